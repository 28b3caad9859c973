"""Bouc-Wen hysteresis, rate-independent with memory: high-damping rubber, wire rope.

    M u'' + C u' + K u + Fy z + F_R + F_L = -M A
    uy z' = u' - (|u'| z |z| + u' z^2) / 2,  z(0) = 0, |z| < 1

The Bouc-Wen law with exponent n = 2 and beta = gamma = 1/2: unloading is straight with slope 1/uy.
z depends on the path, not on the speed, and has a closed form between reversals of u':
    unloading (u' z < 0)  z = z0 + (u - u0) / uy     up to z = 0
    loading               z = tanh((u - u0) / uy + artanh z0)
so no integration is needed. Passive: stored Fy uy z^2 / 2, loss Fy |z|^3 |u'| while loading, none
while unloading. Added stiffness at small amplitude Fy / uy. Source: Wen 1976, J. Eng. Mech. 102(2).
"""

from twin.laws.effect import Effect, EffectParameter, State

EFFECT = Effect(
    id="bouc_wen",
    description=__doc__,
    term="Fy z, rate-independent hysteresis with memory",
    force="force * z",
    states={"z": State("", "(v - 0.5 * (abs(v) * z * abs(z) + v * z * z)) / yield_displacement")},
    compiled={"fy": "force", "uy": "yield_displacement"},
    dissipates=True,
    parameters=(
        EffectParameter("force", "N", 0.0, 1e9, 0.0, 150.0, "Fy, reached far from a reversal."),
        EffectParameter(
            "yield_displacement", "m", 1e-9, 10.0, None, 3e-3, "uy: Fy / uy is the initial slope."
        ),
    ),
    limits=("coulomb_friction",),
    residual=(
        "Stiffer and more dissipative at small amplitude; softening and loss together, the same at "
        "every frequency; a kink of the force at each reversal; present in flight."
    ),
    confused_with=("maxwell_damper", "coulomb_friction"),
)
