"""The verdict on the twin of a run, said once: does it agree with the rig, or depart from it?

It agrees if all of this holds, and every surface shows what is said here:

- The twin restarted from the measured state stays within 3 x noise at rest + 5 % of the amplitude
  (`twin.compare.monitoring.agreement`), step by step. This holds for chaotic motions too, on which
  the free-running twin cannot stay. The median over the held cycles of a step counts, so that
  neither the jump itself nor a filter that settles is a misfit. A bumper touched 0.1 mm too early
  or late belongs to every set-up, so its share of the error is added to the band.
- The free-running twin is on the same branch at every step: eta_d within a tenth and the scatter
  over the cycles, noise and set-up added; where both motions are periodic, with an error below the
  motion itself, that is a phase within 60 degrees.
- Every jump is in its place: within a step of the grid, and within 2 % of its frequency.
- The monitoring has not warned of a disagreement.
- No prediction was without a finite value where the input had one: such a twin has failed.
- The excitation was reached (`excitation_verdict`): else the twin followed another test.

At least half of the measured steps must be judged. A displacement history has no cycles: its NRMSE
is judged, against sqrt(noise^2 + 5 %^2). Forces are not judged by step, because the cells of a side
may share their force unequally; the monitoring judges their sum.

A step in which a sensor of the motion was off its range (clipped) says nothing about the twin.

"Times the noise" is one number everywhere: rms error of u of the restarted twin over the noise at
rest, the median over the steps, and that of the worst step next to it.
"""

import math
import shlex
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from table_io.block import Block, Bool1D, Float1D
from table_io.config.profile import Profile
from table_io.records import MIN_JUMP_RATIO, Agreement, Event, PrcPoint
from twin.compare.monitoring.agreement import (
    AMPLITUDE_TOLERANCE,
    GAP_ERROR_M,
    NOISE_FACTOR,
    detect_contact,
    set_up_allowances,
)
from twin.compare.monitoring.cycle import ChannelNoise
from twin.compare.monitoring.jumps import JUMP_TOLERANCE, measure_separation
from twin.compare.pipeline import FAILURE_KIND, TWIN_TITLES
from twin.model.parameters import Parameters
from twin.recording.columns import ComparisonTable
from twin.recording.reader import Recording
from twin.results.contracts import (
    NOTHING_MEASURED,
    ChannelError,
    HysteresisInterval,
    Jump,
    Phase,
    RunSummary,
    StepBranch,
    StepEntry,
    StepMisfit,
    TwinAgreement,
    TwinVerdict,
    WorstBranch,
    WorstMisfit,
)
from twin.results.quantities import format_quantity

CHANNEL_SYMBOLS = {"rel_disp_m": ("u", "m"), "mass_acc_m_s2": ("a", "m/s2")}
JUDGED_CHANNELS = tuple(CHANNEL_SYMBOLS)
UNKNOWN = (0.0, 0.0, math.nan)  # shares in contact, travel
MOTION_SENSORS = (
    "rel_disp_m", "mass_disp_m", "mass_acc_m_s2", "table_disp_m", "table_acc_m_s2",
)  # fmt: skip
CLIPPING_REACH_S = 1.0  # after which a sensor that was off its range is forgotten
PHASES: tuple[Phase, ...] = ("flight", "contact_right", "contact_left")
DEPARTURE_KIND = "disagreement"  # of warnings
# Range of eta_d over the cycles, relative to its mean, up to which a motion counts as periodic and
# has a phase.
MAX_PERIODIC_SPREAD = 0.05
MAX_FREE_ERROR = 1.0  # of a periodic motion, over the motion itself: a phase of 60 degrees
MAX_UNREMARKABLE_MISFIT = 3.0  # times the noise: beyond it, parameters or effects can be found
HISTORY_TOLERANCE_TEXT = f"{100 * AMPLITUDE_TOLERANCE:g} % of the rms, beyond the noise"
TOLERANCE_TEXT = (
    f"{NOISE_FACTOR:g} x noise at rest + {100 * AMPLITUDE_TOLERANCE:g} % of the amplitude"
    f" + {1e3 * GAP_ERROR_M:g} mm of gap in contact"
)


def summarise_agreement(
    recording: Recording,
    parameters: Parameters,
    profile: Profile,
    noise_rms: Mapping[str, float],
    clipped: Container[int],
) -> dict[int, dict[str, StepMisfit]]:
    """Return by step and channel the error of the restarted twin, its band and its phase.

    The cycle is that with the median of error over band; rms in SI, `misfit` in multiples of the
    noise. Channels without a known error or band are absent, as are cycles of which the end is in
    `clipped`.
    """
    by_step: dict[int, list[Agreement]] = {}
    for record in recording.records(Agreement):
        if record.index not in clipped:
            by_step.setdefault(record.step, []).append(record)
    motion = _measure_motion(recording, profile) if by_step else {}
    return {
        step: _summarise_step(
            records, set_up_allowances(parameters, *motion.get(step, UNKNOWN))[0], noise_rms
        )
        for step, records in by_step.items()
    }


def list_failed_twins(recording: Recording) -> list[str]:
    """Return the names of the twins of which a prediction was not finite on finite input."""
    texts = [event.text for event in recording.records(Event) if event.kind == FAILURE_KIND]
    return [
        name for name, title in TWIN_TITLES.items() if any(text.startswith(title) for text in texts)
    ]


def list_clipped_channels(recording: Recording) -> list[str]:
    """Return the channels of the motion of which samples were off the range of the sensor."""
    clipped = {gap.channel for gap in recording.clipped_gaps}
    return [channel for channel in MOTION_SENSORS if channel in clipped]


def find_clipped_cycles(recording: Recording) -> dict[int, int]:
    """Return the steps with a sensor of the motion off its range, by the ends of their held cycles.

    Or off it within `CLIPPING_REACH_S` before: filters and the restarted twin remember it. All
    cycles of such a step count.
    """
    gaps = [gap for gap in recording.clipped_gaps if gap.channel in MOTION_SENSORS]
    reach = round(CLIPPING_REACH_S * recording.start.rate_hz)
    starts, ends = np.sort([gap.index for gap in gaps]), np.sort([gap.end + reach for gap in gaps])

    def is_clipped(record: Agreement) -> bool:
        begun = np.searchsorted(starts, record.index, "left")
        over = np.searchsorted(ends, record.index - record.count, "right")
        return bool(begun > over)

    records = recording.records(Agreement)
    steps = {record.step for record in records if is_clipped(record)}
    return {record.index: record.step for record in records if record.step in steps}


def _measure_motion(
    recording: Recording, profile: Profile
) -> dict[int, tuple[float, float, float]]:
    """Return by step the shares of held cycles in contact right and left, and the table's travel.

    The travel is half the range of its displacement in m, the median over the held cycles.
    """
    counts: dict[int, Float1D] = {}
    ranges: dict[int, dict[int, tuple[float, float]]] = {}
    for block in recording.iter_pieces("meas"):
        contact = detect_contact(block, profile.comparison.contact_n, profile.specimen.gaps_m)
        _add_cycles(counts, ranges, block, contact)
    return {
        step: (right / total, left / total, _median_half_range(ranges.get(step, {})))
        for step, (total, right, left) in counts.items()
    }


def _add_cycles(
    counts: dict[int, Float1D],
    ranges: dict[int, dict[int, tuple[float, float]]],
    block: Block,
    contact: Iterable[Bool1D],
) -> None:
    """Add the held cycles of a block, in place, in one pass: a recording may have thousands.

    `counts` are the samples by step, in all, in contact right and left; `ranges` are the lowest and
    highest displacement of the table in m by step and cycle.
    """
    changes = np.flatnonzero(np.diff(block.step) | np.diff(block.cycle)) + 1
    starts = np.concatenate([[0], changes])  # of each cycle, and of what lies between
    lengths = np.diff(starts, append=len(block))
    sides = [np.add.reduceat(side.astype(np.int64), starts) for side in contact]
    position = np.full(len(block), np.nan)
    if "table_disp_m" in block.channels:
        position = block.channel("table_disp_m")
        position = np.where(np.isfinite(position), position, np.nan)
    lows, highs = (extreme.reduceat(position, starts) for extreme in (np.fmin, np.fmax))
    for k in np.flatnonzero(block.cycle[starts] >= 0).tolist():
        step, cycle = int(block.step[starts[k]]), int(block.cycle[starts[k]])
        counts[step] = counts.get(step, 0.0) + np.array([lengths[k], *(side[k] for side in sides)])
        if np.isfinite(lows[k]):
            low, high = ranges.setdefault(step, {}).get(cycle, (math.inf, -math.inf))
            ranges[step][cycle] = min(low, float(lows[k])), max(high, float(highs[k]))


def _median_half_range(ranges: Mapping[int, tuple[float, float]]) -> float:
    """Return half the range of a cycle, the median over cycles; NaN without cycles."""
    if not ranges:
        return math.nan
    return float(np.median([0.5 * (high - low) for low, high in ranges.values()]))


def _summarise_step(
    records: Sequence[Agreement], allowance: Mapping[str, float], noise_rms: Mapping[str, float]
) -> dict[str, StepMisfit]:
    misfits = {}
    for column, name in enumerate(records[0].channels):
        known = [
            record
            for record in records
            if math.isfinite(record.error[column]) and record.band[column] > 0
        ]
        if not known or name not in CHANNEL_SYMBOLS:
            continue
        known.sort(key=lambda record: record.error[column] / record.band[column])
        median = known[len(known) // 2]
        phase_errors = [errors[column] for errors in (median.flight, median.right, median.left)]
        is_phase_known = np.isfinite(phase_errors).any()
        noise = noise_rms.get(name, math.nan)
        misfits[name] = StepMisfit(
            error=median.error[column],
            band=median.band[column] + allowance[name],
            misfit=median.error[column] / noise if noise > 0 else None,
            phase=PHASES[int(np.nanargmax(phase_errors))] if is_phase_known else "",
        )
    return misfits


def compare_branches(
    point: PrcPoint, free_error: float, noise: ChannelNoise, u_star_m: float | None
) -> StepBranch | None:
    """Return whether the free twin is on the branch of the specimen at a step; None if unknown.

    `free_error` is its rms error of u over the rms of u, in the measured cycles; `share` is the
    difference of eta_d over its tolerance.
    """
    measured, twin = point.measured, point.twin
    if measured is None or twin is None or not u_star_m:
        return None
    share = measure_separation(point, noise, u_star_m)
    if not math.isfinite(share):
        return None
    is_periodic = max(measured.spread, twin.spread) <= MAX_PERIODIC_SPREAD
    is_opposed = is_periodic and free_error > MAX_FREE_ERROR
    return StepBranch(is_same=share <= 1 and not is_opposed, share=share, free_error=free_error)


def sum_free_errors(
    comparisons: ComparisonTable,
    points: Iterable[PrcPoint],
    measured_s: Mapping[int, float],
    rate_hz: float,
) -> dict[int, float]:
    """Return by step the rms error of u of the free twin over the rms of u; NaN if unknown.

    Over the measured cycles, which last `measured_s` and end where the point of the step was made.
    """
    if JUDGED_CHANNELS[0] not in comparisons.channels:
        return {}
    column = comparisons.channels.index(JUDGED_CHANNELS[0])
    ends = comparisons.index + comparisons.count
    sums = comparisons.free_error_ss, comparisons.measured_ss
    squares = np.stack([part[:, column] for part in sums], axis=1)
    squares[~np.isfinite(squares).all(axis=1)] = 0.0  # lost samples, or before the start
    error, motion = np.vstack([np.zeros(2), np.cumsum(squares, axis=0)]).T
    ratios = {}
    for point in points:
        start = point.index - measured_s.get(point.step, 0.0) * rate_hz
        first, last = np.searchsorted(ends, [start + 0.5, point.index + 0.5])
        total = motion[last] - motion[first]
        ratio = (error[last] - error[first]) / total if total > 0 else math.nan
        ratios[point.step] = math.sqrt(ratio) if ratio >= 0 else math.nan
    return ratios


def judge_twin(summary: RunSummary) -> TwinVerdict:
    """Return the verdict on the twin of a run, from its other results alone."""
    worst = _find_worst(summary)
    outside = [step for step in summary.steps if any(share > 1 for share in _band_shares(step))]
    grid = sorted({step.frequency_hz for step in summary.steps})
    missing = _list_unmatched(summary.twin_jumps, summary.jumps, summary.hysteresis, grid)
    unexpected = _list_unmatched(summary.jumps, summary.twin_jumps, summary.twin_hysteresis, grid)
    apart = [*_list_steps_apart(summary)]
    worst_branch = max(apart, key=lambda place: place.departure, default=None)
    departures = [
        warning
        for warning in summary.warnings
        if warning.kind == DEPARTURE_KIND and not warning.is_clipped
    ]
    judged = _count_judged(summary)
    failures = [warning.text for warning in summary.warnings if warning.kind == FAILURE_KIND]
    reasons = failures[:1]
    if outside:
        reasons.append(f"{len(outside)} of {judged} steps outside the tolerance")
    elif worst and worst.share > 1:
        reasons.append("the history is outside the tolerance")
    if worst_branch:
        count = f"{len(apart)} step{'s' if len(apart) > 1 else ''}"
        reasons.append(f"another response at {count}: {describe_branch(worst_branch)}")
    reasons += [
        f"{count} {noun}{'s' if count > 1 else ''}"
        for count, noun in (
            (len(missing), "missing jump"),
            (len(unexpected), "unexpected jump"),
            (len(departures), "warning"),
        )
        if count
    ]
    planned = _count_planned(summary)
    misfits = _list_misfits(summary)
    misfit = float(np.median(misfits)) if misfits else None
    verdict: TwinAgreement = "not judged"
    if failures and summary.run.source == "model":
        pass
    elif summary.run.source == "model" or not (worst or apart or failures):
        reasons = [_explain_no_tolerance(summary)]
    elif not planned and summary.clipped_channels and not failures:
        reasons = [f"off the range of their sensor: {', '.join(summary.clipped_channels)}"]
    elif reasons:
        verdict = "departs"
    else:
        verdict, reasons = _judge_agreement(summary, judged, misfit)
    if worst and judged < planned:
        reasons.append(f"{judged} of {planned} steps judged")
    if worst and summary.clipped_steps:
        reasons.append(f"{len(summary.clipped_steps)} steps with a sensor off its range")
    return TwinVerdict(
        verdict=verdict,
        reason=", ".join(reasons),
        tolerance=TOLERANCE_TEXT if planned else HISTORY_TOLERANCE_TEXT,
        worst=worst,
        worst_branch=worst_branch,
        steps_outside=len(outside),
        steps_apart=len(apart),
        steps_judged=judged,
        misfit=misfit,
        misfit_worst=max(misfits, default=None),
        missing_jumps=missing,
        unexpected_jumps=unexpected,
        warnings=len(summary.warnings),
        next_command=_suggest_command(summary, verdict, misfit),
    )


def _judge_agreement(
    summary: RunSummary, judged: int, misfit: float | None
) -> tuple[TwinAgreement, list[str]]:
    """Return the verdict on a twin of which nothing departs, and its reasons."""
    if 2 * judged < len(summary.steps):
        return "not judged", ["too few steps can be judged"]
    reasons = ["within the tolerance"]
    if summary.steps and summary.verdict == "complete":
        reasons.append("on the same branch at every step, every jump in its place")
    if _is_remarkable(misfit):
        reasons.append(f"but u differs by {misfit:.2g} times the noise")
    if summary.excitation_verdict and summary.excitation_verdict.verdict == "missed":
        return "not judged", [*reasons, "but the table did not play this test"]
    return "agrees", reasons


def _list_steps_apart(summary: RunSummary) -> Iterator[WorstBranch]:
    """Yield the steps at which the free twin is on another branch than the specimen.

    But those between a jump and its counterpart, where one came a step of the grid later.
    """
    for step in summary.steps:
        branch, measured, twin = step.branch, step.measured, step.twin
        if branch is None or branch.is_same or step.index in summary.clipped_steps:
            continue
        if (
            measured is None
            or twin is None
            or any(
                _is_between(step, jump, other)
                for jump in summary.jumps
                for other in summary.twin_jumps
                if _is_same_jump(jump, other)
            )
        ):
            continue
        yield WorstBranch(
            step=step.index,
            direction=step.direction,
            frequency_hz=step.frequency_hz,
            measured=measured.eta_d,
            twin=twin.eta_d,
            free_error=branch.free_error,
        )


def _is_between(step: StepEntry, jump: Jump, other: Jump) -> bool:
    """Return whether a step lies after one of two jumps and before the other."""
    first, last = sorted((jump.to_hz, other.to_hz))
    if step.direction != jump.direction:
        return False
    if step.direction == "forward":
        return first <= step.frequency_hz < last
    return first < step.frequency_hz <= last


def describe_branch(place: WorstBranch) -> str:
    """Describe a step at which the twin responds in another way than the specimen."""
    kind = "opposite in phase"
    if place.measured != place.twin and (place.free_error or 0.0) <= MAX_FREE_ERROR:
        kind = "another amplitude"
    if place.departure >= MIN_JUMP_RATIO:
        kind = "another branch"
    return (
        f"{place.frequency_hz:g} Hz {place.direction}, {kind}, eta_d {place.measured:.3f} "
        f"measured, {place.twin:.3f} of the twin"
    )


def _band_shares(step: StepEntry) -> list[float]:
    """Return error over band of the judged channels of a step."""
    return [step.agreement[name].share for name in JUDGED_CHANNELS if name in step.agreement]


def _count_judged(summary: RunSummary) -> int:
    return sum(bool(_band_shares(step)) for step in summary.steps)


def _count_planned(summary: RunSummary) -> int:
    """Return the planned steps, without a plan the measured ones; 0 for a history."""
    return max(summary.planned_steps, len(summary.steps))


def _explain_no_tolerance(summary: RunSummary) -> str:
    """Return the reason why nothing of a run can be judged."""
    error = _find_error(summary, JUDGED_CHANNELS[0])
    is_compared = summary.run.source != "model" and error.nrmse
    if not is_compared or not _count_planned(summary):
        return NOTHING_MEASURED
    if len(summary.clipped_steps) == len(summary.steps) > 0:
        return "a sensor was off its range in every step"
    if error.noise_floor:
        return "no step has a whole cycle of twin and rig to compare"
    return "the noise of the sensors is unknown, so no step has a tolerance"


def _find_error(summary: RunSummary, channel: str) -> ChannelError:
    return summary.comparison.get(channel, ChannelError())


def _find_worst(summary: RunSummary) -> WorstMisfit | None:
    """Return the step and channel, or of a history the channel, with the largest misfit."""
    places = [
        (step, name) for step in summary.steps for name in JUDGED_CHANNELS if name in step.agreement
    ]
    if places:
        step, name = max(places, key=lambda place: place[0].agreement[place[1]].share)
        misfit = step.agreement[name]
        return WorstMisfit(
            step=step.index,
            direction=step.direction,
            frequency_hz=step.frequency_hz,
            channel=name,
            share=misfit.share,
            **dict(misfit),
        )
    if _count_planned(summary):
        return None
    errors = {name: _find_error(summary, name) for name in JUDGED_CHANNELS}
    shares = {
        name: error.nrmse / math.hypot(error.noise_floor or 0.0, AMPLITUDE_TOLERANCE)
        for name, error in errors.items()
        if error.nrmse is not None
    }
    if not shares:
        return None
    name = max(shares, key=lambda channel: shares[channel])
    return WorstMisfit(
        step=None,
        direction=None,
        frequency_hz=None,
        channel=name,
        share=shares[name],
        error=None,
        band=None,
        misfit=errors[name].noise_multiple,
        phase="",
    )


def _list_misfits(summary: RunSummary) -> list[float]:
    """Return the misfit of u in multiples of the noise at each step.

    Of a displacement history, one: NRMSE over noise floor.
    """
    entries = [step.agreement.get(JUDGED_CHANNELS[0]) for step in summary.steps]
    misfits = [entry.misfit for entry in entries if entry is not None and entry.misfit]
    if misfits:
        return misfits
    multiple = _find_error(summary, JUDGED_CHANNELS[0]).noise_multiple
    return [] if multiple is None else [multiple]


def format_misfit(verdict: TwinVerdict | None) -> str:
    """Format the misfit of u in multiples of the noise: median and worst step; "" if unknown."""
    if verdict is None or verdict.misfit is None:
        return ""
    median, worst = verdict.misfit, verdict.misfit_worst
    text = f"{median:.2g} times the noise"
    return text if worst is None or worst == median else f"{text} (worst step {worst:.2g})"


def _list_unmatched(
    jumps: Sequence[Jump],
    others: Sequence[Jump],
    intervals: Sequence[HysteresisInterval],
    grid: Sequence[float],
) -> list[Jump]:
    """Return the jumps without a counterpart among those of the other source.

    A jump into the last step of the sweep is not judged if the other's hysteresis, `intervals`,
    reaches that end: the counterpart may lie beyond.
    """

    def leaves_range(jump: Jump) -> bool:
        end = grid[-1] if jump.direction == "forward" else grid[0]
        reached = any(end in (interval.from_hz, interval.to_hz) for interval in intervals)
        return jump.to_hz == end and reached

    return [
        jump
        for jump in jumps
        if not leaves_range(jump) and not any(_is_same_jump(jump, other) for other in others)
    ]


def _is_same_jump(jump: Jump, other: Jump) -> bool:
    """Return whether two jumps are one: within a step of the grid, and within 2 % of frequency."""
    if (jump.direction, jump.kind) != (other.direction, other.kind):
        return False
    grid_step_hz = abs(jump.to_hz - jump.from_hz)
    tolerance_hz = min(grid_step_hz, JUMP_TOLERANCE * jump.to_hz)
    return abs(jump.to_hz - other.to_hz) <= tolerance_hz * (1 + 1e-9)


def _is_remarkable(misfit: float | None) -> bool:
    return misfit is not None and misfit > MAX_UNREMARKABLE_MISFIT


def _suggest_command(summary: RunSummary, verdict: str, misfit: float | None) -> str:
    """Return the command to type next; DIR stands for the folder of the run."""
    if summary.verdict != "complete":
        return "shaketwin verify DIR"
    if verdict == "departs" and any(warning.kind == "instrument" for warning in summary.warnings):
        return "shaketwin identify DIR"  # judges the instruments too
    if verdict == "departs" or (verdict == "agrees" and _is_remarkable(misfit)):
        return "shaketwin discover DIR"
    return "shaketwin view DIR"


def format_twin_verdict(verdict: TwinVerdict, folder: Path) -> list[str]:
    """Return the lines of a verdict for the console: verdict, worst place, jumps, next command."""
    lines = [f"twin {verdict.verdict}: {verdict.reason}"]
    if misfit := format_misfit(verdict):
        lines.append(f"misfit of u: {misfit}")
    if verdict.worst:
        lines.append(f"worst: {describe_worst(verdict.worst)}; tolerance {verdict.tolerance}")
    lines += [f"missing: {format_jump(jump)}" for jump in verdict.missing_jumps]
    lines += [f"unexpected: {format_jump(jump)}" for jump in verdict.unexpected_jumps]
    return [*lines, f"next: {name_command(verdict, folder)}"]


def name_command(verdict: TwinVerdict, folder: Path) -> str:
    """Return the next command with the folder of the run in place of DIR."""
    return verdict.next_command.replace("DIR", shlex.quote(str(folder)))


def describe_worst(worst: WorstMisfit) -> str:
    """Describe the worst place of a verdict: where, by how much, in multiples of the noise."""
    symbol, unit = CHANNEL_SYMBOLS[worst.channel]
    parts = []
    if worst.step is not None:
        parts.append(f"{worst.frequency_hz:g} Hz {worst.direction}, step {worst.step + 1}")
    phase = worst.phase.replace("_", " ")
    parts.append(f"{symbol} {f'in {phase}' if phase else ''}".strip())
    if worst.error is not None:
        parts.append(f"misfit {format_quantity(worst.error, unit)} rms")
    if worst.misfit is not None:
        parts.append(f"{worst.misfit:.3g} times the noise")
    return ", ".join([*parts, f"{worst.share:.2g} times the tolerance"])


def format_jump(jump: Jump) -> str:
    """Format a jump as direction, kind and the grid frequencies that it lies between."""
    return f"{jump.direction} jump {jump.kind}, {jump.from_hz:g} to {jump.to_hz:g} Hz"
