"""Maps for tests: the model's, and some with known bifurcations."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from tests.model.reference import AG, snm
from twin.dynamics.closed_form_map import ClosedFormMap
from twin.dynamics.orbits import Orbit, find_orbit, settle_to_orbit
from twin.dynamics.period_map import MapResult, PeriodMap
from twin.model.model import Model
from twin.model.parameters import Parameters

# x'' + 2 z x' + x + b (x - 1)+ = f cos wt: a memoryless bumper on one side
BILINEAR = Parameters(1.0, 1.0, 0.1, 29.0, 0.0, 1.0, 0.0, 1.0, math.inf)
BILINEAR_LEVEL = 0.9 * 0.64 / 1.26


def model_map(gap_m: float = 0.004, frequency_hz: float = 3.4, **changes: float) -> ClosedFormMap:
    """The map of the paper's model."""
    return ClosedFormMap(Model(snm(gap_m, **changes)), frequency_hz, AG)


def settle(period_map: PeriodMap, frequency_hz: float) -> Orbit:
    """The orbit reached from rest at a frequency."""
    orbit = settle_to_orbit(period_map.with_parameter("frequency", frequency_hz))
    assert orbit is not None
    return orbit


@dataclass(frozen=True, eq=False)
class FormulaMap:
    """x -> f(x, p), where p is the frequency; derivatives by central differences."""

    formula: Callable
    size: int = 1
    frequency_hz: float = 1.0
    acceleration_m_s2: float = 0.0
    derivatives = ("frequency", "level")

    @property
    def scales(self) -> np.ndarray:
        return np.ones(self.size)

    parameter, with_parameter = PeriodMap.parameter, PeriodMap.with_parameter

    def iterate(self, x, periods):
        for _ in range(periods):
            x = np.array(self.formula(*x, self.frequency_hz), dtype=float)
        return x

    def evaluate(self, x, periods=1):
        h, n = 1e-6, self.size
        columns = []
        for step in h * np.eye(n + 1):
            ends = [
                replace(self, frequency_hz=self.frequency_hz + sign * step[n]).iterate(
                    x + sign * step[:n], periods
                )
                for sign in (1, -1)
            ]
            columns.append((ends[0] - ends[1]) / (2 * h))
        derivatives = np.array(columns).T
        by_parameters = np.column_stack([derivatives[:, n], np.zeros(n)])
        end, no_minima = self.iterate(x, periods), np.empty((0, 5 + n))
        return MapResult(end, derivatives[:, :n], by_parameters, (0,), no_minima)

    def find(self, guess, value: float, periods: int = 1) -> Orbit:
        period_map = cast(PeriodMap, replace(self, frequency_hz=value))
        orbit = find_orbit(period_map, np.array(guess, dtype=float), periods)
        assert orbit is not None
        return orbit
