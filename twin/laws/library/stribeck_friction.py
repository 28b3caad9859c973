"""Stribeck friction: dry friction that is largest at rest and falls as the mass begins to slide.

    M u'' + C u' + K u + Ff + F_R + F_L = -M A
    slip: Ff = Fc (1 + (ratio - 1) exp(-(u' / speed)^2)) sign(u')
    stick: u' = 0 and |Ff| <= ratio Fc, Ff holds the mass in place

Stick and slip are events as those of `coulomb_friction`, whose break-away force is ratio Fc here;
the law below is what the friction falls by during slip, zero at u' = 0. With Coulomb friction it
adds up. Passive: power >= Fc |u'|. ratio = 1 is Coulomb friction. Source: Stribeck 1902; the
exponential form Bo and Pavelescu 1982, Wear 82(3).
"""

from twin.laws.effect import Effect, EffectParameter

EFFECT = Effect(
    id="stribeck_friction",
    description=__doc__,
    term="Fc (1 + (ratio - 1) exp(-(u' / speed)^2)) sign(u')",
    constants={"fall": "fc * (ratio - 1)"},
    force="fall * expm1(-((v / speed) ** 2)) * sign(v)",
    break_away="fc * ratio",
    dissipates=True,
    parameters=(
        EffectParameter("fc", "N", 0.0, 1e9, 0.0, 40.0, "Friction force during fast slip."),
        EffectParameter("ratio", "", 1.0, 30.0, None, 3.0, "Break-away force over Fc."),
        EffectParameter("speed", "m/s", 1e-5, 1e3, None, 0.02, "At which it has fallen by 63 %."),
    ),
    limits=("coulomb_friction",),
    residual=(
        "As Coulomb friction, with a peak at each reversal: sticks longer and lets go with a jerk; "
        "the loss per cycle grows less than in proportion to the amplitude."
    ),
    confused_with=("coulomb_friction", "bouc_wen"),
)
