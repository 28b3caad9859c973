"""Static checks: samples, noise, hum, offset, drift and cross-talk of every input at rest.

Values are in the unit of each sensor in the rig file. No check needs an operator or a motion.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from table_io.block import Float1D, Float2D
from table_io.config.rig import RigConfig
from table_io.config.sensor import SensorConfig
from table_io.safety.wiring_check.check_line import CheckLine, check_value, mark_untested
from table_io.safety.wiring_check.mains_hum import MainsHum, fit_mains_hum

MAX_LOST_PERCENT = 0.0  # of the samples
RAIL_RATIO = 0.999  # of the range
MAX_STUCK_S = 0.25  # of equal samples, if the noise is at least half a step
NOISE_RATIO_RANGE = (0.25, 2.0)  # of the noise stated in the rig file
MIN_BITS = 8.0  # effective bits
MAX_HUM_RANGE = 1e-3  # of the range, if the rig file states no noise
MAX_OFFSET_RANGE = 0.2
MAX_DRIFT_RANGE = 1e-3  # from the first quarter to the last
MAX_SPIKE_RATIO = 8.0  # times the rms noise
MAX_CORRELATION = 0.5  # of the noise of two channels
MAX_ZERO_LSB, MAX_ZERO_SPAN = (
    4.0,
    1e-3,
)  # command at rest: steps of both converters, and fraction of the span
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
        return np.array([_finite_mean(row) for row in self.values])

    @cached_property
    def noise_rms(self) -> Float1D:
        """Noise rms of each channel about its mean, (channel,); NaN where it is lost."""
        return np.array([_finite_std(row) for row in self.values])

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


def _finite_mean(row: Float1D) -> float:
    finite = row[np.isfinite(row)]
    return float(finite.mean()) if finite.size else math.nan


def _finite_std(row: Float1D) -> float:
    finite = row[np.isfinite(row)]
    return float(finite.std()) if finite.size else math.nan


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
        railed_percent = 100.0 * float(np.mean(np.abs(values) >= RAIL_RATIO * sensor.range))
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
    first, last = _finite_mean(values[:quarter]), _finite_mean(values[-quarter:])
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
