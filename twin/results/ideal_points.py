"""PRC points of a model under the ideal stepped sine: the ratios of Eq. 1 without sensors."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from table_io.block import Float1D
from table_io.records import NormalizedResponse, PrcPoint, Step
from table_io.units import GRAVITY_M_S2
from twin.compare.curves import FloatND
from twin.model.model import Model
from twin.model.parameters import free_flight_resonance
from twin.model.stepped_sine import SteppedSineResponse


def compute_prc_points(
    model: Model,
    steps: Sequence[Step],
    response: SteppedSineResponse,
    cycles: int,
    measured_cycles: int,
    scale: tuple[float, float] | None = None,
) -> tuple[PrcPoint, ...]:
    """Return the PRC point of every step, as `twin`, averaged over the measured cycles.

    The last cycles of each step, of `cycles` in all, are measured. `scale` is (u* in m,
    a* in m/s2); by default from the linear part of the model, as in a run.
    """
    scale = (
        scale
        or free_flight_resonance(model.parameters, max(step.acceleration_m_s2 for step in steps))[
            :2
        ]
    )
    frequencies = np.array([step.frequency_hz for step in steps])
    extremes = response.extremes[:, -measured_cycles:]
    means = compute_ratios(ResponseScale.of_model(model, *scale), frequencies, extremes, cycles)
    right, left = (extremes[..., column].astype(int).tolist() for column in (6, 7))
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


class ResponseScale(NamedTuple):
    """What the ratios of Eq. 1 take of a model: each a number, or (case, 1, 1) of many models."""

    gap_r_m: Any
    gap_l_m: Any
    gap_opening_m_s: Any
    weight_n: Any
    u_star_m: Any
    a_star_m_s2: Any

    @classmethod
    def of_model(cls, model: Model, u_star_m: float, a_star_m_s2: float) -> "ResponseScale":
        p = model.parameters
        return cls(
            p.gap_r, p.gap_l, model.gap_opening_m(1.0), p.mass * GRAVITY_M_S2, u_star_m, a_star_m_s2
        )


@np.errstate(invalid="ignore", divide="ignore")
def compute_ratios(
    scale: ResponseScale, frequencies_hz: Float1D, extremes: FloatND, cycles: int
) -> dict[str, FloatND]:
    """Return the ratios of Eq. 1 by the names of `NormalizedResponse`, each (..., step).

    extremes (..., step, measured cycle, 8), `EXTREME_NAMES`, of the last of `cycles` at each of the
    frequencies (step,). Means over the measured cycles, and the drift and the range of eta_d and
    eta_a over them relative to the mean.
    """
    u_max, u_min, a_max, a_min, f_r, f_l, _, _ = np.moveaxis(extremes, -1, 0)
    start_s = np.concatenate([[0.0], np.cumsum(cycles / frequencies_hz)[:-1]])[:, None]
    end_s = start_s + np.arange(1, cycles + 1) / frequencies_hz[:, None]
    opening_m = scale.gap_opening_m_s * end_s[:, -extremes.shape[-2] :]
    eta = (u_max - u_min) / (2 * scale.u_star_m)
    eta_a = (a_max - a_min) / (2 * scale.a_star_m_s2)
    deformation_r = _bumper_deformation(u_max - scale.gap_r_m - opening_m, f_r) / scale.u_star_m
    deformation_l = _bumper_deformation(-u_min - scale.gap_l_m - opening_m, -f_l) / scale.u_star_m
    means = {
        "eta_d": eta,
        "eta_a": eta_a,
        "eta_r": deformation_r,
        "eta_l": deformation_l,
        "r_r": f_r / scale.weight_n,
        "r_l": np.abs(f_l) / scale.weight_n,
    }
    return {name: values.mean(axis=-1) for name, values in means.items()} | {
        "drift": (eta[..., -1] - eta[..., 0]) / eta.mean(axis=-1),
        "spread": np.ptp(eta, axis=-1) / eta.mean(axis=-1),
        "spread_a": np.ptp(eta_a, axis=-1) / eta_a.mean(axis=-1),
    }


def _bumper_deformation(depth: FloatND, force: FloatND) -> FloatND:
    """Return the deformation of a bumper in m, 0 without contact."""
    return np.where(force > 0, np.maximum(depth, 0.0), 0.0)
