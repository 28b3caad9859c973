"""Jump monitoring: does the specimen jump where its twin does, and where is the next jump?

The free-running twin is driven by the measured motion of the table, so it is the reference: a step
at which one of both jumps and they end on different solutions is a warning. Forecasts come from the
model of the twin, driven through the steps of the test before it begins.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from table_io.config.profile import Profile
from table_io.records import Event, JumpForecast, NormalizedResponse, PrcPoint, Record, Step
from twin.compare.curves import compare_amplitudes, detect_hysteresis, find_sudden_change
from twin.compare.monitoring.agreement import GAP_ERROR_M, NOISE_FACTOR
from twin.compare.monitoring.cycle import ChannelNoise
from twin.model.ideal_response import simulate_sweep
from twin.model.model import Model

# Of the frequency of a jump, where the grid is finer: gaps, masses and lasers are known well enough
# to place a jump to 1 %, and slow passage moves it as much again.
JUMP_TOLERANCE = 0.02
MIN_FORECAST_CYCLES = 20  # at each step, after which a motion has left a branch that ended
MAX_FORECAST_CYCLES = 4000  # driven before a test; an integrated model needs 0.3 ms for each


@dataclass(frozen=True, slots=True)
class ExpectedJump:
    """A jump of the twin between two steps of the test; `kind` is "up" or "down"."""

    before: Step
    after: Step
    kind: str

    @property
    def at_hz(self) -> float:
        """Middle between the frequencies of both steps."""
        return 0.5 * (self.before.frequency_hz + self.after.frequency_hz)


@dataclass(frozen=True, slots=True)
class JumpTracking:
    """Jumps of the twin's model, the last point, and a departure that may be one step of delay."""

    expected: tuple[ExpectedJump, ...] = ()
    last_point: PrcPoint | None = None
    doubted: Event | None = None


def predict_jumps(
    profile: Profile, model: Model, steps: tuple[Step, ...]
) -> tuple[ExpectedJump, ...]:
    """Return the jumps of the twin's model, driven through the steps of a test, in their order.

    With both directions of a level they are those of its hysteresis, else sudden changes of eta_d.
    """
    if not steps:
        return ()
    averaged = profile.sweep.measured_cycles
    cycles = max(profile.sweep.cycles, MIN_FORECAST_CYCLES)
    cycles = min(cycles, MAX_FORECAST_CYCLES // len(steps))
    response = simulate_sweep(
        model,
        np.array([step.frequency_hz for step in steps]),
        np.array([step.acceleration_m_s2 for step in steps]),
        max(cycles, averaged),
        averaged,
    )
    amplitudes = 0.5 * (response.column("u_max") - response.column("u_min"))
    points = [
        PrcPoint(
            0, step.index, step.direction, step.frequency_hz, None, _as_response(values),
            math.nan, math.nan, math.nan,
        )
        for step, values in zip(steps, amplitudes, strict=True)
    ]  # fmt: skip
    by_index = {step.index: step for step in steps}
    jumps: list[ExpectedJump] = []
    for group in _group_by_level(profile, steps, points):
        detected = {
            (jump.direction, jump.from_hz, jump.to_hz): jump.kind
            for jump in detect_hysteresis(group, "twin")[0]
        }
        is_one_way = len({point.direction for point in group}) == 1
        for before, after in pairwise(group):
            key = (after.direction, before.frequency_hz, after.frequency_hz)
            kind = detected.get(key) if before.direction == after.direction else None
            if is_one_way and (change := find_sudden_change(before, after, "twin")):
                kind = "up" if change > 0 else "down"
            if kind is not None:
                jumps.append(ExpectedJump(by_index[before.step], by_index[after.step], kind))
    return tuple(sorted(jumps, key=lambda jump: jump.after.index))


def _as_response(amplitudes: np.ndarray) -> NormalizedResponse:
    """Return the response of a step from the amplitudes of u over its last cycles, as eta_d."""
    nan, mean = math.nan, float(amplitudes.mean())
    spread = float(np.ptp(amplitudes)) / mean if mean > 0 else 0.0  # zero where the mass sticks
    return NormalizedResponse(mean, nan, nan, nan, nan, nan, (), (), nan, spread)


def _group_by_level(
    profile: Profile, steps: Sequence[Step], points: Sequence[PrcPoint]
) -> list[list[PrcPoint]]:
    """Return the points of each level of a schedule; all in one group without a schedule."""
    schedule_db = profile.sweep.schedule_db
    if len(schedule_db) < 2:
        return [[*points]]
    stated = profile.sweep.levels_m_s2(np.array([step.frequency_hz for step in steps]))
    driven = np.array([step.acceleration_m_s2 for step in steps])
    distance_db = np.abs(20.0 * np.log10(driven / stated) - np.array(schedule_db)[:, None])
    nearest = np.argmin(distance_db, axis=0)
    groups = (
        [point for point, row in zip(points, nearest, strict=True) if row == level]
        for level in range(len(schedule_db))
    )
    return [group for group in groups if group]


def measure_separation(point: PrcPoint, noise: ChannelNoise, u_star_m: float) -> float:
    """Return how far the amplitudes of specimen and twin are apart at a step, over the tolerance.

    Beyond 1 they are on different solutions; noise, if known, and gap errors where the bumpers are
    touched belong to the tolerance. NaN without one of them.
    """
    measured, twin = point.measured, point.twin
    if measured is None or twin is None:
        return math.nan
    allowance_m = GAP_ERROR_M if any((*measured.impacts_right, *measured.impacts_left)) else 0.0
    noise_m = noise.relative_displacement_rms
    if math.isfinite(noise_m):
        allowance_m += NOISE_FACTOR * noise_m
    return compare_amplitudes(measured, twin, allowance_m / u_star_m)


def track_jumps(
    tracking: JumpTracking, point: PrcPoint, is_apart: bool
) -> tuple[JumpTracking, list[Record]]:
    """Update with a planned step; return jump Events and the forecast of the next jump.

    `is_apart` tells whether specimen and twin are on different solutions there. On a grid finer
    than JUMP_TOLERANCE, a departure is reported only if the next step has it too.
    """
    last, doubted = tracking.last_point, tracking.doubted
    items: list[Record] = []
    if doubted is not None and is_apart:
        items.append(replace(doubted, index=point.index))
    tracking = replace(tracking, last_point=point, doubted=None)
    event = _describe_change(last, point, is_apart)
    if event is not None and not items:
        is_fine = last is not None and _is_within_tolerance(last, point)
        if event.kind == "jump":
            # Together they also climb the flank of a resonance on a coarse grid: no jump.
            near = any(abs(jump.after.index - point.step) <= 1 for jump in tracking.expected)
            items += [event] if near else []
        elif is_fine:
            tracking = replace(tracking, doubted=event)
        else:
            items.append(event)
    return tracking, [*items, _forecast_jump(tracking.expected, point)]


def _is_within_tolerance(last: PrcPoint, point: PrcPoint) -> bool:
    distance_hz = abs(point.frequency_hz - last.frequency_hz)
    return distance_hz <= JUMP_TOLERANCE * point.frequency_hz


def _describe_change(last: PrcPoint | None, point: PrcPoint, is_apart: bool) -> Event | None:
    """Return the event of a jump of specimen or twin between two steps; None without one."""
    measured, twin = (find_sudden_change(last, point, source) for source in ("measured", "twin"))
    if last is None or not (measured or (twin and is_apart)):
        return None
    kind = "jump"
    if is_apart and measured != twin:
        kind = "unexpected jump" if measured else "no jump"
    return Event(
        point.index,
        kind,
        f"{point.direction}, {last.frequency_hz:g} to {point.frequency_hz:g} Hz: eta_d "
        f"{_describe_values(last, point, 'measured')} measured, "
        f"{_describe_values(last, point, 'twin')} of the twin",
    )


def _describe_values(last: PrcPoint, point: PrcPoint, source: str) -> str:
    before, after = (getattr(each, source) for each in (last, point))
    if before is None or after is None:
        return "unknown"
    return f"{before.eta_d:.3f} -> {after.eta_d:.3f}"


def _forecast_jump(expected: Sequence[ExpectedJump], point: PrcPoint) -> JumpForecast:
    """Return the forecast of the next jump along the sweep, as of a step."""
    position = (point.index, point.step, point.direction, point.frequency_hz)
    jump = next((jump for jump in expected if jump.after.index > point.step), None)
    if jump is None:
        return JumpForecast(*position, "", math.nan, math.nan, math.nan)
    ends = sorted((jump.before.frequency_hz, jump.after.frequency_hz))
    return JumpForecast(*position, jump.kind, jump.at_hz, *ends)
