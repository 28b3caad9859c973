"""Adaptive tests: policies that choose the next step from the results so far.

A policy is a pure function of the results so far. It returns the next step (a Decision), None to
continue the sweep as planned, or, when the test is over, a sentence with the result.

A policy is described in one sentence, and run by a generator that receives the results one by one.
Every evaluation replays the generator from its beginning, so the results are its only state.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from table_io.adaptive import jump_refinement, resonance_tracking
from table_io.adaptive.result import Decision, MissingMeasurement, PolicyGenerator, StepResult
from table_io.config.adaptive import DwellConfig
from table_io.config.profile import Profile


def describe_dwell(config: DwellConfig, profile: Profile) -> str:
    """Describe the planned dwell in one sentence."""
    last = profile.sweep.steps[-1]
    return (
        f"hold the last step, {last.frequency_hz:g} Hz {last.direction}, for "
        f"{_dwell_cycles(config, last.frequency_hz)} more held cycles, with a result every "
        f"{profile.sweep.cycles}"
    )


def run_dwell(config: DwellConfig, profile: Profile) -> PolicyGenerator:
    """Request the last step of the sweep until it was held long enough; return a summary."""
    sweep, steps = profile.sweep, profile.sweep.steps[profile.first_step :]
    for _ in steps:
        first = yield None
    step, held_cycles, last = steps[-1], 0, first
    target_cycles = _dwell_cycles(config, step.frequency_hz)
    while held_cycles < target_cycles:
        reason = f"dwell, {held_cycles} of {target_cycles} cycles held so far"
        last = yield Decision(step.frequency_hz, step.direction, reason)
        held_cycles += sweep.cycles
    return (
        f"dwell at {step.frequency_hz:g} Hz {step.direction}: {held_cycles} cycles held in "
        f"{held_cycles // sweep.cycles} visits; swing of u from "
        f"{_format_swing(first)} to {_format_swing(last)}"
    )


def _dwell_cycles(config: DwellConfig, frequency_hz: float) -> int:
    if config.cycles is not None:
        return config.cycles
    return math.ceil((config.seconds or 0.0) * frequency_hz - 1e-9)


def _format_swing(result: StepResult) -> str:
    return f"+-{1e3 * result.swing_m:.4g} mm at {result.level_g:.4f} g"


Policy = Callable[[tuple[StepResult, ...]], Decision | str | None]


class _PolicyPlan(NamedTuple):
    """Policy of a profile: name of its table, its description, and its generator."""

    name: str
    describe: Callable[[], str]
    run: Callable[[], PolicyGenerator]


def _find_policy(profile: Profile) -> _PolicyPlan | None:
    """Return the policy that a profile configures; None for a plain sweep."""
    if (dwell := profile.dwell) is not None:
        return _PolicyPlan(
            "dwell", partial(describe_dwell, dwell, profile), partial(run_dwell, dwell, profile)
        )
    if (track := profile.track) is not None:
        return _PolicyPlan(
            "track",
            partial(resonance_tracking.describe_policy, track, profile),
            partial(resonance_tracking.run_policy, track, profile),
        )
    if (refine := profile.refine) is not None:
        return _PolicyPlan(
            "refine",
            partial(jump_refinement.describe_policy, refine, profile),
            partial(jump_refinement.run_policy, refine, profile),
        )
    return None


def make_policy(profile: Profile) -> Policy | None:
    """Return the policy that a profile configures; None for a plain sweep."""
    plan = _find_policy(profile)
    return None if plan is None else partial(_replay_policy, plan.run)


def describe_adaptive_test(profile: Profile) -> str:
    """Describe the adaptive part of a test in one sentence; "" for a plain sweep."""
    plan = _find_policy(profile)
    return "" if plan is None else f"{plan.name}: {plan.describe()}"


def _replay_policy(
    run: Callable[[], PolicyGenerator], results: tuple[StepResult, ...]
) -> Decision | str | None:
    """Replay the generator of a policy on the results and return its last request."""
    generator = run()
    try:
        request = next(generator)
        for result in results:
            request = generator.send(result)
    except StopIteration as end:
        return str(end.value)
    except MissingMeasurement as error:
        return f"{error}; the test ends"
    return request
