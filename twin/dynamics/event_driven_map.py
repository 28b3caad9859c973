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
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from table_io.block import Float1D, Float2D
from twin.dynamics.event_driven_kernel import advance_periods
from twin.dynamics.period_map import (
    FREQUENCY,
    LEVEL,
    TOUCH_TOL_M,
    MapResult,
    change_parameter,
    find_parameter,
)
from twin.laws.effect import PLACES, Effect
from twin.laws.properties import LawProperties, evaluate_law, sum_law_properties
from twin.model.event_integrator import EventDrivenSolver, kernel_coefficients, set_substeps
from twin.model.event_integrator_kernel import (
    CONTACT_L,
    CONTACT_R,
    DIRECTION,
    STATE_B_R,
    STATE_F,
    STATE_S,
    STATE_SIZE,
    STATE_Z,
    U_R,
    U,
    V,
)
from twin.model.event_location import REVERSAL_GUARD
from twin.model.force_laws import AddedLaws, Coefficients
from twin.model.model import Model
from twin.model.solver import OUTPUT_COUNT

SAMPLES_PER_CYCLE = 128
EXTREMES_SAMPLES_PER_CYCLE = 1024  # of accelerations and forces; those of u are exact
STEP_REFINEMENT = 2  # of the solver's limits on angle and relaxation in a step
RELATIVE_STEP = 2e-6  # of a central difference, of the amplitude of the coordinate
STICK_TOL_M_S = 1e-14  # m/s: a speed below it is rest, where there is friction
MAX_HYSTERESIS = 1 - 1e-12  # of the hysteretic variable
MAX_EVENTS = 4000  # logged in one evaluation
SMALL_MOTION_M = 1e-3  # m: at which added laws are probed


Bool1D = npt.NDArray[np.bool_]

_NO_PROPAGATORS = np.zeros((8, 1))  # of exact linear propagation, which is not used here


@dataclass(frozen=True, slots=True, eq=False)
class SampledDrive:
    """What `advance_periods` needs at one frequency and level."""

    coefficients: Coefficients
    laws: AddedLaws | None
    base_acc: Float1D  # m/s2, what drives the mass
    added_acc: Float1D | None  # m/s2, the part of it that is not the table's acceleration

    def advance(self, states: Float2D, periods: int, motion: Float2D | None = None) -> Float2D:
        """Advance states (m, STATE_SIZE) in place, through `periods` times the samples.

        Return the events of all rows in turn, (n, 4) as in `advance_step`. motion (7, n periods):
        `closed_form.OUTPUT_NAMES` of the last row.
        """
        events = np.zeros((MAX_EVENTS + 1, 4))
        advance_periods(
            states, self.coefficients, _NO_PROPAGATORS, self.laws, self.base_acc, periods, events,
            np.empty((OUTPUT_COUNT, 0)) if motion is None else motion,
        )  # fmt: skip
        if motion is not None and self.added_acc is not None:
            motion[2] -= np.tile(self.added_acc, periods)
        return events[: min(int(events[-1, 0]), MAX_EVENTS)]


@dataclass(frozen=True, eq=False)
class EventDrivenMap:
    """Map of a model with any effects; InputError if the model changes with time."""

    model: Model

    def __post_init__(self) -> None:
        self.model.require_steady_state()

    @cached_property
    def _kernel(self) -> tuple[Coefficients, AddedLaws | None]:
        """Coefficients and added laws; a linear model too is integrated.

        The exact propagators of a linear model cost more than the few periods that they serve.
        """
        coefficients, laws = kernel_coefficients(self.model)
        return coefficients._replace(is_linear=False), laws

    @cached_property
    def _law_properties(self) -> dict[int, LawProperties]:
        return sum_law_properties(self.model.added_laws)

    @cached_property
    def _indices(self) -> list[int]:
        """Indices of the coordinates in a state of the solver."""
        p, (coefficients, _) = self.model.parameters, self._kernel
        sides = [side for side, gap in enumerate((p.gap_r, p.gap_l)) if math.isfinite(gap)]
        indices = [U, V, *(U_R + side for side in sides if self._has_memory(side))]
        if coefficients.k1:
            indices.append(STATE_F)
        if coefficients.kb:
            indices += [STATE_B_R + side for side in sides]
        if coefficients.fy:
            indices.append(STATE_Z)
        count = sum(len(PLACES[e.place]) * len(e.states) for e, _ in self.model.added_laws)
        return [*indices, *range(STATE_S, STATE_S + count)]

    def _has_memory(self, side: int) -> bool:
        """Return whether a released face takes time to recover."""
        p, (coefficients, _) = self.model.parameters, self._kernel
        if (p.bumper_damping_r, p.bumper_damping_l)[side] or coefficients.ch or coefficients.kb:
            return True
        return any(
            side in PLACES[effect.place] and has_dashpot(effect, constants)
            for effect, constants in self.model.added_laws
        )

    @cached_property
    def size(self) -> int:
        return len(self._indices)

    @cached_property
    def scales(self) -> Float1D:
        p = self.model.parameters
        w = math.sqrt(p.stiffness / p.mass)
        return self._scale(1.0, w, w)

    def _scale(self, u: float, v: float, w: float) -> Float1D:
        """Return the size of each coordinate, (size,), in a motion of u m, v m/s at w 1/s."""
        coefficients, _ = self._kernel
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
        own = sizes[self._indices]
        own[own == 0.0] = u
        return own

    @property
    def derivatives(self) -> tuple[str, ...]:
        return FREQUENCY, LEVEL

    def _make_drive(
        self,
        frequency_hz: float,
        acceleration_m_s2: float,
        samples: int = SAMPLES_PER_CYCLE,
        periods: int = 1,
        step_frequency_hz: float = 0.0,
    ) -> SampledDrive:
        """Return a sin(2 pi f t) on `samples` samples of `periods` periods.

        With as many substeps as at `step_frequency_hz`, if given: they change with the frequency,
        a difference must not.
        """
        coefficients, laws = self._kernel
        rate_hz = samples / periods * (step_frequency_hz or frequency_hz)
        substeps = set_substeps(
            coefficients, rate_hz / STEP_REFINEMENT, self._law_properties
        ).substeps
        period_s = periods / (samples * frequency_hz)
        coefficients = coefficients._replace(
            period=period_s, substeps=substeps, step=period_s / substeps
        )
        phases = 2 * math.pi * periods * np.arange(1, samples + 1) / samples
        base = acceleration_m_s2 * np.sin(phases)
        added = self.model.added_acceleration(-base / (2 * math.pi * frequency_hz) ** 2)
        if added is not None:
            base = base + added
        harmonics = np.fft.rfft(base) / np.sinc(np.arange(samples // 2 + 1) / samples) ** 2
        return SampledDrive(coefficients, laws, np.fft.irfft(harmonics, samples), added)

    def _make_states(self, x: Float2D) -> Float2D:
        """Return the solver's states (m, STATE_SIZE) at coordinates (m, size).

        A face that the mass touches or penetrates is in contact and follows it, through the onset
        that brings it there, so that the map is smooth where an onset passes through the section.
        The solver itself ends a contact that would pull, or a stick that friction cannot hold.
        """
        states, p = np.zeros((len(x), STATE_SIZE)), self.model.parameters
        states[:, self._indices] = x
        u, v, z = states[:, U], states[:, V], states[:, STATE_Z]
        for side, gap, sign in ((0, p.gap_r, 1.0), (1, p.gap_l, -1.0)):
            face, depth = states[:, U_R + side], sign * u - gap
            contact = depth >= sign * face - TOUCH_TOL_M
            states[:, CONTACT_R + side] = contact
            if U_R + side in self._indices:
                lag = depth - sign * face
                v[contact] -= (sign * self._contact_rate(side, depth) * lag)[contact]
            face[contact] = sign * depth[contact]
        np.clip(z, -MAX_HYSTERESIS, MAX_HYSTERESIS, out=z)
        direction = np.where(v < 0, -1.0, 1.0)
        if self._kernel[0].fc > 0:
            is_stuck = np.abs(v) <= STICK_TOL_M_S
            v[is_stuck] = direction[is_stuck] = 0.0
        states[:, DIRECTION] = direction
        return states

    def _contact_rate(self, side: int, depth: Float1D) -> Float1D:
        """Return dashpot over mass in 1/s of a bumper at these depths in m, without added laws."""
        coefficients = self._kernel[0]
        dashpot = coefficients.c_l if side else coefficients.c_r
        rate: Float1D = (dashpot + coefficients.ch * np.abs(depth)) / coefficients.m
        return rate

    def evaluate(
        self, x: Float1D, frequency_hz: float, acceleration_m_s2: float, periods: int = 1
    ) -> MapResult:
        f, a = frequency_hz, acceleration_m_s2
        drive, states = self._make_drive(f, a), self._make_states(x[None])
        contacts, x = states[0, [CONTACT_R, CONTACT_L]] > 0, states[0, self._indices]
        motion = np.empty((OUTPUT_COUNT, SAMPLES_PER_CYCLE * periods))
        events = drive.advance(states, periods, motion)
        u, v = np.abs(motion[:2]).max(axis=1)
        released = [int(guard) for time, guard, *_ in events.tolist() if time == 0.0 and guard < 2]
        pushes = contacts.copy()
        pushes[released] = False
        steps = RELATIVE_STEP * np.maximum(np.abs(x), self._scale(u, v, 2 * math.pi * f))
        jacobian = self._differentiate(x, contacts, pushes, steps, drive, periods)
        d_parameters = np.empty((self.size, 2))
        for j, (df, da) in enumerate(
            ((RELATIVE_STEP * f, 0.0), (0.0, RELATIVE_STEP * (abs(a) or 1.0)))
        ):
            ends = []
            for sign in (1, -1):
                moved = self._make_states(x[None])
                varied = self._make_drive(f + sign * df, a + sign * da, step_frequency_hz=f)
                varied.advance(moved, periods)
                ends.append(moved[0, self._indices])
            d_parameters[:, j] = (ends[0] - ends[1]) / (2 * (df + da))
        regime, codes = int(contacts[0]) + 2 * int(contacts[1]), []
        for time, guard, is_onset, _ in events.tolist():
            if guard != REVERSAL_GUARD:
                if time == 0.0:  # contacts that would pull, ended by the solver
                    regime ^= 1 << int(guard)
                else:
                    codes.append(4 + int(guard) + 2 * int(is_onset))
        return MapResult(
            states[0, self._indices],
            jacobian,
            d_parameters,
            (regime, *codes),
            np.empty((0, 3 + self.size + 2)),
        )

    def _differentiate(
        self,
        x: Float1D,
        contacts: Bool1D,
        pushes: Bool1D,
        steps: Float1D,
        drive: SampledDrive,
        periods: int,
    ) -> Float2D:
        """Return d end / d x, (size, size); `contacts` of both sides at x, those that push."""
        # Row j varies coordinate j.
        upper, lower = x + np.diag(steps), x - np.diag(steps)
        touching: list[tuple[int, int]] = []
        for j, index in enumerate(self._indices):
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
        drive.advance(states, periods)
        ends, widths = states[:, self._indices], np.diag(upper) - np.diag(lower)
        jacobian: Float2D = ((ends[: self.size] - ends[self.size :]) / widths[:, None]).T
        for j, side in touching:
            # As through an onset: u_j becomes u, u' changes by C_j / M (u_j - u).
            rate = self._contact_rate(side, x[j : j + 1])[0] if pushes[side] else 0.0
            jacobian[:, j] = rate * jacobian[:, 1]
            jacobian[:, 0] -= jacobian[:, j]
        return jacobian

    def iterate(
        self, x: Float1D, frequency_hz: float, acceleration_m_s2: float, periods: int
    ) -> Float1D:
        states = self._make_states(x[None])
        self._make_drive(frequency_hz, acceleration_m_s2).advance(states, periods)
        return states[0, self._indices]

    def rest(self) -> Float1D:
        coefficients, laws = self._kernel
        solver = EventDrivenSolver(
            self.model, self.model.parameters, coefficients, _NO_PROPAGATORS, laws
        )
        return solver.rest_state()[self._indices]

    def to_state(self, x: Float1D) -> Float1D:
        state: Float1D = self._make_states(x[None])[0]
        return state

    def find_extremes(
        self, x: Float1D, frequency_hz: float, acceleration_m_s2: float, periods: int = 1
    ) -> Float1D:
        samples = EXTREMES_SAMPLES_PER_CYCLE * periods
        drive = self._make_drive(frequency_hz, acceleration_m_s2, samples, periods)
        # Reversals as events, so that the extremes of u are exact.
        drive = replace(drive, coefficients=drive.coefficients._replace(has_reversals=True))
        states, motion = self._make_states(x[None]), np.empty((OUTPUT_COUNT, samples))
        events = drive.advance(states, 1, motion)
        u = np.concatenate([x[:1], motion[0], events[events[:, 1] == REVERSAL_GUARD, 3]])
        onsets = [np.count_nonzero((events[:, 1] == side) & (events[:, 2] > 0)) for side in (0, 1)]
        return np.array([
            u.max(), u.min(), motion[2].max(), motion[2].min(), motion[3].max(), motion[4].min(),
            *onsets,
        ])  # fmt: skip

    def sample_motion(
        self, x: Float1D, frequency_hz: float, acceleration_m_s2: float, periods: int, count: int
    ) -> Float2D:
        each = max(1, math.ceil(SAMPLES_PER_CYCLE * periods / count))
        drive = self._make_drive(frequency_hz, acceleration_m_s2, each * count, periods)
        motion = np.empty((OUTPUT_COUNT, each * count))
        drive.advance(self._make_states(x[None]), 1, motion)
        return motion[:, each - 1 :: each]

    def parameter(self, name: str) -> float:
        return find_parameter(self.model, name)

    def with_parameter(self, name: str, value: float) -> "EventDrivenMap":
        return EventDrivenMap(change_parameter(self.model, name, value))


def has_dashpot(effect: Effect, constants: tuple[float, ...]) -> bool:
    """Return whether a law in a bumper delays the recovery of its face: by rate or by states."""
    force, _ = evaluate_law(effect, constants)
    d, relaxed = SMALL_MOTION_M, (0.0,) * len(effect.states)
    return bool(effect.states) or force(d, 1.0, 0.0, 0.0, relaxed) != force(
        d, 0.0, 0.0, 0.0, relaxed
    )
