"""Slow passage through all frequencies: what stands for continuous frequency, both ways."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from table_io.block import Float1D
from twin.model.sweep import EXTREMES
from twin.service.paper.cases import Case

SAME = 0.02  # of eta_d: the two directions of the slow sweep are one curve within this


@dataclass(frozen=True, slots=True)
class Effort:
    """How closely a finding is looked for: a model that must be integrated costs its time."""

    fine_hz: float  # of the slow sweep that stands for continuous frequency,
    fine_cycles: int  # and its cycles at each frequency
    transient: int  # cycles left out, in chaos,
    watched: int  # cycles counted
    followed: int  # and cycles over which two motions part
    gap_mm: float  # of a search over the gap


CLOSE = Effort(0.01, 40, 300, 3000, 3000, 0.05)
QUICK = Effort(0.02, 20, 100, 1000, 150, 0.25)


def effort(case: Case) -> Effort:
    return CLOSE if case.player.exact else QUICK


@dataclass(frozen=True, slots=True, eq=False)
class Slow:
    """Slow passage through all frequencies: eta_d and the state after each, in both directions."""

    frequency: Float1D
    eta_d: dict[str, Float1D]
    eta_a: dict[str, Float1D]
    touched: dict[str, npt.NDArray[np.bool_]]  # whether a bumper was hit
    states: dict[str, Float1D]

    @property
    def peak(self) -> tuple[int, str]:
        """(place, direction) of the primary resonance, the largest eta_d."""
        best = max(self.eta_d, key=lambda one: float(self.eta_d[one].max()))
        return int(self.eta_d[best].argmax()), best

    @property
    def peak_hz(self) -> float:
        return float(self.frequency[self.peak[0]])

    @property
    def difference(self) -> float:
        """Largest difference between the directions above 2 Hz, relative to eta_d there."""
        one, other = self.eta_d["forward"], self.eta_d["backward"]
        high = self.frequency > 2
        return float((np.abs(one - other) / np.maximum(one, other))[high].max())

    def state(self, frequency_hz: float, direction: str) -> Float1D:
        place = int(np.abs(self.frequency - frequency_hz).argmin())
        return np.asarray(self.states[direction][place])


def slow(case: Case) -> Slow:
    """The slow sweep of a gap over the range of its tests."""
    taken = effort(case)
    grid = [step.frequency_hz for test in case.tests for step in test.steps]
    count = round((max(grid) - min(grid)) / taken.fine_hz) + 1
    up = np.linspace(min(grid), max(grid), count)
    u_star, a_star = case.scale
    eta_d, eta_a, touched, states = {}, {}, {}, {}
    state = None
    for direction, way in (("forward", 1), ("backward", -1)):
        sweep = case.player.sweep(up[::way], case.acceleration, taken.fine_cycles, state)
        state = sweep.states[-1]
        last = {name: sweep.column(name)[:, -1] for name in EXTREMES}
        eta_d[direction] = ((last["u_max"] - last["u_min"]) / (2 * u_star))[::way]
        eta_a[direction] = ((last["a_max"] - last["a_min"]) / (2 * a_star))[::way]
        touched[direction] = (last["f_r_max"] - last["f_l_min"] > 0)[::way]
        states[direction] = sweep.states[::way]
    return Slow(up, eta_d, eta_a, touched, states)
