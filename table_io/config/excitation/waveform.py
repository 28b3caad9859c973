"""Parts of the synthetic kinds: quintic blend, varying frequency, level over frequency."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from table_io.block import Float1D
from table_io.config.base import Positive
from table_io.errors import InputError

LevelPoints = tuple[tuple[Positive, Positive], ...]  # (frequency in Hz, level in g)
LEVEL_TOLERANCE = 1e-9  # of a frequency, at the ends of the break points


def smoothstep(x: Float1D) -> Float1D:
    """Return the quintic blend from 0 to 1 over x = 0 to 1, constant outside, (x,).

    Its first and second derivatives are 0 at both ends.
    """
    x = np.clip(x, 0.0, 1.0)
    return x**3 * (10.0 + x * (-15.0 + 6.0 * x))


def integrate_frequency(frequency_hz: Float1D, rate_hz: float) -> Float1D:
    """Return the phase in rad from 0 of a varying frequency, (sample,), by the trapezoidal rule."""
    steps = 0.5 * (frequency_hz[1:] + frequency_hz[:-1]) / rate_hz
    return 2.0 * np.pi * np.concatenate([[0.0], np.cumsum(steps)])


def repeat_with_pauses(pulse: Float1D, count: int, pause: int) -> Float1D:
    """Return a pulse from rest to rest `count` times with `pause` samples between, (sample,)."""
    gap = np.zeros(pause)
    parts = [part for _ in range(count) for part in (pulse, gap)]
    return np.concatenate(parts[: 2 * count - 1])


def interpolate_level(points: LevelPoints, frequency_hz: Float1D) -> Float1D:
    """Return the level in g at frequencies, (frequency,), linear in the logarithms of both."""
    f, level = np.log(np.array(points)).T
    return np.exp(np.interp(np.log(frequency_hz), f, level))


def check_level_points(points: LevelPoints, ends_hz: Sequence[float]) -> None:
    """Raise InputError unless break points ascend and cover the frequencies `ends_hz`."""
    frequencies = [f for f, _ in points]
    if len(points) == 1:
        raise InputError("level_points has one point", allowed="at least two, or acceleration_g")
    if any(after <= before for before, after in pairwise(frequencies)):
        raise InputError(
            f"the frequencies of level_points, {', '.join(f'{f:g}' for f in frequencies)} Hz, do "
            "not ascend",
            allowed="[[frequency in Hz, level in g], ...] in ascending order",
        )
    low, high = min(ends_hz), max(ends_hz)
    tolerance = LEVEL_TOLERANCE * high
    if frequencies and (frequencies[0] > low + tolerance or frequencies[-1] < high - tolerance):
        raise InputError(
            f"level_points ends at {frequencies[0]:g} and {frequencies[-1]:g} Hz",
            allowed=f"points that cover {low:g} to {high:g} Hz",
            remedy="add a point at each end",
        )
