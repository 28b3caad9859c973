"""Contact of the bumpers that load cells show."""

import math

import numpy as np
import numpy.typing as npt
from scipy.ndimage import binary_opening

from twin.discovery.motion import MeasuredMotion
from twin.discovery.signals import LogSignals

MEDIAN_OF_NORMAL = 0.6745  # of the magnitude of a normal variable, over its standard deviation
CONTACT_NOISE_FACTOR = 8.0  # times the rms noise of a load cell: above it there is contact
MIN_CONTACT_SHARE = 0.02  # of the rms inertia force: below it a load cell shows no contact
# A shorter contact is the ringing of a filter before or after a step of the force.
MIN_CONTACT_SAMPLES, MIN_CONTACT_FILTER_CYCLES = 3, 0.5


def find_contact_thresholds(
    signals: LogSignals, m: MeasuredMotion, least_n: float
) -> tuple[float, float]:
    """Return the force of the right and of the left cells in N above which there is contact.

    Bumpers push: without a rest, what the cells read below zero shows their noise.
    """
    squares = np.nan_to_num(m.acc[m.moving] ** 2)
    inertia_n = m.mass_kg * math.sqrt(squares.mean()) if squares.size else 0.0
    least = max(least_n, MIN_CONTACT_SHARE * inertia_n)
    thresholds = []
    for push, rms in ((m.right, m.noise.right), (m.left, m.noise.left)):
        below = push[m.moving & (push < 0.0)] if not signals.rest_noise else push[:0]
        shown = -float(np.median(below)) / MEDIAN_OF_NORMAL if below.size else 0.0
        thresholds.append(max(least, CONTACT_NOISE_FACTOR * max(rms, shown)))
    return thresholds[0], thresholds[1]


def read_contact(
    signals: LogSignals, m: MeasuredMotion, thresholds_n: tuple[float, float]
) -> npt.NDArray[np.int8]:
    """Return the contact of right and left that the load cells show, (2, sample): 1 or 0."""
    sides = []
    shortest = max(
        MIN_CONTACT_SAMPLES,
        math.ceil(MIN_CONTACT_FILTER_CYCLES * m.rate_hz / signals.filter_hz) + 1,
    )
    for push, threshold, gap in zip((m.right, m.left), thresholds_n, m.gaps_m, strict=True):
        idle = float(np.median(push[~m.moving])) if gap > 0 and (~m.moving).any() else 0.0
        sides.append(binary_opening(push - idle > threshold, np.ones(shortest)))
    return np.array(sides, dtype=np.int8)
