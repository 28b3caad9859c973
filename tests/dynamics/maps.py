"""Maps for tests: the model's, and some with known bifurcations."""

import math
from collections.abc import Callable
from typing import cast

import numpy as np

from tests.model.reference import AG, snm
from twin.dynamics.orbits import Orbit, find_orbit, settle_to_orbit
from twin.dynamics.period_map import ClosedFormPeriodMap, MapResult, PeriodMap
from twin.model.model import Model
from twin.model.parameters import Parameters

# x'' + 2 z x' + x + b (x - 1)+ = f cos wt: a memoryless bumper on one side
BILINEAR = Parameters(1.0, 1.0, 0.1, 29.0, 0.0, 1.0, 0.0, 1.0, math.inf)
BILINEAR_LEVEL = 0.9 * 0.64 / 1.26


def model_map(gap_m: float = 0.004, **changes: float) -> ClosedFormPeriodMap:
    """The map of the paper's model."""
    return ClosedFormPeriodMap(Model(snm(gap_m, **changes)))


def settle(period_map, frequency_hz: float, level: float = AG, **keywords) -> Orbit:
    """The orbit reached from rest."""
    orbit = settle_to_orbit(period_map, frequency_hz, level, **keywords)
    assert orbit is not None
    return orbit


class FormulaMap:
    """x -> f(x, p), where p is the frequency; derivatives by central differences."""

    derivatives = ("frequency", "level")

    def __init__(self, formula: Callable, size: int = 1) -> None:
        self.formula, self.size, self.scales = formula, size, np.ones(size)
        self.model = Model(snm())

    def iterate(self, x, frequency_hz, acceleration_m_s2, periods):
        for _ in range(periods):
            x = np.array(self.formula(*x, frequency_hz), dtype=float)
        return x

    def evaluate(self, x, frequency_hz, acceleration_m_s2, periods=1):
        h, n = 1e-6, self.size
        columns = []
        for index in range(n + 1):
            step = np.zeros(n + 1)
            step[index] = h
            ends = [
                self.iterate(x + sign * step[:n], frequency_hz + sign * step[n], 0.0, periods)
                for sign in (1, -1)
            ]
            columns.append((ends[0] - ends[1]) / (2 * h))
        end = self.iterate(x, frequency_hz, 0.0, periods)
        derivatives = np.array(columns).T
        by_parameters = np.column_stack([derivatives[:, n], np.zeros(n)])
        return MapResult(end, derivatives[:, :n], by_parameters, (0,), np.empty((0, 5 + n)))

    def find(self, guess, value: float, periods: int = 1) -> Orbit:
        orbit = find_orbit(cast(PeriodMap, self), value, 0.0, np.array(guess, dtype=float), periods)
        assert orbit is not None
        return orbit
