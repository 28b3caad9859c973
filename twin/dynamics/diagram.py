"""Complete bifurcation diagram of a model over frequency, level, gap or any parameter.

Many starts at many values of the parameter settle to attractors. Each periodic one that lies on no
known branch is continued both ways, through folds. Branches that leave at period doublings and
pitchforks are followed too where the orbit loses or gains its stability there, not the unstable
orbits within chaos; so are mirror images of asymmetric orbits of a symmetric model. Where starts
settle to no orbit of up to `MAX_PERIODS` periods, the Lyapunov exponent tells chaos.

Then random starts at random values, between the others too, until `values * starts //
CONFIRMING_SHARE` in a row settle to known orbits.

What it cannot know: a stable orbit that less than one start in as many reaches, in a narrow window
of the parameter or a small basin, unless a branch connects it to what is known.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from table_io.block import Float1D
from table_io.errors import InputError
from twin.dynamics.bifurcations import Bifurcation
from twin.dynamics.continuation import Branch, BranchEnd, continue_branch, switch_branch
from twin.dynamics.event_driven_map import make_period_map
from twin.dynamics.orbits import (
    SAME_ORBIT,
    Orbit,
    find_attracting_orbit,
    find_orbit,
    motion_size,
    reduce_period,
)
from twin.dynamics.period_map import FREQUENCY, LEVEL, PeriodMap
from twin.model.model import Model

MAX_PERIODS = 8  # of the orbits that are sought
VALUES, STARTS = 121, 8  # of the parameter, and new starts at each of them
SETTLING_CHUNK, MAX_SETTLING = 24, 480  # periods between two looks at a motion, and in all
RETURN_TOL = 1e-3  # of the size: a motion that returns so close is refined by Newton's method
LYAPUNOV_PERIODS = 300
MIN_EXPONENT = 0.02  # per period: a smaller exponent is not told from zero
MAX_BRANCH_POINTS = 1200  # divided by the periods of its orbits: long orbits are costly
MAX_SWITCHES = 96  # of branches; there is no end to period doublings near chaos
FINER_VALUES = 4  # values in place of one where the motion is not periodic
CONFIRMING_SHARE = 3  # starts per confirming start
MAX_CONFIRMATION = 10  # confirming starts in all, as a multiple of those in a row


@dataclass(frozen=True, slots=True)
class ChaoticBand:
    """Values of the parameter at which starts settle to chaos; `exponent` per period, largest.

    Its limits lie between two values that were tried, `resolution` apart.
    """

    low: float
    high: float
    exponent: float
    resolution: float


@dataclass(frozen=True, eq=False)
class Diagram:
    """All branches of a model that were found, over `limits` of a parameter, and chaotic bands.

    `irregular`: values at which a start settled neither to an orbit of up to `MAX_PERIODS` periods
    nor to chaos: a longer period, or quasi-periodic motion. `isolas` are the branches that close
    and that no bifurcation connects to another. `unfollowed`: bifurcations beyond `MAX_SWITCHES`,
    whose branches were not followed.
    """

    period_map: PeriodMap
    parameter: str
    limits: tuple[float, float]
    branches: tuple[Branch, ...]
    chaotic_bands: tuple[ChaoticBand, ...]
    irregular: tuple[float, ...]
    isolas: tuple[Branch, ...]
    unfollowed: tuple[Bifurcation, ...]

    def orbits_at(self, value: float) -> list[Orbit]:
        """Return the distinct orbits at a value of the parameter, one of each set of phases."""
        orbits: list[Orbit] = []
        for branch in self.branches:
            for orbit in branch.orbits_at(value):
                if not any(map(orbit.is_same, orbits)):
                    orbits.append(orbit)
        return orbits


def compute_diagram(
    model: Model,
    limits: tuple[float, float],
    acceleration_m_s2: float,
    *,
    parameter: str = FREQUENCY,
    frequency_hz: float = math.nan,
    values: int = VALUES,
    starts: int = STARTS,
    seed: int = 0,
) -> Diagram:
    """Compute the bifurcation diagram over `limits` of a parameter, at a level in m/s2.

    parameter: "frequency" in Hz, or "level", "gap" (total, m) or a name of `Model.flatten` at
    `frequency_hz`. `values` are spread evenly, those of a frequency in its logarithm; `seed` draws
    the starts. InputError names a range or frequency that cannot be used.
    """
    _validate(limits, acceleration_m_s2, parameter, frequency_hz, values)
    frequency = limits[0] if parameter == FREQUENCY else frequency_hz
    level = limits[0] if parameter == LEVEL else acceleration_m_s2
    period_map = make_period_map(model, frequency, level)
    search = _Search(period_map, parameter, limits, starts, seed)
    search.run(values)
    return Diagram(
        search.period_map, parameter, limits, tuple(search.branches), search.find_bands(),
        tuple(sorted(search.irregular)), tuple(search.isolas), tuple(search.unfollowed),
    )  # fmt: skip


def _validate(
    limits: tuple[float, float], level: float, parameter: str, frequency_hz: float, values: int
) -> None:
    low, high = limits
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise InputError(
            "not a range", key=parameter, value=f"{low:g} to {high:g}", allowed="low < high, finite"
        )
    if parameter in (FREQUENCY, LEVEL) and low <= 0:
        raise InputError("not a range", key=parameter, value=low, allowed="above 0")
    if parameter != FREQUENCY and not (math.isfinite(frequency_hz) and frequency_hz > 0):
        raise InputError(
            f"a diagram over {parameter} needs a drive frequency",
            key="frequency_hz",
            value=frequency_hz,
            allowed="above 0 Hz, finite",
        )
    if parameter != LEVEL and not (math.isfinite(level) and level > 0):
        raise InputError(
            "not a level", key="acceleration_m_s2", value=level, allowed="above 0 m/s2, finite"
        )
    if values < 2:
        raise InputError("too few values", key="values", value=values, allowed="2 or more")


class _Search:
    """Branches found so far, and what is known at the values that were tried."""

    def __init__(
        self,
        period_map: PeriodMap,
        parameter: str,
        limits: tuple[float, float],
        starts: int,
        seed: int,
    ) -> None:
        self.period_map, self._parameter, self._limits = period_map, parameter, limits
        period_map.parameter(parameter)  # refuses an unknown one
        self._starts, self._random = starts, np.random.default_rng(seed)
        self.branches: list[Branch] = []
        self._switched: list[Orbit] = []  # at bifurcations whose branches have been followed
        self._switches = 0
        self.unfollowed: list[Bifurcation] = []
        self.isolas: list[Branch] = []
        self.irregular: set[float] = set()
        self._exponents: dict[float, float] = {}  # largest at each value, 0 without chaos

    def run(self, values: int) -> None:
        """Try starts at all values, upwards and downwards, then more where it is irregular."""
        # Secondary resonances become narrow, and dense, in proportion to the frequency.
        spread = np.geomspace if self._parameter == FREQUENCY else np.linspace
        grid = spread(*self._limits, values)
        grid[0], grid[-1] = self._limits
        self._sweep(grid, self._starts)
        self._sweep(grid[::-1], 0)
        rough = [v for v in grid if self._exponents[v] > 0 or v in self.irregular]
        fine: set[float] = set()
        for value in rough:
            step = value * (grid[1] / grid[0] - 1) if spread is np.geomspace else grid[1] - grid[0]
            fine |= {value + step * k / FINER_VALUES for k in range(1 - FINER_VALUES, FINER_VALUES)}
        own = sorted(v for v in fine if self._limits[0] < v < self._limits[1])
        self._sweep([v for v in own if v not in self._exponents], max(2, self._starts // 2))
        self._confirm(values * self._starts // CONFIRMING_SHARE)

    def _confirm(self, starts_in_a_row: int) -> None:
        """Try random starts at random values until so many in a row settle to known orbits.

        Starts that settle to no orbit do not count.
        """
        is_logarithmic = self._parameter == FREQUENCY
        limits = np.log(self._limits) if is_logarithmic else self._limits
        confirmed = 0
        for _ in range(MAX_CONFIRMATION * starts_in_a_row):
            drawn = self._random.uniform(*limits)
            value = float(np.exp(drawn) if is_logarithmic else drawn)
            period_map = self.period_map.with_parameter(self._parameter, value)
            motion = settle(period_map, draw_start(period_map, self._random))
            if motion.orbit is not None:
                confirmed = 0 if self.add_orbit(motion.orbit) else confirmed + 1
            elif motion.is_chaotic:
                self._exponents[value] = motion.exponent
            elif math.isfinite(motion.x[0]):
                self.irregular.add(value)
            if confirmed >= starts_in_a_row:
                return

    def _sweep(self, values: Sequence[float] | Float1D, starts: int) -> None:
        """Settle the last motions and new starts at each value in turn."""
        carried: list[Float1D] = []
        for value in values:
            period_map = self.period_map.with_parameter(self._parameter, float(value))
            new = [draw_start(period_map, self._random) for _ in range(starts)]
            ends: list[Float1D] = []
            orbits: list[Orbit] = []
            exponent = self._exponents.get(value, 0.0)
            for x in [*carried, *([period_map.rest()] if starts else []), *new]:
                motion = settle(period_map, x, known=orbits)
                if motion.orbit is not None:
                    if motion.orbit not in orbits:
                        orbits.append(motion.orbit)
                        self.add_orbit(motion.orbit)
                elif motion.is_chaotic:
                    exponent = max(exponent, motion.exponent)
                elif math.isfinite(motion.x[0]):
                    self.irregular.add(value)
                if np.isfinite(motion.x).all() and not any(
                    motion_size(motion.x - end, period_map.scales)
                    < 0.1 * motion_size(end, period_map.scales)
                    for end in ends
                ):
                    ends.append(motion.x)
            self._exponents[value] = exponent
            carried = ends[:MAX_PERIODS]

    def add_orbit(self, orbit: Orbit) -> bool:
        """Continue an orbit that lies on no known branch, and all that leaves its branch.

        Return whether it was such an orbit.
        """
        if any(branch.contains(orbit) for branch in self.branches):
            return False
        branch = cut_repetition(
            continue_branch(
                orbit, self._parameter, self._limits, max_points=MAX_BRANCH_POINTS // orbit.periods
            )
        )
        self._add_branch(branch)
        if branch.ends[1].reason == "closed loop" and not branch.of_kind(
            "period doubling", "pitchfork"
        ):
            self.isolas.append(branch)
        mirrored = mirror_orbit(orbit)
        if mirrored is not None:
            self.add_orbit(mirrored)
        return True

    def _add_branch(self, branch: Branch) -> None:
        """Add a branch and, nearest first, what leaves it, up to `MAX_SWITCHES` in all."""
        self.branches.append(branch)
        waiting = [branch]
        while waiting:
            for bifurcation in self._find_origins(waiting.pop(0)):
                # A period later, the other side of a period doubling is the same branch; it is
                # followed all the same, in case this one turns back at a grazing orbit too early.
                for side in (1, -1):
                    if self._switches >= MAX_SWITCHES:
                        self.unfollowed.append(bifurcation)
                        break
                    self._switches += 1
                    leaving = self._leave(bifurcation, side)
                    if not is_covered(leaving, self.branches):
                        # It may go on where an earlier one has stopped.
                        self.branches = [b for b in self.branches if not is_covered(b, [leaving])]
                        self.branches.append(leaving)
                        waiting.append(leaving)

    def _leave(self, bifurcation: Bifurcation, side: int) -> Branch:
        """Return the branch that leaves at a bifurcation, without what it repeats.

        At a period doubling continuation may fall back on the branch of half the period: then the
        other side is tried, and what is not of the double period is left out.
        """
        for try_side in (side, -side):
            branch = switch_branch(
                bifurcation, self._parameter, self._limits, side=try_side,
                max_points=MAX_BRANCH_POINTS // bifurcation.orbit.periods,
            )  # fmt: skip
            if bifurcation.kind != "period doubling":
                break
            branch = cut_half_period(branch)
            if len(branch.points) > 3:
                break
        return cut_repetition(branch)

    def _find_origins(self, branch: Branch) -> Iterator[Bifurcation]:
        """Yield the bifurcations from which branches leave that have not been followed yet."""
        for bifurcation in branch.of_kind("period doubling", "pitchfork"):
            orbit = bifurcation.orbit
            if bifurcation.kind == "period doubling" and 2 * orbit.periods > MAX_PERIODS:
                continue
            if abs(orbit.multipliers[1]) > 1:
                continue  # unstable on both sides: orbits of chaos
            if reduce_period(orbit) is not orbit:
                continue  # the branch from which this one has left
            if any(are_at_same_place(orbit, other, self._parameter) for other in self._switched):
                continue
            self._switched.append(orbit)
            yield bifurcation

    def find_bands(self) -> tuple[ChaoticBand, ...]:
        """Return the runs of neighboring values with chaos."""
        bands, run = [], list[float]()
        values = sorted(self._exponents)
        for _i, value in enumerate([*values, math.inf]):
            if math.isfinite(value) and self._exponents[value] > 0:
                run.append(value)
            elif run:
                first = values.index(run[0])
                before = values[first - 1] if first else run[0]
                after = value if math.isfinite(value) else run[-1]
                bands.append(
                    ChaoticBand(
                        run[0], run[-1], max(self._exponents[v] for v in run),
                        max(run[0] - before, after - run[-1]),
                    )
                )  # fmt: skip
                run = []
        return tuple(bands)


def is_covered(branch: Branch, others: Sequence[Branch]) -> bool:
    """Return whether other branches contain a branch, judged at three of its orbits."""
    count = len(branch.points)
    if count < 4:
        return True  # too short to tell from the branch that it leaves
    # Not at its ends, where branches meet.
    orbits = [branch.points[i].orbit for i in (count // 4, count // 2, 3 * count // 4)]
    return all(any(other.contains(orbit) for other in others) for orbit in orbits)


def cut_repetition(branch: Branch) -> Branch:
    """Return a branch up to the first bifurcation that it passes a second time: it runs in a loop.

    It may return to its start a whole number of periods late, which continuation does not notice.
    """
    passed: list[Bifurcation] = []
    for bifurcation in branch.bifurcations:
        if any(
            bifurcation.kind == other.kind
            and are_at_same_place(bifurcation.orbit, other.orbit, branch.parameter)
            for other in passed
        ):
            last = bifurcation.index
            return Branch(
                branch.parameter, branch.points[: last + 1], tuple(passed),
                (branch.ends[0], BranchEnd("closed loop", bifurcation.value)),
            )  # fmt: skip
        passed.append(bifurcation)
    return branch


def cut_half_period(branch: Branch) -> Branch:
    """Return a branch that left at a period doubling, without where it joins a shorter period."""

    def is_doubled(index: int) -> bool:
        orbit = branch.points[index].orbit
        return reduce_period(orbit) is orbit

    last = len(branch.points) - 1
    if last < 2 or is_doubled(last - 1):
        return branch
    low, high = 1, last - 1
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if is_doubled(middle) else (low, middle)
    return Branch(
        branch.parameter, branch.points[: high + 1],
        tuple(b for b in branch.bifurcations if b.index < high),
        (branch.ends[0], BranchEnd("meets another branch", branch.points[high].value)),
    )  # fmt: skip


def draw_start(period_map: PeriodMap, random: np.random.Generator) -> Float1D:
    """Return coordinates of a start: energies from far below to above those of any response.

    The speed of a damped oscillator stays below level M / C; without damping, below what a period
    of the drive can add.
    """
    p = period_map.model.parameters
    w = math.sqrt(p.stiffness / p.mass)
    fastest = period_map.acceleration_m_s2 / max(p.damping / p.mass, 0.02 * w)
    amplitude, angle = 1.5 * 10 ** random.uniform(-2.0, 0.0), random.uniform(0, 2 * math.pi)
    x = period_map.rest()
    x[0] += amplitude * fastest / w * math.cos(angle)
    x[1] = amplitude * fastest * math.sin(angle)
    return x


@dataclass(frozen=True, slots=True, eq=False)
class SettledMotion:
    """Where a start leads: state x, and the stable orbit, or the Lyapunov exponent per period."""

    x: Float1D
    orbit: Orbit | None
    exponent: float = 0.0

    @property
    def is_chaotic(self) -> bool:
        return self.orbit is None and self.exponent > MIN_EXPONENT


def settle(
    period_map: PeriodMap,
    start: Float1D,
    max_periods: int = MAX_PERIODS,
    known: Sequence[Orbit] = (),
) -> SettledMotion:
    """Return the attractor of a start: a stable orbit of up to `max_periods`, or an exponent.

    A motion that comes close to one of the `known` stable orbits ends there.
    """
    scales, x = period_map.scales, start
    for _ in range(MAX_SETTLING // (SETTLING_CHUNK + max_periods)):
        x = period_map.iterate(x, SETTLING_CHUNK)
        if not np.isfinite(x).all():
            return SettledMotion(x, None)
        first, size = x, 1e-12
        for periods in range(1, max_periods + 1):
            x = period_map.iterate(x, 1)
            size = max(size, motion_size(x, scales))
            if motion_size(x - first, scales) < RETURN_TOL * size:
                for attractor in known:
                    if motion_size(attractor.x - x, scales) < RETURN_TOL * size:
                        return SettledMotion(x, attractor)
                orbit = find_attracting_orbit(period_map, x, periods, size)
                if orbit is not None:
                    return SettledMotion(x, orbit)
                break
    growth, x = period_map.measure_growth(x, LYAPUNOV_PERIODS)
    return SettledMotion(x, None, float(growth.mean()))


def are_at_same_place(orbit: Orbit, other: Orbit, parameter: str) -> bool:
    """Return whether two located bifurcations are one, up to whole periods."""
    value, own = (each.period_map.parameter(parameter) for each in (orbit, other))
    return abs(value - own) < SAME_ORBIT * abs(value) and orbit.is_same(other)


def mirror_orbit(orbit: Orbit) -> Orbit | None:
    """Return the mirror image of an asymmetric orbit of a symmetric model, or None.

    The image is the orbit half a period later with right and left exchanged.
    """
    p, period_map = orbit.period_map.model.parameters, orbit.period_map
    if (p.bumper_stiffness_r, p.bumper_damping_r, p.gap_r) != (
        p.bumper_stiffness_l, p.bumper_damping_l, p.gap_l,
    ):  # fmt: skip
        return None
    n, size = orbit.periods, motion_size(orbit.x, period_map.scales)
    x = period_map.mirror(orbit.x)
    if x.size > 4 or (x.size > 2 and p.bumper_damping_r == 0):  # hidden states of effects
        x = period_map.iterate(x, n * math.ceil(SETTLING_CHUNK / n))
    image = find_orbit(period_map, x, n)
    if image is None or orbit.passes(image.x, SAME_ORBIT * size):
        return None
    is_image = abs(image.u_max + orbit.u_min) + abs(image.u_min + orbit.u_max) < 1e-4 * size
    return image if is_image else None
