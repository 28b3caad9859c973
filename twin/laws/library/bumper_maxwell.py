"""Bumper relaxation: Maxwell branch (spring and dashpot in series) parallel to K_j and C_j.

    contact: F_j = C_j u_j' + K_j u_j + b_j;   flight: that sum is zero
    always:  b_j' = kb u_j' - b_j / tau

Linear, so solved exactly. Passive: stored b_j^2 / (2 kb), loss b_j^2 / (kb tau). After a release
the branch still pulls the face back, so for about tau the gap seems larger than it is.
"""

from twin.laws.effect import Effect, EffectParameter, State

EFFECT = Effect(
    id="bumper_maxwell",
    description=__doc__,
    term="b_j in each bumper, b_j' = kb u_j' - b_j / tau",
    force="b",
    states={"b": State("N", "kb * v - b / tau")},
    compiled={"kb": "kb", "rate_b": "1 / tau"},
    is_linear=True,
    dissipates=True,
    parameters=(
        EffectParameter("kb", "N/m", 0.0, 1e12, 0.0, 2e5, "Stiffness that relaxes."),
        EffectParameter("tau", "s", 1e-4, 100.0, None, 0.05, "Relaxation time."),
    ),
    place="bumpers",
    residual=(
        "In contact only: stiffer at first and softer later, earlier release; after a recent "
        "contact the gap seems larger."
    ),
    confused_with=("gap_drift", "hunt_crossley"),
)
