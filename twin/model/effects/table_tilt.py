"""Table tilt: the table rocks as it moves, so part of the weight acts on the mass.

    M u'' + C u' + K u + F_R + F_L = -M A - M g theta,  theta = tilt x table displacement

theta in rad, positive where it pushes the mass to the left when the table is on the right;
g = 9.80665 m/s2. It acts as base acceleration A + g tilt x, so the closed form remains. The total
acceleration is u'' + A as elsewhere, in the laboratory's horizontal direction.
"""

from collections.abc import Mapping
from typing import Any

from twin.model.effects.effect import Effect, EffectParameter
from twin.model.solver import GRAVITY_M_S2


def _input_acceleration(table_disp: Any, values: Mapping[str, float]) -> Any:
    return GRAVITY_M_S2 * values["tilt"] * table_disp


TABLE_TILT = Effect(
    id="table_tilt",
    term="-M g tilt x_t on the right side, x_t the table displacement",
    parameters=(
        EffectParameter("tilt", "rad/m", -1e3, 1e3, 0.0, 0.1, "Rotation per table displacement."),
    ),
    acts="input",
    place="input",
    input_acceleration=_input_acceleration,
    required_channels=("table_disp_m",),
    residual=(
        "Force in phase with the table's displacement, so it falls with 1/f^2 at constant "
        "acceleration: quasi-static, at low frequency, in flight and in contact alike."
    ),
    confused_with=("sensor_gain", "cubic_stiffness"),
)
