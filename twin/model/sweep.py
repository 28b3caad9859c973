"""The SNM on the ideal stepped sine, in closed form: what `simulate` and ideal PRCs stand on."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import float64, int64, types

from table_io.block import Float1D, Float2D, Int1D
from twin.model.compiled import compiled
from twin.model.exact import parameter_constants, rest, substeps
from twin.model.parameters import Parameters
from twin.model.phase import (
    BASE,
    CONTACT_L,
    CONTACT_R,
    MASS,
    MODE_SIZE,
    MODES,
    MOST_EVENTS,
    REVISION,
    STATE_SIZE,
    Motion,
    Point,
    Quantity,
    guard,
    leap,
    motion_at,
    root,
    value,
)  # fmt: skip

Float3D = npt.NDArray[np.float64]

EXTREMES = ("u_max", "u_min", "a_max", "a_min", "f_r_max", "f_l_min", "onsets_r", "onsets_l")
LEAST_STEPS = 8  # a cycle: fewer, and a contact could begin and end unseen


@compiled()
def span(h: float, m: Motion, q: Quantity, x0: Point, x1: Point) -> tuple[float, float]:
    """(least, greatest) q over a phase of h s, from the root of its slope; x at both ends."""
    a, da, _ = value(0.0, x0, q)
    b, db, _ = value(h, x1, q)
    lo, hi = min(a, b), max(a, b)
    if da * db < 0:
        t = root(0.0, h, m, q, 1)
        a = value(t, motion_at(t, m), q)[0]
        lo, hi = min(a, lo), max(a, hi)
    return lo, hi


@compiled()
def widen(
    extremes: Float1D, con: Float1D, mode: int, h: float, m: Motion, x0: Point, x1: Point
) -> None:
    """Widens `extremes` (`EXTREMES`) by a phase of h s."""
    b = MODES + mode * MODE_SIZE
    mass = con[MASS]
    lo, hi = span(h, m, (0.0, 1.0, 0.0, 0.0, 0.0), x0, x1)
    extremes[0], extremes[1] = max(extremes[0], hi), min(extremes[1], lo)
    total = (con[b + 2] / mass, -con[b] / mass, -con[b + 1] / mass, 0.0, 0.0)
    lo, hi = span(h, m, total, x0, x1)
    extremes[2], extremes[3] = max(extremes[2], hi), min(extremes[3], lo)
    if mode & 1:
        extremes[4] = max(extremes[4], span(h, m, guard(con, mode, 0, 0.0), x0, x1)[1])
    if mode & 2:
        extremes[5] = min(extremes[5], -span(h, m, guard(con, mode, 1, 0.0), x0, x1)[1])


@compiled(
    types.void(
        float64[::1], float64[::1], float64[::1], float64[::1], int64, int64[::1],
        float64[:, :, ::1], float64[:, ::1], types.Omitted(REVISION),
    ),
    cache=True,
)  # fmt: skip
def stepped(
    state: Float1D, con: Float1D, w: Float1D, peaks: Float1D, cycles: int, steps: Int1D,
    extremes: Float3D, ends: Float2D, revision: int = REVISION,
) -> None:  # fmt: skip
    """Whole cycles of A = peak sin(w t) at each w in 1/s, `steps` steps a cycle, carried through.

    extremes (w, cycle, 8), `EXTREMES`; ends (w, STATE_SIZE): the state after each w.
    """
    for i in range(w.size):
        turn = 2 * math.pi / steps[i]
        h = turn / w[i]
        for cycle in range(cycles):
            row = extremes[i, cycle]
            row[0], row[1], row[2], row[3] = -math.inf, math.inf, -math.inf, math.inf
            row[4:] = 0.0
            for k in range(steps[i]):
                t = 0.0
                for attempt in range(MOST_EVENTS):
                    mode = int(state[CONTACT_R] > 0) + 2 * int(state[CONTACT_L] > 0)
                    wave = (peaks[i], w[i], turn * k + w[i] * t)
                    search = attempt + 1 < MOST_EVENTS
                    dt, side, m, x0, x1 = leap(state, con, h - t, 0.0, 0.0, wave, search)
                    widen(row, con, mode, dt, m, x0, x1)
                    t += dt
                    if side < 0:
                        break
                    row[6 + side] += state[CONTACT_R + side]
        ends[i] = state


@dataclass(frozen=True, slots=True, eq=False)
class SteppedSine:
    """extremes (step, cycle, 8), `EXTREMES`, SI; states (step, STATE_SIZE) at the end of each step.

    Extremes are true ones, from roots of the slope and from both sides of a jump, not samples.
    F_R >= 0, F_L <= 0; onsets are counted in the cycle in which they happen.
    """

    extremes: Float3D
    states: Float2D

    def column(self, name: str) -> Float2D:
        """One of `EXTREMES`, (step, cycle)."""
        return self.extremes[:, :, EXTREMES.index(name)]


def stepped_sine(
    parameters: Parameters,
    frequencies_hz: Sequence[float] | Float1D,
    acceleration: float,
    cycles: int,
    steps_per_cycle: int = 16,
    state: Float1D | None = None,
) -> SteppedSine:
    """Whole `cycles` of A = acceleration sin(2 pi f t) at each frequency, in m/s2, carried through.

    Starts from `state` (left as it is) or from rest. A is continuous at a change of frequency; the
    velocity of the table is not, so this is the ideal sweep, which no table can drive.
    `steps_per_cycle` is raised where a contact turns more than `exact.TURN` in a step; the result
    does not depend on it where the motion is not chaotic.
    """
    frequencies = np.asarray(frequencies_hz, dtype=np.float64)
    if steps_per_cycle < LEAST_STEPS:
        raise ValueError(f"steps_per_cycle {steps_per_cycle}: allowed: {LEAST_STEPS} or more")
    con = parameter_constants(parameters)
    steps = np.array(
        [steps_per_cycle * substeps(con, 1 / (f * steps_per_cycle)) for f in frequencies],
        dtype=np.int64,
    )
    moving = rest(parameters) if state is None else state.copy()
    moving[BASE] = 0.0
    extremes = np.empty((frequencies.size, cycles, len(EXTREMES)))
    ends = np.empty((frequencies.size, STATE_SIZE))
    peaks = np.full(frequencies.size, acceleration)
    stepped(moving, con, 2 * math.pi * frequencies, peaks, cycles, steps, extremes, ends)
    return SteppedSine(extremes, ends)
