"""Simulators of a model under harmonic excitation, with one interface.

Closed form for a piecewise-linear model, numerical integration otherwise.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import final

import numpy as np

from table_io.block import Float1D, Float2D
from twin.dynamics.closed_form_map import ClosedFormMap
from twin.model import closed_form
from twin.model.contact_regime import CONTACT_L, CONTACT_R
from twin.model.event_integrator_kernel import DIRECTION, STATE_F
from twin.model.model import Model
from twin.model.parameters import Parameters
from twin.model.prepare import prepare_solver
from twin.model.solver import OUTPUT_COUNT, Solver
from twin.model.stepped_sine import EXTREME_NAMES, SteppedSineResponse, simulate_stepped_sine

FINE_SAMPLES_PER_CYCLE = 2000  # for motions in figures
COARSE_SAMPLES_PER_CYCLE = 300  # for extremes, contact onsets and Lyapunov exponents
CHUNK_CYCLES = 100  # cycles integrated at a time, to bound memory
PERTURBATION_M = 1e-9  # initial distance of the neighboring trajectory, for Lyapunov exponents


@dataclass(frozen=True, slots=True, eq=False)
class SystemMotion:
    """Motion over some cycles, SI, right positive, (sample,); v_r, v_l: bumper positions.

    Out of contact a simulated bumper rests or relaxes; a measured position is NaN.
    """

    time: Float1D
    u: Float1D
    v: Float1D
    a: Float1D
    force_r: Float1D
    force_l: Float1D
    v_r: Float1D
    v_l: Float1D


@dataclass(frozen=True, eq=False)
class HarmonicSimulator(ABC):
    """Simulator of a model under table acceleration A = a sin(2 pi f t).

    States refer to a zero upcrossing of A; a given state vector is not modified. `fine_samples`:
    of each cycle of a sampled motion.
    """

    model: Model
    fine_samples: int = FINE_SAMPLES_PER_CYCLE

    @property
    def parameters(self) -> Parameters:
        """Linear part of the model."""
        return self.model.parameters

    def copy_with_gap(self, gap_mm: float) -> "HarmonicSimulator":
        """Return a simulator of the same model at another total gap, half on each side."""
        base = replace(self.model.base, gap_r=gap_mm / 2e3, gap_l=gap_mm / 2e3)
        return type(self)(Model(base, self.model.effects))

    @property
    @abstractmethod
    def is_exact(self) -> bool:
        """True if folds, unstable motions and exponents follow from the one-period map."""

    @abstractmethod
    def sweep(
        self,
        frequencies_hz: Sequence[float] | Float1D,
        acceleration: float,
        cycles: int,
        state: Float1D | None = None,
    ) -> SteppedSineResponse:
        """Simulate whole cycles at each frequency from a state or from rest, state carried over."""

    @abstractmethod
    def sample(
        self, frequency_hz: float, acceleration: float, state: Float1D, cycles: int
    ) -> Float2D:
        """Return u, v, total acceleration, F_R, F_L, u_R, u_L in SI, (7, sample)."""

    @abstractmethod
    def find_onsets(
        self, frequency_hz: float, acceleration: float, state: Float1D, cycles: int
    ) -> tuple[Float1D, Float1D, Float1D]:
        """Return contact onset times in cycles (right, left) and the final state."""

    @abstractmethod
    def lyapunov_exponent(
        self, frequency_hz: float, acceleration: float, state: Float1D, cycles: int
    ) -> tuple[float, Float1D]:
        """Return (largest Lyapunov exponent per cycle, final state) from a settled state."""

    def simulate_motion(
        self, frequency_hz: float, acceleration: float, state: Float1D, cycles: int
    ) -> SystemMotion:
        """Simulate the motion from a state, sampled for a figure."""
        p, rate = self.parameters, frequency_hz * self.fine_samples
        u, v, acc, force_r, force_l, u_r, u_l = self.sample(
            frequency_hz, acceleration, state, cycles
        )
        time = np.arange(u.size) / rate
        return SystemMotion(time, u, v, acc, force_r, force_l, u_r + p.gap_r, u_l - p.gap_l)

    def bumper_preload(self) -> dict[str, float]:
        """Return bumper preload with the table at rest: u_r, u_l in m; f_r, f_l in N; all >= 0."""
        state = self.sweep([1.0], 0.0, 1).states[0]
        out = self.sample(1.0, 0.0, state, 1)[:, -1].tolist()
        return {"u_r": out[5], "u_l": -out[6], "f_r": out[3], "f_l": -out[4]}


@final
class ClosedFormSimulator(HarmonicSimulator):
    """Closed-form solution between contact events."""

    @property
    def is_exact(self) -> bool:
        return True

    def sweep(
        self,
        frequencies_hz: Sequence[float] | Float1D,
        acceleration: float,
        cycles: int,
        state: Float1D | None = None,
    ) -> SteppedSineResponse:
        return simulate_stepped_sine(
            self.parameters, frequencies_hz, acceleration, cycles, state=state
        )

    def sample(
        self, frequency_hz: float, acceleration: float, state: Float1D, cycles: int
    ) -> Float2D:
        count = cycles * self.fine_samples
        base = acceleration * np.sin(2 * math.pi * np.arange(1, count + 1) / self.fine_samples)
        out = np.empty((OUTPUT_COUNT, count))
        closed_form.advance_state(
            state.copy(),
            closed_form.discretized_params(self.parameters, frequency_hz * self.fine_samples),
            base,
            out,
        )
        return out

    def find_onsets(
        self, frequency_hz: float, acceleration: float, state: Float1D, cycles: int
    ) -> tuple[Float1D, Float1D, Float1D]:
        period_map = ClosedFormMap(self.model, frequency_hz, acceleration)
        events, end = period_map.find_contacts(state.take(period_map.indices), cycles)
        right, left = (events[(events[:, 1] == side) & (events[:, 2] == 1), 0] for side in (0, 1))
        return right, left, period_map.to_state(end)

    def lyapunov_exponent(
        self, frequency_hz: float, acceleration: float, state: Float1D, cycles: int
    ) -> tuple[float, Float1D]:
        period_map = ClosedFormMap(self.model, frequency_hz, acceleration)
        growth, end = period_map.measure_growth(state.take(period_map.indices), cycles)
        return float(growth.mean()), period_map.to_state(end)


@final
class NumericalSimulator(HarmonicSimulator):
    """Numerical integration with the excitation linear between samples; extremes of the samples."""

    @property
    def is_exact(self) -> bool:
        return False

    def _advance(
        self,
        frequency_hz: float,
        acceleration: float,
        state: Float1D,
        cycles: int,
        samples_per_cycle: int = COARSE_SAMPLES_PER_CYCLE,
    ) -> Float2D:
        """Advance `state` in place; return the solver output (7, cycles x samples per cycle)."""
        wave = np.sin(
            2 * math.pi * np.arange(1, cycles * samples_per_cycle + 1) / samples_per_cycle
        )
        out = np.empty((OUTPUT_COUNT, wave.size))
        table = -acceleration / (2 * math.pi * frequency_hz) ** 2 * wave
        prepare_cached(self.model, samples_per_cycle * frequency_hz).advance(
            state, acceleration * wave, table, out
        )
        return out

    def _samples(self, frequency_hz: float) -> int:
        """Return the number of samples per cycle needed to resolve a contact."""
        return COARSE_SAMPLES_PER_CYCLE * math.ceil(
            max(1.0, self.model.min_rate_hz / (COARSE_SAMPLES_PER_CYCLE * frequency_hz))
        )

    def sweep(
        self,
        frequencies_hz: Sequence[float] | Float1D,
        acceleration: float,
        cycles: int,
        state: Float1D | None = None,
    ) -> SteppedSineResponse:
        current = (
            prepare_cached(self.model, self._samples(1.0)).rest_state()
            if state is None
            else state.copy()
        )
        extremes, ends = np.empty((len(frequencies_hz), cycles, len(EXTREME_NAMES))), []
        for index, frequency_hz in enumerate(np.asarray(frequencies_hz).tolist()):
            in_contact = current[CONTACT_R] > 0, current[CONTACT_L] > 0
            samples = self._samples(frequency_hz)
            out = self._advance(frequency_hz, acceleration, current, cycles, samples)
            extremes[index] = _compute_extremes(out, samples, in_contact)
            ends.append(current.copy())
        return SteppedSineResponse(extremes, np.array(ends))

    def sample(
        self, frequency_hz: float, acceleration: float, state: Float1D, cycles: int
    ) -> Float2D:
        return self._advance(frequency_hz, acceleration, state.copy(), cycles, self.fine_samples)

    def find_onsets(
        self, frequency_hz: float, acceleration: float, state: Float1D, cycles: int
    ) -> tuple[Float1D, Float1D, Float1D]:
        onsets: tuple[list[Float1D], list[Float1D]] = ([], [])
        current = state.copy()
        samples = self._samples(frequency_hz)
        for first in range(0, cycles, CHUNK_CYCLES):
            in_contact = current[CONTACT_R] > 0, current[CONTACT_L] > 0
            out = self._advance(
                frequency_hz, acceleration, current, min(CHUNK_CYCLES, cycles - first), samples
            )
            for side, is_onset in enumerate(_detect_onsets(out, in_contact)):
                onsets[side].append(first + (np.flatnonzero(is_onset) + 1) / samples)
        return np.concatenate(onsets[0]), np.concatenate(onsets[1]), current

    def lyapunov_exponent(
        self, frequency_hz: float, acceleration: float, state: Float1D, cycles: int
    ) -> tuple[float, Float1D]:
        """Return the exponent per cycle from the growth of a perturbation, and the final state.

        The neighboring trajectory is renormalized after each cycle.
        """
        reference, neighbour, samples = state.copy(), state.copy(), self._samples(frequency_hz)
        neighbour[0] += PERTURBATION_M
        growth = 0.0
        for _ in range(cycles):
            for state_vector in (reference, neighbour):
                self._advance(frequency_hz, acceleration, state_vector, 1, samples)
            distance = math.hypot(neighbour[0] - reference[0], neighbour[1] - reference[1])
            growth += math.log(max(distance, 1e-6 * PERTURBATION_M) / PERTURBATION_M)
            neighbour = _renormalize(
                reference, neighbour, PERTURBATION_M / distance if distance > 0 else 1.0
            )
        return growth / cycles, reference


@lru_cache(64)
def prepare_cached(model: Model, rate_hz: float) -> Solver:
    """Return the solver of a model at a rate; cached because the preparation is costly."""
    return prepare_solver(model, rate_hz)


def _renormalize(reference: Float1D, neighbour: Float1D, ratio: float) -> Float1D:
    """Return the state at `ratio` of the way from `reference` to `neighbour`.

    The discrete states (contact and direction) are those of `reference`.
    """
    renormalized = reference.copy()
    for rows in (slice(0, CONTACT_R), slice(STATE_F, DIRECTION)):
        renormalized[rows] += ratio * (neighbour[rows] - reference[rows])
    return renormalized


def _detect_onsets(out: Float2D, in_contact: tuple[bool, bool]) -> list[Float1D]:
    """Return masks of contact onsets (right, left), (sample,) each.

    `in_contact` is the contact before the first sample.
    """
    onsets = []
    for force, initial in ((out[3], in_contact[0]), (-out[4], in_contact[1])):
        contact = np.concatenate([[initial], force > 0])
        onsets.append(contact[1:] & ~contact[:-1])
    return onsets


def _compute_extremes(out: Float2D, samples: int, in_contact: tuple[bool, bool]) -> Float2D:
    """Return the extremes `EXTREME_NAMES` of each cycle, (cycle, 8)."""
    u, _, a, right, left, _, _ = out.reshape(OUTPUT_COUNT, -1, samples)
    onsets = [onset.reshape(-1, samples).sum(axis=1) for onset in _detect_onsets(out, in_contact)]
    motion_extremes = [u.max(axis=1), u.min(axis=1), a.max(axis=1), a.min(axis=1)]
    return np.stack([*motion_extremes, right.max(axis=1), left.min(axis=1), *onsets], axis=1)


def make_simulator(model: Model) -> HarmonicSimulator:
    """Return the closed-form simulator if the model allows it, else the numerical one."""
    if model.changes_only_parameters:
        return ClosedFormSimulator(model)
    return NumericalSimulator(model)
