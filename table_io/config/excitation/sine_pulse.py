"""Sine pulse: a few cycles of a sine that swell and fade, once or repeated as sine beats."""

from typing import ClassVar

import numpy as np
from pydantic import Field

from table_io.block import Float1D
from table_io.config.base import Count, NonNegative, Positive
from table_io.config.excitation import History, register_excitation
from table_io.config.excitation.waveform import repeat_with_pauses
from table_io.units import GRAVITY_M_S2

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
