"""Force laws that no model library has: what discovery must call unexplained.

Each field of `StrangeLaws` is an effect of `ground_truth.DEFINITION_BY_ID` with its parameters in
their order, SI; with the first the effect vanishes. Dry friction is smooth over 1 mm/s. Forces of
the damper are on the left side of the equation of motion of `plant.py`, in a bumper they push.
"""

import math
from typing import NamedTuple

from numba import njit

from table_io.compilation import inline_jit

SLIP_SPEED_M_S = 1e-3  # over which dry friction changes its sign
CORNER_M = 1e-4  # over which a spring with slack takes hold
PLASTIC_EXPONENT = 20  # of the yielding: elastic up to a sharp corner
MEMORY_SIZE = 4  # states: two of the damper's law with memory, softening of each bumper


class StrangeLaws(NamedTuple):
    """Parameters of the laws by effect; by default all vanish."""

    exponential_stiffness: tuple[float, float] = (0.0, 1.0)
    saturating_stiffness: tuple[float, float] = (0.0, 1.0)
    slack_stiffness: tuple[float, float] = (0.0, 1.0)
    root_friction: tuple[float] = (0.0,)
    cross_damping: tuple[float] = (0.0,)
    one_sided_damping: tuple[float] = (0.0,)
    position_friction: tuple[float] = (0.0,)
    square_position_friction: tuple[float] = (0.0,)
    saturating_damping: tuple[float, float] = (0.0, 1.0)
    damping_drift: tuple[float] = (0.0,)
    warming_friction: tuple[float, float] = (0.0, 1.0)
    cable_drag: tuple[float] = (0.0,)
    cable_stiffness: tuple[float] = (0.0,)
    hertz_bumper: tuple[float] = (0.0,)
    quintic_bumper: tuple[float] = (0.0,)
    one_sided_cubic: tuple[float] = (0.0,)
    compression_dashpot: tuple[float] = (0.0,)
    cubic_bumper_damping: tuple[float] = (0.0,)
    softening_bumper: tuple[float, float] = (0.0, 1.0)
    dahl_friction: tuple[float, float] = (0.0, 1.0)
    cubic_maxwell: tuple[float, float] = (0.0, 1.0)
    two_branch_maxwell: tuple[float, float] = (0.0, 1.0)
    elastoplastic: tuple[float, float] = (0.0, 1.0)
    cubic_appendage: tuple[float, float, float] = (0.0, 0.0, 0.0)
    table_resonator: tuple[float, float, float] = (0.0, 1.0, 1.0)

    @property
    def shortest_time_s(self) -> float:
        """Return the shortest time scale of the laws with memory in s, in a motion of 0.5 m/s."""
        times = [self.two_branch_maxwell[1] / 10, self.softening_bumper[1]]
        times += [self.dahl_friction[1] / 0.5, self.elastoplastic[1] / (0.5 * PLASTIC_EXPONENT)]
        return min(times)


@inline_jit
def _sign(v):  # type: ignore[no-untyped-def]
    return math.tanh(v / SLIP_SPEED_M_S)


@njit(nogil=True)  # Python calls it too
def strange_spring_force(u, laws):  # type: ignore[no-untyped-def]
    """Return the elastic force in N of the strange springs of the damper; u in m."""
    force = 0.0
    if laws.exponential_stiffness[0] != 0.0:
        k, length = laws.exponential_stiffness
        rise = math.expm1(abs(u) / length) - abs(u) / length
        force += math.copysign(k * length * rise, u)
    if laws.saturating_stiffness[0] != 0.0:
        k, length = laws.saturating_stiffness
        force += k * length * math.tanh(u / length)
    if laws.slack_stiffness[0] != 0.0:
        k, slack = laws.slack_stiffness
        beyond = u - slack
        force += 0.5 * k * (beyond + math.sqrt(beyond * beyond + CORNER_M**2) - CORNER_M)
    return force


@inline_jit
def strange_damper_force(u, v, y, vy, t, c, laws):  # type: ignore[no-untyped-def]
    """Return the other strange forces in N without memory on the specimen.

    u, v relative and y, vy of the table in m and m/s, t in s, c the damper's dashpot in N s/m.
    """
    force = laws.root_friction[0] * v / math.sqrt(math.sqrt(v * v + SLIP_SPEED_M_S**2))
    force += laws.cross_damping[0] * u * v * v + laws.one_sided_damping[0] * v * max(v, 0.0)
    friction = laws.position_friction[0] * abs(u) + laws.square_position_friction[0] * u * u
    friction += laws.warming_friction[0] * math.exp(-t / laws.warming_friction[1])
    force += friction * _sign(v) + c * laws.damping_drift[0] * t * v
    force += laws.saturating_damping[0] * math.tanh(v / laws.saturating_damping[1])
    return force + laws.cable_drag[0] * vy + laws.cable_stiffness[0] * y * y * y


@njit(nogil=True)
def strange_spring_push(d, j, softened, laws):  # type: ignore[no-untyped-def]
    """Return the strange elastic push in N of bumper j at compression d in m."""
    depth = max(d, 0.0)
    cube = depth * depth * depth
    push = laws.hertz_bumper[0] * depth * math.sqrt(depth)
    push += laws.quintic_bumper[0] * cube * depth * depth
    push += laws.one_sided_cubic[0] * cube * (1 - j)
    return push - laws.softening_bumper[0] * softened * depth


@inline_jit
def strange_dashpot_push(closing, laws):  # type: ignore[no-untyped-def]
    """Return the strange push in N of a bumper at a closing speed in m/s."""
    push = laws.compression_dashpot[0] * max(closing, 0.0)
    return push + laws.cubic_bumper_damping[0] * closing * closing * closing


@inline_jit
def strange_recovery_rate(static, dashpot, laws):  # type: ignore[no-untyped-def]
    """Return d' in m/s of a free face: the root of static + dashpot d' + strange push = 0."""
    cubic = laws.cubic_bumper_damping[0]
    if cubic == 0.0:
        return -static / dashpot
    p, q = dashpot / cubic, static / cubic
    half = math.sqrt(p / 3.0)
    return -2.0 * half * math.sinh(math.asinh(1.5 * q / (p * half)) / 3.0)


@inline_jit
def memory_force(first, second, laws):  # type: ignore[no-untyped-def]
    """Return the force in N of the damper's law with memory from its two states."""
    force = laws.dahl_friction[0] * first + laws.cubic_maxwell[0] * first * first * first
    force += laws.two_branch_maxwell[0] * (first + second)
    return force + laws.elastoplastic[0] * first


@inline_jit
def memory_rates(v, first, second, laws):  # type: ignore[no-untyped-def]
    """Return d/dt of both states: friction over its limit, or stretch in m of each spring."""
    if laws.dahl_friction[0] != 0.0:
        return v / laws.dahl_friction[1] * (1.0 - first * _sign(v)), 0.0
    if laws.cubic_maxwell[0] != 0.0:
        k, dashpot = laws.cubic_maxwell
        return v - k * first * first * first / dashpot, 0.0
    if laws.two_branch_maxwell[0] != 0.0:
        tau = laws.two_branch_maxwell[1]
        return v - first / tau, v - 10.0 * second / tau
    if laws.elastoplastic[0] != 0.0:
        loading = 0.5 * (1.0 + _sign(v * first * 1e3))
        return v / laws.elastoplastic[1] * (1.0 - loading * first**PLASTIC_EXPONENT), 0.0
    return 0.0, 0.0


@inline_jit
def softening_rate(touched, softened, laws):  # type: ignore[no-untyped-def]
    """Return d/dt of the softening of a bumper: towards 1 in contact, 0 out of it."""
    return (touched - softened) / laws.softening_bumper[1]


@inline_jit
def strange_resonator(stretch, speed, w, vw, laws):  # type: ignore[no-untyped-def]
    """Return (force in N on the specimen, acceleration of the second mass) of strange resonators.

    stretch, speed of the second mass from the specimen, w and vw from the table, in m and m/s.
    """
    if laws.cubic_appendage[0] != 0.0:
        mass, cubic, damping = laws.cubic_appendage
        pull = mass * (cubic * stretch * stretch * stretch + damping * speed)
        return pull, -pull / mass
    if laws.table_resonator[0] != 0.0:
        coupling, mass, frequency = laws.table_resonator
        w2 = 2.0 * math.pi * frequency
        return coupling * stretch, -w2 * (w2 * w + 0.04 * vw) - coupling * stretch / mass
    return 0.0, 0.0
