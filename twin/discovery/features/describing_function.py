"""Response curves by describing functions: the fast approximation with which features are fitted.

A motion u = U sin(w t) is prescribed; the forces of the model along it, hidden states carried, have
the fundamental k(U, w) u + h(U, w) U cos(w t). Balance of the fundamental with the drive,

    (k - M w^2)^2 + h^2 = (M A / U)^2,

gives for each amplitude U the two frequencies at which it is the response, so that a curve with its
folds is explicit. Harmonics of u are left out: frequencies are off by a few per cent, which
`search` corrects by continuation.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from table_io.block import Float1D
from twin.discovery.features.curve import (
    MIN_EXCESS_M,
    ResponseCurve,
    find_folds_along,
)
from twin.model.inverse_dynamics import CONTACT_UNKNOWN, PreparedForces
from twin.model.model import Model

SAMPLES_PER_CYCLE = 96
PRESCRIBED_CYCLES = (
    3  # of the prescribed motion; the last is evaluated, so that hidden states have settled
)
CURVE_AMPLITUDES = 24  # of a curve
MIN_AMPLITUDE_RATIO = 0.03  # of the smallest amplitude of a curve to the largest
FREQUENCY_ITERATIONS = 2  # of the frequency, on which k and h depend little
MIN_CURVE_POINTS = 3  # on each side of the resonance
# of the range of the largest amplitude, and the amplitudes of each: to 1e-3, then linearly
NARROWINGS, NARROWING_POINTS = 4, 12
MIN_STIFFNESS_RATIO = 1e-3  # of a free motion's stiffness to the damper's
TOUCH_RATIOS = (0.999, 1.02, 1.1)  # of amplitudes about the touch of a bumper to its gap
MIN_AMPLITUDE_M, MAX_AMPLITUDE_M = 1e-6, 1.0  # between which the largest amplitude is searched

_PHASES = 2 * math.pi * np.arange(1, PRESCRIBED_CYCLES * SAMPLES_PER_CYCLE + 1) / SAMPLES_PER_CYCLE
_SINE, _COSINE = np.sin(_PHASES), np.cos(_PHASES)
_LAST = slice(-SAMPLES_PER_CYCLE, None)


@dataclass(frozen=True, eq=False)
class HarmonicBalance:
    """Balance of the fundamental of a model under the acceleration A sin(w t), A in m/s2."""

    model: Model
    acceleration_m_s2: float

    @cached_property
    def _forces(self) -> PreparedForces:
        return PreparedForces.from_model(self.model)

    def describe_force(self, amplitudes_m: Float1D, w: Float1D) -> tuple[Float1D, Float1D, Float1D]:
        """Return (k, h, smallest push): force in phase with u and with u' over U, in N/m; N.

        Each (amplitude,). The motions follow one another in one evaluation, which costs less than
        one each; hidden states settle to the next amplitude in its first cycles.
        """
        u = np.outer(amplitudes_m, _SINE).ravel()
        v = np.outer(amplitudes_m * w, _COSINE).ravel()
        starts_s = np.concatenate([[0.0], np.cumsum(_PHASES[-1] / w)[:-1]])
        time_s = (starts_s[:, None] + _PHASES / w[:, None]).ravel()
        contact = np.full((2, u.size), CONTACT_UNKNOWN, dtype=np.int8)
        # the phase of the drive to the motion is not known: laws that feel it are approximate
        forces = self._forces.evaluate(u, v, np.zeros_like(u), time_s, contact)
        forces = forces.reshape(3, amplitudes_m.size, -1)[:, :, _LAST]
        force = forces.sum(axis=0)
        scale = 2 / (SAMPLES_PER_CYCLE * amplitudes_m)
        push = np.minimum(forces[1].min(axis=1), -forces[2].max(axis=1))
        return scale * (force @ _SINE[_LAST]), scale * (force @ _COSINE[_LAST]), push

    def _drive(self, w: Float1D) -> Float1D:
        """Return the amplitude of the acceleration that the mass feels, in m/s2, (amplitude,)."""
        a = self.acceleration_m_s2
        added = self.model.added_acceleration(-a / w**2)
        return np.abs(np.full_like(w, a) if added is None else a + added)

    def solve_backbone(self, amplitudes_m: Float1D) -> tuple[Float1D, Float1D, Float1D]:
        """Return (w in 1/s at which a free motion has an amplitude, surplus, smallest push).

        The surplus, M A / U - h in N/m, vanishes at the largest response. Each (amplitude,).
        """
        p = self.model.parameters
        w = np.full(amplitudes_m.size, math.sqrt(p.stiffness / p.mass))
        h = push = np.zeros_like(w)
        for _ in range(FREQUENCY_ITERATIONS + 1):
            k, h, push = self.describe_force(amplitudes_m, w)
            w = np.sqrt(np.maximum(k, MIN_STIFFNESS_RATIO * p.stiffness) / p.mass)
        return w, p.mass * self._drive(w) / amplitudes_m - h, push

    def find_largest_amplitude(self) -> float:
        """Return the largest amplitude in m; NaN if the loss does not limit it."""

        ends = math.log(MIN_AMPLITUDE_M), math.log(MAX_AMPLITUDE_M)
        for _ in range(NARROWINGS):
            logs = np.linspace(*ends, NARROWING_POINTS)
            amplitudes_m = np.exp(logs)
            surplus = self.solve_backbone(amplitudes_m)[1] * amplitudes_m
            if not (surplus[0] > 0 > surplus[-1]):
                return math.nan
            k = int((surplus > 0).argmin()) - 1  # before the first without a surplus
            ends = float(logs[k]), float(logs[k + 1])
        share = surplus[k] / (surplus[k] - surplus[k + 1])
        return math.exp(ends[0] + share * (ends[1] - ends[0]))

    def solve_frequencies(self, amplitudes_m: Float1D, w: Float1D, side: int) -> Float1D:
        """Return w in 1/s below (side -1) or above (+1) the backbone; NaN without a solution."""
        mass = self.model.parameters.mass
        for _ in range(FREQUENCY_ITERATIONS):
            solvable = np.isfinite(w)
            k, h, _ = self.describe_force(amplitudes_m, np.where(solvable, w, 1.0))
            square = (mass * self._drive(w) / amplitudes_m) ** 2 - h * h
            inertia = k + side * np.sqrt(np.maximum(square, 0.0))
            w = np.sqrt(np.where(solvable & (inertia > 0), inertia, np.nan) / mass)
        return w


def approximate_curve(model: Model, acceleration_m_s2: float) -> ResponseCurve | None:
    """Return the response curve of a model, from low to high frequency; None without a peak."""
    balance = HarmonicBalance(model, acceleration_m_s2)
    largest = balance.find_largest_amplitude()
    if math.isnan(largest):
        return None
    # Dense at the top, where both frequencies merge; and at first touch, where a fold can be.
    shares = 1 - (1 - MIN_AMPLITUDE_RATIO) * np.linspace(0, 1, CURVE_AMPLITUDES) ** 2
    amplitudes = largest * shares
    p = model.parameters
    touch = min(abs(p.gap_r), abs(p.gap_l))
    if amplitudes[-1] < touch < largest:
        amplitudes = np.append(amplitudes, touch * np.array(TOUCH_RATIOS))
    amplitudes = np.unique(amplitudes)
    w, _, push = balance.solve_backbone(amplitudes)
    excess_m = amplitudes - touch
    if p.gap_r + p.gap_l <= 0:
        stiffness = min(p.bumper_stiffness_r, p.bumper_stiffness_l)
        excess_m = np.where(push > 0, -push / stiffness, np.maximum(excess_m, MIN_EXCESS_M))
    rows = []
    for side in (-1, 1):
        hz = balance.solve_frequencies(amplitudes, w, side) / (2 * math.pi)
        # at the largest amplitude both frequencies are one
        exists = np.isfinite(hz) & ((side < 0) | (amplitudes < largest))
        rows.append(np.array([hz, amplitudes, excess_m])[:, exists])
    if min(row.shape[1] for row in rows) < MIN_CURVE_POINTS:
        return None
    hz, u, excess_m = np.concatenate([rows[0], rows[1][:, ::-1]], axis=1)
    stable = np.ones(hz.size, dtype=bool)
    folds = find_folds_along(hz)
    if folds is not None:
        stable[folds[0] + 1 : folds[1]] = False
    return ResponseCurve(hz, u, excess_m, stable, "describing functions")
