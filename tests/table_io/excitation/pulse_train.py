"""A kind of excitation as a laboratory would add it: one file, a train of cosine pulses."""

import numpy as np

from table_io.block import Float1D
from table_io.config.base import Count, Positive
from table_io.config.excitation import History, register_excitation


@register_excitation("pulse_train")
class PulseTrain(History):
    """Pulses (1 - cos) / 2 to the right, `period_s` apart."""

    height_mm: Positive
    width_s: Positive
    period_s: Positive
    pulses: Count = 3

    def displacement(self, rate_hz: float) -> Float1D:
        """Return the pulses one after another in m, (sample,)."""
        t = np.arange(round(self.pulses * self.period_s * rate_hz)) / rate_hz % self.period_s
        pulse = 0.5 * (1.0 - np.cos(2.0 * np.pi * t / self.width_s))
        return np.where(t < self.width_s, 1e-3 * self.height_mm * pulse, 0.0)
