"""What goes wrong in the simulated machine, by kind; each a transformation at sample indices.

dropped, nan        samples are lost: NaN, in all channels or in one
repeated            the samples before come once more in the place of these, in all channels
replayed            the output plays the command before once more in the place of this one
late, stall         samples come after their schedule, or never; what they hold is unchanged
stuck               the channel stays at the sample before
cable_off           0 V and the converter's own noise
gain, polarity      volts times 1 + size, or times -1
rail                full scale
drift               grows from 0 by size a second
spike               one sample is off by size
power_loss          the valves shut: the table stops where it is, whatever is commanded
oil_loss            the servo's bandwidth falls to a share of it

Nothing here depends on how reads are cut. Where a fault needs samples from before, they are kept.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from table_io.block import Float1D, Float2D
from table_io.rig import PlantedFault, Rig
from table_io.sensor import Sensor

SHUT_S = 0.05  # in which the valves shut
OIL_S = 2.0  # in which the pressure falls
OIL_HOP_S = 0.01  # in which the bandwidth is taken as constant while it falls
# rms of a converter with its input open, of full scale: 100 dB, what 24-bit data loggers reach.
CONVERTER_NOISE = 1e-5
NEVER = 2**62


@dataclass(frozen=True, slots=True)
class Planted:
    """A fault in samples: from `first` up to, not including, `last`; `row` of its channel or -1."""

    kind: str
    first: int
    last: int
    row: int
    size: float

    def overlap(self, first: int, last: int) -> slice:
        """The part of samples first .. last - 1 in which it is there."""
        return slice(max(self.first - first, 0), max(min(self.last, last) - first, 0))


@dataclass(slots=True)
class Memory:
    """What a fault keeps from before: a stuck value, and its own noise."""

    noise: np.random.Generator
    value: float = math.nan


Change = Callable[[Planted, Float1D, Float1D, Sensor, Memory], Float1D]
"""(fault, volts, seconds since it began, sensor, memory) -> volts, (sample,)."""


def _open_input(one: Planted, volts: Float1D, _: Float1D, sensor: Sensor, kept: Memory) -> Float1D:
    noise = kept.noise.standard_normal(volts.size)
    return CONVERTER_NOISE * abs(sensor.range * sensor.volts_per_unit) * noise


def _rail(one: Planted, volts: Float1D, _: Float1D, sensor: Sensor, kept: Memory) -> Float1D:
    return np.full_like(volts, abs(sensor.range * sensor.volts_per_unit))


def _stuck(one: Planted, volts: Float1D, _: Float1D, sensor: Sensor, kept: Memory) -> Float1D:
    if math.isnan(kept.value):
        kept.value = float(volts[0])  # at the very first sample of a run
    return np.full_like(volts, kept.value)


CHANGES: dict[str, Change] = {
    "stuck": _stuck,
    "cable_off": _open_input,
    "rail": _rail,
    "gain": lambda one, volts, _, sensor, kept: volts * (1.0 + one.size),
    "polarity": lambda one, volts, _, sensor, kept: -volts,
    "drift": lambda one, volts, t, sensor, kept: volts + one.size * t * sensor.volts_per_unit,
    "spike": lambda one, volts, _, sensor, kept: volts + one.size * sensor.volts_per_unit,
    "nan": lambda one, volts, _, sensor, kept: np.full_like(volts, math.nan),
}


@dataclass(slots=True)
class Faults:
    """All faults of a machine, and what they keep; samples must come in order."""

    rate_hz: float
    sensors: tuple[Sensor, ...]
    planted: tuple[Planted, ...]
    memory: tuple[Memory, ...]
    reach: int  # samples from before that a repetition needs
    _volts: Float2D = field(repr=False)  # the last `reach` samples as they came
    _shut: dict[int, float] = field(default_factory=dict)  # command while the valves shut

    def output(self, first: int, command: Float1D) -> Float1D:
        """Command from sample `first` on as the converter plays it, (sample,); needs `reach`."""
        for one in self._of("replayed"):
            span, last = one.last - one.first, first + command.size
            command = command.copy()
            for i in range(max(one.first, first + span), min(one.last, last)):
                command[i - first] = command[i - first - span]
        return command

    def servo(self, first: int, command: Float1D) -> Float1D:
        """Command from sample `first` on as the servo follows it, (sample,)."""
        for one in self._of("power_loss"):
            shut = SHUT_S * self.rate_hz
            end = one.first + math.ceil(shut)
            for i in range(max(first, one.first), min(first + command.size, end)):
                self._shut.setdefault(i, float(command[i - first]))
            since = first + np.arange(command.size) - one.first
            late = since >= 0
            # Time itself comes to a stop: t - t^2 / 2, up to half of the time to shut.
            part = np.minimum(since[late] / shut, 1.0)
            at = one.first + shut * (part - 0.5 * part**2)
            if at.size:
                known = np.array(sorted(self._shut))
                command = command.copy()
                command[late] = np.interp(at, known, [self._shut[i] for i in known.tolist()])
        return command

    def bandwidth(self, first: int, count: int) -> Iterator[tuple[int, float]]:
        """(samples, share of the servo's bandwidth) one after another over the next `count`."""
        falling = self._of("oil_loss")
        hop, done = math.ceil(OIL_HOP_S * self.rate_hz), 0
        while done < count:
            left, share = count - done, 1.0
            for one in falling:
                since = first + done - one.first
                fallen = OIL_S * self.rate_hz
                if since < 0:
                    left = min(left, -since)
                elif since < fallen:
                    left = min(left, hop - since % hop)
                part = min(max(since // hop * hop / fallen, 0.0), 1.0)
                share *= 1.0 - (1.0 - one.size) * part
            yield left, share
            done += left

    def late_s(self, first: int, last: int) -> float:
        """How long after their schedule samples first .. last - 1 have come, in s."""
        late = [one.size for one in self._of("late") if first <= one.first < last]
        never = [math.inf for one in self._of("stall") if one.first < last]
        return max([0.0, *late, *never])

    def inputs(self, first: int, volts: Float2D) -> Float2D:
        """Volts of samples from `first` on as they are delivered, (channel, sample)."""
        if not (self.planted and volts.size):
            return volts
        last = first + volts.shape[1]
        volts = volts.copy()
        for one, kept in zip(self.planted, self.memory, strict=True):
            where = one.overlap(first, last)
            if one.kind in CHANGES and where.start < where.stop:
                sensor, row = self.sensors[one.row], volts[one.row]
                if where.start and first + where.start == one.first:
                    kept.value = float(row[where.start - 1])
                since = (first + np.arange(where.start, where.stop) - one.first) / self.rate_hz
                row[where] = CHANGES[one.kind](one, row[where], since, sensor, kept)
            elif one.last > last and one.row >= 0:
                kept.value = float(volts[one.row, -1])
        full = np.array([[abs(s.range * s.volts_per_unit)] for s in self.sensors])
        return self._lost(first, self._repeated(first, np.clip(volts, -full, full)))

    def _repeated(self, first: int, volts: Float2D) -> Float2D:
        """The samples before in the place of these; keeps the last ones for what comes."""
        known = np.concatenate([self._volts, volts], axis=1)
        ahead = self._volts.shape[1]
        self._volts = known[:, known.shape[1] - self.reach :]
        for one in self._of("repeated"):
            where = one.overlap(first, first + volts.shape[1])
            if where.start < where.stop:
                back = ahead - (one.last - one.first)
                volts[:, where] = known[:, where.start + back : where.stop + back]
        return volts

    def _lost(self, first: int, volts: Float2D) -> Float2D:
        for one in self._of("dropped"):
            volts[:, one.overlap(first, first + volts.shape[1])] = math.nan
        return volts

    def _of(self, kind: str) -> list[Planted]:
        return [one for one in self.planted if one.kind == kind]


def planted(cards: tuple[PlantedFault, ...], rig: Rig, rate_hz: float, seed: int) -> Faults:
    """The faults of a machine card at a sampling rate."""
    faults = []
    for card in cards:
        first = round(card.at_s * rate_hz)
        count = 1 if card.kind == "spike" else NEVER
        if card.for_s is not None:
            count = max(round(card.for_s * rate_hz), 1)
        row = rig.channels.index(card.channel) if card.channel is not None else -1
        faults.append(Planted(card.kind, first, first + count, row, card.size or 0.0))
    spans = [one.last - one.first for one in faults if one.kind in ("repeated", "replayed")]
    reach = max(spans, default=0)
    return Faults(
        rate_hz,
        rig.sensors,
        tuple(faults),
        tuple(Memory(np.random.default_rng([seed, 2, k])) for k in range(len(faults))),
        reach,
        np.full((len(rig.sensors), reach), math.nan),
    )
