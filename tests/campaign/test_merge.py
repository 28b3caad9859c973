"""Several recordings of a run as one: what is taken from which, and what became of its history."""

import math
from typing import Any

import pytest

from table_io.config.base import parse_toml
from table_io.config.profile import Profile
from twin.campaign.merge import find_most_impacts, find_peak, merge_summaries, renormalize
from twin.campaign.result import BranchPiece
from twin.campaign.state import RunPart, RunState, first_step, is_complete, missing_steps
from twin.results.contracts import (
    ExcitationVerdict,
    FaultEntry,
    Response,
    RunInfo,
    RunSummary,
    StepEntry,
)

PROFILE = parse_toml(
    """
title = "short"
[specimen]
mass_kg = 550.0
gap_mm = 4.0
[sweep]
start_hz = 1.0
stop_hz = 4.0
step_hz = 1.0
cycles = 4
""",
    Profile,
    "test",
)
STEPS = PROFILE.sweep.steps  # 0 to 3 forward, 4 to 7 backward


def part(number: int, first: int, last: int, verdict: str = "halted") -> RunPart:
    """Recording `number`, in which the steps first to last were measured."""
    measured = tuple(range(first, last + 1))
    return RunPart(
        folder=f"01-g4-{number}", run=f"run {number}", first_step=first, verdict=verdict,
        measured=measured,
    )  # fmt: skip


def summary(part: RunPart, eta: float = 0.5) -> RunSummary:
    """Summary of a recording, every eta_d as given."""

    def make_response(index: int) -> Response:
        return Response(
            eta_d=eta, eta_a=2 * eta, eta_r=0.1, eta_l=0.1, r_r=0.3, r_l=0.3,
            impacts_right=[1, 1, index], impacts_left=[1, 1, 1], drift=0.0, spread=0.0,
        )  # fmt: skip

    steps = [
        StepEntry(
            index=index,
            direction=STEPS[index].direction,
            frequency_hz=STEPS[index].frequency_hz,
            measured=make_response(index),
            twin=make_response(index),
            table_acc_peak_m_s2=0.49,
            table_acc_fundamental_m_s2=STEPS[index].acceleration_m_s2 * (1 + 0.001 * index),
        )
        for index in part.measured
    ]
    fault = FaultEntry(index=5, component="twin", from_index=1, to_index=5, reason="killed")
    return RunSummary(
        run=RunInfo(), verdict=part.verdict, u_star_m=0.03, a_star_m_s2=2.0, steps=steps, gaps=1,
        faults=[fault],
    )  # fmt: skip


def run(*parts: RunPart) -> RunState:
    done = parts[-1].verdict == "complete" if parts else False
    status = "complete" if done else "interrupted"
    return RunState(name="01-g4", label="g4", status=status, parts=parts)


def together(*parts: RunPart) -> Any:
    etas = [0.1 * (k + 1) for k in range(len(parts))]
    summaries = [summary(one_part, eta) for one_part, eta in zip(parts, etas, strict=True)]
    return merge_summaries(run(*parts), PROFILE, summaries)


@pytest.mark.parametrize(
    ("mode", "last", "first"),
    [
        ("direction", 5, 4), ("step", 5, 6), ("run", 5, 0),
        ("direction", 2, 0), ("step", 2, 3), ("direction", 3, 4), ("step", 3, 4),
    ],
)  # fmt: skip
def test_where_an_interrupted_run_goes_on(mode: Any, last: int, first: int) -> None:
    assert first_step(run(part(1, 0, last)), PROFILE, mode) == first


def test_a_run_interrupted_again_goes_on_after_all_that_was_measured() -> None:
    twice = run(part(1, 0, 5), part(2, 6, 6))
    assert first_step(twice, PROFILE, "step") == 7
    assert first_step(twice, PROFILE, "direction") == 4
    nothing = run(part(1, 0, 5), part(2, 4, 3))
    assert first_step(nothing, PROFILE, "direction") == 4


def test_a_run_is_complete_when_nothing_is_left_to_measure() -> None:
    assert not is_complete(run(), PROFILE)
    assert not is_complete(run(part(1, 0, 6)), PROFILE)
    assert is_complete(run(part(1, 0, 7)), PROFILE)  # killed in its soft stop
    assert is_complete(run(part(1, 0, 5), part(2, 4, 7, "complete")), PROFILE)
    assert missing_steps(run(part(1, 0, 2), part(2, 4, 7)), PROFILE) == [3]


def test_a_step_comes_from_the_last_recording_that_measured_it() -> None:
    merged = together(part(1, 0, 5), part(2, 4, 7, "complete"))
    assert [step.index for step in merged.steps] == list(range(8))
    assert [step.measured.eta_d for step in merged.steps] == [0.1] * 4 + [0.2] * 4
    assert merged.gaps == 2
    assert len(merged.faults) == 2


def test_a_branch_says_where_it_comes_from_and_what_became_of_its_history() -> None:
    whole = together(part(1, 0, 7, "complete"))
    assert [branch.history for branch in whole.branches] == ["whole", "whole"]
    anew = together(part(1, 0, 5), part(2, 4, 7, "complete")).branches
    assert [branch.history for branch in anew] == ["whole", "restarted from rest"]
    assert anew[1].pieces == [BranchPiece(part="01-g4-2", from_hz=4.0, to_hz=1.0)]
    broken = together(part(1, 0, 5), part(2, 6, 7, "complete")).branches
    assert [branch.history for branch in broken] == ["whole", "broken"]
    assert broken[1].broken_at_hz == [2.0]
    assert [piece.part for piece in broken[1].pieces] == ["01-g4-1", "01-g4-2"]
    lost = together(part(1, 0, 7), part(2, 0, 7, "complete")).branches
    assert {piece.part for branch in lost for piece in branch.pieces} == {"01-g4-2"}


def test_a_branch_of_which_only_the_end_is_left_is_broken_too() -> None:
    branches = together(part(1, 0, -1), part(2, 2, 7, "complete")).branches
    assert [(branch.history, branch.broken_at_hz) for branch in branches] == [
        ("broken", [3.0]),
        ("whole", []),
    ]


def test_merged_level_is_the_worst_of_all_steps() -> None:
    merged = together(part(1, 0, 5), part(2, 4, 7, "complete"))
    assert merged.level_error == pytest.approx(0.007)
    assert (merged.level_error_hz, merged.level_error_direction) == (1.0, "backward")
    excitation = merged.excitation_verdict
    assert (excitation.verdict, excitation.worst_error) == ("reached", merged.level_error)


def test_the_excitation_of_a_merged_run_is_that_of_all_its_parts() -> None:
    """Not that of the last one alone."""
    parts = part(1, 0, 5), part(2, 4, 7, "complete")
    first: Any = summary(parts[0])
    second = summary(parts[1])
    first.steps[1].table_acc_fundamental_m_s2 *= 1.3
    second.excitation_verdict = ExcitationVerdict(
        verdict="reached", reason="", outside=0, worst_error=0.0
    )
    merged: Any = merge_summaries(run(*parts), PROFILE, [first, second])
    assert merged.excitation_verdict.verdict == "missed"


def test_curves_are_divided_by_what_free_flight_gave() -> None:
    before = together(part(1, 0, 7, "complete"))
    after = renormalize(before, (0.06, 1.0))
    for who in ("measured", "twin"):
        scaled, given = (getattr(run.steps[0], who) for run in (after, before))
        for name, factor in (("eta_d", 0.5), ("eta_r", 0.5), ("eta_a", 2.0), ("r_r", 1.0)):
            assert getattr(scaled, name) == pytest.approx(factor * getattr(given, name)), name
        assert scaled.impacts_right == given.impacts_right
    assert (after.u_star_m, after.a_star_m_s2) == (0.06, 1.0)
    assert renormalize(before, None) == before


def test_what_is_not_known_stays_unknown() -> None:
    whole_part = part(1, 0, 7)
    values: Any = summary(whole_part)
    values.steps[2].measured = None
    values.steps[3].measured.eta_a = math.nan
    renormalized: Any = renormalize(
        merge_summaries(run(whole_part), PROFILE, [values]), (0.06, 1.0)
    )
    assert renormalized.steps[2].measured is None
    assert math.isnan(renormalized.steps[3].measured.eta_a)
    best = find_peak(renormalized, "measured", "eta_a")
    assert best is not None
    assert math.isfinite(best.value)
    impacts = find_most_impacts(renormalized)
    assert impacts is not None
    assert (impacts.frequency_hz, impacts.right) == (1.0, pytest.approx(3.0))


def test_merge_without_a_recording_takes_the_planned_level() -> None:
    merged = merge_summaries(RunState(name="01-g4", label="g4"), PROFILE, [])
    assert (merged.verdict, merged.steps, merged.planned_steps) == ("planned", [], 8)
