"""The SNM on sampled table acceleration, exact between the samples: state in, state out.

The table acceleration is linear between samples (first-order hold); under it every phase is known
in closed form and every contact is found where it happens. The state is float64 (STATE_SIZE,):
    u, v, u_r, u_l          m, m/s, m, m (u_r >= 0, u_l <= 0)
    contact_r, contact_l    1.0 in contact, else 0.0
    A                       table acceleration at this sample, m/s2
    impulse_r, impulse_l    of the contact that is under way, N s
It is the whole memory: cutting the samples into other blocks changes no bit.
"""

import math

import numpy as np

from table_io.block import Float1D, Float2D
from twin.model.parameters import Parameters
from twin.model.phase import (
    BASE,
    C_L,
    C_R,
    CONSTANTS_SIZE,
    CONTACT_L,
    CONTACT_R,
    E_L,
    E_R,
    G_L,
    G_R,
    K_L,
    K_R,
    MASS,
    MODE_SIZE,
    MODES,
    R_L,
    R_R,
    STATE_SIZE,
    STEP,
    SUBSTEPS,
    U_L,
    U_R,
    U,
    V,
    flow,
)  # fmt: skip
from twin.model.sampled import march

OUTPUTS = ("u", "v", "a", "f_r", "f_l", "u_r", "u_l")
EVENT_COLUMNS = ("time_s", "side", "onset", "closing_speed", "impulse")
TURN = 0.5  # rad: most that the fastest phase may turn in a substep, so that no event hides in it

_NO_LOG = np.empty((0, len(EVENT_COLUMNS)))


def rest(parameters: Parameters) -> Float1D:
    """The state of static equilibrium, A = 0: K u + F_R + F_L = 0, F_j = K_j u_j in contact.

    Negative gaps: both in contact at u = (K_L p_L - K_R p_R) / (K + K_R + K_L), p_j = -G0j; one
    bumper alone where the other one stays clear. A gap of zero is flight.
    """
    state = np.zeros(STATE_SIZE)
    k, gap_r, gap_l = parameters.stiffness, parameters.gap_r, parameters.gap_l
    kr, kl = parameters.bumper_stiffness_r, parameters.bumper_stiffness_l
    for right, left in ((False, False), (True, False), (False, True), (True, True)):
        push = (kr * gap_r if right else 0.0) - (kl * gap_l if left else 0.0)
        if not math.isfinite(push):
            continue
        u = push / (k + kr * right + kl * left)
        if (u - gap_r > 0) == right and (-u - gap_l > 0) == left:
            state[U], state[CONTACT_R], state[CONTACT_L] = u, right, left
            state[U_R] = u - gap_r if right else 0.0
            state[U_L] = u + gap_l if left else 0.0
            return state
    raise AssertionError("a system of positive springs has one equilibrium")


def parameter_constants(parameters: Parameters) -> Float1D:
    """The part of `constants` that does not depend on the step."""
    p = parameters
    con = np.zeros(CONSTANTS_SIZE)
    kr, cr, kl, cl = (
        p.bumper_stiffness_r,
        p.bumper_damping_r,
        p.bumper_stiffness_l,
        p.bumper_damping_l,
    )
    con[MASS] = p.mass
    # Without a dashpot the face does not move by itself: released at u_j = 0 it is where it stays.
    con[R_R], con[R_L] = kr / cr if cr > 0 else 0.0, kl / cl if cl > 0 else 0.0
    con[K_R], con[K_L], con[C_R], con[C_L], con[G_R], con[G_L] = kr, kl, cr, cl, p.gap_r, p.gap_l
    for mode in range(4):
        right, left = mode & 1, mode >> 1
        k = p.stiffness + right * kr + left * kl
        c = p.damping + right * cr + left * cl
        # A mode with an infinite gap is never entered; zero keeps inf * 0 out of the table.
        f0 = right * kr * (p.gap_r if math.isfinite(p.gap_r) else 0.0)
        f0 -= left * kl * (p.gap_l if math.isfinite(p.gap_l) else 0.0)
        b = MODES + mode * MODE_SIZE
        con[b : b + 5] = k, c, f0, c / (2 * p.mass), k / p.mass
    return con


def substeps(constants: Float1D, step: float) -> int:
    """Parts of a step in s such that the stiffest phase turns at most `TURN` rad in each.

    Both contacts at once are possible only where the total gap is not positive.
    """
    both = constants[G_R] + constants[G_L] <= 0
    w2 = max(constants[MODES + mode * MODE_SIZE + 4] for mode in ((3,) if both else (1, 2)))
    return max(1, math.ceil(step * math.sqrt(w2) / TURN))


def constants(parameters: Parameters, rate_hz: float) -> Float1D:
    """What `advance` needs of the parameters at this sampling rate, (CONSTANTS_SIZE,)."""
    con = parameter_constants(parameters)
    parts = substeps(con, 1 / rate_hz)
    step = 1 / (rate_hz * parts)
    con[STEP], con[SUBSTEPS] = step, parts
    for e, r in ((E_R, R_R), (E_L, R_L)):
        con[e] = math.exp(-con[r] * step) if con[r] > 0 else 0.0
    for b in range(MODES, CONSTANTS_SIZE, MODE_SIZE):
        con[b + 5 : b + 9] = flow(step, con[b + 3], con[b + 4])
    return con


def advance(state: Float1D, constants: Float1D, base_acc: Float1D, out: Float2D) -> None:
    """Moves `state` in place from the sample it stands at through the next n samples.

    base_acc: table acceleration at these n samples in m/s2, (n,). out (7, n), `OUTPUTS`: u in m,
    v in m/s, total acceleration in m/s2, F_R >= 0 and F_L <= 0 in N, u_R and u_L in m.
    From a NaN on, all of out and the state are NaN until a restart.
    """
    march(state, constants, base_acc, out, _NO_LOG)


def advance_logged(
    state: Float1D, constants: Float1D, base_acc: Float1D, out: Float2D, events: Float2D
) -> int:
    """As `advance`, and writes the contacts to `events` (m, 5), `EVENT_COLUMNS`; their number.

    Time in s since the sample where the call began; side +1 right, -1 left; onset 1 or release 0;
    closing speed against the bumper's own face in m/s, at onsets; impulse of the contact in N s
    (right >= 0, left <= 0), at releases. What does not fit into `events` is counted, not written.
    """
    return int(march(state, constants, base_acc, out, events))


def restart(
    u: float,
    v: float,
    u_r: float,
    u_l: float,
    force_r_contact: bool,
    force_l_contact: bool,
    base: float,
    parameters: Parameters,
) -> Float1D:
    """A state that the model allows, from a measured estimate (SI, right positive, base = A).

    In contact u_j is slaved to u; a contact that would pull is flight from the touching point, one
    on an uncompressed bumper is plain flight; a flight that penetrates is set touching. All NaN
    where anything is.
    """
    p = parameters
    if math.isnan(u + v + u_r + u_l + base):
        return np.full(STATE_SIZE, np.nan)
    state = np.zeros(STATE_SIZE)
    state[U], state[V], state[BASE] = u, v, base
    # On the left everything is mirrored: face(u, v, u_j, gap) with right-hand signs.
    state[U_R], state[CONTACT_R] = _face(
        u - p.gap_r, v, u_r, force_r_contact, p.bumper_stiffness_r, p.bumper_damping_r
    )
    mirrored, state[CONTACT_L] = _face(
        -u - p.gap_l, -v, -u_l, force_l_contact, p.bumper_stiffness_l, p.bumper_damping_l
    )
    state[U_L] = -mirrored
    return state


def _face(
    touching: float, v: float, uj: float, contact: bool, k: float, c: float
) -> tuple[float, bool]:
    """(u_j, contact) of a bumper in right-hand signs; `touching` is the u_j that meets the mass."""
    relaxed = max(uj, 0.0)
    if touching >= 0 and (contact or relaxed < touching):
        return touching, c * v + k * touching > 0
    return relaxed, False
