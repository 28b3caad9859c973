"""Fault injection into the simulated table; each kind is a transformation at sample indices.

dropped, nan        samples are lost: NaN, in all channels or in one
repeated            the preceding samples are delivered again instead of these, in all channels
replayed            the output plays the preceding command again instead of this one
late, stall         samples arrive after their schedule, or never; their values are unchanged
stuck               the channel keeps the preceding sample
cable_off           0 V and the noise of the converter
gain, polarity      volts times 1 + size, or times -1
rail                full scale
drift               offset that grows from 0 by size per second
spike               one sample deviates by size
power_loss          the valves shut: the table stops where it is, whatever the command
oil_loss            the bandwidth of the servo falls to a fraction `size`

Results do not depend on the division of reads: faults keep the earlier samples that they need.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from table_io.block import Float1D, Float2D
from table_io.config.rig import RigConfig
from table_io.config.sensor import SensorConfig
from table_io.sim.config import InjectedFault

VALVE_CLOSING_S = 0.05  # duration of valve closing
OIL_LOSS_S = 2.0  # duration of the pressure drop
OIL_LOSS_STEP_S = 0.01  # interval of constant bandwidth during the drop
# rms of a converter with open input, of full scale: -100 dB, as 24-bit data loggers reach.
CONVERTER_NOISE_RATIO = 1e-5
NO_END = 2**62


@dataclass(frozen=True, slots=True)
class FaultSpan:
    """Fault from sample `first` up to, not including, `last`; `row` of its channel or -1."""

    kind: str
    first: int
    last: int
    row: int
    size: float

    def overlap(self, first: int, last: int) -> slice:
        """Return the slice of samples first .. last - 1 that the fault affects."""
        return slice(max(self.first - first, 0), max(min(self.last, last) - first, 0))


@dataclass(slots=True)
class FaultMemory:
    """State of a fault: its random generator and the value to keep when stuck."""

    noise: np.random.Generator
    value: float = math.nan


ChannelFault = Callable[[FaultSpan, Float1D, Float1D, SensorConfig, FaultMemory], Float1D]
"""(fault, volts, seconds since it began, sensor, memory) -> volts, (sample,)."""


def _disconnect_cable(
    fault: FaultSpan, volts: Float1D, _: Float1D, sensor: SensorConfig, memory: FaultMemory
) -> Float1D:
    noise = memory.noise.standard_normal(volts.size)
    return CONVERTER_NOISE_RATIO * abs(sensor.range * sensor.volts_per_unit) * noise


def _saturate_channel(
    fault: FaultSpan, volts: Float1D, _: Float1D, sensor: SensorConfig, memory: FaultMemory
) -> Float1D:
    return np.full_like(volts, abs(sensor.range * sensor.volts_per_unit))


def _freeze_channel(
    fault: FaultSpan, volts: Float1D, _: Float1D, sensor: SensorConfig, memory: FaultMemory
) -> Float1D:
    if math.isnan(memory.value):
        memory.value = float(volts[0])  # the fault starts at the first sample of the run
    return np.full_like(volts, memory.value)


CHANNEL_FAULTS: dict[str, ChannelFault] = {
    "stuck": _freeze_channel,
    "cable_off": _disconnect_cable,
    "rail": _saturate_channel,
    "gain": lambda fault, volts, _, sensor, memory: volts * (1.0 + fault.size),
    "polarity": lambda fault, volts, _, sensor, memory: -volts,
    "drift": lambda fault, volts, t, sensor, memory: volts + fault.size * t * sensor.volts_per_unit,
    "spike": lambda fault, volts, _, sensor, memory: volts + fault.size * sensor.volts_per_unit,
    "nan": lambda fault, volts, _, sensor, memory: np.full_like(volts, math.nan),
}


@dataclass(slots=True)
class FaultInjector:
    """Fault injector: all faults of a table and their state; samples must come in order."""

    rate_hz: float
    sensors: tuple[SensorConfig, ...]
    faults: tuple[FaultSpan, ...]
    memories: tuple[FaultMemory, ...]
    history_samples: int  # earlier samples that a repetition needs
    _recent_volts: Float2D = field(repr=False)  # the last `history_samples` samples as delivered
    _shut_command: dict[int, float] = field(default_factory=dict)  # command while the valves shut

    def apply_to_output(self, first: int, command: Float1D) -> Float1D:
        """Return the command from sample `first` on as the converter plays it, (sample,).

        `command` must start `history_samples` early.
        """
        for fault in self._select("replayed"):
            span, last = fault.last - fault.first, first + command.size
            command = command.copy()
            for i in range(max(fault.first, first + span), min(fault.last, last)):
                command[i - first] = command[i - first - span]
        return command

    def apply_to_servo(self, first: int, command: Float1D) -> Float1D:
        """Return the command from sample `first` on as the servo receives it, (sample,)."""
        for fault in self._select("power_loss"):
            closing = VALVE_CLOSING_S * self.rate_hz
            end = fault.first + math.ceil(closing)
            for i in range(max(first, fault.first), min(first + command.size, end)):
                self._shut_command.setdefault(i, float(command[i - first]))
            since = first + np.arange(command.size) - fault.first
            after = since >= 0
            # The time base of the command decelerates to a stop, t - t^2 / 2, so motion is smooth.
            fraction = np.minimum(since[after] / closing, 1.0)
            played_at = fault.first + closing * (fraction - 0.5 * fraction**2)
            if played_at.size:
                known = np.array(sorted(self._shut_command))
                command = command.copy()
                command[after] = np.interp(
                    played_at, known, [self._shut_command[i] for i in known.tolist()]
                )
        return command

    def bandwidth_shares(self, first: int, count: int) -> Iterator[tuple[int, float]]:
        """Yield (samples, fraction of the servo's bandwidth) over the next `count` samples."""
        falling = self._select("oil_loss")
        step, done = math.ceil(OIL_LOSS_STEP_S * self.rate_hz), 0
        while done < count:
            remaining, share = count - done, 1.0
            for fault in falling:
                since = first + done - fault.first
                fall_samples = OIL_LOSS_S * self.rate_hz
                if since < 0:
                    remaining = min(remaining, -since)
                elif since < fall_samples:
                    remaining = min(remaining, step - since % step)
                fraction = min(max(since // step * step / fall_samples, 0.0), 1.0)
                share *= 1.0 - (1.0 - fault.size) * fraction
            yield remaining, share
            done += remaining

    def lateness_s(self, first: int, last: int) -> float:
        """Return the delay of samples first .. last - 1 after their schedule, in s; inf: never."""
        delays = [fault.size for fault in self._select("late") if first <= fault.first < last]
        stalls = [math.inf for fault in self._select("stall") if fault.first < last]
        return max([0.0, *delays, *stalls])

    def apply_to_inputs(self, first: int, volts: Float2D) -> Float2D:
        """Return volts of the samples from `first` on as delivered, (channel, sample)."""
        if not (self.faults and volts.size):
            return volts
        last = first + volts.shape[1]
        volts = volts.copy()
        for fault, memory in zip(self.faults, self.memories, strict=True):
            span = fault.overlap(first, last)
            if fault.kind in CHANNEL_FAULTS and span.start < span.stop:
                sensor, row = self.sensors[fault.row], volts[fault.row]
                if span.start and first + span.start == fault.first:
                    memory.value = float(row[span.start - 1])
                since = (first + np.arange(span.start, span.stop) - fault.first) / self.rate_hz
                row[span] = CHANNEL_FAULTS[fault.kind](fault, row[span], since, sensor, memory)
            elif fault.last > last and fault.row >= 0:
                memory.value = float(volts[fault.row, -1])
        full = np.array([[abs(s.range * s.volts_per_unit)] for s in self.sensors])
        return self._apply_drops(first, self._apply_repetitions(first, np.clip(volts, -full, full)))

    def _apply_repetitions(self, first: int, volts: Float2D) -> Float2D:
        """Replace repeated samples by earlier ones and keep the newest samples."""
        known = np.concatenate([self._recent_volts, volts], axis=1)
        ahead = self._recent_volts.shape[1]
        self._recent_volts = known[:, known.shape[1] - self.history_samples :]
        for fault in self._select("repeated"):
            span = fault.overlap(first, first + volts.shape[1])
            if span.start < span.stop:
                back = ahead - (fault.last - fault.first)
                volts[:, span] = known[:, span.start + back : span.stop + back]
        return volts

    def _apply_drops(self, first: int, volts: Float2D) -> Float2D:
        for fault in self._select("dropped"):
            volts[:, fault.overlap(first, first + volts.shape[1])] = math.nan
        return volts

    def _select(self, kind: str) -> list[FaultSpan]:
        return [fault for fault in self.faults if fault.kind == kind]


def build_faults(
    configs: tuple[InjectedFault, ...], rig: RigConfig, rate_hz: float, seed: int
) -> FaultInjector:
    """Build the fault injector of a simulated table at a sampling rate."""
    faults = []
    for config in configs:
        first = round(config.at_s * rate_hz)
        count = 1 if config.kind == "spike" else NO_END
        if config.for_s is not None:
            count = max(round(config.for_s * rate_hz), 1)
        row = rig.channels.index(config.channel) if config.channel is not None else -1
        faults.append(FaultSpan(config.kind, first, first + count, row, config.size or 0.0))
    spans = [fault.last - fault.first for fault in faults if fault.kind in ("repeated", "replayed")]
    history_samples = max(spans, default=0)
    return FaultInjector(
        rate_hz,
        rig.sensors,
        tuple(faults),
        tuple(FaultMemory(np.random.default_rng([seed, 2, k])) for k in range(len(faults))),
        history_samples,
        np.full((len(rig.sensors), history_samples), math.nan),
    )
