"""Linearized motion about a periodic orbit, stable or not, of any model: how it answers the table.

Variations are central differences of the model's own solver over parts of a period, so every effect
is included and no model needs a Jacobian from its user. A part begins at the state of the orbit,
where the solver restarts from the varied state.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from table_io.block import Float1D, Float2D
from table_io.config.excitation.continuation import Complex1D, pack_harmonics
from twin.dynamics.orbits import Orbit
from twin.model.contact_regime import STATE_SIZE as CLOSED_FORM_STATE_SIZE
from twin.model.event_integrator_kernel import (
    CONTACT_L,
    CONTACT_R,
    DIRECTION,
    STATE_F,
    U_L,
    U_R,
    U,
    V,
)
from twin.model.prepare import prepare_solver
from twin.model.solver import OUTPUT_COUNT, Solver, StateEstimate

# Of the sign of a variation: (state at the end, u in m at the samples).
Variation = Callable[[float], tuple[Float1D, Float1D]]

VARIATION_M = 1e-8  # m: small beside any clearance, large beside rounding errors
HIDDEN_VARIATION = 1e-6  # of the largest value on the orbit, of branch forces and their like
MIN_SAMPLES_PER_PERIOD = 500  # the drive is linear between samples
MOTION_SAMPLES = 2048  # of the harmonics


def find_harmonics(orbit: Orbit, count: int) -> Complex1D:
    """Return the harmonics U_0 .. U_count of u in m, u = Re sum_k U_k exp(i k phi)."""
    motion = np.roll(orbit.sample_motion(MOTION_SAMPLES)[0], 1)  # begins at phase 0
    return _transform(motion, count)


def _transform(values: Float1D, count: int) -> Complex1D:
    harmonics: Complex1D = 2.0 * np.fft.rfft(values)[: count + 1] / values.size
    harmonics[0] /= 2.0
    return harmonics


@dataclass(frozen=True, slots=True, eq=False)
class LinearPart:
    """Linearized motion over a part of the period.

    With y the table's additional displacement, z = (coordinates, y, y'), and s the additional
    command of the low-passed table, constant over the part:
        z_end = transition z + from_command s,   mean of u + y = mean_row z + mean_from_command s
    """

    transition: Float2D
    from_command: Float1D
    mean_row: Float1D
    mean_from_command: float


class LinearizedOrbit:
    """Linearized motion about an orbit of period 1, its period divided into `parts`.

    Coordinates: u, v, u_r, u_l and, where the model has them, branch forces and hysteretic states;
    one that follows another has zeros.
    """

    def __init__(self, orbit: Orbit, parts: int) -> None:
        self.orbit = orbit
        self.parts = parts
        model = orbit.period_map.model
        per_period = max(MIN_SAMPLES_PER_PERIOD, 1.1 * model.min_rate_hz / orbit.frequency_hz)
        self._samples = math.ceil(per_period / parts)  # of a part
        self._rate_hz = parts * self._samples * orbit.frequency_hz
        self._solver: Solver = prepare_solver(model, self._rate_hz)
        count = parts * self._samples
        phase = 2.0 * math.pi * np.arange(count + 1) / count
        self._base_acc: Float1D = orbit.acceleration_m_s2 * np.sin(phase)
        self._w = 2.0 * math.pi * orbit.frequency_hz
        self._table_disp: Float1D = -self._base_acc / self._w**2

    @cached_property
    def _starts(self) -> Float2D:
        """States of the orbit at the start of each part, and at the end, (parts + 1, state)."""
        state = self.orbit.period_map.to_state(self.orbit.x)
        states = [state]
        for part in range(self.parts):
            state, _ = self._advance(state, part, np.zeros(self._samples + 1), np.zeros(1))
            states.append(state)
        return np.array(states)

    @cached_property
    def _steps(self) -> dict[int, float]:
        """Size of the variation of each coordinate by its index in a state."""
        steps = {U: VARIATION_M, V: VARIATION_M * self._w, U_R: VARIATION_M, U_L: VARIATION_M}
        if self._starts.shape[1] > CLOSED_FORM_STATE_SIZE:
            sizes = np.abs(self._starts).max(axis=0)
            hidden = [index for index in range(STATE_F, DIRECTION) if sizes[index] > 0.0]
            steps |= {index: HIDDEN_VARIATION * float(sizes[index]) for index in hidden}
        return steps

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return len(self._steps)

    def _advance(
        self, state: Float1D, part: int, added_acc: Float1D, added_disp: Float1D, parts: int = 1
    ) -> tuple[Float1D, Float1D]:
        """Return (state at the end, u in m at the samples) of parts with an additional drive."""
        span = slice(part * self._samples, (part + parts) * self._samples + 1)
        base = self._base_acc[span] + added_acc
        disp = self._table_disp[span] + added_disp
        estimate = StateEstimate(
            0, float(state[U]), float(state[V]), float(state[U_R]), float(state[U_L]),
            bool(state[CONTACT_R] > 0), bool(state[CONTACT_L] > 0),
            float(base[0]), float(disp[0]), state,
        )  # fmt: skip
        end, out = self._solver.restart_state(estimate), np.empty((OUTPUT_COUNT, base.size - 1))
        self._solver.advance(end, base[1:], disp[1:], out)
        return end, out[0]

    def _vary_states(self, part: int, parts: int = 1) -> tuple[Float2D, Float2D]:
        """Return (d coordinates at the end, d u at the samples) by the coordinates at the start."""
        zeros, none = np.zeros(parts * self._samples + 1), np.zeros(1)

        def advance(index: int, step: float) -> tuple[Float1D, Float1D]:
            state = self._starts[part].copy()
            state[index] += step
            return self._advance(state, part, zeros, none, parts)

        return self._collect(
            (partial(_advance_scaled, partial(advance, index), step), step)
            for index, step in self._steps.items()
        )

    def _vary_drive(
        self, drives: list[tuple[Float1D, Float1D]], part: int, parts: int = 1
    ) -> tuple[Float2D, Float2D]:
        """Return (d coordinates, d u) by the amplitude of drives (acceleration, displacement)."""
        start = self._starts[part]

        def advance(drive: tuple[Float1D, Float1D], size: float) -> tuple[Float1D, Float1D]:
            return self._advance(start, part, size * drive[0], size * drive[1], parts)

        steps = [VARIATION_M * self._w**2 / float(np.abs(acc).max()) for acc, _ in drives]
        return self._collect(
            (partial(_advance_scaled, partial(advance, drive), step), step)
            for drive, step in zip(drives, steps, strict=True)
        )

    def _collect(self, varied: Iterable[tuple[Variation, float]]) -> tuple[Float2D, Float2D]:
        """Return the central differences, one column each, of (function of the sign, step)."""
        ends, motions = [], []
        for function, step in varied:
            (end_up, u_up), (end_down, u_down) = function(1.0), function(-1.0)
            ends.append((end_up - end_down)[list(self._steps)] / (2.0 * step))
            motions.append((u_up - u_down) / (2.0 * step))
        return np.array(ends).T, np.array(motions).T

    def linearize_parts(self, pole_rad_s: float) -> list[LinearPart]:
        """Return the linearized motion of each part behind a table with a double real pole.

        y'' = p^2 (s - y) - 2 p y', the low pass of the table's servo.
        """
        times = np.arange(self._samples + 1) / self._rate_hz
        drives, ends = _table_responses(pole_rad_s, times)
        n, parts = self.size, []
        for part in range(self.parts):
            by_state, u_by_state = self._vary_states(part)
            by_drive, u_by_drive = self._vary_drive(drives, part)
            means = np.concatenate([
                u_by_state.mean(axis=0),
                u_by_drive.mean(axis=0) + np.array([disp[1:].mean() for _, disp in drives]),
            ])  # fmt: skip
            transition = np.zeros((n + 2, n + 2))
            transition[:n, :n], transition[:n, n:] = by_state, by_drive[:, :2]
            transition[n:, n:] = ends[:, :2]
            from_command = np.concatenate([by_drive[:, 2], ends[:, 2]])
            parts.append(LinearPart(transition, from_command, means[: n + 2], float(means[n + 2])))
        return parts

    def table_jacobian(self, harmonics: int) -> Float2D:
        """Return d (harmonics of u) / d (harmonics of the table's displacement), (2 H + 1,) each.

        Without feedback: the periodic solution of the linearized motion, which exists on an
        unstable orbit too, as long as no multiplier is 1. A constant displacement has no effect.
        Vectors are ordered as in an orbit plan.
        """
        phase = (
            2.0 * math.pi * np.arange(self.parts * self._samples + 1) / (self.parts * self._samples)
        )
        waves = [
            (-((k * self._w) ** 2) * np.real(unit * wave), np.real(unit * wave))
            for k in range(1, harmonics + 1)
            for wave in [np.exp(1j * k * phase)]
            for unit in (1.0, 1.0j)
        ]
        monodromy, u_by_state = self._vary_states(0, self.parts)
        by_wave, u_by_wave = self._vary_drive(waves, 0, self.parts)
        starts = np.linalg.solve(np.eye(self.size) - monodromy, by_wave)
        motions = np.roll(u_by_wave + u_by_state @ starts, 1, axis=0)
        jacobian = np.zeros((2 * harmonics + 1, 2 * harmonics + 1))
        for column, motion in enumerate(motions.T, 1):
            jacobian[:, column] = pack_harmonics(_transform(motion, harmonics))
        return jacobian


def _advance_scaled(advance: Variation, step: float, sign: float) -> tuple[Float1D, Float1D]:
    return advance(sign * step)


def _table_responses(
    pole_rad_s: float, times: Float1D
) -> tuple[list[tuple[Float1D, Float1D]], Float2D]:
    """Return the table's (y'', y) at `times` from y = 1, y' = 1 and s = 1, and (y, y') at the end.

    The ends are columns, (2, 3). Closed form of the double pole.
    """
    p, decay = pole_rad_s, np.exp(-pole_rad_s * times)
    y_of_y, v_of_y = (1 + p * times) * decay, -p * p * times * decay
    y_of_v, v_of_v = times * decay, (1 - p * times) * decay
    responses = [(y_of_y, v_of_y, 0.0), (y_of_v, v_of_v, 0.0), (1 - y_of_y, -v_of_y, 1.0)]
    drives = [(p * p * (s - y) - 2 * p * v, y) for y, v, s in responses]
    ends = np.array([[y[-1] for y, _, _ in responses], [v[-1] for _, v, _ in responses]])
    return drives, ends
