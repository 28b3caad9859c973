"""Cyclic protocol: blocks of sine cycles of stated displacement, as in quasi-static tests."""

from typing import ClassVar

import numpy as np
from pydantic import Field

from table_io.block import Float1D
from table_io.config.base import Count, Number, Positive
from table_io.config.excitation import MIN_BLEND_CYCLES, History, register_excitation
from table_io.config.excitation.waveform import integrate_frequency, smoothstep


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
