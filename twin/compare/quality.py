"""Quality of recorded channels: samples that cannot be right, and channels that cannot be right.

Bad samples become gaps with a reason, so that nobody fits them:

    wild       far from both neighbours, and nothing else jumps with it: sentinels, dropouts
    clipped    samples at the end of a range, equal or within a noise, entered at speed
    stuck      equal samples while the channel was in motion and others still are

A channel as a whole is a question, since only its owner knows what happened to it:

    held       each reading stands in several samples: a slower converter
    reversed   its sign contradicts another channel, or the work of a passive component
    delayed    its motion is that of another channel at another time
    drifting   its clock is another one than that of a channel of the same motion
    mounted    it stands on the table, where it should stand on the floor
    swapped    it shows what another channel should

Nothing here knows the specimen: a finding compares a channel with itself or with another one of
the same motion. `drive_disp_m` is a command, which may be anything: it is judged only where it
is said to have been played.
"""

import math
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from scipy.fft import irfft, next_fast_len, rfft, rfftfreq

from table_io.block import (
    Block,
    Float1D,
    Float2D,
    find_stretches,
    interpolate_missing,
    join_with_gaps,
)
from table_io.channels import CHANNEL_BY_NAME, LEFT_CELLS, RIGHT_CELLS
from table_io.errors import InputError
from table_io.records import SampleGap

JUDGED = tuple(name for name in CHANNEL_BY_NAME if name != "drive_disp_m")
MIN_SAMPLES = 50  # of a channel that is judged
# Deviation of a wild sample over the largest other one: impacts of one test differ by less.
MIN_STAND_OUT = 5.0
MAX_WILD_SHARE = 0.2  # of the samples, beyond which a jump is the way of the channel
MAX_UNEQUAL_RUN = 3  # wild samples in a row that differ from each other
MAX_ROUGHNESS = 0.25  # of a wild sample's deviation: by how much its neighbours may move
IMPACT_SAMPLES = 2  # between the jumps of two channels that show one impact
CERTAIN_STAND_OUT = 30.0  # range of the others, beyond which no impact explains a sample
MIN_CLIPPED_RUN = 3  # equal samples at an extreme, where no others are equal
MIN_LEVEL_RATIO = 6.0  # of that run over those of the next levels: 4.8 on a quantised sine
MAX_END_RATIO = 3.0  # of a run at the beginning or end over the others: longer, it is a rest
MAX_OVERSHOOT = 2.0  # of the range, that speed and length of a flat top foretell: else a dwell
CLIPPING_NOISE = 1e-4  # of the range, within which a flat top that carries noise stays
MIN_CUT_OFF = 6.0  # times that noise: height that speeds foretell above such a top; of a peak, 1
MIN_STUCK_RUN, MIN_STUCK_RATIO = 5, 4.0  # samples; over how long the longest readings last
LASTING_SHARE = 0.99  # of the readings, which last less
MIN_STUCK_STEP = 10.0  # resolutions by which a stuck channel is off when it moves again
MIN_STUCK_SPEED = 0.3  # of the rms speed, at which a stuck channel stops
MIN_SILENT_RUN = 20  # equal samples of a channel whose noise never repeats a reading
NOISY_BENDS = 0.5  # share of second differences that change their sign: 0.73 in white noise
MIN_OTHER_MOTION = 0.05  # of its range, by which another channel moves meanwhile
MIN_HOLD = 1.5  # samples a reading
MIN_HOLD_SHARE = 0.98  # of the readings that last as long as the others
LOUD_SHARE = 0.1  # of the largest product of two spectra: the lines that are compared
MIN_CORRELATION = 0.9  # of two channels of one motion
SURE_CORRELATION = 0.95
MAX_DELAY_S, MAX_DELAY_SAMPLES = 4e-3, 3.0  # of filters and multiplexers; the larger one counts
MIN_GAIN_IN_CORRELATION = 0.03  # by a delay of many samples
DELAY_SIGMA = 4.0
MAX_PHASE_LEFT = 0.25  # of the phases, or of what a high pass leaves, by a delay that is one
PART_COUNT = 8  # of a test, in which the work of a force is added up, or a delay is measured
MAX_TAKEN_SHARE = 0.1  # of the work done by a force: work taken, by a force that is reversed
# Of confused units: g, mm, inch, cm, in/s2 and their combinations.
UNIT_FACTORS = (9.80665, 1000.0, 25.4, 2.54, 100.0, 39.3701, 386.089, 980.665, 9806.65, 10.0)
MAX_FACTOR_ERROR = 0.05  # of gains of sensors, which are off by less
MIN_LOSS, MIN_WORK = 0.01, 0.1  # of the force: smaller work is that of sensors, or of filters
MIN_SIDE_CORRELATION = 0.3  # of the force of a bumper with the displacement towards it
MIN_REVERSED_PULL = 5.0  # of a load cell, over its push
# Of what an expectation leaves of a channel, by one that is the right one: over the other's.
MAX_BETTER_SHARE = 0.3
COMPARED_PAIRS = (  # displacement, the channels (with signs) that are its second derivative
    ("table_disp_m", {"table_acc_m_s2": 1.0}),
    ("mass_disp_m", {"mass_acc_m_s2": 1.0}),
    ("rel_disp_m", {"mass_acc_m_s2": 1.0, "table_acc_m_s2": -1.0}),
)
Span = tuple[int, int]  # first sample, end
Spectrum = npt.NDArray[np.complex128]


@dataclass(frozen=True, slots=True)
class ChannelDoubt:
    """What makes channels impossible as they are; `remedy` is what a map of an import can state."""

    kind: str  # held, reversed, delayed, drifting, mounted, swapped
    channels: tuple[str, ...]
    problem: str
    remedy: str


def find_bad_samples(
    channels: Mapping[str, Float1D], judged: Container[str] = JUDGED
) -> list[SampleGap]:
    """Return the bad samples of channels in SI, (sample,) each with NaN in gaps, by reason."""
    cleaned = {
        name: np.array(values)
        for name, values in channels.items()
        if name in judged and np.isfinite(values).sum() >= MIN_SAMPLES
    }
    gaps = []
    for name, spans in _find_wild(cleaned).items():
        gaps += _take_out(cleaned, name, spans, "wild")
    for name, values in cleaned.items():
        gaps += _take_out(cleaned, name, _find_clipped(name, values), "clipped")
    for name, values in cleaned.items():
        if not find_hold(values):
            gaps += _take_out(cleaned, name, _find_stuck({**channels, **cleaned}, name), "stuck")
    return gaps


def _take_out(
    channels: dict[str, Float1D], name: str, spans: Sequence[Span], reason: str
) -> list[SampleGap]:
    """Set the samples of spans to NaN in a channel; return them as gaps."""
    for first, end in spans:
        channels[name][first:end] = np.nan
    return [SampleGap(first, end - first, name, reason) for first, end in spans]


def clean_blocks(blocks: Sequence[Block], where: str) -> tuple[tuple[Block, ...], list[str]]:
    """Return measured blocks with NaN for what is bad in them, and a line for each finding.

    InputError if the force of a component cannot be right.
    """
    if not blocks:
        return (), []
    joined = join_with_gaps(blocks)
    first, channels = joined.index, dict(zip(joined.channels, joined.values, strict=True))
    gaps = find_bad_samples(channels)
    lines = describe_gaps(gaps, channels)
    cleaned = {name: np.array(values) for name, values in channels.items()}
    for gap in gaps:
        cleaned[gap.channel][gap.index : gap.end] = np.nan
    for doubt in find_doubts(cleaned, blocks[0].rate_hz):
        if doubt.kind == "reversed" and "damper_force_n" in doubt.channels:
            raise InputError(doubt.problem, where=where, remedy=f"import it again: {doubt.remedy}")
        lines.append(f"{doubt.problem}; {doubt.remedy}")
    if not gaps:
        return tuple(blocks), lines
    windows = [slice(block.index - first, block.end - first) for block in blocks]
    return tuple(
        replace(block, values=np.array([cleaned[name][window] for name in block.channels]))
        for block, window in zip(blocks, windows, strict=True)
    ), lines


def describe_gaps(gaps: Sequence[SampleGap], values: Mapping[str, Float1D]) -> list[str]:
    """Return a line for each channel and reason; `values` are those of the recording."""
    lines = []
    for channel, reason in dict.fromkeys((gap.channel, gap.reason) for gap in gaps):
        spans = [gap for gap in gaps if (gap.channel, gap.reason) == (channel, reason)]
        count = sum(gap.count for gap in spans)
        reading = values[channel][spans[0].index]
        unit = CHANNEL_BY_NAME[channel].unit
        lines.append(
            f"{channel}: {count} samples are {reason}, the first one is sample {spans[0].index} "
            f"({reading:.6g} {unit}); they are not used"
        )
    return lines


def _find_wild(channels: Mapping[str, Float1D]) -> dict[str, list[Span]]:
    """Return the wild samples by channel: not where several channels jump, as in an impact."""
    suspects = {name: _find_suspects(values) for name, values in channels.items()}
    wild: dict[str, list[Span]] = {}
    for name, spans in suspects.items():
        others = np.array(
            sorted(first for other, s in suspects.items() if other != name for first, _ in s)
        )
        values = channels[name]
        bad = np.zeros(values.size, dtype=bool)
        for first, end in spans:
            bad[first:end] = True
        rest = values[~bad & np.isfinite(values)]
        if not rest.size:
            continue
        low, high = float(rest.min()), float(rest.max())
        reach = max(high - low, 1e-300)
        readings = [float(values[first]) for first, _ in spans]
        kept = []
        for (first, end), reading in zip(spans, readings, strict=True):
            near = others.size and np.abs(others - first).min() <= IMPACT_SAMPLES
            beyond = max(reading - high, low - reading)
            if near and beyond < CERTAIN_STAND_OUT * reach and readings.count(reading) < 2:
                continue
            kept.append((first, end))
        if kept:
            wild[name] = kept
    return wild


def _find_suspects(values: Float1D) -> list[Span]:
    """Return the spans of one channel that jump away from both of its neighbours."""
    left = np.array(values)
    is_suspect = np.zeros(values.size, dtype=bool)
    for _ in range(MAX_UNEQUAL_RUN):  # behind a wild sample another one may show
        rows = np.flatnonzero(np.isfinite(left))
        x = left[rows]
        if x.size < MIN_SAMPLES:
            break
        spans = [(k, k + 1) for k in _find_spikes(x)]
        taken = np.zeros(x.size, dtype=bool)
        for first, end in spans:
            taken[first:end] = True
        spans += [(a, b) for a, b in _find_jumping_runs(x) if not taken[a:b].any()]
        if not spans:
            break
        for first, end in spans:
            is_suspect[rows[first] : rows[end - 1] + 1] = True
        left[is_suspect] = np.nan
    return find_stretches(is_suspect)


def _find_limit(sizes: Float1D) -> float:
    """Return the size above which some stand out from all others, which are MIN_STAND_OUT less."""
    present = sizes[sizes > 0.0]
    if present.size < MAX_WILD_SHARE * sizes.size:  # most are none at all
        present = np.append(present, 0.0)
    count = min(max(round(MAX_WILD_SHARE * present.size), 1), present.size - 1)
    if count < 1:
        return np.inf
    top = np.sort(np.partition(present, -count - 1)[-count - 1 :])[::-1]
    stands_out = np.flatnonzero(top[:-1] > MIN_STAND_OUT * top[1:])
    return float(top[stands_out[-1]]) if stands_out.size else np.inf


def _find_spikes(x: Float1D) -> list[int]:
    """Return the single samples that are far from what their four neighbours foretell."""
    deviation = np.zeros(x.size)
    deviation[2:-2] = x[2:-2] - (4.0 * (x[1:-3] + x[3:-1]) - x[:-4] - x[4:]) / 6.0
    size = np.abs(deviation)
    peak = size.copy()
    for shift in (1, 2):  # a spike shows in its neighbours' deviations, too
        peak[shift:] = np.where(size[shift:] < size[:-shift], 0.0, peak[shift:])
        peak[:-shift] = np.where(size[:-shift] < size[shift:], 0.0, peak[:-shift])
    spikes = []
    for k in np.flatnonzero(peak >= _find_limit(peak)).tolist():
        before, after = x[k - 2 : k], x[k + 1 : k + 3]
        roughness = max(abs(np.diff(before)[0]), abs(np.diff(after)[0]), abs(after[0] - before[1]))
        if roughness <= MAX_ROUGHNESS * size[k]:
            spikes.append(k)
    return spikes


def _find_jumping_runs(x: Float1D) -> Iterator[Span]:
    """Yield short runs, or runs of equal samples, between two jumps that stand out."""
    step = np.diff(x)
    jumps = np.flatnonzero(np.abs(step) >= _find_limit(np.abs(step)))
    if not jumps.size:
        return
    edges = [0, *(jumps + 1).tolist(), x.size]
    k = 0
    while k < len(edges) - 1:
        first, end = edges[k], edges[k + 1]
        is_short = end - first <= MAX_UNEQUAL_RUN
        is_equal = (end - first) <= MAX_WILD_SHARE * x.size and np.ptp(x[first:end]) == 0.0
        enters = step[first - 1] if first else -step[end - 1]
        leaves = step[end - 1] if end < x.size else -enters
        if first > 0 and end < x.size:
            returns = abs(x[end] - x[first - 1]) <= 0.5 * min(abs(enters), abs(leaves))
        else:  # what is long at an end, and within the range, is a rest
            rest = x[end:] if first == 0 else x[:first]
            returns = is_short or not rest.min() <= x[first] <= rest.max()
        if (is_short or is_equal) and enters * leaves < 0 and returns:
            yield first, end
            k += 1  # what follows is back
        k += 1


def _find_clipped(name: str, values: Float1D) -> list[Span]:
    """Return the flat parts at the extremes of a channel, if they are cut off there."""
    rows = np.flatnonzero(np.isfinite(values))
    x = values[rows]
    if x.size < MIN_SAMPLES or np.ptp(x) == 0.0:
        return []
    noise = CLIPPING_NOISE * float(np.ptp(x))
    spans: list[Span] = []
    for extreme in (float(x.max()), float(x.min())):
        if extreme == 0.0:
            continue
        depth = np.abs(x - extreme)
        parts = _list_flat_tops(x, depth)
        # between contacts a load cell rests, and has noise there
        is_rest = name in (*RIGHT_CELLS, *LEFT_CELLS) and 2.0 * np.median(depth) < np.ptp(x)
        if not (parts or is_rest):
            parts = _list_flat_tops(x, np.floor(depth / noise), MIN_CUT_OFF * noise)
        spans += [(int(rows[a]), int(rows[b - 1]) + 1) for a, b in parts]
    return sorted(spans)


def _list_flat_tops(x: Float1D, depth: Float1D, least_height: float = 0.0) -> list[Span]:
    """Return the parts of a signal where its depth below an extreme is 0, if it is cut off there.

    `least_height`: of what is cut off, a parabola with the speeds before and after it.
    """
    levels = np.unique(depth)
    runs = find_stretches(depth == 0.0)
    longest = max(end - first for first, end in runs)
    usual = max(
        end - first for level in levels[1:4] for first, end in find_stretches(depth == level)
    )
    is_fine = levels.size > 0.25 * x.size
    least = MIN_CLIPPED_RUN if is_fine and usual == 1 else MIN_LEVEL_RATIO * usual
    if longest < max(least, MIN_CLIPPED_RUN):
        return []
    inner = [(a, b) for a, b in runs if a > 1 and b < x.size - 1]
    at_ends = max((b - a for a, b in runs if a == 0 or b == x.size), default=0)
    if at_ends > MAX_END_RATIO * max((b - a for a, b in inner), default=0):  # it rests there
        return []
    parts = np.array([(a, b) for a, b in inner if b - a >= MIN_CLIPPED_RUN])
    if not parts.size:
        return []
    first, end = parts.T
    speeds = np.sort(np.abs([x[first - 1] - x[first - 2], x[end + 1] - x[end]]), axis=0)
    lowest, highest = np.median(0.25 * (end - first) * speeds, axis=1)
    if usual == 1 and not least_height:  # peaks of a fine channel are flat where they are rounded
        least_height = np.diff(levels).min() * np.median(1.0 + 0.5 * (end - first))
    return inner if least_height <= lowest and highest <= MAX_OVERSHOOT * np.ptp(x) else []


def _find_stuck(channels: Mapping[str, Float1D], name: str) -> list[Span]:
    """Return the runs of equal samples in which the channel should have moved."""
    values = channels[name]
    rows = np.flatnonzero(np.isfinite(values))
    x = values[rows]
    step = np.diff(x)
    moving = step[step != 0.0]
    if not moving.size or moving.size < MIN_SAMPLES // 2:
        return []
    speed = float(np.sqrt(np.mean(moving**2)))
    resolution = float(np.abs(moving).min())
    lasting = np.quantile(np.diff(np.flatnonzero(step)), LASTING_SHARE)
    bends = np.diff(moving)
    is_noisy = np.mean(bends[1:] * bends[:-1] < 0.0) > NOISY_BENDS
    least = MIN_STUCK_RUN if lasting == 1.0 else MIN_STUCK_RATIO * lasting
    is_cell = name in (*RIGHT_CELLS, *LEFT_CELLS)
    spans = []
    for a, b in find_stretches(step == 0.0):
        first, end = a, b + 1  # equal samples
        if end - first < least or (is_cell and x[first] in (0.0, x.min())):
            continue
        jumps = [abs(x[k] - x[k - 1]) for k in (first, end) if 0 < k < x.size]
        is_off = max(jumps) >= max(3.0 * speed, MIN_STUCK_STEP * resolution)
        if x[first] != 0.0:  # at zero it may rest, while others still move
            around = (x[max(first - 5, 0) : first + 1], x[end : end + 6])
            slope = max(abs(float(np.diff(part).mean())) for part in around if part.size > 1)
            is_off |= slope >= MIN_STUCK_SPEED * speed and (
                slope * (end - first) >= MIN_STUCK_STEP * resolution
            )
        # the noise of a fine channel never stops
        is_silent = is_noisy and lasting == 1.0 and end - first >= MIN_SILENT_RUN and x[first] != 0
        span = (int(rows[first]), int(rows[end - 1]) + 1)
        if is_silent or (is_off and _do_others_move(channels, name, *span)):
            spans.append(span)
    return spans


def _do_others_move(channels: Mapping[str, Float1D], name: str, first: int, end: int) -> bool:
    """Return True if another channel moves in a span as it does elsewhere."""
    for other, values in channels.items():
        part = values[first:end]
        if other == name or not np.isfinite(part).any():
            continue
        if np.nanmax(part) - np.nanmin(part) > MIN_OTHER_MOTION * (
            np.nanmax(values) - np.nanmin(values)
        ):
            return True
    return False


def find_hold(values: Float1D) -> float:
    """Return the samples for which each reading of a channel is held, 0.0 if it is not held."""
    x = values[np.isfinite(values)]
    lengths = np.diff(np.flatnonzero(np.diff(x)))
    if lengths.size < MIN_SAMPLES // 2:
        return 0.0
    usual = np.sort(lengths)[: round(MIN_HOLD_SHARE * lengths.size)]  # without rest
    mean = float(usual.mean())
    is_usual = (lengths >= np.floor(mean)) & (lengths <= np.ceil(mean))
    is_held = mean >= MIN_HOLD and is_usual.mean() >= MIN_HOLD_SHARE - 0.01
    return mean if is_held else 0.0


def find_doubts(channels: Mapping[str, Float1D], rate_hz: float) -> list[ChannelDoubt]:
    """Return what makes channels in SI, (sample,) each with NaN in gaps, impossible as they are."""
    judged = {
        name: values
        for name, values in channels.items()
        if name in JUDGED and np.isfinite(values).sum() >= MIN_SAMPLES and np.nanstd(values) > 0.0
    }
    doubts = [*_list_held(judged, rate_hz), *_list_pulling_cells(judged)]
    if doubts:  # it may be the reason for what pairs show
        return doubts
    for list_doubts in (
        _list_swapped,
        _list_mounted,
        _list_drifting,
        _list_pairs,
        _list_active_force,
        _list_swapped_sides,
    ):
        if doubts := [*list_doubts(judged, rate_hz)]:
            return doubts
    return []


def _list_held(channels: Mapping[str, Float1D], rate_hz: float) -> Iterator[ChannelDoubt]:
    for name, values in channels.items():
        if hold := find_hold(values):
            yield ChannelDoubt(
                "held",
                (name,),
                f"{name} holds each reading for {hold:.3g} samples: it was read at "
                f"{rate_hz / hold:.4g} Hz, not at {rate_hz:.6g} Hz",
                f"give a table at {rate_hz / hold:.4g} Hz, or leave the channel out",
            )


def _list_pulling_cells(channels: Mapping[str, Float1D]) -> Iterator[ChannelDoubt]:
    for name in (*RIGHT_CELLS, *LEFT_CELLS):
        if name not in channels:
            continue
        values = channels[name][np.isfinite(channels[name])]
        push, pull = np.quantile(values, 0.999), -np.quantile(values, 0.001)
        noise = float(np.median(np.abs(np.diff(values))))
        if pull > MIN_REVERSED_PULL * max(push, 0.0) and pull > 20.0 * noise:
            yield ChannelDoubt(
                "reversed",
                (name,),
                f"{name} reads down to {-pull:.4g} N and hardly above 0, but compression of a load "
                "cell is positive",
                "state gain = -1.0 for it",
            )


@dataclass(frozen=True, slots=True)
class _PairResponse:
    """A channel against what another one lets expect: correlation at no delay and at the best.

    `gain` is the size over what was expected; `share` what the expectation leaves of the channel,
    at no delay, over the channel itself.
    """

    at_once: float
    best: float
    delay_s: float
    is_delay_sure: bool
    gain: float
    share: float


def _respond(expected: Float1D, read: Float1D, rate_hz: float, order: int) -> _PairResponse | None:
    """Return the response of a reading to the `order`-th derivative of another, (sample,) each.

    Only lines of the spectra count at which both are large. None if there are none.
    """
    lines = _compare_lines(expected, read, rate_hz, order, np.hanning(expected.size))
    if lines is None:
        return None
    omega, g, y, correlation = lines
    cross = np.conj(g) * y
    at_once = float(correlation[0])
    share = float(np.linalg.norm(y - g) / np.linalg.norm(y))
    gain = float(np.linalg.norm(y) / np.linalg.norm(g))
    if abs(at_once) < MIN_CORRELATION:  # a window would not fit a motion seconds later
        lines = _compare_lines(expected, read, rate_hz, order, np.ones(expected.size))
        correlation = lines[3] if lines is not None else correlation
    # A periodic motion is alike a period later: the best delay is large only if it is needed.
    place = int(np.argmax(correlation))
    best = float(correlation[place])
    if best - at_once >= MIN_GAIN_IN_CORRELATION:
        size = correlation.size
        delay_s = (place - size if place > size // 2 else place) / rate_hz
        return _PairResponse(
            at_once, best, delay_s, abs(delay_s) > _max_delay(rate_hz), gain, share
        )
    if omega.size < 4:
        return _PairResponse(at_once, best, 0.0, False, gain, share)
    # the phase of a delay rises with frequency, that of a high pass falls
    weight = np.sqrt(np.abs(cross))
    phase = np.angle(cross) * weight
    delay_s, left = _fit_phase(phase, -omega * weight)
    _, by_high_pass = _fit_phase(phase, weight / omega)
    variance = left / (omega.size - 1) / float(np.sum((omega * weight) ** 2))
    is_sure = abs(delay_s) > _max_delay(rate_hz) + DELAY_SIGMA * float(
        np.sqrt(variance)
    ) and left < MAX_PHASE_LEFT * min(float(phase @ phase), by_high_pass)
    return _PairResponse(at_once, best, delay_s, is_sure, gain, share)


def _fit_phase(phase: Float1D, column: Float1D) -> tuple[float, float]:
    """Return (coefficient of a column by least squares, sum of squares that it leaves)."""
    coefficient = float(column @ phase / (column @ column))
    left = phase - coefficient * column
    return coefficient, float(left @ left)


def _compare_lines(
    expected: Float1D, read: Float1D, rate_hz: float, order: int, window: Float1D
) -> tuple[Float1D, Spectrum, Spectrum, Float1D] | None:
    """Return (angular frequencies, derivative, reading) of the loud lines, and the correlation by
    delay in samples, circular; None without a loud line."""
    size = next_fast_len(expected.size, real=True)
    x, y = (rfft(window * _bridge(values), size) for values in (expected, read))
    omega = 2.0 * np.pi * rate_hz * rfftfreq(size)
    product = np.abs(x * y)  # in a derivative of the first, its hum would be loud
    loud = (product >= LOUD_SHARE * product.max()) & (omega > 0.0)
    g = (1j * omega) ** order * x
    power = float(np.sum(np.abs(g[loud]) ** 2) * np.sum(np.abs(y[loud]) ** 2))
    if not power > 0.0:
        return None
    cross = np.where(loud, np.conj(g) * y, 0.0)
    correlation = irfft(cross, size) * (0.5 * size) / np.sqrt(power)
    return omega[loud], g[loud], y[loud], correlation


def _find_factor(gain: float) -> float:
    """Return the factor of a confusion of units that a gain shows, 0.0 if none."""
    size = max(gain, 1.0 / gain)
    return next((f for f in UNIT_FACTORS if abs(size / f - 1.0) < MAX_FACTOR_ERROR), 0.0)


def _max_delay(rate_hz: float) -> float:
    """Return the largest delay in s that filters and multiplexers explain."""
    return max(MAX_DELAY_S, MAX_DELAY_SAMPLES / rate_hz)


def _bridge(values: Float1D) -> Float1D:
    """Return values less their mean, (sample,), with straight lines in gaps."""
    bridged = interpolate_missing(values)
    return bridged - bridged.mean()


def _list_present_pairs(channels: Mapping[str, Float1D]) -> Iterator[tuple[str, str, Float1D]]:
    """Yield (displacement, name of its acceleration, that acceleration)."""
    for position, accelerations in COMPARED_PAIRS:
        if position in channels and accelerations.keys() <= channels.keys():
            acc = np.sum([sign * channels[name] for name, sign in accelerations.items()], axis=0)
            yield position, " - ".join(accelerations), acc


def _list_pairs(channels: Mapping[str, Float1D], rate_hz: float) -> Iterator[ChannelDoubt]:
    """Yield displacements and accelerations of one body that are not of one motion."""
    for position, name, acc in _list_present_pairs(channels):
        response = _respond(channels[position], acc, rate_hz, 2)
        if response is None:
            continue
        both = (position, *name.split(" - "))
        if response.at_once < -MIN_CORRELATION:
            yield ChannelDoubt(
                "reversed",
                both,
                f"{name} is the second derivative of {position} with the opposite sign "
                f"(correlation {response.at_once:.2f})",
                "state gain = -1.0 for the one that is reversed: right is positive",
            )
        elif unit := _find_factor(response.gain) if response.best > MIN_CORRELATION else 0.0:
            yield ChannelDoubt(
                "unit",
                both,
                f"{name} is {response.gain:.4g} times the second derivative of {position}, as if "
                f"one of their units were wrong by {unit:g}",
                "correct the unit of one of them",
            )
        elif response.is_delay_sure and response.best > SURE_CORRELATION:
            later, earlier = (name, position) if response.delay_s > 0 else (position, name)
            yield ChannelDoubt(
                "delayed",
                both,
                f"{later} is {abs(response.delay_s):.4g} s later than {earlier}",
                "shift it in the table: all channels must have one time",
            )


def _list_mounted(channels: Mapping[str, Float1D], rate_hz: float) -> Iterator[ChannelDoubt]:
    """Yield the laser of a mass that reads mass less table, as one that stands on the table."""
    names = ("mass_disp_m", "mass_acc_m_s2", "table_acc_m_s2")
    if not channels.keys() >= {*names}:
        return
    disp, mass, table = (channels[name] for name in names)
    on_floor, on_table = (_respond(disp, acc, rate_hz, 2) for acc in (mass, mass - table))
    if on_floor is None or on_table is None:
        return
    if on_table.share < MAX_BETTER_SHARE * min(on_floor.share, 1.0):
        yield ChannelDoubt(
            "mounted",
            names,
            "the second derivative of mass_disp_m is the acceleration of the mass less that of the "
            "table: the laser looks mounted on the table",
            "state its column as rel_disp_m in a map",
        )


def _list_drifting(channels: Mapping[str, Float1D], rate_hz: float) -> Iterator[ChannelDoubt]:
    """Yield sensors of one body whose clocks drift apart: their delay changes with time.

    The phases of all parts are fitted by high pass and delay, with a drift and without.
    """
    for position, name, acc in _list_present_pairs(channels):
        phases, columns = [], []
        for first, end in pairwise(np.linspace(0, acc.size, PART_COUNT + 1).astype(int).tolist()):
            read, expected = acc[first:end], channels[position][first:end]
            if not (np.isfinite(read).any() and np.isfinite(expected).any()):
                continue
            lines = _compare_lines(expected, read, rate_hz, 2, np.hanning(read.size))
            if lines is not None:
                omega, g, y, _ = lines
                weight = np.sqrt(np.abs(g * y))
                phases.append(weight * np.angle(np.conj(g) * y))
                middle_s = 0.5 * (first + end) / rate_hz
                columns.append(weight * np.array([1.0 / omega, -omega, -omega * middle_s]))
        if len(phases) < 3:
            continue
        parts = [(y, x.T) for y, x in zip(phases, columns, strict=True)]
        fit, left = _fit_parts(parts)
        steady = _fit_parts([(y, x[:, :2]) for y, x in parts])[1]
        # the lines of a part leak into each other: what counts is how the parts agree
        others = [_fit_parts([*parts[:k], *parts[k + 1 :]])[0][2] for k in range(len(parts))]
        error = math.sqrt((len(parts) - 1) * float(np.var(others)))
        seconds, drift = acc.size / rate_hz, float(fit[2])
        is_sure = abs(drift) * seconds > _max_delay(rate_hz) + DELAY_SIGMA * error * seconds
        if is_sure and left < MAX_PHASE_LEFT * steady:
            yield ChannelDoubt(
                "drifting",
                (position, *name.split(" - ")),
                f"{name} and {position} drift apart by {abs(drift) * seconds:.2g} s in "
                f"{seconds:.4g} s: they are of two clocks, {1e6 * abs(drift):.2g} ppm apart",
                "record both by one clock, or resample the channels of one to the other",
            )


def _fit_parts(parts: Sequence[tuple[Float1D, Float2D]]) -> tuple[Float1D, float]:
    """Return (least squares of all parts, each a vector and a matrix, sum of squares left)."""
    values = np.concatenate([part for part, _ in parts])
    matrix = np.concatenate([part for _, part in parts])
    fit = np.linalg.lstsq(matrix, values)[0]
    return fit, float(np.sum((values - matrix @ fit) ** 2))


def _list_swapped(channels: Mapping[str, Float1D], rate_hz: float) -> Iterator[ChannelDoubt]:
    """Yield channels that stand in each other's place."""
    for first, second in (
        ("mass_disp_m", "table_disp_m"),
        *((position, acc) for position, acc, _ in _list_present_pairs(channels) if " " not in acc),
    ):
        if not {first, second} <= channels.keys():
            continue
        exchanged = {**channels, first: channels[second], second: channels[first]}
        as_is, other = (
            [_respond(c[p], acc, rate_hz, 2) for p, _, acc in _list_present_pairs(c)
             if p in (first, second)]
            for c in (channels, exchanged)
        )  # fmt: skip
        if as_is and all(
            a is not None and b is not None and b.share < MAX_BETTER_SHARE * min(a.share, 1.0)
            for a, b in zip(as_is, other, strict=True)
        ):
            yield ChannelDoubt(
                "swapped",
                (first, second),
                f"{first} and {second} are swapped: the accelerations fit the other one",
                "exchange the columns in a map",
            )


def _list_swapped_sides(channels: Mapping[str, Float1D], _: float) -> Iterator[ChannelDoubt]:
    """Yield load cells that are pressed while the mass is on the other side."""
    if "rel_disp_m" in channels:
        u = channels["rel_disp_m"]
    elif {"mass_disp_m", "table_disp_m"} <= channels.keys():
        u = channels["mass_disp_m"] - channels["table_disp_m"]
    else:
        return
    sides = []
    for cells in (RIGHT_CELLS, LEFT_CELLS):
        forces = [channels[cell] for cell in cells if cell in channels]
        force = np.sum(forces, axis=0) if forces else np.zeros(u.size)
        used = np.isfinite(force) & np.isfinite(u)
        if not used.any() or force[used].std() == 0.0:
            return
        sides.append(float(np.corrcoef(force[used], u[used])[0, 1]))
    if sides[0] < -MIN_SIDE_CORRELATION and sides[1] > MIN_SIDE_CORRELATION:
        yield ChannelDoubt(
            "swapped",
            tuple(cell for cell in (*RIGHT_CELLS, *LEFT_CELLS) if cell in channels),
            "the right load cells are pressed while the mass is left, and the left ones while it "
            "is right",
            "exchange the sides in a map, or state gain = -1.0 for the displacements",
        )


def _list_active_force(channels: Mapping[str, Float1D], rate_hz: float) -> Iterator[ChannelDoubt]:
    """Yield the force of a component that does work, which a passive one cannot, or is late."""
    if not {"damper_force_n", "rel_disp_m"} <= channels.keys():
        return
    both = ("damper_force_n", "rel_disp_m")
    u, force = (_bridge(channels[name]) for name in reversed(both))
    stored, lost, omega = _measure_impedance(u, force, rate_hz)
    size = float(np.hypot(stored.sum(), lost.sum()))
    stiffness, loss = float(stored.sum()), float(lost.sum())
    taken = float(lost[lost > 0.0].sum())
    is_active = loss < -MIN_LOSS * size and taken < MAX_TAKEN_SHARE * -loss
    if stiffness < 0.3 * size and (is_active or (stiffness < 0.0 and loss < 0.3 * size)):
        yield ChannelDoubt(
            "reversed",
            both,
            "damper_force_n does work on the test instead of taking it, which a passive component "
            "cannot: the sign of it or of rel_disp_m is reversed",
            "state gain = -1.0 for one of them",
        )
        return
    delay_s = float(np.arctan2(-loss, stiffness)) / omega
    if not (is_active and (delay_s > _max_delay(rate_hz) or -loss > MIN_WORK * size)):
        delay_s = _find_late_start(u, force, rate_hz)
    if delay_s:
        later, earlier = both if delay_s > 0 else reversed(both)
        yield ChannelDoubt(
            "delayed",
            both,
            f"{later} seems {abs(delay_s):.4g} s later than {earlier}, by the work of the "
            "component; or the two are swapped",
            "shift it in the table: all channels must have one time",
        )


def _measure_impedance(
    u: Float1D, force: Float1D, rate_hz: float
) -> tuple[Float1D, Float1D, float]:
    """Return the parts of a force in phase with a displacement and with its velocity, (part,) each,
    and their common angular frequency in rad/s."""
    parts = []
    weight = moment = 0.0
    for x, f in zip(np.array_split(u, PART_COUNT), np.array_split(force, PART_COUNT), strict=True):
        window = np.hanning(x.size)
        a, b = rfft(window * (x - x.mean())), rfft(window * (f - f.mean()))
        product = np.abs(a * b)
        loud = product >= LOUD_SHARE * product.max()
        cross = np.conj(a[loud]) * b[loud]
        omega = 2.0 * np.pi * rate_hz * rfftfreq(x.size)[loud]
        weight += float(np.abs(cross).sum())
        moment += float(np.sum(omega * np.abs(cross)))
        parts.append(complex(cross.sum()))
    sums = np.array(parts)
    return sums.real, sums.imag, moment / weight


def _find_late_start(u: Float1D, force: Float1D, rate_hz: float) -> float:
    """Return the delay in s with which displacement and velocity explain a force; 0.0 if none."""
    size = next_fast_len(u.size, real=True)
    x, f = rfft(u, size), rfft(force, size)
    omega = 2.0 * np.pi * rate_hz * rfftfreq(size)
    product = np.abs(x * f)
    loud = (product >= 0.1 * LOUD_SHARE * product.max()) & (omega > 0.0)
    explained = np.zeros(size)
    for part in (x, 1j * omega * x):
        cross = np.where(loud, np.conj(part) * f, 0.0)
        power = np.sum(np.abs(part[loud]) ** 2) * np.sum(np.abs(f[loud]) ** 2)
        explained += (irfft(cross, size) * 0.5 * size) ** 2 / power
    place = int(np.argmax(explained))
    lag_s = (place - size if place > size // 2 else place) / rate_hz
    is_needed = explained[place] - explained[0] > MIN_GAIN_IN_CORRELATION
    is_sure = is_needed and explained[place] > MIN_CORRELATION and abs(lag_s) > _max_delay(rate_hz)
    return lag_s if is_sure else 0.0
