"""What the model does, in numbers: folds, grazes, resonances, impacts, chaos, permanent contact."""

import math
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import brentq, minimize_scalar

from table_io.block import Float1D
from twin.model.branch import between, follow, settled
from twin.model.exact import rest
from twin.model.orbit import Orbit, lyapunov, onsets
from twin.model.parameters import Parameters, resonance
from twin.model.sweep import stepped_sine
from twin.service.paper.cases import Case

FINE_HZ, FINE_CYCLES = 0.01, 40  # of the slow sweep that stands for continuous frequency
BRANCH_HZ = 0.02  # first step of a continuation
SAME = 0.02  # of eta_d: the two directions of the slow sweep are one curve within this
TRANSIENT, WATCHED = 300, 3000  # cycles, in chaos


@dataclass(frozen=True, slots=True, eq=False)
class Slow:
    """Slow passage through all frequencies: eta_d and the state after each, in both directions."""

    frequency: Float1D
    eta_d: dict[str, Float1D]
    eta_a: dict[str, Float1D]
    states: dict[str, Float1D]

    @property
    def peak(self) -> tuple[int, str]:
        """(place, direction) of the primary resonance, the largest eta_d."""
        best = max(self.eta_d, key=lambda one: float(self.eta_d[one].max()))
        return int(self.eta_d[best].argmax()), best

    @property
    def peak_hz(self) -> float:
        return float(self.frequency[self.peak[0]])

    @property
    def difference(self) -> float:
        """Largest difference between the directions above 2 Hz, relative to eta_d there."""
        one, other = self.eta_d["forward"], self.eta_d["backward"]
        high = self.frequency > 2
        return float((np.abs(one - other) / np.maximum(one, other))[high].max())

    def state(self, frequency_hz: float, direction: str) -> Float1D:
        place = int(np.abs(self.frequency - frequency_hz).argmin())
        return np.asarray(self.states[direction][place])


def slow(case: Case) -> Slow:
    """The slow sweep of a gap over the range of its tests."""
    p, a = case.parameters, case.acceleration
    grid = [step.frequency_hz for test in case.tests for step in test.steps]
    count = round((max(grid) - min(grid)) / FINE_HZ) + 1
    up = np.linspace(min(grid), max(grid), count)
    u_star, a_star, _ = resonance(p, a)
    eta_d, eta_a, states = {}, {}, {}
    state = rest(p)
    for direction, way in (("forward", 1), ("backward", -1)):
        sweep = stepped_sine(p, up[::way], a, FINE_CYCLES, state=state)
        state = sweep.states[-1]
        last = {name: sweep.column(name)[:, -1] for name in ("u_max", "u_min", "a_max", "a_min")}
        eta_d[direction] = ((last["u_max"] - last["u_min"]) / (2 * u_star))[::way]
        eta_a[direction] = ((last["a_max"] - last["a_min"]) / (2 * a_star))[::way]
        states[direction] = sweep.states[::way]
    return Slow(up, eta_d, eta_a, states)


@dataclass(frozen=True, slots=True)
class Folds:
    """Where the two branches of a hysteresis end, in Hz: the forward one above, the other below."""

    forward_hz: float
    backward_hz: float
    kind: str  # "right": the forward branch is the larger one


def folds(case: Case, sweep: Slow) -> Folds | None:
    """The folds of the primary hysteresis, by continuation; None where there is none.

    Each branch is followed from outside the interval, where it is the only motion.
    """
    p, a = case.parameters, case.acceleration
    eta = sweep.eta_d
    apart = np.abs(eta["forward"] - eta["backward"]) > SAME * np.maximum(*eta.values())
    apart &= sweep.frequency > _chaos_ends(case)
    if not apart.any():
        return None
    low, high = max(bands(sweep.frequency, apart.astype(float)), key=lambda one: one[1] - one[0])
    low_hz, high_hz = low - 5 * FINE_HZ, high + 5 * FINE_HZ
    up = settled(p, low_hz, a, sweep.state(low_hz, "forward"))
    down = settled(p, high_hz, a, sweep.state(high_hz, "backward"))
    if up is None or down is None:
        return None
    top = follow(p, a, up, high_hz + 0.5, BRANCH_HZ).end_hz
    bottom = follow(p, a, down, low_hz - 0.5, BRANCH_HZ).end_hz
    if top is None or bottom is None:
        return None
    middle = int(np.abs(sweep.frequency - (low + high) / 2).argmin())
    larger = eta["forward"][middle] > eta["backward"][middle]
    return Folds(float(top), float(bottom), "right" if larger else "left")


def _chaos_ends(case: Case) -> float:
    """Frequency in Hz above which the two directions can differ only by hysteresis."""
    return 1.42 if case.parameters.gap_r > 0 else 2.0


def graze_hz(case: Case) -> float:
    """Where the flight motion first touches a bumper, from above: a/|w0^2 - w^2 + 2 i z w0 w|."""
    p, a = case.parameters, case.acceleration

    def short_of(hz: float) -> float:
        w = 2 * math.pi * hz
        return a / abs(p.stiffness / p.mass - w * w + 1j * w * p.damping / p.mass) - p.gap_r

    return float(brentq(short_of, resonance(p, a)[2], 20.0))


def coexisting(case: Case, sweep: Slow, frequency_hz: float) -> tuple[Orbit, Orbit, Orbit] | None:
    """(forward, backward, the unstable one between them) inside a hysteresis."""
    p, a = case.parameters, case.acceleration
    up = settled(p, frequency_hz, a, sweep.state(frequency_hz, "forward"))
    down = settled(p, frequency_hz, a, sweep.state(frequency_hz, "backward"))
    if up is None or down is None or abs(up.u_max - down.u_max) < SAME * up.u_max:
        return None
    unstable = between(p, a, up, down)
    return None if unstable is None else (up, down, unstable)


def permanent_contact_mm(case: Case) -> float:
    """Total gap below which the mass never leaves a bumper, at any frequency; negative.

    Both in contact the motion U is linear; a bumper is left where (K_j + i w C_j) U reaches K_j p.
    """
    p, a = case.parameters, case.acceleration
    kj, cj = p.bumper_stiffness_r, p.bumper_damping_r

    def release(hz: float) -> float:
        w = 2 * math.pi * hz
        k, c = p.stiffness + 2 * kj, p.damping + 2 * cj
        return -abs(kj + 1j * w * cj) * p.mass * a / abs(k - p.mass * w * w + 1j * w * c) / kj

    found = minimize_scalar(release, bounds=(1.0, 20.0), method="bounded", options={"xatol": 1e-9})
    return float(2e3 * found.fun)


def detaches(case: Case, gap_mm: float) -> bool:
    """Whether a slow sweep at this total gap sees the mass leave a bumper."""
    p = replace(case.parameters, gap_r=gap_mm / 2e3, gap_l=gap_mm / 2e3)
    swept = stepped_sine(p, np.arange(600, 801) / 100, case.acceleration, 20)
    return bool(swept.column("onsets_r").sum() + swept.column("onsets_l").sum())


@dataclass(frozen=True, slots=True)
class Impacts:
    """Share of cycles by (impacts right, impacts left), most frequent first."""

    shares: tuple[tuple[tuple[int, int], float], ...]

    def share(self, *pairs: tuple[int, int]) -> float:
        return sum(share for pair, share in self.shares if pair in pairs)

    def at_least(self, count: int) -> float:
        """Share of cycles in which a side is hit that often or more."""
        return sum(share for pair, share in self.shares if max(pair) >= count)

    @property
    def usual(self) -> tuple[int, int]:
        return self.shares[0][0]


def impacts(parameters: Parameters, frequency_hz: float, acceleration: float) -> Impacts:
    """Impacts per forcing cycle and side as a distribution, from rest, transient left out."""
    settled_ = stepped_sine(parameters, [frequency_hz], acceleration, TRANSIENT).states[0]
    right, left, _ = onsets(parameters, frequency_hz, acceleration, settled_, WATCHED)
    pairs = zip(per_cycle(right, WATCHED), per_cycle(left, WATCHED), strict=True)
    counted = Counter((int(r), int(l_)) for r, l_ in pairs)
    total = sum(counted.values())
    return Impacts(tuple((pair, n / total) for pair, n in counted.most_common()))


def per_cycle(times: Float1D, cycles: int) -> Float1D:
    """Onsets in each cycle but the last, cut where onsets are rarest, so that no group is torn."""
    phases = np.sort(times % 1.0)
    if not phases.size:
        return np.zeros(cycles - 1)
    counts, edges = np.histogram(phases, bins=50, range=(0.0, 1.0))
    doubled = np.concatenate([counts, counts])
    sparse = [doubled[k : k + 5].sum() for k in range(50)]
    cut = edges[(int(np.argmin(sparse)) + 2) % 50]
    return np.histogram(times, bins=cut + np.arange(cycles))[0].astype(float)


def exponent(case: Case, frequency_hz: float, cycles: int = WATCHED) -> float:
    """Largest Lyapunov exponent per cycle, from rest, transient left out."""
    p, a = case.parameters, case.acceleration
    state = stepped_sine(p, [frequency_hz], a, TRANSIENT).states[0]
    return lyapunov(p, frequency_hz, a, state, cycles)[0]


def bands(frequency: Float1D, exponents: Float1D, chaotic: float = 0.05) -> list[list[float]]:
    """[from, to] in Hz of neighbouring grid frequencies whose exponent is above `chaotic`."""
    found: list[list[float]] = []
    for place in np.flatnonzero(exponents > chaotic):
        f = float(frequency[place])
        if found and place and found[-1][1] == float(frequency[place - 1]):
            found[-1][1] = f
        else:
            found.append([f, f])
    return found


def twice_a_side_mm(case: Case, frequency_hz: float) -> float:
    """Largest total gap in mm, on 0.05 mm, at which a forward sweep arrives at 2/2 impacts."""
    up = np.linspace(frequency_hz - 0.2, frequency_hz, 21)
    for gap_mm in np.arange(4.0, 0.0, -0.05):
        p = replace(case.parameters, gap_r=gap_mm / 2e3, gap_l=gap_mm / 2e3)
        state = stepped_sine(p, up, case.acceleration, 60).states[-1]
        right, left, _ = onsets(p, frequency_hz, case.acceleration, state, 200)
        if min(per_cycle(right, 200).min(), per_cycle(left, 200).min()) >= 2:
            return round(float(gap_mm), 2)
    return math.nan
