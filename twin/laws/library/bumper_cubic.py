"""Cubic hardening of the bumpers: rubber that is squeezed against its plate.

    contact: F_j = C_j u_j' + K_j u_j + kc u_j^3;   flight: that sum is zero, u_j relaxes

Conservative: stored kc u_j^4 / 4. Compared with `bumper_hardening`, u_j |u_j|, it is weaker at
small depth and steeper at large. Source: Taylor expansion of an elastic law.
"""

from twin.laws.effect import Effect, EffectParameter

EFFECT = Effect(
    id="bumper_cubic",
    description=__doc__,
    term="kc u_j^3 in each bumper",
    force="kc * d * d * d",
    parameters=(
        EffectParameter("kc", "N/m3", 0.0, 1e15, 0.0, 4e10, "Coefficient of the depth cubed."),
    ),
    place="bumpers",
    residual="In contact only: peak force grows with the cube of the depth; nothing near touch.",
    confused_with=("bumper_hardening", "hunt_crossley"),
)
