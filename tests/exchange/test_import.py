"""A table of samples becomes a log: what our own run says of itself comes out of its CSV again."""

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from table_io.block import Block, Label
from table_io.records import Comparison, Event, PrcPoint, SampleGap
from tests.exchange.csv_tables import write_csv
from tests.input_errors import raises_input_error
from tests.setup.test_unpaced import QUICK, play_run
from twin.exchange.export import ExportOptions, export_log
from twin.exchange.import_table import ImportOptions, import_table
from twin.inspection.curves import print_curves
from twin.recording.reader import Recording, read_recording
from twin.replay.command import ReplayRequest, replay_logs
from twin.results.recordings import read_recorded_config
from twin.results.summary import summarise

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
SHORT = QUICK.replace("start_hz = 2.6", "start_hz = 3.6")
SILVERBOX = """
rate_hz = 610.35
[columns]
table_acc_m_s2 = { column = "V1", gain = -1.0 }
rel_disp_m = { column = "V2" }
"""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Recording]:
    """A folder with quick.toml and table.csv of an unpaced run, and the run itself."""
    folder = tmp_path_factory.mktemp("ours")
    recording = read_recording(play_run(folder, SHORT)[1])
    write_csv(recording, folder / "table.csv")
    return folder, recording


@pytest.fixture(scope="module")
def imported_log(run: tuple[Path, Recording]) -> Recording:
    folder, _ = run
    log = folder / "imported" / "run.mcap"
    assert (
        import_table(folder / "table.csv", log, ImportOptions(profile=folder / "quick.toml")).gaps
        == 0
    )
    return read_recording(log)


def whole(recording: Recording) -> Block:
    (piece,) = recording.contiguous_blocks("meas")
    return piece


def steps(recording: Recording) -> Any:
    return summarise(recording, read_recorded_config(recording).parameters).steps


def read_warnings(recording: Recording) -> str:
    return "\n".join(event.text for event in recording.records(Event))


def test_import_table_keeps_the_samples(
    run: tuple[Path, Recording], imported_log: Recording
) -> None:
    ours, theirs = whole(run[1]), whole(imported_log)
    assert (theirs.rate_hz, theirs.channels) == (ours.rate_hz, ours.channels)
    np.testing.assert_allclose(theirs.values, ours.values, rtol=1e-8)


def test_import_table_finds_steps_and_measured_cycles(
    run: tuple[Path, Recording], imported_log: Recording
) -> None:
    ours, theirs = whole(run[1]), whole(imported_log)
    assert imported_log.start.steps == run[1].start.steps
    for step in imported_log.start.steps:
        true, detected = (
            np.flatnonzero((log.step == step.index) & (log.label == Label.MEASURE))
            for log in (ours, theirs)
        )
        length = ours.rate_hz / step.frequency_hz
        assert abs(true[0] - detected[0]) < 0.02 * length
        assert abs(true[-1] - detected[-1]) < 0.02 * length
        held = (ours.step == step.index) & (ours.cycle >= 0) & (theirs.cycle >= 0)
        assert (ours.cycle == theirs.cycle)[held].mean() > 0.98


def test_prc_of_an_import_is_that_of_the_run(
    run: tuple[Path, Recording], imported_log: Recording
) -> None:
    for ours, theirs in zip(steps(run[1]), steps(imported_log), strict=True):
        assert ours.frequency_hz == theirs.frequency_hz
        assert ours.direction == theirs.direction
        # At the jump the motion is no steady one, and a sample earlier is another motion.
        near = 5e-3 if ours.measured.spread > 0.02 else 1e-3
        for key in ("eta_d", "eta_a", "eta_r", "eta_l", "r_r", "r_l"):
            expected = getattr(ours.measured, key)
            assert getattr(theirs.measured, key) == pytest.approx(expected, rel=near)
        assert ours.measured.impacts_right == theirs.measured.impacts_right


def test_prc_and_replay_read_an_imported_log(
    imported_log: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    print_curves(imported_log.path, True)
    assert '"frequency_hz": 3.6' in capsys.readouterr().out
    assert replay_logs(ReplayRequest([imported_log.path], [], tmp_path / "again")) == 0
    assert len(read_recording(tmp_path / "again" / "run.mcap").records(PrcPoint)) == len(
        imported_log.start.steps
    )
    assert (tmp_path / "again" / "report.html").stat().st_size > 10_000


def test_import_table_with_the_sweep_of_another_profile(
    run: tuple[Path, Recording], tmp_path: Path
) -> None:
    profile = tmp_path / "other.toml"
    profile.write_text(SHORT.replace("start_hz = 3.6", "start_hz = 1.0").replace("0.2", "1.7"))
    log = tmp_path / "other.mcap"
    import_table(run[0] / "table.csv", log, ImportOptions(profile=profile))
    recording = read_recording(log)
    driven = [(step.direction, step.frequency_hz) for step in run[1].start.steps]
    detected = [(step.direction, step.frequency_hz) for step in recording.start.steps]
    assert [way for way, _ in detected] == [way for way, _ in driven]
    np.testing.assert_allclose([hz for _, hz in detected], [hz for _, hz in driven], rtol=2e-3)
    assert replay_logs(ReplayRequest([log], [], tmp_path / "again")) == 0
    again = read_recording(tmp_path / "again" / "run.mcap").records(PrcPoint)
    assert [step.frequency_hz for step in again] == [hz for _, hz in detected]


def rows(run: tuple[Path, Recording]) -> list[str]:
    """Header and rows of the first second of the sweep."""
    return (run[0] / "table.csv").read_text().splitlines()[:6001]


def test_import_table_records_a_hole_as_a_gap(run: tuple[Path, Recording], tmp_path: Path) -> None:
    lines = rows(run)
    del lines[2001:2051]
    (tmp_path / "holed.csv").write_text("\n".join(lines))
    log = tmp_path / "run.mcap"
    assert (
        import_table(tmp_path / "holed.csv", log, ImportOptions(profile=run[0] / "quick.toml")).gaps
        == 1
    )
    recording = read_recording(log)
    assert recording.records(SampleGap) == (SampleGap(2000, 50, "", "lost"),)
    assert [(block.index, block.end) for block in recording.contiguous_blocks("meas")] == [
        (0, 2000),
        (2050, 6000),
    ]
    assert recording.missing_samples == 50


def test_import_table_keeps_lost_cells_and_sensors_lost(
    run: tuple[Path, Recording], tmp_path: Path
) -> None:
    table = [line.split(",") for line in rows(run)]
    place = table[0].index("force_r1_n")
    other = table[0].index("mass_acc_m_s2")
    for line in table[1:]:
        line[place] = ""
    table[101][other] = "NaN"
    (tmp_path / "lost.csv").write_text("\n".join(map(",".join, table)))
    assert import_table(
        tmp_path / "lost.csv", tmp_path / "l.mcap", ImportOptions(profile=run[0] / "quick.toml")
    ).gaps
    recording = read_recording(tmp_path / "l.mcap")
    assert np.isnan(whole(recording).channel("force_r1_n")).all()
    assert np.flatnonzero(np.isnan(whole(recording).channel("mass_acc_m_s2"))).tolist() == [100]
    assert set(recording.records(SampleGap)) == {
        SampleGap(0, 6000, "force_r1_n", "lost"),
        SampleGap(100, 1, "mass_acc_m_s2", "lost"),
    }
    assert "force_r1_n: all samples lost" in read_warnings(recording)


def test_import_table_takes_the_rate_of_the_file(
    run: tuple[Path, Recording], tmp_path: Path
) -> None:
    lines = rows(run)
    (tmp_path / "half.csv").write_text("\n".join([lines[0], *lines[1::2]]))
    profile = tmp_path / "half.toml"
    profile.write_text(SHORT + "[acquisition]\nblock_samples = 10 # ten\nrate_hz = 2000.0\n")
    import_table(tmp_path / "half.csv", tmp_path / "half.mcap", ImportOptions(profile=profile))
    recorded = read_recorded_config(read_recording(tmp_path / "half.mcap")).profile
    assert recorded.acquisition.rate_hz == 1000.0
    assert recorded.acquisition.block_samples == 10
    assert recorded.specimen.gap_mm == 4.0
    # too slow to play, which an existing file need not be
    (tmp_path / "slow.csv").write_text("\n".join([lines[0], *lines[1::10]]))
    import_table(tmp_path / "slow.csv", tmp_path / "slow.mcap", ImportOptions(profile=profile))
    slow = read_recorded_config(read_recording(tmp_path / "slow.mcap")).profile
    assert slow.acquisition.rate_hz == 200.0
    assert slow.steps == recorded.steps


def test_import_table_of_an_export_is_identical(
    run: tuple[Path, Recording], tmp_path: Path
) -> None:
    export_log(ExportOptions(run[1].path, ("parquet",), tmp_path / "out"))
    assert import_table(tmp_path / "out.parquet", tmp_path / "again.mcap").gaps == 0
    again = read_recording(tmp_path / "again.mcap")
    assert whole(again).is_identical(whole(run[1]))
    for name in ("steps", "profile_toml", "rig_toml", "model_toml"):
        assert getattr(again.start, name) == getattr(run[1].start, name)
    (ours,), (theirs,) = (recording.contiguous_blocks("pred") for recording in (run[1], again))
    assert theirs.is_identical(ours)
    assert again.records(PrcPoint) == run[1].records(PrcPoint)
    assert "no --profile" not in read_warnings(again)
    assert "steps, labels and cycles are taken from the file" in read_warnings(again)


def test_import_table_without_a_profile_warns_and_has_its_curve(
    run: tuple[Path, Recording], tmp_path: Path
) -> None:
    """Its labels tell how many cycles were held and measured, 6 and 2 here."""
    export_log(ExportOptions(run[1].path, ("csv",), tmp_path / "out"))
    imported = import_table(tmp_path / "out.csv", tmp_path / "bare.mcap")
    bare = read_recording(tmp_path / "bare.mcap")
    assert len(bare.records(PrcPoint)) == len(run[1].start.steps)
    sweep = read_recorded_config(bare).profile.sweep
    assert (sweep.cycles, sweep.measured_cycles) == (6, 2)
    (warning,) = (event for event in bare.records(Event) if event.kind == "warning")
    assert warning.text.startswith("no --profile: unit mass, no gap stated, a placeholder model")
    assert f"warning: {warning.text}" in imported.notes
    bare_size = len(whole(bare))
    assert (imported.gaps, imported.samples, imported.channels) == (
        0, bare_size, bare.start.channels,
    )  # fmt: skip
    assert "no --profile" not in read_warnings(run[1])


def test_mass_and_gap_are_stated_without_a_profile_or_in_it(
    run: tuple[Path, Recording], tmp_path: Path
) -> None:
    export_log(ExportOptions(run[1].path, ("csv",), tmp_path / "out"))
    stated = ImportOptions(settings={"mass_kg": 12.5, "gap_mm": 3.0}, accept=True)
    import_table(tmp_path / "out.csv", tmp_path / "bare.mcap", stated)
    bare = read_recording(tmp_path / "bare.mcap")
    specimen = read_recorded_config(bare).profile.specimen
    assert (specimen.mass_kg, specimen.gaps_m) == (12.5, (0.0015, 0.0015))
    assert "12.5 kg, a gap of 3 mm, a placeholder model" in read_warnings(bare)
    with raises_input_error(key="gap_mm", value=3.0, problem="the profile states the gap"):
        import_table(
            tmp_path / "out.csv", tmp_path / "both.mcap",
            replace(stated, settings={"gap_mm": 3.0}, profile=run[0] / "quick.toml"),
        )  # fmt: skip


@pytest.mark.parametrize(("key", "value"), [("gap_mm", math.nan), ("mass_kg", -5.0)])
def test_an_impossible_specimen_is_one_clear_error(
    key: str, value: float, run: tuple[Path, Recording], tmp_path: Path
) -> None:
    options = ImportOptions(settings={key: value}, accept=True)
    with raises_input_error(key=key):
        import_table(run[0] / "table.csv", tmp_path / "l.mcap", options)


def test_a_file_that_states_its_specimen_takes_no_other(
    run: tuple[Path, Recording], tmp_path: Path
) -> None:
    export_log(ExportOptions(run[1].path, ("parquet",), tmp_path / "out"))
    options = ImportOptions(settings={"gap_mm": 4.0}, accept=True)
    with raises_input_error(key="gap_mm", value=4.0, problem="states the gap"):
        import_table(tmp_path / "out.parquet", tmp_path / "l.mcap", options)


def test_a_file_too_slow_for_a_model_is_referred_to_another_model(
    run: tuple[Path, Recording], tmp_path: Path
) -> None:
    profile = tmp_path / "light.toml"
    text = (run[0] / "quick.toml").read_text()
    profile.write_text(text.replace("mass_kg = 550.0", "mass_kg = 0.5"))
    assert "mass_kg = 0.5" in profile.read_text()
    with raises_input_error(key="rate_hz", problem="too low", remedy="a model of this specimen"):
        import_table(run[0] / "table.csv", tmp_path / "l.mcap", ImportOptions(profile=profile))


def test_import_table_prefers_labels_to_detected_steps(
    run: tuple[Path, Recording], tmp_path: Path
) -> None:
    """One that is not all of them is none."""
    export_log(
        ExportOptions(
            run[1].path, ("csv",), tmp_path / "out", channels=("table_acc_m_s2",), steps=(1, 2)
        )
    )
    import_table(
        tmp_path / "out.csv", tmp_path / "a.mcap", ImportOptions(profile=run[0] / "quick.toml")
    )
    steps = read_recording(tmp_path / "a.mcap").start.steps
    assert [step.frequency_hz for step in steps] == [
        step.frequency_hz for step in run[1].start.steps[1:3]
    ]
    lines = (tmp_path / "out.csv").read_text().splitlines()
    kept = [k for k, name in enumerate(lines[0].split(",")) if name != "cycle"]
    rows = [",".join(line.split(",")[k] for k in kept) for line in lines]
    (tmp_path / "less.csv").write_text("\n".join(rows))
    import_table(
        tmp_path / "less.csv", tmp_path / "b.mcap", ImportOptions(profile=run[0] / "quick.toml")
    )
    assert "left out: step, label, direction" in read_warnings(read_recording(tmp_path / "b.mcap"))


def test_import_table_of_a_shaking_table_by_a_map(tmp_path: Path) -> None:
    card = tmp_path / "map.toml"
    card.write_text(
        '[columns]\ntime_s = { column = "timepos:1" }\n'
        'table_disp_m = { column = "timepos:2", gain = 0.01 }\n'
    )
    file = open_dataset("shaking_table/SineA5F2.npz")
    assert import_table(file, tmp_path / "a.mcap", ImportOptions(columns=card)).gaps == 0
    recording = read_recording(tmp_path / "a.mcap")
    assert (whole(recording).rate_hz, len(whole(recording))) == (200.0, 4001)
    (step,) = recording.start.steps
    assert step.frequency_hz == pytest.approx(2.0, rel=1e-3)


def test_import_table_of_a_component_test_is_not_replayed(tmp_path: Path) -> None:
    time = np.arange(4000) / 200
    u = 0.01 * np.sin(2 * np.pi * time)
    table = np.array([time, u, 36e3 * u]).T
    file, log = tmp_path / "component.csv", tmp_path / "component.mcap"
    np.savetxt(file, table, delimiter=",", header="time_s,rel_disp_m,damper_force_n", comments="")
    assert import_table(file, log).gaps == 0
    recording = read_recording(log)
    assert recording.start.channels == ("damper_force_n", "rel_disp_m")
    assert not recording.records(Comparison)
    assert "no --profile" in read_warnings(recording)
    assert recording.start.steps[0].frequency_hz == pytest.approx(1.0, rel=1e-3)
    with raises_input_error(where=log, key="table_acc_m_s2"):
        replay_logs(ReplayRequest([log], [], tmp_path / "out"))
    with raises_input_error(where=log):
        import_table(file, log)


def open_dataset(name: str) -> Path:
    path = DATA / name
    if not path.is_file():
        pytest.skip("the measured data of others are not here")
    return path


def test_import_table_of_an_earthquake_has_no_steps(tmp_path: Path) -> None:
    log = tmp_path / "b" / "run.mcap"
    assert import_table(open_dataset("bncs/CNP100.csv"), log).gaps == 0
    recording = read_recording(log)
    block = whole(recording)
    assert block.rate_hz == 200.0
    u = np.genfromtxt(DATA / "bncs/CNP100.csv", delimiter=",", names=True)["rel_disp_m"]
    assert block.channel("rel_disp_m") - block.channel("rel_disp_m")[0] == pytest.approx(u - u[0])
    assert set(block.step) == {-1}
    assert set(block.label) == {Label.REST, Label.SETTLE}
    assert "no stepped sine" in read_warnings(recording)
    assert replay_logs(ReplayRequest([log], [], tmp_path / "again")) == 0


def test_import_table_of_the_silverbox_by_a_map(tmp_path: Path) -> None:
    (tmp_path / "map.toml").write_text(SILVERBOX)
    file, log = tmp_path / "s.csv", tmp_path / "s.mcap"
    lines = open_dataset("silverbox/SNLS80mV.csv").read_text().splitlines(keepends=True)
    file.write_text("".join(lines[:20_001]))
    assert import_table(file, log, ImportOptions(columns=tmp_path / "map.toml")).gaps == 0
    block = whole(read_recording(log))
    assert (block.rate_hz, len(block)) == (610.35, 20_000)
    acc, u = block.channel("table_acc_m_s2"), block.channel("rel_disp_m")
    first, second = (float(line.split(",")[0]) for line in lines[1:3])
    assert acc[1] - acc[0] == pytest.approx(first - second)  # gain -1
    still = block.label == Label.REST
    assert [acc[still].mean(), u[still].mean()] == pytest.approx([0.0, 0.0], abs=1e-12)
    assert set(block.step) == {-1}


def test_a_table_is_tared_where_it_is_still_unless_bumpers_press(
    run: tuple[Path, Recording], tmp_path: Path
) -> None:
    """A laser or load cell of others has any zero; one that is pressed at rest has none."""
    zeros = {"mass_disp_m": 2e-4, "mass_acc_m_s2": -0.03, "force_r1_n": 4.0}
    header, *lines = (run[0] / "table.csv").read_text().splitlines()
    rows = np.array([line.split(",") for line in lines], dtype=np.float64)
    rows += [zeros.get(name, 0.0) for name in header.split(",")]
    file = tmp_path / "table.csv"
    np.savetxt(file, rows, fmt="%.9g", delimiter=",", header=header, comments="")
    known = whole(run[1])
    at_rest = slice(0, np.flatnonzero(known.label != Label.REST)[0])
    for number, (gap, is_tared) in enumerate(((None, True), ("gap_mm = -1.0", False))):
        text = (run[0] / "quick.toml").read_text()
        (tmp_path / f"{number}.toml").write_text(
            text if gap is None else re.sub("gap_mm = .*", gap, text)
        )
        log = tmp_path / f"{number}.mcap"
        options = ImportOptions(profile=tmp_path / f"{number}.toml")
        notes = "; ".join(import_table(file, log, options).notes)
        block = whole(read_recording(log))
        for name, zero in zeros.items():
            ours, theirs = block.channel(name), known.channel(name)
            left = ours - theirs
            assert left == pytest.approx(
                np.full(left.size, -theirs[at_rest].mean() if is_tared else zero), abs=1e-6
            )
            assert (f"{name} by" in notes) is is_tared
