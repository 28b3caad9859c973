"""Bumper asymmetry: right and left bumper stiffness differ.

    K_R = 2 K ratio / (1 + ratio),  K_L = 2 K / (1 + ratio),  K the mean, which is kept

Damping is unchanged, so the relaxation times C_j/K_j differ too. If the bumpers already differ,
ratio multiplies their stiffness ratio.
"""

from twin.laws.effect import Effect, EffectParameter

EFFECT = Effect(
    id="bumper_asymmetry",
    description=__doc__,
    term="K_R u_R on the right, K_L u_L on the left, K_R/K_L = ratio",
    constants={
        "total": "bumper_stiffness_r + bumper_stiffness_l",
        "share": "ratio * bumper_stiffness_r / bumper_stiffness_l",
    },
    changes={
        "bumper_stiffness_r": "total * share / (1 + share)",
        "bumper_stiffness_l": "total / (1 + share)",
    },
    parameters=(
        EffectParameter(
            "ratio", "", 0.2, 5.0, 1.0, 1.2, "Right over left bumper stiffness, K_R/K_L."
        ),
    ),
    place="bumpers",
    residual=(
        "In contact only, of the same sign on both sides: force in proportion to |u_j|, so even "
        "harmonics of the drive. Slopes of the two F_j-v_j loops differ; their feet do not."
    ),
    confused_with=("gap_offset", "bumper_hardening"),
)
