"""A record as one sentence for people: the same words on a terminal, in a view and in a report."""

import math

from table_io.block import Label
from table_io.records import (
    Check,
    Decided,
    Event,
    Fault,
    Gap,
    Level,
    Params,
    Record,
    Response,
    RunStop,
    Trip,
)
from table_io.units import GRAVITY_M_S2

DOING = {
    Label.REST: "at rest",
    Label.BLEND: "blending",
    Label.SETTLE: "settling",
    Label.MEASURE: "measuring",
    Label.STOP: "decaying to rest",
    Label.CHECK: "loop check",
}
LEVELS = {
    "ERROR": {"fault", "halted", "error", "died"},
    "WARN": {
        "warning", "calibration", "alarm", "divergence", "late", "stop", "stopped", "sensor",
        "disagreement", "drift", "no jump", "unexpected jump", "attractor", "instrument", "refused",
    },
}  # fmt: skip


def printable(text: str) -> str:
    """The text without what would command a terminal: what comes from elsewhere may hold it."""
    return "".join(one if one.isprintable() else "?" for one in text)


def sentence(record: Record, rate_hz: float) -> tuple[str, str] | None:
    """(INFO, WARN or ERROR, text) of a record, None for one that is data and no message."""
    match record:
        case Event(kind=kind, text=text):
            level = next((one for one, kinds in LEVELS.items() if kind in kinds), "INFO")
            return level, f"{kind}: {text}"
        case Gap(count=count, channel=channel, reason=reason):
            return "WARN", f"gap: {count} samples of {channel or 'all channels'} {reason}"
        case Fault(component=component, from_index=first, to_index=last, reason=reason):
            span = f"{first / rate_hz:.3f} s to {last / rate_hz:.3f} s"
            return "ERROR", f"{component} failed, nothing from {span}: {reason}"
        case Params(reason=reason):
            return "INFO", f"parameters of the twin: {reason}"
        case Trip(kind=kind, text=text):
            return "ERROR", f"protection ({kind}): {text}"
        case Check():
            return ("INFO" if record.passed else "ERROR"), _check(record)
        case Response(frequencies_hz=frequencies, gain=gain):
            points = ", ".join(
                f"{g:.3f} at {f:g} Hz" for f, g in zip(frequencies, gain, strict=True)
            )
            return "INFO", f"response of the table, acceleration over command: {points}"
        case Level():
            return ("INFO" if record.accepted else "WARN"), _level(record)
        case Decided(frequency_hz=frequency, reason=reason):
            return "INFO", f"next step {frequency:g} Hz: {reason}"
        case RunStop(verdict=verdict, reason=reason):
            return ("INFO" if verdict == "complete" else "WARN"), f"{verdict}: {reason}"
    return None


def _check(check: Check) -> str:
    how = "pass" if check.passed else "FAIL"
    value = f"{check.value:.4g} {check.unit}".rstrip()
    limited = math.isfinite(check.low) or math.isfinite(check.high)
    allowed = f" (allowed {check.low:.4g} to {check.high:.4g})" if limited else ""
    return f"check {how}: {check.name}, {check.channel}: {value}{allowed}"


def _level(level: Level) -> str:
    return (
        f"level at step {level.step}: {level.measured_m_s2 / GRAVITY_M_S2:.4f} g, demanded "
        f"{level.demanded_m_s2 / GRAVITY_M_S2:.4f} g, command x {level.correction:.4f} "
        f"after {level.update} updates"
    )
