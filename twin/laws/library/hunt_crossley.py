"""Hunt-Crossley bumper damping: grows with compression, zero at touch.

    contact: F_j = (C_j + ch |u_j|) u_j' + K_j u_j;   flight: that sum is zero, u_j relaxes

It is added to C_j, so it vanishes with ch; the pure law, without a force jump at touch, is C_j = 0
with ch. Passive: power ch |u_j| u_j'^2. As for every bumper here, contact ends when F_j would pull;
then the bumper recovers at -K_j u_j / (C_j + ch |u_j|), slower when deep than near its face.
Source: Hunt and Crossley 1975, J. Appl. Mech. 42(2), exponent 1.
"""

from twin.laws.effect import Effect, EffectParameter

EFFECT = Effect(
    id="hunt_crossley",
    description=__doc__,
    term="ch |u_j| u_j' in each bumper",
    force="ch * abs(d) * v",
    compiled={"ch": "ch"},
    dissipates=True,
    parameters=(
        EffectParameter("ch", "N s/m2", 0.0, 1e14, 0.0, 5e5, "Damping per depth of compression."),
    ),
    place="bumpers",
    residual=(
        "In contact only: loss that grows with depth; where C_j was fitted without it, a force "
        "jump at touch that is too large and one in the middle that is too small."
    ),
    confused_with=("bumper_hardening", "bumper_maxwell"),
)
