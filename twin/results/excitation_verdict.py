"""The verdict on the excitation of a run, said once: did the table play the test?

A stepped sine is reached if the fundamental of the table acceleration is within the profile's
`protection.alarm` of the demanded level at every step, a swept sine if it is for MIN_INSIDE of the
time of all its passes; a record if its peak is within
`tracking.required_lower` to `required_upper` of the target's, its rms error is small enough, and a
required spectrum is met; a random motion or multisine, which has a spectrum and no peak to reach,
if MIN_INSIDE of its lines are within `protection.alarm` of their level.
"""

import math
from collections.abc import Iterable

from table_io.config.profile import Profile
from twin.results.contracts import (
    ExcitationVerdict,
    RunSummary,
    SpectrumRatios,
    StepEntry,
    SweptSineResult,
    TrackingResult,
    select_judged_points,
)
from twin.results.table_motion import format_lines

# Of the rms of the target's acceleration, in the band that is judged: beyond it the table has
# played another record, whatever its peak.
MAX_RECORD_ERROR = 0.3
# Of the time of a swept sine, or the lines of a multisine: the rest is for jumps of the specimen.
MIN_INSIDE = 0.95
MAX_PEAK_EXCESS = 0.05  # of the table's peak over its fundamental: half of what harmonics of 8 % do
MIN_DISTORTION = 0.03  # THD above which a raised peak is that of harmonics, not of noise


def judge_excitation(summary: RunSummary, profile: Profile) -> ExcitationVerdict:
    """Return the verdict on the excitation of a run, from its other results."""
    if summary.run.source == "model":
        return _decline("no table was driven")
    if summary.tracking and summary.tracking.lines is not None:
        return _judge_lines(summary.tracking.lines)
    if summary.tracking:
        return _judge_record(summary.tracking, profile)
    if summary.swept_sine is not None:
        return _judge_swept_sine(summary.swept_sine)
    if profile.swept_sine is not None:
        return _decline("the test ended before its frequency moved")
    known = list_level_errors(summary.steps)
    if not known:
        return _decline("the level of no step is known")
    tolerance = profile.protection.alarm
    error, step = max(known, key=lambda entry: abs(entry[0]))
    outside = sum(abs(error) > tolerance for error, _ in known)
    place = f"{100 * error:+.2g} % at {step.frequency_hz:g} Hz {step.direction}"
    reason = f"level within {100 * tolerance:g} % at every step, worst {place}"
    if outside:
        reason = f"level off by more than {100 * tolerance:g} % at {outside} of {len(known)} steps"
        reason += f", worst {place}"
    return ExcitationVerdict(
        verdict="missed" if outside else "reached",
        reason=reason,
        outside=outside,
        worst_error=error,
    )


def _judge_swept_sine(swept: SweptSineResult) -> ExcitationVerdict:
    """Return the verdict on a swept sine: all passes played, and the level held for the time."""
    errors = [
        (point.achieved_m_s2 / point.demanded_m_s2 - 1.0, point)
        for point in select_judged_points(swept.points)
    ]
    outside = sum(abs(error) > swept.tolerance for error, _ in errors)
    error, worst = max(errors, key=lambda entry: abs(entry[0]))
    is_whole = swept.passes == swept.planned_passes
    reason = (
        f"level within {100 * swept.tolerance:g} % for {100 * swept.inside:.4g} % of the time, "
        f"worst {100 * error:+.2g} % at {worst.frequency_hz:.3g} Hz {worst.direction}"
    )
    if not is_whole:
        reason = f"{swept.passes} of {swept.planned_passes} passes; {reason}"
    is_reached = is_whole and swept.inside >= MIN_INSIDE
    return ExcitationVerdict(
        verdict="reached" if is_reached else "missed",
        reason=reason,
        outside=outside,
        worst_error=error,
    )


def list_level_errors(steps: Iterable[StepEntry]) -> list[tuple[float, StepEntry]]:
    """Return the relative error of the level with each step of a summary where it is known."""
    errors = [
        (step.table_acc_fundamental_m_s2 / step.demanded_m_s2 - 1.0, step)
        for step in steps
        if step.demanded_m_s2
    ]
    return [(error, step) for error, step in errors if math.isfinite(error)]


def describe_peaks(steps: Iterable[StepEntry]) -> list[str]:
    """Return a sentence on the peak of the table where its harmonics raise it beyond its level.

    The fundamental is controlled; a level stated as a peak, as in the paper, contains the rest.
    """
    ratios = [
        (step.table_acc_peak_m_s2 / step.table_acc_fundamental_m_s2 - 1.0, step)
        for step in steps
        if step.table_acc_fundamental_m_s2 and step.thd > MIN_DISTORTION
    ]
    raised = [(ratio, step) for ratio, step in ratios if ratio > MAX_PEAK_EXCESS]
    if not raised:
        return []
    ratio, step = max(raised, key=lambda entry: entry[0])
    return [
        f"the peak of the table is more than {100 * MAX_PEAK_EXCESS:g} % above its fundamental at "
        f"{len(raised)} of {len(ratios)} distorted steps, most {100 * ratio:+.2g} % at "
        f"{step.frequency_hz:g} Hz {step.direction} (THD {100 * step.thd:.2g} %): "
        "control.harmonics = true cancels harmonics of the table"
    ]


def _judge_record(tracking: TrackingResult, profile: Profile) -> ExcitationVerdict:
    """Return the verdict on a record from its tracking error."""
    peak, error = tracking.pga_ratio_band, tracking.acc_rms_error_band
    if not math.isfinite(peak + error):
        return _decline("samples of the acceleration of the table are missing")
    low, high = profile.tracking.required_lower, profile.tracking.required_upper
    required = tracking.required_spectrum
    faults = []
    if not low <= peak <= high:
        allowed = f"{100 * low:g} to {100 * high:g} %"
        faults.append(f"PGA {100 * peak:.0f} % of the target, allowed {allowed}")
    if error > MAX_RECORD_ERROR:
        allowed = f"{100 * MAX_RECORD_ERROR:g} %"
        faults.append(f"acceleration {100 * error:.3g} % RMS off its target, allowed {allowed}")
    if required is not None and required.outside:
        faults.append(f"required spectrum missed at {required.outside} ordinates")
    text = f"PGA {100 * peak:.0f} % of the target, acceleration {100 * error:.2g} % RMS off it"
    return ExcitationVerdict(
        verdict="missed" if faults else "reached",
        reason=", ".join(faults) or text,
        outside=len(faults),
        worst_error=error,
    )


def _judge_lines(lines: SpectrumRatios) -> ExcitationVerdict:
    """Return the verdict on a random motion or multisine from the levels of its lines."""
    if lines.outside is None or lines.lowest_ratio is None or lines.highest_ratio is None:
        return _decline("samples of the acceleration of the table are missing")
    return ExcitationVerdict(
        verdict="reached" if lines.outside <= (1.0 - MIN_INSIDE) * lines.count else "missed",
        reason=format_lines(lines),
        outside=lines.outside,
        worst_error=max(lines.lowest_ratio - 1.0, lines.highest_ratio - 1.0, key=abs),
    )


def _decline(reason: str) -> ExcitationVerdict:
    return ExcitationVerdict(verdict="not judged", reason=reason, outside=0, worst_error=None)


def format_excitation_verdict(verdict: ExcitationVerdict) -> str:
    """Return the line of a verdict for the console."""
    return f"excitation {verdict.verdict}: {verdict.reason}"
