"""Signals of a log as spectra, and their fusion into a motion for assumed sensor models.

Gain, lag and offset of a sensor are simple operations on its spectrum, so a fit can vary them.
"""

import math
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.polynomial import Polynomial
from scipy.fft import irfft
from scipy.integrate import cumulative_trapezoid
from scipy.ndimage import uniform_filter1d
from scipy.signal import spectrogram
from scipy.stats import chi2

from table_io.block import Block, Bool2D, Float1D, Int1D, Label, find_stretches, join_with_gaps
from table_io.channels import LEFT_CELLS, RIGHT_CELLS
from table_io.errors import InputError
from twin.compare.hum import remove_hum
from twin.compare.spectra import PAD_S, FrequencyGrid, Spectrum, exclude_margins
from twin.discovery.motion import ConsistencyResidual, MeasuredMotion, MotionNoise
from twin.discovery.noise import (
    RestNoise,
    compare_with_white,
    estimate_noise_density,
    find_loudest_power,
    find_shown_roll_off,
    measure_rest_noise,
    number_bands,
)
from twin.model.model import SensorModel

LOST_MARGIN_S = 0.3  # excluded around lost samples: the fusion spreads the interpolation error
FILL_ROUNDS = 20  # in which lost samples of a sensor approach what the other one of its body tells
OPEN_END_S = 0.5  # excluded at each end of the record
MIN_END_SAMPLES = 10  # from which an end of a record is continued
# Of the power of a drive with a single frequency: within this width, of the frequency, about it.
MIN_SINGLE_LINE_SHARE, SINGLE_LINE_WIDTH = 0.95, 0.05
# Power over that of the noise above which a band holds forces, and the share of the corner of a
# filter, or of the Nyquist frequency, up to which a channel is as it was measured.
MIN_BAND_RATIO, BAND_OF_FILTER = 4.0, 0.7
BAND_ROLL_OFF = 2.0  # end of the low pass of the motion over the end of that band
WIENER_SEGMENT_S, WIENER_LINES = 4.0, 9  # in which the power of a motion is averaged
EVENT_S, MAX_EVENT_CHANCE = 0.05, 1e-3  # a short event, and the probability that noise looks so
MAX_CHANCE_POWER = 3.0  # of the loudest of some tens of such averages of noise, over its mean
NOISE_SEED = 20_26, 0  # of the copy of the noise: the same recording gives the same verdict
MAX_NOISE_RATIO = 4.0  # noise in motion over that at rest: sensors that disagree more are faulty
BODY_SENSORS = (
    ("mass", "mass_disp_m", "mass_acc_m_s2"),
    ("table", "table_disp_m", "table_acc_m_s2"),
)
# Of the accelerations of which that of rel_disp_m is the sum.
RELATIVE_SIGNS = {"mass_acc_m_s2": 1.0, "table_acc_m_s2": -1.0}
SENSOR_PAIRS: Mapping[str, tuple[str, ...]] = {
    **{body: (laser, accelerometer) for body, laser, accelerometer in BODY_SENSORS},
    "mass against table": ("rel_disp_m", "mass_acc_m_s2", "table_acc_m_s2"),
}
CELL_PAIRS: Mapping[str, tuple[str, ...]] = {
    "right cells": RIGHT_CELLS,
    "left cells": LEFT_CELLS,
}
USED_CHANNELS = (
    "rel_disp_m", "mass_disp_m", "table_disp_m", "mass_acc_m_s2", "table_acc_m_s2",
    *RIGHT_CELLS, *LEFT_CELLS, "damper_force_n",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class LogSignals:
    """Signals of a log: spectrum and rms noise of each channel, specimen data and labels."""

    name: str
    mass_kg: float
    gaps_m: tuple[float, float]
    grid: FrequencyGrid
    omega: Float1D
    low_pass: Float1D
    unit_spectrum: Spectrum
    spectra: Mapping[str, Spectrum]
    noise: Mapping[str, Float1D]  # density, (frequency,): white noise of rms s has the density s
    rest_values: Mapping[str, tuple[float, float]]  # (mean, its std error) before the motion, SI
    time_s: Float1D
    step: Int1D
    label: Int1D
    cycle: Int1D
    good: Bool2D
    rest_noise: Mapping[str, RestNoise] = field(default_factory=dict)  # where there is a rest
    band_hz: float = math.inf  # highest frequency at which the measured forces exceed their noise
    motion_pass: Float1D | float = 1.0  # gain of a Wiener filter of the displacement, (frequency,)
    surface_noise_m: float = 0.0  # rms error of each laser in motion, besides its noise
    hum_hz: tuple[float, ...] = ()  # lines of the mains that were removed
    measured_sides: tuple[str, ...] = ()  # whose gaps load cells show, where none is stated
    shared_filter_hz: float = math.inf  # where all channels roll off, if there is no rest

    @property
    def channels(self) -> tuple[str, ...]:
        return tuple(self.spectra)

    def pass_of(self, row: str) -> Float1D:
        """Return the low pass of a row that compares sensors, (frequency,)."""
        return self.read_pass if row in CELL_PAIRS else self.low_pass

    @property
    def read_pass(self) -> Float1D:
        """Low pass of forces and accelerations as read, (frequency,).

        Forces keep their steps, as those of a model have them. Beside a second derivative, which
        has none, they are in its band.
        """
        return self.low_pass if derives_acc(self.channels) else self.grid.low_pass

    @property
    def in_whole_band(self) -> "LogSignals":
        """The signals up to the Nyquist frequency, with the steps of the forces as they are."""
        return replace(self, low_pass=self.grid.low_pass, band_hz=math.inf)

    @property
    def filter_hz(self) -> float:
        """Frequency where the slowest anti-alias filter begins to act; inf without one."""
        at_rest = (noise.roll_off_hz for noise in self.rest_noise.values())
        return min(at_rest, default=self.shared_filter_hz)

    @property
    def zero_channels(self) -> dict[str, tuple[tuple[str, float], ...]]:
        """Channels, with signs, that make up u, acc, table (its acceleration), right and left.

        Only tared quantities: those with a rest value of every channel.
        """
        displacements = (("mass_disp_m", 1.0), ("table_disp_m", -1.0))
        channels_of = {
            "u": displacements if "mass_disp_m" in self.spectra else (("rel_disp_m", 1.0),),
            "acc": (("mass_acc_m_s2", 1.0),),
            "table": (("table_acc_m_s2", 1.0),),
            "right": tuple((cell, 1.0) for cell in RIGHT_CELLS if cell in self.spectra),
            "left": tuple((cell, 1.0) for cell in LEFT_CELLS if cell in self.spectra),
        }
        return {
            name: channels
            for name, channels in channels_of.items()
            if channels and {channel for channel, _ in channels} <= self.rest_values.keys()
        }

    def channel_rms(self, channel: str) -> float:
        """Return the rms of a channel about its mean while the drive moves, SI."""
        values = self._values_in_motion(channel)
        return float(values.std()) if values.size else 0.0

    def _values_in_motion(self, channel: str) -> Float1D:
        return self.grid.to_time_domain(self.spectra[channel])[self.label != Label.REST]

    def largest_reading(self, channel: str) -> float:
        """Return the largest absolute reading of a channel while the drive moves, SI."""
        return float(np.abs(self._values_in_motion(channel)).max(initial=0.0))

    @property
    def relative_spectrum(self) -> Spectrum:
        """Spectrum of the displacement of the mass relative to the table, from the lasers alone."""
        if {"mass_disp_m", "table_disp_m"} <= self.spectra.keys():
            return self.spectra["mass_disp_m"] - self.spectra["table_disp_m"]
        return self.spectra["rel_disp_m"]

    def rest_value(self, name: str) -> tuple[float, float]:
        """Return (mean, standard error) of one of `zero_channels` at rest, SI.

        With precompression the readings at rest are real: the mean is then 0, because only the
        standard error of the tare is known.
        """
        rest = [(sign, *self.rest_values[channel]) for channel, sign in self.zero_channels[name]]
        pressed = min(self.gaps_m) <= 0
        mean = 0.0 if pressed else sum(sign * mean for sign, mean, _ in rest)
        return mean, float(np.hypot.reduce([sd for _, _, sd in rest])) / float(np.sqrt(2.0))

    def whitening(self, stiffness: float, damping: float) -> Float1D:
        """Return the whitening filter of the force balance without accelerometer, (frequency,).

        It is a gain per kg that makes the noise white with rms 1 where the acceleration of the mass
        comes from its displacement. The noise of u then enters through -w^2 u and K u + C u': for a
        stiffness in N/(m kg) and a damping in N s/(m kg) it is s_u |K - w^2 + i w C|, small where
        the signal is large.
        """
        displacement = "rel_disp_m" if "rel_disp_m" in self.noise else "mass_disp_m"
        s_u = self.noise[displacement] * np.abs(
            stiffness - self.omega**2 + 1j * self.omega * damping
        )
        gain: Float1D = self.low_pass / np.hypot(s_u, self.noise["table_acc_m_s2"])
        return gain / self.grid.white_noise_rms(self.low_pass)

    def balance_noise(self, stiffness: float, damping: float) -> float:
        """Return the rms noise in m/s2 of the force balance without accelerometer, per kg.

        The parameters are those of `whitening`: this is the noise that it makes white.
        """
        gain = self.whitening(stiffness, damping) * self.grid.white_noise_rms(self.low_pass)
        density = np.divide(self.low_pass, gain, out=np.zeros_like(gain), where=gain > 0)
        return self.grid.white_noise_rms(density * self.low_pass)

    def find_force_band(self) -> float:
        """Return the highest frequency in Hz at which the measured forces exceed their noise.

        The forces are those of inertia, of the load cells and of a component. Above it, and above
        the corner of an anti-alias filter, a residual holds noise alone.
        """
        hz, top = self.omega / (2.0 * np.pi), 0.0
        rate_hz = self.grid.rate_hz / self.grid.decimation
        moving = self.good & (self.label != Label.REST)
        if not moving.any():  # which whoever fits refuses
            return float(4.0 * hz[1])
        names = (*RIGHT_CELLS, *LEFT_CELLS, "damper_force_n", "mass_acc_m_s2")
        present = [name for name in names if name in self.spectra]
        for name in present or [name for name in ("table_acc_m_s2",) if name in self.spectra]:
            values = self.grid.to_time_domain(self.spectra[name] * self.low_pass)[moving]
            bands = find_loudest_power(values, rate_hz)
            noise = np.interp(bands.frequency, hz, self.noise[name]) / math.sqrt(
                self.grid.decimation
            )
            loud = bands.power > MIN_BAND_RATIO * noise**2
            top = max(top, float(bands.frequency[loud].max(initial=0.0)))
        limit = BAND_OF_FILTER * min(self.filter_hz, 0.5 * rate_hz)
        return max(min(top, limit), 4.0 * hz[1])

    @property
    def motion_density(self) -> Float1D:
        """Return the noise density in m of the displacement at its rate, (frequency,).

        The errors of the lasers in motion are slow: they lie in the band of the forces.
        """
        density = self._fusion.density / math.sqrt(self.grid.decimation)
        rate_hz = self.grid.rate_hz / self.grid.decimation
        count = 2 if "mass_disp_m" in self.spectra else 1
        slow = self.surface_noise_m * math.sqrt(count * 0.5 * rate_hz / self.band_hz)
        return np.hypot(density, slow)

    @property
    def motion_noise(self) -> MotionNoise:
        """Rms noise of the motion and of the forces, SI."""
        return self._fusion.motion_noise

    def with_louder_channels(self, scale: Mapping[str, Float1D]) -> "LogSignals":
        """Return the signals with the noise that the rows of sensors show, over that known.

        `scale` are factors by row, (band,).
        """
        bands = number_bands(self.omega / (2.0 * np.pi))
        noise = dict(self.noise)
        for row, channels in {**SENSOR_PAIRS, **CELL_PAIRS}.items():
            for channel in channels if row in scale else ():
                if channel in noise:
                    louder = self.noise[channel] * scale[row][bands]
                    noise[channel] = np.maximum(noise[channel], louder)
        return replace(self, noise=noise)

    def add_noise(self) -> "LogSignals":
        """Return the signals with noise of the known density added to every channel."""
        rng = np.random.default_rng(NOISE_SEED)
        spectra = {}
        for channel in self.channels:
            density = self.noise[channel] * math.sqrt(0.5 * self.grid.padded_size)
            parts = rng.standard_normal((2, density.size))
            spectra[channel] = self.spectra[channel] + density * (parts[0] + 1j * parts[1])
        return replace(self, spectra=spectra)

    def calibrate_noise(self) -> "LogSignals":
        """Return the signals with the noise of redundant sensors as loud as they disagree.

        No force law can make the two sensors of a body disagree: what exceeds the noise seen at
        rest is noise in motion (light spot, resolution, drift). Where no rest shows the noise,
        it is all that does, of the load cells of a side, too; and sensors without another one are
        as much louder than above the anti-alias filter, which is that of the logger.
        """
        is_known = bool(self.rest_noise)
        pairs = SENSOR_PAIRS if is_known else {**SENSOR_PAIRS, **CELL_PAIRS}
        noise = dict(self.noise)
        if not self.good.any():
            return self
        share = float(self.good.mean())
        ratios: dict[str, Float1D] = {}
        for residual in self.fuse_motion().consistency_residuals:
            channels = pairs.get(residual.body, ())
            # an offset would leak over the cuts at lost samples
            offset = residual.values[self.good].mean() if share < 1.0 else 0.0
            values = np.where(self.good, residual.values - offset, 0.0) / math.sqrt(share)
            ratio = np.sqrt(compare_with_white(values, self.pass_of(residual.body)))
            ratio = np.minimum(ratio, MAX_NOISE_RATIO) if is_known else ratio
            ratios |= dict.fromkeys(channels, ratio)
        if ratios and not is_known:
            usual = np.median(list(ratios.values()), axis=0)
            ratios = dict.fromkeys(noise, usual) | ratios
        noise |= {name: noise[name] * ratio for name, ratio in ratios.items() if name in noise}
        return replace(self, noise=noise)

    def fuse_motion(self, sensors: Sequence[SensorModel] = ()) -> MeasuredMotion:
        """Return the motion, assuming that these sensors read gain x value(t - lag) + offset.

        The noise is that of the readings as they are: scaled by an assumed gain, it would let the
        misfit shrink by its own denominator.
        """
        return self._fusion.fuse(self.spectra, sensors)

    def fuse_corrected(self, corrected: "LogSignals") -> MeasuredMotion:
        """Return the motion of corrected signals: with the noise of these, and most spectra."""
        return replace(self._fusion.fuse(corrected.spectra), gaps_m=corrected.gaps_m)

    @cached_property
    def _fusion(self) -> "_SensorFusion":
        return _SensorFusion(self)


def derives_acc(channels: Container[str]) -> bool:
    """Return True if the acceleration of the mass is derived from its displacement."""
    return "mass_acc_m_s2" not in channels and "table_acc_m_s2" in channels


def weigh_sensors(
    omega: Float1D, laser: Float1D, accelerometer: Float1D
) -> tuple[Float1D, Float1D, Float1D]:
    """Return the shares of both readings in a displacement, and the density of its noise in m.

    Each by frequency, (frequency,), as the densities given: the mean of both, weighted by the
    inverse of their variances. The share of the accelerometer is in s2.
    """
    square = omega**2
    variance = accelerometer**2 + square**2 * laser**2
    return (
        accelerometer**2 / variance,
        -square * laser**2 / variance,
        accelerometer * laser / np.sqrt(variance),
    )


def pass_motion(signals: LogSignals, u: Float1D, density: Float1D) -> Float1D:
    """Return the gain of a Wiener filter, (frequency,), of a motion u, (sample,).

    `density` is that of its noise, (frequency,), at the rate of u. What is loud in any part of
    the record passes: the frequency of a drive may change.
    """
    rate_hz = signals.grid.rate_hz / signals.grid.decimation
    size = min(round(WIENER_SEGMENT_S * rate_hz), u.size)
    hz, _, power = spectrogram(u, rate_hz, "hann", size, size // 2, detrend=False)
    power = uniform_filter1d(0.5 * rate_hz * power, WIENER_LINES, axis=0).max(axis=1)
    # noise alone exceeds its mean in a band by chance
    power = np.interp(signals.omega / (2.0 * np.pi), hz, power) - MAX_CHANCE_POWER * density**2
    power = np.maximum(power, 0.0)
    return power / np.maximum(power + density**2, 1e-300)


@dataclass(frozen=True, slots=True)
class _ChannelWeights:
    """Share of a displacement or acceleration in the fusion, gains by frequency, (frequency,)."""

    u: Float1D
    body: str = ""  # of its sensor-consistency residual
    consistency: Float1D | None = None


class _SensorFusion:
    """Minimum-variance fusion of displacement and acceleration spectra into one motion.

    It is linear: every channel adds its own series, (sample,), to those of the motion. The series
    of the channels as read are computed once; gain and offset of a sensor only scale and shift.
    """

    def __init__(self, signals: LogSignals) -> None:
        self.signals, self.noise = signals, signals.noise
        self.grid, self.omega, self.low_pass = signals.grid, signals.omega, signals.low_pass
        self.kept_share = self.grid.white_noise_rms(self.low_pass)
        self.weights: dict[str, _ChannelWeights] = {}
        self.sensitivity: dict[str, float] = {}  # of the consistency residuals
        if {"mass_disp_m", "table_disp_m"} <= signals.spectra.keys():
            densities = [
                self._weigh(body, sign, laser, {accelerometer: 1.0})
                for (body, laser, accelerometer), sign in zip(BODY_SENSORS, (1, -1), strict=True)
            ]
        else:
            densities = [self._weigh("mass against table", 1, "rel_disp_m", RELATIVE_SIGNS)]
        # what passes of the noise, and what is lost of the motion
        self.density = np.hypot.reduce(densities) * np.sqrt(signals.motion_pass)
        density = self.density * self.low_pass
        # the surface noise is too slow for the low pass
        surface = math.sqrt(len(densities)) * signals.surface_noise_m
        rms = self._filtered_rms
        self.motion_noise = MotionNoise(
            math.hypot(self.grid.white_noise_rms(density), surface),
            self.grid.white_noise_rms(self.omega * density),
            rms("mass_acc_m_s2"), self._side_noise(RIGHT_CELLS), self._side_noise(LEFT_CELLS),
            rms("damper_force_n"),
        )  # fmt: skip
        self.cell_noise = {side: self._side_noise(cells) for side, cells in CELL_PAIRS.items()}
        self.series: dict[str, dict[str, Float1D]] = {}
        self.unit_series: dict[str, dict[str, Float1D]] = {}  # of readings of 1 SI

    def _weigh(
        self, body: str, sign: int, laser: str, accelerometers: Mapping[str, float]
    ) -> Float1D:
        """Set the weights of the sensors of a body; return the density of its fused noise.

        With a `sign` for each accelerometer: mass less table, where the laser reads their distance.
        """
        s_x, motion_pass = self.noise[laser], self.low_pass * self.signals.motion_pass
        if not accelerometers.keys() <= self.signals.spectra.keys():
            self.weights[laser] = _ChannelWeights(sign * motion_pass)
            return s_x
        s_a, w2 = np.hypot.reduce([self.noise[name] for name in accelerometers]), self.omega**2
        laser_share, acc_share, density = weigh_sensors(self.omega, s_x, s_a)
        variance = s_a**2 + w2**2 * s_x**2
        residual = self.low_pass / np.sqrt(variance) / self.kept_share
        self.weights[laser] = _ChannelWeights(sign * laser_share * motion_pass, body, w2 * residual)
        for name, own_sign in accelerometers.items():
            self.weights[name] = _ChannelWeights(
                sign * own_sign * acc_share * motion_pass, body, own_sign * residual
            )
        self.sensitivity[body] = 1.0 / (float(np.sqrt(variance[0])) * self.kept_share)
        return density

    def fuse(
        self, spectra: Mapping[str, Spectrum], sensors: Sequence[SensorModel] = ()
    ) -> MeasuredMotion:
        """Return the motion of the spectra of all channels, for assumed sensors."""
        signals, assumed = self.signals, {sensor.channel: sensor for sensor in sensors}
        shares = {
            channel: self._read(channel, spectrum, assumed.get(channel))
            for channel, spectrum in spectra.items()
        }
        missing = np.full(signals.time_s.size, np.nan)

        def add(name: str, channels: Sequence[str] = USED_CHANNELS) -> Float1D:
            """Return the sum of one series of the channels that have it; NaN without any."""
            parts = [shares[c][name] for c in channels if c in shares and name in shares[c]]
            total = parts[0] if parts else missing
            if len(parts) > 1:
                total = parts[0] + parts[1]
                for part in parts[2:]:
                    total += part
            return total

        right, left = add("read", RIGHT_CELLS), add("read", LEFT_CELLS)
        noise = self.motion_noise
        # a side without a bumper needs no cells: its force is zero
        if np.isfinite(noise.right) and np.isnan(noise.left):
            left, noise = np.zeros(missing.size), replace(noise, left=0.0)
        elif np.isfinite(noise.left) and np.isnan(noise.right):
            right, noise = np.zeros(missing.size), replace(noise, right=0.0)
        consistency = [
            ConsistencyResidual(body, add(body), sensitivity)
            for body, sensitivity in self.sensitivity.items()
        ]
        for side, (first, second) in CELL_PAIRS.items():
            if {first, second} <= spectra.keys():
                difference = shares[first]["read"] - shares[second]["read"]
                difference /= self.cell_noise[side]
                consistency.append(ConsistencyResidual(side, difference))
        acc = add("read", ["mass_acc_m_s2"])
        if derives_acc(spectra):
            acc = add("relative acc") + add("read", ["table_acc_m_s2"])
        return MeasuredMotion(
            signals.name, self.grid.rate_hz / self.grid.decimation, signals.mass_kg,
            signals.gaps_m, signals.time_s, add("u"), add("v"), acc,
            add("read", ["table_acc_m_s2"]), add("read", ["table_disp_m"]), right, left,
            signals.step, signals.label, signals.cycle, signals.good, noise, tuple(consistency),
            add("read", ["damper_force_n"]) if "damper_force_n" in spectra else None,
        )  # fmt: skip

    def _read(
        self, channel: str, spectrum: Spectrum, sensor: SensorModel | None
    ) -> dict[str, Float1D]:
        """Return the series of a channel, of which the sensor reads gain x value(t - lag) + offset.

        Those of the channels as read are cached.
        """
        if sensor is not None and sensor.lag:
            tared = spectrum - sensor.offset * self.signals.unit_spectrum
            series = self._filter(channel, tared * np.exp(1j * self.omega * sensor.lag))
        elif spectrum is not self.signals.spectra[channel]:
            series = self._filter(channel, spectrum)
        else:
            if channel not in self.series:
                self.series[channel] = self._filter(channel, spectrum)
            series = self.series[channel]
        if sensor is not None and sensor.offset and not sensor.lag:
            if channel not in self.unit_series:
                self.unit_series[channel] = self._filter(channel, self.signals.unit_spectrum)
            unit = self.unit_series[channel]
            series = {name: values - sensor.offset * unit[name] for name, values in series.items()}
        if sensor is not None and sensor.gain != 1.0:
            series = {name: values / sensor.gain for name, values in series.items()}
        return series

    def _filter(self, channel: str, spectrum: Spectrum) -> dict[str, Float1D]:
        """Return the series of a channel: its share in u, v, ..., and the readings themselves."""
        series, weights = {}, self.weights.get(channel)
        if weights is not None:
            position = spectrum * weights.u
            series["u"] = self.grid.to_time_domain(position)
            series["v"] = self.grid.to_time_domain(1j * self.omega * position)
            if derives_acc(self.signals.spectra):
                series["relative acc"] = self.grid.to_time_domain(-(self.omega**2) * position)
            if weights.consistency is not None:
                series[weights.body] = self.grid.to_time_domain(spectrum * weights.consistency)
        if channel not in ("rel_disp_m", "mass_disp_m"):
            series["read"] = self.grid.to_time_domain(spectrum * self.signals.read_pass)
        return series

    def _filtered_rms(self, name: str) -> float:
        """Return the rms noise of a channel after the low pass, SI; NaN without the channel."""
        if name not in self.noise:
            return float("nan")
        return self.grid.white_noise_rms(self.noise[name] * self.signals.read_pass)

    def _side_noise(self, cells: tuple[str, ...]) -> float:
        """Return the rms noise of the force of a side in N; NaN without load cells."""
        present = [self._filtered_rms(name) for name in cells if name in self.signals.spectra]
        return float(np.hypot.reduce(present)) if present else float("nan")


def build_signals(
    blocks: tuple[Block, ...], name: str, mass_kg: float, gaps_m: tuple[float, float]
) -> LogSignals:
    """Build the signals of measured blocks; raise InputError if no displacement was measured."""
    if not blocks:
        raise InputError(
            "the log has no measured samples", where=name, remedy="give a recorded test"
        )
    block = join_with_gaps(blocks)
    columns = {
        key: block.channel(key)
        for key in USED_CHANNELS
        if key in block.channels and is_channel_alive(block.channel(key))
    }
    if find_unmeasured_side(columns, gaps_m):
        columns = {
            key: values for key, values in columns.items() if key not in (*RIGHT_CELLS, *LEFT_CELLS)
        }
    if "rel_disp_m" not in columns and not {"mass_disp_m", "table_disp_m"} <= columns.keys():
        raise InputError(
            "the displacement of the mass relative to the table was not measured",
            where=name,
            allowed="logs with rel_disp_m, or with mass_disp_m and table_disp_m",
        )
    at_rest = _find_rest(block)
    good = np.logical_and.reduce([np.isfinite(values) for values in columns.values()])
    grid = FrequencyGrid(len(block), block.rate_hz)
    lost_margin = round(LOST_MARGIN_S * block.rate_hz)
    usable = exclude_margins(good, lost_margin, lost_margin)
    frequency = grid.omega / (2 * np.pi * block.rate_hz)
    noise = {
        key: estimate_noise_density(values, at_rest, frequency) for key, values in columns.items()
    }
    margin = round(OPEN_END_S * block.rate_hz)
    # also where the drive rests: the mass may not yet
    usable[:margin], usable[-margin:] = False, False
    size = -(-len(block) // grid.decimation)
    measured = {
        key: measure_rest_noise(values, at_rest, block.rate_hz) for key, values in columns.items()
    }
    rest_noise = {key: value for key, value in measured.items() if value is not None}
    filled = _fill_lost(columns, grid, noise)
    ends = _continue_ends(filled, grid)
    spectra = {key: grid.to_spectrum(values, ends.get(key)) for key, values in filled.items()}
    without_hum, hum_hz = remove_hum(spectra, grid, at_rest, _find_drive_hz(block))
    signals = LogSignals(
        name, mass_kg, gaps_m, grid, grid.omega, grid.low_pass,
        grid.to_spectrum(np.ones(len(block))), without_hum, noise,
        _measure_rest(columns, at_rest, noise),
        (block.index + grid.decimation * np.arange(size)) / block.rate_hz,
        block.step[:: grid.decimation], block.label[:: grid.decimation],
        block.cycle[:: grid.decimation],
        usable[:: grid.decimation],
        rest_noise,
        hum_hz=hum_hz,
        shared_filter_hz=math.inf if rest_noise else max(
            find_shown_roll_off(values, block.rate_hz) for values in columns.values()
        ),
    )  # fmt: skip
    band_hz = signals.find_force_band()
    hz = grid.omega / (2.0 * np.pi)
    roll_off = np.clip((hz / band_hz - 1.0) / (BAND_ROLL_OFF - 1.0), 0.0, 1.0)
    low_pass = grid.low_pass * (0.5 + 0.5 * np.cos(np.pi * roll_off))
    signals = replace(signals, low_pass=low_pass, band_hz=band_hz)
    if derives_acc(columns):
        return signals
    u, density = signals.fuse_motion().u, signals.motion_density * low_pass
    gain = pass_motion(signals, u, density)
    removed = u - grid.apply_gain(u, gain)
    is_whole = _is_noise(signals, removed, density * (1.0 - gain))
    return replace(signals, motion_pass=gain) if is_whole else signals


def _list_fused(columns: Container[str]) -> Iterator[tuple[str, Mapping[str, float]]]:
    """Yield each laser that is fused with accelerometers, and the signs of these."""
    has_lasers = "mass_disp_m" in columns and "table_disp_m" in columns
    bodies = [(laser, {acc: 1.0}) for _, laser, acc in BODY_SENSORS]
    for laser, signs in bodies if has_lasers else [("rel_disp_m", RELATIVE_SIGNS)]:
        if all(name in columns for name in (laser, *signs)):
            yield laser, signs


def _continue_ends(
    columns: Mapping[str, Float1D], grid: FrequencyGrid
) -> dict[str, tuple[Float1D, Float1D]]:
    """Return what continues the sensors of a fused motion before and after the record, to rest.

    A displacement that ends off zero is a step, of which its accelerometer shows nothing: it would
    ring in the fused motion for as long as its slowest frequency that is taken from the latter.
    Both are continued by the same smooth motion, from where they end.
    """
    ends: dict[str, tuple[Float1D, Float1D]] = {}
    for laser, signs in _list_fused(columns):
        acc = np.sum([sign * columns[name] for name, sign in signs.items()], axis=0)
        after, back = (
            _continue_motion(columns[laser][::step], acc[::step], grid.rate_hz) for step in (1, -1)
        )
        first = next(iter(signs))
        silence = np.zeros(after[0].size)
        ends |= dict.fromkeys(signs, (silence, silence))
        ends[laser] = back[0][::-1], after[0]
        ends[first] = signs[first] * back[1][::-1], signs[first] * after[1]
    return ends


def _continue_motion(position: Float1D, acc: Float1D, rate_hz: float) -> tuple[Float1D, Float1D]:
    """Return displacement and acceleration of a motion that comes to rest after its record.

    A polynomial of fifth order, from the last position and velocity; these are those with which the
    integrated acceleration follows the displacement at the end of the record. What it is off by
    there as a parabola is an offset of the accelerometer, no motion.
    """
    size = min(round(OPEN_END_S * rate_hz), position.size)
    time = (np.arange(size) - size + 1.0) / rate_hz
    velocity = cumulative_trapezoid(np.nan_to_num(acc[-size:]), dx=1.0 / rate_hz, initial=0.0)
    moved = cumulative_trapezoid(velocity, dx=1.0 / rate_hz, initial=0.0)
    rest = position[-size:] - moved
    used = np.isfinite(rest)
    if used.sum() < MIN_END_SAMPLES:
        return np.zeros(0), np.zeros(0)
    _, slope, start = np.polyfit(time[used], rest[used], 2)
    x, v = start + moved[-1], slope + velocity[-1]
    length = 0.5 * PAD_S
    s = np.arange(1, round(length * rate_hz)) / (length * rate_hz)
    # x(0) and x'(0) as given; x''(0) = 0, for the last reading is mostly noise; and 0 at s = 1
    of_x = Polynomial([1.0, 0.0, 0.0, -10.0, 15.0, -6.0])
    of_v = Polynomial([0.0, 1.0, 0.0, -6.0, 8.0, -3.0])
    motion = x * of_x + v * length * of_v
    return motion(s), motion.deriv(2)(s) / length**2


def _fill_lost(
    columns: Mapping[str, Float1D], grid: FrequencyGrid, noise: Mapping[str, Float1D]
) -> dict[str, Float1D]:
    """Return the columns, (sample,) each, with lost samples as the other sensors of a body tell.

    A straight line in their place is an error of the fused motion for as long as its slowest
    frequency that is taken from an accelerometer, far beyond the margin that is excluded. A lost
    displacement follows the accelerations but for what is slower than its longest lost stretch.
    """
    filled = dict(columns)
    for laser, signs in _list_fused(columns):
        is_lost = {name: np.isnan(columns[name]) for name in (laser, *signs)}
        lossy = [name for name in signs if is_lost[name].any()]
        is_alone = is_lost[laser] & ~np.logical_or.reduce([is_lost[name] for name in signs])
        longest = max((end - first for first, end in find_stretches(is_alone)), default=1)
        acc_noise = np.hypot.reduce([noise[name] for name in signs])
        loud = np.maximum(noise[laser], acc_noise / (np.pi * grid.rate_hz / longest) ** 2)
        shares, slow_shares = (
            weigh_sensors(grid.omega, density, acc_noise) for density in (noise[laser], loud)
        )
        for _ in range(FILL_ROUNDS if lossy or is_lost[laser].any() else 0):
            spectra = {name: grid.to_spectrum(filled[name]) for name in is_lost}
            acc = np.sum([sign * spectra[name] for name, sign in signs.items()], axis=0)
            u, slow_u = (
                grid.low_pass * (of_laser * spectra[laser] + of_acc * acc)
                for of_laser, of_acc, _ in (shares, slow_shares)
            )
            excess = grid.low_pass * acc + grid.omega**2 * u
            corrected = {name: spectra[name] - signs[name] / len(lossy) * excess for name in lossy}
            for name, spectrum in {laser: u, **corrected}.items():
                values = irfft(spectrum, grid.padded_size)[: grid.size]
                filled[name] = np.where(is_lost[name], values, filled[name])
            values = irfft(slow_u, grid.padded_size)[: grid.size]
            filled[laser] = np.where(is_alone, values, filled[laser])
    return filled


def _find_drive_hz(block: Block) -> Float1D:
    """Return the frequency of the drive in Hz, (sample,), by the cycles of its steps; else NaN."""
    drive_hz = np.full(len(block), np.nan)
    for number in np.unique(block.step[block.cycle >= 0]):
        in_step = block.step == number
        cycles = block.cycle[in_step & (block.cycle >= 0)]
        drive_hz[in_step] = np.unique(cycles).size / cycles.size * block.rate_hz
    return drive_hz


def _is_noise(signals: LogSignals, values: Float1D, density: Float1D) -> bool:
    """Return False if a series, (sample,), is louder than noise of a density for a short time.

    A filter of the whole record takes a short event for noise.
    """
    grid = signals.grid
    size = max(round(EVENT_S * grid.rate_hz / grid.decimation), 1)
    power = density**2
    share = float(power.sum() ** 2 / max(power.size * (power @ power), 1e-300))
    freedom = max(size * share, 1.0)
    local = uniform_filter1d(values**2, size)[signals.good]
    chance = MAX_EVENT_CHANCE * size / max(local.size, size)
    expected = (grid.white_noise_rms(density) * math.sqrt(grid.decimation)) ** 2
    return float(local.max(initial=0.0)) <= chi2.isf(chance, freedom) / freedom * expected


def find_single_frequency(signals: LogSignals) -> float | None:
    """Return the frequency of the drive in Hz if most of its power lies about one line, else None.

    The drive is the motion of the table where it was measured, else that of the mass.
    """
    table = ("table_acc_m_s2", "table_disp_m")
    channel = next((name for name in table if name in signals.channels), "rel_disp_m")
    values = signals.grid.to_time_domain(signals.spectra[channel])[signals.label != Label.REST]
    window = np.hanning(values.size)
    power = np.abs(np.fft.rfft((values - values.mean()) * window)) ** 2
    if not power.sum() > 0:
        return None
    line = np.arange(power.size)
    main = int(power[1:].argmax()) + 1
    about_main = np.abs(line - main) <= max(SINGLE_LINE_WIDTH * main, 3.0)
    if power[about_main].sum() <= MIN_SINGLE_LINE_SHARE * power.sum():
        return None
    return main * signals.grid.rate_hz / signals.grid.decimation / values.size


def find_unmeasured_side(channels: Container[str], gaps_m: tuple[float, float]) -> str:
    """Return "right" or "left" if only the other side's bumper force was measured, else "".

    Half of the bumper forces is worse than none: the balance of the mass gives their sum. A side
    without a bumper needs no cells.
    """
    sides = {"right": (RIGHT_CELLS, gaps_m[0]), "left": (LEFT_CELLS, gaps_m[1])}
    measured = {side for side, (cells, _) in sides.items() if any(c in channels for c in cells)}
    missing = [side for side, (_, gap) in sides.items() if gap < np.inf and side not in measured]
    return missing[0] if measured and missing else ""


def is_channel_alive(values: Float1D) -> bool:
    """Return False for a dead channel: no samples, or a constant value."""
    finite = values[np.isfinite(values)]
    return bool(finite.size and np.ptp(finite) > 0.0)


def _find_rest(block: Block) -> Bool2D:
    """Find the samples at rest before the motion, (sample,): there all readings are noise."""
    moving = np.flatnonzero(block.label != Label.REST)
    at_rest = np.zeros(len(block), dtype=bool)
    at_rest[: moving[0] if moving.size else 0] = True
    return at_rest


def _measure_rest(
    columns: Mapping[str, Float1D], at_rest: Bool2D, noise: Mapping[str, Float1D]
) -> dict[str, tuple[float, float]]:
    """Return (mean, std error) of each tared channel at rest, SI, with the tare's own error.

    The force of a damper is none: friction or a preload may hold one at rest.
    """
    rest_values = {}
    for key, values in columns.items():
        finite = values[at_rest & np.isfinite(values)]
        if finite.size >= 100 and key != "damper_force_n":
            rest_values[key] = (
                float(finite.mean()),
                float(noise[key][1]) * float(np.sqrt(2.0 / finite.size)),
            )
    return rest_values
