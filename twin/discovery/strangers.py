"""The stranger: an unknown smooth force by place, which competes with every named effect.

Its columns are hat functions of what a force at the place can depend on: u and u' of the damper,
depth and its rate of a bumper, time, and the motion of the table. So what no effect of the library
is, has a place nevertheless.
"""

import math

import numpy as np

from table_io.block import Float1D, Float2D
from twin.discovery.parameters import ParameterSet
from twin.discovery.residuals import LogResiduals
from twin.evidence.linear import CROSSED_HATS, HATS, list_hats

DEPTH_HATS = 6


def compute_stranger_forces(
    residuals: LogResiduals, parameters: ParameterSet
) -> dict[str, list[Float2D]]:
    """Return the columns of the stranger by place: forces on D, F_R, -F_L, (3, sample) each."""
    m, scale = residuals.motion(parameters.assumed_sensors()), residuals.scale
    u, v = np.nan_to_num(m.u) / scale.u, np.nan_to_num(m.v) / scale.v
    nothing = np.zeros(u.size)

    def damper(values: Float1D) -> Float2D:
        return np.array([values, nothing, nothing])

    slow_u, slow_v = list_hats(u, CROSSED_HATS), list_hats(v, CROSSED_HATS)
    t = (m.time_s - m.time_s[0]) / max(float(np.ptp(m.time_s)), 1e-9)
    places = {
        "spring of the damper": [damper(hat) for hat in list_hats(u, HATS)],
        "damping of the damper": [damper(hat) for hat in list_hats(v, HATS)],
        "damper": [
            *(damper(hat) for hat in list_hats(u, HATS)),
            *(damper(hat) for hat in list_hats(v, HATS)),
            *(damper(hat * v) for hat in slow_u),
            *(damper(hat * u) for hat in slow_v),
        ],
        "stiffness over time": [damper(u * t**k) for k in (1, 2)],
        "damping over time": [damper(v * t**k) for k in (1, 2)],
    }
    model = parameters.model_for_log(residuals.log_number, m).parameters
    for side, sign, gap in ((0, 1.0, model.gap_r), (1, -1.0, model.gap_l)):
        touched = residuals.contact_state[side] != 0
        if not math.isfinite(gap) or not touched.any():
            continue
        depth = np.clip(sign * m.u - gap, 0.0, None) / scale.depth
        touched = touched & (depth > 0)
        rate = sign * v

        def push(values: Float1D, row: int = side, where: Float1D = touched) -> Float2D:
            forces = np.zeros((3, u.size))
            forces[1 + row] = np.where(where, values, 0.0)
            return forces

        hats = list_hats(2.0 * np.minimum(depth, 1.0) - 1.0, DEPTH_HATS)
        own = [*(push(hat) for hat in hats), *(push(hat * rate) for hat in hats[::2])]
        places["bumpers"] = [np.array(column) for column in _join(places.get("bumpers"), own)]
        places["bumpers over time"] = [
            np.array(column)
            for column in _join(places.get("bumpers over time"), [push(depth * t), push(t)])
        ]
    return places


def _join(first: list[Float2D] | None, second: list[Float2D]) -> list[Float2D]:
    """Return columns of both sides: each its own."""
    return second if first is None else [*first, *second]
