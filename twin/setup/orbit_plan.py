"""Orbit plan of a continuation or a backbone: orbits with Jacobian and feedback gains.

Everything that the rig needs of the model is computed here, before the table moves, and refused
here if it cannot be done: no unstable orbit or no phase resonance in the range, or a latency at
which no gains hold them.
"""

import math
import re
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from table_io.backends import open_backend
from table_io.block import Float1D, find_stretches
from table_io.clock import ManualClock
from table_io.config.excitation.continuation import Backbone, OrbitPlan, PlannedOrbit
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig
from table_io.errors import InputError
from table_io.sequencer.procedure import FEEDBACK_HORIZON_S, find_lag_ms, make_test_plan
from table_io.units import GRAVITY_M_S2
from twin.dynamics.arclength import NoConvergence, correct, weighted_length
from twin.dynamics.continuation import Branch, continue_branch, make_problem, orbit_weights
from twin.dynamics.event_driven_map import make_period_map
from twin.dynamics.linearized_orbit import LinearizedOrbit, find_harmonics
from twin.dynamics.orbits import Orbit, settle_to_orbit
from twin.dynamics.period_map import FREQUENCY, LEVEL, PeriodMap
from twin.model.model import Model
from twin.setup.feedback_gains import FeedbackTiming, interpolate_gains

RANGE_MARGIN = 1.2  # ratio of frequencies by which the branch is followed beyond the range
REFUSAL_MARGIN = 1.6  # the same below the range, to tell where unstable orbits are
MAX_RAISES = 12  # by RANGE_MARGIN each, of the frequency above the range and all folds
LEAD_ORBITS = 3  # stable ones before and after the unstable ones
# Of the unstable part, largest distance of orbits from one to the next: the feedback, whose command
# is limited, must hold each of them with what is known from the one before.
MAX_SPACING = 0.04
PLAN_HARMONICS = 9
MODEL_ERROR = 0.05  # relative error of mass and of stiffness with which the gains must hold
JITTER_S = 0.005  # of blocks that arrive late; the feedback horizon absorbs smaller ones
PLAN_FILE = "orbit_plan.json"
FINE_POSITIONS = 2001  # at which the range is looked for along the unstable part
MIN_UNSTABLE_POINTS = 3  # of a followed branch, between its folds


@dataclass(frozen=True, eq=False)
class UnstableStretch:
    """Unstable orbits of a branch in order, with the stable ones before and after them.

    positions (orbit,): distance along the branch, 0 and 1 at the ends of the unstable part; lengths
    in frequency and in amplitude count alike.
    """

    orbits: tuple[Orbit, ...]
    positions: Float1D

    @property
    def unstable_hz(self) -> Float1D:
        """Frequencies of the orbits of the unstable part, (orbit,)."""
        inside = (self.positions >= 0.0) & (self.positions <= 1.0)
        return np.array([orbit.frequency_hz for orbit in self.orbits])[inside]

    def divide(self, range_hz: tuple[float, float], points: int) -> list[float]:
        """Return positions of unstable orbits in a range, evenly spaced, and of stable ones.

        There are more than `points` where these would be further than MAX_SPACING apart. The stable
        ones, LEAD_ORBITS on either side, are those beyond a fold that the range holds. A range that
        begins between the folds is reached through the lower one: the orbits on the way are
        measured too.
        """
        frequencies = np.array([orbit.frequency_hz for orbit in self.orbits])
        fine = np.linspace(0.0, 1.0, FINE_POSITIONS)
        fine_hz = np.interp(fine, self.positions, frequencies)
        inside = fine[(fine_hz >= range_hz[0]) & (fine_hz <= range_hz[1])]
        low, high = float(inside[0]), float(inside[-1])
        points = max(points, math.ceil((high - low) / MAX_SPACING))
        numbers = np.arange(-LEAD_ORBITS, points + LEAD_ORBITS) + 0.5
        positions = low + numbers / points * (high - low)
        last = self.positions[-1] if high == 1.0 else high
        if low > 0.0:
            way = MAX_SPACING * (np.arange(-LEAD_ORBITS, math.ceil(low / MAX_SPACING)) + 0.5)
            positions = np.append(way[way < low], positions[positions > low])
        return [float(p) for p in positions if self.positions[0] <= p <= last]

    def list_leads(self, position: float) -> list[Orbit]:
        """Return stable orbits that lead to a position from beyond all folds, if there are any."""
        before = [
            orbit for orbit, p in zip(self.orbits, self.positions, strict=True) if p < position
        ]
        unstable_hz = [orbit.frequency_hz for orbit in self.orbits if not orbit.stable]
        leads = _select_leads(before[::-1], self.orbit_at(position), unstable_hz)
        return leads if all(orbit.stable for orbit in leads) else []

    def orbit_at(self, position: float) -> Orbit:
        """Return the orbit at a position by Newton's method."""
        last = len(self.orbits) - 2
        index = int(np.clip(np.searchsorted(self.positions, position) - 1, 0, last))
        first, second = self.orbits[index], self.orbits[index + 1]
        span = self.positions[index + 1] - self.positions[index]
        z0, z1 = (np.append(orbit.x, orbit.frequency_hz) for orbit in (first, second))
        weights = np.append(orbit_weights(first), 1.0)
        guess = z0 + (position - self.positions[index]) / span * (z1 - z0)
        problem = make_problem(first, FREQUENCY)
        length = weighted_length(z1 - z0, weights)
        try:
            point = correct(problem.evaluate, guess, (z1 - z0) / length, weights, length)
        except NoConvergence:  # between orbits of different contacts
            return first if position - self.positions[index] < span / 2 else second
        return problem.make_orbit(point.z, point.linearization.result)


def make_orbit_plan(
    model: Model,
    range_hz: tuple[float, float],
    acceleration_m_s2: float,
    points: int,
    timing: FeedbackTiming,
) -> OrbitPlan:
    """Return the plan of a continuation through the unstable orbits of a model in a range.

    At least `points` unstable orbits, evenly spaced along the branch, and LEAD_ORBITS stable ones
    on either side. InputError if there are none, or if the latency is too large, with the largest
    allowed.
    """
    period_map = make_period_map(model, range_hz[1], acceleration_m_s2)
    stretch = find_unstable_stretch(period_map, range_hz)
    variants = _find_variants(period_map, range_hz)
    positions = stretch.divide(range_hz, points)
    orbits = [stretch.orbit_at(position) for position in positions]

    def list_orbits(station: int) -> list[Orbit]:
        return [source.orbit_at(positions[station]) for source in (stretch, *variants)]

    gains = interpolate_gains(list_orbits, positions, timing)
    return OrbitPlan(
        harmonics=PLAN_HARMONICS,
        latency_s=timing.latency_s,
        jitter_s=timing.jitter_s,
        points=tuple(_plan_orbit(orbit, own) for orbit, own in zip(orbits, gains, strict=True)),
        leads=tuple(_plan_orbit(orbit, gains[0]) for orbit in stretch.list_leads(positions[0])),
    )


def _plan_orbit(orbit: Orbit, gains: tuple[float, float]) -> PlannedOrbit:
    multiplier = complex(orbit.multipliers[0])
    harmonics = find_harmonics(orbit, PLAN_HARMONICS)
    return PlannedOrbit(
        frequency_hz=orbit.frequency_hz,
        acceleration_m_s2=orbit.acceleration_m_s2,
        stable=orbit.stable,
        multiplier=(multiplier.real, multiplier.imag) if multiplier.imag else multiplier.real,
        u_m=tuple((value.real, value.imag) for value in harmonics.tolist()),
        jacobian=tuple(
            tuple(row) for row in LinearizedOrbit(orbit, 1).table_jacobian(PLAN_HARMONICS).tolist()
        ),
        gain=gains[0],
        rate_gain_s=gains[1],
    )


def find_unstable_stretch(period_map: PeriodMap, range_hz: tuple[float, float]) -> UnstableStretch:
    """Return the longest unstable part between folds in a frequency range, with its surroundings.

    The branch is that of `_follow_from_above`, followed until it holds the lower fold, below which
    rest leads to it. InputError without one.
    """
    for margin in (RANGE_MARGIN, REFUSAL_MARGIN):
        branch = _follow_from_above(period_map, range_hz, margin)
        stretches = [
            stretch
            for stretch in _split_unstable(branch)
            if ((stretch.unstable_hz >= range_hz[0]) & (stretch.unstable_hz <= range_hz[1])).any()
        ]
        if stretches:
            longest = max(stretches, key=lambda stretch: stretch.unstable_hz.size)
            if longest.positions[0] < 0.0:
                return longest
    if not stretches:
        raise _make_refusal(branch, range_hz)
    raise InputError(
        f"the lower fold of the branch lies below {range_hz[0] / REFUSAL_MARGIN:.4g} Hz, and rest "
        "leads to the branch only below it",
        key="excitation.start_hz",
        value=range_hz[0],
        remedy="lower start_hz",
    )


def _follow_from_above(
    period_map: PeriodMap, range_hz: tuple[float, float], margin: float
) -> Branch:
    """Return the branch of the orbit to which rest settles above a range, from `margin` below it.

    Where folds lie above the range, rest may settle below its resonance, or the branch turns back
    to where it began: it is followed from higher up, so that it holds them. InputError where rest
    settles to no orbit of period 1.
    """
    branch: Branch | None = None
    for raises in range(1, MAX_RAISES + 1):
        high_hz = range_hz[1] * RANGE_MARGIN**raises
        start = settle_to_orbit(period_map.with_parameter(FREQUENCY, high_hz))
        if start is None:
            continue
        is_above = measure_orbit_phase(start) < RESONANCE_PHASE_DEG
        if is_above or branch is None:
            branch = continue_branch(start, FREQUENCY, (range_hz[0] / margin, high_hz))
            if is_above and not all(math.isclose(end.value, high_hz) for end in branch.ends):
                break
    if branch is None:
        raise InputError(
            f"from rest, the model does not settle to an orbit of period 1 at {high_hz:.4g} Hz and "
            f"{period_map.acceleration_m_s2 / GRAVITY_M_S2:.4g} g, nor above the range before",
            key="excitation.stop_hz",
            value=range_hz[1],
            remedy="choose another range",
        )
    return branch


def _make_refusal(branch: Branch, range_hz: tuple[float, float]) -> InputError:
    """Return the error that the range has no unstable orbit, with what the branch has."""
    inside = [
        abs(point.orbit.multipliers[0])
        for point in branch.points
        if range_hz[0] <= point.value <= range_hz[1]
    ]
    extents = sorted(
        (own.min(), own.max()) for own in (s.unstable_hz for s in _split_unstable(branch))
    )
    others = " or ".join(_format_inside(low, high) for low, high in extents)
    largest = f" (largest multiplier {max(inside):.4g})" if inside else ""
    return InputError(
        f"the model has no unstable orbit between folds from {range_hz[0]:g} to {range_hz[1]:g} "
        f"Hz{largest}",
        key="excitation.start_hz",
        value=range_hz[0],
        allowed=f"a range within {others} Hz" if others else "",
        remedy="choose another range, level or model",
    )


def _format_inside(low: float, high: float) -> str:
    """Return a range of positive numbers, its ends rounded inwards to four digits."""
    scale = 10.0 ** (3 - math.floor(math.log10(high)))
    return f"{math.ceil(low * scale) / scale:g} to {math.floor(high * scale) / scale:g}"


def _split_unstable(branch: Branch) -> list[UnstableStretch]:
    """Return the unstable parts between folds, each with the branch before and after it."""
    orbits = tuple(point.orbit for point in branch.points)
    is_unstable = [
        bool(((orbit.multipliers.imag == 0) & (orbit.multipliers.real > 1)).any())
        for orbit in orbits
    ]
    frequencies = np.array([orbit.frequency_hz for orbit in orbits])
    amplitudes = np.array([orbit.u_max - orbit.u_min for orbit in orbits])
    stretches = []
    for first, end in find_stretches(is_unstable):
        if end - first < MIN_UNSTABLE_POINTS:
            continue
        scales = [float(np.ptp(values[first:end])) or 1.0 for values in (frequencies, amplitudes)]
        steps = np.hypot(np.diff(frequencies) / scales[0], np.diff(amplitudes) / scales[1])
        distance = np.append(0.0, np.cumsum(steps))
        positions = (distance - distance[first]) / (distance[end - 1] - distance[first])
        positions, indices = np.unique(positions, return_index=True)
        stretch = UnstableStretch(tuple(orbits[index] for index in indices), positions)
        rises = frequencies[end - 1] > frequencies[first]
        stretches.append(stretch if rises else _reverse(stretch))
    return stretches


def _reverse(stretch: UnstableStretch) -> UnstableStretch:
    """Return the stretch from its other end: towards higher frequencies."""
    return UnstableStretch(stretch.orbits[::-1], 1.0 - stretch.positions[::-1])


def _vary_parameters(period_map: PeriodMap) -> list[PeriodMap]:
    """Return models with errors of mass and stiffness."""
    return [
        period_map.with_parameter(name, factor * period_map.parameter(name))
        for name in ("mass", "stiffness")
        for factor in (1.0 - MODEL_ERROR, 1.0 + MODEL_ERROR)
    ]


def _find_variants(period_map: PeriodMap, range_hz: tuple[float, float]) -> list[UnstableStretch]:
    """Return the unstable parts of models with errors of mass and stiffness, where they exist."""
    variants = []
    for varied in _vary_parameters(period_map):
        try:
            variants.append(find_unstable_stretch(varied, range_hz))
        except InputError:
            continue
    return variants


def make_backbone_plan(
    model: Model, range_hz: tuple[float, float], levels_m_s2: Float1D, timing: FeedbackTiming
) -> OrbitPlan:
    """Return the plan of a backbone: the orbit in phase resonance at each level, (level,) in m/s2.

    InputError if a level has none in the range, or if the latency is too large.
    """
    levels = levels_m_s2.tolist()
    period_map = make_period_map(model, range_hz[1], levels[0])
    *leads, first = find_resonance_approach(period_map, range_hz)
    orbits = [first] + [
        find_phase_resonance(period_map.with_parameter(LEVEL, level), range_hz)
        for level in levels[1:]
    ]
    variants = _vary_parameters(period_map)

    def list_orbits(station: int) -> list[Orbit]:
        listed = [orbits[station]]
        for variant in variants:
            try:
                varied = variant.with_parameter(LEVEL, levels[station])
                listed.append(find_phase_resonance(varied, range_hz))
            except InputError:  # beyond the range
                continue
        return listed

    gains = interpolate_gains(list_orbits, np.log(levels_m_s2).tolist(), timing)
    return OrbitPlan(
        condition="phase",
        harmonics=PLAN_HARMONICS,
        latency_s=timing.latency_s,
        jitter_s=timing.jitter_s,
        points=tuple(_plan_orbit(orbit, own) for orbit, own in zip(orbits, gains, strict=True)),
        leads=tuple(_plan_orbit(orbit, gains[0]) for orbit in leads),
    )


def attach_orbit_plan(text: str, profile: Profile, rig: RigConfig, model: Model, where: str) -> str:
    """Return the text of a continuation profile with the orbit plan of the model attached.

    InputError as in `make_orbit_plan`, or if the rig cannot replace its queued command.
    """
    config = profile.continuation
    assert config is not None
    timing = find_timing(profile, rig)
    _attach_file(text, "", where)  # refuses before the plan is computed
    range_hz = (config.start_hz, config.stop_hz)
    largest = config.acceleration_g * GRAVITY_M_S2
    if isinstance(config, Backbone):
        smallest = config.min_acceleration_g * GRAVITY_M_S2
        levels = np.geomspace(smallest, largest, config.points) if config.points > 1 else [largest]
        plan = make_backbone_plan(model, range_hz, np.array(levels), timing)
    else:
        plan = make_orbit_plan(model, range_hz, largest, config.points, timing)
    return _attach_file(text, plan.to_json(), where)


def _attach_file(text: str, content: str, where: str) -> str:
    """Return the text of a profile with the content of its orbit plan; InputError if impossible."""
    named = re.sub(
        r"^[ \t]*\[excitation\].*$", rf'\g<0>\nfile = "{PLAN_FILE}"', text, count=1, flags=re.M
    )
    attached = f"{named}\n[excitation.files]\n\"{PLAN_FILE}\" = '''\n{content}'''\n"
    try:
        if tomllib.loads(attached)["excitation"]["file"] == PLAN_FILE:
            return attached
    except (tomllib.TOMLDecodeError, KeyError):
        pass
    raise InputError(
        "its orbit plan cannot be attached",
        where=where,
        key="excitation",
        remedy="write it as a table, [excitation]",
    )


def check_orbit_plan(profile: Profile, rig: RigConfig) -> None:
    """Raise InputError if a rig answers later than the orbit plan that a profile brings allows."""
    make_test_plan(profile, rig, _find_replace_after(profile, rig))


def find_timing(profile: Profile, rig: RigConfig) -> FeedbackTiming:
    """Return the timing of the feedback on a rig; InputError if it cannot replace its command."""
    config = profile.continuation
    assert config is not None
    rate_hz = profile.acquisition.rate_hz
    horizon_s = _find_replace_after(profile, rig) / rate_hz + FEEDBACK_HORIZON_S
    latency_s = horizon_s + 1e-3 * find_lag_ms(config, rig)
    return FeedbackTiming(latency_s, JITTER_S, profile.acquisition.block_samples / rate_hz)


def _find_replace_after(profile: Profile, rig: RigConfig) -> int:
    """Return how many samples ahead a rig can change its command; InputError if it cannot."""
    if rig.under_external_control:
        raise InputError(
            "another controller drives this table: there is no queued command to replace",
            where=f"rig {rig.name}",
            key="backend",
            value=rig.backend,
            remedy="use a rig whose backend drives the table",
        )
    return open_backend(rig, profile, ManualClock()).replace_after


RESONANCE_PHASE_DEG = 90.0  # by which u leads: more below the resonance, less above
PHASE_TOLERANCE_DEG = 1e-3
MAX_BISECTIONS = 40
LEAD_RATIO = 1.04  # of the frequencies of two orbits on the way from rest to the first one


def find_phase_resonance(period_map: PeriodMap, range_hz: tuple[float, float]) -> Orbit:
    """Return the largest orbit in phase resonance within a frequency range, at one level.

    The branch is that of `_follow_from_above`. InputError without one, with the phases of the
    branch in the range.
    """
    return find_resonance_approach(period_map, range_hz)[-1]


def find_resonance_approach(period_map: PeriodMap, range_hz: tuple[float, float]) -> list[Orbit]:
    """Return orbits from below all folds up to the one in phase resonance, which is the last.

    From rest the first is reached without any other solution to fall to; where the branch has no
    fold the resonance alone is returned. InputError as in `find_phase_resonance`.
    """
    level_g = period_map.acceleration_m_s2 / GRAVITY_M_S2
    for margin in (RANGE_MARGIN, REFUSAL_MARGIN):
        branch = _follow_from_above(period_map, range_hz, margin)
        orbits = [point.orbit for point in branch.points]
        phases = np.array([measure_orbit_phase(orbit) for orbit in orbits])
        is_crossing = np.diff(np.sign(phases - RESONANCE_PHASE_DEG)) != 0.0
        resonances = {
            int(k): _locate(orbits[k], orbits[k + 1], float(phases[k]))
            for k in np.flatnonzero(is_crossing)
        }
        inside = [
            k for k, orbit in resonances.items() if range_hz[0] <= orbit.frequency_hz <= range_hz[1]
        ]
        if inside:
            break
    else:
        raise _make_phase_error(branch.values, phases, range_hz, level_g, [*resonances.values()])
    k = max(inside, key=lambda k: resonances[k].u_max - resonances[k].u_min)
    # The branch comes from higher frequencies: the way up to the resonance lies on the other side.
    below = orbits[k::-1] if orbits[0].frequency_hz < orbits[-1].frequency_hz else orbits[k + 1 :]
    folds_hz = [bifurcation.value for bifurcation in branch.folds]
    return [*_select_leads(below, resonances[k], folds_hz), resonances[k]]


def _select_leads(way: list[Orbit], target: Orbit, folds_hz: Sequence[float]) -> list[Orbit]:
    """Return orbits LEAD_RATIO apart in frequency that lead to a target from beyond all folds.

    way: the branch away from the target. Beyond all folds rest leads to no other solution; if the
    target lies there itself, there are none.
    """
    if not folds_hz:
        return []
    low_hz, high_hz = min(folds_hz) / LEAD_RATIO, max(folds_hz) * LEAD_RATIO
    leads, last = [], target
    for orbit in way:
        if not low_hz < last.frequency_hz < high_hz:
            break
        ratio = orbit.frequency_hz / last.frequency_hz
        is_beyond = not low_hz < orbit.frequency_hz < high_hz
        if is_beyond or not 1.0 / LEAD_RATIO < ratio < LEAD_RATIO:
            leads.append(orbit)
            last = orbit
    return leads[::-1]


def measure_orbit_phase(orbit: Orbit) -> float:
    """Return the phase in degrees by which u leads the table's acceleration, -90 to 270."""
    fundamental = complex(find_harmonics(orbit, 1)[1])
    return math.degrees(math.atan2(fundamental.imag, fundamental.real)) + 90.0


def _locate(first: Orbit, second: Orbit, first_phase: float) -> Orbit:
    """Return the orbit in phase resonance between two of a branch, by bisection of the arc."""
    problem = make_problem(first, FREQUENCY)
    z0, z1 = (np.append(orbit.x, orbit.frequency_hz) for orbit in (first, second))
    weights = np.append(orbit_weights(first), 1.0)
    length = weighted_length(z1 - z0, weights)
    low, high = 0.0, 1.0
    for _ in range(MAX_BISECTIONS):
        middle = (low + high) / 2
        guess = z0 + middle * (z1 - z0)
        try:
            point = correct(problem.evaluate, guess, (z1 - z0) / length, weights, length)
        except NoConvergence:  # between orbits of different contacts
            return first if middle < 0.5 else second
        orbit = problem.make_orbit(point.z, point.linearization.result)
        phase = measure_orbit_phase(orbit)
        if abs(phase - RESONANCE_PHASE_DEG) < PHASE_TOLERANCE_DEG:
            break
        if (phase > RESONANCE_PHASE_DEG) == (first_phase > RESONANCE_PHASE_DEG):
            low = middle
        else:
            high = middle
    return orbit


def _make_phase_error(
    frequencies: Float1D,
    phases: Float1D,
    range_hz: tuple[float, float],
    level_g: float,
    resonances: list[Orbit],
) -> InputError:
    """Return the error that a range has no phase resonance, with what the branch has."""
    inside = (frequencies >= range_hz[0]) & (frequencies <= range_hz[1])
    own = phases[inside]
    extent = f" (u leads by {own.min():.4g} to {own.max():.4g} degrees)" if own.size else ""
    others_hz = [orbit.frequency_hz for orbit in resonances]
    return InputError(
        f"the model has no phase resonance at {level_g:.4g} g from {range_hz[0]:g} to "
        f"{range_hz[1]:g} Hz{extent}",
        key="excitation.start_hz",
        value=range_hz[0],
        allowed=f"a range that contains {max(others_hz):.4g} Hz" if others_hz else "",
        remedy="choose another range, levels or model",
    )
