"""The two twins of a measured stream, and their errors on a fixed grid of samples.

`free` runs on the measured table acceleration alone; `window` restarts from the measured state at
every sample index that is a multiple of the window, so it can be compared sample by sample where
the motion is chaotic. Both begin at the first such index with enough measured history.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from table_io.block import Block, Float1D, Float2D
from table_io.channels import Channel, contact_forces, relative_displacement
from table_io.records import Comparison
from twin.compare import COMPARED_CHANNELS, PREDICTED_CHANNELS, TWIN_CHANNELS, TWIN_NAMES
from twin.compare.extra_channels import TABLE_INPUTS, predict_channel
from twin.compare.sensors import apply_sensors, keep_last, lag_samples, remove_sensor_errors
from twin.model.model import Model
from twin.model.parameters import Parameters
from twin.model.prepare import prepare_solver
from twin.model.solver import OUTPUT_COUNT, Solver, StateEstimate

HISTORY_S = 0.1  # of measured motion, from which a restart estimates u and u'
PREDICTED_ROWS = 5  # of a solver's: u, v, a, F_R, F_L
MEMORY_RELAXATION_TIMES = 8.0  # after which a bumper has forgotten a contact
HASHED_CELLS = 10  # of the comparison, in one hash of the predictions
SAVED_HASHES = 20  # between those that state the solvers' states: 2 s in blocks of 10 ms


@dataclass(frozen=True)
class TwinSetup:
    """Model of the twins and settings of the comparison; `from_rest` if nothing is measured.

    `extra_channels` are declared in the rig file, predicted by the model, and compared after
    COMPARED_CHANNELS.
    """

    model: Model
    rate_hz: float
    window_samples: int
    grid_samples: int  # samples per Comparison
    contact_n: float
    from_rest: bool = False
    extra_channels: tuple[Channel, ...] = ()

    @cached_property
    def compared_channels(self) -> tuple[str, ...]:
        """Names of the compared channels, in the order of a Comparison."""
        return (*COMPARED_CHANNELS, *(channel.name for channel in self.extra_channels))

    @property
    def parameters(self) -> Parameters:
        return self.model.parameters

    @cached_property
    def solver(self) -> Solver:
        return prepare_solver(self.model, self.rate_hz)

    @property
    def hash_samples(self) -> int:
        """Number of samples in one hash of the predictions."""
        return HASHED_CELLS * self.grid_samples

    @cached_property
    def delay_samples(self) -> int:
        """Number of past samples that the sensors' lags need."""
        return lag_samples(self.model.sensors, self.rate_hz)

    @cached_property
    def history_samples(self) -> int:
        """Number of past samples that a restart uses."""
        p = self.parameters
        slowest = max(
            p.bumper_damping_r / p.bumper_stiffness_r, p.bumper_damping_l / p.bumper_stiffness_l
        )
        return round(min(max(HISTORY_S, MEMORY_RELAXATION_TIMES * slowest), 2.0) * self.rate_hz)


SavedStates = tuple[tuple[float, ...], tuple[float, ...]]  # free and window; () while unknown


@dataclass(frozen=True, slots=True)
class TwinStates:
    """State of both twins before sample `index`; `past` holds u, a - A, A, F_R, F_L (5, n).

    `lag_history` holds the last samples of the prediction without sensor effects, as many as a lag
    needs. `failures`: the first sample, by twin, at which it was not finite on finite input.
    `saved`: the solvers' states (free, window) by the number of samples after which they were so.
    """

    index: int
    free: Float1D | None
    window: Float1D | None
    past: Float2D
    squares: Float2D  # (3, channel, sample) of the unfinished grid cell
    lag_history: Float2D
    failures: Mapping[str, int] = field(default_factory=dict)
    saved: Mapping[int, SavedStates] = field(default_factory=dict)


def start_twins(setup: TwinSetup, index: int) -> TwinStates:
    """Return twins without history that start at sample `index`."""
    free = setup.solver.rest_state(index - 1) if setup.from_rest else None
    no_squares = np.empty((3, len(setup.compared_channels), 0))
    return TwinStates(
        index, free, None, np.empty((5, 0)), no_squares, np.empty((len(TWIN_CHANNELS), 0))
    )


def resume_twins(setup: TwinSetup, saved: SavedStates, before: Block) -> TwinStates:
    """Return twins in saved states of their solvers at the end of block `before`.

    They go on as if they had computed what came before, but for a sensor's lag, which is unknown at
    first, if the block has `TwinSetup.history_samples`, or begins where the twins did.
    """
    free, window = (np.array(state) if state else None for state in saved)
    past = _measure_motion(setup, before)[:, -setup.history_samples :]
    return replace(start_twins(setup, before.end), free=free, window=window, past=past)


def _measure_motion(setup: TwinSetup, block: Block) -> Float2D:
    """Return u, a - A, A, F_R, F_L of a measured block, (5, sample), as `TwinStates.past`."""
    corrected = remove_sensor_errors(setup.model.sensors, block)
    base_acc = block.channel("table_acc_m_s2")
    relative_acc = _channel_or_nan(corrected, "mass_acc_m_s2") - base_acc
    u, forces = relative_displacement(corrected), contact_forces(corrected)
    return np.array([u, relative_acc, base_acc, *forces])


def estimate_motion(u: Float1D, relative_acc: Float1D, rate_hz: float) -> tuple[float, float]:
    """Estimate (u in m, u' in m/s) at the last sample, causally.

    Least squares of displacement and twice integrated relative acceleration: with s the time before
    the last sample, u(s) = u0 + v0 s + double integral of the acceleration from there, fitted for
    u0 and v0. Accelerometer noise is integrated; laser noise is never differentiated.
    """
    h = 1.0 / rate_hz
    s = (np.arange(u.size) - (u.size - 1)) * h
    # gain of velocity and displacement from sample k to the last, acceleration linear between
    a0, a1 = relative_acc[:-1], relative_acc[1:]
    velocity_gain = np.concatenate([np.cumsum((0.5 * h * (a0 + a1))[::-1])[::-1], [0.0]])
    step = h * velocity_gain[1:] + h * h * (a0 / 6 + a1 / 3)
    disp_gain = np.concatenate([np.cumsum(step[::-1])[::-1], [0.0]])
    # backwards from the end: u(s) = u0 + v0 s + disp_gain, disp_gain = integral (tau - s) a dtau
    y = u - disp_gain
    mean_s = s.mean()
    slope = float(((s - mean_s) * (y - y.mean())).sum() / ((s - mean_s) ** 2).sum())
    return float(y.mean() - slope * mean_s), slope


def _estimate_bumper(
    setup: TwinSetup, depth: Float1D, force: Float1D, stiffness: float, damping: float
) -> tuple[float, bool]:
    """Estimate (deformation magnitude in m, in contact) of one bumper at the last sample.

    `depth` is the mass's position beyond the bumper's undeformed face, `force` >= 0 its load cells.
    In contact the deformation is the depth; after release it relaxes exponentially. Without load
    cells it is the larger of the two at any time, because no force pulls: F >= 0 means
    u_j' >= -(K/C) u_j.
    """
    if np.isnan(force).any():
        age = np.arange(depth.size - 1, -1, -1) / setup.rate_hz
        deformation = np.maximum(depth, 0.0) * _relaxation_factor(age, stiffness, damping)
        deepest = int(np.nanargmax(deformation))
        return float(deformation[deepest]), bool(
            deepest == depth.size - 1 and deformation[deepest] > 0.0
        )
    in_contact = force > setup.contact_n
    if in_contact[-1]:
        return float(depth[-1]), True
    contact_samples = np.flatnonzero(in_contact)
    if not contact_samples.size:
        return 0.0, False
    since_contact_s = (depth.size - 1 - contact_samples[-1]) / setup.rate_hz
    deformation = max(depth[contact_samples[-1]], 0.0) * _relaxation_factor(
        np.array(since_contact_s), stiffness, damping
    )
    return float(deformation), False


def _relaxation_factor(age: Float1D, stiffness: float, damping: float) -> Float1D:
    """Return the fraction of a deformation that remains after `age` s; 0 without a dashpot."""
    if damping == 0.0:
        return np.where(age > 0.0, 0.0, 1.0)
    return np.exp(-age * stiffness / damping)


def _restart_window(
    setup: TwinSetup, past: Float2D, index: int, table_disp: float, hidden: Float1D | None
) -> Float1D | None:
    """Return the model's state at sample `index`, the last of the past; None if it is unknown.

    Unmeasured states (branch forces, hysteresis) continue from `hidden`: the windowed twin, whose
    motion is nearest to the measured one, else the free twin, else relaxed.
    """
    u, relative_acc, base_acc, force_r, force_l = past
    recent_samples = round(HISTORY_S * setup.rate_hz)
    if u.size < setup.history_samples or not np.isfinite(past[:3, -recent_samples:]).all():
        return None
    p, gap_opening = setup.parameters, setup.model.gap_opening_m(index / setup.rate_hz)
    gap_r, gap_l = p.gap_r + gap_opening, p.gap_l + gap_opening
    u0, v0 = estimate_motion(u[-recent_samples:], relative_acc[-recent_samples:], setup.rate_hz)
    u_r, contact_r = _estimate_bumper(
        setup, u - gap_r, force_r, p.bumper_stiffness_r, p.bumper_damping_r
    )
    u_l, contact_l = _estimate_bumper(
        setup, -u - gap_l, -force_l, p.bumper_stiffness_l, p.bumper_damping_l
    )
    base_acc_last = float(base_acc[-1])
    estimate = StateEstimate(
        index, u0, v0, u_r, -u_l, contact_r, contact_l, base_acc_last, table_disp, hidden
    )
    return setup.solver.restart_state(estimate)


def _is_lost(state: Float1D | None) -> bool:
    return state is None or not np.isfinite(state).all()


def _advance_twin(
    state: Float1D | None, setup: TwinSetup, base_acc: Float1D, table_disp: Float1D
) -> tuple[Float2D, int | None]:
    """Advance `state` in place; return the solver's rows (7, sample), and the sample that failed.

    The first at which the prediction, or its square, is not finite, though state and input were.
    """
    out = np.full((OUTPUT_COUNT, base_acc.size), np.nan)
    if state is None:
        return out, None
    was_known = not _is_lost(state)
    setup.solver.advance(state, base_acc, table_disp, out)
    predicted = out[:PREDICTED_ROWS]
    failed = ~np.isfinite(predicted * predicted).all(axis=0)
    first = int(failed.argmax())
    if not (was_known and failed[first]):
        return out, None
    inputs = [base_acc]
    if setup.model.uses_table_displacement:
        inputs.append(table_disp)
    is_input_known = all(np.isfinite(values[: first + 1]).all() for values in inputs)
    return out, first if is_input_known else None


def _twin_channels(out: Float2D, table_disp: Float1D) -> list[Float1D]:
    """Return the solver's rows as the predicted channels of one twin."""
    u, v, a, force_r, force_l = out[:PREDICTED_ROWS]
    half_r, half_l = 0.5 * force_r, -0.5 * force_l
    return [u, v, table_disp + u, a, half_r, half_r, half_l, half_l]


@np.errstate(over="ignore", invalid="ignore")  # of a twin that fails, which is reported
def advance_twins(
    setup: TwinSetup, twins: TwinStates, block: Block
) -> tuple[TwinStates, Block, list[Comparison]]:
    """Return (twins after the block, predicted Block, a Comparison per completed grid cell)."""
    n = len(block)
    if block.index != twins.index:
        twins = start_twins(setup, block.index)
    base_acc = np.ascontiguousarray(block.channel("table_acc_m_s2"))
    table_disp = _channel_or_nan(block, "table_disp_m")
    past = np.concatenate([twins.past, _measure_motion(setup, block)], axis=1)
    past_samples = twins.past.shape[1]

    free = None if twins.free is None else twins.free.copy()
    window = None if twins.window is None else twins.window.copy()
    outputs: dict[str, list[Float2D]] = {name: [] for name in TWIN_NAMES}
    failures, saved = dict(twins.failures), dict(twins.saved)
    saved_samples = SAVED_HASHES * setup.hash_samples
    first_restart = -block.index % setup.window_samples
    restarts = range(first_restart + 1, n + 1, setup.window_samples)
    saves = range(-block.index % saved_samples or saved_samples, n + 1, saved_samples)
    start = 0
    for end in sorted({*restarts, *saves, n}):
        drive = base_acc[start:end], table_disp[start:end]
        for name, state in zip(TWIN_NAMES, (free, window), strict=True):
            out, failed = _advance_twin(state, setup, *drive)
            outputs[name].append(out)
            if failed is not None:
                failures.setdefault(name, block.index + start + failed)
        if (block.index + end - 1) % setup.window_samples == 0 and not setup.from_rest:
            history = past[
                :, max(past_samples + end - setup.history_samples, 0) : past_samples + end
            ]
            hidden = free if _is_lost(window) else window
            index, disp = block.index + end - 1, float(table_disp[end - 1])
            restarted = _restart_window(setup, history, index, disp, hidden)
            window = None if restarted is None else restarted.copy()
            if _is_lost(free):
                free = restarted
        if end in saves:
            saved[block.index + end] = _save_state(free), _save_state(window)
        start = end
    twin_rows = (np.concatenate(rows, axis=1) for rows in outputs.values())
    true_values = np.array([row for out in twin_rows for row in _twin_channels(out, table_disp)])
    values = _apply_model_sensors(setup, block, true_values, twins.lag_history)
    predicted = Block(
        "pred",
        block.index,
        block.rate_hz,
        TWIN_CHANNELS,
        values,
        block.step,
        block.label,
        block.cycle,
    )
    new_squares = _square_errors(setup, block, predicted, true_values)
    squares, comparisons = _compare_cells(setup, twins.squares, block.end, new_squares)
    after = replace(
        twins,
        index=block.end,
        free=free,
        window=window,
        past=past[:, max(past.shape[1] - setup.history_samples, 0) :],
        squares=squares,
        lag_history=keep_last(true_values, twins.lag_history, setup.delay_samples),
        failures=failures,
        saved=saved,
    )
    return after, predicted, comparisons


def _save_state(state: Float1D | None) -> tuple[float, ...]:
    return () if state is None else tuple(state.tolist())


def _channel_or_nan(block: Block, name: str) -> Float1D:
    """Return a channel, NaN if it is missing."""
    return block.channel(name) if name in block.channels else np.full(len(block), np.nan)


def _apply_model_sensors(
    setup: TwinSetup, block: Block, values: Float2D, lag_history: Float2D
) -> Float2D:
    """Return the predicted rows with the model's sensor effects.

    If u is measured as the difference of two sensors, it is predicted the same way.
    """
    sensors = setup.model.sensors
    if not sensors:
        return values
    readings = apply_sensors(sensors, setup.rate_hz, TWIN_CHANNELS, values, lag_history)
    if "rel_disp_m" not in block.channels and any(s.channel == "mass_disp_m" for s in sensors):
        for twin_name in TWIN_NAMES:
            total = readings[TWIN_CHANNELS.index(f"{twin_name}/mass_disp_m")]
            readings[TWIN_CHANNELS.index(f"{twin_name}/rel_disp_m")] = total - _channel_or_nan(
                block, "table_disp_m"
            )
    return readings


def compared_values(block: Block) -> Float2D:
    """Return the compared channels of a measured block, (channel, sample); NaN if missing."""
    return np.array(
        [
            relative_displacement(block) if name == "rel_disp_m" else _channel_or_nan(block, name)
            for name in COMPARED_CHANNELS
        ]
    )


_ROWS = [
    [TWIN_CHANNELS.index(f"{track}/{name}") for name in COMPARED_CHANNELS]
    for track in ("free", "window")
]


def _square_errors(
    setup: TwinSetup, block: Block, predicted: Block, true_values: Float2D
) -> Float2D:
    """Return squares of measurement, free and window error, (3, channel, sample).

    `true_values` are the TWIN_CHANNELS without sensor errors.
    """
    measured = compared_values(block)
    free, window = (predicted.values[rows] for rows in _ROWS)
    if setup.extra_channels:
        count = len(PREDICTED_CHANNELS)
        measured, free, window = (
            np.vstack([canonical, *extra])
            for canonical, extra in (
                (measured, [_channel_or_nan(block, c.name) for c in setup.extra_channels]),
                (free, _predict_extra_channels(setup, block, true_values[:count])),
                (window, _predict_extra_channels(setup, block, true_values[count:])),
            )
        )
    return np.array([measured**2, (measured - free) ** 2, (measured - window) ** 2])


def _predict_extra_channels(setup: TwinSetup, block: Block, twin: Float2D) -> list[Float1D]:
    """Return the extra channels as predicted from one twin's rows, (sample,) each."""
    sources = dict(zip(PREDICTED_CHANNELS, twin, strict=True))
    sources |= {name: _channel_or_nan(block, name) for name in TABLE_INPUTS}
    return [predict_channel(channel, sources) for channel in setup.extra_channels]


def _compare_cells(
    setup: TwinSetup, pending: Float2D, end: int, new: Float2D
) -> tuple[Float2D, list[Comparison]]:
    """Return (squares of the unfinished grid cell, Comparisons of the completed ones).

    `pending` and `new` are (3, channel, sample); sample `end` follows the last of `new`.
    """
    squares = np.concatenate([pending, new], axis=2)
    # the first cell is shorter if the twin started inside it
    first, comparisons = end - squares.shape[2], []
    for size, max_cells in ((-first % setup.grid_samples, 1), (setup.grid_samples, end)):
        cells = min(squares.shape[2] // size, max_cells) if size else 0
        if not cells:
            continue
        used = np.ascontiguousarray(squares[:, :, : cells * size])
        sums = np.add.reduce(used.reshape(*used.shape[:2], cells, size), axis=3)
        for m, f, w in sums.transpose(2, 0, 1).tolist():
            comparisons.append(
                Comparison(first, size, setup.compared_channels, tuple(m), tuple(f), tuple(w))
            )
            first += size
        squares = squares[:, :, cells * size :]
    return squares, comparisons
