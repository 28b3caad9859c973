"""A step of the integrated model up to its first event, located to roundoff.

Between events the right-hand side is smooth, so the Runge-Kutta formula keeps its order through
them: an event is where a step of just that length makes a guard zero. A guard is a quantity that
stays positive until its event: clearance or push of a side, u' in its direction, or what friction
has left while the mass sticks. Linear models go by their exact propagator instead.

Source of the formula: Dormand and Prince 1980, J. Comput. Appl. Math. 6(1), the order 5 part.
"""

import math

from table_io.block import Float1D, Float2D
from twin.model.compiled import inner, revision
from twin.model.laws import (
    BASE,
    C_L,
    C_R,
    CH,
    DRIFT,
    FC,
    GAP_L,
    GAP_R,
    K2,
    K_L,
    K_R,
    KB,
    LINEAR,
    LINEAR_SIZE,
    PEAK,
    RATE_B,
    SLOPE,
    STEP,
    TURNS,
    U_L,
    U_R,
    Constants,
    Extra,
    Frame,
    Point,
    U,
    V,
    bumper,
    crossley,
    face,
    hold,
    rates,
)  # fmt: skip
from twin.model.laws import REVISION as LAWS_REVISION

TOUCH = 1e-14  # m, and m/s: what lies below is rounding
TERMS = 60  # of the Taylor series; far more than a step needs
TURN_GUARD = 2  # the guard that is not a side's

Moved = tuple[Point, Point]  # a point and its rates


@inner(inlined=True)
def add(x: Point, h: float, k: Point) -> Point:
    """x + h k."""
    return (
        x[0] + h * k[0], x[1] + h * k[1], x[2] + h * k[2], x[3] + h * k[3], x[4] + h * k[4],
        x[5] + h * k[5], x[6] + h * k[6],
    )  # fmt: skip


@inner()
def runge_kutta(
    t: float, x: Point, k1: Point, frame: Frame, con: Constants, mode: int, way: float, extra: Extra
) -> Point:
    """The point t s after x, where the rates are k1."""
    y = add(x, t / 5, k1)
    k2 = rates(y, frame, con, mode, way, t / 5, extra)
    y = add(add(x, t * 3 / 40, k1), t * 9 / 40, k2)
    k3 = rates(y, frame, con, mode, way, t * 3 / 10, extra)
    y = add(add(add(x, t * 44 / 45, k1), t * -56 / 15, k2), t * 32 / 9, k3)
    k4 = rates(y, frame, con, mode, way, t * 4 / 5, extra)
    y = add(add(x, t * 19372 / 6561, k1), t * -25360 / 2187, k2)
    y = add(add(y, t * 64448 / 6561, k3), t * -212 / 729, k4)
    k5 = rates(y, frame, con, mode, way, t * 8 / 9, extra)
    y = add(add(x, t * 9017 / 3168, k1), t * -355 / 33, k2)
    y = add(add(add(y, t * 46732 / 5247, k3), t * 49 / 176, k4), t * -5103 / 18656, k5)
    k6 = rates(y, frame, con, mode, way, t, extra)
    y = add(add(x, t * 35 / 384, k1), t * 500 / 1113, k3)
    return add(add(add(y, t * 125 / 192, k4), t * -2187 / 6784, k5), t * 11 / 84, k6)


@inner()
def linear(t: float, x: Point, frame: Frame, con: Constants, maps: Float2D, mode: int) -> Point:
    """The point t s after x of a linear model: the tabled map over a whole step, else the series.

    maps (8 x LINEAR_SIZE, LINEAR_SIZE): the generators of the four modes, then their maps.
    """
    base, slope, right, left = frame[BASE], frame[SLOPE], frame[GAP_R], frame[GAP_L]
    if t == con[STEP]:
        row = (4 + mode) * LINEAR_SIZE
        return times(maps, row, x, base, slope, right, left, 1.0)
    row, one, term = mode * LINEAR_SIZE, 1.0, x
    for n in range(1, TERMS):
        # t^n / n! of the n-th derivative; the drive and the gaps are lines.
        term = times(maps, row, term, base, slope, right, left, one)
        term = add((0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0), t / n, term)
        base, right, left = slope * (t / n), con[DRIFT] * one * (t / n), con[DRIFT] * one * (t / n)
        slope, one = 0.0, 0.0
        new = add(x, 1.0, term)
        if n > 2 and new == x:
            break
        x = new
    return x


@inner()
def times(
    maps: Float2D, row: int, x: Point, base: float, slope: float, right: float, left: float,
    one: float,
) -> Point:  # fmt: skip
    """Seven rows of a map times (x, base, slope, right, left, one)."""
    return (
        product(maps[row], x, base, slope, right, left, one),
        product(maps[row + 1], x, base, slope, right, left, one),
        product(maps[row + 2], x, base, slope, right, left, one),
        product(maps[row + 3], x, base, slope, right, left, one),
        product(maps[row + 4], x, base, slope, right, left, one),
        product(maps[row + 5], x, base, slope, right, left, one),
        product(maps[row + 6], x, base, slope, right, left, one),
    )


@inner(inlined=True)
def product(
    m: Float1D, x: Point, base: float, slope: float, right: float, left: float, one: float
) -> float:
    """One row of `times`."""
    total = m[0] * x[0] + m[1] * x[1] + m[2] * x[2] + m[3] * x[3] + m[4] * x[4] + m[5] * x[5]
    return (
        total + m[6] * x[6] + m[7] * base + m[8] * slope + m[9] * right + m[10] * left + m[11] * one
    )


@inner()
def flow(
    t: float, x: Point, k1: Point, frame: Frame, con: Constants, maps: Float2D, mode: int,
    way: float, extra: Extra,
) -> Moved:  # fmt: skip
    """(point, its rates) t s after x in one mode; k1 the rates at x."""
    if con[LINEAR] > 0.0 and frame[PEAK] == 0.0:
        y = linear(t, x, frame, con, maps, mode)
    else:
        y = runge_kutta(t, x, k1, frame, con, mode, way, extra)
    # In contact u_j follows the mass, recomputed from it, so nothing drifts.
    right = y[U] - frame[GAP_R] - con[DRIFT] * t if mode & 1 else y[U_R]
    left = y[U] + frame[GAP_L] + con[DRIFT] * t if mode & 2 else y[U_L]
    y = (y[0], y[1], right, left, y[4], y[5], y[6])
    return y, rates(y, frame, con, mode, way, t, extra)


@inner(inlined=True)
def guard(
    t: float,
    at: Moved,
    frame: Frame,
    con: Constants,
    mode: int,
    way: float,
    extra: Extra,
    which: int,
) -> tuple[float, float]:
    """(guard, its slope) of side 0 or 1, or of the sign of u'.

    Clearance in m, push in N, u' in m/s; N that friction has left, with no slope.
    """
    x, dx = at
    if which == TURN_GUARD:
        if way == 0.0:
            return con[FC] - abs(hold(x, frame, con, mode, t, extra)), 0.0
        return way * x[V], way * dx[V]
    d, dd, b = face(x, frame, con, mode, which, t)
    right = 1.0 - 2.0 * which
    if not (mode >> which) & 1:
        gap = (frame[GAP_L] if which else frame[GAP_R]) + con[DRIFT] * t
        return gap + d - right * x[U], con[DRIFT] + dd - right * x[V]
    k, c = (con[K_L], con[C_L]) if which else (con[K_R], con[C_R])
    slope = (k + 2.0 * con[K2] * abs(d)) * dd + (c + crossley(d, con[CH])) * right * dx[V]
    slope += con[CH] * math.copysign(1.0, d) * dd * dd + con[KB] * dd - con[RATE_B] * b
    return bumper(con, which, d, dd, b), slope


@inner()
def root(
    lo: float, hi: float, order: int, x: Point, k1: Point, frame: Frame, con: Constants,
    maps: Float2D, mode: int, way: float, extra: Extra, which: int,
) -> float:  # fmt: skip
    """Time in s between lo and hi at which a guard (order 0) or its slope (1) changes sign.

    Newton kept in the bracket, from hi, so that a zero at lo which is only the start of a phase is
    not found again. Where there is no slope, the chord's.
    """
    at, sign, chord, t = (x, k1), 0.0, 0.0, lo
    for attempt in range(82):
        if attempt > 0 or lo > 0.0:
            at = flow(t, x, k1, frame, con, maps, mode, way, extra)
        g, slope = guard(t, at, frame, con, mode, way, extra, which)
        f = slope if order else g
        if attempt == 0:
            chord, t = f, hi
            continue
        if attempt == 1:
            chord, sign = (f - chord) / (hi - lo), math.copysign(1.0, f)
        elif f * sign > 0:
            hi = t
        else:
            lo = t
        df = slope if order == 0 and slope != 0.0 else chord
        new = t - f / df if df != 0.0 else lo
        if df != 0.0 and abs(new - t) <= 1e-12 * hi:
            return min(max(new, lo), hi)
        if not lo < new < hi:
            new = 0.5 * (lo + hi)
            if not lo < new < hi:
                break
        t = new
    return t


@inner()
def crossing(
    h: float, x: Point, k1: Point, end: Moved, frame: Frame, con: Constants, maps: Float2D,
    mode: int, way: float, extra: Extra, which: int,
) -> float:  # fmt: skip
    """First time in s in [0, h] at which a guard turns negative, else inf; `end` is at h.

    As `phase.crossing`: also in and out again within the step, and not the zero of the last event.
    """
    g0, d0 = guard(0.0, (x, k1), frame, con, mode, way, extra, which)
    g1, d1 = guard(h, end, frame, con, mode, way, extra, which)
    if g1 >= 0 and (d0 >= 0 or d1 <= 0 or g0 > -2 * h * d0):
        return math.inf
    touch, hi = TOUCH, h
    if which < TURN_GUARD and (mode >> which) & 1:
        touch = TOUCH * (con[K_L] if which else con[K_R])
    elif way == 0.0 and which == TURN_GUARD:
        touch = 1e-12 * con[FC]
    if not (g1 < -touch or (g1 < 0 and d1 < 0 and which < TURN_GUARD)):
        if not (d0 < 0 < d1) or g0 > -2 * h * d0:
            return math.inf
        hi = root(0.0, h, 1, x, k1, frame, con, maps, mode, way, extra, which)
        at = flow(hi, x, k1, frame, con, maps, mode, way, extra)
        if not guard(hi, at, frame, con, mode, way, extra, which)[0] < -touch:
            return math.inf
    if g0 > 0:
        return root(0.0, hi, 0, x, k1, frame, con, maps, mode, way, extra, which)
    # Just after an event the guard starts at zero, rounded either way: find where it is positive.
    lo = hi
    for _ in range(45):
        lo *= 0.5
        at = flow(lo, x, k1, frame, con, maps, mode, way, extra)
        if guard(lo, at, frame, con, mode, way, extra, which)[0] > touch:
            return root(lo, 2 * lo, 0, x, k1, frame, con, maps, mode, way, extra, which)
    return 0.0


@inner()
def leap(
    h: float, x: Point, frame: Frame, con: Constants, maps: Float2D, mode: int, way: float,
    extra: Extra, search: bool,
) -> tuple[float, int, Moved]:  # fmt: skip
    """(time in s, guard that ended it or -1, where): to the first event within h s, or by h."""
    k1 = rates(x, frame, con, mode, way, 0.0, extra)
    end = flow(h, x, k1, frame, con, maps, mode, way, extra)
    dt, found = h, -1
    for which in range((2 + int(con[TURNS])) if search else 0):
        t = crossing(h, x, k1, end, frame, con, maps, mode, way, extra, which)
        if t < dt or (found < 0 and t == dt):
            dt, found = t, which
    if found >= 0:
        end = flow(dt, x, k1, frame, con, maps, mode, way, extra)
    return dt, found, end


REVISION = revision(globals()) ^ LAWS_REVISION
