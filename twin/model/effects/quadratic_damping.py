"""The damper loses more at speed: drag of a fluid or of air.

    M u'' + C u' + c2 u' |u'| + K u + F_R + F_L = -M A

Odd in u', passive: power c2 |u'|^3 >= 0. Where u' changes sign its slope has a kink.
"""

from twin.model.effects.effect import Effect, EffectParameter


def force(v: float, way: float, c2: float) -> float:
    """c2 v |v| in N, v in m/s; `way` = +1 or -1 is the sign that v has in this phase."""
    return c2 * v * v * way


QUADRATIC_DAMPING = Effect(
    id="quadratic_damping",
    term="c2 u' |u'| in the damper",
    parameters=(
        EffectParameter("c2", "N s2/m2", 0.0, 1e6, 0.0, 2e3, "Coefficient of speed squared."),
    ),
    acts="force",
    residual=(
        "Equivalent damping grows in proportion to amplitude times frequency; odd harmonics in "
        "phase with u'; nothing at low speed."
    ),
    confused_with=("coulomb_friction", "hunt_crossley"),
)
