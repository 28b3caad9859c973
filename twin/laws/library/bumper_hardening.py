"""Bumper hardening: stiffness grows with compression.

    contact: F_j = C_j u_j' + K_j u_j + k2 u_j |u_j|;   flight: that sum is zero, u_j relaxes

Conservative: stored energy k2 |u_j|^3 / 3. In flight the bumper recovers faster.
"""

from twin.laws.effect import Effect, EffectParameter

EFFECT = Effect(
    id="bumper_hardening",
    description=__doc__,
    term="k2 u_j |u_j| in each bumper",
    force="k2 * d * abs(d)",
    compiled={"k2": "k2"},
    parameters=(
        EffectParameter("k2", "N/m2", 0.0, 1e15, 0.0, 1e8, "Coefficient of depth squared."),
    ),
    place="bumpers",
    residual=(
        "In contact only: the force grows faster than the depth, so peaks are underestimated and "
        "light contacts are not; F_j-v_j loops bend upwards."
    ),
    confused_with=("cubic_stiffness", "gap_offset"),
)
