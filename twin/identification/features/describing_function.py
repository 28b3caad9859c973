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
from scipy.optimize import brentq

from twin.identification.features.curve import (
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
AMPLITUDE_TOL = 1e-4  # of the largest amplitude, relative
MIN_STIFFNESS_RATIO = 1e-3  # of a free motion's stiffness to the damper's
TOUCH_RATIOS = (0.999, 1.02, 1.1)  # of amplitudes about the touch of a bumper to its gap
MIN_AMPLITUDE_M, MAX_AMPLITUDE_M = 1e-6, 1.0  # between which the largest amplitude is searched

_PHASES = 2 * math.pi * np.arange(1, PRESCRIBED_CYCLES * SAMPLES_PER_CYCLE + 1) / SAMPLES_PER_CYCLE
_SINE, _COSINE = np.sin(_PHASES), np.cos(_PHASES)
_LAST = slice(-SAMPLES_PER_CYCLE, None)
# The phase of the drive to the motion is not known here: laws that feel it are approximate.
_NO_DRIVE = np.zeros_like(_PHASES)
_CONTACT = np.full((2, _PHASES.size), CONTACT_UNKNOWN, dtype=np.int8)


@dataclass(frozen=True, eq=False)
class HarmonicBalance:
    """Balance of the fundamental of a model under the acceleration A sin(w t), A in m/s2."""

    model: Model
    acceleration_m_s2: float

    @cached_property
    def _forces(self) -> PreparedForces:
        return PreparedForces.from_model(self.model)

    def describe_force(self, amplitude_m: float, w: float) -> tuple[float, float, float]:
        """Return (k, h, smallest push): force in phase with u and with u' over U, in N/m; N."""
        forces = self._forces.evaluate(
            amplitude_m * _SINE, amplitude_m * w * _COSINE, _NO_DRIVE, _PHASES / w, _CONTACT
        )[:, _LAST]
        force = forces.sum(axis=0)
        scale = 2 / (SAMPLES_PER_CYCLE * amplitude_m)
        push = min(float(forces[1].min()), -float(forces[2].max()))
        return float(scale * (force @ _SINE[_LAST])), float(scale * (force @ _COSINE[_LAST])), push

    def _drive(self, w: float) -> float:
        """Return the amplitude of the acceleration that the mass feels, in m/s2."""
        a = self.acceleration_m_s2
        return abs(a + (self.model.added_acceleration(-a / w**2) or 0.0))

    def solve_backbone(self, amplitude_m: float) -> tuple[float, float, float]:
        """Return (w in 1/s at which a free motion has this amplitude, surplus, smallest push).

        The surplus, M A / U - h in N/m, vanishes at the largest response.
        """
        p = self.model.parameters
        w, h, push = math.sqrt(p.stiffness / p.mass), 0.0, 0.0
        for _ in range(FREQUENCY_ITERATIONS + 1):
            k, h, push = self.describe_force(amplitude_m, w)
            w = math.sqrt(max(k, MIN_STIFFNESS_RATIO * p.stiffness) / p.mass)
        return w, p.mass * self._drive(w) / amplitude_m - h, push

    def find_largest_amplitude(self) -> float:
        """Return the largest amplitude in m; NaN if the loss does not limit it."""

        def surplus(log_amplitude: float) -> float:
            amplitude_m = math.exp(log_amplitude)
            return self.solve_backbone(amplitude_m)[1] * amplitude_m

        low, high = math.log(MIN_AMPLITUDE_M), math.log(MAX_AMPLITUDE_M)
        if not (surplus(low) > 0 > surplus(high)):
            return math.nan
        return math.exp(brentq(surplus, low, high, xtol=AMPLITUDE_TOL))

    def solve_frequency(self, amplitude_m: float, w: float, side: int) -> float:
        """Return w in 1/s below (side -1) or above (+1) the backbone; NaN without a solution."""
        mass = self.model.parameters.mass
        for _ in range(FREQUENCY_ITERATIONS):
            k, h, _ = self.describe_force(amplitude_m, w)
            square = (mass * self._drive(w) / amplitude_m) ** 2 - h * h
            inertia = k + side * math.sqrt(max(square, 0.0))
            if inertia <= 0:
                return math.nan
            w = math.sqrt(inertia / mass)
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
    rows: list[list[tuple[float, float, float]]] = [[], []]
    for amplitude in np.unique(amplitudes).tolist():
        w, _, push = balance.solve_backbone(amplitude)
        excess = amplitude - touch
        if p.gap_r + p.gap_l <= 0:
            stiffness = min(p.bumper_stiffness_r, p.bumper_stiffness_l)
            excess = -push / stiffness if push > 0 else max(excess, MIN_EXCESS_M)
        for row, side in zip(rows, (-1, 1), strict=True):
            if side > 0 and amplitude == largest:
                continue  # both frequencies are one
            hz = balance.solve_frequency(amplitude, w, side) / (2 * math.pi)
            if math.isfinite(hz):
                row.append((hz, amplitude, excess))
    if len(rows[0]) < MIN_CURVE_POINTS or len(rows[1]) < MIN_CURVE_POINTS:
        return None
    hz, u, excess_m = np.array(rows[0] + rows[1][::-1]).T
    stable = np.ones(hz.size, dtype=bool)
    folds = find_folds_along(hz)
    if folds is not None:
        stable[folds[0] + 1 : folds[1]] = False
    return ResponseCurve(hz, u, excess_m, stable, "describing functions")
