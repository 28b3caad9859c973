"""Half-sine shock: an acceleration pulse, compensated so that the table ends where it began."""

from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from table_io.block import Float1D
from table_io.config.base import Count, NonNegative, Number, Positive
from table_io.config.excitation import History, register_excitation
from table_io.config.excitation.waveform import repeat_with_pauses
from table_io.errors import InputError
from table_io.units import GRAVITY_M_S2

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
