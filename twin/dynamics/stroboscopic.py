"""Stroboscopic map of a model: its states once per cycle of A = a sin(2 pi f t), at phase 0.

In closed form where effects only change parameters, else on sampled acceleration.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from table_io.block import Float1D, Float2D, Int1D
from twin.dynamics.period_map import (
    FREQUENCY,
    LEVEL,
    change_parameter,
)
from twin.dynamics.stroboscopic_kernel import (
    UNDECIDED,
    CaptureRegions,
    SineDrive,
    capture_states,
    record_points,
    update_capture,
)
from twin.model.closed_form import (
    continuous_params,
    highest_angular_frequency,
    restart_state,
)
from twin.model.contact_regime import CONTACT_R, STATE_SIZE, U_L, U_R, U, V
from twin.model.event_integrator_kernel import DIRECTION, STATE_F
from twin.model.ideal_response import MIN_SAMPLES_PER_CYCLE, sampled_extremes
from twin.model.model import Model
from twin.model.parameters import Parameters
from twin.model.periodic_orbit import (
    NO_EVENTS,
    NO_GROWTH,
    NO_MINIMA,
    ORBIT_STEPS_PER_CYCLE,
    PARAMETER_COUNT,
    advance_cycles,
    steps_per_cycle,
)
from twin.model.solver import OUTPUT_COUNT, Solver, StateEstimate
from twin.model.stepped_sine import simulate_stepped_sine, validate_frequencies
from twin.model.stepped_sine_kernel import prepare_frequency

PERTURBATION_M = 1e-8  # m, m/s: finite differences and separation of neighbors, where sampled


@dataclass(frozen=True, slots=True)
class OperatingPoint:
    """A model and its drive: A = acceleration_m_s2 sin(2 pi frequency_hz t)."""

    model: Model
    frequency_hz: float
    acceleration_m_s2: float

    def with_parameter(self, name: str, value: float) -> "OperatingPoint":
        """Return this point at another "frequency" in Hz, "level" in m/s2, or model parameter.

        Names as in `PeriodMap`; InputError names an unknown one.
        """
        if name == FREQUENCY:
            return replace(self, frequency_hz=value)
        if name == LEVEL:
            return replace(self, acceleration_m_s2=value)
        return replace(self, model=change_parameter(self.model, name, value))


class StroboscopicMap(Protocol):
    """States of a model at phase 0, cycle by cycle. A state is a float64 array (size,)."""

    @property
    def frequency_hz(self) -> float: ...

    @property
    def coordinates(self) -> Int1D:
        """Indices into a state: u, v, deformations of bumpers with memory, states of effects."""
        ...

    def make_state(self, u: float, v: float) -> Float1D:
        """Return the state at u in m, v in m/s, phase 0, with all memory relaxed."""
        ...

    def advance(self, state: Float1D, cycles: int) -> Float2D:
        """Advance `state` in place; return the states after each cycle, (cycles, size)."""
        ...

    def adopt(self, state: Float1D) -> Float1D:
        """Return a consistent state of this map from one of another map of the same effects."""
        ...

    def measure_cycles(self, state: Float1D, cycles: int) -> Float2D:
        """Return the `EXTREME_NAMES` of the next cycles, (cycles, 8); `state` is not modified."""
        ...

    def mirror(self, state: Float1D) -> Float1D:
        """Return the mirror image of the motion through a state: -u half a cycle later."""
        ...

    def differentiate(self, state: Float1D, cycles: int) -> Float2D:
        """Return d(coordinates `cycles` later) / d(coordinates), (n, n).

        A deformation that follows u, in contact, has its column in u's.
        """
        ...

    def measure_growth(self, state: Float1D, cycles: int) -> Float1D:
        """Advance `state` in place; return the logarithm of a perturbation's growth, (cycles,)."""
        ...

    def capture(
        self, states: Float2D, regions: CaptureRegions, max_cycles: int, labels: Int1D,
        cycles: Int1D,
    ) -> None:  # fmt: skip
        """Advance undecided states in place until captured: see `capture_states`."""
        ...


def make_stroboscopic_map(point: OperatingPoint) -> StroboscopicMap:
    """Return the stroboscopic map of a model at a drive; InputError if it has no steady state."""
    validate_frequencies([point.frequency_hz], point.acceleration_m_s2, 1)
    model = point.model
    model.require_steady_state()
    if model.changes_only_parameters:
        return ClosedFormMap(model, point.frequency_hz, point.acceleration_m_s2)
    return SampledMap(model, point.frequency_hz, point.acceleration_m_s2)


def select_free(coordinates: Int1D, state: Float1D) -> Int1D:
    """Return which of the coordinates vary independently: not a deformation in contact."""
    follows = [U_R + side for side in range(2) if state[CONTACT_R + side] > 0]
    return np.flatnonzero(~np.isin(coordinates, follows))


def displace(state: Float1D, indices: Int1D | int, values: Float1D | float) -> Float1D:
    """Return a state with other values at some indices; deformations in contact follow u."""
    result = state.copy()
    result[indices] = values
    for side in range(2):
        if state[CONTACT_R + side] > 0:
            result[U_R + side] = state[U_R + side] + result[U] - state[U]
    return result


def _memory_coordinates(p: Parameters) -> list[int]:
    """Return the deformations that outlive a contact: of present bumpers with a dashpot."""
    sides = (U_R, p.bumper_damping_r, p.gap_r), (U_L, p.bumper_damping_l, p.gap_l)
    return [index for index, damping, gap in sides if damping > 0 and math.isfinite(gap)]


@dataclass(frozen=True, eq=False)
class ClosedFormMap:
    """Stroboscopic map in closed form."""

    model: Model
    frequency_hz: float
    acceleration_m_s2: float

    @cached_property
    def parameters(self) -> Parameters:
        return self.model.parameters

    @cached_property
    def coordinates(self) -> Int1D:
        return np.array([U, V, *_memory_coordinates(self.parameters)], dtype=np.int64)

    @cached_property
    def _kernel_inputs(self) -> tuple[Float1D, SineDrive]:
        params, w = continuous_params(self.parameters), 2 * math.pi * self.frequency_hz
        steps = steps_per_cycle(highest_angular_frequency(params), self.frequency_hz)
        drive = SineDrive(
            float(self.acceleration_m_s2), w, steps, np.empty((2, steps + 1)), np.empty((4, 3))
        )
        prepare_frequency(params, drive.table, drive.particular, drive.peak, w, steps)
        return params, drive

    def make_state(self, u: float, v: float) -> Float1D:
        return restart_state(u, v, 0.0, 0.0, False, False, 0.0, self.parameters)

    def advance(self, state: Float1D, cycles: int) -> Float2D:
        params, drive = self._kernel_inputs
        points = np.empty((cycles, STATE_SIZE))
        record_points(state, params, drive, 0, drive.steps, points)
        return points

    def adopt(self, state: Float1D) -> Float1D:
        u, v, u_r, u_l = state[: U_L + 1].tolist()
        right, left = (state[CONTACT_R : CONTACT_R + 2] > 0).tolist()
        return restart_state(u, v, u_r, u_l, right, left, 0.0, self.parameters)

    def measure_cycles(self, state: Float1D, cycles: int) -> Float2D:
        return simulate_stepped_sine(
            self.parameters, [self.frequency_hz], self.acceleration_m_s2, cycles,
            ORBIT_STEPS_PER_CYCLE, state,
        ).extremes[0]  # fmt: skip

    def mirror(self, state: Float1D) -> Float1D:
        params, drive = self._kernel_inputs
        result = state.copy()
        record_points(result, params, drive, 0, drive.steps // 2, np.empty((1, STATE_SIZE)))
        return _reflect(result)

    def differentiate(self, state: Float1D, cycles: int) -> Float2D:
        variations = np.zeros((4, self.coordinates.size + PARAMETER_COUNT))
        for column, row in enumerate(self.coordinates):
            variations[row, column] = 1.0
        for side in range(2):
            if state[CONTACT_R + side] > 0:
                variations[U_R + side] = variations[U]
        self._advance_variations(state.copy(), cycles, variations, NO_GROWTH)
        return variations[self.coordinates, : self.coordinates.size]

    def measure_growth(self, state: Float1D, cycles: int) -> Float1D:
        growth, variation = np.empty(cycles), np.zeros((4, 1 + PARAMETER_COUNT))
        variation[: V + 1, 0] = 1.0
        self._advance_variations(state, cycles, variation, growth)
        return growth

    def _advance_variations(
        self, state: Float1D, cycles: int, variations: Float2D, growth: Float1D
    ) -> None:
        params, drive = self._kernel_inputs
        advance_cycles(
            state, params, drive.peak, drive.w, drive.steps, cycles, variations, growth,
            NO_EVENTS, NO_MINIMA,
        )  # fmt: skip

    def capture(
        self, states: Float2D, regions: CaptureRegions, max_cycles: int, labels: Int1D,
        cycles: Int1D,
    ) -> None:  # fmt: skip
        params, drive = self._kernel_inputs
        capture_states(states, params, drive, regions, max_cycles, labels, cycles)


def _reflect(state: Float1D) -> Float1D:
    """Return a state seen in a mirror: right and left exchanged."""
    result = -state
    result[U_R], result[U_L] = -state[U_L], -state[U_R]
    result[CONTACT_R], result[CONTACT_R + 1] = state[CONTACT_R + 1], state[CONTACT_R]
    return result


@dataclass(frozen=True, eq=False)
class SampledMap:
    """Stroboscopic map of a model with force effects, on sampled acceleration.

    The drive is linear between samples, at least `MIN_SAMPLES_PER_CYCLE` per cycle.
    """

    model: Model
    frequency_hz: float
    acceleration_m_s2: float

    @cached_property
    def coordinates(self) -> Int1D:
        """Those of the SNM, and the states of effects that a first motion changes."""
        memory = _memory_coordinates(self.model.parameters)
        state = self._solver.rest_state()
        if state.size == STATE_SIZE:
            return np.array([U, V, *memory], dtype=np.int64)
        changes = np.any(self.advance(state, 3)[:, STATE_F:DIRECTION] != 0.0, axis=0)
        return np.array([U, V, *memory, *(STATE_F + np.flatnonzero(changes))], dtype=np.int64)

    @cached_property
    def _samples(self) -> int:
        """Samples per cycle, even, so that half a cycle is whole samples."""
        needed = self.model.min_rate_hz / (MIN_SAMPLES_PER_CYCLE * self.frequency_hz)
        return MIN_SAMPLES_PER_CYCLE * max(1, math.ceil(needed))

    @cached_property
    def _solver(self) -> Solver:
        return self.model.prepare(self._samples * self.frequency_hz)

    @cached_property
    def _drive(self) -> tuple[Float1D, Float1D]:
        """Table acceleration and displacement of a cycle, without its start."""
        wave = np.sin(2 * math.pi * np.arange(1, self._samples + 1) / self._samples)
        w = 2 * math.pi * self.frequency_hz
        return self.acceleration_m_s2 * wave, -self.acceleration_m_s2 / w**2 * wave

    def make_state(self, u: float, v: float) -> Float1D:
        return self._solver.restart_state(StateEstimate(0, u, v))

    def adopt(self, state: Float1D) -> Float1D:
        u, v, u_r, u_l = state[: U_L + 1].tolist()
        right, left = (state[CONTACT_R : CONTACT_R + 2] != 0).tolist()
        return self._solver.restart_state(
            StateEstimate(0, u, v, u_r, u_l, right, left, hidden=state)
        )

    def measure_cycles(self, state: Float1D, cycles: int) -> Float2D:
        contacts = bool(state[CONTACT_R] > 0), bool(state[CONTACT_R + 1] > 0)
        state = state.copy()
        outputs = [self._run_samples(state, self._samples) for _ in range(cycles)]
        return sampled_extremes(np.concatenate(outputs, axis=1), cycles, contacts)

    def _run_samples(self, state: Float1D, count: int) -> Float2D:
        base_acc, table_disp = self._drive
        out = np.empty((OUTPUT_COUNT, count))
        self._solver.advance(state, base_acc[:count], table_disp[:count], out)
        return out

    def advance(self, state: Float1D, cycles: int) -> Float2D:
        points = np.empty((cycles, state.size))
        for i in range(cycles):
            self._run_samples(state, self._samples)
            points[i] = state
        return points

    def mirror(self, state: Float1D) -> Float1D:
        result = state.copy()
        self._run_samples(result, self._samples // 2)
        return self.adopt(_reflect(result))

    def differentiate(self, state: Float1D, cycles: int) -> Float2D:
        columns = []
        for index in self.coordinates.tolist():
            ends = []
            for step in (PERTURBATION_M, -PERTURBATION_M):
                displaced = displace(state, index, state[index] + step)
                ends.append(self.advance(displaced, cycles)[-1, self.coordinates])
            columns.append((ends[0] - ends[1]) / (2 * PERTURBATION_M))
        return np.array(columns).T

    def measure_growth(self, state: Float1D, cycles: int) -> Float1D:
        """See `StroboscopicMap`; from a neighbor that is brought back near after each cycle."""
        growth, separation = np.empty(cycles), np.zeros(state.size)
        separation[: V + 1] = PERTURBATION_M / math.sqrt(2)
        for i in range(cycles):
            neighbor = displace(state, self.coordinates, (state + separation)[self.coordinates])
            self._run_samples(state, self._samples)
            self._run_samples(neighbor, self._samples)
            difference = (neighbor - state)[self.coordinates]
            size = max(float(np.linalg.norm(difference)), math.ulp(PERTURBATION_M))
            growth[i] = math.log(size / PERTURBATION_M)
            separation[self.coordinates] = difference * (PERTURBATION_M / size)
        return growth

    def capture(
        self, states: Float2D, regions: CaptureRegions, max_cycles: int, labels: Int1D,
        cycles: Int1D,
    ) -> None:  # fmt: skip
        for i in np.flatnonzero(labels == UNDECIDED):
            visited, hits = UNDECIDED, 0
            for _ in range(max_cycles):
                self._run_samples(states[i], self._samples)
                cycles[i] += 1
                labels[i], visited, hits = update_capture(states[i], regions, visited, hits)
                if labels[i] != UNDECIDED:
                    break
