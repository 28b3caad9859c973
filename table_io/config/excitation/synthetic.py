"""Synthetic histories: noise, multisine, chirp, cyclic protocol, half-sine shock, sine pulse."""

from typing import ClassVar, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field, ValidationInfo, field_validator

from table_io.block import Float1D, Int1D
from table_io.config.base import Count, NonNegative, Number, Positive
from table_io.config.excitation import (
    DRIVE_MARGIN_S,
    MIN_BLEND_CYCLES,
    History,
    register_excitation,
)
from table_io.config.excitation.waveform import (
    LevelPoints,
    check_points_in_band,
    integrate_frequency,
    interpolate_level,
    repeat_with_pauses,
    smoothstep,
)
from table_io.errors import InputError
from table_io.units import GRAVITY_M_S2

MAX_BAND_SHARE = 0.4  # of the sampling rate
MIN_LINES = 8  # spectral lines in the band
DETECTION_GROUP = 4  # odd lines, of which a multisine leaves one out


@register_excitation("random")
class BandLimitedRandom(History):
    """Random-phase multisine: flat acceleration spectrum between two frequencies.

    Lines 1 / duration_s apart have equal amplitudes of acceleration and random phases; below
    `corner_hz` the amplitudes of velocity are equal instead, so that those of displacement rise
    with 1 / f and not with 1 / f^2. The rms over `duration_s` is exact. Source: Pintelon and
    Schoukens, System Identification, 2nd ed. 2012, section 5.2. The phases are raw numbers of the
    generator PCG64, which do not change between versions of numpy.
    """

    LEVEL_KEY: ClassVar[str] = "rms_g"

    low_hz: Positive = Field(description="Lower edge of the band.")
    high_hz: Positive = Field(description="Upper edge of the band.")
    rms_g: Positive = Field(0.02, description="Root mean square of the table acceleration.")
    corner_hz: Positive | None = Field(
        None, description="Below it the velocity is flat; omitted: the acceleration throughout."
    )
    duration_s: Number = Field(60.0, gt=0, le=3600, description="Without the ramps.")
    seed: Count = Field(1, ge=0, description="Of the random phases.")
    ramp_s: Number = Field(2.0, ge=0.1, le=60, description="From rest, and to rest.")

    @field_validator("high_hz")
    @classmethod
    def _check_band(cls, high: float, info: ValidationInfo) -> float:
        low = info.data.get("low_hz", 0.0)
        if high <= low:
            raise InputError(
                f"high_hz {high:g} is not above low_hz {low:g}", remedy="exchange them"
            )
        return high

    @field_validator("corner_hz")
    @classmethod
    def _check_corner(cls, corner: float | None, info: ValidationInfo) -> float | None:
        if corner is None or not {"low_hz", "high_hz"} <= info.data.keys():
            return corner
        low, high = info.data["low_hz"], info.data["high_hz"]
        if not low <= corner <= high:
            raise InputError(
                f"corner_hz {corner:g} lies outside the band", allowed=f"{low:g} to {high:g}"
            )
        return corner

    @field_validator("duration_s")
    @classmethod
    def _check_lines(cls, duration_s: float, info: ValidationInfo) -> float:
        if {"low_hz", "high_hz"} <= info.data.keys():
            width_hz = info.data["high_hz"] - info.data["low_hz"]
            if width_hz * duration_s < MIN_LINES:
                raise InputError(
                    f"duration_s {duration_s:g} is short for a band of {width_hz:g} Hz",
                    allowed=f"from {MIN_LINES / width_hz:.4g}",
                )
        return duration_s

    def displacement(self, rate_hz: float) -> Float1D:
        """Return the noise in m, between ramps that continue it periodically, (sample,)."""
        self._check_rate(rate_hz)
        return self._play(self._make_period(rate_hz, self.seed), rate_hz)

    def _check_rate(self, rate_hz: float) -> None:
        if self.high_hz > MAX_BAND_SHARE * rate_hz:
            raise InputError(
                f"too high for {rate_hz:g} samples per second",
                where=f"excitation {self.kind!r}",
                key="high_hz",
                value=self.high_hz,
                allowed=f"up to {MAX_BAND_SHARE * rate_hz:g}",
            )

    def list_lines(self, rate_hz: float) -> Int1D:
        """Return the numbers of the spectral lines that are excited, (line,), rising."""
        f = np.fft.rfftfreq(round(self.duration_s * rate_hz), 1.0 / rate_hz)
        return np.flatnonzero((f >= self.low_hz) & (f <= self.high_hz))

    def list_starts(self, rate_hz: float) -> npt.NDArray[np.int64]:
        """Return the first samples of the whole periods in its target, (realisation, period)."""
        before = DRIVE_MARGIN_S if self.drive is not None else 0.0
        return np.array([[round(before * rate_hz) + round(self.ramp_s * rate_hz)]])

    def _make_period(self, rate_hz: float, seed: int) -> Float1D:
        """Return a period with the phases of a seed in m, (sample,)."""
        count = round(self.duration_s * rate_hz)
        f, lines = np.fft.rfftfreq(count, 1.0 / rate_hz), self.list_lines(rate_hz)
        corner_hz = self.corner_hz or self.low_hz
        amplitude = np.minimum(f[lines] / corner_hz, 1.0)
        rms = self.rms_g * GRAVITY_M_S2
        amplitude *= rms / np.sqrt(0.5 * (amplitude @ amplitude))
        phase = 2.0 * np.pi * _draw_shares(seed, lines.size)
        spectrum = np.zeros(f.size, dtype=np.complex128)
        spectrum[lines] = -amplitude / (2.0 * np.pi * f[lines]) ** 2 * np.exp(1j * phase)
        return np.asarray(np.fft.irfft(spectrum, count) * (count / 2.0))

    def _play(self, period: Float1D, rate_hz: float, periods: int = 1) -> Float1D:
        """Return periods between ramps that continue them, in m, (sample,)."""
        ramp = round(self.ramp_s * rate_hz)
        played = np.take(period, np.arange(-ramp, periods * period.size + ramp + 1), mode="wrap")
        x = np.arange(played.size)
        return played * smoothstep(x / ramp) * smoothstep((played.size - 1 - x) / ramp)


def _draw_shares(seed: int, count: int) -> Float1D:
    """Return numbers from 0 to 1, (count,), that do not change between versions of numpy."""
    raw = np.random.PCG64(seed).random_raw(count)
    return np.asarray((np.asarray(raw, dtype=np.uint64) >> np.uint64(11)) * 2.0**-53)


@register_excitation("multisine")
class PeriodicMultisine(BandLimitedRandom):
    """Random-phase multisine played in periods, several times with new phases.

    The periods of a realisation differ by noise alone, the realisations by the distortion of a
    nonlinear table or specimen too. With `odd` only odd lines are excited, and one of each
    DETECTION_GROUP of them is left out at random: what comes there is odd distortion, on the even
    lines even distortion. Source: Pintelon and Schoukens (2012), sections 4.3.1 and 5.2.
    """

    duration_s: Number = Field(16.0, gt=0, le=600, description="Of a period.")
    periods: Count = Field(3, ge=2, le=100, description="Measured, after one that settles.")
    realisations: Count = Field(4, ge=2, le=100, description="With phases of their own.")
    odd: bool = Field(True, description="Leave out the even lines, and every fourth odd one.")

    def list_lines(self, rate_hz: float) -> Int1D:
        """Return the numbers of the spectral lines that are excited, (line,), rising."""
        lines = super().list_lines(rate_hz)
        if not self.odd:
            return lines
        lines = lines[lines % 2 == 1]
        groups = lines.size // DETECTION_GROUP
        left_out = (DETECTION_GROUP * _draw_shares(self.seed, groups)).astype(int)
        return np.delete(lines, DETECTION_GROUP * np.arange(groups) + left_out)

    def list_starts(self, rate_hz: float) -> npt.NDArray[np.int64]:
        """Return the first samples of the measured periods in its target, (realisation, period)."""
        count, ramp = round(self.duration_s * rate_hz), round(self.ramp_s * rate_hz)
        whole = (self.periods + 1) * count + 2 * ramp + 1
        first = super().list_starts(rate_hz) + whole * np.arange(self.realisations)[:, None]
        return np.asarray(first + count * np.arange(1, self.periods + 1))

    def displacement(self, rate_hz: float) -> Float1D:
        """Return all realisations in m, each from rest to rest, (sample,)."""
        self._check_rate(rate_hz)
        seeds = range(self.seed, self.seed + self.realisations)
        periods = [self._make_period(rate_hz, seed) for seed in seeds]
        return np.concatenate([self._play(own, rate_hz, self.periods + 1) for own in periods])


MIN_RAMP_S = 0.5
SMOOTHING_S = 1.0  # of the logarithm of the level, so that a break point is no jump of velocity
MAX_SWEEP_START_SHARE = 0.1  # of the duration, in which the rate of the sweep rises


@register_excitation("chirp")
class Chirp(History):
    """Swept sine between two frequencies, linear or logarithmic in time.

    d = -a(f) / (2 pi f)^2 sin(theta), theta the integral of 2 pi f dt; so the acceleration is
    a(f) sin(theta) up to terms of the order of the change of f in a cycle. The level rises at
    `start_hz`, then the frequency sweeps in `duration_s`, then the level falls at `stop_hz`.
    """

    LEVEL_KEY: ClassVar[str] = "acceleration_g"

    start_hz: Positive = Field(description="First frequency.")
    stop_hz: Positive = Field(description="Last frequency; below start_hz the sweep goes down.")
    duration_s: Number = Field(gt=0, le=3600, description="Of the sweep, without the ramps.")
    law: Literal["linear", "logarithmic"] = Field(
        "logarithmic", description="Of the frequency in time: Hz/s or octaves/s are constant."
    )
    acceleration_g: Positive = Field(0.05, description="Peak table acceleration.")
    level_points: LevelPoints = Field(
        (),
        max_length=100,
        validate_default=True,
        description="Instead of acceleration_g: [[frequency in Hz, level in g], ...], "
        "interpolated in logarithms.",
    )
    ramp_cycles: Number = Field(3.0, ge=1.5, le=100, description="Of the level, at either end.")

    @field_validator("stop_hz")
    @classmethod
    def _check_range(cls, stop: float, info: ValidationInfo) -> float:
        if stop == info.data.get("start_hz"):
            raise InputError("stop_hz is start_hz", remedy="sweep, or use kind sine_pulse")
        return stop

    _check_level_points = field_validator("level_points")(check_points_in_band)

    def displacement(self, rate_hz: float) -> Float1D:
        """Return the swept sine in m, (sample,)."""
        rise_s, fall_s = (
            max(self.ramp_cycles / f, MIN_RAMP_S) for f in (self.start_hz, self.stop_hz)
        )
        end_s = rise_s + self.duration_s + fall_s
        t = np.arange(round(end_s * rate_hz) + 1) / rate_hz
        share = self._sweep_share(t - rise_s)
        if self.law == "linear":
            frequency = self.start_hz + (self.stop_hz - self.start_hz) * share
        else:
            frequency = self.start_hz * (self.stop_hz / self.start_hz) ** share
        envelope = smoothstep(t / rise_s) * smoothstep((end_s - t) / fall_s)
        amplitude = self._level_m_s2(frequency, rate_hz) / (2.0 * np.pi * frequency) ** 2
        return -envelope * amplitude * np.sin(integrate_frequency(frequency, rate_hz))

    def _sweep_share(self, t: Float1D) -> Float1D:
        """Return the share of the sweep that is done, 0 to 1, at times in s from its start, (t,).

        Its rate is constant but for a quintic rise and fall, so the frequency has no kink.
        """
        blend_s = min(MAX_SWEEP_START_SHARE * self.duration_s, 2.0)
        t = np.clip(t, 0.0, self.duration_s)

        def integrate_ramp(x: Float1D) -> Float1D:
            x = np.clip(x, 0.0, 1.0)
            return x**4 * (2.5 + x * (x - 3.0))

        before = integrate_ramp(t / blend_s)
        after = integrate_ramp((self.duration_s - t) / blend_s)
        middle = np.clip(t, blend_s, self.duration_s - blend_s) - blend_s
        return (blend_s * (before + 0.5 - after) + middle) / (self.duration_s - blend_s)

    def _level_m_s2(self, frequency_hz: Float1D, rate_hz: float) -> Float1D:
        """Return the peak acceleration in m/s2 at each sample of a varying frequency, (sample,)."""
        if not self.level_points:
            return np.full(frequency_hz.size, self.acceleration_g * GRAVITY_M_S2)
        level = np.log(interpolate_level(self.level_points, frequency_hz))
        window = np.hanning(2 * round(0.5 * SMOOTHING_S * rate_hz) + 1)
        padded = np.pad(level, window.size // 2, mode="edge")
        smooth = np.convolve(padded, window / window.sum(), mode="valid")
        return np.exp(smooth) * GRAVITY_M_S2


@register_excitation("cyclic")
class CyclicProtocol(History):
    """Blocks of cycles of constant displacement and frequency, such as those of FEMA 461.

    Amplitude and frequency change by quintic blends between the blocks, in addition to the stated
    cycles, so that the velocity has no jump.
    """

    LEVEL_KEY: ClassVar[str] = "the amplitudes of protocol"

    protocol: tuple[tuple[Positive, Positive, Count], ...] = Field(
        min_length=1,
        max_length=1000,
        description="Blocks [[amplitude in mm, frequency in Hz, cycles], ...] in their order.",
    )
    blend_cycles: Number = Field(
        MIN_BLEND_CYCLES, ge=MIN_BLEND_CYCLES, le=20, description="Between blocks and at the ends."
    )

    def displacement(self, rate_hz: float) -> Float1D:
        """Return the blocks one after another in m, (sample,)."""
        knots = self._list_knots()
        times, amplitudes, frequencies = np.array(knots).T
        t = np.arange(round(times[-1] * rate_hz) + 1) / rate_hz
        after = np.clip(np.searchsorted(times, t, side="right"), 1, times.size - 1)
        share = smoothstep((t - times[after - 1]) / (times[after] - times[after - 1]))
        amplitude, frequency = (
            values[after - 1] + share * (values[after] - values[after - 1])
            for values in (amplitudes, frequencies)
        )
        return 1e-3 * amplitude * np.sin(integrate_frequency(frequency, rate_hz))

    def _list_knots(self) -> list[tuple[float, float, float]]:
        """Return (time in s, amplitude in mm, frequency in Hz) where each blend and hold begins."""
        time_s, before_mm, before_hz = 0.0, 0.0, self.protocol[0][1]
        knots = [(time_s, before_mm, before_hz)]
        for amplitude_mm, frequency_hz, cycles in self.protocol:
            if (amplitude_mm, frequency_hz) != (before_mm, before_hz):
                time_s += self.blend_cycles / (0.5 * (before_hz + frequency_hz))
                knots.append((time_s, amplitude_mm, frequency_hz))
            time_s += cycles / frequency_hz
            knots.append((time_s, amplitude_mm, frequency_hz))
            before_mm, before_hz = amplitude_mm, frequency_hz
        return [*knots, (time_s + self.blend_cycles / before_hz, 0.0, before_hz)]


MIN_PULSE_SAMPLES = 16


@register_excitation("half_sine")
class HalfSine(History):
    """Half-sine acceleration pulse between two pulses of compensation.

    The pulse of peak A and duration T has the area 2 A T / pi. A half-sine of the opposite sign,
    of peak r A and duration T / (2 r), before and another after it take half of this area each, so
    the velocity returns to zero; and since the acceleration is symmetric about the middle of the
    pulse, the velocity is antisymmetric and the displacement returns to zero too. Its peak is
    A T^2 (1 / (4 pi r) + 1 / pi^2). Source: pre- and post-pulse compensation of shock tests on
    shakers, Lalanne, Mechanical Vibration and Shock Analysis, volume 2, chapter 7.
    """

    LEVEL_KEY: ClassVar[str] = "acceleration_g"

    acceleration_g: Positive = Field(0.05, description="Peak of the pulse.")
    duration_s: Positive = Field(description="Of the pulse, without its compensation.")
    compensation: Number = Field(
        0.2, ge=0.05, le=1.0, description="Peak of the pulses before and after, over its own."
    )
    direction: Literal["right", "left"] = Field("right", description="Of the acceleration.")
    pulses: Count = Field(1, ge=1, le=100, description="One after another.")
    pause_s: NonNegative = Field(1.0, le=60, description="Rest between pulses.")

    def displacement(self, rate_hz: float) -> Float1D:
        """Return the pulses in m, (sample,)."""
        if self.duration_s * rate_hz < MIN_PULSE_SAMPLES:
            raise InputError(
                f"duration_s {self.duration_s:g} has fewer than {MIN_PULSE_SAMPLES} samples at "
                f"{rate_hz:g} Hz",
                where=f"excitation {self.kind!r}",
                allowed=f"from {MIN_PULSE_SAMPLES / rate_hz:g} s",
            )
        sign = 1.0 if self.direction == "right" else -1.0
        peak = sign * self.acceleration_g * GRAVITY_M_S2
        side_s = self.duration_s / (2.0 * self.compensation)
        middle_s = side_s + 0.5 * self.duration_s
        samples = int(np.ceil(middle_s * rate_hz))
        t = np.arange(samples + 1) / rate_hz  # before the middle of the pulse
        t = np.clip(t + middle_s - samples / rate_hz, 0.0, None)
        before = -self.compensation * peak * _integrate_half_sine(np.minimum(t, side_s), side_s)
        speed = -peak * self.duration_s / np.pi  # m/s, at the end of the compensation
        inside = np.clip(t - side_s, 0.0, None)
        rise = before + speed * inside + peak * _integrate_half_sine(inside, self.duration_s)
        pulse = np.concatenate([rise, rise[-2::-1]])
        return repeat_with_pauses(pulse, self.pulses, round(self.pause_s * rate_hz))


def _integrate_half_sine(t: Float1D, duration_s: float) -> Float1D:
    """Return the displacement from rest of the acceleration sin(pi t / duration), (t,)."""
    w = np.pi / duration_s
    return (t - np.sin(w * t) / w) / w


POINTS_PER_CYCLE = 1000  # where the peak acceleration is looked for


@register_excitation("sine_pulse")
class SinePulse(History):
    """Cycles of a sine under a sin^2 envelope, with a stated peak table acceleration.

    d = D sin^2(pi t / T) sin(2 pi f t) over T = cycles / f: displacement, velocity and
    acceleration begin and end at zero. Repeated, these are sine beats as in IEC 60068-2-59.
    """

    LEVEL_KEY: ClassVar[str] = "acceleration_g"

    frequency_hz: Positive = Field(description="Of the sine.")
    acceleration_g: Positive = Field(0.05, description="Peak table acceleration.")
    cycles: Count = Field(5, ge=1, le=100, description="In a pulse.")
    pulses: Count = Field(1, ge=1, le=100, description="One after another.")
    pause_s: NonNegative = Field(1.0, le=60, description="Rest between pulses.")

    def displacement(self, rate_hz: float) -> Float1D:
        """Return the pulses in m, (sample,)."""
        w = 2.0 * np.pi * self.frequency_hz
        beat = w / self.cycles
        duration_s = self.cycles / self.frequency_hz
        fine = np.linspace(0.0, duration_s, POINTS_PER_CYCLE * self.cycles + 1)
        curvature = 0.25 * (
            (w + beat) ** 2 * np.sin((w + beat) * fine)
            + (w - beat) ** 2 * np.sin((w - beat) * fine)
            - 2.0 * w**2 * np.sin(w * fine)
        )
        amplitude_m = self.acceleration_g * GRAVITY_M_S2 / np.abs(curvature).max()
        t = np.arange(round(duration_s * rate_hz) + 1) / rate_hz
        pulse = 0.5 * (1.0 - np.cos(beat * t)) * np.sin(w * t)
        pulse = np.where(t < duration_s, amplitude_m * pulse, 0.0)
        return repeat_with_pauses(pulse, self.pulses, round(self.pause_s * rate_hz))
