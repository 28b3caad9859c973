"""PRC points of a model under the ideal stepped sine: the ratios of Eq. 1 without sensors."""

from collections.abc import Sequence

import numpy as np

from table_io.block import Float2D
from table_io.records import NormalizedResponse, PrcPoint, Step
from table_io.units import GRAVITY_M_S2
from twin.model.model import Model
from twin.model.parameters import free_flight_resonance
from twin.model.stepped_sine import SteppedSineResponse


def compute_prc_points(
    model: Model,
    steps: Sequence[Step],
    response: SteppedSineResponse,
    measured_cycles: int,
    scale: tuple[float, float] | None = None,
) -> tuple[PrcPoint, ...]:
    """Return the PRC point of every step, as `twin`, averaged over the measured cycles.

    `scale` is (u* in m, a* in m/s2); by default from the linear part of the model, as in a run.
    """
    p, cycles = model.parameters, response.extremes.shape[1]
    u_star, a_star = (
        scale or free_flight_resonance(p, max(step.acceleration_m_s2 for step in steps))[:2]
    )
    frequency = np.array([step.frequency_hz for step in steps])
    start_s = np.concatenate([[0.0], np.cumsum(cycles / frequency)[:-1]])[:, None]
    end_s = start_s + np.arange(1, cycles + 1) / frequency[:, None]
    gap_opening_m = model.gap_opening_m(1.0) * end_s[:, -measured_cycles:]
    u_max, u_min, a_max, a_min, f_r, f_l, impacts_r, impacts_l = np.moveaxis(
        response.extremes[:, -measured_cycles:], 2, 0
    )
    weight = p.mass * GRAVITY_M_S2
    eta, eta_a = (u_max - u_min) / (2 * u_star), (a_max - a_min) / (2 * a_star)
    means = {
        "eta_d": eta.mean(axis=1),
        "eta_a": eta_a.mean(axis=1),
        "eta_r": _bumper_deformation(u_max - p.gap_r - gap_opening_m, f_r).mean(axis=1) / u_star,
        "eta_l": _bumper_deformation(-u_min - p.gap_l - gap_opening_m, -f_l).mean(axis=1) / u_star,
        "r_r": f_r.mean(axis=1) / weight,
        "r_l": np.abs(f_l).mean(axis=1) / weight,
        "drift": (eta[:, -1] - eta[:, 0]) / eta.mean(axis=1),
        "spread": np.ptp(eta, axis=1) / eta.mean(axis=1),
        "spread_a": np.ptp(eta_a, axis=1) / eta_a.mean(axis=1),
    }
    right, left = impacts_r.astype(int).tolist(), impacts_l.astype(int).tolist()
    return tuple(
        PrcPoint(
            0, step.index, step.direction, step.frequency_hz, None,
            NormalizedResponse(
                **{name: float(values[index]) for name, values in means.items()},
                impacts_right=tuple(right[index]), impacts_left=tuple(left[index]),
            ),
            step.acceleration_m_s2, step.acceleration_m_s2, 0.0,
        )
        for index, step in enumerate(steps)
    )  # fmt: skip


def _bumper_deformation(depth: Float2D, force: Float2D) -> Float2D:
    """Return the deformation of a bumper in m, 0 without contact."""
    return np.where(force > 0, np.maximum(depth, 0.0), 0.0)
