"""The event locator of all solvers: the time within a step at which a guard turns negative.

A guard is a quantity that stays positive until its event. A solver describes it by a function
`evaluate(t, motion, guard)` that returns the guard, its slope and its curvature t s into the step.
Where the curvature is not known it is 0, and where the slope is not, that is 0 too: then the slope
of the chord between the ends of the bracket is used.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

from table_io.compilation import jit_helper

# (time in s, motion, guard) -> (guard, its slope, its curvature); motion and guard as of a solver.
Evaluation = Callable[[float, Any, Any], tuple[float, float, float]]

MAX_ROOT_STEPS = 81  # of the bracketed iteration: bisection alone ends within as many
MAX_HALVINGS = 45  # of a step, down to where an event has just been


class Accuracy(NamedTuple):
    """When a root of a guard has converged.

    The last Newton step relative to the end of the bracket: `value_tolerance` of a root of the
    guard, `slope_tolerance` of its slope. `is_analytic`: Newton's method converges quadratically
    from the root of a parabola, and the bracket is the first one; otherwise it starts at the end,
    uses the `chord` where there is no slope, and the bracket is the last one.
    """

    value_tolerance: float
    slope_tolerance: float
    is_analytic: bool


@jit_helper(inlined=True)
def find_root(
    lo: float,
    hi: float,
    start: float,
    sign: float,
    chord: float,
    order: int,
    accuracy: Accuracy,
    evaluate: Evaluation,
    motion: Any,
    guard: Any,
) -> float:
    """Return the time in s in [lo, hi] at which a guard (order 0) or its slope (1) gets a `sign`.

    Bracketed Newton iteration from `start`. A short bisection step is no sign of convergence.
    """
    ratio = accuracy.slope_tolerance if order else accuracy.value_tolerance
    tolerance = ratio * hi
    t = start if lo < start < hi else hi
    for _ in range(MAX_ROOT_STEPS):
        values = evaluate(t, motion, guard)
        f, df = values[order], values[order + 1]
        if df == 0.0 and not accuracy.is_analytic:
            df = chord
        if f * sign > 0:
            hi = t
        else:
            lo = t
        if not accuracy.is_analytic:
            tolerance = ratio * hi
        new = t - f / df if df != 0.0 else lo
        if df != 0.0 and abs(new - t) <= tolerance:
            return min(max(new, lo), hi)
        if not lo < new < hi:
            new = 0.5 * (lo + hi)
            if not lo < new < hi:
                break
        t = new
    return t


@jit_helper()
def locate_event(
    h: float,
    at_start: tuple[float, float],
    at_end: tuple[float, float],
    tolerance: float,
    begins_at_zero: bool,
    accuracy: Accuracy,
    evaluate: Evaluation,
    motion: Any,
    guard: Any,
) -> float:
    """Return the first time in s in [0, h] at which a guard turns negative, else inf.

    at_start, at_end: the guard and its slope at both ends. A guard above -tolerance is negative by
    rounding only, unless it falls at the end and `begins_at_zero`, as a guard of a contact does
    after an event. Finds a guard that dips within the step and skips the zero of the last event.
    """
    (g0, d0), (g1, d1) = at_start, at_end
    hi, g_hi = h, g1
    if not (g1 < -tolerance or (g1 < 0 and d1 < 0 and begins_at_zero)):
        if not (d0 < 0 < d1) or g0 > -2 * h * d0:
            return math.inf
        start = h * d0 / (d0 - d1) if accuracy.is_analytic else h
        chord = (d1 - d0) / h
        hi = find_root(0.0, h, start, 1.0, chord, 1, accuracy, evaluate, motion, guard)
        g_hi = evaluate(hi, motion, guard)[0]
        if not g_hi < -tolerance:
            return math.inf
    if g0 > 0:
        start = hi
        if accuracy.is_analytic:
            curvature = (g1 - g0 - d0 * h) / (h * h)
            discriminant = d0 * d0 - 4 * curvature * g0
            # The nearer root of the parabola; without one, or where d0 rounds it off, hi.
            divisor = math.sqrt(discriminant) - d0 if discriminant > 0 else 0.0
            start = 2 * g0 / divisor if divisor != 0.0 else hi
        chord = (g_hi - g0) / hi
        return find_root(0.0, hi, start, -1.0, chord, 0, accuracy, evaluate, motion, guard)
    # Just after an event the guard starts at zero, rounded either way: find where it is positive.
    lo = hi
    for _ in range(MAX_HALVINGS):
        lo *= 0.5
        g_lo = evaluate(lo, motion, guard)[0]
        if g_lo > tolerance:
            chord = (g_hi - g_lo) / lo
            return find_root(lo, 2 * lo, 2 * lo, -1.0, chord, 0, accuracy, evaluate, motion, guard)
        g_hi = g_lo
    return 0.0
