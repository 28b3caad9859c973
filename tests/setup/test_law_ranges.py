"""A law outside the range in which it was fitted: what simulate and check say, and record."""

import json
from io import StringIO
from itertools import chain
from pathlib import Path

import numpy as np
import pytest
from markupsafe import escape
from rich.console import Console

from table_io.block import join_blocks
from table_io.records import Event
from twin.campaign.simulate_grid import simulate_peaks
from twin.model.ideal_response import simulate_sweep
from twin.model.model import Model
from twin.model.stepped_sine import SteppedSineResponse
from twin.model.valid_range import select_first_exits
from twin.monitor.run_state import LiveRunState, update_run_state
from twin.recording.reader import read_recording
from twin.report.report import render_report
from twin.results.report_data import build_report_data
from twin.results.summary import summarise
from twin.rig.check import check_test, print_plan
from twin.setup.run_config import read_model, read_run_config
from twin.setup.unpaced import simulate_ideal
from twin.simulation.command import simulate_profile
from twin.system.progress import RunProgress

PROFILE = """
title = "two frequencies"
model = "{model}"
[specimen]
mass_kg = 550.0
gap_mm = 4.0
[acquisition]
rate_hz = 1000.0
block_samples = 50
[loop_check]
enabled = false
[control]
enabled = false
"""
SWEEP = """
[sweep]
start_hz = 2.0
stop_hz = 2.5
step_hz = 0.5
cycles = 4
measured_cycles = 2
acceleration_g = 0.05
"""
CHIRP = """
[excitation]
kind = "chirp"
start_hz = 1.0
stop_hz = 3.0
duration_s = 10.0
acceleration_g = 0.05
"""
LAW = """
id = "own_cubic"
force = "k * u**3"
[parameters.k]
unit = "N/m3"
low = 0.0
high = 1e12
vanishing = 0.0
typical = 1e7
[range]
u = [-{end}, {end}]
t = [0.0, {seconds}]
"""
SENTENCE = "the law 'own_cubic' is not known here: displacement "


def write_profile(folder: Path, excitation: str, end_m: float, seconds: float = 1e4) -> Path:
    """Write a test of a model with a law that is known up to a displacement and a time."""
    (folder / "own.toml").write_text(LAW.format(end=end_m, seconds=seconds))
    model = folder / "model.toml"
    entry = "\n[[effects]]\nfile = 'own.toml'\nparameters = { k = 1e6 }\n"
    model.write_text(read_model("snm")[1] + entry)
    path = folder / "test.toml"
    path.write_text(PROFILE.format(model=model) + excitation)
    return path


def list_exits(sweep: SteppedSineResponse) -> list[list[str]]:
    """Return the variables that leave their range, by step."""
    return [[range_exit.variable for range_exit in exits] for exits in sweep.range_exits]


def format_check(profile: Path) -> str:
    """Return what `check` prints, in one line."""
    console = Console(width=400, record=True, file=StringIO())
    print_plan(console, check_test(profile))
    return " ".join(console.export_text().split())


@pytest.mark.parametrize(("end_m", "count"), [(1e-3, 1), (0.1, 0)])
@pytest.mark.parametrize("excitation", [SWEEP, CHIRP], ids=["sweep", "history"])
def test_check_warns_once_of_a_range_that_the_test_leaves(
    tmp_path: Path, excitation: str, end_m: float, count: int
) -> None:
    text = format_check(write_profile(tmp_path, excitation, end_m))
    assert text.count(f"warning: {SENTENCE}") == text.count("own_cubic") == count


def test_simulate_shows_and_records_the_exit_once(tmp_path: Path) -> None:
    config = read_run_config(write_profile(tmp_path, SWEEP, 1e-3))
    shown, path = StringIO(), tmp_path / "run.mcap"
    with RunProgress(Console(file=shown, width=400), 1, 1) as progress:
        simulate_ideal(config, "own", path, progress)
    recording = read_recording(path)
    (event,) = (event for event in recording.records(Event) if event.kind == "law_range")
    assert event.text.startswith(SENTENCE)
    assert shown.getvalue().count(event.text) == 1
    u = np.abs(join_blocks(recording.contiguous_blocks("pred")).channel("free/rel_disp_m"))
    end_m = 1e-3 + 0.02 * 2e-3  # with the margin, of the width of the range
    assert u[: event.index].max() <= end_m < u[event.index]


def test_the_report_and_the_monitor_warn_in_words(tmp_path: Path) -> None:
    config = read_run_config(write_profile(tmp_path, SWEEP, 1e-3))
    simulate_ideal(config, "own", tmp_path / "run.mcap", lambda _: None)
    recording = read_recording(tmp_path / "run.mcap")
    summary = summarise(recording, config.parameters)
    (warning,) = summary.warnings
    assert warning.kind == "law_range"
    page = render_report(build_report_data(recording, summary), [])
    section = page[page.index('id="monitoring"') : page.index("Timing, dropouts")]
    assert "law range" in section
    assert escape(warning.text) in section
    assert "law_range" not in page
    state = LiveRunState()
    for item in recording.items:
        state = update_run_state(state, recording.start.run, item)
    (line,) = (line for line in state.events.values() if "own_cubic" in line.text)
    assert (line.level, line.text) == ("WARN", f"law range: {warning.text}")


def test_a_batch_warns_once_of_each_model_and_keeps_every_case(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("twin.studies.figures.draw_study_figures", lambda *_: [])
    profile, out = write_profile(tmp_path, SWEEP, 1e-3), tmp_path / "out"
    models = [str(tmp_path / "model.toml"), "snm"]
    assert simulate_profile(profile, models, ["4", "30"], 1, out, False) == 0
    shown = capsys.readouterr().out
    assert shown.count("own_cubic") == shown.count(f"warning: model, G = 4 mm: {SENTENCE}") == 1
    cases = json.loads((out / "summary.json").read_text())["cases"]
    assert [len(case["warnings"]) for case in cases] == [1, 1, 0, 0]
    assert (out / "report.html").read_text().count("own_cubic&#39; is not known here") == 2


@pytest.mark.parametrize(("end_m", "count"), [(1e-3, 1), (0.1, 0)])
def test_a_history_of_a_campaign_warns_once(tmp_path: Path, end_m: float, count: int) -> None:
    config = read_run_config(write_profile(tmp_path, CHIRP, end_m))
    _, warnings = simulate_peaks(config)
    assert [text.startswith(SENTENCE) for text in warnings] == [True] * count


def test_the_exits_of_a_sweep_are_those_of_its_steps(tmp_path: Path) -> None:
    profile = write_profile(tmp_path, SWEEP, 2.5e-3, seconds=3.0)
    model = read_run_config(profile).model
    strong, weak = (simulate_sweep(model, [0.5, 2.5], level, 2) for level in (0.5, 0.05))
    # static: u = 550 kg * 0.5 m/s2 / 36 kN/m = 7.6 mm, and a tenth
    assert list_exits(strong) == [["u", "t"], ["u", "t"]]
    assert list_exits(weak) == [["t"], ["t"]]
    displacement, time = select_first_exits(chain.from_iterable(strong.range_exits))
    assert abs(displacement.value) == pytest.approx(2.6e-3, rel=0.02)
    assert time.value == pytest.approx(3.06, abs=2e-3)  # a sample
    assert simulate_sweep(Model(model.base), [2.0], 0.05, 2).range_exits == ()
