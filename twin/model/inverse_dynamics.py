"""Inverse dynamics: forces of a model along a measured motion, without integrating a motion.

    damper  D = K u + C u' + every force law that acts in flight too
    bumpers F_R >= 0 and F_L <= 0 where contact was measured

Hidden states (hysteresis, relaxation) are carried along the measured motion from rest. Where
contact was not measured the model decides: a face is touched while its force pushes. Along the
motion every force is a smooth function of the parameters, even where trajectories are chaotic:
this is what makes a fit converge (see `twin.identification`).
"""

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
from numba import float64, types

from table_io.block import Float1D, Float2D
from twin.model import force_laws
from twin.model.compilation import jit_helper, jit_kernel
from twin.model.event_integrator import kernel_params
from twin.model.force_laws import (
    C2,
    C_L,
    C_R,
    DRIFT,
    FC,
    FY,
    G_L,
    G_R,
    HAS_PLUGIN,
    K1,
    K3,
    K_L,
    K_R,
    KB,
    KERNEL_PARAMS_SIZE,
    NO_WALL_M,
    PLUGIN_FIRST,
    PLUGIN_FORCE_TYPE,
    RATE_1,
    RATE_B,
    UY,
    C,
    K,
    KernelParams,
    bumper_force,
    coulomb_force,
    cubic_force,
    hysteretic_variable,
    quadratic_force,
)
from twin.model.model import Model
from twin.model.solver import GRAVITY_M_S2

FORCE_ROWS = ("damper", "right", "left")
# One signature: numba never caches a kernel specialized to the function of an effect.
_READ = types.Array(float64, 1, "A", readonly=True)
_KERNEL = types.void(
    _READ,
    _READ,
    _READ,
    float64[:, ::1],
    types.UniTuple(float64, KERNEL_PARAMS_SIZE),
    PLUGIN_FORCE_TYPE,
    float64[:, ::1],
)
CONTACT_UNKNOWN, NO_CONTACT, IN_CONTACT = -1, 0, 1  # measured contact state


@jit_helper()
def relax_branch(
    branch: float, rate: float, stiffness: float, displacement: float, h: float
) -> float:
    """Return the force of a Maxwell branch after h s at constant speed: f' = k v - f / tau."""
    if rate == 0.0:
        return branch + stiffness * displacement
    decay = math.exp(-rate * h)
    return branch * decay + stiffness * displacement * (1.0 - decay) / (rate * h)


@jit_helper()
def recover_bumper(
    params: KernelParams, side: int, d: float, b: float, h: float
) -> tuple[float, float]:
    """Return (deformation, branch force) of a free bumper after h s.

    Closed form of d' = -(K_j d + b) / C_j and b' = kb d' - b / tau: two real rates, never equal
    while kb > 0. Without a dashpot K_j d + b = 0 at every time.
    """
    k, c = (params[K_R], params[C_R]) if side == 0 else (params[K_L], params[C_L])
    kb, rate = params[KB], params[RATE_B]
    if c <= 0.0:
        b = b * math.exp(-h * rate / (1.0 + kb / k))
        return -b / k, b
    half = 0.5 * ((k + kb) / c + rate)
    root = math.sqrt(half * half - k * rate / c)
    fast, slow = math.exp(-(half + root) * h), math.exp(-(half - root) * h)
    mean, rate_part = 0.5 * (slow + fast), 0.5 * (slow - fast) / root
    d_rate = -(k * d + b) / c
    b_rate = kb * d_rate - rate * b
    return mean * d + rate_part * (half * d + d_rate), mean * b + rate_part * (half * b + b_rate)


@jit_helper()
def track_face(
    params: KernelParams,
    side: int,
    d: float,
    face: float,
    b: float,
    was_in_contact: bool,
    contact: float,
    h: float,
) -> tuple[float, float]:
    """Return (face position in m, branch force in N) after h s, with the mass at d.

    A face that the mass meets meanwhile jumps to it; at the first sample (h = 0) it has relaxed.
    """
    if was_in_contact:
        return d, relax_branch(b, params[RATE_B], params[KB], d - face, h)
    face, b = recover_bumper(params, side, face, b, h)
    if contact > 0.5 or (contact < -0.5 and d > face):
        return d, b + (params[KB] * (d - face) if h > 0.0 else 0.0)
    return face, b


def _build_force_kernel(revision: int) -> Callable[..., None]:
    """Return the kernel; `revision` is a free variable of it and so part of numba's cache key."""

    @jit_kernel(_KERNEL, cache=True)
    def kernel(
        u: Float1D,
        v: Float1D,
        time: Float1D,
        contact: Float2D,
        params: KernelParams,
        plugin_force: force_laws.PluginForce,
        out: Float2D,
    ) -> None:
        """Fill `out` (3, sample): D, F_R, F_L in N; `contact` (2, sample) as `CONTACT_UNKNOWN`."""
        if revision < 0:
            return
        z, f, b_r, b_l = 0.0, 0.0, 0.0, 0.0
        face_r, face_l = 0.0, 0.0  # face positions in m, tracked only with relaxation
        in_contact_r, in_contact_l = False, False
        for k in range(u.size):
            h = time[k] - time[k - 1] if k else 0.0
            if k:
                du = u[k] - u[k - 1]
                if params[FY] > 0.0 and du != 0.0:
                    z = hysteretic_variable(z, du, math.copysign(1.0, du), params[UY])
                if params[K1] > 0.0 or f != 0.0:
                    f = relax_branch(f, params[RATE_1], params[K1], du, h)
            direction = 1.0 if v[k] > 0.0 else -1.0
            damper = params[K] * u[k] + params[C] * v[k] + cubic_force(u[k], params[K3])
            damper += (
                quadratic_force(v[k], direction, params[C2])
                + coulomb_force(direction, params[FC])
                + params[FY] * z
                + f
            )
            if params[HAS_PLUGIN] > 0.0:
                damper += plugin_force(u[k], v[k], params[PLUGIN_FIRST:])
            opening = params[DRIFT] * time[k]
            out[0, k] = damper
            for side in range(2):
                sign = 1.0 if side == 0 else -1.0
                gap = (params[G_R] if side == 0 else params[G_L]) + opening
                d, dd = sign * u[k] - gap, sign * v[k] - params[DRIFT]
                b, face, was_in_contact = (
                    (b_r, face_r, in_contact_r) if side == 0 else (b_l, face_l, in_contact_l)
                )
                if params[KB] > 0.0:
                    face, b = track_face(
                        params, side, d, face, b, was_in_contact, contact[side, k], h
                    )
                bumper_push = bumper_force(params, side, d, dd, b) if d > -0.5 * NO_WALL_M else 0.0
                if contact[side, k] < -0.5:
                    in_contact = bumper_push > 0.0 and (was_in_contact or d >= face)
                else:
                    in_contact = contact[side, k] > 0.5
                if side == 0:
                    b_r, face_r, in_contact_r = b, face, in_contact
                else:
                    b_l, face_l, in_contact_l = b, face, in_contact
                out[1 + side, k] = sign * bumper_push if in_contact else 0.0

    return kernel


_force_kernel = _build_force_kernel(force_laws.REVISION)


def forces_along(
    model: Model, u: Float1D, v: Float1D, time_s: Float1D, contact: npt.NDArray[np.int8]
) -> Float2D:
    """Return D, F_R >= 0 and F_L <= 0 in N, (3, sample), of a model along a motion.

    u in m and v in m/s, (sample,), at times `time_s` in s since the start of the run; `contact`
    (2, sample) right and left: IN_CONTACT, NO_CONTACT, or CONTACT_UNKNOWN where the model decides.
    Effects on the base acceleration (see `tilt_force`) and on sensors are not included.
    """
    params, plugin_force = kernel_params(model)
    out = np.empty((3, u.size))
    _force_kernel(
        u, v, time_s, contact.astype(np.float64), tuple(params.tolist()), plugin_force, out
    )
    return out


def tilt_force(model: Model, table_disp: Float1D) -> Float1D:
    """Return the force in N of table tilt on the mass, M g tilt x, on the left side; (sample,)."""
    tilt = model.effect_parameter("table_tilt", "tilt") or 0.0
    return model.parameters.mass * GRAVITY_M_S2 * tilt * table_disp
