"""Stroboscopic map: the state one or more periods of A = a sin(2 pi f t) later, and derivatives.

The map is taken at zero upcrossings of A. Its coordinates x are those parts of the state that can
vary independently of each other (a bumper without a dashpot has no face of its own). Continuation
works on this protocol, so that no model needs a Jacobian from its user.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, Protocol, Self

import numpy as np

from table_io.block import Float1D, Float2D, Int1D
from table_io.errors import InputError, suggest
from twin.model.closed_form import (
    advance_state,
    continuous_params,
    discretized_params,
    highest_angular_frequency,
    rest_state,
)
from twin.model.contact_regime import CONTACT_R, STATE_SIZE, U_R, U, V
from twin.model.model import Model
from twin.model.parameters import Parameters
from twin.model.periodic_orbit import (
    MAX_ONSETS_PER_CYCLE,
    NO_EVENTS,
    NO_GROWTH,
    NO_MINIMA,
    PARAMETER_COUNT,
    advance_cycles,
    jump_variations,
    steps_per_cycle,
)
from twin.model.solver import OUTPUT_COUNT
from twin.model.stepped_sine import EXTREME_NAMES, simulate_stepped_sine

GAP = "gap"  # the total gap in m; its change is shared by both sides
FREQUENCY, LEVEL = "frequency", "level"  # drive frequency in Hz, peak table acceleration in m/s2
TOUCH_TOL_M = 1e-11  # m: a face this close to the mass that pushes it is in contact


class MapResult(NamedTuple):
    """Result of `PeriodMap.evaluate` for n coordinates and p `PeriodMap.derivatives`.

    contacts: regime at the start (contact_r + 2 contact_l), then the contact events in order of
    time, 4 + side + 2 (onset).
    minima (k, 3 + n + p): local minima of the contact guards, at which contacts appear and vanish:
    time in periods; side, + 2 if in contact; value in m (clearance, or push / K_j; negative where
    the event that it caused cuts it off); derivatives of the value by x and by parameters. k = 0
    where a map does not have them.
    """

    end: Float1D  # (n,)
    jacobian: Float2D  # (n, n), d end / d x
    d_parameters: Float2D  # (n, p), d end / d parameter
    contacts: tuple[int, ...]
    minima: Float2D


class PeriodMap(Protocol):
    """Stroboscopic map of a model.

    Names of parameters: "frequency" (Hz), "level" (peak acceleration in m/s2), "gap" (total gap in
    m) and every name of `Model.flatten`.
    """

    @property
    def model(self) -> Model: ...

    @property
    def size(self) -> int:
        """Number n of coordinates."""
        ...

    @property
    def scales(self) -> Float1D:
        """Size of each coordinate, (n,), in a free vibration of 1 m: distances are in m."""
        ...

    @property
    def derivatives(self) -> tuple[str, ...]:
        """Parameters by which `evaluate` differentiates; the first are frequency and level."""
        ...

    def evaluate(
        self, x: Float1D, frequency_hz: float, acceleration_m_s2: float, periods: int = 1
    ) -> MapResult:
        """Return the coordinates `periods` later and their derivatives; NaN if x is."""
        ...

    def iterate(
        self, x: Float1D, frequency_hz: float, acceleration_m_s2: float, periods: int
    ) -> Float1D:
        """Return the coordinates `periods` later, (n,)."""
        ...

    def rest(self) -> Float1D:
        """Return the coordinates of the static equilibrium, (n,)."""
        ...

    def to_state(self, x: Float1D) -> Float1D:
        """Return the state of the model's solver at coordinates x."""
        ...

    def find_extremes(
        self, x: Float1D, frequency_hz: float, acceleration_m_s2: float, periods: int = 1
    ) -> Float1D:
        """Return the extremes over `periods` from x, (8,), `stepped_sine.EXTREME_NAMES`."""
        ...

    def sample_motion(
        self, x: Float1D, frequency_hz: float, acceleration_m_s2: float, periods: int, count: int
    ) -> Float2D:
        """Return (7, count) samples `closed_form.OUTPUT_NAMES`, evenly spaced to the end."""
        ...

    def parameter(self, name: str) -> float:
        """Return a parameter of the model."""
        ...

    def with_parameter(self, name: str, value: float) -> Self:
        """Return the map with another value of a parameter of the model."""
        ...


@dataclass(frozen=True, eq=False)
class ClosedFormPeriodMap:
    """Map of a model whose motion has a closed form between events; exact derivatives.

    x = (u, v) in m and m/s, then u_r, u_l in m of the sides that have a bumper with a dashpot.
    """

    model: Model

    @cached_property
    def parameters(self) -> Parameters:
        return self.model.parameters

    @cached_property
    def _params(self) -> Float1D:
        return continuous_params(self.parameters)

    @cached_property
    def _highest_w(self) -> float:
        return highest_angular_frequency(self._params)

    @cached_property
    def _faces(self) -> tuple[int, ...]:
        """Indices in the state of the u_j that are coordinates."""
        p = self.parameters
        sides = (p.bumper_damping_r, p.gap_r), (p.bumper_damping_l, p.gap_l)
        return tuple(
            U_R + side
            for side, (damping, gap) in enumerate(sides)
            if damping > 0 and math.isfinite(gap)
        )

    @cached_property
    def size(self) -> int:
        return 2 + len(self._faces)

    @cached_property
    def scales(self) -> Float1D:
        scales = np.ones(self.size)
        scales[1] = math.sqrt(self.parameters.stiffness / self.parameters.mass)
        return scales

    @cached_property
    def derivatives(self) -> tuple[str, ...]:
        if self.model.present_effects:  # may change the gaps in their own way
            return FREQUENCY, LEVEL
        return FREQUENCY, LEVEL, "gap_r", "gap_l"

    @cached_property
    def _coordinates(self) -> Int1D:
        return np.array([U, V, *self._faces])

    @cached_property
    def _identity(self) -> Float2D:
        """Variations (4, n + 4) at the start of a flight."""
        identity = np.zeros((4, self.size + PARAMETER_COUNT))
        for column, row in enumerate(self._coordinates):
            identity[row, column] = 1.0
        return identity

    def to_state(self, x: Float1D) -> Float1D:
        """Return the state (STATE_SIZE,) of `closed_form` at x."""
        return self._start(x)[0]

    def _start(self, x: Float1D) -> tuple[Float1D, list[tuple[int, bool]]]:
        """Return the state at x, and the sides whose u_j lies on the mass, True in contact.

        A contact passes through the onset that brings u_j to the mass, so that the map is smooth
        where an onset passes through the start.
        """
        p = self.parameters
        state, touching = np.zeros(STATE_SIZE), []
        u, v = float(x[0]), float(x[1])
        for column, row in enumerate(self._faces, 2):
            state[row] = x[column]
        for side, sign, gap, k, c in (
            (0, 1.0, p.gap_r, p.bumper_stiffness_r, p.bumper_damping_r),
            (1, -1.0, p.gap_l, p.bumper_stiffness_l, p.bumper_damping_l),
        ):
            depth = sign * u - gap
            lag = depth - sign * float(state[U_R + side])
            if depth < 0.0 or lag < -TOUCH_TOL_M:
                continue
            onset_v = v - (sign * c / p.mass * lag if side + U_R in self._faces else 0.0)
            pushes = c * sign * onset_v + k * depth > 0.0
            state[CONTACT_R + side], state[U_R + side] = float(pushes), sign * depth
            v = onset_v if pushes else v
            touching.append((side, pushes))
        state[U], state[V] = u, v
        return state, touching

    def from_state(self, state: Float1D) -> Float1D:
        """Return the coordinates (n,) of a state of `closed_form`."""
        return state.take(self._coordinates)

    def evaluate(
        self, x: Float1D, frequency_hz: float, acceleration_m_s2: float, periods: int = 1
    ) -> MapResult:
        state, touching = self._start(x)
        n, variations = self.size, self._identity.copy()
        for side, pushes in touching:
            if pushes and side + U_R in self._faces:
                jump_variations(variations, self._params, side, True)
            else:
                variations[U_R + side] = variations[U]
                variations[U_R + side, n + 2 + side] = 2.0 * side - 1.0
        regime = int(state[CONTACT_R]) + 2 * int(state[CONTACT_R + 1])
        events = np.empty((4 * MAX_ONSETS_PER_CYCLE * periods, 3))
        minima = np.empty((4 * MAX_ONSETS_PER_CYCLE * periods, 3 + n + PARAMETER_COUNT))
        event_count, minimum_count = advance_cycles(
            state, self._params, acceleration_m_s2, 2 * math.pi * frequency_hz,
            steps_per_cycle(self._highest_w, frequency_hz), periods, variations, NO_GROWTH, events,
            minima,
        )  # fmt: skip
        derivatives = variations.take(self._coordinates, axis=0)
        codes = [4 + side + 2 * onset for _, side, onset in events[:event_count].tolist()]
        end = n + len(self.derivatives)
        return MapResult(
            state.take(self._coordinates),
            derivatives[:, :n],
            derivatives[:, n:end],
            (regime, *map(int, codes)),
            minima[:minimum_count, : 3 + end],
        )

    def iterate(
        self, x: Float1D, frequency_hz: float, acceleration_m_s2: float, periods: int
    ) -> Float1D:
        state = self.to_state(x)
        advance_cycles(
            state, self._params, acceleration_m_s2, 2 * math.pi * frequency_hz,
            steps_per_cycle(self._highest_w, frequency_hz), periods, np.empty((4, 0)), NO_GROWTH,
            NO_EVENTS, NO_MINIMA,
        )  # fmt: skip
        return self.from_state(state)

    def rest(self) -> Float1D:
        return self.from_state(rest_state(self.parameters))

    def find_extremes(
        self, x: Float1D, frequency_hz: float, acceleration_m_s2: float, periods: int = 1
    ) -> Float1D:
        extremes = simulate_stepped_sine(
            self.parameters, [frequency_hz], acceleration_m_s2, periods, state=self.to_state(x)
        ).extremes[0]
        is_minimum = np.array([name.endswith("_min") for name in EXTREME_NAMES])
        total = np.where(is_minimum, extremes.min(axis=0), extremes.max(axis=0))
        total[-2:] = extremes[:, -2:].sum(axis=0)
        return total

    def sample_motion(
        self, x: Float1D, frequency_hz: float, acceleration_m_s2: float, periods: int, count: int
    ) -> Float2D:
        # The drive is linear between samples: many of them, so that it is a sinusoid.
        each = max(1, math.ceil(4000 * periods / count))
        phases = 2 * math.pi * periods * np.arange(1, each * count + 1) / (each * count)
        out, state = np.empty((OUTPUT_COUNT, each * count)), self.to_state(x)
        rate_hz = each * count * frequency_hz / periods
        params = discretized_params(self.parameters, rate_hz)
        advance_state(state, params, acceleration_m_s2 * np.sin(phases), out)
        return out[:, each - 1 :: each]

    def parameter(self, name: str) -> float:
        return find_parameter(self.model, name)

    def with_parameter(self, name: str, value: float) -> "ClosedFormPeriodMap":
        return ClosedFormPeriodMap(change_parameter(self.model, name, value))


def find_parameter(model: Model, name: str) -> float:
    """Return "gap" (total, m) or a number of `Model.flatten`; InputError names an unknown one."""
    if name == GAP:
        return model.base.gap_r + model.base.gap_l
    values = model.flatten()
    if name not in values:
        raise InputError("unknown model parameter", key=name, remedy=suggest(name, [GAP, *values]))
    return values[name]


def change_parameter(model: Model, name: str, value: float) -> Model:
    """Return the model with another value of "gap" (total, m) or of a name of `Model.flatten`.

    A change of the total gap is shared by both sides. InputError as in `find_parameter`.
    """
    base = model.base
    if name == GAP:
        if not math.isfinite(base.gap_r + base.gap_l):
            raise InputError(
                "the total gap is infinite: one side has no bumper",
                key=GAP,
                value=float(value),
                allowed="gap_r or gap_l",
            )
        half = (value - base.gap_r - base.gap_l) / 2
        base = replace(base, gap_r=base.gap_r + half, gap_l=base.gap_l + half)
        return Model(base, model.effects)
    if name in base.as_dict():
        return Model(replace(base, **{name: value}), model.effects)
    find_parameter(model, name)
    return model.with_flat(model.flatten() | {name: value})


def make_period_map(model: Model) -> PeriodMap:
    """Return the stroboscopic map of a model: closed form if effects allow, else event-driven.

    InputError if the model changes with time.
    """
    if model.changes_only_parameters:
        return ClosedFormPeriodMap(model)
    from twin.dynamics.event_driven_map import EventDrivenMap

    return EventDrivenMap(model)
