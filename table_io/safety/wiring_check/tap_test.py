"""Tap test and shunt calibration: polarity, placement and timing of each sensor.

Nothing is commanded. The operator taps or presses to the right, or switches a shunt on; the first
swing of each channel must have the sign of its definition (right, or compression, positive).
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from table_io.block import Float1D, Float2D
from table_io.channels import LEFT_CELLS, RIGHT_CELLS
from table_io.config.rig import RigConfig
from table_io.safety.wiring_check.check_line import CheckLine, check_value, mark_untested

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
        row = self.values[self.rig.channels.index(channel)][: self.rest_samples]
        finite = row[np.isfinite(row)]
        return float(finite.mean()) if finite.size else math.nan

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
        response, reason = (
            None,
            "a sensor moved before the prompt or was not released; repeat, and wait for the "
            f"prompt: {stimulus.prompt}",
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
        sensor = response.rig.sensors[response.rig.channels.index(name)]
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
    unit = response.rig.sensors[response.rig.channels.index(stimulus.channels[0])].si_per_unit
    sizes = {
        name: response.rig.sensors[response.rig.channels.index(name)].si_per_unit
        * response.largest_swing(name)
        for name in _same_unit_channels(stimulus, response.rig)
        if registry[name].unit == registry[stimulus.channels[0]].unit
    }
    largest_channel = max(sizes, key=sizes.__getitem__)
    return largest_channel, sizes[largest_channel] / unit


def _check_shunt(stimulus: Stimulus, response: TapResponse) -> Iterator[CheckLine]:
    """Check the shift caused by a shunt: sign and gain of the whole measuring chain."""
    name = stimulus.channels[0]
    sensor = response.rig.sensors[response.rig.channels.index(name)]
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
