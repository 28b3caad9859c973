"""Motion of the table against its target: tracking error of a run, and its required spectrum."""

import math
from dataclasses import dataclass

import numpy as np

from table_io.block import Block, Float1D, Label
from table_io.config.excitation import History, history_acceleration
from table_io.config.excitation.record import RecordedHistory
from table_io.config.excitation.synthetic import BandLimitedRandom
from table_io.config.profile import Profile
from table_io.config.tracking import RequiredSpectrum, TrackingConfig
from twin.recording.reader import Recording
from twin.results.contracts import (
    RequiredSpectrumResult,
    SpectrumRatios,
    TrackingError,
    TrackingResult,
)
from twin.results.spectra import (
    USUAL_PER_OCTAVE,
    compute_response_spectrum,
    list_octave_frequencies,
)
from twin.results.tracking import MAX_BAND_RATIO, MAX_LAG_S, find_record_error, judge_tracking
from twin.results.windows import find_windows, join_channel


@dataclass(frozen=True, slots=True, eq=False)
class TableMotion:
    """Target and achieved motion of the table, (sample,) each in SI, from sample `first` on.

    `start` and `end` are the samples of the recording between which the history was played; the
    rest around it is part of the motion, as far as it was recorded and no more than MAX_LAG_S. Lost
    samples of the achieved motion are NaN.
    """

    rate_hz: float
    first: int
    start: int
    end: int
    target_disp_m: Float1D
    target_acc_m_s2: Float1D
    achieved_disp_m: Float1D
    achieved_acc_m_s2: Float1D

    @property
    def time_s(self) -> Float1D:
        """Time in the recording, (sample,)."""
        return (self.first + np.arange(self.target_disp_m.size)) / self.rate_hz


def find_table_motion(recording: Recording, profile: Profile) -> TableMotion | None:
    """Return the motion of the table of a displacement history; None of other tests.

    None too if nothing was measured, the test ended before the history moved, or the recording
    lacks its begin, without which the target has no place in time.
    """
    blocks = recording.contiguous_blocks("meas")
    windows = find_windows(blocks)
    excitation, rate_hz = profile.excitation, recording.start.rate_hz
    if not isinstance(excitation, History) or not windows or recording.start.source != "table":
        return None
    history = excitation.target(rate_hz)
    start = min(first for first, _ in windows.values())
    end = min(max(last for _, last in windows.values()), start + history.size)
    margin = round(MAX_LAG_S * rate_hz)
    before = _count_rest(blocks, range(start - 1, start - 1 - margin, -1))
    if 0 not in windows or (before == 0 and start > recording.start.index):
        return None
    is_whole = end == start + history.size
    after = _count_rest(blocks, range(end, end + margin)) if is_whole else 0
    target = np.pad(history[: end - start], (before, after))
    acceleration = np.pad(history_acceleration(history, rate_hz)[: end - start], (before, after))
    first = start - before
    achieved_disp, achieved_acc = (
        extract_channel(blocks, name, first, end + after)
        for name in ("table_disp_m", "table_acc_m_s2")
    )
    if not acceleration.any() or not np.isfinite(achieved_acc).any():
        return None
    return TableMotion(
        rate_hz, first, start, end, target, acceleration, achieved_disp, achieved_acc
    )


def _count_rest(blocks: tuple[Block, ...], samples: range) -> int:
    """Return how many samples, in this order, were recorded at rest without a break."""
    at_rest: set[int] = set()
    low, high = min(samples), max(samples) + 1
    for block in blocks:
        if block.index < high and low < block.end:
            part = block.cut(max(low, block.index), min(high, block.end))
            at_rest |= set((np.flatnonzero(part.label == Label.REST) + part.index).tolist())
    for count, sample in enumerate(samples):
        if sample not in at_rest:
            return count
    return len(samples)


def extract_channel(blocks: tuple[Block, ...], name: str, first: int, end: int) -> Float1D:
    """Return a channel at the samples first .. end - 1, NaN where there is none."""
    values = np.full(end - first, np.nan)
    for block in blocks:
        if block.index < end and first < block.end:
            part = block.cut(max(first, block.index), min(end, block.end))
            values[part.index - first : part.end - first] = join_channel([part], name)
    return values


def summarise_tracking(recording: Recording, profile: Profile) -> TrackingResult | None:
    """Return the error of the table against its target; None without a target."""
    motion = find_table_motion(recording, profile)
    if motion is None:
        return None
    config = profile.tracking
    band_hz = config.band_hz
    if band_hz is not None and band_hz[1] > motion.rate_hz / 2:
        band_hz = None  # of a recording at another rate than that of the profile
    has_displacement = bool(np.isfinite(motion.achieved_disp_m).any())
    error = judge_tracking(
        motion.target_acc_m_s2,
        motion.achieved_acc_m_s2,
        motion.rate_hz,
        band_hz,
        damping=config.damping,
        target_disp=motion.target_disp_m if has_displacement else None,
        achieved_disp=motion.achieved_disp_m,
    )
    required = config.spectrum
    return TrackingResult(
        **dict(error),
        acc_rms_error_record=_judge_by_record(motion, profile, error),
        from_s=motion.start / motion.rate_hz,
        to_s=motion.end / motion.rate_hz,
        required_spectrum=None if required is None else _check_required(motion, required, config),
        lines=check_lines(motion, profile),
    )


def _judge_by_record(motion: TableMotion, profile: Profile, error: TrackingError) -> float:
    """Return the error of the table in the band against the record itself; NaN without one."""
    excitation = profile.excitation
    record = (
        excitation.record_acceleration(motion.rate_hz)
        if isinstance(excitation, RecordedHistory)
        else None
    )
    if record is None:
        return math.nan
    return find_record_error(
        record, motion.target_acc_m_s2, motion.achieved_acc_m_s2, motion.rate_hz,
        error.band_hz, error.lag_s,
    )  # fmt: skip


def list_required_frequencies(required: RequiredSpectrum, rate_hz: float) -> Float1D:
    """Return the frequencies in Hz, 1/6 octave apart, at which a spectrum is checked, (k,)."""
    low_hz, high_hz = required.frequencies_hz[[0, -1]].tolist()
    high_hz = min(high_hz, MAX_BAND_RATIO * rate_hz)
    if high_hz < low_hz:
        return np.empty(0)
    return list_octave_frequencies(low_hz, high_hz, USUAL_PER_OCTAVE)


def _check_required(
    motion: TableMotion, required: RequiredSpectrum, config: TrackingConfig
) -> RequiredSpectrumResult:
    """Return the check of the spectrum of the table against the required one."""
    hz = list_required_frequencies(required, motion.rate_hz)
    ratios = np.full(hz.size, np.nan)
    if hz.size and np.isfinite(motion.achieved_acc_m_s2).all():
        spectrum = compute_response_spectrum(
            motion.achieved_acc_m_s2, motion.rate_hz, hz, config.damping
        )
        ratios = spectrum / required.interpolate(hz)
    result = _find_extremes(hz, ratios, (config.required_lower, config.required_upper))
    return RequiredSpectrumResult(**dict(result), passed=result.outside == 0)


def check_lines(motion: TableMotion, profile: Profile) -> SpectrumRatios | None:
    """Return the amplitude of each excited line over that asked for, rms of the whole periods.

    None of an excitation without lines, and if no period was played to its end.
    """
    excitation, rate_hz = profile.excitation, motion.rate_hz
    if not isinstance(excitation, BandLimitedRandom):
        return None
    count = round(excitation.duration_s * rate_hz)
    starts = motion.start - motion.first + excitation.list_starts(rate_hz).ravel()
    starts = starts[starts + count <= motion.end - motion.first]
    if not starts.size:
        return None
    lines = excitation.list_lines(rate_hz)
    target, achieved = (
        np.linalg.norm(np.fft.rfft(row[starts[:, None] + np.arange(count)])[:, lines], axis=0)
        for row in (motion.target_acc_m_s2, motion.achieved_acc_m_s2)
    )
    alarm = profile.protection.alarm
    return _find_extremes(lines * rate_hz / count, achieved / target, (1.0 - alarm, 1.0 + alarm))


def _find_extremes(hz: Float1D, ratios: Float1D, allowed: tuple[float, float]) -> SpectrumRatios:
    """Return the extremes of ratios at frequencies in Hz, (frequency,); NaN: samples are lost."""
    known = bool(hz.size) and bool(np.isfinite(ratios).all())
    lowest, highest = (int(np.argmin(ratios)), int(np.argmax(ratios))) if known else (0, 0)
    outside = np.count_nonzero((ratios < allowed[0]) | (ratios > allowed[1]))
    return SpectrumRatios(
        lower=allowed[0],
        upper=allowed[1],
        count=hz.size,
        outside=int(outside) if known else None,
        lowest_ratio=float(ratios[lowest]) if known else None,
        lowest_hz=float(hz[lowest]) if known else None,
        highest_ratio=float(ratios[highest]) if known else None,
        highest_hz=float(hz[highest]) if known else None,
    )


def format_tracking(tracking: TrackingResult) -> str:
    """Format the tracking error of a summary in one sentence: RMS, PGA, SA, lag, RRS."""
    low_hz, high_hz = tracking.band_hz
    band = f"{low_hz:.2g} to {high_hz:.2g} Hz"
    own = tracking.acc_rms_error_record
    parts = [
        f"table acceleration {_format_percent(tracking.acc_rms_error_band)} RMS off its target "
        f"in {band} ({_format_percent(tracking.acc_rms_error_full)} in full"
        + (f", {_format_percent(own)} off the record itself)" if math.isfinite(own) else ")"),
    ]
    if tracking.lines is not None:
        parts.append(format_lines(tracking.lines))
    else:
        parts.append(
            f"PGA {_format_percent(tracking.pga_ratio_band)} of it "
            f"({_format_percent(tracking.pga_ratio_full)})"
        )
    if tracking.sa_count and tracking.lines is None:
        inside = round(tracking.sa_share * tracking.sa_count)
        parts.append(f"{inside} of {tracking.sa_count} SA within 10 %")
    parts.append(f"lag {1e3 * tracking.lag_s:.3g} ms")
    if tracking.lost_samples:
        parts.append(f"{tracking.lost_samples} samples lost")
    if tracking.required_spectrum is not None:
        parts.append(format_required(tracking.required_spectrum))
    return ", ".join(parts)


def format_lines(lines: SpectrumRatios) -> str:
    """Format the check of the lines of a multisine."""
    if lines.lowest_ratio is None or lines.highest_ratio is None:
        return "level of its lines unknown"
    low, high = _format_percent(lines.lowest_ratio), _format_percent(lines.highest_ratio)
    return (
        f"{lines.outside} of {lines.count} lines are off their level by more than "
        f"{_format_percent(1.0 - (lines.lower or 0.0))}; they have {low} of it at "
        f"{lines.lowest_hz:.3g} Hz to {high} at {lines.highest_hz:.3g} Hz"
    )


def format_required(required: RequiredSpectrumResult) -> str:
    """Format the check of a required spectrum."""
    if required.outside is None:
        return "required spectrum not checked"
    if required.passed:
        return "required spectrum met"
    return f"required spectrum missed at {required.outside} of {required.count} ordinates"


def _format_percent(ratio: float) -> str:
    return f"{100 * ratio:.3g} %" if math.isfinite(ratio) else "–"
