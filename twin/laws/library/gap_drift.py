"""Gap drift: gaps open or close during the test (loose anchor, creeping or warming bumper).

    G0R(t) = G0R + rate t,  G0L(t) = G0L + rate t;  t in s from sample 0 of the run

The wall moves with `rate`, so in contact u_R' = u' - rate and u_L' = u' + rate; the solver follows
the moving wall continuously within every step. A side without a bumper is unaffected.
"""

from twin.laws.effect import Effect, EffectParameter

EFFECT = Effect(
    id="gap_drift",
    description=__doc__,
    term="both gaps grow by rate x time",
    gap_rate="rate",
    is_linear=True,
    parameters=(
        EffectParameter(
            "rate", "m/s", -1.0, 1.0, 0.0, 5e-6, "Opening speed of the gap of each side."
        ),
    ),
    place="bumpers",
    residual=(
        "Onset and release move with time on both sides alike, not with frequency: the backward "
        "sweep has other gaps than the forward sweep."
    ),
    confused_with=("bumper_maxwell", "gap_offset"),
)
