"""Refine policy: narrow the jumps of a sweep, in the direction of the sweep.

After a jump the motion is on the other branch. The table therefore returns to where the branches
meet, approaches again in steps of the sweep, holds the last good frequency and continues from there
in smaller steps. Every step that jumps costs a whole return, so the steps are chosen to need the
fewest visits in the worst case; that is a bisection only if the return is cheap.
"""

import math
from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise

from table_io.adaptive.result import (
    Decision,
    PolicyGenerator,
    StepRequest,
    StepResult,
    request_step,
)
from table_io.config.adaptive import RefineConfig
from table_io.config.profile import Profile
from table_io.records import MIN_JUMP_RATIO, Step

# A change is smooth if it shrinks nearly in proportion to the interval.
NARROW_WIDTH_RATIO = 1 / 7
STEEP_CHANGE_RATIO = 3.0
MIN_APPROACH_VISITS = 3  # least number of visits to reach the branch again


@dataclass(frozen=True, slots=True)
class JumpInterval:
    """Jump between `good_hz` (before) and `bad_hz` (after); `approach_path` follows its branch."""

    direction: str
    approach_path: tuple[float, ...]
    good_hz: float
    bad_hz: float
    good_swing_m: float  # swing of u at good
    bad_swing_m: float  # and at bad
    branch_limit_m: float  # swing that separates the two branches
    level_g: float  # at good
    confirmed: bool = False  # good was held for `hold_cycles`

    @property
    def kind(self) -> str:
        return "down" if self.bad_swing_m < self.good_swing_m else "up"

    def has_left_branch(self, result: StepResult) -> bool:
        """Return True if the motion is no longer on the branch."""
        return (result.swing_m < self.branch_limit_m) == (self.bad_swing_m < self.good_swing_m)

    def continues(self, before: StepResult, after: StepResult) -> bool:
        """Return True if the change from `before` to `after` continues this jump."""
        at_jump = (before.step.direction, before.step.frequency_hz) == (self.direction, self.bad_hz)
        return at_jump and (after.swing_m < before.swing_m) == (
            self.bad_swing_m < self.good_swing_m
        )

    def part_count(self, resolution_hz: float) -> int:
        """Return the number of equal parts of the interval, none wider than the resolution."""
        return max(math.ceil(abs(self.bad_hz - self.good_hz) / resolution_hz - 1e-6), 1)


RefinementGenerator = Generator[
    StepRequest, StepResult, tuple[JumpInterval | None, int]
]  # (None if not reached, visits spent)


def describe_policy(config: RefineConfig, profile: Profile) -> str:
    """Describe the planned refinement in one sentence."""
    cycles = profile.sweep.cycles
    approach = (
        "the start of its direction" if config.approach_hz is None else f"{config.approach_hz:g} Hz"
    )
    return (
        f"after the sweep, narrow each of its jumps to {config.resolution_hz:g} Hz: approach again "
        f"along its branch from {approach}, then in smaller steps, each held "
        f"{_hold_visits(config, profile) * cycles} cycles; at most "
        f"{_max_visits(config, profile) * cycles} held cycles in total"
    )


def run_policy(config: RefineConfig, profile: Profile) -> PolicyGenerator:
    """Request the steps that narrow each jump; return the interval of each jump as text."""
    results = []
    for _ in profile.sweep.steps[profile.first_step :]:
        results.append((yield from request_step(None)))
    visits_left, sentences = _max_visits(config, profile), []
    for jump in find_jump_intervals(results, config.approach_hz):
        refined, spent = yield from _narrow_jump(jump, config, profile, visits_left)
        visits_left -= spent
        sentences.append(_format_jump(jump, refined, config, profile, spent))
    return "refine: " + ("; ".join(sentences) or "the sweep found no jump")


def _hold_visits(config: RefineConfig, profile: Profile) -> int:
    """Return the number of visits for which a frequency is held before it counts as passed."""
    return math.ceil((config.hold_cycles or profile.sweep.cycles) / profile.sweep.cycles)


def _max_visits(config: RefineConfig, profile: Profile) -> int:
    """Return the total number of visits allowed."""
    return config.cycles // profile.sweep.cycles


def find_jump_intervals(
    results: Sequence[StepResult], approach_hz: float | None
) -> list[JumpInterval]:
    """Detect the jumps of a sweep, in the order of the steps.

    A jump that extends over several steps of the sweep counts once.
    """
    intervals: list[JumpInterval] = []
    for before, after in pairwise(results):
        if after.step.direction != before.step.direction or not _is_jump(
            before.swing_m, after.swing_m
        ):
            continue
        last = intervals[-1] if intervals and intervals[-1].continues(before, after) else None
        if last is None:
            last = JumpInterval(
                before.step.direction,
                _approach_path(results, before.step, approach_hz),
                before.step.frequency_hz,
                after.step.frequency_hz,
                before.swing_m,
                after.swing_m,
                math.nan,
                before.level_g,
            )
        else:
            intervals.pop()
        middle = math.sqrt(last.good_swing_m * after.swing_m)
        intervals.append(replace(_move_bad(last, after), branch_limit_m=middle))
    return intervals


def _approach_path(
    results: Sequence[StepResult], step: Step, approach_hz: float | None
) -> tuple[float, ...]:
    """Return the frequencies of the sweep in Hz that lead to a step, from `approach_hz` on."""
    steps = [result.step for result in results if result.step.direction == step.direction]
    path = [path_step.frequency_hz for path_step in steps if path_step.index <= step.index]
    up = 1 if step.direction == "forward" else -1
    approach = [f for f in path if approach_hz is None or up * f >= up * approach_hz - 1e-9]
    return tuple(approach or path)


def _is_jump(a: float, b: float) -> bool:
    return max(a, b) > MIN_JUMP_RATIO * min(a, b)


def _narrow_jump(
    jump: JumpInterval, config: RefineConfig, profile: Profile, visits_left: int
) -> RefinementGenerator:
    """Narrow a jump to the resolution, or as far as the remaining visits allow."""
    holds, spent, on_branch = _hold_visits(config, profile), 0, False
    while not jump.confirmed or jump.part_count(config.resolution_hz) > 1:
        approach_visits, parts = len(jump.approach_path) + 1, jump.part_count(config.resolution_hz)
        if (
            spent + holds + (0 if on_branch else approach_visits + max(holds, MIN_APPROACH_VISITS))
            > visits_left
        ):
            break
        if on_branch:
            part = choose_part(parts, holds, approach_visits)[1]
            frequency_hz = round(jump.good_hz + part * (jump.bad_hz - jump.good_hz) / parts, 9)
            reason = f"part {part} of {parts} from {jump.good_hz:g} to {jump.bad_hz:g} Hz"
            result, visits = yield from _hold_frequency(jump, frequency_hz, holds, reason)
            on_branch = not jump.has_left_branch(result)
            jump = _move_good(jump, result) if on_branch else _move_bad(jump, result)
        else:
            returned, visits = yield from _return_to_branch(jump, holds)
            if returned is None:
                return None, spent + visits
            jump, on_branch = returned, returned.confirmed
        spent += visits
    return jump, spent


@lru_cache(maxsize=1024)
def choose_part(parts: int, hold_visits: int, return_visits: int) -> tuple[int, int]:
    """Return (visits in the worst case, part to hold next) for a jump in one of `parts`.

    Minimax search: holding costs `hold_visits`; a jump costs `return_visits` more, unless it ends
    the search.
    """
    best = [(0, 0), (0, 0)]
    for n in range(2, parts + 1):
        best.append(
            min(
                (hold_visits + max(best[n - k][0], best[k][0] + (return_visits if k > 1 else 0)), k)
                for k in range(1, n)
            )
        )
    return best[parts]


def _return_to_branch(jump: JumpInterval, hold_visits: int) -> RefinementGenerator:
    """Return to the start of the approach path and follow it to the last good frequency.

    If the motion leaves the branch on the way, the jump lies there. None if it was never on it.
    """
    path = (
        jump.approach_path
        if jump.good_hz == jump.approach_path[-1]
        else (*jump.approach_path, jump.good_hz)
    )
    reason = f"back to the {jump.direction} branch of the {jump.kind}-jump"
    result, spent = yield from _hold_frequency(
        jump, path[0], max(hold_visits, MIN_APPROACH_VISITS), reason, until=False
    )
    if jump.has_left_branch(result):
        return None, spent
    for position, frequency_hz in enumerate(path[1:] or path):
        is_last = frequency_hz == jump.good_hz
        reason = (
            f"last good frequency of the {jump.kind}-jump" if is_last else "along the branch again"
        )
        result, visits = yield from _hold_frequency(
            jump, frequency_hz, hold_visits if is_last and not jump.confirmed else 1, reason
        )
        spent += visits
        if jump.has_left_branch(result):
            if frequency_hz == path[0]:
                return None, spent
            approach_path, good = jump.approach_path[: position + 1], path[position]
            return replace(
                _move_bad(jump, result), approach_path=approach_path, good_hz=good, confirmed=False
            ), spent
    return _move_good(jump, result), spent


def _hold_frequency(
    jump: JumpInterval, frequency_hz: float, max_visits: int, reason: str, until: bool = True
) -> Generator[StepRequest, StepResult, tuple[StepResult, int]]:
    """Hold a frequency until the branch is left (`until`) or reached: (result, visits)."""
    visits = 0
    while True:
        result = yield from request_step(Decision(frequency_hz, jump.direction, reason))
        visits += 1
        if jump.has_left_branch(result) == until or visits == max_visits:
            return result, visits


def _move_good(jump: JumpInterval, result: StepResult) -> JumpInterval:
    good, swing, level = result.step.frequency_hz, result.swing_m, result.level_g
    return replace(jump, good_hz=good, good_swing_m=swing, level_g=level, confirmed=True)


def _move_bad(jump: JumpInterval, result: StepResult) -> JumpInterval:
    return replace(jump, bad_hz=result.step.frequency_hz, bad_swing_m=result.swing_m)


def _format_jump(
    first: JumpInterval,
    jump: JumpInterval | None,
    config: RefineConfig,
    profile: Profile,
    visits: int,
) -> str:
    """Describe the interval of a jump in one sentence."""
    cycles = profile.sweep.cycles
    name = f"{first.kind}-jump {first.direction}"
    if jump is None:
        return (
            f"{name}: its branch was not met again at {first.approach_path[0]:g} Hz; the jump "
            f"lies between {first.good_hz:g} and {first.bad_hz:g} Hz as in the sweep; set "
            "approach_hz, or start the sweep, where the branches meet"
        )
    if not jump.confirmed:
        return (
            f"{name} between {jump.good_hz:g} and {jump.bad_hz:g} Hz: not refined, "
            f"{config.cycles} cycles do not suffice to reach it again; {visits * cycles} were used"
        )
    hold_cycles = _hold_visits(config, profile) * cycles
    text = (
        f"{name} between {jump.good_hz:.4f} and {jump.bad_hz:.4f} Hz, "
        f"{1e3 * jump.good_swing_m:.4g} to {1e3 * jump.bad_swing_m:.4g} mm at "
        f"{jump.level_g:.4f} g, at {hold_cycles} held cycles per frequency; a jump is passed late, "
        f"so the fold lies there or before; {visits * cycles} cycles used"
    )
    if _is_smooth(first, jump):
        text += "; the swing changes as fast on either side, so this is a steep flank, but no jump"
    if jump.part_count(config.resolution_hz) > 1:
        text += f"; {config.cycles} cycles do not suffice for {config.resolution_hz:g} Hz"
    return text


def _is_smooth(first: JumpInterval, jump: JumpInterval) -> bool:
    """Return True if the change shrank nearly in proportion to a much narrower interval."""
    width_ratio = abs((jump.bad_hz - jump.good_hz) / (first.bad_hz - first.good_hz))
    final_change, initial_change = (
        math.log(interval.bad_swing_m / interval.good_swing_m) for interval in (jump, first)
    )
    return (
        width_ratio < NARROW_WIDTH_RATIO
        and final_change / initial_change < STEEP_CHANGE_RATIO * width_ratio
    )
