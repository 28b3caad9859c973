"""Dry friction between mass and table.

    M u'' + C u' + K u + Ff + F_R + F_L = -M A
    slip: Ff = Fc sign(u');  stick: u' = 0 and |Ff| <= Fc, Ff what keeps the mass in place

Passive: power Fc |u'|. At u' = 0 the mass sticks where the force that is needed to hold it is at
most Fc, else it slips the other way; it leaves the stick when that force reaches Fc. Both moments
are located, so there is no chatter and no regularising slope. Source: Coulomb.
"""

from twin.model.effects.effect import Effect, EffectParameter


def force(way: float, fc: float) -> float:
    """Fc sign(u') in N while the mass slips; `way` = +1 or -1 is the sign of u', 0 stuck."""
    return fc * way


COULOMB_FRICTION = Effect(
    id="coulomb_friction",
    term="Fc sign(u')",
    parameters=(EffectParameter("fc", "N", 0.0, 5e3, 0.0, 50.0, "Friction force of the slip."),),
    acts="force",
    residual=(
        "Loss per cycle in proportion to amplitude, so equivalent damping falls as 1/amplitude; "
        "odd harmonics in phase with u'; at small motion the mass does not move at all."
    ),
    confused_with=("bouc_wen", "quadratic_damping"),
)
