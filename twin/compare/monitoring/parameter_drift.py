"""Running estimate of the specimen's parameters, and detection of their drift.

The equations of each held cycle are summed in chunks of a few cycles, and the chunks give
    value   least squares over the recent ones
    drift   least squares over all, stiffness or gap with a linear trend in time and another in the
            logarithm of the amplitude, so that a nonlinear law is not taken for a drift
with standard deviations from the scatter among the chunks where it exceeds the noise.

A drift is reported if it is also significant for instruments as they are: plates in front of the
load cells, lasers whose slope is off, an accelerometer whose phase is not quite right, which the
damping turns into stiffness, and few chunks (Student's t). What instruments do besides depends on
the motion, so it is another one at each step, but the same where a motion comes back: motions of
one frequency and amplitude share an offset of the drifting parameter, of a size that is expected.
"""

from dataclasses import dataclass, replace

import numpy as np

from table_io.block import Float1D, Float2D, Int1D
from table_io.channels import relative_displacement
from table_io.records import Estimate, Event, Record
from twin.compare.monitoring.cycle import ChannelNoise, CycleData, MonitoringSetup
from twin.compare.monitoring.force_equations import force_equations

MIN_CHUNK_S, MIN_CHUNK_CYCLES = 1.0, 3  # least time and cycles, held in one step
RECENT_S = 30.0  # of the test, whose chunks give the value
MIN_DRIFT_CHUNKS = 8  # before a drift is reported
LOAD_CELL_GAIN_SD = 0.01  # of a contact force: constant gain error of load cells
MIN_DRIFT_SIGMA = 4.0  # standard deviations, for a drift to be reported
# Least drift of a stiffness, which a low cut known to 0.02 Hz does not explain, and of a gap, both
# relative; that of a gap to the deepest deformation.
MIN_STIFFNESS_DRIFT, MIN_GAP_DRIFT = 0.015, 0.003
# Of a stiffness per e-fold of the amplitude: how far a law may deviate from the model's, while the
# twin has stayed within its band, and after it has left it.
LAW_CURVATURE, UNTRUSTED_LAW_CURVATURE = 0.003, 0.1
MIN_AMPLITUDE_M = 1e-9
MAX_CHUNKS = 256  # chunks of a law, before neighbors are merged
PARAMETER_NAMES = (
    ("stiffness", "damping"),
    ("bumper_stiffness_r", "gap_r"),
    ("bumper_stiffness_l", "gap_l"),
)
PARAMETER_COUNTS = (4, 2, 2)  # of each law; further columns are nuisances
PLATE_MASS_SD_KG = 5.0
LASER_SLOPE_SD = 0.01  # difference of two lasers; also of u per e-fold of the amplitude
LOW_CUT_SD_RAD_S, LAG_SD_S = 2 * np.pi * 0.03, 2e-4  # of an accelerometer, after its removal
STIFFNESS_OFFSET_SD = 0.05  # of the stiffness, by what instruments do at one motion
SAME_LOG_AMPLITUDE = 0.1  # difference up to which motions of one frequency are the same
LASER_ERROR_SD_M = 1e-4  # of a gap per e-fold of the amplitude
LASER_LINEARITY = 0.006  # of the displacement, two lasers with 0.15 % of their range each
LEAST_GAP_DRIFT_M = 1e-4  # what a feeler gauge and lasers that warm up leave open
TREND_COLUMNS = (0, 1, 1)  # index of the linear parameter of each law that may drift


@dataclass(frozen=True, slots=True, eq=False)
class Chunk:
    """Normal equations of one law's n parameters, (n, n) and (n,), from `count` cycles.

    Mean time `time_s`, `duration_s` in all; `log_amplitude` is the mean logarithm of the amplitude
    of u in m.
    """

    time_s: float
    log_amplitude: float
    frequency_hz: float
    step: int
    count: int
    duration_s: float
    matrix: Float2D
    rhs: Float1D

    @property
    def full(self) -> bool:
        return self.count >= MIN_CHUNK_CYCLES and self.duration_s >= MIN_CHUNK_S


@dataclass(frozen=True, slots=True, eq=False)
class DriftState:
    """Chunks of each law so far, the last one still growing; parameters reported to drift."""

    chunks: tuple[tuple[Chunk, ...], ...] = ((), (), ())
    drifting: frozenset[str] = frozenset()
    max_depth_m: float = 0.0  # deepest bumper deformation
    max_travel_m: float = 0.0  # of table or mass: range of the lasers that was used


def update_estimate(
    setup: MonitoringSetup,
    state: DriftState,
    noise: ChannelNoise,
    cycle: CycleData,
    trusted: bool,
    doubt: bool,
) -> tuple[DriftState, list[Record]]:
    """Update with one cycle; return an Estimate when a chunk is complete, and drift Events.

    `trusted`: the twin has stayed within its band so far, so its laws hold. `doubt`: sensors
    contradict each other, so no drift is reported.
    """
    cycle_equations = force_equations(setup, noise, cycle)
    chunks = tuple(
        law_chunks
        if equations is None
        else _add_cycle(law_chunks, cycle, setup.rate_hz, *equations)
        for law_chunks, equations in zip(state.chunks, cycle_equations, strict=True)
    )
    state = replace(
        state,
        chunks=chunks,
        max_depth_m=max(state.max_depth_m, _max_depth(setup, cycle)),
        max_travel_m=max(state.max_travel_m, _max_travel(cycle)),
    )
    grown = [
        law_chunks
        for law_chunks, equations in zip(chunks, cycle_equations, strict=True)
        if equations is not None
    ]
    if not any(law_chunks[-1].full for law_chunks in grown):
        return state, []
    state, items = _report_drift(
        setup, state, cycle, LAW_CURVATURE if trusted else UNTRUSTED_LAW_CURVATURE
    )
    return state, [item for item in items if not (doubt and isinstance(item, Event))]


def _add_cycle(
    chunks: tuple[Chunk, ...], cycle: CycleData, rate_hz: float, rows: Float2D, values: Float1D
) -> tuple[Chunk, ...]:
    """Add the noise-scaled equations (equation, n) and (equation,) of a cycle."""
    duration_s = len(cycle.measured) / rate_hz
    time_s = cycle.end / rate_hz - 0.5 * duration_s
    last = chunks[-1] if chunks else None
    if last is None or last.step != cycle.step.index or last.full:
        step, zeros = cycle.step, np.zeros(rows.shape[1])
        matrix = np.zeros((zeros.size, zeros.size))
        last = Chunk(time_s, 0.0, step.frequency_hz, step.index, 0, 0.0, matrix, zeros)
    else:
        chunks = chunks[:-1]
    log_amplitude = float(
        np.log(max(np.ptp(relative_displacement(cycle.corrected)), MIN_AMPLITUDE_M))
    )
    grown = replace(
        last,
        time_s=last.time_s + (time_s - last.time_s) / (last.count + 1),
        log_amplitude=last.log_amplitude + (log_amplitude - last.log_amplitude) / (last.count + 1),
        count=last.count + 1,
        duration_s=last.duration_s + duration_s,
        matrix=last.matrix + (rows[:, :, None] * rows[:, None, :]).sum(axis=0),
        rhs=last.rhs + (rows * values[:, None]).sum(axis=0),
    )
    return (*(_merge_pairs(chunks) if len(chunks) >= MAX_CHUNKS else chunks), grown)


def _merge_pairs(chunks: tuple[Chunk, ...]) -> tuple[Chunk, ...]:
    """Return the chunks with neighbors of one step merged in pairs."""
    merged: list[Chunk] = []
    is_pair = False
    for chunk in chunks:
        last = merged[-1] if merged else None
        if last is None or is_pair or last.step != chunk.step:
            merged.append(chunk)
            is_pair = False
            continue
        merged[-1] = replace(
            chunk,
            time_s=0.5 * (last.time_s + chunk.time_s),
            log_amplitude=0.5 * (last.log_amplitude + chunk.log_amplitude),
            count=last.count + chunk.count,
            duration_s=last.duration_s + chunk.duration_s,
            matrix=last.matrix + chunk.matrix,
            rhs=last.rhs + chunk.rhs,
        )
        is_pair = True
    return tuple(merged)


def _max_depth(setup: MonitoringSetup, cycle: CycleData) -> float:
    """Return the deepest bumper deformation of the cycle in m."""
    u = relative_displacement(cycle.corrected)
    extents = [float(np.nanmax(s * u)) for s in (1, -1)] if np.isfinite(u).any() else [0.0, 0.0]
    return max(0.0, *(r - g for r, g in zip(extents, setup.gaps_m, strict=True)))


def _max_travel(cycle: CycleData) -> float:
    """Return the largest displacement of table or mass in the cycle, in m."""
    block = cycle.corrected
    lasers = [name for name in ("table_disp_m", "mass_disp_m") if name in block.channels]
    values = np.abs([block.channel(name) for name in lasers])
    return float(np.nanmax(values, initial=0.0))


def _report_drift(
    setup: MonitoringSetup, state: DriftState, cycle: CycleData, law_curvature: float
) -> tuple[DriftState, list[Record]]:
    """Return the Estimate, and an Event for each parameter that has begun to drift."""
    p = setup.model.parameters
    max_depth_m = max(state.max_depth_m, MIN_AMPLITUDE_M)
    force_scale = (
        p.stiffness,
        p.bumper_stiffness_r * max_depth_m,
        p.bumper_stiffness_l * max_depth_m,
    )
    estimates: dict[str, tuple[float, float, float, float]] = {}
    laser_error_m = max(LASER_ERROR_SD_M, LASER_LINEARITY * state.max_travel_m)
    instruments = (
        LASER_SLOPE_SD * p.stiffness,
        LASER_ERROR_SD_M * p.bumper_stiffness_r,
        LASER_ERROR_SD_M * p.bumper_stiffness_l,
    )
    offset_sds = (
        STIFFNESS_OFFSET_SD * p.stiffness,
        laser_error_m * p.bumper_stiffness_r,
        laser_error_m * p.bumper_stiffness_l,
    )
    nuisance_sds = (
        (PLATE_MASS_SD_KG, LASER_SLOPE_SD * p.stiffness, LOW_CUT_SD_RAD_S, LAG_SD_S),
        (LASER_SLOPE_SD * p.bumper_stiffness_r,),
        (LASER_SLOPE_SD * p.bumper_stiffness_l,),
    )
    full_chunks = [[c for c in each if c.count >= MIN_CHUNK_CYCLES] for each in state.chunks]
    curvatures = [law_curvature * scale for scale in force_scale]
    for law, law_names in enumerate(PARAMETER_NAMES):
        law_estimates = _law_estimates(full_chunks[law], law, curvatures[law])
        estimates |= dict(zip(law_names, law_estimates, strict=False))
    if not estimates:
        return state, []
    columns = (tuple(column) for column in zip(*estimates.values(), strict=True))
    items: list[Record] = [Estimate(cycle.end, cycle.step.index, tuple(estimates), *columns)]
    drifting = set(state.drifting)
    for law, law_names in enumerate(PARAMETER_NAMES):
        name = law_names[TREND_COLUMNS[law]]  # the one that may drift
        if name not in estimates:
            continue
        value, _, change, spread = estimates[name]
        min_change = MIN_STIFFNESS_DRIFT * abs(value)
        if name.startswith("gap"):
            min_change = max(MIN_GAP_DRIFT * state.max_depth_m, LEAST_GAP_DRIFT_M)
        has_drifted = abs(change) > max(MIN_DRIFT_SIGMA * spread, min_change)
        if not has_drifted and name not in drifting:
            continue
        change, spread, sigmas = _measure_drift(
            full_chunks[law], law, max(curvatures[law], instruments[law]), nuisance_sds[law],
            offset_sds[law],
        )  # fmt: skip
        if has_drifted and abs(change) > max(sigmas * spread, min_change):
            if name not in drifting:
                items.append(Event(cycle.end, "drift", _sentence(name, value, change, spread)))
            drifting.add(name)
        elif abs(change) < 0.5 * sigmas * spread:
            drifting.discard(name)
    return replace(state, drifting=frozenset(drifting)), items


def _sentence(name: str, value: float, change: float, spread: float) -> str:
    if name.startswith("gap"):
        return (
            f"{name} has changed by {1e3 * change:+.3f} mm (+-{2e3 * spread:.3f}) since the start, "
            f"to {1e3 * value:.3f} mm"
        )
    first = value - change
    return (
        f"{name} has changed by {100 * change / first:+.2f} % "
        f"(+-{200 * spread / first:.2f}) since the start, to {value:.5g}"
    )


def _law_estimates(
    full_chunks: list[Chunk], law: int, law_curvature: float
) -> list[tuple[float, float, float, float]]:
    """Return (value, sd, drift, sd of the drift) of both parameters of a law; empty at first.

    `law_curvature`: allowed dependence of the drifting one on the logarithm of the amplitude.
    """
    if len(full_chunks) < 2:
        return []
    since_s = min(full_chunks[-1].time_s - RECENT_S, full_chunks[-2].time_s)
    count = PARAMETER_COUNTS[law]
    recent = _solve_chunks(
        [chunk for chunk in full_chunks if chunk.time_s >= since_s], count, (), None, 0.0
    )
    if recent is None:
        return []
    (first, second), covariance = recent[0][:2], recent[1][:2, :2]
    if first <= 0:  # not a spring: too few data yet
        return []
    jacobian = np.eye(2)
    if law:  # of (K, K G) -> (K, G)
        jacobian[1] = -second / first**2, 1 / first
        second = second / first
    sd = np.sqrt(np.diag(jacobian @ covariance @ jacobian.T))
    drift = [(float("nan"), float("nan"))] * 2
    drift[TREND_COLUMNS[law]] = _measure_drift(full_chunks, law, law_curvature)[:2]
    return [(float(first), float(sd[0]), *drift[0]), (float(second), float(sd[1]), *drift[1])]


def _measure_drift(
    full_chunks: list[Chunk],
    law: int,
    law_curvature: float,
    nuisance_sds: tuple[float, ...] = (),
    offset_sd: float = 0.0,
) -> tuple[float, float, float]:
    """Return (drift, its sd, sds that make it significant) of a law's drifting parameter.

    `nuisance_sds`: expected sizes of the nuisances that are fitted too, `offset_sd` that of the
    offsets of motions. NaN while there are too few chunks.
    """
    nan = float("nan")
    if len(full_chunks) < MIN_DRIFT_CHUNKS:
        return nan, nan, nan
    trend = _solve_chunks(
        full_chunks, PARAMETER_COUNTS[law], nuisance_sds, TREND_COLUMNS[law], law_curvature,
        offset_sd,
    )  # fmt: skip
    if trend is None or trend[0][0] <= 0:
        return nan, nan, nan
    from scipy.special import ndtr, stdtrit  # slow to import, and a short test needs none

    span = full_chunks[-1].time_s - full_chunks[0].time_s
    x, spread = trend
    scale = span / x[0] if law else span
    dof = len(full_chunks) - x.size
    sigmas = float(stdtrit(dof, ndtr(MIN_DRIFT_SIGMA))) if dof > 0 else float("inf")
    return float(scale * x[-1]), float(scale * np.sqrt(spread[-1, -1])), sigmas


def _group_motions(chunks: list[Chunk]) -> Int1D:
    """Return the number of the motion of each chunk, (chunk,): by frequency and amplitude."""
    motions: dict[float, list[tuple[int, float]]] = {}  # number, log amplitude; by frequency
    numbers: list[int] = []
    count = 0
    for chunk in chunks:
        candidates = motions.setdefault(chunk.frequency_hz, [])
        for number, log_amplitude in candidates:
            if abs(log_amplitude - chunk.log_amplitude) < SAME_LOG_AMPLITUDE:
                numbers.append(number)
                break
        else:
            candidates.append((count, chunk.log_amplitude))
            numbers.append(count)
            count += 1
    return np.array(numbers)


def _solve_chunks(
    chunks: list[Chunk],
    parameter_count: int,
    nuisance_sds: tuple[float, ...],
    trend: int | None,
    law_curvature: float,
    offset_sd: float = 0.0,
) -> tuple[Float1D, Float2D] | None:
    """Return (parameters, covariance) by least squares over the chunks; None if singular.

    Columns of the equations after the parameters are nuisances of these sizes; those after them are
    not used. With a trend of one of them, two more follow:
    per e-fold of the amplitude, and per s. With an `offset_sd` each motion has an offset of that
    parameter, of that size. The covariance is that of the noise, larger where the chunks scatter
    more.
    """
    count = parameter_count + len(nuisance_sds)
    matrices = np.array([chunk.matrix[:count, :count] for chunk in chunks])
    right_sides = np.array([chunk.rhs[:count] for chunk in chunks])
    regressors = np.array([(chunk.log_amplitude, chunk.time_s) for chunk in chunks])
    expansion = np.tile(np.eye(count, count if trend is None else count + 2), (len(chunks), 1, 1))
    prior = np.zeros(expansion.shape[2])
    prior[2:parameter_count] = LOAD_CELL_GAIN_SD**-2  # load-cell gains are 1 within this
    rhs = prior.copy()
    prior[parameter_count:count] = np.array(nuisance_sds) ** -2.0
    if trend is not None:
        expansion[:, trend, count:] = regressors - regressors[0]
        prior[count] = law_curvature**-2
    rhs += (expansion.mT @ right_sides[:, :, None]).sum(axis=0)[:, 0]
    matrix = (expansion.mT @ matrices @ expansion).sum(axis=0) + np.diag(prior)
    if offset_sd:
        motion, column = _group_motions(chunks), trend or 0
        coupling = _sum_by(motion, (matrices[:, None, column] @ expansion)[:, 0])
        weight = _sum_by(motion, matrices[:, column, column]) + offset_sd**-2
        offset_rhs = _sum_by(motion, right_sides[:, column])
        eliminated = coupling / weight[:, None]
        matrix -= eliminated.T @ coupling
        rhs -= eliminated.T @ offset_rhs
    size = np.sqrt(np.diag(matrix))
    if not (size > 0).all():
        return None
    scaled = matrix / np.outer(size, size)
    if np.linalg.cond(scaled) > 1e10:
        return None
    inverse = np.linalg.inv(scaled) / np.outer(size, size)
    x: Float1D = inverse @ rhs
    left = right_sides - (matrices @ expansion) @ x
    if offset_sd:
        offset = (offset_rhs - coupling @ x) / weight
        left -= matrices[:, :, column] * offset[motion, None]
    residuals = (expansion.mT @ left[:, :, None])[:, :, 0]
    if offset_sd:
        residuals -= eliminated[motion] * left[:, column, None]
    dof_factor = len(chunks) / max(len(chunks) - x.size, 1)
    scatter = dof_factor * inverse @ (residuals.T @ residuals) @ inverse
    inflation = np.sqrt(np.maximum(np.diag(scatter) / np.diag(inverse), 1.0))
    return x, inverse * np.outer(inflation, inflation)


def _sum_by(motion: Int1D, values: Float2D) -> Float2D:
    """Return the sums of values (chunk, ...) over the chunks of each motion, (motion, ...)."""
    sums = np.zeros((int(motion.max()) + 1, *values.shape[1:]))
    np.add.at(sums, motion, values)
    return sums
