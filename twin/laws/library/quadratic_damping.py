"""Quadratic damping in the damper: drag of a fluid or of air.

    M u'' + C u' + c2 u' |u'| + K u + F_R + F_L = -M A

Odd in u', passive: power c2 |u'|^3 >= 0. Its slope has a kink where u' changes sign.
"""

from twin.laws.effect import Effect, EffectParameter

EFFECT = Effect(
    id="quadratic_damping",
    description=__doc__,
    term="c2 u' |u'| in the damper",
    force="c2 * v * v * sign(v)",
    compiled={"c2": "c2"},
    dissipates=True,
    parameters=(
        EffectParameter("c2", "N s2/m2", 0.0, 1e12, 0.0, 2e3, "Coefficient of speed squared."),
    ),
    residual=(
        "Equivalent damping grows in proportion to amplitude times frequency; odd harmonics in "
        "phase with u'; nothing at low speed."
    ),
    confused_with=("coulomb_friction", "hunt_crossley"),
)
