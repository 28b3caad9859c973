"""Chirp: swept sine of continuously varying frequency, of constant level or by break points."""

from typing import ClassVar, Literal

import numpy as np
from pydantic import Field, ValidationInfo, field_validator

from table_io.block import Float1D
from table_io.config.base import Number, Positive
from table_io.config.excitation import History, register_excitation
from table_io.config.excitation.waveform import (
    LevelPoints,
    check_level_points,
    integrate_frequency,
    interpolate_level,
    smoothstep,
)
from table_io.errors import InputError
from table_io.units import GRAVITY_M_S2

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

    @field_validator("level_points")
    @classmethod
    def _check_points(cls, points: LevelPoints, info: ValidationInfo) -> LevelPoints:
        if points and {"start_hz", "stop_hz"} <= info.data.keys():
            check_level_points(points, (info.data["start_hz"], info.data["stop_hz"]))
        return points

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
