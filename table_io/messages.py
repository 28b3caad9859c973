"""One-line text of a record, identical on the terminal, in the viewer and in the report."""

import math

from table_io.block import Label
from table_io.records import (
    Check,
    Event,
    Fault,
    FrequencyResponse,
    Level,
    OrbitPoint,
    Params,
    Record,
    RunStop,
    SampleGap,
    StepAdded,
    Trip,
)
from table_io.units import GRAVITY_M_S2

LABEL_TEXTS = {
    Label.REST: "at rest",
    Label.BLEND: "blending",
    Label.SETTLE: "settling",
    Label.MEASURE: "measuring",
    Label.STOP: "decaying to rest",
    Label.CHECK: "loop check",
}
SEVERITY_KINDS = {
    "ERROR": {"fault", "halted", "error", "died"},
    "WARN": {
        "warning", "calibration", "alarm", "divergence", "late", "stop", "stopped", "sensor",
        "disagreement", "drift", "no jump", "unexpected jump", "attractor", "instrument", "refused",
        "law_range",
    },
}  # fmt: skip


def format_record(record: Record, rate_hz: float) -> tuple[str, str] | None:
    """Return (INFO, WARN or ERROR, text) of a record, or None for a record that is only data."""
    match record:
        case Event(kind=kind, text=text):
            level = next(
                (severity for severity, kinds in SEVERITY_KINDS.items() if kind in kinds), "INFO"
            )
            return level, f"{format_kind(kind)}: {text}"
        case SampleGap(count=count, channel=channel, reason=reason):
            return "WARN", f"dropout: {count} samples of {channel or 'all channels'} {reason}"
        case Fault(component=component, from_index=first, to_index=last, reason=reason):
            span = f"{first / rate_hz:.3f} s to {last / rate_hz:.3f} s"
            return "ERROR", f"{component} failed, no output from {span}: {reason}"
        case Params(reason=reason):
            return "INFO", f"twin parameters: {reason}"
        case Trip(kind=kind, text=text):
            return "ERROR", f"protection ({kind}): {text}"
        case Check():
            return ("INFO" if record.passed else "ERROR"), _format_check(record)
        case FrequencyResponse(frequencies_hz=frequencies, gain=gain):
            points = ", ".join(
                f"{g:.3f} at {f:g} Hz" for f, g in zip(frequencies, gain, strict=True)
            )
            return "INFO", f"table FRF gain (acceleration / command): {points}"
        case Level():
            return ("INFO" if record.accepted else "WARN"), _format_level(record)
        case StepAdded(frequency_hz=frequency, reason=reason):
            return "INFO", f"next step at {frequency:g} Hz: {reason}"
        case OrbitPoint():
            return ("INFO" if record.accepted else "WARN"), _format_orbit(record)
        case RunStop(verdict=verdict, reason=reason):
            return ("INFO" if verdict == "complete" else "WARN"), f"{verdict}: {reason}"
    return None


def format_kind(kind: str) -> str:
    """Return the kind of an event in words."""
    return kind.replace("_", " ")


def _format_check(check: Check) -> str:
    how = "pass" if check.passed else "FAIL"
    value = f"{check.value:.4g} {check.unit}".rstrip()
    limited = math.isfinite(check.low) or math.isfinite(check.high)
    allowed = f" (allowed {check.low:.4g} to {check.high:.4g})" if limited else ""
    return f"check {how}: {check.name}, {check.channel}: {value}{allowed}"


def _format_level(level: Level) -> str:
    return (
        f"level at step {level.step}: {level.measured_m_s2 / GRAVITY_M_S2:.4f} g measured, "
        f"{level.demanded_m_s2 / GRAVITY_M_S2:.4f} g demanded; command multiplied by "
        f"{level.correction:.4f} after {level.update} updates"
    )


def _format_orbit(orbit: OrbitPoint) -> str:
    feedback = math.hypot(*orbit.feedback_m)
    share = 100 * feedback / orbit.command_m
    text = (
        f"orbit {orbit.step}: +-{1e3 * orbit.amplitude_m:.4g} mm at {orbit.frequency_hz:.5g} Hz; "
        f"feedback {1e6 * feedback:.2g} um, {share:.2g} % of the command; {orbit.periods} periods"
    )
    if orbit.multiplier_sd is not None:
        text += f"; multiplier {orbit.multiplier:.3g} +-{orbit.multiplier_sd:.1g}"
    return text if orbit.accepted else f"{text}; not accepted: {orbit.reason}"
