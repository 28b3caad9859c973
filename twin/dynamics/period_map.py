"""Period map of a model: the state whole periods of A = a sin(2 pi f t) later, and derivatives.

The map is taken at zero upcrossings of A. Its coordinates x are those parts of the solver's state
that can vary independently of each other (a bumper without a dashpot has no face of its own): u, v,
u_r and u_l in m and m/s, then what effects bring. A face in contact lies on the mass; a variation
of it alone is one of the onset that brought it there. All of this package works on this class, so
that no model needs a Jacobian from its user.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np

from table_io.block import Float1D, Float2D, Int1D
from table_io.errors import InputError, suggest
from twin.dynamics.capture import UNDECIDED, CaptureRegions, update_capture
from twin.model.contact_regime import CONTACT_R, U_R, U
from twin.model.event_integrator_kernel import STATE_B_L, STATE_B_R, U_L
from twin.model.model import Model
from twin.model.stepped_sine import EXTREME_NAMES

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


@dataclass(frozen=True, eq=False)
class PeriodMap(ABC):
    """Period map of a model at a frequency and a peak table acceleration.

    Names of parameters: "frequency" (Hz), "level" (peak acceleration in m/s2), "gap" (total gap in
    m) and every name of `Model.flatten`.
    """

    model: Model
    frequency_hz: float
    acceleration_m_s2: float

    @property
    @abstractmethod
    def indices(self) -> Sequence[int]:
        """Indices of the n coordinates in a state of the model's solver."""

    @property
    @abstractmethod
    def scales(self) -> Float1D:
        """Size of each coordinate, (n,), in a free vibration of 1 m: distances are in m."""

    @property
    @abstractmethod
    def derivatives(self) -> tuple[str, ...]:
        """Parameters by which `evaluate` differentiates; the first are frequency and level."""

    @abstractmethod
    def evaluate(self, x: Float1D, periods: int = 1) -> MapResult:
        """Return the coordinates `periods` later and their derivatives; NaN if x is."""

    @abstractmethod
    def record(self, x: Float1D, periods: int) -> Float2D:
        """Return the coordinates after each of `periods`, (periods, n)."""

    @abstractmethod
    def rest(self) -> Float1D:
        """Return the coordinates of the static equilibrium, (n,)."""

    @abstractmethod
    def to_state(self, x: Float1D) -> Float1D:
        """Return the state of the model's solver at coordinates x."""

    @abstractmethod
    def measure_periods(self, x: Float1D, periods: int) -> Float2D:
        """Return the extremes of each of `periods` from x, (periods, 8), `EXTREME_NAMES`."""

    @abstractmethod
    def sample_motion(self, x: Float1D, periods: int, count: int) -> Float2D:
        """Return (7, count) samples `closed_form.OUTPUT_NAMES`, evenly spaced to the end."""

    @abstractmethod
    def measure_growth(self, x: Float1D, periods: int) -> tuple[Float1D, Float1D]:
        """Return (logarithm of a perturbation's growth in each period, coordinates at the end)."""

    @abstractmethod
    def advance_half(self, x: Float1D) -> Float1D:
        """Return the coordinates half a period later, (n,)."""

    @property
    def size(self) -> int:
        """Number n of coordinates."""
        return len(self.indices)

    def iterate(self, x: Float1D, periods: int) -> Float1D:
        """Return the coordinates `periods` later, (n,)."""
        return self.record(x, periods)[-1]

    def start(self, u: float, v: float) -> Float1D:
        """Return the coordinates at u in m, v in m/s with all memory relaxed, (n,)."""
        p, x = self.model.parameters, np.zeros(self.size)
        x[:2] = u, v
        for column, side in self.faces:
            x[column] = min(u + p.gap_l, 0.0) if side else max(u - p.gap_r, 0.0)
        return x

    @property
    def faces(self) -> list[tuple[int, int]]:
        """(column, side) of the faces among the coordinates."""
        return [(j, index - U_R) for j, index in enumerate(self.indices) if index in (U_R, U_L)]

    def free_directions(self, x: Float1D) -> tuple[list[int], Float2D]:
        """Return (columns that vary freely at x, variations of x by them (n, m)).

        A face in contact follows u.
        """
        contacts, directions = self.to_state(x)[CONTACT_R : CONTACT_R + 2] > 0, np.eye(self.size)
        in_contact = [column for column, side in self.faces if contacts[side]]
        directions[in_contact, U] = 1.0
        free = [column for column in range(self.size) if column not in in_contact]
        return free, directions[:, free]

    def find_extremes(self, x: Float1D, periods: int = 1) -> Float1D:
        """Return the extremes over `periods` from x, (8,), `EXTREME_NAMES`; sums of the onsets."""
        extremes = self.measure_periods(x, periods)
        is_minimum = np.array([name.endswith("_min") for name in EXTREME_NAMES])
        total = np.where(is_minimum, extremes.min(axis=0), extremes.max(axis=0))
        total[-2:] = extremes[:, -2:].sum(axis=0)
        return total

    def mirror(self, x: Float1D) -> Float1D:
        """Return the mirror image of the motion through x: -u half a period later.

        Exact for u, v and faces; states that effects bring are near those of the image.
        """
        order = list(range(self.size))
        for right, left in ((U_R, U_L), (STATE_B_R, STATE_B_L)):
            if right in self.indices and left in self.indices:
                i, j = self.indices.index(right), self.indices.index(left)
                order[i], order[j] = j, i
        return -self.advance_half(x)[order]

    def capture(
        self, starts: Float2D, regions: CaptureRegions, max_periods: int, labels: Int1D,
        periods: Int1D,
    ) -> None:  # fmt: skip
        """Advance each undecided row of starts (k, n) until captured, at most `max_periods`.

        labels (k,) become the attractor or stay `UNDECIDED`; periods (k,) count up.
        """
        for i in np.flatnonzero(labels == UNDECIDED):
            visited, hits = UNDECIDED, 0
            for _ in range(max_periods):
                starts[i] = self.iterate(starts[i], 1)
                periods[i] += 1
                contact_r, contact_l = self.to_state(starts[i])[CONTACT_R : CONTACT_R + 2]
                labels[i], visited, hits = update_capture(
                    starts[i], contact_r, contact_l, regions, visited, hits
                )
                if labels[i] != UNDECIDED:
                    break

    def parameter(self, name: str) -> float:
        """Return the value of a parameter; InputError names an unknown one."""
        if name == FREQUENCY:
            return self.frequency_hz
        if name == LEVEL:
            return self.acceleration_m_s2
        return find_parameter(self.model, name)

    def with_parameter(self, name: str, value: float) -> Self:
        """Return the map with another value of a parameter; InputError as `parameter`."""
        if name == FREQUENCY:
            return replace(self, frequency_hz=value)
        if name == LEVEL:
            return replace(self, acceleration_m_s2=value)
        return replace(self, model=change_parameter(self.model, name, value))


def find_parameter(model: Model, name: str) -> float:
    """Return "gap" (total, m) or a number of `Model.flatten`; InputError names an unknown one."""
    if name == GAP:
        return model.base.gap_r + model.base.gap_l
    values = model.flatten()
    if name not in values:
        raise InputError("unknown model parameter", key=name, remedy=suggest(name, [GAP, *values]))
    return values[name]


def set_total_gap(model: Model, gap_m: float) -> Model:
    """Return the model at a total gap in m, half of it on each side."""
    return Model(replace(model.base, gap_r=gap_m / 2, gap_l=gap_m / 2), model.effects)


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
