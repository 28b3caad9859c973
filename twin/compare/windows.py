"""The two twins beside a measured stream, and their errors on a fixed grid of samples.

`free` runs on the measured table acceleration alone; `window` restarts from the measured state at
every sample index that is a multiple of the window, so it can be compared sample by sample where
the motion is chaotic. Both begin at the first such index that has enough measured history.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from table_io.block import Block, Float1D, Float2D
from table_io.channels import contact_forces, rel_disp
from table_io.records import Comparison
from twin.compare import COMPARED, PREDICTED, TRACKS
from twin.compare.sensors import corrected, kept, memory, read
from twin.model.model import Model
from twin.model.parameters import Parameters
from twin.model.solver import OUTPUTS, Solver, Start

HISTORY_S = 0.1  # of measured motion, from which a restart takes u and u'
MEMORY = 8.0  # relaxation times of a bumper after which it has forgotten a contact


@dataclass(frozen=True)
class TwinSetup:
    """What the twin is and how it is compared; `from_rest` where there is nothing measured."""

    model: Model
    rate_hz: float
    window: int  # samples
    grid: int  # samples a Comparison covers
    contact_n: float
    from_rest: bool = False

    @property
    def parameters(self) -> Parameters:
        return self.model.parameters

    @cached_property
    def solver(self) -> Solver:
        return self.model.prepare(self.rate_hz)

    @cached_property
    def delay(self) -> int:
        """Samples of the past that the sensors' lags need."""
        return memory(self.model.sensors, self.rate_hz)

    @cached_property
    def history(self) -> int:
        """Samples of the past that a restart looks at."""
        p = self.parameters
        slowest = max(
            p.bumper_damping_r / p.bumper_stiffness_r, p.bumper_damping_l / p.bumper_stiffness_l
        )
        return round(min(max(HISTORY_S, MEMORY * slowest), 2.0) * self.rate_hz)


@dataclass(frozen=True, slots=True)
class Tracks:
    """State of both twins before sample `index`; `past` holds u, a - A, A, F_R, F_L (5, n).

    `late` are the last rows of the prediction before the sensors, as far as a lag looks back.
    """

    index: int
    free: Float1D | None
    window: Float1D | None
    past: Float2D
    squares: Float2D  # (3, channel, sample) of the grid cell that is not full yet
    late: Float2D


def begin(setup: TwinSetup, index: int) -> Tracks:
    """Tracks that know nothing yet and start at sample `index`."""
    free = setup.solver.rest(index - 1) if setup.from_rest else None
    nothing = np.empty((3, len(COMPARED), 0))
    return Tracks(index, free, None, np.empty((5, 0)), nothing, np.empty((len(PREDICTED), 0)))


def measured_state(u: Float1D, relative_acc: Float1D, rate_hz: float) -> tuple[float, float]:
    """(u in m, u' in m/s) at the last sample, causal.

    Least squares of displacement and twice integrated relative acceleration: with s the time before
    the last sample, u(s) = u0 + v0 s + double integral of the acceleration from there, fitted for
    u0 and v0. Noise of the accelerometer is integrated, never that of the laser differentiated.
    """
    h = 1.0 / rate_hz
    s = (np.arange(u.size) - (u.size - 1)) * h
    # velocity and displacement gained from sample k to the last one, acceleration linear between
    a0, a1 = relative_acc[:-1], relative_acc[1:]
    later = np.concatenate([np.cumsum((0.5 * h * (a0 + a1))[::-1])[::-1], [0.0]])
    step = h * later[1:] + h * h * (a0 / 6 + a1 / 3)
    fallen = np.concatenate([np.cumsum(step[::-1])[::-1], [0.0]])
    # seen from the end: u(s) = u0 + v0 s + fallen, fallen = integral (tau - s) a dtau
    y = u - fallen
    mean_s = s.mean()
    slope = float(((s - mean_s) * (y - y.mean())).sum() / ((s - mean_s) ** 2).sum())
    return float(y.mean() - slope * mean_s), slope


def _bumper(
    setup: TwinSetup, depth: Float1D, force: Float1D, stiffness: float, damping: float
) -> tuple[float, bool]:
    """(deformation magnitude in m, in contact) of one bumper at the last sample.

    `depth` is the mass's position beyond the bumper's undeformed face, `force` >= 0 its load cells.
    In contact the deformation is the depth; since release it has relaxed exponentially. Without
    load cells it is the larger of the two at any time, because no force pulls: F >= 0 is
    u_j' >= -(K/C) u_j.
    """
    if np.isnan(force).any():
        age = np.arange(depth.size - 1, -1, -1) / setup.rate_hz
        left = np.maximum(depth, 0.0) * _memory(age, stiffness, damping)
        most = int(np.nanargmax(left))
        return float(left[most]), bool(most == depth.size - 1 and left[most] > 0.0)
    touching = force > setup.contact_n
    if touching[-1]:
        return float(depth[-1]), True
    places = np.flatnonzero(touching)
    if not places.size:
        return 0.0, False
    elapsed = (depth.size - 1 - places[-1]) / setup.rate_hz
    left = max(depth[places[-1]], 0.0) * _memory(np.array(elapsed), stiffness, damping)
    return float(left), False


def _memory(age: Float1D, stiffness: float, damping: float) -> Float1D:
    """What is left of a deformation after `age` s; nothing of one without a dashpot."""
    if damping == 0.0:
        return np.where(age > 0.0, 0.0, 1.0)
    return np.exp(-age * stiffness / damping)


def _restarted(
    setup: TwinSetup, past: Float2D, index: int, table_disp: float, hidden: Float1D | None
) -> Float1D | None:
    """The model's state at sample `index`, the last one of the past; None where it is not known.

    What no sensor sees (branch forces, hysteresis) goes on from the state `hidden`: that of the
    windowed twin, whose motion is the nearest to the measured one, else of the free one, else
    relaxed.
    """
    u, relative_acc, base_acc, force_r, force_l = past
    recent = round(HISTORY_S * setup.rate_hz)
    if u.size < setup.history or not np.isfinite(past[:3, -recent:]).all():
        return None
    p, opened = setup.parameters, setup.model.opened(index / setup.rate_hz)
    gap_r, gap_l = p.gap_r + opened, p.gap_l + opened
    u0, v0 = measured_state(u[-recent:], relative_acc[-recent:], setup.rate_hz)
    u_r, touch_r = _bumper(setup, u - gap_r, force_r, p.bumper_stiffness_r, p.bumper_damping_r)
    u_l, touch_l = _bumper(setup, -u - gap_l, -force_l, p.bumper_stiffness_l, p.bumper_damping_l)
    base = float(base_acc[-1])
    start = Start(index, u0, v0, u_r, -u_l, touch_r, touch_l, base, table_disp, hidden)
    return setup.solver.restart(start)


def _lost(state: Float1D | None) -> bool:
    return state is None or bool(np.isnan(state).any())


def _run(
    state: Float1D | None, setup: TwinSetup, base_acc: Float1D, table_disp: Float1D
) -> Float2D:
    """The solver's rows (7, sample); moves `state` on."""
    out = np.full((OUTPUTS, base_acc.size), np.nan)
    if state is not None:
        setup.solver.advance(state, base_acc, table_disp, out)
    return out


def _channels(out: Float2D, table_disp: Float1D) -> list[Float1D]:
    """The solver's rows as the predicted channels of one track."""
    u, v, a, force_r, force_l = out[:5]
    half_r, half_l = 0.5 * force_r, -0.5 * force_l
    return [u, v, table_disp + u, a, half_r, half_r, half_l, half_l]


def follow(
    setup: TwinSetup, tracks: Tracks, block: Block
) -> tuple[Tracks, Block, list[Comparison]]:
    """(tracks after the block, its predicted Block, a Comparison for every grid cell completed)."""
    n = len(block)
    if block.index != tracks.index:
        tracks = begin(setup, block.index)
    base_acc = np.ascontiguousarray(block.channel("table_acc_m_s2"))
    table_disp = _column(block, "table_disp_m")
    true = corrected(setup.model.sensors, block)
    u = rel_disp(true)
    force_r, force_l = contact_forces(true)
    relative = _column(true, "mass_acc_m_s2") - base_acc
    past = np.concatenate([tracks.past, [u, relative, base_acc, force_r, force_l]], axis=1)
    before = tracks.past.shape[1]

    free = None if tracks.free is None else tracks.free.copy()
    window = None if tracks.window is None else tracks.window.copy()
    free_out, window_out = [], []
    first_restart = -block.index % setup.window
    ends = [*range(first_restart + 1, n + 1, setup.window), n]
    start = 0
    for end in ends:
        if start == end:
            continue
        drive = base_acc[start:end], table_disp[start:end]
        free_out.append(_run(free, setup, *drive))
        window_out.append(_run(window, setup, *drive))
        if (block.index + end - 1) % setup.window == 0 and not setup.from_rest:
            known = past[:, max(before + end - setup.history, 0) : before + end]
            hidden = free if _lost(window) else window
            index, displaced = block.index + end - 1, float(table_disp[end - 1])
            measured = _restarted(setup, known, index, displaced, hidden)
            window = None if measured is None else measured.copy()
            if _lost(free):
                free = measured
        start = end
    tracks_out = (np.concatenate(out, axis=1) for out in (free_out, window_out))
    exact = np.array([row for out in tracks_out for row in _channels(out, table_disp)])
    values = _read(setup, block, exact, tracks.late)
    predicted = Block(
        "pred", block.index, block.rate_hz, PREDICTED, values, block.step, block.label, block.cycle
    )
    squares, comparisons = _compare(setup, tracks.squares, block, predicted)
    after = replace(
        tracks,
        index=block.end,
        free=free,
        window=window,
        past=past[:, max(past.shape[1] - setup.history, 0) :],
        squares=squares,
        late=kept(exact, tracks.late, setup.delay),
    )
    return after, predicted, comparisons


def _column(block: Block, name: str) -> Float1D:
    """A channel, NaN where it is missing."""
    return block.channel(name) if name in block.channels else np.full(len(block), np.nan)


def _read(setup: TwinSetup, block: Block, values: Float2D, late: Float2D) -> Float2D:
    """The predicted rows as the model's sensors read them.

    Where u is measured as the difference of two sensors, so is the predicted one.
    """
    sensors = setup.model.sensors
    if not sensors:
        return values
    readings = read(sensors, setup.rate_hz, PREDICTED, values, late)
    if "rel_disp_m" not in block.channels and any(s.channel == "mass_disp_m" for s in sensors):
        for track in TRACKS:
            total = readings[PREDICTED.index(f"{track}/mass_disp_m")]
            readings[PREDICTED.index(f"{track}/rel_disp_m")] = total - _column(
                block, "table_disp_m"
            )
    return readings


def compared(block: Block) -> Float2D:
    """The compared channels of a measured block, (channel, sample); NaN where one is missing."""
    return np.array(
        [rel_disp(block) if name == "rel_disp_m" else _column(block, name) for name in COMPARED]
    )


_ROWS = [[PREDICTED.index(f"{track}/{name}") for name in COMPARED] for track in ("free", "window")]


def _compare(
    setup: TwinSetup, pending: Float2D, block: Block, predicted: Block
) -> tuple[Float2D, list[Comparison]]:
    """(squares of the cell that is not full yet, Comparisons of the full ones)."""
    measured = compared(block)
    free, window = (measured - predicted.values[rows] for rows in _ROWS)
    new = np.array([measured**2, free**2, window**2])
    squares = np.concatenate([pending, new], axis=2)
    # the first cell may begin in the middle of the grid, where the twin was started there
    first, comparisons = block.end - squares.shape[2], []
    for size, most in ((-first % setup.grid, 1), (setup.grid, block.end)):
        cells = min(squares.shape[2] // size, most) if size else 0
        if not cells:
            continue
        used = np.ascontiguousarray(squares[:, :, : cells * size])
        sums = np.add.reduce(used.reshape(*used.shape[:2], cells, size), axis=3)
        for m, f, w in sums.transpose(2, 0, 1).tolist():
            comparisons.append(Comparison(first, size, COMPARED, tuple(m), tuple(f), tuple(w)))
            first += size
        squares = squares[:, :, cells * size :]
    return squares, comparisons
