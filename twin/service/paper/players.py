"""What moves a model through the paper's motions: in closed form where that is all it needs, else
integrated and sampled. Pictures and findings ask a player and do not care which.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import final

import numpy as np

from table_io.block import Float1D, Float2D
from twin.model import exact, orbit
from twin.model.integrate import AT_F, AT_Z
from twin.model.model import Model
from twin.model.parameters import Parameters
from twin.model.phase import CONTACT_L, CONTACT_R
from twin.model.solver import OUTPUTS, Solver
from twin.model.sweep import EXTREMES, SteppedSine, stepped_sine

SMOOTH = 2000  # samples a cycle of the motions in the pictures
COARSE = 300  # and where only extremes, onsets and growth are wanted
PIECE = 100  # cycles at once
NUDGE = 1e-9  # m: how far the second of two motions starts from the first


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Motion over some cycles, SI, right positive, (sample,); v_r, v_l: positions of the bumpers.

    A bumper without force stands still there or relaxes; a measured one is NaN out of contact.
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
class Player(ABC):
    """A model under A = a sin(2 pi f t). A state is at a zero upcrossing of A; none is changed."""

    model: Model

    @property
    def parameters(self) -> Parameters:
        """The linear part of the model."""
        return self.model.parameters

    def at_gap(self, gap_mm: float) -> "Player":
        """The same model at another total gap, half of it a side."""
        base = replace(self.model.base, gap_r=gap_mm / 2e3, gap_l=gap_mm / 2e3)
        return type(self)(Model(base, self.model.effects))

    @property
    @abstractmethod
    def exact(self) -> bool:
        """True where folds, unstable motions and exponents follow from the one-period map."""

    @abstractmethod
    def sweep(
        self, hz: Sequence[float] | Float1D, a: float, cycles: int, state: Float1D | None = None
    ) -> SteppedSine:
        """Whole cycles at each frequency, from a state or from rest, carried through."""

    @abstractmethod
    def sampled(self, hz: float, a: float, state: Float1D, cycles: int) -> Float2D:
        """u, v, total acceleration, F_R, F_L, u_R, u_L in SI, (7, `SMOOTH` a cycle)."""

    @abstractmethod
    def onsets(
        self, hz: float, a: float, state: Float1D, cycles: int
    ) -> tuple[Float1D, Float1D, Float1D]:
        """(right, left: times in cycles at which contact begins; the state after it)."""

    @abstractmethod
    def exponent(self, hz: float, a: float, state: Float1D, cycles: int) -> float:
        """Largest Lyapunov exponent per cycle, from a settled state."""

    def motion(self, hz: float, a: float, state: Float1D, cycles: int) -> Motion:
        """The motion from a state on, for a picture."""
        p, rate = self.parameters, hz * SMOOTH
        u, v, acc, force_r, force_l, u_r, u_l = self.sampled(hz, a, state, cycles)
        time = np.arange(u.size) / rate
        return Motion(time, u, v, acc, force_r, force_l, u_r + p.gap_r, u_l - p.gap_l)

    def at_rest(self) -> dict[str, float]:
        """u_r, u_l in m and f_r, f_l in N, all >= 0, of bumpers while the table stands still."""
        state = self.sweep([1.0], 0.0, 1).states[0]
        out = self.sampled(1.0, 0.0, state, 1)[:, -1].tolist()
        return {"u_r": out[5], "u_l": -out[6], "f_r": out[3], "f_l": -out[4]}


@final
class Closed(Player):
    """Closed form between events."""

    @property
    def exact(self) -> bool:
        return True

    def sweep(
        self, hz: Sequence[float] | Float1D, a: float, cycles: int, state: Float1D | None = None
    ) -> SteppedSine:
        return stepped_sine(self.parameters, hz, a, cycles, state=state)

    def sampled(self, hz: float, a: float, state: Float1D, cycles: int) -> Float2D:
        count = cycles * SMOOTH
        base = a * np.sin(2 * math.pi * np.arange(1, count + 1) / SMOOTH)
        out = np.empty((OUTPUTS, count))
        exact.advance(state.copy(), exact.constants(self.parameters, hz * SMOOTH), base, out)
        return out

    def onsets(
        self, hz: float, a: float, state: Float1D, cycles: int
    ) -> tuple[Float1D, Float1D, Float1D]:
        return orbit.onsets(self.parameters, hz, a, state, cycles)

    def exponent(self, hz: float, a: float, state: Float1D, cycles: int) -> float:
        return orbit.lyapunov(self.parameters, hz, a, state, cycles)[0]


@final
class Sampled(Player):
    """Integrated, the drive linear between samples; extremes are those of the samples."""

    @property
    def exact(self) -> bool:
        return False

    def _advance(
        self, hz: float, a: float, state: Float1D, cycles: int, samples: int = COARSE
    ) -> Float2D:
        """Moves `state` on; the solver's rows (7, cycles x samples a cycle)."""
        wave = np.sin(2 * math.pi * np.arange(1, cycles * samples + 1) / samples)
        out = np.empty((OUTPUTS, wave.size))
        table = -a / (2 * math.pi * hz) ** 2 * wave
        prepared(self.model, samples * hz).advance(state, a * wave, table, out)
        return out

    def _samples(self, hz: float) -> int:
        """Samples a cycle, enough to follow a contact."""
        return COARSE * math.ceil(max(1.0, self.model.least_rate_hz / (COARSE * hz)))

    def sweep(
        self, hz: Sequence[float] | Float1D, a: float, cycles: int, state: Float1D | None = None
    ) -> SteppedSine:
        moving = prepared(self.model, self._samples(1.0)).rest() if state is None else state.copy()
        extremes, ends = np.empty((len(hz), cycles, len(EXTREMES))), []
        for place, one in enumerate(np.asarray(hz).tolist()):
            touching = moving[CONTACT_R] > 0, moving[CONTACT_L] > 0
            samples = self._samples(one)
            out = self._advance(one, a, moving, cycles, samples)
            extremes[place] = _extremes(out, samples, touching)
            ends.append(moving.copy())
        return SteppedSine(extremes, np.array(ends))

    def sampled(self, hz: float, a: float, state: Float1D, cycles: int) -> Float2D:
        return self._advance(hz, a, state.copy(), cycles, SMOOTH)

    def onsets(
        self, hz: float, a: float, state: Float1D, cycles: int
    ) -> tuple[Float1D, Float1D, Float1D]:
        found: tuple[list[Float1D], list[Float1D]] = ([], [])
        moving = state.copy()
        samples = self._samples(hz)
        for first in range(0, cycles, PIECE):
            touching = moving[CONTACT_R] > 0, moving[CONTACT_L] > 0
            out = self._advance(hz, a, moving, min(PIECE, cycles - first), samples)
            for side, begins in enumerate(_begins(out, touching)):
                found[side].append(first + (np.flatnonzero(begins) + 1) / samples)
        return np.concatenate(found[0]), np.concatenate(found[1]), moving

    def exponent(self, hz: float, a: float, state: Float1D, cycles: int) -> float:
        """From the growth of the distance between two motions, brought back after each cycle."""
        one, other, samples = state.copy(), state.copy(), self._samples(hz)
        other[0] += NUDGE
        growth = 0.0
        for _ in range(cycles):
            for moving in (one, other):
                self._advance(hz, a, moving, 1, samples)
            apart = math.hypot(other[0] - one[0], other[1] - one[1])
            growth += math.log(max(apart, 1e-6 * NUDGE) / NUDGE)
            other = _brought_back(one, other, NUDGE / apart if apart > 0 else 1.0)
        return growth / cycles


@lru_cache(64)
def prepared(model: Model, rate_hz: float) -> Solver:
    """The solver; what is linear is costly to prepare, and a motion comes back to its rate."""
    return model.prepare(rate_hz)


def _brought_back(one: Float1D, other: Float1D, share: float) -> Float1D:
    """The state on the way from one to the other; contact and way are those of the first."""
    moved = one.copy()
    for places in (slice(0, CONTACT_R), slice(AT_F, AT_Z + 1)):
        moved[places] += share * (other[places] - one[places])
    return moved


def _begins(out: Float2D, touching: tuple[bool, bool]) -> list[Float1D]:
    """Where contact begins, right and left, (sample,); `touching` before the first."""
    found = []
    for force, before in ((out[3], touching[0]), (-out[4], touching[1])):
        contact = np.concatenate([[before], force > 0])
        found.append(contact[1:] & ~contact[:-1])
    return found


def _extremes(out: Float2D, samples: int, touching: tuple[bool, bool]) -> Float2D:
    """`EXTREMES` of each cycle, (cycle, 8)."""
    u, _, a, right, left, _, _ = out.reshape(OUTPUTS, -1, samples)
    onsets = [one.reshape(-1, samples).sum(axis=1) for one in _begins(out, touching)]
    most = [u.max(axis=1), u.min(axis=1), a.max(axis=1), a.min(axis=1)]
    return np.stack([*most, right.max(axis=1), left.min(axis=1), *onsets], axis=1)


def player(model: Model) -> Player:
    """Whoever can play this model."""
    if all(one.effect.acts in ("parameters", "sensor") for one in model.present):
        return Closed(model)
    return Sampled(model)
