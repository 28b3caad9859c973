"""A line of the wiring check."""

from dataclasses import dataclass
from typing import Literal

Verdict = Literal["pass", "fail", "not tested"]


@dataclass(frozen=True, slots=True)
class Line:
    """`value` has to lie in low .. high, in `unit`; `do` says what to do where it does not.

    A line that was not tested says in `do` why, and what would test it.
    """

    name: str
    channel: str
    value: float
    low: float
    high: float
    unit: str
    verdict: Verdict
    do: str = ""


def judged(
    name: str, channel: str, value: float, allowed: tuple[float, float], unit: str, do: str
) -> Line:
    """A line that passes or fails; NaN fails."""
    low, high = map(float, allowed)
    passed = low <= float(value) <= high
    return Line(name, channel, float(value), low, high, unit, "pass" if passed else "fail",
                "" if passed else do)  # fmt: skip


def untested(name: str, channel: str, why: str) -> Line:
    """A line that could not be judged."""
    nan = float("nan")
    return Line(name, channel, nan, nan, nan, "", "not tested", why)
