"""Gap offset: the mass does not rest midway between the bumpers.

    G0R = G/2 + offset,  G0L = G/2 - offset;  the total gap G is kept

If the specimen has unequal gaps the offset is added to them. A side without a bumper (infinite
gap) is unaffected.
"""

from twin.laws.effect import Effect, EffectParameter

EFFECT = Effect(
    id="gap_offset",
    description=__doc__,
    term="contact at u = G/2 + offset on the right, at u = -(G/2 - offset) on the left",
    changes={"gap_r": "gap_r + offset", "gap_l": "gap_l - offset"},
    parameters=(
        EffectParameter("offset", "m", -1.0, 1.0, 0.0, 3e-4, "Right gap minus half the total gap."),
    ),
    place="bumpers",
    residual=(
        "Contact begins early on one side and late on the other: force residual of one sign "
        "through the contact, largest at onset and release, and a mean of u. Slopes of the two "
        "F_j-v_j loops agree; their feet do not."
    ),
    confused_with=("bumper_asymmetry", "sensor_offset"),
)
