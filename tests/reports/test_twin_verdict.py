"""Verdict on the twin: agrees on clean rigs, departs where the specimen is another one."""

import json
import math
import tomllib
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from table_io.block import Block
from table_io.config.base import format_toml
from table_io.records import NormalizedResponse, PrcPoint
from tests.builders.profiles import AT_1_KHZ, UNCHECKED, format_test
from tests.builders.rigs import RIG_TEXT
from tests.builders.truths import seal_truth
from twin.compare.monitoring.cycle import ChannelNoise
from twin.recording.reader import read_recording
from twin.results.contracts import RunSummary, TwinVerdict
from twin.results.summary import summarise
from twin.results.twin_verdict import (
    _add_cycles,
    _median_half_range,
    compare_branches,
    judge_twin,
    name_command,
)
from twin.setup.run_config import read_run_config
from twin.setup.unpaced import play_unpaced

Json = dict[str, Any]
TABLES = AT_1_KHZ | UNCHECKED | {"protection": {"sensor": "warn", "alarm": 0.2}}
FRICTION = '[[effects]]\nid = "coulomb_friction"\nparameters = { fc = 50.0 }\n'
STIFF_BUMPERS = "[base]\nbumper_stiffness_n_m = 700e3\n"
IMPACTS = {"gap_mm": 4.0, "start_hz": 2.4, "stop_hz": 4.4, "step_hz": 0.4}
PRECOMPRESSED = {"gap_mm": -2.0, "start_hz": 4.0, "stop_hz": 8.0, "step_hz": 1.0}


def run_test(
    folder: Path, sweep: dict[str, Any], truth: str = "", laser_range_mm: float = 100.0
) -> Json:
    """Summary of a run on a rig that hides a truth, as written."""
    rig = tomllib.loads(RIG_TEXT)
    simulated = rig["simulated"]
    if truth:
        simulated |= seal_truth(folder, truth)
    sensors = [
        sensor | ({"range": laser_range_mm} if sensor["channel"] == "mass_disp_m" else {})
        for sensor in rig["sensors"]
    ]
    rig |= {"simulated": simulated, "sensors": sensors}
    (folder / "rig.toml").write_text(format_toml(rig))
    (folder / "test.toml").write_text(format_test(**sweep, tables=TABLES, rig=folder / "rig.toml"))
    config = read_run_config(folder / "test.toml")
    play_unpaced(config, "test", folder / "run.mcap", lambda: None, lambda _: None)
    recording = read_recording(folder / "run.mcap")
    summarise(recording, config.parameters).write(folder / "summary.json")
    return dict(json.loads((folder / "summary.json").read_text()))


@pytest.fixture(scope="module")
def clean(tmp_path_factory: pytest.TempPathFactory) -> Json:
    return run_test(tmp_path_factory.mktemp("clean"), IMPACTS)


def test_the_twin_of_a_clean_rig_agrees_at_the_noise(clean: Json) -> None:
    verdict = clean["twin_verdict"]
    assert verdict["verdict"] == "agrees"
    assert verdict["missing_jumps"] == verdict["unexpected_jumps"] == []
    assert verdict["steps_judged"] == len(clean["steps"]) > verdict["steps_outside"] == 0
    assert 0.8 < verdict["misfit"] < 1.5
    assert verdict["worst"]["share"] < 0.5
    assert verdict["next_command"] == "shaketwin view DIR"


def test_another_clean_rig_with_precompressed_bumpers_agrees(tmp_path: Path) -> None:
    assert run_test(tmp_path, PRECOMPRESSED)["twin_verdict"]["verdict"] == "agrees"


@pytest.mark.parametrize(("sweep", "truth"), [(IMPACTS, FRICTION), (PRECOMPRESSED, STIFF_BUMPERS)])
def test_the_twin_of_another_specimen_departs_while_the_test_is_complete(
    sweep: dict[str, Any], truth: str, tmp_path: Path
) -> None:
    summary = run_test(tmp_path, sweep, truth)
    verdict = summary["twin_verdict"]
    assert (summary["verdict"], verdict["verdict"]) == ("complete", "departs")
    assert verdict["steps_outside"] > 0
    assert verdict["worst"]["share"] > 1
    assert verdict["worst"]["misfit"] > 10
    assert verdict["worst"]["error"] > verdict["worst"]["band"]
    assert verdict["next_command"] == "shaketwin discover DIR"


@pytest.mark.parametrize(
    ("range_mm", "verdict"), [(6.0, "agrees"), (2.0, "not judged"), (0.2, "not judged")]
)
def test_a_step_with_a_sensor_off_its_range_is_not_judged(
    range_mm: float, verdict: str, clean: Json, tmp_path: Path
) -> None:
    """Of a clean rig with a short laser: the steps of small motion agree, the others are open."""
    summary = run_test(tmp_path, IMPACTS, laser_range_mm=range_mm)
    judged = summary["twin_verdict"]
    assert judged["verdict"] == verdict, judged["reason"]
    assert judged["steps_outside"] == 0
    clipped = {*summary["clipped_steps"]}
    assert judged["steps_judged"] == len(clean["steps"]) - len(clipped)
    assert any(warning["is_clipped"] for warning in summary["warnings"])
    assert clipped


def judge_changed(clean: Json, **entries: Any) -> Json:
    return judge_twin(RunSummary.model_validate(deepcopy(clean) | entries)).to_plain()


@pytest.mark.parametrize(
    ("grid_step_hz", "steps", "verdict"),
    [(0.4, 0, "agrees"), (0.4, 1, "departs"), (0.04, 1, "agrees"), (0.04, 2, "departs")],
)
def test_a_jump_belongs_within_a_step_of_the_grid_and_two_percent_of_its_frequency(
    clean: Json, grid_step_hz: float, steps: int, verdict: str
) -> None:
    jump = next(jump for jump in clean["jumps"] if jump["direction"] == "backward")
    jump |= {"from_hz": jump["to_hz"] + grid_step_hz}
    shift = grid_step_hz * steps
    moved = jump | {"from_hz": jump["from_hz"] + shift, "to_hz": jump["to_hz"] + shift}
    judged = judge_changed(clean, jumps=[jump], twin_jumps=[moved])
    assert judged["verdict"] == verdict
    is_apart = verdict == "departs"
    assert len(judged["missing_jumps"]) == len(judged["unexpected_jumps"]) == is_apart


@pytest.mark.parametrize(
    ("eta_d", "free_error", "words"),
    [
        (0.2, 0.1, "another branch"),
        (1.3, 0.3, "another amplitude"),
        (1.0, 1.8, "opposite in phase"),
    ],
)
def test_a_step_with_another_response_of_the_twin_departs_and_is_named(
    clean: Json, eta_d: float, free_error: float, words: str
) -> None:
    """Whatever the restarted twin says: a missed jump leaves its error small."""
    steps = deepcopy(clean["steps"])
    step = steps[1]
    step["twin"]["eta_d"] *= eta_d
    step["branch"] = {"is_same": False, "share": 5.0, "free_error": free_error}
    judged = judge_changed(clean, steps=steps)
    assert (judged["verdict"], judged["steps_apart"]) == ("departs", 1)
    assert judged["worst_branch"]["step"] == step["index"]
    assert words in judged["reason"]
    assert judged["next_command"] == "shaketwin discover DIR"


def test_a_step_between_a_jump_and_its_late_counterpart_is_not_apart(clean: Json) -> None:
    steps = deepcopy(clean["steps"])
    step = next(step for step in steps if step["direction"] == "forward")
    step["branch"]["is_same"] = False
    jump = {"direction": "forward", "kind": "down", "to_hz": step["frequency_hz"]}
    late = jump | {"from_hz": jump["to_hz"], "to_hz": jump["to_hz"] + 0.04}
    jump["from_hz"] = jump["to_hz"] - 0.04
    assert judge_changed(clean, steps=steps)["steps_apart"] == 1
    judged = judge_changed(clean, steps=steps, jumps=[jump], twin_jumps=[late])
    assert judged["steps_apart"] == 0


def test_a_twin_that_agrees_with_another_test_is_not_judged(clean: Json) -> None:
    missed = clean["excitation_verdict"] | {"verdict": "missed"}
    judged = judge_changed(clean, excitation_verdict=missed)
    assert judged["verdict"] == "not judged"
    assert "did not play this test" in judged["reason"]


def test_every_step_compares_the_free_twin_in_amplitude_and_phase(clean: Json) -> None:
    branches = [step["branch"] for step in clean["steps"]]
    assert all(branch["is_same"] and branch["share"] < 0.5 for branch in branches)
    assert max(branch["free_error"] for branch in branches) < 0.2


@pytest.mark.parametrize(
    ("spread", "free_error", "twin_eta", "is_same"),
    [
        (0.01, 0.1, 0.2, True),
        (0.01, 0.1, 0.3, False),
        (0.01, 1.8, 0.2, False),  # in antiphase
        (0.3, 1.8, 0.2, True),  # chaotic: no phase
        (0.01, math.nan, 0.2, True),
    ],
)
def test_the_free_twin_is_on_the_branch_by_amplitude_and_phase(
    spread: float, free_error: float, twin_eta: float, is_same: bool
) -> None:
    measured, twin = (
        NormalizedResponse(eta, 1.0, 0.0, 0.0, 0.0, 0.0, (0,), (0,), 0.0, spread)
        for eta in (0.2, twin_eta)
    )
    point = PrcPoint(100, 0, "forward", 2.0, measured, twin, 0.5, 0.5, 0.0)
    branch = compare_branches(point, free_error, ChannelNoise(), 0.03)
    assert branch is not None
    assert branch.is_same == is_same


def test_a_jump_that_only_the_twin_has_is_missing(clean: Json) -> None:
    jumps = [jump for jump in clean["jumps"] if jump["direction"] == "backward"]
    judged = judge_changed(clean, jumps=[], hysteresis=[], twin_jumps=jumps)
    assert judged["verdict"] == "departs"
    assert judged["missing_jumps"] == jumps


def test_one_step_outside_decides_and_is_the_worst(clean: Json) -> None:
    steps = deepcopy(clean["steps"])
    entry = steps[2]["agreement"]["mass_acc_m_s2"]
    entry["error"] = 1.5 * entry["band"]
    worst = judge_changed(clean, steps=steps)
    assert (worst["verdict"], worst["steps_outside"]) == ("departs", 1)
    assert worst["worst"]["step"] == steps[2]["index"]
    assert worst["worst"]["share"] == pytest.approx(1.5)


@pytest.mark.parametrize(
    ("kind", "verdict"),
    [("disagreement", "departs"), ("unexpected jump", "agrees"), ("drift", "agrees")],
)
def test_kind_of_a_warning_decides_the_twin_verdict(clean: Json, kind: str, verdict: str) -> None:
    warnings = [{"at_s": 1.0, "kind": kind, "text": ""}]
    judged = judge_changed(clean, warnings=warnings)
    assert (judged["verdict"], judged["warnings"]) == (verdict, 1)
    clipped = [warning | {"is_clipped": True} for warning in warnings]
    assert judge_changed(clean, warnings=clipped)["verdict"] == "agrees"


@pytest.mark.parametrize(("nrmse", "verdict"), [(0.03, "agrees"), (0.27, "departs")])
def test_a_history_is_judged_by_its_nrmse(clean: Json, nrmse: float, verdict: str) -> None:
    comparison = {"rel_disp_m": {"nrmse": nrmse, "free_nrmse": 0.5, "noise_floor": 0.003}}
    history: Json = {"planned_steps": 0, "steps": [], "jumps": [], "twin_jumps": []}
    judged = judge_changed(clean, **history, comparison=comparison)
    assert judged["verdict"] == verdict
    assert "jump" not in judged["reason"]
    assert judged["misfit"] == pytest.approx(nrmse / 0.003)
    clipped = judge_changed(
        clean, **history, comparison=comparison, clipped_channels=["mass_disp_m"]
    )
    assert clipped["verdict"] == "not judged"
    assert "mass_disp_m" in clipped["reason"]


def test_a_model_alone_is_not_judged(clean: Json) -> None:
    judged = judge_changed(clean, run=clean["run"] | {"source": "model"})
    assert judged["verdict"] == "not judged"


def without_agreement(clean: Json, count: int) -> list[Json]:
    """The steps, of which all but the first `count` have no band."""
    steps = deepcopy(clean["steps"])
    for step in steps[count:]:
        step.pop("agreement")
    return steps


def test_agreement_needs_half_of_the_measured_steps(clean: Json) -> None:
    total = len(clean["steps"])
    few = judge_changed(clean, steps=without_agreement(clean, 1), verdict="aborted")
    assert few["verdict"] == "not judged"
    assert f"1 of {total} steps judged" in few["reason"]


def test_a_stopped_run_claims_what_was_measured(clean: Json) -> None:
    stopped = judge_changed(clean, steps=clean["steps"][:3], verdict="stopped")
    assert stopped["verdict"] == "agrees"
    assert stopped["reason"] == f"within the tolerance, 3 of {clean['planned_steps']} steps judged"
    assert "every jump in its place" in clean["twin_verdict"]["reason"]


def test_steps_without_noise_are_not_judged_as_a_history(clean: Json) -> None:
    comparison = {"rel_disp_m": {"nrmse": 0.01, "free_nrmse": 0.5, "noise_floor": None}}
    judged = judge_changed(clean, steps=without_agreement(clean, 0), comparison=comparison)
    assert (judged["verdict"], judged["worst"]) == ("not judged", None)
    assert "the noise of the sensors is unknown" in judged["reason"]


def test_a_spike_does_not_widen_the_travel() -> None:
    position = np.tile([-0.01, 0.03], 30)
    position[7] = 0.5
    step, label, cycle = np.zeros(60, int), np.zeros(60, int), np.repeat(np.arange(3), 20)
    values = position[np.newaxis]
    block = Block("meas", 0, 100.0, ("table_disp_m",), values, step, label, cycle)
    counts: dict[int, np.ndarray] = {}
    ranges: dict[int, dict[int, tuple[float, float]]] = {}
    right = np.arange(60) < 15
    _add_cycles(counts, ranges, block, (right, ~right))
    assert counts[0].tolist() == [60, 15, 45]
    assert sorted(ranges[0]) == [0, 1, 2]
    assert _median_half_range(ranges[0]) == pytest.approx(0.02)


def test_the_next_command_quotes_the_folder(clean: Json) -> None:
    command = name_command(TwinVerdict.model_validate(clean["twin_verdict"]), Path("my runs/first"))
    assert command == "shaketwin view 'my runs/first'"
