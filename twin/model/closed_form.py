"""Closed-form solver of the SNM on sampled table acceleration: state in, state out.

The table acceleration is linear between samples (first-order hold). The motion in each contact
regime has a closed form and every contact event is located in time. The state is float64
(STATE_SIZE,):
    u, v, u_r, u_l          m, m/s, m, m (u_r >= 0, u_l <= 0)
    contact_r, contact_l    1.0 in contact, else 0.0
    A                       table acceleration at this sample, m/s2
    impulse_r, impulse_l    impulse of the contact in progress, N s
There is no other memory: results are bit-identical for any division of the samples into blocks.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import float64, int64, types

from table_io.block import Float1D, Float2D
from table_io.compilation import jit_helper, jit_kernel
from twin.model.contact_regime import (
    BASE,
    C_L,
    C_R,
    CONTACT_L,
    CONTACT_R,
    E_L,
    E_R,
    G_L,
    G_R,
    IMPULSE_L,
    IMPULSE_R,
    K_L,
    K_R,
    MASS,
    MODE_SIZE,
    MODES,
    PARAMS_SIZE,
    R_L,
    R_R,
    STATE_SIZE,
    STEP,
    SUBSTEPS,
    U_L,
    U_R,
    ModeSegment,
    U,
    V,
    advance_through_events,
    bumper_forces,
    contact_mode,
    flush_denormal,
    take_step,
    transition_matrix,
)
from twin.model.model import Model
from twin.model.parameters import Parameters
from twin.model.solver import OUTPUT_COUNT, StateEstimate

OUTPUT_NAMES = ("u", "v", "a", "f_r", "f_l", "u_r", "u_l")
EVENT_COLUMNS = ("time_s", "side", "onset", "closing_speed", "impulse")
MAX_PHASE_STEP_RAD = 0.5  # rad per substep in the stiffest mode, so that no event is missed

_EMPTY_EVENTS = np.empty((0, len(EVENT_COLUMNS)))


@dataclass(frozen=True, slots=True, eq=False)
class ClosedFormSolver:
    """Closed-form solver of a model at one sampling rate."""

    model: Model
    parameters: Parameters
    params: Float1D

    @classmethod
    def from_model(cls, model: Model, rate_hz: float) -> "ClosedFormSolver":
        return cls(model, model.parameters, discretized_params(model.parameters, rate_hz))

    def rest_state(self, index: int = 0) -> Float1D:
        return rest_state(self.parameters)

    def restart_state(self, start: StateEstimate) -> Float1D:
        added = self.model.added_acceleration(start.table_disp)
        return restart_state(
            start, start.base_acc + (0.0 if added is None else added), self.parameters
        )

    def set_clock(self, state: Float1D, samples: float) -> None:
        pass

    def advance(self, state: Float1D, base_acc: Float1D, table_disp: Float1D, out: Float2D) -> None:
        added = self.model.added_acceleration(table_disp)
        if added is None:
            advance_state(state, self.params, base_acc, out)
            return
        advance_state(state, self.params, base_acc + added, out)
        out[2] -= added


def rest_state(parameters: Parameters) -> Float1D:
    """Return the static equilibrium state, A = 0: K u + F_R + F_L = 0, F_j = K_j u_j in contact.

    Negative gaps: both in contact at u = (K_L p_L - K_R p_R) / (K + K_R + K_L), p_j = -G0j; only
    one bumper in contact where the other stays clear. A gap of zero counts as flight.
    """
    state = np.zeros(STATE_SIZE)
    k, gap_r, gap_l = parameters.stiffness, parameters.gap_r, parameters.gap_l
    kr, kl = parameters.bumper_stiffness_r, parameters.bumper_stiffness_l
    for right, left in ((False, False), (True, False), (False, True), (True, True)):
        gap_force = (kr * gap_r if right else 0.0) - (kl * gap_l if left else 0.0)
        if not math.isfinite(gap_force):
            continue
        u = gap_force / (k + kr * right + kl * left)
        if (u - gap_r > 0) == right and (-u - gap_l > 0) == left:
            state[U], state[CONTACT_R], state[CONTACT_L] = u, right, left
            state[U_R] = u - gap_r if right else 0.0
            state[U_L] = u + gap_l if left else 0.0
            return state
    raise AssertionError("a system of positive springs has one equilibrium")


def continuous_params(parameters: Parameters) -> Float1D:
    """Return the step-independent part of `discretized_params`, (PARAMS_SIZE,)."""
    p = parameters
    params = np.zeros(PARAMS_SIZE)
    kr, kl = p.bumper_stiffness_r, p.bumper_stiffness_l
    cr, cl = p.bumper_damping_r, p.bumper_damping_l
    params[MASS] = p.mass
    # A face without a dashpot is released at u_j = 0, where it stays: it has no relaxation rate.
    params[R_R], params[R_L] = kr / cr if cr > 0 else 0.0, kl / cl if cl > 0 else 0.0
    params[K_R : K_L + 1] = kr, kl
    params[C_R : C_L + 1] = cr, cl
    params[G_R : G_L + 1] = p.gap_r, p.gap_l
    for mode in range(4):
        right, left = mode & 1, mode >> 1
        k = p.stiffness + right * kr + left * kl
        c = p.damping + right * cr + left * cl
        # A mode with an infinite gap is never entered; zero keeps inf * 0 out of the table.
        f0 = right * kr * (p.gap_r if math.isfinite(p.gap_r) else 0.0)
        f0 -= left * kl * (p.gap_l if math.isfinite(p.gap_l) else 0.0)
        b = MODES + mode * MODE_SIZE
        params[b : b + 5] = k, c, f0, c / (2 * p.mass), k / p.mass
    return params


def highest_angular_frequency(params: Float1D) -> float:
    """Return the angular frequency in 1/s of the stiffest mode that can be reached.

    Both contacts at once are possible only where the total gap is not positive.
    """
    both_contacts = params[G_R] + params[G_L] <= 0
    w2 = max(params[MODES + mode * MODE_SIZE + 4] for mode in ((3,) if both_contacts else (1, 2)))
    return math.sqrt(w2)


def substep_count(params: Float1D, step_s: float) -> int:
    """Return the number of substeps of a step in s, of at most `MAX_PHASE_STEP_RAD` rad each."""
    return max(1, math.ceil(step_s * highest_angular_frequency(params) / MAX_PHASE_STEP_RAD))


def discretized_params(parameters: Parameters, rate_hz: float) -> Float1D:
    """Return the kernel constants of the parameters at this sampling rate, (PARAMS_SIZE,)."""
    params = continuous_params(parameters)
    substeps = substep_count(params, 1 / rate_hz)
    step = 1 / (rate_hz * substeps)
    params[STEP], params[SUBSTEPS] = step, substeps
    for e, r in ((E_R, R_R), (E_L, R_L)):
        params[e] = math.exp(-params[r] * step) if params[r] > 0 else 0.0
    for b in range(MODES, PARAMS_SIZE, MODE_SIZE):
        params[b + 5 : b + 9] = transition_matrix(step, params[b + 3], params[b + 4])
    return params


class ContactLog(NamedTuple):
    """Contact events (m, 5), `EVENT_COLUMNS`, and the step in progress: its start in s, and A."""

    events: Float2D
    start: float
    base: float
    slope: float


@jit_helper()
def add_impulses(
    state: Float1D, params: Float1D, mode: int, t: float, du: float, dv: float, base: float
) -> None:
    """Add the impulses of F_R, F_L over t s of contact, exact by momentum; `base` is the mean A."""
    b = MODES + mode * MODE_SIZE
    integral_u = (params[b + 2] * t - params[MASS] * (dv + base * t) - params[b + 1] * du) / params[
        b
    ]
    if mode & 1:
        state[IMPULSE_R] += params[C_R] * du + params[K_R] * (integral_u - params[G_R] * t)
    if mode & 2:
        state[IMPULSE_L] += params[C_L] * du + params[K_L] * (integral_u + params[G_L] * t)


@jit_helper()
def log_segment(
    log: ContactLog, count: int, state: Float1D, params: Float1D, segment: ModeSegment
) -> int:
    """Add impulses over a segment and write its event, if it fits; return the number of events."""
    events, start, base, slope = log
    mode, t, dt, side, _, _, x0, x1 = segment
    if mode:
        mean_acc = base + slope * t + 0.5 * slope * dt
        add_impulses(state, params, mode, dt, x1[0] - x0[0], x1[1] - x0[1], mean_acc)
    if side < 0:
        return count
    sign, onset = 1.0 - 2.0 * side, state[CONTACT_R + side]
    if count < events.shape[0]:
        closing_speed = sign * (state[V] + params[R_R + side] * state[U_R + side])
        events[count, 0] = start + (t + dt)
        events[count, 1] = sign
        events[count, 2] = onset
        events[count, 3] = closing_speed * onset
        events[count, 4] = state[IMPULSE_R + side]
    state[IMPULSE_R + side] = 0.0
    return count + 1


# One signature, so that slices and read-only arrays of Blocks need no further compilation.
_READ = types.Array(float64, 1, "A", readonly=True)
_WRITE = types.Array(float64, 2, "A")


@jit_kernel(int64(float64[::1], _READ, _READ, _WRITE, _WRITE))
def advance_samples(
    state: Float1D, params: Float1D, base_acc: Float1D, out: Float2D, events: Float2D
) -> int:
    """Advance `state` through the samples of A in m/s2, (n,), linear between; return the events.

    out (7, n), events (m, 5) and their number as in `advance_state`. A step whose guards may
    have turned negative (or are NaN) is repeated through its events.
    """
    if state.size < STATE_SIZE or out.shape[0] < OUTPUT_COUNT or out.shape[1] < base_acc.size:
        raise ValueError("state or out is too small for these samples; see advance_state")
    h, substeps, mass, count = params[STEP], int(params[SUBSTEPS]), params[MASS], 0
    u, v, ur, ul, base = state[U], state[V], state[U_R], state[U_L], state[BASE]
    mode = contact_mode(state)
    for i in range(base_acc.size * substeps):
        sample, substep = i // substeps, i % substeps
        slope = (base_acc[sample] - base) / (h * (substeps - substep))
        next_base = base + slope * h if substep + 1 < substeps else base_acc[sample]
        b = MODES + mode * MODE_SIZE
        k, c = params[b], params[b + 1]
        q1 = -mass * slope / k
        q0 = (params[b + 2] - mass * base - c * q1) / k
        departure, particular = (u - q0, v - q1), (q0 + q1 * h, q1)
        step = take_step(params, mode, h, (u, v, ur, ul), departure, particular, (base, next_base))
        if step.is_clear:
            if mode:
                mean_acc = 0.5 * (base + next_base)
                add_impulses(state, params, mode, h, step.u - u, step.v - v, mean_acc)
            u, v, ur, ul = step.u, step.v, flush_denormal(step.u_r), flush_denormal(step.u_l)
        else:
            state[U], state[V], state[U_R], state[U_L], state[BASE] = u, v, ur, ul, base
            log = ContactLog(events, i * h, base, slope)
            count = advance_through_events(
                state, params, h, base, slope, (0.0, 0.0, 0.0), log_segment, log, count
            )
            if not abs(state[U]) + abs(state[U_R]) + abs(state[U_L]) < math.inf:
                state[:] = math.nan
            u, v, ur, ul = state[U], state[V], state[U_R], state[U_L]
            mode = contact_mode(state)
            next_base += state[BASE] - base  # propagates NaN
        base = next_base
        if substep + 1 == substeps:
            b = MODES + mode * MODE_SIZE
            out[0, sample], out[1, sample] = u, v
            out[2, sample] = (params[b + 2] - params[b + 1] * v - params[b] * u) / mass
            flight_force = state[BASE] - state[BASE]  # 0, or NaN once the state is NaN
            out[3, sample], out[4, sample] = bumper_forces(params, mode, v, ur, ul, flight_force)
            out[5, sample], out[6, sample] = ur, ul
    state[U], state[V], state[U_R], state[U_L], state[BASE] = u, v, ur, ul, base
    return count


def advance_state(
    state: Float1D,
    params: Float1D,
    base_acc: Float1D,
    out: Float2D,
    events: Float2D = _EMPTY_EVENTS,
) -> int:
    """Advance `state` in place from its sample through the next n samples; return the events.

    base_acc: table acceleration at these n samples in m/s2, (n,). out (7, n), `OUTPUT_NAMES`: u in
    m, v in m/s, total acceleration in m/s2, F_R >= 0 and F_L <= 0 in N, u_R and u_L in m.
    events (m, 5), `EVENT_COLUMNS`: time in s since the sample where the call began; side +1 right,
    -1 left; onset 1 or release 0; closing speed relative to the bumper's face in m/s, at onsets;
    impulse of the contact in N s (right >= 0, left <= 0), at releases. Those beyond m are counted,
    not written. After a NaN in the input, out and the state are NaN until a restart.
    """
    return advance_samples(state, params, base_acc, out, events)


def restart_state(start: StateEstimate, base_acc: float, parameters: Parameters) -> Float1D:
    """Return a consistent model state from a measured one; the mass feels `base_acc` = A in m/s2.

    In contact u_j follows u. A contact that would pull becomes flight from the touching point, one
    on an uncompressed bumper becomes flight; a flight that penetrates becomes touching. All NaN if
    any input is.
    """
    p, u, v = parameters, start.u, start.v
    if math.isnan(u + v + start.u_r + start.u_l + base_acc):
        return np.full(STATE_SIZE, np.nan)
    state = np.zeros(STATE_SIZE)
    state[U], state[V], state[BASE] = u, v, base_acc
    # The left side is mirrored, so that both are evaluated with right-hand signs.
    state[U_R], state[CONTACT_R] = _bumper_state(
        u - p.gap_r, v, start.u_r, start.contact_r, p.bumper_stiffness_r, p.bumper_damping_r
    )
    mirrored_u_l, state[CONTACT_L] = _bumper_state(
        -u - p.gap_l, -v, -start.u_l, start.contact_l, p.bumper_stiffness_l, p.bumper_damping_l
    )
    state[U_L] = -mirrored_u_l
    return state


def _bumper_state(
    depth: float, v: float, uj: float, contact: bool, k: float, c: float
) -> tuple[float, bool]:
    """Return (u_j, contact) of a bumper in right-hand signs; `depth` is the u_j at the mass."""
    relaxed = max(uj, 0.0)
    if depth >= 0 and (contact or relaxed < depth):
        return depth, c * v + k * depth > 0
    return relaxed, False
