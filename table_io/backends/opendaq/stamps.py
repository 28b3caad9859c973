"""The clock of a device's signals: one, even, and at the test's rate; or BadInput."""

from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

from table_io.backends.opendaq.assembly import OFF
from table_io.card import BadInput


@dataclass(frozen=True)
class Ticking:
    """How time stamps count."""

    origin: str
    per_sample: float  # ticks
    seconds: float  # a tick

    def said(self, tick: int) -> str:
        """A time stamp, as the device tells it."""
        seconds = tick * self.seconds
        try:
            origin = datetime.fromisoformat(self.origin.replace("Z", "+00:00"))
            return (origin + timedelta(seconds=seconds)).isoformat()
        except (ValueError, OverflowError):
            return f"{seconds:.6f} s after {self.origin or 'its start'}"


def one_clock(daq: Any, signals: list[Any], rate_hz: float, device: str) -> Ticking:
    """One even clock at the test's rate, for all signals; BadInput otherwise."""
    clocks = set()
    for signal in signals:
        stamp = signal.domain_signal.descriptor
        rule, tick = stamp.rule, stamp.tick_resolution
        if rule.type != daq.DataRuleType.Linear or tick is None:
            raise BadInput(f"signal {signal.global_id} is not sampled evenly; set a sample rate")
        delta = float(rule.parameters["delta"])
        seconds = int(tick.numerator) / int(tick.denominator)
        if abs(delta * seconds * rate_hz - 1.0) > 1e-6:
            raise BadInput(
                f"acquisition.rate_hz = {rate_hz:g}: signal {signal.global_id} is sampled "
                f"at {1.0 / (delta * seconds):g} Hz; set the device's rate, or the test's"
            )
        domain = stamp.reference_domain_info
        source = str(domain.reference_domain_id) if domain is not None else ""
        clocks.add((str(stamp.origin), source, delta, seconds))
    if len(clocks) > 1:
        raise BadInput(
            f"the signals of {device} do not share one clock; take all channels from devices on "
            "one clock"
        )
    origin, _, delta, seconds = clocks.pop()
    return Ticking(origin, delta, seconds)


def together(newest: dict[str, int], ticks_per_sample: float, device: str) -> None:
    """BadInput where samples of two channels lie between each other, by a time stamp of each."""
    names = list(newest)
    for name in names[1:]:
        apart = (newest[name] - newest[names[0]]) / ticks_per_sample
        beside = abs(apart - round(apart))
        if beside > OFF:
            raise BadInput(
                f"{name} is taken {beside:.2f} samples beside {names[0]}; start all channels of "
                f"{device} together, on one clock"
            )
