"""Gap offset: the mass does not rest midway between the bumpers.

    G0R = G/2 + offset,  G0L = G/2 - offset;  the total gap G is kept

If the specimen has unequal gaps the offset is added to them. A side without a bumper (infinite
gap) is unaffected.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

from twin.model.effects.effect import Effect, EffectParameter

if TYPE_CHECKING:
    from twin.model.parameters import Parameters


def _change(parameters: "Parameters", values: Mapping[str, float]) -> "Parameters":
    offset = values["offset"]
    return replace(parameters, gap_r=parameters.gap_r + offset, gap_l=parameters.gap_l - offset)


GAP_OFFSET = Effect(
    id="gap_offset",
    term="contact at u = G/2 + offset on the right, at u = -(G/2 - offset) on the left",
    parameters=(
        EffectParameter("offset", "m", -1.0, 1.0, 0.0, 3e-4, "Right gap minus half the total gap."),
    ),
    acts="parameters",
    place="bumpers",
    change=_change,
    residual=(
        "Contact begins early on one side and late on the other: force residual of one sign "
        "through the contact, largest at onset and release, and a mean of u. Slopes of the two "
        "F_j-v_j loops agree; their feet do not."
    ),
    confused_with=("bumper_asymmetry", "sensor_offset"),
)
