"""Free runs of the model on the measured table motion: as given, refitted, with the effects."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from table_io.block import Block, Float1D, Label
from table_io.channels import LEFT_CELLS, RIGHT_CELLS
from table_io.records import PrcPoint, Step
from twin.compare.curves import PrcJump, detect_hysteresis
from twin.compare.cycles import PrcScale
from twin.compare.pipeline import PipelineSetup, start_pipeline, step
from twin.compare.twins import TwinSetup
from twin.discovery.figure_data import DiscoveryView
from twin.discovery.residuals import LogResiduals
from twin.discovery.selection import FittedSet
from twin.model.parameters import free_flight_resonance

WINDOW_S = 0.5
MODELS = ("as given", "refitted", "with the effects")


@dataclass(frozen=True, eq=False)
class FreeRun:
    """Free run of a model on a log: PRC points, and time in s, u measured and of the model in m."""

    points: list[PrcPoint]
    block: Block
    u: Float1D


FreeRuns = tuple[FreeRun, ...]  # one per model of MODELS


@dataclass(frozen=True)
class CurvePeak:
    """Peak of eta_d of a curve, its frequency in Hz, and the jumps of the curve."""

    eta_d: float
    frequency_hz: float
    jumps: list[PrcJump]


@dataclass(frozen=True)
class ModelledCurve(CurvePeak):
    """Peak and jumps of a model, and its misfit.

    `error` is the rms of model minus measured eta_d over the rms of the measured curve, for both
    directions.
    """

    label: str
    error: float


@dataclass(frozen=True)
class CurveMisfit:
    """Measured curve of a log, and that of each model."""

    log: str
    measured: CurvePeak
    models: list[ModelledCurve]


def run_logs_free(view: DiscoveryView) -> dict[int, FreeRuns]:
    """Return the free runs by log number; logs that cannot be run free are omitted."""
    runs: dict[int, FreeRuns] = {}
    for residuals in view.log_residuals:
        steps = view.sweep_steps(residuals.log_number)
        of_models = [run_log_free(residuals, steps, fitted) for fitted in view.models]
        if all(run is not None for run in of_models):
            runs[residuals.log_number] = tuple(run for run in of_models if run is not None)
    return runs


def compute_misfits(view: DiscoveryView, runs: dict[int, FreeRuns]) -> list[CurveMisfit]:
    """Return peak and jumps of eta_d of each log, measured and modelled, with the misfits."""
    return [
        CurveMisfit(
            log=view.log_residuals[number].signals.name,
            measured=CurvePeak(
                *_find_peak(of_models[0].points, "measured"),
                detect_hysteresis(of_models[0].points, "measured")[0],
            ),
            models=[
                ModelledCurve(
                    *_find_peak(run.points, "twin"),
                    detect_hysteresis(run.points, "twin")[0],
                    label,
                    _relative_error(run.points),
                )
                for label, run in zip(MODELS, of_models, strict=True)
            ],
        )
        for number, of_models in runs.items()
    ]


def _find_peak(points: Sequence[PrcPoint], source: str) -> tuple[float, float]:
    """Return (largest eta_d, its frequency in Hz)."""
    peaks = [
        (values.eta_d, point.frequency_hz)
        for point in points
        if (values := getattr(point, source)) is not None and math.isfinite(values.eta_d)
    ]
    return max(peaks, default=(math.nan, math.nan))


def _relative_error(points: Sequence[PrcPoint]) -> float:
    pairs = [(p.twin.eta_d, p.measured.eta_d) for p in points if p.twin and p.measured]
    finite_pairs = [pair for pair in pairs if all(map(math.isfinite, pair))]
    if not finite_pairs:
        return math.nan
    twin, measured = np.array(finite_pairs).T
    return float(np.linalg.norm(twin - measured) / max(float(np.linalg.norm(measured)), 1e-300))


def run_log_free(
    residuals: LogResiduals, steps: Sequence[Step], fitted: FittedSet
) -> FreeRun | None:
    """Return the run of the model on the table motion of a log, with PRC points of both.

    None if table or mass acceleration, or the steps, are missing. Signals are corrected for the
    sensor errors of the fit.
    """
    parameters = fitted.fit.parameters
    m = residuals.motion(parameters.assumed_sensors())
    if not steps or not np.isfinite(m.table_acc).all() or not np.isfinite(m.acc).all():
        return None
    measured = m.label == Label.MEASURE
    cycles = [
        np.unique(m.cycle[measured & (m.step == sweep_step.index)]).size for sweep_step in steps
    ]
    level = math.sqrt(2.0) * float(m.table_acc[measured].std()) if measured.any() else 0.0
    if level == 0.0 or max(cycles) == 0 or residuals.reference.parameters.damping == 0:
        return None
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
    points = [item for item in items if isinstance(item, PrcPoint)]
    predicted = next(item for item in items if isinstance(item, Block))
    return FreeRun(points, block, predicted.channel("free/rel_disp_m")) if points else None
