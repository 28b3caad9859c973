"""PRC points of a model on the ideal stepped sine: the ratios of Eq. 1 without any sensor."""

from collections.abc import Sequence

import numpy as np

from table_io.block import Float2D
from table_io.records import Point, Quantities, Step
from table_io.units import GRAVITY_M_S2
from twin.model.model import Model
from twin.model.parameters import resonance
from twin.model.sweep import SteppedSine


def points(
    model: Model,
    steps: Sequence[Step],
    played: SteppedSine,
    measured_cycles: int,
    stars: tuple[float, float] | None = None,
) -> tuple[Point, ...]:
    """The PRC point of every step as `twin`, means over its last cycles.

    u* and a* are those of the model's linear part, as in a run, unless `stars` gives others.
    """
    p, held = model.parameters, played.extremes.shape[1]
    u_star, a_star = stars or resonance(p, max(step.acceleration_m_s2 for step in steps))[:2]
    frequency = np.array([step.frequency_hz for step in steps])
    begins = np.concatenate([[0.0], np.cumsum(held / frequency)[:-1]])[:, None]
    ends_s = begins + np.arange(1, held + 1) / frequency[:, None]
    opened = model.opened(1.0) * ends_s[:, -measured_cycles:]
    u_max, u_min, a_max, a_min, f_r, f_l, hits_r, hits_l = np.moveaxis(
        played.extremes[:, -measured_cycles:], 2, 0
    )
    weight = p.mass * GRAVITY_M_S2
    eta = (u_max - u_min) / (2 * u_star)
    means = {
        "eta_d": eta.mean(axis=1),
        "eta_a": ((a_max - a_min) / (2 * a_star)).mean(axis=1),
        "eta_r": _deformation(u_max - p.gap_r - opened, f_r).mean(axis=1) / u_star,
        "eta_l": _deformation(-u_min - p.gap_l - opened, -f_l).mean(axis=1) / u_star,
        "r_r": f_r.mean(axis=1) / weight,
        "r_l": np.abs(f_l).mean(axis=1) / weight,
        "drift": (eta[:, -1] - eta[:, 0]) / eta.mean(axis=1),
        "spread": np.ptp(eta, axis=1) / eta.mean(axis=1),
    }
    right, left = hits_r.astype(int).tolist(), hits_l.astype(int).tolist()
    return tuple(
        Point(
            0, step.index, step.direction, step.frequency_hz, None,
            Quantities(
                **{name: float(values[place]) for name, values in means.items()},
                impacts_right=tuple(right[place]), impacts_left=tuple(left[place]),
            ),
            step.acceleration_m_s2, step.acceleration_m_s2, 0.0,
        )
        for place, step in enumerate(steps)
    )  # fmt: skip


def _deformation(depth: Float2D, force: Float2D) -> Float2D:
    """Deformation of a bumper in m, 0 where it was not touched."""
    return np.where(force > 0, np.maximum(depth, 0.0), 0.0)
