"""The forces of a model along a motion that was measured: no motion is computed, so none diverges.

    damper  D = K u + C u' + every force law that acts in flight too
    bumpers F_R >= 0 and F_L <= 0 where contact was measured

Hidden states (hysteresis, relaxation) are carried along the measured motion from rest. Where nobody
measured contact the model's own is taken: a face is touched while its force pushes. Along the
motion every force is a smooth function of the parameters, whatever the chaos of the trajectories:
that is what makes a fit converge (see `learn`).
"""

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
from numba import float64, types

from table_io.block import Float1D, Float2D
from twin.model import laws
from twin.model.compiled import compiled, inner
from twin.model.integrated import coefficients
from twin.model.laws import (
    C2,
    C_L,
    C_R,
    CONSTANTS_SIZE,
    DRIFT,
    EXTRA,
    EXTRA_FIRST,
    EXTRA_TYPE,
    FAR,
    FC,
    FY,
    G_L,
    G_R,
    K1,
    K3,
    K_L,
    K_R,
    KB,
    RATE_1,
    RATE_B,
    UY,
    C,
    Constants,
    K,
    bumper,
    coulomb,
    cubic,
    hysteretic,
    quadratic,
)
from twin.model.model import Model
from twin.model.solver import GRAVITY_M_S2

ROWS = ("damper", "right", "left")
# One signature: a kernel that is specialised to the very function of an effect is never cached.
_READ = types.Array(float64, 1, "A", readonly=True)
_KERNEL = types.void(
    _READ, _READ, _READ, float64[:, ::1], types.UniTuple(float64, CONSTANTS_SIZE), EXTRA_TYPE,
    float64[:, ::1],
)  # fmt: skip
UNKNOWN, FREE, TOUCHED = -1, 0, 1  # what was measured of a contact


@inner()
def relaxing(branch: float, rate: float, stiffness: float, travelled: float, h: float) -> float:
    """A Maxwell branch h s on, while its end travels at one speed: f' = k v - f / tau."""
    if rate == 0.0:
        return branch + stiffness * travelled
    left = math.exp(-rate * h)
    return branch * left + stiffness * travelled * (1.0 - left) / (rate * h)


@inner()
def recovering(con: Constants, side: int, d: float, b: float, h: float) -> tuple[float, float]:
    """(deformation, branch force) of a bumper h s on that nobody touches.

    Of d' = -(K_j d + b) / C_j and b' = kb d' - b / tau in closed form: two real rates, never equal
    while kb > 0. Without a dashpot K_j d + b = 0 at every time.
    """
    k, c = (con[K_R], con[C_R]) if side == 0 else (con[K_L], con[C_L])
    kb, rate = con[KB], con[RATE_B]
    if c <= 0.0:
        b = b * math.exp(-h * rate / (1.0 + kb / k))
        return -b / k, b
    half = 0.5 * ((k + kb) / c + rate)
    root = math.sqrt(half * half - k * rate / c)
    fast, slow = math.exp(-(half + root) * h), math.exp(-(half - root) * h)
    mean, part = 0.5 * (slow + fast), 0.5 * (slow - fast) / root
    d_rate = -(k * d + b) / c
    b_rate = kb * d_rate - rate * b
    return mean * d + part * (half * d + d_rate), mean * b + part * (half * b + b_rate)


@inner()
def followed(
    con: Constants,
    side: int,
    d: float,
    stands: float,
    b: float,
    was: bool,
    touched: float,
    h: float,
) -> tuple[float, float]:
    """(where the face stands in m, branch force in N) h s on; the mass is at d, `was` it there?

    A face that is met in between jumps to the mass; at the very start it has long relaxed there.
    """
    if was:
        return d, relaxing(b, con[RATE_B], con[KB], d - stands, h)
    stands, b = recovering(con, side, stands, b, h)
    if touched > 0.5 or (touched < -0.5 and d > stands):
        return d, b + (con[KB] * (d - stands) if h > 0.0 else 0.0)
    return stands, b


def _kernel(revision: int) -> Callable[..., None]:
    """The kernel; the revision is a free variable of it, and so in the key of numba's cache."""

    @compiled(_KERNEL, cache=True)
    def kernel(
        u: Float1D,
        v: Float1D,
        time: Float1D,
        touched: Float2D,
        con: Constants,
        extra: laws.Extra,
        out: Float2D,
    ) -> None:
        """Fills `out` (3, sample): D, F_R, F_L in N. `touched` (2, sample) as in `UNKNOWN` ..."""
        if revision < 0:
            return
        z, f, b_r, b_l = 0.0, 0.0, 0.0, 0.0
        face_r, face_l = 0.0, 0.0  # where the faces stand, followed only for what relaxes
        on_r, on_l = False, False
        for k in range(u.size):
            h = time[k] - time[k - 1] if k else 0.0
            if k:
                du = u[k] - u[k - 1]
                if con[FY] > 0.0 and du != 0.0:
                    z = hysteretic(z, du, math.copysign(1.0, du), con[UY])
                if con[K1] > 0.0 or f != 0.0:
                    f = relaxing(f, con[RATE_1], con[K1], du, h)
            way = 1.0 if v[k] > 0.0 else -1.0
            damper = con[K] * u[k] + con[C] * v[k] + cubic(u[k], con[K3])
            damper += quadratic(v[k], way, con[C2]) + coulomb(way, con[FC]) + con[FY] * z + f
            if con[EXTRA] > 0.0:
                damper += extra(u[k], v[k], con[EXTRA_FIRST:])
            opened = con[DRIFT] * time[k]
            out[0, k] = damper
            for side in range(2):
                right = 1.0 if side == 0 else -1.0
                gap = (con[G_R] if side == 0 else con[G_L]) + opened
                d, dd = right * u[k] - gap, right * v[k] - con[DRIFT]
                b, stands, was = (b_r, face_r, on_r) if side == 0 else (b_l, face_l, on_l)
                if con[KB] > 0.0:
                    stands, b = followed(con, side, d, stands, b, was, touched[side, k], h)
                push = bumper(con, side, d, dd, b) if d > -0.5 * FAR else 0.0
                if touched[side, k] < -0.5:
                    on = push > 0.0 and (was or d >= stands)
                else:
                    on = touched[side, k] > 0.5
                if side == 0:
                    b_r, face_r, on_r = b, stands, on
                else:
                    b_l, face_l, on_l = b, stands, on
                out[1 + side, k] = right * push if on else 0.0

    return kernel


_along = _kernel(laws.REVISION)


def along(
    model: Model, u: Float1D, v: Float1D, time_s: Float1D, touched: npt.NDArray[np.int8]
) -> Float2D:
    """D, F_R >= 0 and F_L <= 0 in N, (3, sample), of a model along a motion.

    u in m and v in m/s, (sample,), at times `time_s` in s since the start of the run; `touched`
    (2, sample) right and left: TOUCHED, FREE, or UNKNOWN where the model decides. Effects on the
    base acceleration and on sensors have no place here: see `tilting`.
    """
    con, extra = coefficients(model)
    out = np.empty((3, u.size))
    _along(u, v, time_s, touched.astype(np.float64), tuple(con.tolist()), extra, out)
    return out


def tilting(model: Model, table_disp: Float1D) -> Float1D:
    """Force in N on the mass of a table that rocks, M g tilt x, on the left side; (sample,)."""
    tilt = model.value("table_tilt", "tilt") or 0.0
    return model.parameters.mass * GRAVITY_M_S2 * tilt * table_disp
