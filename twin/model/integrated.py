"""The solver of models with force laws or more states: integrated, or linear and exact."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import expm

from table_io.block import Float1D, Float2D
from table_io.card import BadInput
from twin.model import exact, laws
from twin.model.effects import bumper_hardening, cubic_stiffness
from twin.model.integrate import (
    AT_BASE,
    AT_F,
    AT_Z,
    CLOCK,
    STATE_SIZE,
    WAY,
    sampled,
)
from twin.model.parameters import Parameters
from twin.model.solver import GRAVITY_M_S2, Start

if TYPE_CHECKING:
    from twin.model.model import Model

TURN = 0.5  # rad: most that the fastest phase may turn in a part of a step
FADE = 0.6  # most relaxation times of a part of a step, where it is integrated
FADE_LINEAR = 2.0  # and where it is propagated: the series still converges without cancellation
MOST_PARTS = 500
DEPTH = 0.003  # m: compression for which a hardening bumper's pace is taken

# effect, parameter -> coefficient, for those that go straight in
COEFFICIENTS = (
    ("cubic_stiffness", "k3", laws.K3),
    ("quadratic_damping", "c2", laws.C2),
    ("coulomb_friction", "fc", laws.FC),
    ("bouc_wen", "force", laws.FY),
    ("bouc_wen", "yield_displacement", laws.UY),
    ("maxwell_damper", "k1", laws.K1),
    ("bumper_hardening", "k2", laws.K2),
    ("hunt_crossley", "ch", laws.CH),
    ("bumper_maxwell", "kb", laws.KB),
    ("gap_drift", "rate", laws.DRIFT),
)
RATES = (("maxwell_damper", "tau", laws.RATE_1), ("bumper_maxwell", "tau", laws.RATE_B))


@dataclass(frozen=True, slots=True, eq=False)
class IntegratedSolver:
    """`parameters` at sample 0; `period` in s; `tilt` as in `ClosedSolver`."""

    parameters: Parameters
    period: float
    tilt: float
    constants: laws.Constants
    maps: Float2D
    extra: laws.Extra

    @classmethod
    def of(cls, model: "Model", rate_hz: float) -> "IntegratedSolver":
        con, extra = coefficients(model)
        divide(con, rate_hz)
        tilt = GRAVITY_M_S2 * (model.value("table_tilt", "tilt") or 0.0)
        return cls(model.parameters, 1 / rate_hz, tilt, tuple(con.tolist()), maps(con), extra)

    def rest(self, index: int = 0) -> Float1D:
        p = self._at(index)
        begin = exact.rest(p)
        u, con = float(begin[0]), self.constants
        if con[laws.K3] or con[laws.K2]:
            u = balance(p, u, con[laws.K3], con[laws.K2])
        state = self._blank(index)
        state[:6] = begin[:6]
        state[0] = u
        state[2], state[3] = max(u - p.gap_r, 0.0), min(u + p.gap_l, 0.0)
        return state

    def restart(self, start: Start) -> Float1D:
        base = start.base_acc + (self.tilt * start.table_disp if self.tilt else 0.0)
        state = self._blank(start.index)
        state[: AT_BASE + 1] = exact.restart(
            start.u, start.v, start.u_r, start.u_l, start.touch_r, start.touch_l, base,
            self._at(start.index),
        )[: AT_BASE + 1]  # fmt: skip
        if start.hidden is not None and np.isfinite(start.hidden).all():
            state[AT_F : AT_Z + 1] = start.hidden[AT_F : AT_Z + 1]
        if math.isnan(state[0]):
            state[:CLOCK] = math.nan
        elif start.v != 0:
            state[WAY] = math.copysign(1.0, start.v)
        return state

    def retime(self, state: Float1D, samples: float) -> None:
        state[CLOCK] = samples

    def advance(self, state: Float1D, base_acc: Float1D, table_disp: Float1D, out: Float2D) -> None:
        base = base_acc + self.tilt * table_disp if self.tilt else base_acc
        sampled(state, self.constants, self.maps, self.extra, base, out)
        if self.tilt:
            out[2] -= self.tilt * table_disp

    def _at(self, index: int) -> Parameters:
        """The parameters with the gaps of a sample."""
        opened = self.constants[laws.DRIFT] * index * self.period
        p = self.parameters
        return replace(p, gap_r=p.gap_r + opened, gap_l=p.gap_l + opened) if opened else p

    def _blank(self, index: int) -> Float1D:
        """Standing still, relaxed. It sticks, where there is friction: the solver looks first."""
        state = np.zeros(STATE_SIZE)
        state[WAY], state[CLOCK] = 0.0 if self.constants[laws.FC] > 0 else 1.0, index
        return state


def coefficients(model: "Model") -> tuple[Float1D, laws.Extra]:
    """(all of `laws` that does not depend on the step, the compiled force of the plug-ins)."""
    plugins = [one for one in model.present if one.effect.force is not None]
    numbers = [one.values[p.name] for one in plugins for p in one.effect.parameters]
    if len(numbers) > laws.EXTRAS:
        raise BadInput(
            f"plug-in effects have {len(numbers)} parameters together; allowed: {laws.EXTRAS}; "
            "remove one"
        )
    con = np.zeros(laws.CONSTANTS_SIZE)
    p = model.parameters
    con[: laws.C_L + 1] = (
        p.mass, p.stiffness, p.damping, p.bumper_stiffness_r, p.bumper_stiffness_l,
        p.bumper_damping_r, p.bumper_damping_l,
    )  # fmt: skip
    con[laws.G_R], con[laws.G_L] = min(p.gap_r, laws.FAR), min(p.gap_l, laws.FAR)
    con[laws.UY] = 1.0
    for effect, parameter, place in COEFFICIENTS:
        con[place] = model.value(effect, parameter) or con[place]
    for effect, parameter, place in RATES:
        tau = model.value(effect, parameter)
        con[place] = 1 / tau if tau else 0.0
    con[laws.EXTRA], con[laws.EXTRA_FIRST :][: len(numbers)] = len(plugins), numbers
    con[laws.TURNS] = float(con[[laws.C2, laws.FC, laws.FY, laws.EXTRA]].any())
    smooth = con[[laws.K3, laws.K2, laws.CH]].any() or con[laws.TURNS]
    con[laws.LINEAR] = float(not smooth)
    forces = tuple(
        (force, len(one.effect.parameters)) for one in plugins if (force := one.effect.force)
    )
    return con, laws.together(forces) if forces else laws.no_extra


def divide(con: Float1D, rate_hz: float) -> None:
    """Writes period, parts and step: no part may turn or relax too far. BadInput names the worst.

    A face relaxes with (K_j + k2 d + kb) / C_j, which no damping at touch makes slower.
    """
    both = con[laws.G_R] + con[laws.G_L] <= 0
    sides = [con[laws.K_R + s] + 2 * con[laws.K2] * DEPTH + con[laws.KB] for s in range(2)]
    k = con[laws.K] + con[laws.K1] + con[laws.FY] / con[laws.UY]
    turn = math.sqrt((k + (sum(sides) if both else max(sides))) / con[laws.MASS])
    fades = [con[laws.RATE_1], con[laws.RATE_B]]
    for s in range(2):
        if con[laws.C_R + s] > 0 and con[laws.G_R + s] < laws.FAR / 2:
            fades.append((con[laws.K_R + s] + con[laws.K2] * DEPTH + con[laws.KB])
                         / con[laws.C_R + s] + con[laws.RATE_B])  # fmt: skip
    fade = FADE_LINEAR if con[laws.LINEAR] else FADE
    parts = max(1, math.ceil(turn / TURN / rate_hz), math.ceil(max(fades) / fade / rate_hz))
    if parts > MOST_PARTS:
        raise BadInput(
            f"rate_hz {rate_hz:g}: too low for a relaxation in {1e3 / max(fades):.2g} ms, which "
            f"takes {parts} steps a sample; allowed: {MOST_PARTS}; raise rate_hz, or tau or the "
            "bumper damping (0 is allowed: a bumper without memory)"
        )
    con[laws.PERIOD], con[laws.PARTS], con[laws.STEP] = 1 / rate_hz, parts, 1 / (rate_hz * parts)


def maps(con: Float1D) -> Float2D:
    """(8 x LINEAR_SIZE, LINEAR_SIZE): generators of the four modes, then their maps over a step.

    Row by row the derivatives of the first LINEAR_SIZE entries of a point, as in `laws.rates`.
    """
    n = laws.LINEAR_SIZE
    result = np.zeros((8 * n, n))
    if not con[laws.LINEAR]:
        return result
    for mode in range(4):
        generator = _generator(con, mode)
        result[mode * n : (mode + 1) * n] = generator
        result[(4 + mode) * n : (5 + mode) * n] = expm(generator * con[laws.STEP])
    return result


def _generator(con: Float1D, mode: int) -> Float2D:
    """d/dt of (u, v, u_R, u_L, f, b_R, b_L, A, its slope, right gap, left gap, 1) as a matrix."""
    u, v, f, base, slope, one = 0, 1, 4, 7, 8, 11
    mass, drift, kb, rate = con[[laws.MASS, laws.DRIFT, laws.KB, laws.RATE_B]]
    rows = np.zeros((laws.LINEAR_SIZE, laws.LINEAR_SIZE))
    rows[u, v], rows[v, base], rows[base, slope] = 1.0, -1.0, 1.0
    rows[v, u], rows[v, v], rows[v, f] = -con[laws.K] / mass, -con[laws.C] / mass, -1 / mass
    rows[f, v], rows[f, f] = con[laws.K1], -con[laws.RATE_1]
    for side, right in ((0, 1.0), (1, -1.0)):
        uj, b, gap = 2 + side, 5 + side, 9 + side
        k, c = con[laws.K_R + side], con[laws.C_R + side]
        rows[gap, one] = drift
        if (mode >> side) & 1:
            # u_j = u -+ gap and the wall moves: F_j = c (u' -+ drift) + k (u -+ gap) + b
            rows[uj, v], rows[uj, one] = 1.0, -right * drift
            rows[v, u] -= k / mass
            rows[v, v] -= c / mass
            rows[v, b] -= 1 / mass
            rows[v, gap] += right * k / mass
            rows[v, one] += right * c * drift / mass
        elif c > 0:
            rows[uj, uj], rows[uj, b] = -k / c, -1 / c
        else:
            rows[uj, b] = rate / (k + kb)
        rows[b] = kb * rows[uj]
        rows[b, b] -= rate
    return rows


def balance(p: Parameters, near: float, k3: float, k2: float) -> float:
    """u in m where the springs balance; the linear answer `near` where it does already.

    Bisection on a force that grows with u; k3 < 0 softens it less than the bumpers stiffen it.
    """

    def push(d: float, k: float) -> float:
        return k * d + bumper_hardening.force(d, k2) if d > 0 else 0.0

    def force(u: float) -> float:
        right, left = (
            push(u - p.gap_r, p.bumper_stiffness_r),
            push(-u - p.gap_l, p.bumper_stiffness_l),
        )
        return p.stiffness * u + cubic_stiffness.force(u, k3) + right - left

    if force(near) == 0.0:
        return near
    reach = max(abs(gap) for gap in (p.gap_r, p.gap_l, near) if math.isfinite(gap))
    return bisect(force, -reach, reach)


def bisect(function: Callable[[float], float], low: float, high: float) -> float:
    """The root of a growing function between low and high, to the last bit."""
    for _ in range(200):
        middle = 0.5 * (low + high)
        if function(middle) > 0:
            high = middle
        else:
            low = middle
    return 0.5 * (low + high)
