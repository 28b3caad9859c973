"""What the inputs must show where nothing moves: every channel alive, quiet and its own.

Values are in the unit of each sensor's card. No line here needs a hand, nor a motion.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from table_io.block import Float1D, Float2D
from table_io.rig import Rig
from table_io.sensor import Sensor
from table_io.wiring_check.line import Line, judged, untested
from table_io.wiring_check.mains import Hum, hum

LOST = 0.0  # per cent of the samples
RAIL = 0.999  # of the range
STUCK_S = 0.25  # of equal samples, where the noise is at least half a step
NOISE = (0.25, 2.0)  # of what the card says
LEAST_BITS = 8.0  # that noise leaves
HUM_RANGE = 1e-3  # of the range, where the card states no noise
OFFSET_RANGE = 0.2
STEADY_RANGE = 1e-3  # from the first quarter to the last
SPIKE = 8.0  # times the rms of the noise
SAME = 0.5  # correlation of two channels' noise
ZERO_LSB, ZERO_SPAN = 4.0, 1e-3  # command at rest: steps of both converters, and of the span
COMMAND = "drive_disp_m"


@dataclass(frozen=True, eq=False)
class Resting:
    """Inputs at rest: volts, (channel, sample), NaN where a sample was lost."""

    rig: Rig
    rate_hz: float
    volts: Float2D

    @cached_property
    def values(self) -> Float2D:
        """In the unit of each sensor, (channel, sample); nothing is tared."""
        volts_per_unit = np.array([sensor.volts_per_unit for sensor in self.rig.sensors])
        values: Float2D = self.volts / volts_per_unit[:, None]
        return values

    @cached_property
    def lost(self) -> list[bool]:
        """True for a channel of which nothing came."""
        return [bool(np.isnan(row).all()) for row in self.values]

    @cached_property
    def means(self) -> Float1D:
        """Mean of each channel, (channel,); NaN where it is lost."""
        return np.array([_mean(row) for row in self.values])

    @cached_property
    def noise(self) -> Float1D:
        """rms of each channel about its mean, (channel,); NaN where it is lost."""
        return np.array([_rms(row) for row in self.values])

    @cached_property
    def hum(self) -> Hum:
        """Mains hum; a lost sample counts as the mean."""
        means = np.nan_to_num(self.means)[:, None]
        return hum(np.where(np.isnan(self.values), means, self.values), self.rate_hz)

    def bits(self, place: int) -> float:
        """Bits of the range that the noise leaves: log2(2 range / (sqrt(12) rms))."""
        sensor = self.rig.sensors[place]
        rms = max(float(self.noise[place]), sensor.lsb / math.sqrt(12.0))
        return math.log2(2.0 * sensor.range / (math.sqrt(12.0) * rms))


def _mean(row: Float1D) -> float:
    known = row[np.isfinite(row)]
    return float(known.mean()) if known.size else math.nan


def _rms(row: Float1D) -> float:
    """About its mean."""
    known = row[np.isfinite(row)]
    return float(known.std()) if known.size else math.nan


def at_rest(resting: Resting) -> tuple[Line, ...]:
    """Every line of the inputs at rest, channel by channel."""
    lines: list[Line] = []
    for place, sensor in enumerate(resting.rig.sensors):
        lines += _arriving(resting, place, sensor)
        if not resting.lost[place]:
            judges = (_alive, _noise, _hum, _level, _own)
            lines += [line for judge in judges for line in judge(resting, place, sensor)]
    return tuple(lines)


def _arriving(resting: Resting, place: int, sensor: Sensor) -> Iterator[Line]:
    """Samples come, and within the range."""
    values = resting.values[place]
    share = 100.0 * float(np.isnan(values).mean())
    do = "look at its cable, at its channel in the machine card, and at the acquisition"
    yield judged("lost samples", sensor.channel, share, (0.0, LOST), "%", do)
    if not resting.lost[place]:
        railed = 100.0 * float(np.mean(np.abs(values) >= RAIL * sensor.range))
        do = "it is at the end of its range: look at its cable, its supply, its place, its range"
        yield judged("at the rail", sensor.channel, railed, (0.0, 0.0), "%", do)


def _alive(resting: Resting, place: int, sensor: Sensor) -> Iterator[Line]:
    """Samples change where there is noise to see.

    A command that stands still says nothing, nor does noise below half a step of the converter.
    """
    values = resting.values[place]
    known = values[np.isfinite(values)]
    edges = np.flatnonzero(np.diff(known, prepend=np.nan, append=np.nan))
    longest = float(np.diff(edges).max()) / resting.rate_hz
    if longest > STUCK_S and sensor.noise_rms < 0.5 * sensor.lsb:
        why = "it stands still, and its card states no noise that would show: the loop check tells"
        yield untested("stuck", sensor.channel, why)
        return
    do = "it does not change: look at its supply and at the acquisition"
    yield judged("stuck", sensor.channel, longest, (0.0, STUCK_S), "s", do)


def _noise(resting: Resting, place: int, sensor: Sensor) -> Iterator[Line]:
    """Noise against the card, and against the range; single samples that stick out."""
    rms = float(resting.noise[place])
    if sensor.noise_rms:
        low = NOISE[0] * sensor.noise_rms if sensor.noise_rms >= sensor.lsb else 0.0
        high = NOISE[1] * sensor.noise_rms + sensor.lsb
        do = (
            "quieter than its card: its cable or its supply is off, or its filter another"
            if rms < low
            else "look at earth loops, shields and range, and at what moves"
        )
        yield judged("noise", sensor.channel, rms, (low, high), sensor.unit, do)
    elif sensor.channel != COMMAND:
        why = f"its card states no noise_rms; {rms:.3g} {sensor.unit} where the wiring is right"
        yield untested("noise", sensor.channel, why)
    do = "the noise leaves too little of the range: take a range that fits the test, or mend noise"
    yield judged(
        "bits used", sensor.channel, resting.bits(place), (LEAST_BITS, math.inf), "bit", do
    )
    values = resting.values[place]
    off = np.abs(values - np.nanmedian(values))
    least = max(1.4826 * float(np.nanmedian(off)), sensor.lsb)
    do = "single samples stick out: look for a loose contact, or a switch beside its cable"
    peak = float(np.nanmax(off)) / least
    yield judged("spikes", sensor.channel, peak, (0.0, SPIKE), "x noise", do)


def _hum(resting: Resting, place: int, sensor: Sensor) -> Iterator[Line]:
    """Hum of the mains below the noise of the card, or below a thousandth of the range."""
    most = max(sensor.noise_rms or HUM_RANGE * sensor.range, sensor.lsb)
    mains = f"{resting.hum.frequency_hz:.1f} Hz"
    do = f"mains of {mains} and harmonics: look at earth loops, shields, and supplies beside it"
    rms = float(resting.hum.rms[place])
    yield judged("mains hum", sensor.channel, rms, (0.0, most), sensor.unit, do)


def _level(resting: Resting, place: int, sensor: Sensor) -> Iterator[Line]:
    """What it shows, and that it stays there."""
    if sensor.channel == COMMAND:
        yield from zero(resting)
    else:
        most = OFFSET_RANGE * sensor.range
        do = "set its zero, or its place: the offset takes away range"
        at = sensor.offset
        shown = float(resting.means[place])
        yield judged("offset", sensor.channel, shown, (at - most, at + most), sensor.unit, do)
    values = resting.values[place]
    quarter = max(values.size // 4, 1)
    first, last = _mean(values[:quarter]), _mean(values[-quarter:])
    doubt = 6.0 * float(resting.noise[place]) * math.sqrt(2.0 / quarter)
    most = STEADY_RANGE * sensor.range + doubt
    do = "it drifts: let it warm up, look at its supply, and whether the table really rests"
    yield judged("steady", sensor.channel, last - first, (-most, most), sensor.unit, do)


def zero(resting: Resting) -> Iterator[Line]:
    """The command wired back stands at the output's 0 V, and stays there.

    Judged is the sample that is farthest off: a swing may have any mean. None that came fails.
    """
    place = resting.rig.channels.index(COMMAND)
    sensor, output = resting.rig.sensors[place], resting.rig.output
    span = 1e-3 * output.span_mm / sensor.si_per_unit
    lsb = output.lsb_m / sensor.si_per_unit
    most = max(ZERO_LSB * (lsb + sensor.lsb), ZERO_SPAN * span)
    do = (
        "nothing is commanded, and it is not at 0 V: something else drives this input, or the "
        "output was left there"
    )
    row = resting.values[place]
    known = row[~np.isnan(row)]
    shown = float(known[np.argmax(np.abs(known))]) if known.size else math.nan
    yield judged("command at 0 V", COMMAND, shown, (-most, most), sensor.unit, do)


def _own(resting: Resting, place: int, sensor: Sensor) -> Iterator[Line]:
    """Its noise is its own: hum and trend taken off, no other channel shows the same."""
    left = resting.hum.left
    rms = np.std(left, axis=1)
    worst, other = 0.0, ""
    for k, one in enumerate(resting.rig.sensors):
        if k != place and rms[k] > 0 and rms[place] > 0:
            alike = float(np.mean(left[k] * left[place]) / (rms[k] * rms[place]))
            if abs(alike) > abs(worst):
                worst, other = alike, one.channel
    do = (
        f"it shows the noise of {other}: one signal at two inputs, an open input, or a floor that "
        "shakes both; look at the cables, and take it again in quiet"
    )
    yield judged("same noise as another", sensor.channel, worst, (-SAME, SAME), "", do)
