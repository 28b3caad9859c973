"""Level control of a swept sine: what is measured, and the level and correction that follow.

The command is not integrated from errors. From each window the gain of the table, level over
command, is known; it is extrapolated to the frequency at which the next command will act, so that
the delay of window and queue cannot make the loop oscillate. The same is done with the ratio of
each limited channel to the level, from which the level is reduced before the limit is reached.

A ratio is extrapolated as its difference from what is known of it (the response of the loop check,
an earlier pass, the twin of the specimen) over ln f, by the median slope of the last points: one
jump of the specimen does not tilt it.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise

import numpy as np

from table_io.block import Float1D
from table_io.config.excitation.swept_sine import SweptSine
from table_io.records import SweepLevel

SLOPE_POINTS = 5  # of the extrapolation
MAX_SLOPE = 15.0  # of ln(ratio) over ln f: a resonance of 3 % damping
JUMP_CHANGE = 0.4  # in ln(ratio): beyond is a jump of the specimen
MIN_BEND = 0.01  # in ln(ratio), from which a curve does not fit the points: noise is less
MIN_BEND_RATIO = 3.0  # of two bends, from which they differ by more than noise
LIMIT_SHARE = 0.96  # of a limit, at which a notch aims: a jump of the specimen takes of the rest
RISE_SHARE = 0.5  # of `clamp_db`, by which a notch may open in an update
MAX_SWEEP_CORRECTION = 20.0  # of the command: 26 dB of roll-off
MIN_RATIO = 1e-6  # of two amplitudes: below is a dead channel
PEAK_SPAN = 0.06  # in ln f on either side, within which a resonance is the largest
Curve = Callable[[float], float]  # ln(ratio) at ln f


def combine_levels(config: SweptSine, amplitudes: Mapping[str, float], w: float) -> float:
    """Return the level in m/s2 from the fundamentals of the control channels at w in rad/s."""
    levels = [
        amplitudes[name] * (1.0 if name.endswith("_m_s2") else w**2)
        for name in config.control_channels
    ]
    return max(levels) if config.strategy == "maximum" else sum(levels) / len(levels)


def extrapolate_ratio(points: Sequence[tuple[float, float]], known: Curve, ln_f: float) -> float:
    """Return ln(ratio) at ln f from measured (ln f, ln(ratio)), oldest first, and what is known."""
    if not points:
        return known(ln_f)
    slopes = _list_slopes(points, known)
    slope = float(np.median(slopes)) if len(slopes) >= SLOPE_POINTS - 1 else 0.0
    slope = min(max(slope, -MAX_SLOPE), MAX_SLOPE)
    at, value = points[-1]
    return known(ln_f) + value - known(at) + slope * (ln_f - at)


def choose_curve(points: Sequence[tuple[float, float]], earlier: Curve) -> Curve:
    """Return the curve of an earlier pass, or zero where the specimen was then on another branch.

    It was if the last points less that curve bend beyond noise, and far more than the points do.
    """
    flat = make_curve(())
    slopes = [_list_slopes(points, curve) for curve in (earlier, flat)]
    if len(slopes[0]) < SLOPE_POINTS - 1:
        return earlier
    step = abs(points[-1][0] - points[-SLOPE_POINTS][0]) / (SLOPE_POINTS - 1)
    bend, own = (step * (max(each) - min(each)) for each in slopes)
    return flat if bend > max(MIN_BEND, MIN_BEND_RATIO * own) else earlier


def _list_slopes(points: Sequence[tuple[float, float]], known: Curve) -> list[float]:
    """Return the slopes over ln f of the last points, less what is known of them."""
    last = [(at, value - known(at)) for at, value in points[-SLOPE_POINTS:]]
    return [
        (after - before) / (right - left)
        for (left, before), (right, after) in pairwise(last)
        if right != left
    ]


def make_curve(points: Sequence[tuple[float, float]]) -> Curve:
    """Return ln(ratio) over ln f through points, constant outside; 0 of none."""
    if not points:
        return lambda _: 0.0
    table = np.array(sorted(points))
    return lambda ln_f: float(np.interp(ln_f, table[:, 0], table[:, 1]))


def list_gain_points(levels: Sequence[SweepLevel]) -> list[tuple[float, float]]:
    """Return (ln f, ln of level over command) of measured levels."""
    return [
        (
            math.log(level.frequency_hz),
            math.log(level.measured_m_s2 / (level.demanded_m_s2 * level.correction)),
        )
        for level in levels
    ]


def list_ratio_points(levels: Sequence[SweepLevel], channel: str) -> list[tuple[float, float]]:
    """Return (ln f, ln of the amplitude of a channel over the level) of measured levels."""
    return [
        (
            math.log(level.frequency_hz),
            math.log(max(level.amplitudes[level.channels.index(channel)], 1e-30)
                     / level.measured_m_s2),
        )
        for level in levels
    ]  # fmt: skip


def find_resonances(
    frequencies_hz: Float1D, ratios: Float1D, min_amplification: float
) -> list[tuple[float, float]]:
    """Return (frequency in Hz, ratio) of the peaks of a ratio of response to level, largest first.

    frequencies_hz, ratios: (point,), in any order. A peak is the largest within PEAK_SPAN of ln f,
    not at an end of the band, and `min_amplification` at least.
    """
    order = np.argsort(frequencies_hz)
    ln_f, sorted_ratios = np.log(frequencies_hz[order]), ratios[order]
    peaks = []
    for k in range(1, ln_f.size - 1):
        near = np.abs(ln_f - ln_f[k]) <= PEAK_SPAN
        is_inside = ln_f[0] + PEAK_SPAN < ln_f[k] < ln_f[-1] - PEAK_SPAN
        if is_inside and sorted_ratios[k] >= max(sorted_ratios[near].max(), min_amplification):
            peaks.append((float(np.exp(ln_f[k])), float(sorted_ratios[k])))
    return sorted(peaks, key=lambda peak: -peak[1])


def find_pass_resonances(
    config: SweptSine, levels: Sequence[SweepLevel]
) -> list[tuple[float, float]]:
    """Return (frequency in Hz, ratio) of the resonances that a pass shows, largest first."""
    if len(levels) < 3 or config.response_channel not in levels[0].channels:
        return []
    ratios = np.exp([ratio for _, ratio in list_ratio_points(levels, config.response_channel)])
    frequencies_hz = np.array([level.frequency_hz for level in levels])
    return find_resonances(frequencies_hz, ratios, config.min_amplification)
