"""A displacement history from end to end: run, protection, recording, replay, windows, report."""

import json
from collections.abc import Iterator
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from table_io.acquisition.session import OperatorCommand, run_session
from table_io.backends import open_backend
from table_io.block import Block, Label, join_blocks
from table_io.clock import ManualClock
from table_io.records import Check, Event, Level, PrcPoint, RunStop, Trip
from tests.builders.rigs import RIG_TEXT
from tests.replay.in_memory import recorded_in
from tests.table_io.excitation.pulse_train import PulseTrain
from twin.exchange.export import ExportOptions, export_log
from twin.exchange.import_table import import_table
from twin.live.run_command import run_test
from twin.recording.reader import Recording, read_recording
from twin.replay.pipeline_replay import replay_recording
from twin.results.summary import summarise
from twin.setup.run_config import RunConfig, from_texts, read_run_config
from twin.setup.unpaced import play_unpaced
from twin.simulation.command import simulate_profile
from twin.transport.codec import Item

RECORD = """title = "A short record"
[specimen]
mass_kg = 550.0
gap_mm = 4.0
[excitation]
kind = "record"
file = "motion.csv"
windows = 4
blend_s = 0.5
"""
NO_CHECK = "[loop_check]\nenabled = false\n"
PULSES = """title = "Pulses"
[specimen]
mass_kg = 550.0
gap_mm = 4.0
[excitation]
kind = "pulse_train"
height_mm = 6.0
width_s = 0.8
period_s = 1.6
windows = 3
"""


def write_profile(folder: Path, more: str = "", rig: str = "") -> Path:
    """A record of 8 s, 6 mm at 0.8 Hz and 1.5 mm at 2.6 Hz in an envelope, and its rig."""
    t = np.arange(801) / 100.0
    waves = 6 * np.sin(2 * np.pi * 0.8 * t) + 1.5 * np.sin(2 * np.pi * 2.6 * t)
    motion = np.sin(np.pi * t / 8) ** 2 * waves
    rows = (f"{s:.2f},{d:.6f}\n" for s, d in zip(t.tolist(), motion.tolist(), strict=True))
    (folder / "motion.csv").write_text("time_s,disp_mm\n" + "".join(rows))
    if rig:
        (folder / "rig.toml").write_text(rig)
    path = folder / "record.toml"
    path.write_text(f"rig = {'rig.toml' if rig else 'simulated'!r}\n{RECORD}{more}")
    return path


def play_run(
    folder: Path, more: str = "", rig: str = "", stop_at: int | None = None
) -> tuple[RunConfig, Recording, Any]:
    config = read_run_config(write_profile(folder, more, rig))
    latest = [0]

    def interrupt() -> str | None:
        return "asked to stop" if stop_at is not None and latest[0] >= stop_at else None

    def watch(item: Item) -> None:
        latest[0] = max(latest[0], item.index)

    play_unpaced(config, "record", folder / "run.mcap", interrupt, watch)
    recording = read_recording(folder / "run.mcap")
    return config, recording, summarise(recording, config.parameters)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[RunConfig, Recording, Any]:
    """With its loop check, on a sound table whose specimen is the model."""
    return play_run(tmp_path_factory.mktemp("record"))


Run = tuple[RunConfig, Recording, Any]


def join_measured(recording: Recording) -> Block:
    return join_blocks(recording.contiguous_blocks("meas"))


def test_the_table_follows_the_record_after_a_loop_check(run: Run) -> None:
    config, recording, summary = run
    assert (summary.verdict, summary.gaps, summary.trips) == ("complete", 0, [])
    checks = recording.records(Check)
    assert len(checks) > 20
    assert all(check.passed for check in checks)
    block = join_measured(recording)
    block = block.cut(round(summary.windows[0].from_s * block.rate_hz), block.end)
    command = config.drive.command(config.drive.segments[-1].start, len(block))
    assert np.abs(block.channel("drive_disp_m") - command).max() < 2e-6
    lag = round(0.02 * block.rate_hz)
    table = np.roll(block.channel("table_disp_m"), -lag)
    assert np.std((table - command)[:-lag]) < 0.05 * np.std(command)


def test_record_has_no_results_of_a_stepped_sine(run: Run) -> None:
    """No amplitude is tuned: the drive is open loop."""
    _, recording, summary = run
    assert recording.start.steps == ()
    assert not recording.records(Level)
    assert not recording.records(PrcPoint)
    assert summary.steps == summary.jumps == summary.hysteresis == []
    assert summary.u_star_m is None
    assert (join_measured(recording).cycle == -1).all()


def test_the_results_are_given_by_windows(run: Run) -> None:
    _, recording, summary = run
    windows, block = summary.windows, join_measured(recording)
    assert [window.index for window in windows] == [0, 1, 2, 3]
    assert all(before.to_s == after.from_s for before, after in pairwise(windows))
    for window in windows:
        inside = (block.time_s >= window.from_s) & (block.time_s < window.to_s)
        assert set(block.label[inside].tolist()) == {Label.MEASURE}
        assert set(block.step[inside].tolist()) == {window.index}
        u = (block.channel("mass_disp_m") - block.channel("table_disp_m"))[inside]
        assert window.measured.u.peak == pytest.approx(np.abs(u).max())
        assert window.measured.u.rms == pytest.approx(np.sqrt(np.mean(u**2)))
        table = block.channel("table_acc_m_s2")[inside]
        assert window.table_acc.peak == pytest.approx(np.abs(table).max())


def test_the_twin_agrees_where_the_model_is_the_specimen(run: Run) -> None:
    _, _, summary = run
    assert summary.comparison["rel_disp_m"].nrmse < 0.01
    assert summary.comparison["rel_disp_m"].free_nrmse < 0.02
    impacts = 0
    for window in summary.windows[1:3]:
        assert window.comparison["rel_disp_m"].nrmse < 0.01
        for name in ("u", "a", "force_r", "force_l"):
            for key in ("peak", "rms"):
                expected, twin = (
                    getattr(getattr(motion, name), key) for motion in (window.measured, window.twin)
                )
                assert twin == pytest.approx(expected, rel=0.02)
        for side in ("impacts_right", "impacts_left"):
            impacts_measured = getattr(window.measured, side)
            assert abs(impacts_measured - getattr(window.twin, side)) <= 1
            impacts += impacts_measured
    assert impacts > 10


def test_another_model_disagrees(run: Run, tmp_path: Path) -> None:
    _, recording, _ = run
    start = recording.start
    stiffer = start.model_toml.replace("36000", "40000")
    assert stiffer != start.model_toml
    config = from_texts("x", start.profile_toml, start.rig_toml, stiffer, "recording")
    path = tmp_path / "run.mcap"
    replay_recording(recorded_in(recording), config, path, "again", lambda _: None)
    summary: Any = summarise(read_recording(path), config.parameters)
    assert summary.comparison["rel_disp_m"].free_nrmse > 0.05


def test_a_replay_needs_the_recording_alone_and_is_identical(run: Run, tmp_path: Path) -> None:
    config, recording, summary = run
    start = recording.start
    again = from_texts(
        start.name, start.profile_toml, start.rig_toml, start.model_toml, "recording"
    )
    assert again.profile.plan.history_m.tobytes() == config.profile.plan.history_m.tobytes()
    path = tmp_path / "run.mcap"
    identity = replay_recording(recorded_in(recording), again, path, "again", lambda _: None)
    assert identity.is_identical
    assert identity.compared == identity.recorded > 1000
    assert summarise(read_recording(path), again.parameters).windows == summary.windows


@pytest.mark.parametrize(
    ("fault", "kinds"),
    [
        ('kind = "stuck"\nchannel = "table_disp_m"', {"stuck"}),
        ('kind = "gain"\nchannel = "table_disp_m"\nsize = 0.4', {"following"}),
        ('kind = "polarity"\nchannel = "drive_disp_m"', {"command"}),
        ('kind = "dropped"\nfor_s = 0.5', {"lost"}),
    ],
)
def test_a_planted_fault_trips_and_the_table_comes_to_rest(
    fault: str, kinds: set[str], tmp_path: Path
) -> None:
    at_s = 4.0
    rig = f"{RIG_TEXT}\n[[simulated.faults]]\nat_s = {at_s}\n{fault}\n"
    config, recording, summary = play_run(tmp_path, NO_CHECK, rig)
    (trip,) = recording.records(Trip)
    assert summary.verdict == "aborted"
    assert trip.kind in kinds
    assert at_s <= trip.index / config.drive.rate_hz < at_s + 1.0
    stop = recording.stop
    assert stop is not None
    assert stop.states[-1] == "at rest"
    assert stop.index < config.drive.planned_end  # the record was not played to its end
    assert 1 <= len(summary.windows) < 4


@pytest.mark.parametrize("stop_s", [1.0, 4.56])
def test_a_stop_in_motion_comes_to_rest_smoothly(stop_s: float, tmp_path: Path) -> None:
    config, recording, summary = play_run(tmp_path, NO_CHECK, stop_at=round(stop_s * 2000))
    assert summary.verdict == "stopped"
    block = join_measured(recording)
    command = block.channel("drive_disp_m")
    assert np.abs(command[-500:]).max() < 1e-6
    assert np.abs(np.diff(command)).max() * 2000 < 1.1 * config.margins[-1].velocity_m_s
    assert (block.label[-500:] == Label.REST).all()
    assert (block.label == Label.STOP).any()
    table = block.channel("table_acc_m_s2")
    assert np.abs(table).max() < 1.2 * config.margins[-1].acceleration_m_s2


def test_a_record_cannot_be_held_and_plays_on(tmp_path: Path) -> None:
    config = read_run_config(write_profile(tmp_path, NO_CHECK))
    clock = ManualClock()
    backend = open_backend(config.rig, config.profile, clock)
    asked: list[int] = []

    def commands() -> OperatorCommand | None:
        asked.append(1)
        return OperatorCommand("hold", "") if len(asked) == 300 else None

    session: Iterator[Any] = run_session(
        config.session_setup, backend, clock, config.make_start_factory("r", "table"), commands
    )
    with closing(session):  # type: ignore[type-var]
        items = list(session)
    refused = [item for item in items if isinstance(item, Event) and item.kind == "refused"]
    assert len(refused) == 1
    assert isinstance(items[-1], RunStop)
    assert items[-1].verdict == "complete"


def test_blocks_of_another_length_give_the_same_record(tmp_path: Path) -> None:
    commands = []
    for samples in (7, 64):
        folder = tmp_path / str(samples)
        folder.mkdir()
        more = f"{NO_CHECK}[acquisition]\nblock_samples = {samples}\n"
        _, recording, summary = play_run(folder, more)
        assert summary.verdict == "complete"
        commands.append(join_measured(recording).values)
    size = min(values.shape[1] for values in commands)
    assert commands[0][:, :size].tobytes() == commands[1][:, :size].tobytes()


def test_a_kind_of_one_file_runs_with_all_that_belongs_to_a_run(tmp_path: Path) -> None:
    """As `run --speed max`: check, drive, twin, recording, summary, report."""
    path, out = tmp_path / "pulses.toml", tmp_path / "out"
    path.write_text(PULSES)
    assert run_test(path, out, True, None, None, False, "") == 0
    summary = json.loads((out / "summary.json").read_text())
    assert (summary["verdict"], len(summary["windows"])) == ("complete", 3)
    assert summary["comparison"]["rel_disp_m"]["nrmse"] < 0.02
    for window in summary["windows"]:  # a pulse each
        assert window["table_disp"]["peak"] == pytest.approx(6e-3, rel=0.05)
    page = (out / "report.html").read_text()
    assert "<h2>Windows</h2>" in page
    assert "pulse_train" in page
    assert '<figure id="history">' in page
    config = read_recording(out / "run.mcap").start.profile_toml
    assert config == PULSES
    assert PulseTrain.model_fields.keys() >= {"height_mm", "windows"}


def test_the_model_alone_plays_the_record(tmp_path: Path) -> None:
    path, out = write_profile(tmp_path), tmp_path / "out"
    assert simulate_profile(path, [], [], None, out, False) == 0
    summary = json.loads((out / "summary.json").read_text())
    assert len(summary["windows"]) == 4
    assert all(window["measured"] is None for window in summary["windows"])
    assert summary["windows"][1]["twin"]["impacts_right"] > 2


def test_an_export_comes_back_with_its_windows(run: Run, tmp_path: Path) -> None:
    _, recording, summary = run
    table = tmp_path / "samples.csv"
    export_log(ExportOptions(recording.path, ("csv",), tmp_path / "samples"))
    assert import_table(table, tmp_path / "back.mcap").gaps == 0
    back = read_recording(tmp_path / "back.mcap")
    assert back.start.steps == ()
    config = from_texts(
        "x", back.start.profile_toml, back.start.rig_toml, back.start.model_toml, "x"
    )
    windows: Any = summarise(back, config.parameters).windows
    assert [window.measured for window in windows] == [
        window.measured for window in summary.windows
    ]


def test_an_acceleration_of_a_mat_file_is_played_and_replayed_from_the_recording(
    tmp_path: Path,
) -> None:
    """2 Hz at 0.1 g in an envelope of 8 s: the table follows, and the replay needs no mat file."""
    t = np.arange(801) / 100.0
    ground = np.sin(np.pi * t / 8) ** 4 * np.sin(2 * np.pi * 2.0 * t)
    savemat(tmp_path / "ground.mat", {"ground": 0.1 * ground, "note": np.zeros(2)})
    keys = 'unit = "g"\nstep_s = 0.01\nband_hz = [0.4, 20.0]\n'
    text = RECORD.replace("motion.csv", "ground.mat") + keys + NO_CHECK
    path = tmp_path / "record.toml"
    path.write_text(f"rig = 'simulated'\n{text}")
    config = read_run_config(path)
    play_unpaced(config, "record", tmp_path / "run.mcap", lambda: None, lambda _: None)
    (tmp_path / "ground.mat").unlink()
    recording = read_recording(tmp_path / "run.mcap")
    block = join_measured(recording)
    acceleration = np.abs(block.channel("table_acc_m_s2")).max()
    assert acceleration == pytest.approx(0.1 * 9.80665, rel=0.05)
    start = recording.start
    again = from_texts(
        start.name, start.profile_toml, start.rig_toml, start.model_toml, "recording"
    )
    assert again.profile.plan.history_m.tobytes() == config.profile.plan.history_m.tobytes()
    identity = replay_recording(
        recorded_in(recording), again, tmp_path / "again.mcap", "again", lambda _: None
    )
    assert identity.is_identical
