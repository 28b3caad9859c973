"""Random: band-limited noise of a stated rms acceleration, the same for the same seed."""

from typing import ClassVar

import numpy as np
from pydantic import Field, ValidationInfo, field_validator

from table_io.block import Float1D
from table_io.config.base import Count, Number, Positive
from table_io.config.excitation import History, register_excitation
from table_io.config.excitation.waveform import smoothstep
from table_io.errors import InputError
from table_io.units import GRAVITY_M_S2

MAX_BAND_SHARE = 0.4  # of the sampling rate
MIN_LINES = 8  # spectral lines in the band


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
        if self.high_hz > MAX_BAND_SHARE * rate_hz:
            raise InputError(
                f"too high for {rate_hz:g} samples per second",
                where=f"excitation {self.kind!r}",
                key="high_hz",
                value=self.high_hz,
                allowed=f"up to {MAX_BAND_SHARE * rate_hz:g}",
            )
        count, ramp = round(self.duration_s * rate_hz), round(self.ramp_s * rate_hz)
        f = np.fft.rfftfreq(count, 1.0 / rate_hz)
        lines = np.flatnonzero((f >= self.low_hz) & (f <= self.high_hz))
        corner_hz = self.corner_hz or self.low_hz
        amplitude = np.minimum(f[lines] / corner_hz, 1.0)
        rms = self.rms_g * GRAVITY_M_S2
        amplitude *= rms / np.sqrt(0.5 * (amplitude @ amplitude))
        raw = np.random.PCG64(self.seed).random_raw(lines.size)
        phase = 2.0 * np.pi * (np.asarray(raw, dtype=np.uint64) >> np.uint64(11)) * 2.0**-53
        spectrum = np.zeros(f.size, dtype=np.complex128)
        spectrum[lines] = -amplitude / (2.0 * np.pi * f[lines]) ** 2 * np.exp(1j * phase)
        period = np.fft.irfft(spectrum, count) * (count / 2.0)
        played = np.take(period, np.arange(-ramp, count + ramp + 1), mode="wrap")
        x = np.arange(played.size)
        return played * smoothstep(x / ramp) * smoothstep((played.size - 1 - x) / ramp)
