"""Check line: one result of the wiring check."""

from dataclasses import dataclass
from typing import Literal

LineVerdict = Literal["pass", "fail", "not tested"]


@dataclass(frozen=True, slots=True)
class CheckLine:
    """Result of one check: pass if low <= value <= high, in `unit`.

    `do` holds the remedy of a failed line, or the reason of one that was not tested.
    """

    name: str
    channel: str
    value: float
    low: float
    high: float
    unit: str
    verdict: LineVerdict
    do: str = ""


def check_value(
    name: str, channel: str, value: float, allowed: tuple[float, float], unit: str, remedy: str
) -> CheckLine:
    """Make a check line that passes or fails; NaN fails."""
    low, high = map(float, allowed)
    passed = low <= float(value) <= high
    return CheckLine(name, channel, float(value), low, high, unit, "pass" if passed else "fail",
                "" if passed else remedy)  # fmt: skip


def mark_untested(name: str, channel: str, reason: str) -> CheckLine:
    """Make a check line that was not tested for the given reason."""
    nan = float("nan")
    return CheckLine(name, channel, nan, nan, nan, "", "not tested", reason)
