"""The force laws of all effects in one compiled right-hand side, with their coefficients.

    M u'' + C u' + K u + k3 u^3 + c2 u' |u'| + Fc sign(u') + Fy z + f + extra + F_R + F_L = -M A
    contact: F_j = (C_j + ch |u_j|) u_j' + K_j u_j + k2 u_j |u_j| + b_j
             u_R = u - G0R, u_L = u + G0L
    flight:  F_j = 0, that sum is zero and u_j relaxes
    f' = k1 u' - f / tau1,  b_j' = kb u_j' - b_j / tau,  G0j grows with `DRIFT`

SI, right positive. Each term is described in its file in `effects`. A coefficient of zero is an
absent effect. Sides are 0 = right, 1 = left; `mode` = contact_r + 2 contact_l; `way` is the sign of
u', 0 where the mass sticks.
"""

import math
from collections.abc import Callable
from functools import cache
from typing import Any

from numba import float64, types

from twin.model.compiled import compiled, inner, revision
from twin.model.effects import (
    bouc_wen,
    bumper_hardening,
    coulomb_friction,
    cubic_stiffness,
    hunt_crossley,
    quadratic_damping,
)

# The motion at one time: u, u', u_R, u_L, f, b_R, b_L; or its rates.
Point = tuple[float, float, float, float, float, float, float]
U, V, U_R, U_L, F, B_R, B_L = range(7)
# What a step starts from: u, z, the gaps, and the drive A = base + slope t + peak sin(phase + w t).
Frame = tuple[float, float, float, float, float, float, float, float, float]
U_0, Z_0, GAP_R, GAP_L, BASE, SLOPE, PEAK, W, PHASE = range(9)
# The part of both on which linear propagation works, and 1.
LINEAR_SIZE = 12

# Coefficients; RATE_* are 1/tau; gaps at sample 0; sampling period, its parts and their length;
# whether all is linear, whether a change of sign of u' is an event, whether plug-ins add a force,
# whose coefficients come from EXTRA_FIRST on.
MASS, K, C, K_R, K_L, C_R, C_L, K3, C2, FC, FY, UY, K1, RATE_1, K2, CH, KB, RATE_B, DRIFT = range(
    19
)
G_R, G_L, PERIOD, PARTS, STEP, LINEAR, TURNS, EXTRA, EXTRA_FIRST = range(19, 28)
EXTRAS = 8  # numbers that all plug-ins of a model may have together
CONSTANTS_SIZE = EXTRA_FIRST + EXTRAS
Constants = tuple[float, ...]

FAR = 1e9  # m: a wall that is not there; finite, so that zero times it is zero
FORCE = float64(float64, float64, types.UniTuple(float64, EXTRAS))
EXTRA_TYPE = types.FunctionType(FORCE)
Extra = Callable[[float, float, Constants], float]

cubic = inner(inlined=True)(cubic_stiffness.force)
quadratic = inner(inlined=True)(quadratic_damping.force)
coulomb = inner(inlined=True)(coulomb_friction.force)
hysteretic = inner()(bouc_wen.hysteretic)
hardening = inner(inlined=True)(bumper_hardening.force)
crossley = inner(inlined=True)(hunt_crossley.damping)


@compiled(FORCE, cache=True)
def no_extra(u: float, v: float, c: Constants) -> float:
    """The force of no plug-in, N."""
    return 0.0


@inner(inlined=True)
def bumper(con: Constants, side: int, d: float, dd: float, b: float) -> float:
    """Push of a bumper in N; deformation d, its rate dd and branch force b > 0 in compression."""
    k, c = (con[K_R], con[C_R]) if side == 0 else (con[K_L], con[C_L])
    return k * d + (c + crossley(d, con[CH])) * dd + hardening(d, con[K2]) + b


@inner(inlined=True)
def recovery(con: Constants, side: int, d: float, b: float) -> float:
    """Rate in m/s of the deformation d of a bumper that nobody touches; b as in `bumper`.

    Without any dashpot the face has no memory of its own: it stands where the springs balance.
    """
    if d == 0.0 and b == 0.0:
        return 0.0
    dashpot = (con[C_R] if side == 0 else con[C_L]) + crossley(d, con[CH])
    if dashpot > 0.0:
        return -bumper(con, side, d, 0.0, b) / dashpot
    if b == 0.0:
        return 0.0
    k = con[K_R] if side == 0 else con[K_L]
    return b * con[RATE_B] / (k + 2 * con[K2] * abs(d) + con[KB])


@inner(inlined=True)
def face(
    x: Point, frame: Frame, con: Constants, mode: int, side: int, t: float
) -> tuple[float, float, float]:
    """(d, d', b) of a bumper, t s into the step, positive in compression."""
    if side == 0:
        right, uj, b, gap = 1.0, x[U_R], x[B_R], frame[GAP_R]
    else:
        right, uj, b, gap = -1.0, x[U_L], -x[B_L], frame[GAP_L]
    if (mode >> side) & 1:
        return right * x[U] - gap - con[DRIFT] * t, right * x[V] - con[DRIFT], b
    d = right * uj
    return d, recovery(con, side, d, b), b


@inner(inlined=True)
def resistance(
    x: Point, frame: Frame, con: Constants, mode: int, way: float, t: float, extra: Extra
) -> float:
    """All forces on the left side of the equation of motion in N."""
    u, v = x[U], x[V]
    force = con[K] * u + con[C] * v + x[F]
    if con[LINEAR] == 0.0:
        force += cubic(u, con[K3]) + quadratic(v, way, con[C2]) + coulomb(way, con[FC])
        if con[FY] > 0.0:
            # At a standstill z stays, whatever the way.
            z = frame[Z_0]
            if way != 0.0:
                z = hysteretic(z, u - frame[U_0], way, con[UY])
            force += con[FY] * z
        if con[EXTRA] > 0.0:
            force += extra(u, v, con[EXTRA_FIRST:])
    if mode & 1:
        d, dd, b = face(x, frame, con, mode, 0, t)
        force += bumper(con, 0, d, dd, b)
    if mode & 2:
        d, dd, b = face(x, frame, con, mode, 1, t)
        force -= bumper(con, 1, d, dd, b)
    return force


@inner(inlined=True)
def drive(frame: Frame, t: float) -> float:
    """Table acceleration in m/s2, t s into the step."""
    base = frame[BASE] + frame[SLOPE] * t
    if frame[PEAK] != 0.0:
        base += frame[PEAK] * math.sin(frame[PHASE] + frame[W] * t)
    return base


@inner(inlined=True)
def rates(
    x: Point, frame: Frame, con: Constants, mode: int, way: float, t: float, extra: Extra
) -> Point:
    """d/dt of a point, t s into the step."""
    du, dv = 0.0, 0.0
    if way != 0.0 or con[FC] == 0.0:
        force = resistance(x, frame, con, mode, way, t, extra)
        du, dv = x[V], -drive(frame, t) - force / con[MASS]
    _, right, b_r = face(x, frame, con, mode, 0, t)
    _, left, b_l = face(x, frame, con, mode, 1, t)
    return (
        du, dv, right, -left, con[K1] * du - con[RATE_1] * x[F],
        con[KB] * right - con[RATE_B] * b_r, con[RATE_B] * b_l - con[KB] * left,
    )  # fmt: skip


@inner(inlined=True)
def hold(x: Point, frame: Frame, con: Constants, mode: int, t: float, extra: Extra) -> float:
    """Friction in N that it takes to keep the mass in place."""
    force = resistance(x, frame, con, mode, 0.0, t, extra)
    return -(con[MASS] * drive(frame, t) + force)


@cache
def together(forces: tuple[tuple[Callable[..., float], int], ...]) -> Extra:
    """One compiled `Extra` from plug-ins: (plain Python force, its number of parameters) each.

    Compiled once a process, and in each: numba's own cache does not see when a plug-in changes.
    """
    total: Any = no_extra
    first = 0
    for force, size in forces:
        total, first = _added(total, compiled()(force), first), first + size
    return compiled(FORCE)(total.py_func)


def _added(before: Any, one: Any, first: int) -> Any:
    """`before` plus a force whose numbers begin at `first`."""

    def both(u, v, c):  # type: ignore[no-untyped-def]
        own = (
            c[first], c[(first + 1) % EXTRAS], c[(first + 2) % EXTRAS], c[(first + 3) % EXTRAS],
            c[(first + 4) % EXTRAS], c[(first + 5) % EXTRAS], c[(first + 6) % EXTRAS],
            c[(first + 7) % EXTRAS],
        )  # fmt: skip
        return before(u, v, c) + one(u, v, own)

    return compiled()(both)


REVISION = revision(globals())
