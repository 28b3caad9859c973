"""What a person's hand proves: polarity, place and timing of each sensor, by a tap or a shunt.

Nothing is commanded. A hand strikes or presses to the right, or switches a shunt; the first swing
of each channel must have the sign of its definition (right, or compression, positive).
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from table_io.block import Float1D, Float2D
from table_io.channels import BY_NAME, LEFT_CELLS, RIGHT_CELLS
from table_io.rig import Rig
from table_io.wiring_check.line import Line, judged, untested

CLEAR = 10.0  # times noise, that a swing must reach
FIRST = 0.25  # of its largest swing, that a channel's first one must reach
TOGETHER_MS = (0.0, 60.0)  # after the first of the channels that one hand moves
NOISE_RANGE = 1e-5  # of the range: less noise is not believed
HELD = 5e-3  # of the range: a load cell that is farther from its rest is still pressed
SHIFT = 0.3  # of a shunt, that shows that it was switched
SHUNT_REST = 0.5  # the later share of what was taken, in which a shunt is read


@dataclass(frozen=True, slots=True)
class Hand:
    """What to ask a person, and the channels that it proves, the clearest first."""

    ask: str
    channels: tuple[str, ...]
    shunt: bool = False


HANDS = (
    Hand("tap the table to the right, once", ("table_acc_m_s2", "table_disp_m")),
    Hand("tap the mass to the right, once", ("mass_acc_m_s2", "mass_disp_m", "rel_disp_m")),
    Hand("press the load cells of the right bumper, both", RIGHT_CELLS),
    Hand("press the load cells of the left bumper, both", LEFT_CELLS),
    Hand("push the mass to the right against the damper", ("damper_force_n",)),
)


def hands(rig: Rig) -> tuple[Hand, ...]:
    """What to ask for on this rig: taps and presses, then every shunt that its card states."""
    taps = (
        Hand(hand.ask, tuple(name for name in hand.channels if name in rig.channels))
        for hand in HANDS
    )
    shunts = (
        Hand(f"switch the shunt of {one.channel} on", (one.channel,), shunt=True)
        for one in rig.sensors
        if one.shunt is not None
    )
    return (*(hand for hand in taps if hand.channels), *shunts)


@dataclass(frozen=True, eq=False)
class Felt:
    """What came while a hand was asked for, in the unit of each sensor, (channel, sample).

    `noise` is the rms of each channel at rest; the mean at rest is that of the first `before`
    samples, in which nobody has moved yet (`restless` where somebody has). `rest` is the mean of
    each channel before anybody was asked.
    """

    rig: Rig
    rate_hz: float
    values: Float2D
    noise: Float1D
    before: int
    rest: Float1D | None = None

    def swing(self, channel: str) -> Float1D:
        """A channel about its mean at rest, (sample,); a lost sample is 0."""
        row = self.values[self.rig.channels.index(channel)]
        return np.nan_to_num(row - self._early(channel))

    def _early(self, channel: str) -> float:
        """The mean of a channel at rest; NaN where nothing came."""
        row = self.values[self.rig.channels.index(channel)][: self.before]
        known = row[np.isfinite(row)]
        return float(known.mean()) if known.size else math.nan

    def clear(self, channel: str) -> float:
        """What a swing must reach to be one, in the sensor's unit."""
        place = self.rig.channels.index(channel)
        sensor = self.rig.sensors[place]
        noise = float(np.nan_to_num(self.noise[place]))
        return CLEAR * max(noise, sensor.lsb, NOISE_RANGE * sensor.range)

    def first(self, channel: str) -> tuple[int, float] | None:
        """(sample, value) at which the first swing is there; None where there is no clear one.

        What came in the samples at rest is none.
        """
        swing = self.swing(channel)[self.before :]
        largest = float(np.abs(swing).max(initial=0.0))
        if largest < self.clear(channel):
            return None
        at = int(np.argmax(np.abs(swing) >= max(FIRST * largest, self.clear(channel))))
        return self.before + at, float(swing[at])

    def largest(self, channel: str) -> float:
        """The largest swing once the samples at rest are over, in the sensor's unit."""
        return float(np.abs(self.swing(channel)[self.before :]).max(initial=0.0))

    def unquiet(self, channel: str) -> bool:
        """True where the samples at rest show a swing, or a load cell that is still pressed."""
        place = self.rig.channels.index(channel)
        early = self.swing(channel)[: self.before]
        if np.abs(early).max(initial=0.0) >= self.clear(channel):
            return True
        if self.rest is None or BY_NAME[channel].unit != "N":
            return False
        least = max(HELD * self.rig.sensors[place].range, self.clear(channel))
        return abs(self._early(channel) - float(self.rest[place])) >= least


def restless(hand: Hand, felt: Felt) -> bool:
    """True where a hand was there already, or still, in the samples that are to be at rest."""
    names = hand.channels if hand.shunt else _alike(hand, felt.rig)
    return any(felt.unquiet(name) for name in names)


def moved(hand: Hand, felt: Felt) -> int | None:
    """The sample at which a hand is first felt, or None: in any channel of the kind it proves."""
    if hand.shunt:
        place = felt.rig.channels.index(hand.channels[0])
        shunt = felt.rig.sensors[place].shunt or math.inf
        far = np.abs(felt.swing(hand.channels[0])[felt.before :]) >= SHIFT * abs(shunt)
        return felt.before + int(np.argmax(far)) if far.any() else None
    found = [first[0] for name in _alike(hand, felt.rig) if (first := felt.first(name))]
    return min(found, default=None)


def proven(hand: Hand, felt: Felt | None, why: str) -> tuple[Line, ...]:
    """The lines of one hand; not tested, and why, where nobody was felt, or somebody too early."""
    if felt is not None and restless(hand, felt):
        felt, why = None, f"something moved before it was asked for, or was not let go: {hand.ask}"
    if felt is None:
        what = "shunt" if hand.shunt else "polarity"
        return tuple(untested(what, name, why) for name in hand.channels)
    return tuple(_shunt(hand, felt) if hand.shunt else _struck(hand, felt))


def _alike(hand: Hand, rig: Rig) -> tuple[str, ...]:
    """The channels of the same quantity as the one that the hand proves."""
    unit = BY_NAME[hand.channels[0]].unit
    others = (name for name in rig.channels if BY_NAME[name].unit == unit and unit != "m")
    return tuple(dict.fromkeys((*hand.channels, *others)))


def _struck(hand: Hand, felt: Felt) -> Iterator[Line]:
    """Sign and time of each channel that the hand moves, and whether it is the right one.

    A press is no strike: two cells may feel it one after another.
    """
    kind = BY_NAME[hand.channels[0]].unit
    earliest = min((one[0] for name in hand.channels if (one := felt.first(name))), default=0)
    loudest, most = _loudest(hand, felt)
    for name in hand.channels:
        sensor = felt.rig.sensors[felt.rig.channels.index(name)]
        first = felt.first(name)
        if loudest not in hand.channels and BY_NAME[name].unit == kind:
            own = felt.largest(name)
            do = f"{loudest} felt it more: their cables, or their lines in the card, are swapped"
            yield judged("place", name, own, (most, math.inf), sensor.unit, do)
        if first is None:
            why = "it did not move clearly: a stronger hand, or the loop check, proves it"
            yield untested("polarity", name, why)
            continue
        do = "turn the sensor round, or the sign of volts_per_unit in its card"
        yield judged("polarity", name, first[1], (0.0, math.inf), sensor.unit, do)
        if kind != "N":
            after = 1e3 * (first[0] - earliest) / felt.rate_hz
            do = "it comes late: look at its filter, and at the clock of its device"
            yield judged("time after the first", name, after, TOGETHER_MS, "ms", do)


def _loudest(hand: Hand, felt: Felt) -> tuple[str, float]:
    """The channel of this quantity that felt most, in SI, and that in the unit of the hand's."""
    unit = felt.rig.sensors[felt.rig.channels.index(hand.channels[0])].si_per_unit
    sizes = {
        name: felt.rig.sensors[felt.rig.channels.index(name)].si_per_unit * felt.largest(name)
        for name in _alike(hand, felt.rig)
        if BY_NAME[name].unit == BY_NAME[hand.channels[0]].unit
    }
    loudest = max(sizes, key=sizes.__getitem__)
    return loudest, sizes[loudest] / unit


def _shunt(hand: Hand, felt: Felt) -> Iterator[Line]:
    """The shift by a shunt: sign and gain of the whole way from sensor to card."""
    name = hand.channels[0]
    sensor = felt.rig.sensors[felt.rig.channels.index(name)]
    wanted, tolerance = sensor.shunt or 0.0, sensor.shunt_tolerance or 0.0
    later = felt.swing(name)[moved(hand, felt) :]
    shift = float(later[round((1.0 - SHUNT_REST) * later.size) :].mean())
    allowed = (wanted - tolerance, wanted + tolerance)
    do = (
        "the sign is turned: turn the sensor round, or the sign of volts_per_unit"
        if shift * wanted < 0
        else "compare volts_per_unit, range and supply with the sensor: `shaketwin calibrate`"
    )
    yield judged("shunt", name, shift, allowed, sensor.unit, do)
