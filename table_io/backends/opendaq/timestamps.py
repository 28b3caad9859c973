"""Checks of time stamps: all signals on one even clock, at the sample rate of the test."""

from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

from table_io.backends.opendaq.assembly import MAX_STAMP_ERROR_SAMPLES
from table_io.errors import InputError


@dataclass(frozen=True)
class TickClock:
    """Scale of the time stamps: origin, ticks per sample, seconds per tick."""

    origin: str
    ticks_per_sample: float
    seconds: float  # per tick

    def format_tick(self, tick: int) -> str:
        """Format a time stamp as ISO 8601, or as seconds after a non-standard origin."""
        seconds = tick * self.seconds
        try:
            origin = datetime.fromisoformat(self.origin.replace("Z", "+00:00"))
            return (origin + timedelta(seconds=seconds)).isoformat()
        except (ValueError, OverflowError):
            return f"{seconds:.6f} s after {self.origin or 'its start'}"


def require_common_clock(daq: Any, signals: list[Any], rate_hz: float, device: str) -> TickClock:
    """Return the clock that all signals share; InputError if uneven or at another rate."""
    clocks = set()
    for signal in signals:
        stamp = signal.domain_signal.descriptor
        rule, tick = stamp.rule, stamp.tick_resolution
        if rule.type != daq.DataRuleType.Linear or tick is None:
            raise InputError(
                "not sampled evenly",
                where=f"signal {signal.global_id}",
                remedy="set a sample rate in the device",
            )
        delta = float(rule.parameters["delta"])
        seconds = int(tick.numerator) / int(tick.denominator)
        if abs(delta * seconds * rate_hz - 1.0) > 1e-6:
            raise InputError(
                f"signal {signal.global_id} is sampled at {1.0 / (delta * seconds):g} Hz",
                key="acquisition.rate_hz",
                value=rate_hz,
                remedy="set both to the same sample rate",
            )
        domain = stamp.reference_domain_info
        source = str(domain.reference_domain_id) if domain is not None else ""
        clocks.add((str(stamp.origin), source, delta, seconds))
    if len(clocks) > 1:
        raise InputError(
            "the signals do not share one clock",
            where=device,
            remedy="use channels on one clock only",
        )
    origin, _, delta, seconds = clocks.pop()
    return TickClock(origin, delta, seconds)


def require_simultaneous(newest: dict[str, int], ticks_per_sample: float, device: str) -> None:
    """Raise InputError if two channels are not sampled at the same instants."""
    names = list(newest)
    for name in names[1:]:
        offset = (newest[name] - newest[names[0]]) / ticks_per_sample
        misalignment = abs(offset - round(offset))
        if misalignment > MAX_STAMP_ERROR_SAMPLES:
            raise InputError(
                f"sampled {misalignment:.2f} samples apart from {names[0]}",
                where=device,
                key=name,
                remedy="start all its channels together, on one clock",
            )
