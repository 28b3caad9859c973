"""Adhesion: the bumper sticks to the mass and lets go only when it is pulled with a force.

    contact: F_j = C_j u_j' + K_j u_j;   it ends when F_j falls to -force, not to 0
    flight:  F_j = 0, that sum is zero and u_j relaxes, also from beyond its rest position

Contact begins as without it. Passive: what the stretched bumper holds at the release is lost in its
dashpot. Source: pull-off force, Johnson, Kendall and Roberts 1971, Proc. R. Soc. A 324.
"""

from twin.laws.effect import Effect, EffectParameter

EFFECT = Effect(
    id="adhesion",
    description=__doc__,
    term="contact ends at F_j = -force",
    pull_off="force",
    parameters=(
        EffectParameter("force", "N", 0.0, 1e9, 0.0, 100.0, "Tension at which contact ends."),
    ),
    place="bumpers",
    residual=(
        "Tension in the load cells just before each release, which comes later; nothing in "
        "compression."
    ),
    confused_with=("bumper_maxwell", "hunt_crossley"),
)
