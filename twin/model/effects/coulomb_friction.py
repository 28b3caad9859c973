"""Coulomb (dry) friction between mass and table.

    M u'' + C u' + K u + Ff + F_R + F_L = -M A
    slip: Ff = Fc sign(u');  stick: u' = 0 and |Ff| <= Fc, Ff holds the mass in place

Passive: power Fc |u'|. At u' = 0 the mass sticks if the force needed to hold it is at most Fc,
else it slips the other way; it starts to slip when that force reaches Fc. Both events are located
in time, so there is no chatter and no regularizing slope. Source: Coulomb.
"""

from twin.model.effects.effect import Effect, EffectParameter


def force(direction: float, fc: float) -> float:
    """Return Fc sign(u') in N during slip; `direction` = +1 or -1 is the sign of u', 0 if stuck."""
    return fc * direction


COULOMB_FRICTION = Effect(
    id="coulomb_friction",
    term="Fc sign(u')",
    parameters=(EffectParameter("fc", "N", 0.0, 1e9, 0.0, 50.0, "Friction force during slip."),),
    acts="force",
    is_dry_friction=True,
    residual=(
        "Loss per cycle in proportion to amplitude, so equivalent damping falls as 1/amplitude; "
        "odd harmonics in phase with u'; at small motion the mass does not move at all."
    ),
    confused_with=("bouc_wen", "quadratic_damping"),
)
