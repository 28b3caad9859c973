"""Random vibro-impact models, and what many starts find of them without any continuation."""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from tests.laws.laboratory_laws import SLIP_DAMPER, ZENER_DAMPER
from tests.model.independent_solution import Witness
from twin.dynamics.diagram import Diagram, compute_diagram
from twin.dynamics.event_driven_map import make_period_map
from twin.dynamics.orbits import Orbit, find_orbit, motion_size, reduce_period
from twin.dynamics.period_map import PeriodMap
from twin.laws.library import find_effect
from twin.model.model import EffectInstance, Model
from twin.model.parameters import Parameters

MAX_PERIODS = 8
MAX_SETTLING = 1200  # periods
RELATIVE_DISTURBANCE = 1e-8  # of the size, from which a motion leaves or comes back
PENETRATION_TOL_M = 1e-7  # m: of sampled motion, whose drive is linear between samples
RETURN_TOL = 1e-3  # of the travel: error of the same sampled motion after an orbit
SAMPLES_PER_PERIOD = 2000
SETTLED_DISTANCE = 1e-9  # of the size: a motion that returns so close has settled


def is_admissible(orbit: Orbit) -> bool:
    """Check densely sampled motion: it returns, no mass inside a bumper, no bumper pulls."""
    parameters = orbit.period_map.model.parameters
    u, _, _, f_r, f_l, u_r, u_l = orbit.sample_motion(SAMPLES_PER_PERIOD * orbit.periods)
    clearance = min((parameters.gap_r + u_r - u).min(), (u - u_l + parameters.gap_l).min())
    tolerance = PENETRATION_TOL_M + RETURN_TOL * float(np.ptp(u))
    returns = abs(u[-1] - orbit.x[0]) < tolerance * max(1.0, abs(orbit.multipliers[0]))
    return bool(returns and clearance > -PENETRATION_TOL_M and f_r.min() >= 0 and f_l.max() <= 0)


@dataclass(frozen=True)
class RandomCase:
    """A model, its range of frequencies in Hz, and the level in m/s2."""

    model: Model
    limits: tuple[float, float]
    level: float
    effect: str


def draw_case(seed: int) -> RandomCase:
    """Masses 1 to 1e4 kg, 0.5 to 10 Hz, damping 1 to 20 %, bumpers 1 to 100 times as stiff.

    Gaps positive, zero, negative, unequal or on one side only; some bumpers without memory; every
    third model has an effect, of a size that shows.
    """
    random = np.random.default_rng(seed)
    mass, w = 10 ** random.uniform(0, 4), 2 * math.pi * 10 ** random.uniform(-0.3, 1)
    zeta, level = 10 ** random.uniform(-2, -0.7), 10 ** random.uniform(-0.5, 0.7)
    k, c = mass * w * w, 2 * zeta * mass * w
    size = level / (w * w * 2 * zeta)  # of free flight at resonance, m
    ratio = 10 ** random.uniform(0, 2, 2)
    if random.uniform() < 0.6:
        ratio[1] = ratio[0]
    relative_damping = 10 ** random.uniform(-2, -0.3) * np.ones(2)
    if random.uniform() < 0.3:
        relative_damping[:] = 0.0
    k_j = k * ratio
    c_j = 2 * relative_damping * np.sqrt(k_j * mass)
    gap = size * 10 ** random.uniform(-1.5, -0.2)
    kind = random.choice(["positive", "unequal", "zero", "negative", "mixed", "one side"])
    gaps = {
        "positive": (gap, gap),
        "unequal": (gap, gap * random.uniform(0.2, 0.9)),
        "zero": (0.0, 0.0),
        "negative": (-0.3 * gap, -0.3 * gap),
        "mixed": (-0.2 * gap, gap),
        "one side": (gap * random.choice([-0.3, 0.0, 1.0]), math.inf),
    }[kind]
    (right, left), (c_r, c_l) = k_j.tolist(), c_j.tolist()
    model = Model(Parameters(mass, k, c, right, c_r, left, c_l, *map(float, gaps)))
    f = w / (2 * math.pi)
    effect = ""
    if seed % 3 == 0:
        model, effect = add_effect(model, level, min(size, 3 * gap), w, random)
    return RandomCase(model, (0.5 * f, min(3.0, 1.5 * math.sqrt(1 + ratio[0])) * f), level, effect)


def add_effect(
    model: Model, level: float, size: float, w: float, random: np.random.Generator
) -> tuple[Model, str]:
    """Return the model with one effect, scaled to a motion of `size` m, and its name."""
    p, force = model.base, model.base.mass * level
    effects = {
        "coulomb_friction": {"fc": 0.15 * force},
        "bouc_wen": {"force": 0.2 * force, "yield_displacement": 0.1 * size},
        "cubic_stiffness": {"k3": 0.3 * p.stiffness / size**2},
        "quadratic_damping": {"c2": 0.3 * p.damping / (w * size)},
        "maxwell_damper": {"k1": 0.3 * p.stiffness, "tau": 1 / w},
        "bumper_hardening": {"k2": 0.5 * p.bumper_stiffness_r / size},
        "hunt_crossley": {"ch": 0.3 * p.mass * w / size},
        "bumper_maxwell": {"kb": 0.3 * p.bumper_stiffness_r, "tau": 0.1 / w},
        "table_tilt": {"tilt": 0.1 * w * w / 9.81},
        "zener_damper": {"k1": 0.3 * p.stiffness, "tau": 0.5 / w},
        "slip_damper": {"force": 0.2 * force, "yield_displacement": 0.1 * size},
    }
    name = str(random.choice(list(effects)))
    own = {"zener_damper": ZENER_DAMPER, "slip_damper": SLIP_DAMPER}.get(name)
    effect = own or find_effect(name)
    bounds = {q.name: (q.low, q.high) for q in effect.parameters}
    values = {n: float(np.clip(v, *bounds[n])) for n, v in effects[name].items()}
    return Model(p, (EffectInstance.create(effect, values),)), name


def settle_start(period_map: PeriodMap, x: np.ndarray) -> Orbit | None:
    """The periodic orbit in which a start ends after at most `MAX_SETTLING` periods, or None."""
    scales = period_map.scales
    for _ in range(MAX_SETTLING // 48):
        x = period_map.iterate(x, 40)
        first, size = x, motion_size(x, scales)
        for periods in range(1, MAX_PERIODS + 1):
            x = period_map.iterate(x, 1)
            size = max(size, motion_size(x, scales), 1e-15)
            if motion_size(x - first, scales) < SETTLED_DISTANCE * size:
                orbit = find_orbit(period_map, x, periods)
                if orbit is not None and motion_size(orbit.x - x, scales) < 1e-5 * size:
                    return reduce_period(orbit)
                unknown = np.zeros((x.size, x.size)), np.full(x.size, np.nan + 0j)
                return Orbit(period_map, periods, x, *unknown, (0,))
    return None


@dataclass
class Findings:
    """Counts of one model; `missed` as (frequency, periods, multiplier)."""

    settled: int = 0
    irregular: int = 0
    missed: list[tuple[float, int, float]] = field(default_factory=list)
    checked: int = 0
    false: list[str] = field(default_factory=list)
    simulated: int = 0
    independent: int = 0


def find_missed(case: RandomCase, diagram: Diagram, starts: int, seed: int, findings: Findings):
    """Settle random starts at random frequencies; the orbits must lie on the diagram."""
    random = np.random.default_rng(seed)
    p = case.model.parameters
    w = math.sqrt(p.stiffness / p.mass)
    speed = case.level * p.mass / p.damping
    for _ in range(starts):
        frequency_hz = random.uniform(*case.limits)
        period_map = make_period_map(case.model, frequency_hz, case.level)
        x = period_map.rest()
        spread = 10 ** random.uniform(-2, 0.3)
        x[:2] += spread * speed * random.normal(size=2) * (1 / w, 1.0)
        orbit = settle_start(period_map, x)
        if orbit is None:
            findings.irregular += 1
            continue
        findings.settled += 1
        if not any(branch.contains(orbit) for branch in diagram.branches):
            findings.missed.append((frequency_hz, orbit.periods, float(abs(orbit.multipliers[0]))))


def check_orbits(diagram: Diagram, count: int, independent: int, seed: int, findings: Findings):
    """Check orbits of the diagram: admissible, stable or not as long motions say, and by scipy."""
    random = np.random.default_rng(seed)
    orbits = [
        point.orbit
        for branch in diagram.branches
        for point in branch.points[1:-1]  # a branch begins and ends at bifurcations of others
        # The Jacobian of a grazing orbit is one-sided, other bifurcations are marginal.
        if not any(point.orbit is b.orbit for b in branch.bifurcations)
    ]
    if not orbits:
        return
    for orbit in random.choice(np.array(orbits, dtype=object), count):
        findings.checked += 1
        if not is_admissible(orbit):
            findings.false.append(f"inadmissible at {orbit.frequency_hz:.6f}")
        problem = contradicts_simulation(orbit)
        findings.simulated += 1
        if problem:
            findings.false.append(f"{problem} at {orbit.frequency_hz:.6f}, {orbit.periods}")
    known = {"coulomb_friction", "bouc_wen", "cubic_stiffness", "quadratic_damping",
             "maxwell_damper", "bumper_hardening", "hunt_crossley", "bumper_maxwell"}  # fmt: skip
    effects = {instance.effect.id for instance in diagram.period_map.model.present_effects}
    if not effects <= known:
        return
    short = [orbit for orbit in orbits if orbit.periods <= 2]
    for orbit in random.choice(np.array(short, dtype=object), independent):
        findings.independent += 1
        error = independent_return_error(orbit)
        if not error < 1e-4:
            findings.false.append(f"scipy returns to {error:.1e} at {orbit.frequency_hz:.6f}")


def contradicts_simulation(orbit: Orbit) -> str:
    """What a long motion from a disturbed orbit shows against its multipliers, "" if nothing."""
    largest = abs(orbit.multipliers[0])
    if 0.98 < largest < 1.02:
        return ""  # too slow to tell
    period_map, n = orbit.period_map, orbit.periods
    size = motion_size(orbit.x, period_map.scales)
    x = orbit.x.copy()
    x[0] += RELATIVE_DISTURBANCE * size
    x[1] += 0.7 * RELATIVE_DISTURBANCE * size * period_map.scales[1]
    times = math.ceil(min(14 / abs(math.log(max(largest, 1e-6))), 400))
    distance = 0.0
    for _ in range(times):
        x = period_map.iterate(x, n)
        distance = motion_size(x - orbit.x, period_map.scales) / size
        if largest > 1 and distance > 100 * RELATIVE_DISTURBANCE:
            return ""
    if largest > 1:
        return f"multiplier {largest:.3f}, but it stays"
    if distance < RELATIVE_DISTURBANCE:
        return ""
    return f"multiplier {largest:.3f}, but it leaves to {distance:.1e}"


def independent_return_error(orbit: Orbit) -> float:
    """Relative distance from its start, after its periods, of scipy's motion from an orbit."""
    model = orbit.period_map.model
    w = 2 * math.pi * orbit.frequency_hz
    base = model.base
    u, v = orbit.x[:2]
    out = orbit.sample_motion(orbit.periods * 100)
    size = max(np.abs(out[0]).max(), 1e-12)
    if base.gap_r == base.gap_l == 0 and not base.bumper_damping_r:
        # Both guards would be zero at once, and scipy would not see the second one.
        model = Model(replace(base, gap_r=1e-5 * size, gap_l=1e-5 * size), model.effects)
    witness = Witness(model, lambda t: orbit.acceleration_m_s2 * math.sin(w * t))
    witness.contact = [bool(out[3, -1] > 0), bool(out[4, -1] < 0)]
    witness.way = (
        math.copysign(1.0, v) if v else (0.0 if witness.get("coulomb_friction", "fc") else 1.0)
    )
    start = np.zeros(8)
    start[0], start[1], start[2], start[3] = u, v, out[5, -1], -out[6, -1]
    names = hidden_coordinates(model)
    for row, value in zip(names, orbit.x[orbit.x.size - len(names) :], strict=True):
        start[row] = -value if row == 6 else value
    period = 2 * math.pi / w
    times = np.linspace(0, orbit.periods * period, 120 * orbit.periods + 1)
    end = witness.run(start, times, 1e-10)[:, -1]
    speed = max(np.abs(out[1]).max(), 1e-12)
    growth = max(1.0, abs(orbit.multipliers[0]))
    return max(abs(end[0] - u) / size, abs(end[1] - v) / speed) / growth


def hidden_coordinates(model: Model) -> list[int]:
    """Rows of `Witness` of the last coordinates: f, b_R, b_L, z."""
    effects, p = {i.effect.id for i in model.present_effects}, model.parameters
    rows = [4] if "maxwell_damper" in effects else []
    if "bumper_maxwell" in effects:
        rows += [5 + side for side, gap in enumerate((p.gap_r, p.gap_l)) if math.isfinite(gap)]
    return rows + ([7] if "bouc_wen" in effects else [])


def study_case(seed: int, starts: int, values: int, draws: int, orbits: int = 12) -> tuple:
    """(case, diagram, findings) of one model."""
    case, findings = draw_case(seed), Findings()
    diagram = compute_diagram(
        case.model, case.limits, case.level, values=values, starts=draws, seed=seed
    )
    find_missed(case, diagram, starts, seed + 1_000_000, findings)
    check_orbits(diagram, orbits, 2, seed + 2_000_000, findings)
    return case, diagram, findings
