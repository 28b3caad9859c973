"""Bumper damping that grows with compression, none at touch.

    contact: F_j = (C_j + ch |u_j|) u_j' + K_j u_j;   flight: that sum is zero, u_j relaxes

It comes on top of C_j, so it vanishes with ch; the pure law, without any jump of the force at
touch, is C_j = 0 with ch. Passive: power ch |u_j| u_j'^2. Contact ends, as for every bumper here,
when F_j would pull; from then on the bumper recovers at -K_j u_j / (C_j + ch |u_j|), slower when
deep than near its face. Source: Hunt and Crossley 1975, J. Appl. Mech. 42(2), exponent 1.
"""

from twin.model.effects.effect import Effect, EffectParameter


def damping(d: float, ch: float) -> float:
    """ch |d| in N s/m, d the deformation in m."""
    return ch * abs(d)


HUNT_CROSSLEY = Effect(
    id="hunt_crossley",
    term="ch |u_j| u_j' in each bumper",
    parameters=(
        EffectParameter("ch", "N s/m2", 0.0, 1e9, 0.0, 5e5, "Damping per depth of compression."),
    ),
    acts="force",
    residual=(
        "In contact only: loss that grows with depth; where C_j was fitted without it, a force "
        "jump at touch that is too large and one in the middle that is too small."
    ),
    confused_with=("bumper_hardening", "bumper_maxwell"),
)
