"""Period map of a model with any effects, by the event-driven solver, with automatic Jacobian.

The drive is A = a sin(2 pi f t) plus what input effects add; the section is phase 0 of A. The
solver takes A as linear between samples, which multiplies harmonic k of it by sinc^2(k / n), n
samples per cycle: the samples are divided by that, so that the interpolated drive has exactly the
harmonics of the true one. What remains are harmonics k n +- 1 of the drive, of amplitude about
1 / n^2, which move the state by 1 / n^4: 1e-8 of its amplitude at `SAMPLES_PER_CYCLE`.

Coordinates are (u, v), u_j of a face with memory, f, b_j, z and the states of added laws, as far as
the model has them. A face in contact follows u; a variation of it alone is one of the onset that
brought it there. Derivatives are central differences, `RELATIVE_STEP` of the motion's amplitude
wide; one-sided for a coordinate at its bound, such as a relaxed face.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np

from table_io.block import Bool1D, Float1D, Float2D
from twin.dynamics.closed_form_map import ClosedFormMap
from twin.dynamics.period_map import FREQUENCY, LEVEL, TOUCH_TOL_M, MapResult, PeriodMap
from twin.laws.effect import PLACES, Effect
from twin.laws.properties import LawProperties, evaluate_law, sum_law_properties
from twin.model.event_integrator import EventDrivenSolver, kernel_coefficients, set_substeps
from twin.model.event_integrator_kernel import (
    CONTACT_L,
    CONTACT_R,
    DIRECTION,
    REVERSAL_GUARD,
    STATE_B_R,
    STATE_BASE,
    STATE_F,
    STATE_S,
    STATE_SIZE,
    STATE_Z,
    U_R,
    U,
    V,
    build_kernel,
)
from twin.model.force_laws import AddedLaws, Coefficients
from twin.model.model import Model
from twin.model.solver import OUTPUT_COUNT
from twin.model.stepped_sine import EXTREME_NAMES, validate_frequencies

SAMPLES_PER_CYCLE = 128
EXTREMES_SAMPLES_PER_CYCLE = 1024  # of accelerations and forces; those of u are exact
STEP_REFINEMENT = 2  # of the solver's limits on angle and relaxation in a step
RELATIVE_STEP = 2e-6  # of a central difference, of the amplitude of the coordinate
STICK_TOL_M_S = 1e-14  # m/s: a speed below it is rest, where there is friction
MAX_HYSTERESIS = 1 - 1e-12  # of the hysteretic variable
MAX_EVENTS = 4000  # logged in one evaluation
SMALL_MOTION_M = 1e-3  # m: at which added laws are probed

PERTURBATION_M = 1e-8  # m: of the neighboring motion whose separation is the growth

_NO_PROPAGATORS = np.zeros((8, 1))  # of exact linear propagation, which is not used here
_NO_EVENTS = np.empty((0, 4))


class SampledDrive(NamedTuple):
    """A period of the drive on samples, and the coefficients of the steps between them."""

    coefficients: Coefficients
    base_acc: Float1D  # m/s2, what drives the mass
    added_acc: Float1D  # m/s2, the part of it that is not the table's acceleration


class _IntegratedConstants(NamedTuple):
    """What the maps of a model have in common; a linear model too is integrated.

    The exact propagators of a linear model cost more than the few periods that they serve.
    indices: of the coordinates in a state of the solver.
    """

    coefficients: Coefficients
    laws: AddedLaws | None
    law_properties: dict[int, LawProperties]
    indices: list[int]


@lru_cache(maxsize=64)
def _make_constants(model: Model) -> _IntegratedConstants:
    """Return what the maps of a model at all frequencies and levels have in common."""
    coefficients, laws = kernel_coefficients(model)
    p, added = model.parameters, model.added_laws

    def has_memory(side: int) -> bool:
        """Return whether a released face takes time to recover."""
        if (p.bumper_damping_r, p.bumper_damping_l)[side] or coefficients.ch or coefficients.kb:
            return True
        return any(
            side in PLACES[effect.place] and has_dashpot(effect, constants)
            for effect, constants in added
        )

    sides = [side for side, gap in enumerate((p.gap_r, p.gap_l)) if math.isfinite(gap)]
    indices = [U, V, *(U_R + side for side in sides if has_memory(side))]
    if coefficients.k1:
        indices.append(STATE_F)
    if coefficients.kb:
        indices += [STATE_B_R + side for side in sides]
    if coefficients.fy:
        indices.append(STATE_Z)
    count = sum(len(PLACES[effect.place]) * len(effect.states) for effect, _ in added)
    indices += range(STATE_S, STATE_S + count)
    linear = coefficients._replace(is_linear=False)
    return _IntegratedConstants(linear, laws, sum_law_properties(added), indices)


@dataclass(frozen=True, eq=False)
class EventDrivenMap(PeriodMap):
    """Map of a model with any effects that do not change with time."""

    @cached_property
    def _constants(self) -> _IntegratedConstants:
        return _make_constants(self.model)

    @property
    def indices(self) -> Sequence[int]:
        return self._constants.indices

    @cached_property
    def scales(self) -> Float1D:
        p = self.model.parameters
        w = math.sqrt(p.stiffness / p.mass)
        return self._scale(1.0, w, w)

    def _scale(self, u: float, v: float, w: float) -> Float1D:
        """Return the size of each coordinate, (size,), in a motion of u m, v m/s at w 1/s."""
        coefficients = self._constants.coefficients
        sizes = np.full(STATE_SIZE, u)
        sizes[V], sizes[STATE_F], sizes[STATE_Z] = v, coefficients.k1 * u, u / coefficients.uy
        sizes[STATE_B_R : STATE_B_R + 2] = coefficients.kb * u
        index = STATE_S
        for effect, constants in self.model.added_laws:
            if effect.states:
                # The rates of a law may saturate: those of a small motion, scaled up.
                small = SMALL_MOTION_M / u
                rates = evaluate_law(effect, constants)[1](
                    small * u, small * v, 0.0, 0.0, (0.0,) * len(effect.states)
                )
                for _ in PLACES[effect.place]:
                    sizes[index : index + len(rates)] = np.abs(rates) / (small * w)
                    index += len(rates)
        own = sizes[self.indices]
        own[own == 0.0] = u
        return own

    @property
    def derivatives(self) -> tuple[str, ...]:
        return FREQUENCY, LEVEL

    def _make_drive(
        self, samples: int = SAMPLES_PER_CYCLE, periods: int = 1, stepped_hz: float = 0.0
    ) -> SampledDrive:
        """Return the drive on `samples` samples of `periods` periods.

        With as many substeps as at the frequency `stepped_hz`, if given: they change with the
        frequency, a difference must not.
        """
        constants, f = self._constants, self.frequency_hz
        rate_hz = samples / periods * (stepped_hz or f) / STEP_REFINEMENT
        coefficients = set_substeps(constants.coefficients, rate_hz, constants.law_properties)
        period_s = periods / (samples * f)
        coefficients = coefficients._replace(period=period_s, step=period_s / coefficients.substeps)
        phases = 2 * math.pi * periods * np.arange(1, samples + 1) / samples
        table_acc = self.acceleration_m_s2 * np.sin(phases)
        added = self.model.added_acceleration(-table_acc / (2 * math.pi * f) ** 2)
        added = np.zeros(samples) if added is None else added
        harmonics = np.fft.rfft(table_acc + added)
        harmonics = harmonics / np.sinc(np.arange(samples // 2 + 1) / samples) ** 2
        return SampledDrive(coefficients, np.fft.irfft(harmonics, samples), added)

    @cached_property
    def _drive(self) -> SampledDrive:
        return self._make_drive()

    def _advance(
        self, states: Float2D, drive: SampledDrive, samples: int, out: Float2D, events: Float2D
    ) -> int:
        """Advance states (m, STATE_SIZE) in place by samples from phase 0; return events.

        out (7, samples): `closed_form.OUTPUT_NAMES` of the last row. A row that becomes infinite
        is NaN. events (k, 4) as in `integrate_samples`; their number, both of the last row.
        """
        integrate, count = build_kernel(self._constants.laws is not None), 0
        base = np.resize(drive.base_acc, samples)
        for state in states:
            state[STATE_BASE] = drive.base_acc[-1]
            count = integrate(
                state, drive.coefficients, _NO_PROPAGATORS, self._constants.laws, base, out, events
            )
            if not math.isfinite(state[U]):
                state[:] = math.nan
        out[2] -= np.resize(drive.added_acc, samples)
        return count

    def _advance_periods(self, states: Float2D, periods: int) -> Float2D:
        """Return the coordinates (m, n) whole periods after states (m, STATE_SIZE)."""
        samples = periods * SAMPLES_PER_CYCLE
        self._advance(states, self._drive, samples, np.empty((OUTPUT_COUNT, samples)), _NO_EVENTS)
        return states[:, self.indices]

    def _make_states(self, x: Float2D) -> Float2D:
        """Return the solver's states (m, STATE_SIZE) at coordinates (m, size).

        A face that the mass touches or penetrates is in contact and follows it, through the onset
        that brings it there, so that the map is smooth where an onset passes through the section.
        The solver itself ends a contact that would pull, or a stick that friction cannot hold.
        """
        states, p = np.zeros((len(x), STATE_SIZE)), self.model.parameters
        states[:, self.indices] = x
        u, v, z = states[:, U], states[:, V], states[:, STATE_Z]
        for side, gap, sign in ((0, p.gap_r, 1.0), (1, p.gap_l, -1.0)):
            face, depth = states[:, U_R + side], sign * u - gap
            contact = depth >= sign * face - TOUCH_TOL_M
            states[:, CONTACT_R + side] = contact
            if U_R + side in self.indices:
                lag = depth - sign * face
                v[contact] -= (sign * self._contact_rate(side, depth) * lag)[contact]
            face[contact] = sign * depth[contact]
        np.clip(z, -MAX_HYSTERESIS, MAX_HYSTERESIS, out=z)
        direction = np.where(v < 0, -1.0, 1.0)
        if self._constants.coefficients.fc > 0:
            is_stuck = np.abs(v) <= STICK_TOL_M_S
            v[is_stuck] = direction[is_stuck] = 0.0
        states[:, DIRECTION] = direction
        return states

    def _contact_rate(self, side: int, depth: Float1D) -> Float1D:
        """Return dashpot over mass in 1/s of a bumper at these depths in m, without added laws."""
        coefficients = self._constants.coefficients
        dashpot = coefficients.c_l if side else coefficients.c_r
        rate: Float1D = (dashpot + coefficients.ch * np.abs(depth)) / coefficients.m
        return rate

    def evaluate(self, x: Float1D, periods: int = 1) -> MapResult:
        f, a = self.frequency_hz, self.acceleration_m_s2
        states, samples = self._make_states(x[None]), periods * SAMPLES_PER_CYCLE
        contacts, x = states[0, [CONTACT_R, CONTACT_L]] > 0, states[0, self.indices]
        motion, log = np.empty((OUTPUT_COUNT, samples)), np.empty((MAX_EVENTS, 4))
        count = self._advance(states, self._drive, samples, motion, log)
        end, events = states[0, self.indices], log[: min(count, MAX_EVENTS)].tolist()
        u, v = np.abs(motion[:2]).max(axis=1)
        pushes = contacts.copy()
        pushes[[int(guard) for time, guard, *_ in events if time == 0.0 and guard < 2]] = False
        steps = RELATIVE_STEP * np.maximum(np.abs(x), self._scale(u, v, 2 * math.pi * f))
        jacobian = self._differentiate(x, contacts, pushes, steps, periods)
        d_parameters = np.empty((self.size, 2))
        for column, df, da in (
            (0, RELATIVE_STEP * f, 0.0),
            (1, 0.0, RELATIVE_STEP * (abs(a) or 1.0)),
        ):
            ends = []
            for sign in (1, -1):
                varied = replace(self, frequency_hz=f + sign * df, acceleration_m_s2=a + sign * da)
                moved, drive = self._make_states(x[None]), varied._make_drive(stepped_hz=f)
                varied._advance(moved, drive, samples, motion, _NO_EVENTS)
                ends.append(moved[0, self.indices])
            d_parameters[:, column] = (ends[0] - ends[1]) / (2 * (df + da))
        regime, codes = int(contacts[0]) + 2 * int(contacts[1]), []
        for time, guard, is_onset, _ in events:
            if guard != REVERSAL_GUARD:
                if time == 0.0:  # contacts that would pull, ended by the solver
                    regime ^= 1 << int(guard)
                else:
                    codes.append(4 + int(guard) + 2 * int(is_onset))
        no_minima = np.empty((0, 3 + self.size + 2))
        return MapResult(end, jacobian, d_parameters, (regime, *codes), no_minima)

    def _differentiate(
        self, x: Float1D, contacts: Bool1D, pushes: Bool1D, steps: Float1D, periods: int
    ) -> Float2D:
        """Return d end / d x, (n, n); `contacts` of both sides at x, those that push."""
        # Row j varies coordinate j.
        upper, lower = x + np.diag(steps), x - np.diag(steps)
        touching: list[tuple[int, int]] = []
        for j, index in enumerate(self.indices):
            if index in (U_R, U_R + 1):
                side = index - U_R
                if contacts[side]:  # it follows u
                    upper[0, j], lower[0, j] = x[j] + steps[0], x[j] - steps[0]
                    touching.append((j, side))
                elif abs(x[j]) <= steps[j]:  # a relaxed face can only be compressed
                    (upper if side else lower)[j, j] = x[j]
            elif index == STATE_Z:
                upper[j, j] = min(upper[j, j], MAX_HYSTERESIS)
                lower[j, j] = max(lower[j, j], -MAX_HYSTERESIS)
        states = self._make_states(np.concatenate([upper, lower]))
        ends, widths = self._advance_periods(states, periods), np.diag(upper) - np.diag(lower)
        jacobian: Float2D = ((ends[: self.size] - ends[self.size :]) / widths[:, None]).T
        for j, side in touching:
            # As through an onset: u_j becomes u, u' changes by C_j / M (u_j - u).
            rate = self._contact_rate(side, x[j : j + 1])[0] if pushes[side] else 0.0
            jacobian[:, j] = rate * jacobian[:, 1]
            jacobian[:, 0] -= jacobian[:, j]
        return jacobian

    def record(self, x: Float1D, periods: int) -> Float2D:
        points = np.empty((periods, self.size))
        for point in points:
            x = self._advance_periods(self._make_states(x[None]), 1)[0]
            point[:] = x
        return points

    def advance_half(self, x: Float1D) -> Float1D:
        states, samples = self._make_states(x[None]), SAMPLES_PER_CYCLE // 2
        self._advance(states, self._drive, samples, np.empty((OUTPUT_COUNT, samples)), _NO_EVENTS)
        return states[0, self.indices]

    def rest(self) -> Float1D:
        coefficients, laws, _, indices = self._constants
        p = self.model.parameters
        solver = EventDrivenSolver(self.model, p, coefficients, _NO_PROPAGATORS, laws)
        return solver.rest_state()[indices]

    def to_state(self, x: Float1D) -> Float1D:
        state: Float1D = self._make_states(x[None])[0]
        return state

    def measure_periods(self, x: Float1D, periods: int) -> Float2D:
        drive = self._make_drive(EXTREMES_SAMPLES_PER_CYCLE)
        # Reversals as events, so that the extremes of u are exact.
        drive = drive._replace(coefficients=drive.coefficients._replace(has_reversals=True))
        motion, log = np.empty((OUTPUT_COUNT, drive.base_acc.size)), np.empty((MAX_EVENTS, 4))
        rows, states = np.empty((periods, len(EXTREME_NAMES))), self._make_states(x[None])
        for row in rows:
            start = states[0, U]
            count = self._advance(states, drive, drive.base_acc.size, motion, log)
            events = log[: min(count, MAX_EVENTS)]
            u = np.concatenate([[start], motion[0], events[events[:, 1] == REVERSAL_GUARD, 3]])
            onsets = [
                np.count_nonzero((events[:, 1] == side) & (events[:, 2] > 0)) for side in (0, 1)
            ]
            forces = motion[3].max(), motion[4].min()
            row[:] = u.max(), u.min(), motion[2].max(), motion[2].min(), *forces, *onsets
        return rows

    def sample_motion(self, x: Float1D, periods: int, count: int) -> Float2D:
        each = max(1, math.ceil(SAMPLES_PER_CYCLE * periods / count))
        drive = self._make_drive(each * count, periods)
        motion = np.empty((OUTPUT_COUNT, each * count))
        self._advance(self._make_states(x[None]), drive, each * count, motion, _NO_EVENTS)
        return motion[:, each - 1 :: each]

    def measure_growth(self, x: Float1D, periods: int) -> tuple[Float1D, Float1D]:
        """See `PeriodMap`; from a neighbor that is brought back near after each period."""
        growth, separation = np.empty(periods), np.zeros(self.size)
        separation[: V + 1] = PERTURBATION_M / math.sqrt(2)
        for i in range(periods):
            free, directions = self.free_directions(x)
            neighbor = x + directions @ separation[free]
            ends = self._advance_periods(self._make_states(np.array([x, neighbor])), 1)
            x, difference = ends[0], ends[1] - ends[0]
            size = max(float(np.linalg.norm(difference)), math.ulp(PERTURBATION_M))
            growth[i] = math.log(size / PERTURBATION_M)
            separation = difference * (PERTURBATION_M / size)
        return growth, x


def make_period_map(model: Model, frequency_hz: float, acceleration_m_s2: float) -> PeriodMap:
    """Return the period map of a model at a drive: closed form if effects allow, else event-driven.

    InputError if the model changes with time, or the drive is none.
    """
    validate_frequencies([frequency_hz], acceleration_m_s2, 1)
    model.require_steady_state()
    kind = ClosedFormMap if model.changes_only_parameters else EventDrivenMap
    return kind(model, frequency_hz, acceleration_m_s2)


def has_dashpot(effect: Effect, constants: tuple[float, ...]) -> bool:
    """Return whether a law in a bumper delays the recovery of its face: by rate or by states."""
    force, _ = evaluate_law(effect, constants)
    d, relaxed = SMALL_MOTION_M, (0.0,) * len(effect.states)
    return bool(effect.states) or force(d, 1.0, 0.0, 0.0, relaxed) != force(
        d, 0.0, 0.0, 0.0, relaxed
    )
