"""Free runs of the model on the measured table motion, before and after, compared by PRC."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from table_io.block import Block, Label
from table_io.channels import LEFT_CELLS, RIGHT_CELLS
from table_io.records import PrcPoint, Step
from twin.compare.cycles import PrcScale
from twin.compare.pipeline import PipelineSetup, start_pipeline, step
from twin.compare.twins import TwinSetup
from twin.identification.residuals import LogResiduals
from twin.identification.selection import FittedSet
from twin.model.parameters import free_flight_resonance
from twin.reports.discovery.figure_data import DiscoveryView
from twin.reports.discovery.serialize import Json

WINDOW_S = 0.5
FreeRuns = tuple[list[PrcPoint], list[PrcPoint]]  # before, after


def run_logs_free(view: DiscoveryView) -> dict[int, FreeRuns]:
    """Return the free runs by log number; logs that cannot be run free are omitted."""
    runs: dict[int, FreeRuns] = {}
    for residuals in view.log_residuals:
        steps = view.sweep_steps(residuals.log_number)
        before, after = (run_log_free(residuals, steps, fitted) for fitted in view.before_after)
        if before and after:
            runs[residuals.log_number] = before, after
    return runs


def compute_misfits(view: DiscoveryView, runs: dict[int, FreeRuns]) -> list[Json]:
    """Return per log the peak of eta_d and its frequency in Hz, measured, before and after.

    `error` is the rms of twin minus measured eta_d over the rms of the measured curve, for both
    directions.
    """
    return [
        {
            "log": view.log_residuals[number].signals.name,
            "measured": _find_peak(runs[number][0], "measured"),
            **{
                name: _find_peak(points, "twin") | {"error": _relative_error(points)}
                for name, points in zip(("before", "after"), runs[number], strict=True)
            },
        }
        for number in runs
    ]


def _find_peak(points: Sequence[PrcPoint], source: str) -> Json:
    peaks = [
        (values.eta_d, point.frequency_hz)
        for point in points
        if (values := getattr(point, source)) is not None and math.isfinite(values.eta_d)
    ]
    peak, hz = max(peaks, default=(math.nan, math.nan))
    return {"eta_d": peak, "frequency_hz": hz}


def _relative_error(points: Sequence[PrcPoint]) -> float:
    pairs = [(p.twin.eta_d, p.measured.eta_d) for p in points if p.twin and p.measured]
    finite_pairs = [pair for pair in pairs if all(map(math.isfinite, pair))]
    if not finite_pairs:
        return math.nan
    twin, measured = np.array(finite_pairs).T
    return float(np.linalg.norm(twin - measured) / max(float(np.linalg.norm(measured)), 1e-300))


def run_log_free(
    residuals: LogResiduals, steps: Sequence[Step], fitted: FittedSet
) -> list[PrcPoint]:
    """Return the PRC points of a log, measured and of the model running free on the table motion.

    Empty if table or mass acceleration, or the steps, are missing. Signals are corrected for the
    sensor errors of the fit.
    """
    parameters = fitted.fit.parameters
    m = residuals.motion(parameters.assumed_sensors())
    if not steps or not np.isfinite(m.table_acc).all() or not np.isfinite(m.acc).all():
        return []
    measured = m.label == Label.MEASURE
    cycles = [
        np.unique(m.cycle[measured & (m.step == sweep_step.index)]).size for sweep_step in steps
    ]
    level = math.sqrt(2.0) * float(m.table_acc[measured].std()) if measured.any() else 0.0
    if level == 0.0 or max(cycles) == 0 or residuals.reference.parameters.damping == 0:
        return []
    columns = {"rel_disp_m": m.u, "table_disp_m": m.table_disp, "table_acc_m_s2": m.table_acc}
    columns["mass_acc_m_s2"] = m.acc
    if m.has_load_cells:
        columns |= dict.fromkeys(RIGHT_CELLS, 0.5 * m.right) | dict.fromkeys(
            LEFT_CELLS, 0.5 * m.left
        )
    first = round(m.time_s[0] * m.rate_hz)
    block = Block(
        "meas", first, m.rate_hz, tuple(columns), np.array([*columns.values()]),
        m.step.copy(), m.label.copy(), m.cycle.copy(),
    )  # fmt: skip
    model = parameters.model_for_log(residuals.log_number, m)
    window = round(WINDOW_S * m.rate_hz)
    contact_n = max(residuals.contact_thresholds_n)
    twin = TwinSetup(model, m.rate_hz, window, window, contact_n)
    u_star, a_star, _ = free_flight_resonance(
        replace(residuals.reference.parameters, mass=m.mass_kg), level
    )
    gaps = model.parameters.gap_r, model.parameters.gap_l
    scale = PrcScale(model.parameters, m.rate_hz, contact_n, u_star, a_star, gaps)
    driven_steps = tuple(replace(sweep_step, acceleration_m_s2=level) for sweep_step in steps)
    setup = PipelineSetup(twin, scale, driven_steps, max(cycles))
    state, _ = start_pipeline(setup, first)
    _, items = step(setup, state, block)
    return [item for item in items if isinstance(item, PrcPoint)]
