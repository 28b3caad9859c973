"""Quadratic damping in the damper: drag of a fluid or of air.

    M u'' + C u' + c2 u' |u'| + K u + F_R + F_L = -M A

Odd in u', passive: power c2 |u'|^3 >= 0. Its slope has a kink where u' changes sign.
"""

from twin.model.effects.effect import Effect, EffectParameter


def force(v: float, direction: float, c2: float) -> float:
    """Return c2 v |v| in N, v in m/s; `direction` = +1 or -1 is the sign of v until a reversal."""
    return c2 * v * v * direction


QUADRATIC_DAMPING = Effect(
    id="quadratic_damping",
    term="c2 u' |u'| in the damper",
    parameters=(
        EffectParameter("c2", "N s2/m2", 0.0, 1e12, 0.0, 2e3, "Coefficient of speed squared."),
    ),
    acts="force",
    residual=(
        "Equivalent damping grows in proportion to amplitude times frequency; odd harmonics in "
        "phase with u'; nothing at low speed."
    ),
    confused_with=("coulomb_friction", "hunt_crossley"),
)
