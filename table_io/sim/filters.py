"""Linear filters of sampled signals that keep their state: results do not depend on the division.

Each starts in the steady state of its first sample, so the signal is constant before sample 0.
"""

import math

import numpy as np

from table_io.block import Float1D, Float2D

CUBIC_POINTS = 4  # samples of the interpolation
SETTLING_TIME_CONSTANTS = 40.0  # e^-40 is below the rounding error


class FractionalDelay:
    """Delay of one channel by causal cubic interpolation; lag in samples, not necessarily whole."""

    def __init__(self, lag: float) -> None:
        self._whole_samples = max(math.floor(lag) - 1, 0)
        # Positions of the four samples relative to the delayed time.
        positions = self._whole_samples + np.arange(CUBIC_POINTS) - lag
        self._weights = [math.prod(a / (a - b) for a in positions if a != b) for b in positions]
        self._recent: Float1D | None = None

    def apply(self, values: Float1D) -> Float1D:
        """Return the values a lag earlier, (sample,)."""
        if values.size == 0:
            return values
        depth = self._whole_samples + CUBIC_POINTS - 1
        recent = np.full(depth, values[0]) if self._recent is None else self._recent
        known = np.concatenate([recent, values])
        self._recent = known[known.size - depth :]
        delayed: Float1D = np.zeros(values.size)
        for back, weight in enumerate(self._weights):
            delayed += weight * known[depth - self._whole_samples - back :][: values.size]
        return delayed


class AnalogFilter:
    """Continuous-time filter, exact for a signal that is linear between samples (ramp invariant).

    H(s) = gain prod (s - zero) / prod (s - pole) = direct + sum residue / (s - pole), with distinct
    poles of negative real part, in rad/s, and at most as many zeros. Each pole is integrated in
    closed form; of a conjugate pair, one pole and twice its real part.
    """

    def __init__(
        self, zeros: list[complex], poles: list[complex], gain: float, rate_hz: float
    ) -> None:
        from scipy.signal import lfilter  # slow to import, and few tables have such a filter

        self._run_section = lfilter
        self._direct = gain if len(zeros) == len(poles) else 0.0
        self._sections = []
        self.settling_samples = math.ceil(
            SETTLING_TIME_CONSTANTS * rate_hz / min(-np.real(pole) for pole in poles)
        )
        for pole in poles:
            if pole.imag < 0:
                continue
            residue = gain * math.prod((pole - zero for zero in zeros), start=1.0 + 0j)
            residue /= math.prod((pole - other for other in poles if other != pole), start=1.0 + 0j)
            step = pole / rate_hz
            growth = np.expm1(step)
            ramp = (growth - step) / (pole * step)  # response to a ramp from 0 to 1 over a sample
            weight = 2.0 if pole.imag > 0 else 1.0
            self._sections.append(
                (
                    weight * residue * np.array([ramp, growth / pole - ramp]),
                    np.array([1.0, -np.exp(step)]),
                    -weight * residue / pole,  # static gain
                )
            )
        self._states: list[np.ndarray] = []

    def apply(self, values: Float2D) -> Float2D:
        """Return the filtered values, (channel, sample) as given."""
        if values.shape[1] == 0:
            return values
        if not self._states:
            start = values[:, :1]
            self._states = [(static - b[0]) * start for b, _, static in self._sections]
        filtered: Float2D = self._direct * values
        for n, (b, a, _) in enumerate(self._sections):
            response, self._states[n] = self._run_section(b, a, values, axis=1, zi=self._states[n])
            filtered += response.real
        return filtered
