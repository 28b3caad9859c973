"""The plant with hidden effects: `plant.py` and every force of `truth.KINDS`, integrated anew.

    R + damper + N_R - N_L + M g sin(tilt y) = m2 p,  R = M x''   (p: pull of the appendage over m2)
    free face:     static_j + dashpot_j d_j' = 0
    touched face:  d_j' = +-u' - drift, N_j = static_j + dashpot_j d_j', for as long as N_j > -pull

Laws are smooth where textbooks have corners, so classical Runge-Kutta, cut where a contact changes,
keeps its fourth order (but for z of Bouc-Wen at z = 0, where it is only once differentiable). The
table bears R of the mass and of the appendage. `Plant` without a truth never comes here.
"""

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numba import njit

from table_io.backends import plant as plain
from table_io.backends.plant import ON, VX, VY, D, Plant, X, Y, _at, _from, _spline
from table_io.block import Float1D, Float2D
from table_io.card import BadInput
from table_io.units import GRAVITY_M_S2

# The state goes on, float64 (15,): z, the damper's Maxwell force and the bumpers' in N, the
# appendage's position and velocity, time in s.
Z, F, B, W, VW, T, SIZE = 8, 9, 10, 12, 13, 14, 15
HALVINGS = 45  # of a sub-step down to rounding
SLOW = 1e-3  # m/s: below it |u'| is rounded
STRETCH, DEPTH, SATURATED = 0.15, 0.1, 0.03  # m: scales of the laws; see `truth.KINDS`
SPEED, ACCELERATION = 0.5, 2.0  # SI, of a fast motion, to bound the sub-step


inner = njit(nogil=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)


class Hidden(NamedTuple):
    """Coefficients of the hidden laws in SI, each at the value at which it vanishes."""

    k3: float = 0.0
    k5: float = 0.0
    ke: float = 0.0
    dead: float = 0.0
    c2: float = 0.0
    c3: float = 0.0
    cu: float = 0.0
    fc: float = 0.0
    fs: float = 0.0
    vs: float = 1.0
    v0: float = SLOW
    fy: float = 0.0
    uy: float = 1.0
    n: float = 1.5
    beta: float = 0.6
    k1: float = 0.0
    tau: float = 1.0
    k2: float = 0.0
    kc: float = 0.0
    ch: float = 0.0
    kb: float = 0.0
    tau_b: float = 1.0
    pull: float = 0.0
    drift: float = 0.0
    warm: float = 0.0
    tilt: float = 0.0
    stiff: tuple[float, float] = (1.0, 1.0)  # K_R and K_L over the mean
    m2: float = 0.0
    w2: float = 0.0
    z2: float = 0.0

    def fastest(self, plant: Plant) -> float:
        """Shortest time in s in which one of the laws moves."""
        dry = max(self.fc, self.fs, 1e-9)
        kj, cj = plant.bumper_stiffness_n_m * max(self.stiff), plant.bumper_damping_n_s_m
        return min(
            cj / (kj + self.kb),
            self.tau,
            self.tau_b,
            self.v0 * min(plant.mass_kg / dry, 1.0 / ACCELERATION),
            self.uy / (self.n * SPEED),
            1.0 / max(self.w2, 1e-9),
        )


@inner
def _spring(u, t, law, hid):  # type: ignore[no-untyped-def]
    """Elastic force of the damper in N, u in m, t in s."""
    u2 = u * u
    force = u * (law.k * (1.0 + hid.warm * t) + hid.k5 * u2 * u2) + hid.ke * u2
    if hid.k3 != 0.0:
        force += hid.k3 * u * u2 / math.sqrt(1.0 + u2 / STRETCH**2)
    if hid.dead > 0.0:
        force -= law.k * hid.dead * math.tanh(u / hid.dead)
    return force


@inner
def _damper(s, law, hid):  # type: ignore[no-untyped-def]
    """Force of the damper in N: springs, dashpots, dry friction, hysteresis, relaxation."""
    u, v = s[X] - s[Y], s[VX] - s[VY]
    viscous = law.c + hid.c2 * math.sqrt(v * v + SLOW**2) + hid.c3 * v * v + hid.cu * u * u
    force = _spring(u, s[T], law, hid) + viscous * v + hid.fy * s[Z] + s[F]
    if hid.fc > 0.0 or hid.fs > 0.0:
        dry = hid.fc + (hid.fs - hid.fc) * math.exp(-((v / hid.vs) ** 2))
        force += dry * math.tanh(v / hid.v0)
    return force


@inner
def _bumper(d, b, j, law, hid):  # type: ignore[no-untyped-def]
    """(static force in N, dashpot in N s/m) of bumper j; compression d in m, branch force b."""
    static = law.kj * hid.stiff[j] * d + hid.kc * d * d * d + b
    dashpot = law.cj
    if hid.k2 != 0.0:
        static += 2.0 * hid.k2 * DEPTH**2 * (math.expm1(d / DEPTH) - d / DEPTH)
    if hid.ch != 0.0:
        dashpot += hid.ch * SATURATED * math.tanh(abs(d) / SATURATED)
    return static, dashpot


@inner
def _face(s, j, law, hid):  # type: ignore[no-untyped-def]
    """(N_j in N, d_j' in m/s) of the face j."""
    static, dashpot = _bumper(s[D + j], s[B + j], j, law, hid)
    if s[ON + j] == 0.0:
        return 0.0, -static / dashpot
    closing = (1 - 2 * j) * (s[VX] - s[VY]) - hid.drift
    return static + dashpot * closing, closing


@inner
def _rates(s, command, law, hid, rate):  # type: ignore[no-untyped-def]
    """Time derivative of the state, into `rate`; command in m."""
    v = s[VX] - s[VY]
    right, right_rate = _face(s, 0, law, hid)
    left, left_rate = _face(s, 1, law, hid)
    on_table = _damper(s, law, hid) + right - left
    if hid.tilt != 0.0:
        on_table += law.m * GRAVITY_M_S2 * math.sin(hid.tilt * s[Y])
    swing = hid.w2 * (hid.w2 * (s[W] - s[X]) + 2.0 * hid.z2 * (s[VW] - s[VX]))
    rate[X] = s[VX]
    rate[VX] = (hid.m2 * swing - on_table) / law.m
    rate[Y] = s[VY]
    rate[VY] = law.p * (law.p * (command - s[Y]) - 2.0 * s[VY]) + on_table * law.per_table
    rate[D], rate[D + 1] = right_rate, left_rate
    rate[ON], rate[ON + 1] = 0.0, 0.0
    rate[Z] = 0.0
    if hid.fy != 0.0:
        back = hid.beta * math.tanh(v / SLOW) * np.sign(s[Z]) + 1.0 - hid.beta
        rate[Z] = v / hid.uy * (1.0 - abs(s[Z]) ** hid.n * back)
    rate[F] = hid.k1 * v - s[F] / hid.tau
    rate[B] = hid.kb * right_rate - s[B] / hid.tau_b
    rate[B + 1] = hid.kb * left_rate - s[B + 1] / hid.tau_b
    rate[W], rate[VW], rate[T] = s[VW], -swing, 1.0


@inner
def _runge_kutta(s, path, h, law, hid, work):  # type: ignore[no-untyped-def]
    """The state h seconds on, contacts unchanged, into the last row of `work`."""
    stage, end = work[4], work[5]
    _rates(s, path[0], law, hid, work[0])
    for i in range(1, 4):
        part = h if i == 3 else 0.5 * h
        for n in range(SIZE):
            stage[n] = s[n] + part * work[i - 1, n]
        _rates(stage, _at(path, part), law, hid, work[i])
    for n in range(SIZE):
        mean = work[0, n] + 2.0 * (work[1, n] + work[2, n]) + work[3, n]
        end[n] = s[n] + h / 6.0 * mean


@inner
def _changed(s, law, hid):  # type: ignore[no-untyped-def]
    """The face (0 right, 1 left) whose contact is no longer what the state says, or -1."""
    for j in range(2):
        if s[ON + j] != 0.0:
            margin = (_face(s, j, law, hid)[0] + hid.pull) / law.kj
        else:
            margin = law.gap[j] + hid.drift * s[T] + s[D + j] - (1 - 2 * j) * (s[X] - s[Y])
        if margin < -plain.TOUCH_M:
            return j
    return -1


@inner
def _settle(s, law, hid):  # type: ignore[no-untyped-def]
    """Ties touched faces to the mass, so that rounding cannot part them; drops denormals."""
    for j in range(2):
        if s[ON + j] != 0.0:
            s[D + j] = (1 - 2 * j) * (s[X] - s[Y]) - law.gap[j] - hid.drift * s[T]
    for n in (D, D + 1, F, B, B + 1):
        if abs(s[n]) < plain.DENORMAL_M:
            s[n] = 0.0


@inner
def _substep(s, path, h, law, hid, work):  # type: ignore[no-untyped-def]
    """Moves the state by h, cut where a contact changes."""
    left, end = h, work[5]
    for switch in range(plain.SWITCHES + 1):
        _runge_kutta(s, path, left, law, hid, work)
        if switch == plain.SWITCHES or _changed(end, law, hid) < 0:
            break
        low, high = 0.0, left
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            _runge_kutta(s, path, middle, law, hid, work)
            if _changed(end, law, hid) < 0:
                low = middle
            else:
                high = middle
        _runge_kutta(s, path, high, law, hid, work)
        side = _changed(end, law, hid)
        s[:] = end
        s[ON + side] = 1.0 - s[ON + side]
        _settle(s, law, hid)
        path = _from(path, high)
        left -= high
    s[:] = end
    _settle(s, law, hid)


@njit(cache=True, nogil=True)
def _advance(s, command, law, hid, work, out):  # type: ignore[no-untyped-def]
    """Moves `s` by out.shape[1] samples; command[k : k + 4] spans the delayed sample k."""
    corner, rest = law.phi * law.h, (1.0 - law.phi) * law.h
    for k in range(out.shape[1]):
        path = _from(_spline(command, k, law.h), rest)
        h = corner / max(law.before, 1)
        for i in range(law.before):
            _substep(s, _from(path, i * h), h, law, hid, work)
        path = _spline(command, k + 1, law.h)
        h = rest / law.after
        for i in range(law.after):
            _substep(s, _from(path, i * h), h, law, hid, work)
        _rates(s, _at(path, rest), law, hid, work[0])
        out[0, k], out[1, k] = s[Y], work[0, VY]
        out[2, k], out[3, k] = s[X], work[0, VX]
        out[4, k], out[5, k] = _face(s, 0, law, hid)[0], -_face(s, 1, law, hid)[0]
        out[6, k] = _damper(s, law, hid)


@dataclass(frozen=True)
class HiddenPlant(Plant):
    """The plant with hidden laws; `state` is float64 (15,), a signal more: the damper's force."""

    hidden: Hidden = field(default_factory=Hidden)
    signals = (*plain.SIGNALS, "damper_force")

    def __post_init__(self) -> None:
        super().__post_init__()
        fastest, least = (
            self.hidden.fastest(self),
            1.0 / (plain.RELAXATION * plain.MOST_SUBSTEPS * self.rate_hz),
        )
        if fastest < least:
            raise BadInput(
                f"the hidden truth moves in {fastest:.2g} s, faster than the simulated table can "
                f"follow; allowed at {self.rate_hz:g} Hz: at least {least:.2g} s; mend the truth"
            )
        object.__setattr__(self, "substep_s", min(self.substep_s, plain.RELAXATION * fastest))

    def rest(self) -> Float1D:
        """State of static equilibrium with the table at 0 and everything relaxed.

        Found by halving, since the laws are nonlinear: spring(u) + N_R - N_L = 0.
        """
        law = self._law

        def pressed(u: float) -> tuple[float, float]:
            return max(u - self.gap_right_m, 0.0), max(-u - self.gap_left_m, 0.0)

        def force(u: float) -> float:
            right, left = (
                _bumper.py_func(d, 0.0, j, law, self.hidden)[0] for j, d in enumerate(pressed(u))
            )
            return float(_spring.py_func(u, 0.0, law, self.hidden) + right - left)

        low, high = -0.05, 0.05
        for _ in range(80 if force(0.0) != 0.0 else 0):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if force(middle) < 0.0 else (low, middle)
        u = 0.5 * (low + high)
        state, faces = np.zeros(SIZE), pressed(u)
        state[[X, W, T]] = u, u, -1.0 / self.rate_hz  # so that sample 0 is at 0 s
        state[D : D + 2], state[ON : ON + 2] = faces, np.array(faces) > 0.0
        return state

    def advance(self, state: Float1D, command_m: Float1D, out: Float2D) -> None:
        """As `Plant.advance`, `out` (7, sample)."""
        if command_m.shape != (self.history + out.shape[1],) or len(out) != len(self.signals):
            raise ValueError(f"command {command_m.shape} does not span output {out.shape}")
        _advance(state, command_m, self._law, self.hidden, np.empty((plain.ROWS, SIZE)), out)
