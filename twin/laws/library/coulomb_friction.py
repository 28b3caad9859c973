"""Coulomb (dry) friction between mass and table.

    M u'' + C u' + K u + Ff + F_R + F_L = -M A
    slip: Ff = Fc sign(u');  stick: u' = 0 and |Ff| <= Fc, Ff holds the mass in place

Passive: power Fc |u'|. At u' = 0 the mass sticks if the force needed to hold it is at most Fc,
else it slips the other way; it starts to slip when that force reaches Fc. Both events are located
in time, so there is no chatter and no regularizing slope. Source: Coulomb.
"""

from twin.laws.effect import Effect, EffectParameter

EFFECT = Effect(
    id="coulomb_friction",
    description=__doc__,
    term="Fc sign(u')",
    break_away="fc",
    dissipates=True,
    parameters=(EffectParameter("fc", "N", 0.0, 1e9, 0.0, 50.0, "Friction force during slip."),),
    residual=(
        "Loss per cycle in proportion to amplitude, so equivalent damping falls as 1/amplitude; "
        "odd harmonics in phase with u'; at small motion the mass does not move at all."
    ),
    confused_with=("bouc_wen", "quadratic_damping"),
)
