"""Level of a swept sine against its tolerance, its notches and the resonances found."""

import math

import numpy as np

from table_io.config.excitation.swept_sine import SweptSine
from table_io.config.profile import Profile
from table_io.control.sweep_control import find_pass_resonances
from table_io.records import SweepLevel
from twin.recording.reader import Recording
from twin.results.contracts import (
    ResonanceEntry,
    SweptPoint,
    SweptSineResult,
    select_judged_points,
)


def summarise_swept_sine(
    recording: Recording, profile: Profile, config: SweptSine
) -> SweptSineResult | None:
    """Return the level over frequency and the resonances; None if no level was measured.

    Shares of time count the cycles up to each point since the one before, from the first part that
    sweeps on: at the first frequency the level is still being set.
    """
    levels = recording.records(SweepLevel)
    points = [_describe_point(level, config, recording.start.rate_hz) for level in levels]
    swept = select_judged_points(points)
    if not swept:
        return None
    is_complete = recording.stop is not None and recording.stop.verdict == "complete"
    last = max(point.sweep for point in swept)
    tolerance = profile.protection.alarm
    ratios = np.array([point.achieved_m_s2 / point.demanded_m_s2 for point in swept])
    ends = np.array([points[0].at_s, *(point.at_s for point in swept)])
    seconds = np.minimum(np.diff(ends), [config.tracked_s(point.frequency_hz) for point in swept])
    notched = np.array([bool(point.limited_by) for point in swept])
    highest, lowest = swept[int(np.argmax(ratios))], swept[int(np.argmin(ratios))]
    return SweptSineResult(
        octaves_per_min=config.octaves_per_min,
        control_channels=list(config.control_channels),
        strategy=config.strategy,
        tolerance=tolerance,
        abort_db=profile.protection.abort_db,
        passes=config.passes if is_complete else min(last, config.passes),
        planned_passes=config.passes,
        inside=float(seconds[np.abs(ratios - 1.0) <= tolerance].sum() / seconds.sum()),
        highest_ratio=float(ratios.max()),
        highest_hz=highest.frequency_hz,
        lowest_ratio=float(ratios.min()),
        lowest_hz=lowest.frequency_hz,
        notched=float(seconds[notched].sum() / seconds.sum()),
        response_channel=config.response_channel,
        resonances=_list_resonances(levels, config),
        points=points,
    )


def _describe_point(level: SweepLevel, config: SweptSine, rate_hz: float) -> SweptPoint:
    sweep = config.find_pass(level.step)
    return SweptPoint(
        sweep=sweep,
        direction=config.direction(sweep) if sweep < config.passes else "dwell",
        at_s=level.index / rate_hz,
        frequency_hz=level.frequency_hz,
        reference_m_s2=level.reference_m_s2,
        demanded_m_s2=level.demanded_m_s2,
        achieved_m_s2=level.measured_m_s2,
        limited_by=level.limited_by,
        predicted_m_s2=(
            math.nan
            if config.predicted_sweep is None
            else config.predicted_sweep.level_m_s2(sweep, level.frequency_hz)
        ),
    )


def _list_resonances(levels: tuple[SweepLevel, ...], config: SweptSine) -> list[ResonanceEntry]:
    """Return the resonances of each pass, largest first."""
    return [
        ResonanceEntry(
            sweep=sweep,
            direction=config.direction(sweep),
            frequency_hz=hz,
            amplification=ratio,
        )
        for sweep in range(config.passes)
        for hz, ratio in find_pass_resonances(
            config, [level for level in levels if config.find_pass(level.step) == sweep]
        )
    ]


def format_swept_sine(result: SweptSineResult) -> str:
    """Format the level and the resonances of a swept sine in one sentence."""
    parts = [
        f"{result.passes} of {result.planned_passes} passes",
        f"level within +-{100 * result.tolerance:g} % for {100 * result.inside:.4g} % of the time",
        f"{result.lowest_ratio:.3f} at {result.lowest_hz:.3g} Hz to "
        f"{result.highest_ratio:.3f} of the demand at {result.highest_hz:.3g} Hz",
    ]
    if result.notched:
        parts.append(f"notched for {100 * result.notched:.3g} %")
    parts += [
        f"resonance at {entry.frequency_hz:.4g} Hz {entry.direction}, {entry.amplification:.3g} "
        "times the level"
        for entry in result.resonances
        if math.isfinite(entry.amplification)
    ]
    return ", ".join(parts)
