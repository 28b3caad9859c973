"""Wiring check: evaluation of inputs at rest, digital inputs, tap tests and shunts, without motion.

    check_resting_inputs(resting) -> check lines of the inputs at rest
    check_zero_command(resting) -> check line of the command at 0 V output
    check_digital_inputs(...) -> check lines of heartbeat and switches
    list_stimuli(rig) -> stimuli (tap, press, shunt) that the operator is asked to apply
    is_disturbed(stimulus, response) -> True if the stimulus came too early
    find_tap_onset(stimulus, response) -> sample at which it came
    evaluate_tap(stimulus, response, reason) -> its check lines

Functions take samples that are already acquired, in the unit of each sensor in the rig file.
Nothing is commanded. In a tap test the operator taps or presses to the right, or switches a shunt
on; the first swing of each channel must have the sign of its definition (right, or compression,
positive).
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Literal

import numpy as np

from table_io.block import Float1D, Float2D, finite_mean, finite_std
from table_io.channels import LEFT_CELLS, RIGHT_CELLS
from table_io.config.rig import RigConfig
from table_io.config.sensor import CLIP_RATIO, SensorConfig

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


MAINS_HZ = (50.0, 60.0)
MAX_MAINS_DEVIATION_HZ = 0.5  # more than any public grid deviates
HARMONIC_COUNT = 5
REFINEMENT_STEPS = 16  # steps of the fine search per step of the coarse one


@dataclass(frozen=True, slots=True, eq=False)
class MainsHum:
    """Fitted mains hum: common frequency, rms of the hum in each channel, (channel,).

    `residual`: values without hum, mean and trend, (channel, sample).
    """

    frequency_hz: float
    rms: Float1D
    residual: Float2D


def fit_mains_hum(values: Float2D, rate_hz: float) -> MainsHum:
    """Fit the hum in finite values, (channel, sample); rms in their unit, corrected for noise."""
    count = values.shape[1]
    t = (np.arange(count) - 0.5 * (count - 1)) / rate_hz
    detrended = values - _project(np.stack([np.ones(count), t]), values)
    variance = np.mean(detrended**2, axis=1)
    weights = np.divide(1.0, variance, out=np.zeros_like(variance), where=variance > 0)

    def explained_share(f: float) -> float:
        """Return the share of the channels' variance that hum of this frequency explains."""
        rows = _tone_rows(f, t, rate_hz)
        projection = rows @ detrended.T
        return (
            float(weights @ (projection * np.linalg.solve(rows @ rows.T, projection)).sum(axis=0))
            / count
        )

    step = rate_hz / (4.0 * count)
    offsets = np.arange(-MAX_MAINS_DEVIATION_HZ, MAX_MAINS_DEVIATION_HZ + 0.5 * step, step)
    frequency_hz = max((mains + off for mains in MAINS_HZ for off in offsets), key=explained_share)
    frequency_hz = max(
        frequency_hz + step * np.linspace(-1.0, 1.0, 2 * REFINEMENT_STEPS + 1), key=explained_share
    )
    rows = _tone_rows(frequency_hz, t, rate_hz)
    tones = _project(rows, detrended)
    residual = detrended - tones
    noise_power = len(rows) / count * np.mean(residual**2, axis=1)
    rms = np.sqrt(np.maximum(np.mean(tones**2, axis=1) - noise_power, 0.0))
    return MainsHum(float(frequency_hz), rms, residual)


def _tone_rows(f: float, t: Float1D, rate_hz: float) -> Float2D:
    """Return cosines and sines of f and its harmonics below 0.45 of the rate, (row, sample)."""
    orders = np.arange(1, HARMONIC_COUNT + 1)
    phase = 2 * math.pi * f * orders[orders * f < 0.45 * rate_hz][:, None] * t
    return np.concatenate([np.cos(phase), np.sin(phase)])


def _project(rows: Float2D, values: Float2D) -> Float2D:
    """Project values, (channel, sample), onto the span of rows, (row, sample)."""
    weights = np.linalg.solve(rows @ rows.T, rows @ values.T)
    projection: Float2D = (rows.T @ weights).T
    return projection


BEAT_HZ = (5.0, 15.0)  # for a beat of 10 Hz, sampled at 50 Hz
HEARTBEAT = "heartbeat"

LevelSamples = Sequence[dict[str, bool]]  # name -> level, per sample


def check_digital_inputs(
    held_levels: LevelSamples,
    held_s: float,
    released_levels: LevelSamples,
    has_heartbeat: bool,
    simulated: bool,
) -> tuple[CheckLine, ...]:
    """Check the digital inputs, sampled while the output was held and after it was released.

    Inputs missing in the rig file are not tested; a simulated table has none.
    """
    names = tuple(held_levels[0]) if held_levels else ()
    lines = []
    if HEARTBEAT in names:
        beats = _count_changes(held_levels) / (2.0 * held_s)
        remedy = "no heartbeat is read back: check its output line, cable and the interlock input"
        lines.append(check_value("heartbeat comes back", "", beats, BEAT_HZ, "Hz", remedy))
        remedy = "the input still changes after the heartbeat stopped: check where it is connected"
        changes = float(_count_changes(released_levels))
        lines.append(check_value("heartbeat stops", "", changes, (0.0, 0.0), "changes", remedy))
    elif has_heartbeat:
        reason = (
            "the rig file has no heartbeat_back, or the output was not held: connect the heartbeat "
            "to an input, or check that the lamp of the interlock goes out"
        )
        lines.append(mark_untested("heartbeat comes back", "", reason))
    for name in names:
        if name != HEARTBEAT:
            share = 100.0 * sum(levels[name] for levels in held_levels) / len(held_levels)
            remedy = "the input is low: check the switch, its supply and its cable"
            lines.append(check_value("all is well", name, share, (100.0, 100.0), "%", remedy))
    if not simulated:
        reason = (
            "with this computer off, trip each limit switch and the emergency stop by hand; the "
            "table must come to rest by itself"
        )
        lines.append(mark_untested("stroke limits and emergency stop", "", reason))
    return tuple(lines)


def _count_changes(levels: LevelSamples) -> int:
    return sum(before[HEARTBEAT] != after[HEARTBEAT] for before, after in pairwise(levels))


MAX_LOST_PERCENT = 0.0  # of the samples
MAX_STUCK_S = 0.25  # of equal samples, if the noise is at least half a step
NOISE_RATIO_RANGE = (0.25, 2.0)  # of the noise stated in the rig file
MIN_BITS = 8.0  # effective bits
MAX_HUM_RANGE = 1e-3  # of the range, if the rig file states no noise
MAX_OFFSET_RANGE = 0.2
MAX_DRIFT_RANGE = 1e-3  # from the first quarter to the last
MAX_SPIKE_RATIO = 8.0  # times the rms noise
MAX_CORRELATION = 0.5  # of the noise of two channels
# Command at rest: steps of both converters, and fraction of the span.
MAX_ZERO_LSB = 4.0
MAX_ZERO_SPAN = 1e-3
COMMAND_CHANNEL = "drive_disp_m"


@dataclass(frozen=True, eq=False)
class RestingInputs:
    """Inputs at rest: volts, (channel, sample); lost samples are NaN."""

    rig: RigConfig
    rate_hz: float
    volts: Float2D

    @cached_property
    def values(self) -> Float2D:
        """Values in the unit of each sensor, (channel, sample), not tared."""
        volts_per_unit = np.array([sensor.volts_per_unit for sensor in self.rig.sensors])
        values: Float2D = self.volts / volts_per_unit[:, None]
        return values

    @cached_property
    def is_lost(self) -> list[bool]:
        """True for each channel without any sample, (channel,)."""
        return [bool(np.isnan(row).all()) for row in self.values]

    @cached_property
    def means(self) -> Float1D:
        """Mean of each channel, (channel,); NaN where it is lost."""
        return np.array([finite_mean(row) for row in self.values])

    @cached_property
    def noise_rms(self) -> Float1D:
        """Noise rms of each channel about its mean, (channel,); NaN where it is lost."""
        return np.array([finite_std(row) for row in self.values])

    @cached_property
    def hum(self) -> MainsHum:
        """Mains hum; lost samples are replaced by the mean."""
        means = np.nan_to_num(self.means)[:, None]
        return fit_mains_hum(np.where(np.isnan(self.values), means, self.values), self.rate_hz)

    def effective_bits(self, row: int) -> float:
        """Return the effective number of bits: log2(2 range / (sqrt(12) rms))."""
        sensor = self.rig.sensors[row]
        rms = max(float(self.noise_rms[row]), sensor.lsb / math.sqrt(12.0))
        return math.log2(2.0 * sensor.range / (math.sqrt(12.0) * rms))


def check_resting_inputs(resting: RestingInputs) -> tuple[CheckLine, ...]:
    """Check the inputs at rest, channel by channel."""
    lines: list[CheckLine] = []
    for row, sensor in enumerate(resting.rig.sensors):
        lines += _check_delivery(resting, row, sensor)
        if not resting.is_lost[row]:
            checks = (_check_alive, _check_noise, _check_hum, _check_level, _check_correlation)
            lines += [line for check in checks for line in check(resting, row, sensor)]
    return tuple(lines)


def _check_delivery(resting: RestingInputs, row: int, sensor: SensorConfig) -> Iterator[CheckLine]:
    """Check for lost samples and saturated samples."""
    values = resting.values[row]
    lost_percent = 100.0 * float(np.isnan(values).mean())
    remedy = "check its cable, its channel in the rig file, and the acquisition device"
    yield check_value(
        "lost samples", sensor.channel, lost_percent, (0.0, MAX_LOST_PERCENT), "%", remedy
    )
    if not resting.is_lost[row]:
        railed_percent = 100.0 * float(np.mean(np.abs(values) >= CLIP_RATIO * sensor.range))
        remedy = "it saturates: check its cable, supply, mounting position and range"
        yield check_value("at the rail", sensor.channel, railed_percent, (0.0, 0.0), "%", remedy)


def _check_alive(resting: RestingInputs, row: int, sensor: SensorConfig) -> Iterator[CheckLine]:
    """Check that samples change; a constant input with low stated noise is not tested."""
    values = resting.values[row]
    finite = values[np.isfinite(values)]
    edges = np.flatnonzero(np.diff(finite, prepend=np.nan, append=np.nan))
    longest = float(np.diff(edges).max()) / resting.rate_hz
    if longest > MAX_STUCK_S and sensor.noise_rms < 0.5 * sensor.lsb:
        reason = (
            "it is constant, and no noise of at least half a converter step is stated in the rig "
            "file; the loop check tests it"
        )
        yield mark_untested("stuck", sensor.channel, reason)
        return
    remedy = "it does not change: check its supply and the acquisition device"
    yield check_value("stuck", sensor.channel, longest, (0.0, MAX_STUCK_S), "s", remedy)


def _check_noise(resting: RestingInputs, row: int, sensor: SensorConfig) -> Iterator[CheckLine]:
    """Check the noise against the rig file and the range, and check for spikes."""
    rms = float(resting.noise_rms[row])
    if sensor.noise_rms:
        low = NOISE_RATIO_RANGE[0] * sensor.noise_rms if sensor.noise_rms >= sensor.lsb else 0.0
        high = NOISE_RATIO_RANGE[1] * sensor.noise_rms + sensor.lsb
        remedy = (
            "it is quieter than stated in the rig file: check its cable, supply and filter"
            if rms < low
            else "check ground loops, shields and range, and that nothing moves"
        )
        yield check_value("noise", sensor.channel, rms, (low, high), sensor.unit, remedy)
    elif sensor.channel != COMMAND_CHANNEL:
        reason = (
            "the rig file states no noise_rms; if the wiring is correct, enter "
            f"{rms:.3g} {sensor.unit}"
        )
        yield mark_untested("noise", sensor.channel, reason)
    remedy = (
        "the noise is large compared with the range: use a range that fits the test, or reduce the "
        "noise"
    )
    yield check_value(
        "bits used",
        sensor.channel,
        resting.effective_bits(row),
        (MIN_BITS, math.inf),
        "bit",
        remedy,
    )
    values = resting.values[row]
    deviations = np.abs(values - np.nanmedian(values))
    noise_floor = max(1.4826 * float(np.nanmedian(deviations)), sensor.lsb)
    remedy = "single samples deviate: check for loose contacts, and for switches near its cable"
    peak = float(np.nanmax(deviations)) / noise_floor
    yield check_value("spikes", sensor.channel, peak, (0.0, MAX_SPIKE_RATIO), "x noise", remedy)


def _check_hum(resting: RestingInputs, row: int, sensor: SensorConfig) -> Iterator[CheckLine]:
    """Check that mains hum is below the stated noise, or below a thousandth of the range."""
    max_rms = max(sensor.noise_rms or MAX_HUM_RANGE * sensor.range, sensor.lsb)
    mains = f"{resting.hum.frequency_hz:.1f} Hz"
    remedy = f"hum of {mains} and harmonics: check ground loops, shields and power supplies nearby"
    rms = float(resting.hum.rms[row])
    yield check_value("mains hum", sensor.channel, rms, (0.0, max_rms), sensor.unit, remedy)


def _check_level(resting: RestingInputs, row: int, sensor: SensorConfig) -> Iterator[CheckLine]:
    """Check the offset of a channel (the command: 0 V), and that it does not drift."""
    if sensor.channel == COMMAND_CHANNEL:
        yield from check_zero_command(resting)
    elif sensor.channel not in resting.rig.stated_offsets:  # at rest a temperature has any value
        limit = MAX_OFFSET_RANGE * sensor.range
        remedy = "adjust its zero or its mounting position: the offset reduces the usable range"
        expected = sensor.offset
        measured = float(resting.means[row])
        yield check_value(
            "offset",
            sensor.channel,
            measured,
            (expected - limit, expected + limit),
            sensor.unit,
            remedy,
        )
    values = resting.values[row]
    quarter = max(values.size // 4, 1)
    first, last = finite_mean(values[:quarter]), finite_mean(values[-quarter:])
    uncertainty = 6.0 * float(resting.noise_rms[row]) * math.sqrt(2.0 / quarter)
    limit = MAX_DRIFT_RANGE * sensor.range + uncertainty
    remedy = "it drifts: let it warm up, check its supply, and check that the table is at rest"
    yield check_value("steady", sensor.channel, last - first, (-limit, limit), sensor.unit, remedy)


def check_zero_command(resting: RestingInputs) -> Iterator[CheckLine]:
    """Check that the command read back stays at 0 V, by its largest sample.

    The mean would not reveal an oscillation. Without any sample the check fails.
    """
    row = resting.rig.channels.index(COMMAND_CHANNEL)
    sensor, output = resting.rig.sensors[row], resting.rig.output
    span = 1e-3 * output.span_mm / sensor.si_per_unit
    lsb = output.lsb_m / sensor.si_per_unit
    limit = max(MAX_ZERO_LSB * (lsb + sensor.lsb), MAX_ZERO_SPAN * span)
    remedy = (
        "it is not at 0 V although nothing is commanded: check what else drives this input, or "
        "whether the output was left at this voltage"
    )
    samples = resting.values[row]
    finite = samples[~np.isnan(samples)]
    largest = float(finite[np.argmax(np.abs(finite))]) if finite.size else math.nan
    yield check_value(
        "command at 0 V", COMMAND_CHANNEL, largest, (-limit, limit), sensor.unit, remedy
    )


def _check_correlation(
    resting: RestingInputs, row: int, sensor: SensorConfig
) -> Iterator[CheckLine]:
    """Check that no other channel has the same noise, after removal of hum and trend."""
    residual = resting.hum.residual
    rms = np.std(residual, axis=1)
    worst, worst_channel = 0.0, ""
    for k, neighbour in enumerate(resting.rig.sensors):
        if k != row and rms[k] > 0 and rms[row] > 0:
            correlation = float(np.mean(residual[k] * residual[row]) / (rms[k] * rms[row]))
            if abs(correlation) > abs(worst):
                worst, worst_channel = correlation, neighbour.channel
    remedy = (
        f"its noise equals that of {worst_channel}: one signal at two inputs, an open input, or "
        "floor vibration; check the cables and repeat the check while nothing vibrates"
    )
    yield check_value(
        "same noise as another",
        sensor.channel,
        worst,
        (-MAX_CORRELATION, MAX_CORRELATION),
        "",
        remedy,
    )


MIN_SWING_SNR = 10.0  # smallest swing over the noise
FIRST_SWING_RATIO = 0.25  # smallest first swing of a channel over its largest
DELAY_RANGE_MS = (0.0, 60.0)  # after the first channel of the same stimulus
MIN_NOISE_RANGE = 1e-5  # of the range: lower bound of the assumed noise
MIN_PRESS_RANGE = 5e-3  # of the range: a load cell farther from its rest value is still pressed
MIN_SHUNT_RATIO = 0.3  # of the shunt value: a larger shift shows that it was switched on
SHUNT_READ_SHARE = 0.5  # last share of the samples after the onset, in which a shunt is read


@dataclass(frozen=True, slots=True)
class Stimulus:
    """Stimulus that the operator applies: prompt, and the channels it tests, the clearest first."""

    prompt: str
    channels: tuple[str, ...]
    shunt: bool = False


STIMULI = (
    Stimulus("tap the table to the right, once", ("table_acc_m_s2", "table_disp_m")),
    Stimulus("tap the mass to the right, once", ("mass_acc_m_s2", "mass_disp_m", "rel_disp_m")),
    Stimulus("press the load cells of the right bumper, both", RIGHT_CELLS),
    Stimulus("press the load cells of the left bumper, both", LEFT_CELLS),
    Stimulus("push the mass to the right against the damper", ("damper_force_n",)),
)


def list_stimuli(rig: RigConfig) -> tuple[Stimulus, ...]:
    """List the stimuli for a rig: taps and presses, then the shunts stated in the rig file."""
    taps = (Stimulus(stimulus.prompt, _list_moved(stimulus, rig)) for stimulus in STIMULI)
    shunts = (
        Stimulus(f"switch the shunt of {sensor.channel} on", (sensor.channel,), shunt=True)
        for sensor in rig.sensors
        if sensor.shunt is not None
    )
    return (*(stimulus for stimulus in taps if stimulus.channels), *shunts)


def _list_moved(stimulus: Stimulus, rig: RigConfig) -> tuple[str, ...]:
    """List the rig's channels that a stimulus moves: its own, then declared ones alike."""
    registry = rig.channel_by_name
    alike = {(registry[name].quantity, registry[name].body) for name in stimulus.channels}
    declared = (
        channel.name
        for channel in (registry[extra.name] for extra in rig.extra_channels)
        if (channel.quantity, channel.body) in alike and channel.sign is not None
    )
    return tuple(name for name in (*stimulus.channels, *declared) if name in rig.channels)


@dataclass(frozen=True, eq=False)
class TapResponse:
    """Response to a stimulus in the unit of each sensor, (channel, sample).

    `noise_rms` is that of each channel at rest. The first `rest_samples` samples precede the
    stimulus and give the mean at rest (`is_disturbed` if the stimulus came too early). `rest_means`
    is the mean of each channel before the operator was prompted.
    """

    rig: RigConfig
    rate_hz: float
    values: Float2D
    noise_rms: Float1D
    rest_samples: int
    rest_means: Float1D | None = None

    def swing(self, channel: str) -> Float1D:
        """Return a channel minus its mean at rest, (sample,); lost samples are 0."""
        row = self.values[self.rig.channels.index(channel)]
        return np.nan_to_num(row - self._rest_mean(channel))

    def _rest_mean(self, channel: str) -> float:
        """Return the mean of a channel at rest; NaN without samples."""
        row = self.values[self.rig.channels.index(channel)]
        return finite_mean(row[: self.rest_samples])

    def min_swing(self, channel: str) -> float:
        """Return the smallest detectable swing in the sensor's unit."""
        row = self.rig.channels.index(channel)
        sensor = self.rig.sensors[row]
        noise = float(np.nan_to_num(self.noise_rms[row]))
        return MIN_SWING_SNR * max(noise, sensor.lsb, MIN_NOISE_RANGE * sensor.range)

    def find_first_swing(self, channel: str) -> tuple[int, float] | None:
        """Find (sample, value) of the first swing after the samples at rest; None if unclear."""
        swing = self.swing(channel)[self.rest_samples :]
        largest = float(np.abs(swing).max(initial=0.0))
        if largest < self.min_swing(channel):
            return None
        onset = int(
            np.argmax(np.abs(swing) >= max(FIRST_SWING_RATIO * largest, self.min_swing(channel)))
        )
        return self.rest_samples + onset, float(swing[onset])

    def largest_swing(self, channel: str) -> float:
        """Return the largest swing after the samples at rest, in the sensor's unit."""
        return float(np.abs(self.swing(channel)[self.rest_samples :]).max(initial=0.0))

    def is_channel_disturbed(self, channel: str) -> bool:
        """Return True if the channel swings at rest, or is a load cell that is still pressed."""
        row = self.rig.channels.index(channel)
        rest_swing = self.swing(channel)[: self.rest_samples]
        if np.abs(rest_swing).max(initial=0.0) >= self.min_swing(channel):
            return True
        if self.rest_means is None or self.rig.channel_by_name[channel].unit != "N":
            return False
        min_shift = max(MIN_PRESS_RANGE * self.rig.sensors[row].range, self.min_swing(channel))
        return abs(self._rest_mean(channel) - float(self.rest_means[row])) >= min_shift


def is_disturbed(stimulus: Stimulus, response: TapResponse) -> bool:
    """Return True if the samples at rest are disturbed by this or the previous stimulus."""
    names = stimulus.channels if stimulus.shunt else _same_unit_channels(stimulus, response.rig)
    return any(response.is_channel_disturbed(name) for name in names)


def find_tap_onset(stimulus: Stimulus, response: TapResponse) -> int | None:
    """Find the first sample of the response in any channel of the same unit, or None."""
    if stimulus.shunt:
        row = response.rig.channels.index(stimulus.channels[0])
        shunt = response.rig.sensors[row].shunt or math.inf
        shifted = np.abs(
            response.swing(stimulus.channels[0])[response.rest_samples :]
        ) >= MIN_SHUNT_RATIO * abs(shunt)
        return response.rest_samples + int(np.argmax(shifted)) if shifted.any() else None
    onsets = [
        first[0]
        for name in _same_unit_channels(stimulus, response.rig)
        if (first := response.find_first_swing(name))
    ]
    return min(onsets, default=None)


def evaluate_tap(
    stimulus: Stimulus, response: TapResponse | None, reason: str
) -> tuple[CheckLine, ...]:
    """Evaluate the response to one stimulus; not tested if it is None or disturbed.

    `reason` explains a missing response.
    """
    if response is not None and is_disturbed(stimulus, response):
        response = None
        reason = (
            "a sensor moved before the prompt or was not released; repeat, and wait for the "
            f"prompt: {stimulus.prompt}"
        )
    if response is None:
        check_name = "shunt" if stimulus.shunt else "polarity"
        return tuple(mark_untested(check_name, name, reason) for name in stimulus.channels)
    return tuple(
        _check_shunt(stimulus, response) if stimulus.shunt else _check_tap(stimulus, response)
    )


def _same_unit_channels(stimulus: Stimulus, rig: RigConfig) -> tuple[str, ...]:
    """List the channels of the stimulus and all others of the same unit (none for lengths)."""
    registry = rig.channel_by_name
    unit = registry[stimulus.channels[0]].unit
    channels = (name for name in rig.channels if registry[name].unit == unit and unit != "m")
    return tuple(dict.fromkeys((*stimulus.channels, *channels)))


def _check_tap(stimulus: Stimulus, response: TapResponse) -> Iterator[CheckLine]:
    """Check sign, delay and placement of each channel that a tap or press moves.

    The delay of load cells is not checked: a press may load two cells one after the other.
    """
    registry = response.rig.channel_by_name
    unit = registry[stimulus.channels[0]].unit
    earliest = min(
        (swing[0] for name in stimulus.channels if (swing := response.find_first_swing(name))),
        default=0,
    )
    largest_channel, min_size = _find_largest_swing(stimulus, response)
    for name in stimulus.channels:
        sensor = response.rig.sensor(name)
        first_swing = response.find_first_swing(name)
        if largest_channel not in stimulus.channels and registry[name].unit == unit:
            size = response.largest_swing(name)
            remedy = (
                f"{largest_channel} responds more: check whether their cables, or their channels "
                "in the rig file, are swapped"
            )
            yield check_value("place", name, size, (min_size, math.inf), sensor.unit, remedy)
        if first_swing is None:
            reason = "it did not respond clearly: repeat with more force, or use the loop check"
            yield mark_untested("polarity", name, reason)
            continue
        remedy = "turn the sensor around, or change the sign of volts_per_unit in the rig file"
        # Left and tension are negative; the damper's cell has a convention of its own.
        value = first_swing[1] * (registry[name].sign or 1.0)
        yield check_value("polarity", name, value, (0.0, math.inf), sensor.unit, remedy)
        if unit != "N":
            delay_ms = 1e3 * (first_swing[0] - earliest) / response.rate_hz
            remedy = "it responds late: check its filter and the clock of its device"
            yield check_value("time after the first", name, delay_ms, DELAY_RANGE_MS, "ms", remedy)


def _find_largest_swing(stimulus: Stimulus, response: TapResponse) -> tuple[str, float]:
    """Find the channel of this unit with the largest response: (channel, size).

    `size` is in the unit of the first channel of the stimulus.
    """
    registry = response.rig.channel_by_name
    unit = response.rig.sensor(stimulus.channels[0]).si_per_unit
    sizes = {
        name: response.rig.sensor(name).si_per_unit * response.largest_swing(name)
        for name in _same_unit_channels(stimulus, response.rig)
        if registry[name].unit == registry[stimulus.channels[0]].unit
    }
    largest_channel = max(sizes, key=sizes.__getitem__)
    return largest_channel, sizes[largest_channel] / unit


def _check_shunt(stimulus: Stimulus, response: TapResponse) -> Iterator[CheckLine]:
    """Check the shift caused by a shunt: sign and gain of the whole measuring chain."""
    name = stimulus.channels[0]
    sensor = response.rig.sensor(name)
    expected, tolerance = sensor.shunt or 0.0, sensor.shunt_tolerance or 0.0
    settled = response.swing(name)[find_tap_onset(stimulus, response) :]
    shift = float(settled[round((1.0 - SHUNT_READ_SHARE) * settled.size) :].mean())
    allowed = (expected - tolerance, expected + tolerance)
    remedy = (
        "the sign is wrong: turn the sensor around, or change the sign of volts_per_unit"
        if shift * expected < 0
        else "check volts_per_unit, range and supply of the sensor (`shaketwin calibrate`)"
    )
    yield check_value("shunt", name, shift, allowed, sensor.unit, remedy)
