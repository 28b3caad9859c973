"""The integrated model on sampled table acceleration: state in, state out.

The state is float64 (STATE_SIZE,); its first seven entries are those of `exact`:
    u, v, u_r, u_l, contact_r, contact_l, A      as there
    f, b_r, b_l                                  branch forces in N, of u's sign
    z, way                                       hysteresis; sign of u', 0 where the mass sticks
    clock                                        samples since sample 0 of the run
It is the whole memory: cutting the samples into other blocks changes no bit.
"""

import math
from collections.abc import Callable

from numba import float64, types

from table_io.block import Float1D, Float2D
from twin.model.compiled import compiled, inner, revision
from twin.model.events import REVISION as EVENTS_REVISION
from twin.model.events import TURN_GUARD, Moved, leap
from twin.model.laws import (
    C_L,
    C_R,
    CH,
    CONSTANTS_SIZE,
    DRIFT,
    EXTRA_TYPE,
    FC,
    FY,
    G_L,
    G_R,
    GAP_L,
    GAP_R,
    KB,
    PARTS,
    PERIOD,
    STEP,
    U_0,
    U_L,
    U_R,
    UY,
    Z_0,
    Constants,
    Extra,
    Frame,
    Point,
    U,
    V,
    bumper,
    drive,
    face,
    hold,
    hysteretic,
)  # fmt: skip
from twin.model.solver import OUTPUTS

CONTACT_R, CONTACT_L, AT_BASE, AT_F, AT_B_R, AT_B_L, AT_Z, WAY, CLOCK, STATE_SIZE = range(4, 14)
DENORMAL = 1e-30  # m, N, 1: what is this near to zero is zero
MOST_EVENTS = 60  # in one step; only rounding can come near it


@inner(inlined=True)
def later(frame: Frame, x: Point, t: float, way: float, con: Constants) -> Frame:
    """The frame of a step that begins where the motion is at x, t s into this one."""
    z = frame[Z_0]
    if con[FY] > 0.0 and way != 0.0:
        z = hysteretic(z, x[U] - frame[U_0], way, con[UY])
    _, _, right, left, base, slope, peak, w, phase = frame
    opened = con[DRIFT] * t
    return x[U], z, right + opened, left + opened, base + slope * t, slope, peak, w, phase + w * t


@inner()
def event(
    found: int, x: Point, frame: Frame, con: Constants, mode: int, way: float, extra: Extra
) -> tuple[Point, int, float]:
    """(point, mode, way) after an event at x, where `frame` begins."""
    u, v, right, left, f, b_r, b_l = x
    if found == TURN_GUARD:
        v = 0.0
        x = (u, v, right, left, f, b_r, b_l)
        need = hold(x, frame, con, mode, 0.0, extra)
        if way != 0.0 and abs(need) <= con[FC]:
            way = 0.0 if con[FC] > 0.0 else -way
        else:
            way = math.copysign(1.0, need)
        return x, mode, way
    mode ^= 1 << found
    # A face without any memory is back at once.
    c = con[C_R] if found == 0 else con[C_L]
    forgets = c + con[CH] == 0.0 and con[KB] == 0.0
    if found == 0 and mode & 1:
        right = u - frame[GAP_R]
    elif found == 0 and forgets:
        right = 0.0
    elif found == 1 and mode & 2:
        left = u + frame[GAP_L]
    elif found == 1 and forgets:
        left = 0.0
    return (u, v, right, left, f, b_r, b_l), mode, way


@inner(inlined=True)
def flushed(q: float, sign: float, b: float) -> float:
    """u_j of a free face: zero where it has decayed, or overshot with no branch that drives it."""
    return 0.0 if abs(q) < DENORMAL or (sign * q < 0.0 and b == 0.0) else q


@inner()
def onward(
    h: float, x: Point, frame: Frame, con: Constants, maps: Float2D, mode: int, way: float,
    extra: Extra,
) -> tuple[Moved, Frame, int, float]:  # fmt: skip
    """(point and rates, frame, mode, way) after h s through any events."""
    t, at = 0.0, (x, x)
    for attempt in range(MOST_EVENTS):
        search = attempt + 1 < MOST_EVENTS
        dt, found, at = leap(h - t, x, frame, con, maps, mode, way, extra, search)
        x = at[0]
        frame = later(frame, x, dt, way, con)
        t += dt
        if found < 0:
            break
        x, mode, way = event(found, x, frame, con, mode, way, extra)
    u, v, right, left, f, b_r, b_l = x
    f, b_r = f if abs(f) > DENORMAL else 0.0, b_r if abs(b_r) > DENORMAL else 0.0
    b_l = b_l if abs(b_l) > DENORMAL else 0.0
    right = right if mode & 1 else flushed(right, 1.0, b_r)
    left = left if mode & 2 else flushed(left, -1.0, b_l)
    return ((u, v, right, left, f, b_r, b_l), at[1]), frame, mode, way


@inner(inlined=True)
def placed(
    x: Point, frame: Frame, con: Constants, mode: int, time: float, base: float, slope: float
) -> tuple[Point, Frame]:
    """x and the frame at a time in s since sample 0, gaps and drive not summed up but set."""
    right, left = con[G_R] + con[DRIFT] * time, con[G_L] + con[DRIFT] * time
    u, v, u_r, u_l, f, b_r, b_l = x
    x = (u, v, u - right if mode & 1 else u_r, u + left if mode & 2 else u_l, f, b_r, b_l)
    return x, (u, frame[Z_0], right, left, base, slope, frame[6], frame[7], frame[8])


@inner(inlined=True)
def push(x: Point, frame: Frame, con: Constants, mode: int, side: int) -> float:
    """F_R >= 0 or F_L <= 0 in N at the start of a frame."""
    if not (mode >> side) & 1:
        return 0.0
    d, dd, b = face(x, frame, con, mode, side, 0.0)
    return (1.0 - 2.0 * side) * max(0.0, bumper(con, side, d, dd, b))


_READ = types.Array(float64, 1, "A", readonly=True)
_OUT = types.Array(float64, 2, "A")
REVISION = revision(globals()) ^ EVENTS_REVISION


_CONSTANTS = types.UniTuple(float64, CONSTANTS_SIZE)
_KERNEL = types.void(float64[::1], _CONSTANTS, float64[:, ::1], EXTRA_TYPE, _READ, _OUT)


def _sampled(revision: int) -> Callable[..., None]:
    """The kernel; the revision is a free variable of it, and so in the key of numba's cache."""

    @compiled(_KERNEL, cache=True)
    def sampled(
        state: Float1D, con: Constants, maps: Float2D, extra: Extra, base_acc: Float1D, out: Float2D
    ) -> None:
        """Moves `state` through the samples of A in m/s2, (n,), linear in between; out (7, n).

        From a sample on that is not finite all is NaN, but for the clock, until a restart.
        """
        if revision < 0:
            return
        if state.size < STATE_SIZE or out.shape[0] < OUTPUTS or out.shape[1] < base_acc.size:
            raise ValueError("state or out is too small for these samples; see Solver.advance")
        parts, h = int(con[PARTS]), con[STEP]
        x = (state[U], state[V], state[U_R], state[U_L], state[AT_F], state[AT_B_R], state[AT_B_L])
        mode = int(state[CONTACT_R] > 0) + 2 * int(state[CONTACT_L] > 0)
        way, clock, base = state[WAY], state[CLOCK], state[AT_BASE]
        frame = (x[U], state[AT_Z], 0.0, 0.0, base, 0.0, 0.0, 0.0, 0.0)
        for i in range(base_acc.size):
            for part in range(parts):
                slope = (base_acc[i] - base) / (h * (parts - part))
                time = (clock + i + part / parts) * con[PERIOD]
                x, frame = placed(x, frame, con, mode, time, base, slope)
                at, frame, mode, way = onward(h, x, frame, con, maps, mode, way, extra)
                x, base = at[0], base + slope * h if part + 1 < parts else base_acc[i]
            if not math.isfinite(base) or not math.isfinite(x[U]):
                base = math.nan
                x = (base, base, base, base, base, base, base)
            x, frame = placed(x, frame, con, mode, (clock + i + 1) * con[PERIOD], base, 0.0)
            idle = base - base
            out[0, i], out[1, i], out[2, i] = x[U], x[V], at[1][V] + drive(frame, 0.0)
            out[3, i] = push(x, frame, con, mode, 0) + idle
            out[4, i] = push(x, frame, con, mode, 1) + idle
            out[5, i], out[6, i] = x[U_R], x[U_L]
        state[U], state[V], state[U_R], state[U_L], state[AT_F], state[AT_B_R], state[AT_B_L] = x
        state[CONTACT_R], state[CONTACT_L] = float(mode & 1), float(mode >> 1)
        state[AT_BASE], state[AT_Z], state[WAY] = base, frame[Z_0], way
        if math.isnan(base):
            state[:CLOCK] = math.nan
        state[CLOCK] = clock + base_acc.size

    return sampled


sampled = _sampled(REVISION)
