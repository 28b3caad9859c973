"""What the model does, in numbers: folds, grazes, resonances, impacts, chaos, permanent contact."""

import math
from collections import Counter
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq, minimize_scalar

from table_io.block import Float1D
from twin.model.branch import between, follow, settled
from twin.model.orbit import Orbit
from twin.model.parameters import resonance
from twin.service.paper.cases import Case
from twin.service.paper.passage import CLOSE, SAME, Slow, effort

DEEPEST_MM, NEAR_MM = -40.0, 0.005  # of the search for permanent contact
BRANCH_HZ = 0.02  # first step of a continuation
SETTLE = 400  # cycles to a steady motion


@dataclass(frozen=True, slots=True)
class Folds:
    """Where the two branches of a hysteresis end, in Hz: the forward one above, the other below.

    `how` they were found: "folds", or "slow passage", which is a little later.
    """

    forward_hz: float
    backward_hz: float
    kind: str  # "right": the forward branch is the larger one
    how: str = "folds"


def folds(case: Case, sweep: Slow) -> Folds | None:
    """The folds of the primary hysteresis, by continuation; None where there is none.

    Each branch is followed from outside the interval, where it is the only motion. A model that
    has no one-period map in closed form is taken at its word in slow passage.
    """
    eta, f = sweep.eta_d, sweep.frequency
    apart = np.abs(eta["forward"] - eta["backward"]) > SAME * np.maximum(*eta.values())
    apart &= f > _chaos_ends(case)
    if not apart.any():
        return None
    low, high = max(bands(f, apart.astype(float)), key=lambda one: one[1] - one[0])
    middle = int(np.abs(f - (low + high) / 2).argmin())
    kind = "right" if eta["forward"][middle] > eta["backward"][middle] else "left"
    if not case.player.exact:
        wide = high - low > 2 * effort(case).fine_hz
        return Folds(high, low, kind, "slow passage") if wide else None
    p, a = case.parameters, case.acceleration
    low_hz, high_hz = low - 5 * CLOSE.fine_hz, high + 5 * CLOSE.fine_hz
    up = settled(p, low_hz, a, sweep.state(low_hz, "forward"))
    down = settled(p, high_hz, a, sweep.state(high_hz, "backward"))
    if up is None or down is None:
        return None
    top = follow(p, a, up, high_hz + 0.5, BRANCH_HZ).end_hz
    bottom = follow(p, a, down, low_hz - 0.5, BRANCH_HZ).end_hz
    return None if top is None or bottom is None else Folds(float(top), float(bottom), kind)


def _chaos_ends(case: Case) -> float:
    """Frequency in Hz above which the two directions can differ only by hysteresis."""
    return 1.42 if case.parameters.gap_r > 0 else 2.0


def graze_hz(case: Case, sweep: Slow) -> float:
    """Where the flight motion first touches a bumper, from above: a/|w0^2 - w^2 + 2 i z w0 w|,
    where flight is linear; else where slow passage down does."""
    p, a = case.parameters, case.acceleration
    if not case.player.exact:
        hit = sweep.frequency[sweep.touched["backward"]]
        return float(hit.max()) if hit.size else math.nan

    def short_of(hz: float) -> float:
        w = 2 * math.pi * hz
        flight = a / abs(p.stiffness / p.mass - w * w + 1j * w * p.damping / p.mass)
        return flight - min(p.gap_r, p.gap_l)

    return float(brentq(short_of, resonance(p, a)[2], 20.0))


@dataclass(frozen=True, slots=True, eq=False)
class Coexisting:
    """Largest u in m of the forward and the backward motion, and the unstable one between them.

    None: it can be found only where the one-period map is known in closed form.
    """

    forward_m: float
    backward_m: float
    unstable: Orbit | None


def coexisting(case: Case, sweep: Slow, frequency_hz: float) -> Coexisting | None:
    """The two motions inside a hysteresis; None where both directions lead to one."""
    p, a = case.parameters, case.acceleration
    begin = {one: sweep.state(frequency_hz, one) for one in ("forward", "backward")}
    if not case.player.exact:
        top, bottom = (steady_m(case, sweep, frequency_hz, one) for one in begin)
        return None if abs(top - bottom) < SAME * top else Coexisting(top, bottom, None)
    up = settled(p, frequency_hz, a, begin["forward"])
    down = settled(p, frequency_hz, a, begin["backward"])
    if up is None or down is None or abs(up.u_max - down.u_max) < SAME * up.u_max:
        return None
    unstable = between(p, a, up, down)
    return None if unstable is None else Coexisting(up.u_max, down.u_max, unstable)


def steady_m(case: Case, sweep: Slow, frequency_hz: float, direction: str) -> float:
    """Largest u in m of the steady motion that one direction leads to."""
    begin = sweep.state(frequency_hz, direction)
    steady = case.player.sweep([frequency_hz], case.acceleration, SETTLE, begin)
    return float(steady.column("u_max")[0, -1])


def permanent_contact_mm(case: Case) -> float:
    """Total gap below which the mass never leaves a bumper, at any frequency; negative.

    Both in contact the motion U is linear; a bumper is left where (K_j + i w C_j) U reaches K_j p.
    Where it is not, or the sides differ, by halving; NaN beyond `DEEPEST_MM`.
    """
    p, a = case.parameters, case.acceleration
    kj, cj = p.bumper_stiffness_r, p.bumper_damping_r
    alike = (kj, cj, p.gap_r) == (p.bumper_stiffness_l, p.bumper_damping_l, p.gap_l)
    if not (case.player.exact and alike):
        return _halved(case)

    def release(hz: float) -> float:
        w = 2 * math.pi * hz
        k, c = p.stiffness + 2 * kj, p.damping + 2 * cj
        return -abs(kj + 1j * w * cj) * p.mass * a / abs(k - p.mass * w * w + 1j * w * c) / kj

    found = minimize_scalar(release, bounds=(1.0, 20.0), method="bounded", options={"xatol": 1e-9})
    return float(2e3 * found.fun)


def _halved(case: Case) -> float:
    left, held = 0.0, DEEPEST_MM
    if detaches(case, held) or not detaches(case, left):
        return math.nan
    while left - held > NEAR_MM:
        half = (left + held) / 2
        left, held = (half, held) if detaches(case, half) else (left, half)
    return held


def detaches(case: Case, gap_mm: float) -> bool:
    """Whether a slow sweep at this total gap sees the mass leave a bumper."""
    exact = case.player.exact
    grid = np.arange(600, 801) / 100 if exact else np.arange(80, 241) / 20
    if exact:  # round the resonance with both bumpers in contact
        p = case.parameters
        stiffness = p.stiffness + p.bumper_stiffness_r + p.bumper_stiffness_l
        grid += math.sqrt(stiffness / p.mass) / (2 * math.pi) - 6.95
    swept = case.player.at_gap(gap_mm).sweep(grid, case.acceleration, 20)
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


def impacts(case: Case, frequency_hz: float) -> Impacts:
    """Impacts per forcing cycle and side as a distribution, from rest, transient left out."""
    taken, a = effort(case), case.acceleration
    begin = case.player.sweep([frequency_hz], a, taken.transient).states[0]
    right, left, _ = case.player.onsets(frequency_hz, a, begin, taken.watched)
    pairs = zip(per_cycle(right, taken.watched), per_cycle(left, taken.watched), strict=True)
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


def exponent(case: Case, frequency_hz: float, cycles: int | None = None) -> float:
    """Largest Lyapunov exponent per cycle, from rest, transient left out."""
    taken, a = effort(case), case.acceleration
    state = case.player.sweep([frequency_hz], a, taken.transient).states[0]
    followed = min(cycles or taken.followed, taken.followed)
    return case.player.exponent(frequency_hz, a, state, followed)


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
    """Largest total gap in mm, on a grid, at which a forward sweep arrives at 2/2 impacts."""
    up, a = np.linspace(frequency_hz - 0.2, frequency_hz, 21), case.acceleration
    for gap_mm in np.arange(4.0, 0.0, -effort(case).gap_mm).tolist():
        there = case.player.at_gap(gap_mm)
        state = there.sweep(up, a, 60).states[-1]
        right, left, _ = there.onsets(frequency_hz, a, state, 200)
        if min(per_cycle(right, 200).min(), per_cycle(left, 200).min()) >= 2:
            return round(gap_mm, 2)
    return math.nan
