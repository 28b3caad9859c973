"""Measured orbits of a continuation in summary and report, beside those of the plan."""

import io
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from table_io.config.base import parse_toml
from table_io.config.excitation.continuation import OrbitPlan, PlannedOrbit
from table_io.config.profile import Profile
from table_io.records import OrbitPoint, RunStart, RunStop, Step
from tests.model.reference import snm
from tests.reports.recordings import start_record
from twin.monitor.panels import draw_prc
from twin.monitor.run_state import LiveRunState
from twin.monitor.run_view import RunView, SessionStatus
from twin.recording.mcap_log import write_items
from twin.recording.reader import read_recording
from twin.report.report import write_report
from twin.results.contracts import OrbitResult, PlannedOrbitEntry
from twin.results.orbits import find_measured_folds, read_planned_branch
from twin.results.summary import parse_toml_tables, summarise
from twin.system.progress import RunProgress
from twin.transport.codec import decode_item, encode_item, topic_for
from twin.viewer.plots import FrequencyCurves

AMPLITUDE_M = 2e-3
PROFILE = """
title = "Three orbits"
[specimen]
mass_kg = 550.0
gap_mm = 4.0
[excitation]
kind = "continuation"
start_hz = 3.0
stop_hz = 3.4
file = "plan.json"
[excitation.files]
"plan.json" = '''
{plan}'''
"""


def make_plan() -> OrbitPlan:
    zeros = ((0.0,) * 3,) * 3
    orbits = [
        PlannedOrbit(
            frequency_hz=3.0 + 0.1 * k, acceleration_m_s2=0.49, stable=k == 0, multiplier=3.0 + k,
            u_m=((1e-4, 0.0), (0.0, AMPLITUDE_M * (1 + k))), jacobian=zeros, gain=0.8,
            rate_gain_s=0.01,
        )
        for k in range(3)
    ]  # fmt: skip
    return OrbitPlan(harmonics=1, latency_s=0.045, points=tuple(orbits))


def make_point(step: int, reason: str = "") -> OrbitPoint:
    """Return an orbit; only that of step 1 has a measured multiplier."""
    multiplier, sd = (4.123, 0.07) if step == 1 else (np.nan, None)
    return OrbitPoint(
        1000 * (step + 1), step, 3.01 + 0.1 * step, 0.491, 2.1e-3 * (1 + step),
        (1e-4, 0.0, 3e-4, 4e-4, 0.0, 0.0), (0.0, 3e-6, 4e-6), 1e-6, 1e-3, 50, 1, step == 0,
        multiplier, not reason, reason, sd,
    )  # fmt: skip


def make_start(profile_toml: str) -> RunStart:
    """Return the start of a recording of three planned orbits."""
    steps = tuple(Step(k, "forward", 3.0 + 0.1 * k, 0.49) for k in range(3))
    return replace(start_record(), steps=steps, profile_toml=profile_toml)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("orbits")
    start = make_start(PROFILE.format(plan=make_plan().to_json()))
    points = [make_point(0), make_point(1), make_point(2, "the feedback is 0.5 % of the command")]
    write_items(path / "run.mcap", [start, *points, RunStop(4000, "complete", "", ())], start)
    summary = summarise(read_recording(path / "run.mcap"), snm())
    summary.write(path / "summary.json")
    return path, summary


def test_summary_has_each_orbit_with_its_feedback(folder):
    orbits = folder[1].orbits
    assert [orbit.index for orbit in orbits] == [0, 1, 2]
    assert [orbit.accepted for orbit in orbits] == [True, True, False]
    assert orbits[1].feedback_m == pytest.approx(5e-6)
    assert orbits[1].feedback_share == pytest.approx(5e-3)
    assert orbits[1].fundamental_m == pytest.approx(5e-4)
    assert orbits[2].planned.amplitude_m == pytest.approx(3 * AMPLITUDE_M, rel=1e-4)
    assert orbits[2].planned.multiplier == 5.0
    assert np.array_equal(
        [orbit.multiplier for orbit in orbits], [np.nan, 4.123, np.nan], equal_nan=True
    )
    assert [orbit.multiplier_sd for orbit in orbits] == [None, 0.07, None]


def test_progress_tells_measured_and_planned_orbits():
    shown = io.StringIO()
    show = RunProgress(Console(file=shown, width=200), 70, 100)
    for point in (make_point(0), make_point(1, "the feedback is 0.5 % of the command")):
        show(point)
    first, second = shown.getvalue().splitlines()
    assert first.startswith("  1/70   orbit 0: +-2.1 mm at 3.01 Hz")
    assert second.startswith("  1/70   orbit 1")
    assert second.endswith("not accepted: the feedback is 0.5 % of the command")


def test_uncertainty_of_a_multiplier_survives_the_wire():
    point = make_point(0)
    decoded = decode_item(topic_for(point), encode_item(point, "r"))[1]
    assert isinstance(decoded, OrbitPoint)
    assert decoded.multiplier_sd is None
    assert decode_item(topic_for(point), encode_item(make_point(1), "r"))[1] == make_point(1)


def test_planned_branch_is_read_from_the_recorded_profile():
    branch = read_planned_branch(parse_toml_tables(PROFILE.format(plan=make_plan().to_json())))
    assert branch is not None
    assert branch.frequencies_hz == pytest.approx([3.0, 3.1, 3.2])
    assert branch.stable.tolist() == [True, False, False]
    assert read_planned_branch({"sweep": {}}) is None


def test_report_shows_branch_and_table(folder):
    path = write_report(folder[0])
    text = path.read_text(encoding="utf-8")
    assert '<figure id="orbits">' in text
    assert "3.1100" in text
    assert "4.12 ± 0.07" in text
    assert "2 of 3 orbits measured, 1 of them unstable" in text


def test_report_of_a_backbone_shows_the_phase(tmp_path):
    plan = make_plan().model_copy(update={"condition": "phase"})
    profile = PROFILE.format(plan=plan.to_json()).replace('"continuation"', '"backbone"')
    start = make_start(profile)
    points = [make_point(0), make_point(1), make_point(2)]
    write_items(tmp_path / "run.mcap", [start, *points, RunStop(4000, "complete", "", ())], start)
    summary: Any = summarise(read_recording(tmp_path / "run.mcap"), snm())
    summary.write(tmp_path / "summary.json")
    assert summary.orbits[0].phase_deg == pytest.approx(90.0 + np.degrees(np.arctan2(4, 3)))
    branch = read_planned_branch(parse_toml_tables(profile))
    assert branch is not None
    assert branch.is_backbone
    text = write_report(tmp_path).read_text(encoding="utf-8")
    assert "3 of 3 points of the backbone measured" in text
    assert "Measured backbone" in text
    assert "<dt>Backbone</dt>" in text


def test_view_draws_accepted_orbits_over_the_planned_ones():
    curves = FrequencyCurves(0.0, 1.0, make_plan())
    assert curves.get_curves("measured") == []
    for step in (1, 0, 2):
        curves.add(make_point(step, "not on the branch" if step == 2 else ""))
    (_, measured), (_, planned) = *curves.get_curves("measured"), *curves.get_curves("twin")
    assert measured == pytest.approx(np.array([[3.01, 2.1], [3.11, 4.2]]))
    assert planned[:, 1] == pytest.approx([2.0, 4.0, 6.0], rel=1e-4)
    assert curves.axes.y[1] >= 6.0


def test_monitor_draws_orbits_in_place_of_the_curves():
    start = replace(start_record(), profile_toml=PROFILE.format(plan=make_plan().to_json()))
    run_state = LiveRunState(run=start.run)
    run_state.profile = parse_toml(start.profile_toml, Profile, "profile")
    run_state.orbits[1] = make_point(1)
    text = "\n".join(line.plain for line in draw_prc(RunView(run_state, SessionStatus()), 60, 12))
    assert text.count("●") == 1
    assert "3.2" in text


def make_branch() -> list[OrbitResult]:
    """Orbits on f = 3 + 0.2 (A - 5)^2 below 6 mm and f = 3.4 - 0.1 (A - 7)^2 above."""
    amplitudes = np.arange(4.45, 7.6, 0.1)
    frequencies = np.where(
        amplitudes < 6.0, 3.0 + 0.2 * (amplitudes - 5) ** 2, 3.4 - 0.1 * (amplitudes - 7) ** 2
    )
    orbit = OrbitResult(
        index=0, frequency_hz=3.0, acceleration_m_s2=0.5, amplitude_m=1e-3, fundamental_m=1e-3,
        phase_deg=90.0, feedback_m=0.0, feedback_share=0.0, feedback_harmonics_m=[], noise_m=0.0,
        periods=10, updates=1, accepted=True, reason="", stable=True, multiplier=1.0,
        multiplier_sd=None,
        planned=PlannedOrbitEntry(frequency_hz=3.0, amplitude_m=1e-3, multiplier=1.0),
    )  # fmt: skip
    return [
        orbit.model_copy(
            update={
                "stable": not 5.0 < amplitude < 7.0,
                "amplitude_m": 1e-3 * amplitude,
                "frequency_hz": frequency,
            }
        )
        for amplitude, frequency in zip(amplitudes, frequencies, strict=True)
    ]


def test_folds_are_where_the_measured_branch_turns():
    lower, upper = find_measured_folds(make_branch())
    assert (lower.kind, upper.kind, lower.orbits) == ("lower", "upper", 4)
    assert lower.frequency_hz == pytest.approx(3.0, abs=1e-6)
    assert upper.frequency_hz == pytest.approx(3.4, abs=1e-6)
    assert upper.amplitude_m == pytest.approx(7e-3, rel=1e-6)


def test_no_fold_is_stated_where_too_little_was_measured():
    branch = make_branch()
    unstable = [orbit for orbit in branch if not orbit.stable]
    assert find_measured_folds(unstable) == []
    assert find_measured_folds([unstable[-1], *branch[-1:]]) == []
    refused = [
        orbit.model_copy(update={"accepted": orbit.amplitude_m < 5.2e-3}) for orbit in branch
    ]
    assert [fold.kind for fold in find_measured_folds(refused)] == ["lower"]


def test_no_fold_is_stated_far_from_the_measured_orbits():
    sparse = make_branch()[1::9]
    assert {orbit.stable for orbit in sparse} == {True, False}
    assert find_measured_folds(sparse) == []


def test_a_branch_that_does_not_turn_where_the_plan_says_has_no_fold_there():
    branch = [
        orbit.model_copy(update={"stable": orbit.amplitude_m < 5.7e-3}) for orbit in make_branch()
    ]
    assert find_measured_folds(branch) == []
