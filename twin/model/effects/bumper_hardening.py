"""Bumper hardening: stiffness grows with compression.

    contact: F_j = C_j u_j' + K_j u_j + k2 u_j |u_j|;   flight: that sum is zero, u_j relaxes

Conservative: stored energy k2 |u_j|^3 / 3. In flight the bumper recovers faster.
"""

from twin.model.effects.effect import Effect, EffectParameter


def force(d: float, k2: float) -> float:
    """Return k2 d |d| in N, d the deformation in m, positive in compression."""
    return k2 * d * abs(d)


BUMPER_HARDENING = Effect(
    id="bumper_hardening",
    term="k2 u_j |u_j| in each bumper",
    parameters=(
        EffectParameter("k2", "N/m2", 0.0, 1e15, 0.0, 1e8, "Coefficient of depth squared."),
    ),
    acts="force",
    place="bumpers",
    residual=(
        "In contact only: the force grows faster than the depth, so peaks are underestimated and "
        "light contacts are not; F_j-v_j loops bend upwards."
    ),
    confused_with=("cubic_stiffness", "gap_offset"),
)
