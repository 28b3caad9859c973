"""Quasi-stationary sweep on a fine grid, in both directions, as a continuous-frequency PRC."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from table_io.block import Float1D
from twin.model.stepped_sine import EXTREME_NAMES
from twin.results.paper_cases import PaperCase

MAX_DIRECTION_DIFFERENCE = 0.02  # relative to eta_d: below it both directions count as one curve


@dataclass(frozen=True, slots=True)
class SearchEffort:
    """Resolution of the searches, coarser for a model that needs numerical integration."""

    fine_hz: float  # frequency step of the slow sweep
    fine_cycles: int  # cycles per frequency of the slow sweep
    transient_cycles: int  # cycles discarded in a chaotic motion
    counted_cycles: int  # cycles evaluated in a chaotic motion
    lyapunov_cycles: int  # cycles for the Lyapunov exponent
    gap_step_mm: float  # step of a search over the gap
    secondary_hz: float  # frequency step of the scan for secondary resonances


FINE_EFFORT = SearchEffort(0.01, 40, 300, 3000, 3000, 0.05, 0.001)
COARSE_EFFORT = SearchEffort(0.02, 20, 100, 1000, 150, 0.25, 0.005)


def choose_effort(case: PaperCase) -> SearchEffort:
    return FINE_EFFORT if case.simulator.is_exact else COARSE_EFFORT


@dataclass(frozen=True, slots=True, eq=False)
class SettledSweep:
    """Frequencies of a sweep in Hz, and the state at the end of each, keyed by direction."""

    frequency: Float1D
    states: dict[str, Float1D]

    def state_at(self, frequency_hz: float, direction: str) -> Float1D:
        """Return the state reached at the nearest frequency in one direction."""
        index = int(np.abs(self.frequency - frequency_hz).argmin())
        return np.asarray(self.states[direction][index])


@dataclass(frozen=True, slots=True, eq=False)
class SlowSweep(SettledSweep):
    """Slow sweep with ratios at each frequency, keyed by direction."""

    eta_d: dict[str, Float1D]
    eta_a: dict[str, Float1D]
    has_contact: dict[str, npt.NDArray[np.bool_]]

    @property
    def peak(self) -> tuple[int, str]:
        """Index into `frequency` and direction of the primary resonance, the largest eta_d."""
        peak_direction = max(self.eta_d, key=lambda direction: float(self.eta_d[direction].max()))
        return int(self.eta_d[peak_direction].argmax()), peak_direction

    @property
    def peak_hz(self) -> float:
        return float(self.frequency[self.peak[0]])

    @property
    def max_difference(self) -> float:
        """Largest difference between the directions above 2 Hz, relative to eta_d there."""
        forward, backward = self.eta_d["forward"], self.eta_d["backward"]
        high = self.frequency > 2
        return float((np.abs(forward - backward) / np.maximum(forward, backward))[high].max())


def run_slow_sweep(case: PaperCase) -> SlowSweep:
    """Simulate the slow sweep of a gap over the frequency range of its tests."""
    effort = choose_effort(case)
    frequencies_hz = [step.frequency_hz for test in case.tests for step in test.steps]
    count = round((max(frequencies_hz) - min(frequencies_hz)) / effort.fine_hz) + 1
    grid_hz = np.linspace(min(frequencies_hz), max(frequencies_hz), count)
    u_star, a_star = case.scale
    eta_d, eta_a, has_contact, states = {}, {}, {}, {}
    state = None
    for direction, stride in (("forward", 1), ("backward", -1)):
        sweep = case.simulator.sweep(
            grid_hz[::stride], case.acceleration, effort.fine_cycles, state
        )
        state = sweep.states[-1]
        last = {name: sweep.column(name)[:, -1] for name in EXTREME_NAMES}
        eta_d[direction] = ((last["u_max"] - last["u_min"]) / (2 * u_star))[::stride]
        eta_a[direction] = ((last["a_max"] - last["a_min"]) / (2 * a_star))[::stride]
        has_contact[direction] = (last["f_r_max"] - last["f_l_min"] > 0)[::stride]
        states[direction] = sweep.states[::stride]
    return SlowSweep(grid_hz, states, eta_d, eta_a, has_contact)
