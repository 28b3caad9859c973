"""Attached resonator: a second mass on a spring and a dashpot on the specimen, as a cable tray.

    M u'' + C u' + K u + F_R + F_L - m2 (w2^2 p + 2 z w2 p') = -M A
    y'' = -A - w2^2 p - 2 z w2 p',  p = y - u,  w2 = 2 pi frequency

y is the displacement of the second mass m2 relative to the table. Its states are p and y', so that
the acceleration of the specimen does not enter. M is the mass without m2. Passive: stored
m2 (w2^2 p^2 + y'^2) / 2, loss 2 z w2 m2 p'^2. At a frequency far above those of the motion m2
moves with the specimen: a mass error. Source: Den Hartog 1956, Mechanical Vibrations, the absorber.
"""

import math
from collections.abc import Mapping

from twin.model.effects.effect import Effect, EffectParameter
from twin.model.parameters import Parameters


def force(w: float, s: tuple[float, ...], c: tuple[float, ...]) -> float:
    """Return the force in N on the left side; s = (p, y'), c as in `_constants`."""
    return -c[0] * s[0] - c[1] * (s[1] - w)


def rates(w: float, a: float, s: tuple[float, ...], c: tuple[float, ...]) -> tuple[float, float]:
    """Return (p', y'') in m/s and m/s2."""
    stretching = s[1] - w
    return stretching, -a - c[2] * s[0] - c[3] * stretching


def _constants(_: Parameters, values: Mapping[str, float]) -> tuple[float, ...]:
    """Return (stiffness, dashpot, stiffness / m2, dashpot / m2) of the resonator, SI."""
    w2 = 2 * math.pi * values["frequency"]
    stiffness, dashpot = w2 * w2, 2 * values["damping_ratio"] * w2
    return values["mass"] * stiffness, values["mass"] * dashpot, stiffness, dashpot


APPENDAGE = Effect(
    id="appendage",
    term="m2 (w2^2 (u - y) + 2 z w2 (u' - y')), y the displacement of an attached mass m2",
    parameters=(
        EffectParameter("mass", "kg", 0.0, 1e9, 0.0, 20.0, "m2, the attached mass."),
        EffectParameter(
            "frequency", "Hz", 1e-2, 1e3, None, 6.0, "w2 / (2 pi), with the specimen held."
        ),
        EffectParameter("damping_ratio", "", 1e-4, 2.0, None, 0.05, "z, of critical damping."),
    ),
    acts="force",
    limits=("mass_error",),
    residual=(
        "A resonance and an antiresonance close together at one frequency, whatever the amplitude; "
        "free oscillation at it after each impact; force in phase with the acceleration below it."
    ),
    confused_with=("mass_error", "maxwell_damper"),
    force=force,
    states=("stretch", "velocity"),
    rates=rates,
    constants=_constants,
    required_channels=("table_acc_m_s2",),
)
