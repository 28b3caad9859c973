"""Main branches of a model: those that a slow sweep from rest meets, in a fraction of a second.

`diagram.compute_diagram` looks for all others too: longer periods, isolas, mirrored motions.
"""

import math
from collections.abc import Iterable

import numpy as np

from twin.dynamics.continuation import Branch, continue_branch
from twin.dynamics.diagram import lies_on
from twin.dynamics.orbits import OrbitProblem, settle_to_orbit
from twin.dynamics.period_map import (
    FREQUENCY,
    ClosedFormPeriodMap,
    PeriodMap,
    make_period_map,
)
from twin.model.model import Model

MIN_SWEEP_STEPS = 3  # over which branches say something
VALUE_COUNT = 9  # of the parameter at which a motion settles, spread evenly


def follow_main_branches(
    period_map: PeriodMap,
    limits: tuple[float, float],
    acceleration_m_s2: float,
    *,
    parameter: str = FREQUENCY,
    frequency_hz: float = math.nan,
    values: int = VALUE_COUNT,
) -> tuple[Branch, ...]:
    """Follow the branches of the stable orbits of period 1 that are met from rest, over `limits`.

    Arguments as in `diagram.compute_diagram`. From the upper end downwards, each from rest.
    """
    start_hz = limits[0] if parameter == FREQUENCY else frequency_hz
    problem = OrbitProblem(period_map, start_hz, acceleration_m_s2, 1, (parameter,))
    branches: list[Branch] = []
    for value in np.linspace(*limits, values)[::-1]:
        own_map, own_hz, level = problem.at([float(value)])
        orbit = settle_to_orbit(own_map, own_hz, level)
        if orbit is not None and not any(lies_on(orbit, branch) for branch in branches):
            branches.append(continue_branch(orbit, parameter, limits))
    return tuple(branches)


def follow_sweep_branches(
    model: Model, frequencies_hz: Iterable[float], levels_m_s2: Iterable[float]
) -> tuple[Branch, ...]:
    """Follow the main branches over the frequencies of a sweep, in a fraction of a second.

    None are returned where this would take longer, with force laws, and without a range of
    frequencies or one level.
    """
    frequencies, levels = set(frequencies_hz), set(levels_m_s2)
    period_map = make_period_map(model)
    if (
        len(frequencies) < MIN_SWEEP_STEPS
        or len(levels) != 1
        or not isinstance(period_map, ClosedFormPeriodMap)
    ):
        return ()
    limits = min(frequencies), max(frequencies)
    return follow_main_branches(period_map, limits, levels.pop(), values=3)
