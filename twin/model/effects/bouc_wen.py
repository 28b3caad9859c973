"""Bouc-Wen hysteresis, rate-independent with memory: high-damping rubber, wire rope.

    M u'' + C u' + K u + Fy z + F_R + F_L = -M A
    uy z' = u' - (|u'| z |z| + u' z^2) / 2,  z(0) = 0, |z| < 1

The Bouc-Wen law with exponent n = 2 and beta = gamma = 1/2: unloading is straight with slope 1/uy.
z depends on the path, not on the speed, and has a closed form between reversals of u':
    unloading (u' z < 0)  z = z0 + (u - u0) / uy     up to z = 0
    loading               z = tanh((u - u0) / uy + artanh z0)
so no integration is needed. Passive: stored Fy uy z^2 / 2, loss Fy |z|^3 |u'|. Added stiffness at
small amplitude Fy / uy. Source: Wen 1976, J. Eng. Mech. 102(2).
"""

import math

from twin.model.effects.effect import Effect, EffectParameter


def hysteretic_variable(z: float, du: float, direction: float, uy: float) -> float:
    """Return z after du m more in `direction` = +1 or -1, starting from z."""
    start = direction * z
    step = direction * du / uy
    if start < 0.0:
        if start + step <= 0.0:
            return direction * (start + step)
        return direction * math.tanh(start + step)
    gain = math.tanh(step)
    return direction * (start + gain) / (1.0 + start * gain)


BOUC_WEN = Effect(
    id="bouc_wen",
    term="Fy z, rate-independent hysteresis with memory",
    parameters=(
        EffectParameter("force", "N", 0.0, 1e9, 0.0, 150.0, "Fy, reached far from a reversal."),
        EffectParameter(
            "yield_displacement", "m", 1e-9, 10.0, None, 3e-3, "uy: Fy / uy is the initial slope."
        ),
    ),
    acts="force",
    limits=("coulomb_friction",),
    residual=(
        "Stiffer and more dissipative at small amplitude; softening and loss together, the same at "
        "every frequency; a kink of the force at each reversal; present in flight."
    ),
    confused_with=("maxwell_damper", "coulomb_friction"),
)
