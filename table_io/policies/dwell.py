"""Dwell: stay where the sweep ends, on the branch that it came on, and measure again and again."""

import math

from table_io.policies.result import Decision, Result, Tool
from table_io.profile import Profile
from table_io.tool_cards import Dwell


def words(card: Dwell, profile: Profile) -> str:
    """The plan in words."""
    last = profile.sweep.steps[-1]
    return (
        f"stay at the last step, {last.frequency_hz:g} Hz {last.direction}, for "
        f"{_cycles(card, last.frequency_hz)} held cycles more, a result every "
        f"{profile.sweep.cycles}"
    )


def begin(card: Dwell, profile: Profile) -> Tool:
    """The tool; it asks for the last step of the sweep until it was held for long enough."""
    sweep, steps = profile.sweep, profile.sweep.steps[profile.first_step :]
    for _ in steps:
        first = yield None
    step, held, last = steps[-1], 0, first
    wanted = _cycles(card, step.frequency_hz)
    while held < wanted:
        why = f"dwell, {held} of {wanted} cycles held so far"
        last = yield Decision(step.frequency_hz, step.direction, why)
        held += sweep.cycles
    return (
        f"dwell at {step.frequency_hz:g} Hz {step.direction}: {held} cycles held in "
        f"{held // sweep.cycles} visits; swing of u from {_swing(first)} to {_swing(last)}"
    )


def _cycles(card: Dwell, frequency_hz: float) -> int:
    if card.cycles is not None:
        return card.cycles
    return math.ceil((card.seconds or 0.0) * frequency_hz - 1e-9)


def _swing(result: Result) -> str:
    return f"+-{1e3 * result.swing_m:.4g} mm at {result.level_g:.4f} g"
