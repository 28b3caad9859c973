"""Mass error: all forces are off by one common factor relative to the assumed mass.

    M u'' + ratio (C u' + K u + F_R + F_L) = -M A;  the same as a mass of M / ratio

Motion alone cannot distinguish it from a factor on K, C, K_j and C_j together: it is identifiable
only if a force is measured, because the forces themselves stay those of K, C, K_j and C_j.
"""

from twin.laws.effect import Effect, EffectParameter

EFFECT = Effect(
    id="mass_error",
    description=__doc__,
    term="ratio on all forces over mass",
    changes={"mass": "mass / ratio"},
    parameters=(
        EffectParameter(
            "ratio", "", 0.5, 2.0, 1.0, 1.05, "Assumed mass over true mass, forces kept."
        ),
    ),
    place="mass",
    residual=(
        "Acceleration off in proportion to the whole force, resonance moved by its root, in flight "
        "and in contact alike; load cells against M a off by the same factor."
    ),
    confused_with=("sensor_gain", "cubic_stiffness"),
)
