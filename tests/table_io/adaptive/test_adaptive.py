"""Tests that find their way: on specimens whose resonance and whose jumps are known."""

import cmath
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from scipy.signal import butter, sosfilt

from table_io.adaptive.jump_refinement import choose_part
from table_io.adaptive.policy import describe_adaptive_test, make_policy
from table_io.adaptive.resonance_tracking import interpolate_phase_crossing, parabola_vertex
from table_io.adaptive.result import Decision, StepResult
from table_io.block import Block, Float1D, Label
from table_io.config.base import PROFILES_DIR, load_config
from table_io.config.profile import Profile
from table_io.harmonics import HARMONIC_COUNT, NO_FIT, HarmonicFit, mean_swing
from table_io.records import Event, Record, Step, StepAdded
from table_io.sequencer.procedure import (
    advance_test,
    hold_test,
    make_test_plan,
    resume_test,
    start_test,
)
from table_io.sequencer.state import SequencerState
from table_io.units import GRAVITY_M_S2
from tests.builders.profiles import make_profile
from tests.builders.rigs import RIG

A = 0.05 * GRAVITY_M_S2
# Of the paper's damper: K = 36 kN/m, C = 1.1 kN s/m, M = 550 kg.
NATURAL_HZ = 1.2876
DAMPING_RATIO = 0.1236


def profile(tool: str, card: dict[str, Any], **sweep: Any) -> Profile:
    grid = {"start_hz": 1.0, "stop_hz": 1.6, "step_hz": 0.1, "cycles": 5}
    tables = {"loop_check": {"enabled": False}, tool: card}
    return make_profile(tables=tables, **{**grid, "directions": ["forward"], **sweep})


def result(step: Step, u: complex, swing_m: float | None = None, level: float = 1.0) -> StepResult:
    """A step whose u has this fundamental in m beside a table at `level` of what was asked."""

    def make_fit(fundamental: complex) -> HarmonicFit:
        return HarmonicFit(0.0, np.array([fundamental] + (HARMONIC_COUNT - 1) * [0j]), 0.0)

    table = make_fit(A * level * cmath.exp(0.3j))
    moved = make_fit(u * level * cmath.exp(0.3j))
    size = abs(u) if swing_m is None else swing_m
    return StepResult(step, table, moved, NO_FIT, size * level)


Specimen = Callable[[Step], StepResult]


def linear(f: float, natural_hz: float = NATURAL_HZ) -> complex:
    """u in m of M u'' + C u' + K u = -M A, complex at the phase of A."""
    w, n = 2 * math.pi * f, 2 * math.pi * natural_hz
    return -A / (n * n - w * w + 2j * DAMPING_RATIO * n * w)


@dataclass
class Driven:
    """What a policy asked for and found."""

    results: list[StepResult]
    reasons: list[str]
    conclusion: str

    @property
    def visits(self) -> list[Step]:
        return (
            [result.step for result in self.results[-len(self.reasons) :]] if self.reasons else []
        )


def play_policy(test: Profile, specimen: Specimen) -> Driven:
    """Plays a policy against a specimen, as the conductor does."""
    policy, steps = make_policy(test), list(test.sweep.steps)
    assert policy is not None
    results, reasons, place = [], list[str](), 0
    while True:
        results.append(specimen(steps[place]))
        decision = policy(tuple(results))
        assert decision == policy(tuple(results)), "the same results, another decision"
        if isinstance(decision, str):
            return Driven(results, reasons, decision)
        if isinstance(decision, Decision):
            steps.append(Step(len(steps), decision.direction, decision.frequency_hz, A))
            reasons.append(decision.reason)
            place = len(steps) - 1
        else:
            place += 1
            assert place < len(test.sweep.steps), "the sweep is over"


# Dwell


@pytest.mark.parametrize(
    "card, visits", [({"cycles": 20}, 4), ({"cycles": 21}, 5), ({"seconds": 12.5}, 4)]
)
def test_dwell_stays_at_the_last_step_for_as_long_as_asked(
    card: dict[str, Any], visits: int
) -> None:
    outcome = play_policy(profile("dwell", card), lambda step: result(step, 1e-3 + 0j))
    assert len(outcome.results) == 7 + visits
    assert {(step.frequency_hz, step.direction) for step in outcome.visits} == {(1.6, "forward")}
    assert f"{5 * visits} cycles held in {visits} visits" in outcome.conclusion


def test_dwell_goes_on_without_a_laser() -> None:
    outcome = play_policy(
        profile("dwell", {"cycles": 10}), lambda step: result(step, complex("nan"), math.nan)
    )
    assert len(outcome.visits) == 2


# Track


def make_track(by: str, **changes: Any) -> dict[str, Any]:
    return {"by": by, "step_hz": 0.05, "resolution_hz": 0.002, **changes}


def at(conclusion: str) -> float:
    """The first frequency in Hz that a sentence says."""
    words = conclusion.split()
    return float(words[words.index("Hz") - 1])


@pytest.mark.parametrize("level", [0.0, 0.02])
def test_by_phase_the_natural_frequency_is_found_whatever_the_level(level: float) -> None:
    """u is 90 degrees ahead at the undamped natural frequency: K / M, whatever the damping."""
    errors = itertools.cycle([1 + level, 1 - level, 1.0])
    outcome = play_policy(
        profile("track", make_track("phase")),
        lambda step: result(step, linear(step.frequency_hz), level=next(errors)),
    )
    assert at(outcome.conclusion) == pytest.approx(NATURAL_HZ, abs=0.002)
    assert len(outcome.visits) <= 4
    # it left the sweep where the resonance was near, and was careful from there on
    assert len(outcome.results) - len(outcome.visits) <= 4
    first = len(outcome.results) - len(outcome.visits) - 1
    moves = np.abs(np.diff([r.step.frequency_hz for r in outcome.results[first:]]))
    assert moves.max() <= 0.05 + 1e-9


@pytest.mark.parametrize("level", [0.0, 0.01])
def test_by_peak_the_maximum_of_u_is_found_below_it(level: float) -> None:
    """|u| is largest at f sqrt(1 - 2 zeta^2); an error of the level does not move it."""
    errors = itertools.cycle([1 + level, 1 - level, 1.0])
    outcome = play_policy(
        profile("track", make_track("peak", resolution_hz=0.005)),
        lambda step: result(step, linear(step.frequency_hz), level=next(errors)),
    )
    peak = NATURAL_HZ * math.sqrt(1 - 2 * DAMPING_RATIO**2)
    assert peak == pytest.approx(1.268, abs=0.001)
    assert at(outcome.conclusion) == pytest.approx(peak, abs=0.004)
    assert len(outcome.visits) <= 9
    first = len(outcome.results) - len(outcome.visits) - 1
    moves = np.abs(np.diff([r.step.frequency_hz for r in outcome.results[first:]]))
    assert moves.max() <= 0.05 + 1e-9


@pytest.mark.parametrize("by", ["phase", "peak"])
@pytest.mark.parametrize("direction", ["forward", "backward"])
def test_resonance_that_moves_is_followed(by: str, direction: str) -> None:
    """The damper warms up: 1 % of its frequency over 30 visits."""
    played_steps = itertools.count()

    def warm_up(step: Step) -> StepResult:
        return result(
            step, linear(step.frequency_hz, NATURAL_HZ * (1 - 0.01 * next(played_steps) / 30))
        )

    card = make_track(by, follow=24, resolution_hz=0.005)
    outcome = play_policy(profile("track", card, directions=[direction]), warm_up)
    last = NATURAL_HZ * (1 - 0.01 * len(outcome.results) / 30)
    if by == "peak":
        last *= math.sqrt(1 - 2 * DAMPING_RATIO**2)
    words = outcome.conclusion.split()
    followed = float(words[words.index("to", words.index("followed")) + 1])
    assert followed == pytest.approx(last, abs=0.003)
    assert at(outcome.conclusion) - followed > 0.005


FOLD_HZ = 4.0274


def upper(f: float) -> complex:
    """Near the end of the large branch of G4: f = fold - c (phase - 75)^2, then the small one."""
    if f > FOLD_HZ:
        return 0.8e-3 + 0j
    phase = 75.0 + 15.3 * math.sqrt((FOLD_HZ - f) / 0.0272)
    size = 6.54e-3 - 2.5e-3 * abs(f - 3.99)
    return cmath.rect(size, math.radians(phase))


def test_branch_that_turns_back_is_followed_to_its_phase_without_a_fall() -> None:
    """What a Newton step over frequency would overshoot: the branch ends 0.027 Hz further on."""
    fallen = []

    def specimen(step: Step) -> StepResult:
        if step.frequency_hz > FOLD_HZ:
            fallen.append(step.frequency_hz)
        return result(step, upper(step.frequency_hz))

    sweep = {"start_hz": 3.0, "stop_hz": 4.4, "step_hz": 0.1}
    card = make_track("phase", step_hz=0.03, resolution_hz=0.004)
    outcome = play_policy(profile("track", card, **sweep), specimen)
    assert not fallen
    assert at(outcome.conclusion) == pytest.approx(FOLD_HZ - 0.0272 * (15.0 / 15.3) ** 2, abs=0.004)


def test_fall_off_the_branch_ends_the_search() -> None:
    card = make_track("phase", phase_deg=70.0, step_hz=0.03, resolution_hz=0.004)
    sweep = {"start_hz": 3.0, "stop_hz": 4.4, "step_hz": 0.1}
    outcome = play_policy(
        profile("track", card, **sweep), lambda step: result(step, upper(step.frequency_hz))
    )
    assert "where this branch ends" in outcome.conclusion
    assert outcome.results[-1].step.frequency_hz > FOLD_HZ
    assert outcome.results[-2].step.frequency_hz <= FOLD_HZ


@pytest.mark.parametrize("by", ["phase", "peak"])
def test_no_resonance_in_the_sweep_ends_with_the_sweep(by: str) -> None:
    test = profile("track", make_track(by), start_hz=2.0, stop_hz=3.0)
    outcome = play_policy(test, lambda step: result(step, linear(step.frequency_hz)))
    assert "was not met in the sweep" in outcome.conclusion
    assert len(outcome.results) == 11
    assert not outcome.visits


def test_range_is_kept_and_the_visits_are_counted() -> None:
    test = profile("track", make_track("phase", lowest_hz=1.0, highest_hz=1.25))
    outcome = play_policy(test, lambda step: result(step, linear(step.frequency_hz)))
    assert "was not met" in outcome.conclusion
    stiffer = itertools.count()

    def stiffen(step: Step) -> StepResult:
        return result(step, linear(step.frequency_hz, 1.25 + 0.005 * next(stiffer)))

    outcome = play_policy(
        profile("track", make_track("phase", highest_hz=1.31, follow=50)), stiffen
    )
    assert max(step.frequency_hz for step in outcome.visits) == 1.31
    assert "at 1.31 Hz, the end of the range" in outcome.conclusion
    runs_away = itertools.count()

    def elusive(step: Step) -> StepResult:
        return result(step, linear(step.frequency_hz, 1.25 + 0.03 * (next(runs_away) % 2)))

    outcome = play_policy(profile("track", make_track("phase", visits=7)), elusive)
    assert len(outcome.visits) == 7
    assert "not found in 7 visits" in outcome.conclusion


@pytest.mark.parametrize("tool, card", [("track", make_track("peak")), ("refine", None)])
def test_adaptive_test_without_u_ends(tool: str, card: dict[str, Any] | None) -> None:
    test = profile(tool, card or {"resolution_hz": 0.02, "cycles": 100})
    outcome = play_policy(test, lambda step: result(step, complex("nan"), math.nan))
    assert "was not measured at 1 Hz" in outcome.conclusion
    assert not outcome.visits


def test_phase_near_180_degrees_does_not_flip_its_sign() -> None:
    """Far below a resonance u lies against A: noise makes it 179 or 181, never -179."""
    step = Step(0, "forward", 0.5, A)
    for phase in (179.0, 181.0, 90.0, 0.0, -5.0):
        u = cmath.rect(1e-3, math.radians(phase))
        assert result(step, u).phase_deg == pytest.approx(phase, abs=1e-9)


def test_crossing_is_interpolated_over_the_phase() -> None:
    fold = [(4.0 - 0.001 * (p - 75.0) ** 2, p) for p in (110.0, 100.0, 95.0)]
    assert interpolate_phase_crossing(fold, 90.0, 0.01) == pytest.approx(
        4.0 - 0.001 * 15.0**2, abs=1e-9
    )
    line = [(1.0, 100.0), (1.1, 80.0)]
    assert interpolate_phase_crossing(line, 90.0, 0.01) == pytest.approx(1.05)
    assert (
        interpolate_phase_crossing([(1.0, 80.0), (1.1, 100.0)], 90.0, 0.01) is None
    )  # it rises: no resonance
    assert (
        interpolate_phase_crossing([(1.0, 100.0), (1.001, 80.0)], 90.0, 0.01) is None
    )  # too near to tell
    assert interpolate_phase_crossing(line[:1], 90.0, 0.01) is None


def test_summit_is_that_of_the_parabola() -> None:
    def y(x: float) -> float:
        return 3.0 - 2.0 * (x - 1.23) ** 2

    points = [(x, y(x)) for x in (1.3, 1.1, 1.2)]
    assert parabola_vertex(points) == pytest.approx(1.23)
    assert parabola_vertex([(x, -value) for x, value in points]) is None
    assert parabola_vertex(points[:2]) is None
    assert parabola_vertex([points[0], points[0], points[1]]) is None


# Refine


@dataclass
class Bistable:
    """Two branches of u over f; a jump is passed `late` visits after it was due."""

    rises_hz: float  # the small branch ends, going down if it hardens
    falls_hz: float  # the large one ends
    hardens: bool = True
    late: int = 0
    large: bool | None = None
    due: int = 0

    def __call__(self, step: Step) -> StepResult:
        f = step.frequency_hz
        up, down = f < self.rises_hz, f > self.falls_hz
        if not self.hardens:
            up, down = f > self.rises_hz, f < self.falls_hz
        if self.large is None:
            self.large = up
        if down if self.large else up:
            self.due += 1
            if self.due > self.late:
                self.large = not self.large
        else:
            self.due = 0
        size = (5e-3 if self.large else 1.5e-3) * (1 + 0.1 * (f - 3.4))
        return result(step, size + 0j)


WIDE: dict[str, Any] = {"start_hz": 2.4, "stop_hz": 4.4, "directions": ["forward", "backward"]}


def make_refinement(**changes: Any) -> dict[str, Any]:
    return {"resolution_hz": 0.0125, "cycles": 2000, **changes}


def intervals(conclusion: str) -> dict[str, tuple[float, float]]:
    """Kind and direction of each jump -> (last good, first bad) in Hz."""
    out = {}
    for part in conclusion.removeprefix("refine: ").split("; "):
        if "-jump" in part:
            words = part.split()
            a, b = words.index("between") + 1, words.index("and") + 1
            out[" ".join(words[:2])] = float(words[a]), float(words[b])
    return out


@pytest.mark.parametrize("hardens", [True, False])
@pytest.mark.parametrize("step_hz, resolution_hz", [(0.1, 0.0125), (0.2, 0.0125), (0.5, 0.005)])
def test_every_jump_is_narrowed_in_its_own_direction(
    hardens: bool, step_hz: float, resolution_hz: float
) -> None:
    """Down and up, forward and backward: a hardening specimen, and a softening one."""
    low, high = 2.7912, 4.0274
    specimen = Bistable(low, high) if hardens else Bistable(high, low, hardens=False)
    test = profile(
        "refine", make_refinement(resolution_hz=resolution_hz), **WIDE | {"step_hz": step_hz}
    )
    outcome = play_policy(test, specimen)
    names = ("down-jump", "up-jump") if hardens else ("up-jump", "down-jump")
    wanted = {f"{names[0]} forward": high, f"{names[1]} backward": low}
    jumps = intervals(outcome.conclusion)
    assert jumps.keys() == wanted.keys()
    for name, (good, bad) in jumps.items():
        assert min(good, bad) <= wanted[name] <= max(good, bad)
        assert abs(good - bad) <= resolution_hz + 1e-9
        assert (good < bad) == name.endswith("forward")
    assert "no jump" not in outcome.conclusion


def test_after_every_jump_the_branch_is_reached_again_from_where_the_branches_meet() -> None:
    specimen = Bistable(2.7912, 4.0274)
    outcome = play_policy(
        profile("refine", make_refinement(), **WIDE | {"directions": ["forward"]}), specimen
    )
    sizes = [r.swing_m > 3e-3 for r in outcome.results]
    falls = 0
    for k in range(1, len(outcome.results)):
        before, after = (outcome.results[j].step.frequency_hz for j in (k - 1, k))
        if sizes[k - 1] and not sizes[k]:
            falls += 1
            if falls > 1 and k + 1 < len(outcome.results):
                assert outcome.results[k + 1].step.frequency_hz == 2.4
        elif k > 21 and sizes[k - 1] and sizes[k] and after != 2.4:
            assert 0 <= after - before <= 0.1 + 1e-9, "on the branch, never more than a sweep step"
    assert falls >= 2
    assert {step.direction for step in outcome.visits} == {"forward"}


def test_approach_hz_shortens_the_way_and_one_inside_the_hysteresis_is_found_out() -> None:
    forward = WIDE | {"directions": ["forward"]}
    short = play_policy(
        profile("refine", make_refinement(approach_hz=2.7), **forward), Bistable(2.75, 4.0274)
    )
    long = play_policy(profile("refine", make_refinement(), **forward), Bistable(2.75, 4.0274))
    assert intervals(short.conclusion) == intervals(long.conclusion)
    assert len(short.visits) < len(long.visits)
    assert min(step.frequency_hz for step in short.visits) == 2.7
    lost = play_policy(
        profile("refine", make_refinement(approach_hz=3.4), **forward), Bistable(2.75, 4.0274)
    )
    assert "not met again at 3.4 Hz" in lost.conclusion
    assert {step.frequency_hz for step in lost.visits} == {3.4}


def test_jump_that_comes_late_is_found_earlier_the_longer_a_frequency_is_held() -> None:
    """Slow passage: it leaves two visits after it was due, so the sweep finds it too far on."""
    forward = WIDE | {"directions": ["forward"]}
    specimen = Bistable(2.7912, 3.89, late=2)
    short = play_policy(profile("refine", make_refinement(), **forward), replace(specimen))
    long = play_policy(
        profile("refine", make_refinement(hold_cycles=20), **forward), replace(specimen)
    )
    (a, _), (c, d) = (
        intervals(outcome.conclusion)["down-jump forward"] for outcome in (short, long)
    )
    assert a > 3.89 + 0.01
    assert c <= 3.89 <= d
    assert " 5 held cycles" in short.conclusion
    assert "20 held cycles" in long.conclusion


def test_jump_that_takes_two_steps_of_the_sweep_is_one() -> None:
    """The first visit after the fold is passed finds the motion half way down."""
    specimen, before = Bistable(2.7912, 4.0274), []

    def shrink_slowly(step: Step) -> StepResult:
        measured = specimen(step)
        before.append(measured.swing_m)
        if len(before) > 1 and before[-1] < 0.5 * before[-2]:
            return replace(measured, swing_m=math.sqrt(0.99 * before[-1] * before[-2]))
        return measured

    forward = WIDE | {"directions": ["forward"]}
    outcome = play_policy(profile("refine", make_refinement(), **forward), shrink_slowly)
    assert outcome.conclusion.count("down-jump") == 1
    good, bad = intervals(outcome.conclusion)["down-jump forward"]
    assert good <= 4.0274 <= bad <= good + 0.0125 + 1e-9


def test_fold_that_drifts_under_way_is_found_where_it_is_last() -> None:
    """What was good before is no longer: the interval moves back with it."""
    specimen = Bistable(2.7912, 4.0274)

    def drift_down(step: Step) -> StepResult:
        was = specimen.large
        measured = specimen(step)
        if was and not specimen.large:
            specimen.falls_hz -= 0.025
        return measured

    forward = WIDE | {"directions": ["forward"]}
    outcome = play_policy(
        profile("refine", make_refinement(resolution_hz=0.004), **forward), drift_down
    )
    good, bad = intervals(outcome.conclusion)["down-jump forward"]
    assert bad - good <= 0.004 + 1e-9
    assert good <= specimen.falls_hz + 0.025 <= bad


@pytest.mark.parametrize("cycles", [5, 60, 150, 400])
def test_cycles_allowed_are_never_exceeded(cycles: int) -> None:
    test = profile("refine", make_refinement(cycles=cycles, resolution_hz=0.002), **WIDE)
    outcome = play_policy(test, Bistable(2.7912, 4.0274))
    assert 5 * len(outcome.visits) <= cycles
    assert f"{cycles} cycles do not suffice" in outcome.conclusion
    for name, true in (("down-jump forward", 4.0274), ("up-jump backward", 2.7912)):
        good, bad = intervals(outcome.conclusion)[name]
        assert min(good, bad) <= true <= max(good, bad)


def test_without_a_jump_there_is_nothing_to_refine() -> None:
    test = profile("refine", make_refinement(resolution_hz=0.02))
    outcome = play_policy(test, lambda step: result(step, linear(step.frequency_hz)))
    assert outcome.conclusion == "refine: the sweep found no jump"
    assert len(outcome.results) == 7


def test_steep_change_is_not_taken_for_a_jump() -> None:
    def steep(step: Step) -> StepResult:
        return result(step, 5e-3 * math.exp(-6.0 * (step.frequency_hz - 3.0)) + 0j)

    test = profile("refine", make_refinement(), **WIDE | {"directions": ["forward"]})
    assert "no jump" in play_policy(test, steep).conclusion


@pytest.mark.parametrize("parts", [2, 8, 20])
def test_worst_case_needs_the_fewest_visits(parts: int) -> None:
    """Against a search over all strategies; halves where the way back is free, else it creeps."""

    def worst(n: int, hold: int, back: int) -> int:
        return min(
            (
                hold + max(worst(n - k, hold, back), worst(k, hold, back) + (back if k > 1 else 0))
                for k in range(1, n)
            ),
            default=0,
        )

    if parts < 20:
        for hold_, back in ((1, 0), (1, 3), (4, 8)):
            assert choose_part(parts, hold_, back)[0] == worst(parts, hold_, back)
    assert choose_part(parts, 1, 0)[0] == math.ceil(math.log2(parts))
    assert choose_part(parts, 1, 1000) == (parts - 1, 1)


# Swing


def test_swing_is_the_mean_over_whole_cycles() -> None:
    phase = 7.3 + np.arange(1201) * 3.0 / 1200
    size = np.floor(phase - phase[0] + 1e-9).clip(0, 2) + 1.0
    assert mean_swing(size * np.sin(2 * math.pi * phase), phase) == pytest.approx(2.0, rel=1e-3)
    assert math.isnan(mean_swing(np.full(1201, np.nan), phase))
    assert math.isnan(mean_swing(np.empty(0), np.empty(0)))


@pytest.mark.parametrize("noise_m", [0.0, 5e-6, 15e-6, 30e-6])
@pytest.mark.parametrize("cycles", [4, 10])
@pytest.mark.parametrize("corner_hz", [None, 200.0])
def test_swing_of_an_orbit_does_not_grow_with_the_noise_of_its_sensor(
    noise_m: float, cycles: int, corner_hz: float | None
) -> None:
    """A motion with even and odd harmonics, as next to bumpers; its true swing by a fine grid.

    The noise is white, or it passed the filter of a sensor and is alike in successive samples.
    """
    orders, sizes = np.arange(1, 8), 2.3e-3 / np.arange(1, 8) ** 2.5

    def motion(phase: np.ndarray) -> np.ndarray:
        angles = np.outer(2 * np.pi * phase, orders) + 0.4 * orders**2
        return np.asarray(np.sin(angles) @ sizes)

    true = 0.5 * np.ptp(motion(np.arange(200_000) / 200_000))
    errors = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        phase = rng.random() + np.arange(round(cycles * 2000 / 3.37)) * 3.37 / 2000
        noise = rng.standard_normal(phase.size)
        if corner_hz is not None:
            noise = sosfilt(butter(4, corner_hz, fs=2000.0, output="sos"), noise)
        u = motion(phase) + noise_m * noise
        errors.append(mean_swing(u, phase) - true)
    assert abs(np.mean(errors)) < 2e-6
    assert np.abs(errors).max() < max(1e-7, 0.25 * noise_m)


# In the conductor


@dataclass
class Table:
    """An ideal table: what it is told it does; no specimen on it."""

    state: SequencerState
    at: int = 0

    def play(self, samples: int, until: int = 10**9) -> list[Record]:
        records: list[Record] = []
        while self.at < until and not (
            self.state.is_finished and self.at >= self.state.drive.rest_start
        ):
            drive, first = self.state.drive, self.at
            metres = drive.command(first, samples)
            values = np.array([metres, metres, drive.acceleration(first, samples)])
            names = ("drive_disp_m", "table_disp_m", "table_acc_m_s2")
            labels = drive.labels(first, samples)
            self.at += samples
            self.state, new = advance_test(
                self.state, Block("meas", first, drive.rate_hz, names, values, *labels)
            )
            records += new
        return records


def make_dwell_test(**control: Any) -> Profile:
    test = profile("dwell", {"cycles": 9}, start_hz=3.0, stop_hz=4.0, step_hz=1.0, cycles=3)
    return test.model_copy(update={"control": test.control.model_copy(update=control)})


@pytest.mark.parametrize("control", [True, False])
def test_decided_step_is_announced_before_it_begins(control: bool) -> None:
    table = Table(start_test(make_test_plan(make_dwell_test(enabled=control), RIG, 40)))
    records = table.play(20)
    decided = [record for record in records if isinstance(record, StepAdded)]
    assert [addition.step for addition in decided] == [2, 3, 4]
    drive = table.state.drive
    step, label, cycle = drive.labels(0, table.at)
    for addition in decided:
        begins = int(np.flatnonzero(step == addition.step)[0])
        assert begins - addition.index >= 0.25 * drive.rate_hz
        held = (step == addition.step) & (cycle >= 0)
        assert held.sum() == math.ceil(3 * drive.rate_hz / 4.0)
        assert (label[held] == Label.MEASURE).sum() == pytest.approx(2 * drive.rate_hz / 4.0, abs=1)
    (event,) = [record for record in records if isinstance(record, Event)]
    assert event.kind == "found"
    assert event.index == max(np.flatnonzero(cycle >= 0)) + 1
    # all the while the motion went on as it was: no blend from the first held cycle to the last
    first, last = np.flatnonzero((step == 1) & (cycle >= 0))[0], np.flatnonzero(cycle >= 0)[-1]
    assert Label.BLEND not in label[first:last]
    command: Float1D = drive.command(0, drive.rest_start + 10)
    assert np.abs(np.diff(command, 2)).max() * drive.rate_hz**2 <= 1.05 * A
    assert not command[drive.rest_start :].any()


@pytest.mark.parametrize("after", [0, 2000])
def test_person_may_hold_a_decided_step_and_go_on(after: int) -> None:
    """Also between a decision and its step: the step before is then measured anew."""
    table = Table(start_test(make_test_plan(make_dwell_test(enabled=False), RIG, 40)))
    records: list[Record] = []
    while not [record for record in records if isinstance(record, StepAdded) and record.step == 3]:
        records += table.play(20, until=table.at + 20)
    records += table.play(20, until=table.at + after)
    held = int(table.state.drive.labels(table.at, 1)[0][0])
    assert held >= 2, "the case must lie in a decided step"
    table.state = hold_test(table.state, table.at + 100)
    assert table.state.stage.kind == "open"
    records += table.play(20, until=table.at + 6000)
    table.state = resume_test(table.state, table.at + 100)
    records += table.play(20)
    measured = [result.step.index for result in table.state.results]
    assert measured == ([0, 1, 2, 3, 4] if after else [0, 1, 2, 4, 5])
    assert [record.kind for record in records if isinstance(record, Event)] == ["found"]


# The cards


@pytest.mark.parametrize(
    "name, part",
    [
        ("dwell", "3.4 Hz forward, for 40"),
        ("track", "find it to 0.002 Hz in 1 to 1.6 Hz"),
        ("refine_g4", "at most 800 held cycles"),
        ("g4_ss3", ""),
    ],
)
def test_describe_adaptive_test(name: str, part: str) -> None:
    test = load_config(PROFILES_DIR / "tests" / f"{name}.toml", Profile, "test")[0]
    assert part in describe_adaptive_test(test)
    assert bool(describe_adaptive_test(test)) == bool(part) == (make_policy(test) is not None)
