"""summary.json: results of a run, computed from its recording; the keys are a stable interface."""

import math
import tomllib
from collections.abc import Container, Iterable, Mapping
from dataclasses import asdict, replace
from functools import partial
from typing import Any

import numpy as np

from table_io.block import Float1D
from table_io.channels import CHANNEL_BY_NAME, Channel
from table_io.config.base import parse_toml
from table_io.config.channel import read_channels
from table_io.config.profile import Profile
from table_io.records import (
    Check,
    Estimate,
    Event,
    Fault,
    Level,
    NormalizedResponse,
    PrcPoint,
    SampleGap,
    Step,
    StepAdded,
    Timing,
    Trip,
)
from twin.compare import COMPARED_CHANNELS, pipeline
from twin.compare.curves import Hysteresis, PrcJump, detect_hysteresis
from twin.compare.extra_channels import select_predicted
from twin.compare.monitoring.cycle import ChannelNoise
from twin.compare.pipeline import EVENT_KINDS
from twin.model.model import Model
from twin.model.parameters import Parameters, free_flight_resonance
from twin.recording.columns import ComparisonTable
from twin.recording.reader import Recording
from twin.results.best_linear import estimate_best_linear, format_best_linear
from twin.results.contracts import (
    ChannelError,
    CheckEntry,
    ComponentTiming,
    FaultEntry,
    HysteresisInterval,
    Jump,
    Latency,
    LevelResult,
    ParameterEstimate,
    Response,
    RunInfo,
    RunSummary,
    StepEntry,
    TimingResult,
    TripEntry,
    WarningEntry,
)
from twin.results.excitation_verdict import judge_excitation
from twin.results.orbits import find_measured_folds, summarise_orbits
from twin.results.swept_sine import format_swept_sine, summarise_swept_sine
from twin.results.table_motion import format_tracking, summarise_tracking
from twin.results.twin_verdict import (
    compare_branches,
    find_clipped_cycles,
    judge_twin,
    list_clipped_channels,
    list_failed_twins,
    sum_free_errors,
    summarise_agreement,
)
from twin.results.windows import summarise_windows

WARNING_KINDS = frozenset(EVENT_KINDS) - {"jump"}
ALARM_KINDS = frozenset({"alarm", "sensor"})


def summarise(recording: Recording, parameters: Parameters) -> RunSummary:
    """Compute the summary of a recording whose twin ran with these parameters."""
    start = recording.start
    profile = parse_toml(start.profile_toml, Profile, "recorded profile")
    u_star, a_star, normalisation = _find_normalisation(start.steps, parameters)
    points = _collect_points(recording, parameters, profile)
    source = "twin" if start.source == "model" else "measured"
    reasons = {addition.step: addition.reason for addition in recording.records(StepAdded)}
    planned = [point for point in points if point.step not in reasons]
    jumps, intervals = detect_hysteresis(planned, source)
    twin_jumps, twin_intervals = detect_hysteresis(planned, "twin")
    levels = recording.records(Level)
    noise = find_channel_noise(recording)
    channels = read_channels(start.rig_toml)
    clipped = find_clipped_cycles(recording)
    failed = list_failed_twins(recording)  # their finite samples alone are no score
    agreement = {}
    if "window" not in failed:
        rms = {name: _compared_noise(noise, name) for name in COMPARED_CHANNELS}
        agreement = summarise_agreement(recording, parameters, profile, rms, clipped)

    demanded: dict[int, Step | StepAdded] = {step.index: step for step in start.steps}
    demanded |= {addition.step: addition for addition in recording.records(StepAdded)}
    measured_cycles = profile.sweep.measured_cycles if start.steps and points else 0
    comparisons = recording.comparisons
    durations = {index: measured_cycles / step.frequency_hz for index, step in demanded.items()}
    free_errors = (
        {} if "free" in failed else sum_free_errors(comparisons, points, durations, start.rate_hz)
    )

    def describe_step(point: PrcPoint) -> StepEntry:
        step = StepEntry(
            index=point.step,
            direction=point.direction,
            frequency_hz=point.frequency_hz,
            measured=_make_response(point.measured),
            twin=_make_response(point.twin),
            table_acc_peak_m_s2=point.table_acc_peak_m_s2,
            table_acc_fundamental_m_s2=point.table_acc_fundamental_m_s2,
            thd=point.thd,
        )
        if point.step in demanded:
            step.demanded_m_s2 = demanded[point.step].acceleration_m_s2
        if point.step in agreement:
            step.agreement = agreement[point.step]
        free_error = free_errors.get(point.step, math.nan)
        branch = compare_branches(point, free_error, noise, u_star)
        if branch is not None:
            step.branch = branch
        if point.step in reasons:
            step.reason = reasons[point.step]
        elif (level := _describe_level(point, levels)) is not None:
            step.level = level
        return step

    stop = recording.stop
    summary = RunSummary(
        run=_describe_run(recording, profile, normalisation, source),
        verdict=stop.verdict if stop else "halted",
        reason=stop.reason if stop else "the recording ends without a stop record",
        gaps=len(recording.records(SampleGap)) + (1 if recording.missing_samples else 0),
        lost_samples=recording.missing_samples,
        clipped_channels=list_clipped_channels(recording),
        clipped_steps=sorted({*clipped.values()}),
        faults=[FaultEntry(**asdict(fault)) for fault in recording.records(Fault)],
        u_star_m=u_star,
        a_star_m_s2=a_star,
        checks=[CheckEntry(**asdict(check)) for check in recording.records(Check)],
        trips=[TripEntry(**asdict(trip)) for trip in recording.records(Trip)],
        planned_steps=len(start.steps),
        steps=[describe_step(point) for point in planned],
        # Steps added during the test are not part of the PRC grid.
        visits=[describe_step(point) for point in points if point.step in reasons],
        found=[event.text for event in recording.records(Event) if event.kind == "found"],
        jumps=make_jumps(jumps),
        hysteresis=make_intervals(intervals),
        twin_jumps=make_jumps(twin_jumps),
        twin_hysteresis=make_intervals(twin_intervals),
        timing=summarise_timing(recording.records(Timing)),
        comparison=channel_nrmse(comparisons, parameters, channels, noise, failed),
        estimates=_list_estimates(recording.records(Estimate)),
        warnings=_list_events(recording, WARNING_KINDS, clipped),
        alarms=_list_events(recording, ALARM_KINDS, clipped),
    )
    if not start.steps:
        compare = partial(
            channel_nrmse, parameters=parameters, channels=channels, noise=noise, failed=failed
        )
        summary.windows = summarise_windows(recording, profile.comparison.contact_n, compare)
        summary.tracking = summarise_tracking(recording, profile)
        if approximations := estimate_best_linear(recording, profile):
            summary.best_linear = approximations
    _add_kind_results(summary, recording, profile)
    summary.excitation_verdict = judge_excitation(summary, profile)
    summary.twin_verdict = judge_twin(summary)
    return summary


def _add_kind_results(summary: RunSummary, recording: Recording, profile: Profile) -> None:
    """Add what only some kinds of excitation have: the level of a swept sine, orbits."""
    if profile.swept_sine is not None:
        swept = summarise_swept_sine(recording, profile, profile.swept_sine)
        if swept is not None:
            summary.swept_sine = swept
    if profile.continuation is not None:
        plan = profile.continuation.orbit_plan
        summary.orbits = summarise_orbits(recording, plan)
        summary.folds = [] if plan.condition == "phase" else find_measured_folds(summary.orbits)


def _describe_run(
    recording: Recording, profile: Profile, normalisation: str, source: str
) -> RunInfo:
    """Return what was run, where and when."""
    start, stop = recording.start, recording.stop
    blocks = recording.contiguous_blocks("meas")
    end = stop.index if stop else max((block.end for block in blocks), default=0)
    samples = max(end - start.index, 0)
    return RunInfo(
        id=start.run,
        name=start.name,
        title=profile.title,
        source=start.source,
        started_at=start.started_at,
        host=start.host,
        rate_hz=start.rate_hz,
        samples=samples,
        duration_s=samples / start.rate_hz,
        gap_m=sum(profile.specimen.gaps_m),  # infinite without bumpers: null
        model=parse_toml_tables(start.model_toml).get("title"),
        normalisation=normalisation,
        branches_from=source,
    )


def _list_events(
    recording: Recording, kinds: Container[str], clipped: Container[int]
) -> list[WarningEntry]:
    """Return the events of some kinds; `clipped` are ends of cycles with a clipped sensor."""
    return [
        WarningEntry(
            at_s=event.index / recording.start.rate_hz,
            kind=event.kind,
            text=event.text,
            is_clipped=event.index in clipped,
        )
        for event in recording.records(Event)
        if event.kind in kinds
    ]


def make_jumps(jumps: Iterable[PrcJump]) -> list[Jump]:
    """Return jumps as entries of a summary."""
    return [Jump(**asdict(jump)) for jump in jumps]


def make_intervals(intervals: Iterable[Hysteresis]) -> list[HysteresisInterval]:
    """Return intervals of hysteresis as entries of a summary."""
    return [HysteresisInterval(**asdict(interval)) for interval in intervals]


def parse_toml_tables(text: str) -> dict[str, Any]:
    """Parse TOML text into its tables by name; return {} if it is not valid TOML."""
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        return {}


def _find_normalisation(
    steps: tuple[Step, ...], parameters: Parameters
) -> tuple[float | None, float | None, str]:
    """Return (u* in m, a* in m/s2, how they are found); None for a displacement history."""
    if not steps:
        return None, None, "none: peaks and rms of a displacement history are given in SI"
    level = max(step.acceleration_m_s2 for step in steps)
    u_star, a_star, peak_hz = free_flight_resonance(parameters, level)
    text = "u* and a* are the maxima of the model in free flight, continuous in frequency"
    return u_star, a_star, f"{text} (at {peak_hz:.3f} Hz, {level:.4g} m/s2)"


def _list_estimates(estimates: tuple[Estimate, ...]) -> dict[str, ParameterEstimate]:
    """Return the last parameter estimates of the run, SI; `drift` since the start."""
    if not estimates:
        return {}
    last = estimates[-1]
    rows = zip(last.names, last.values, last.sd, last.drift, last.drift_sd, strict=True)
    return {
        name: ParameterEstimate(value=value, sd=sd, drift=drift, drift_sd=drift_sd)
        for name, value, sd, drift, drift_sd in rows
    }


def _collect_points(
    recording: Recording, parameters: Parameters, profile: Profile
) -> tuple[PrcPoint, ...]:
    """Return the recorded PRC points; recompute the measured part of those lost to a fault."""
    points = {point.step: point for point in recording.records(PrcPoint)}
    if recording.start.steps and recording.records(Fault):
        setup = pipeline.prepare_pipeline(profile, Model(parameters), recording.start.steps)
        setup = pipeline.add_steps(setup, *recording.records(StepAdded))
        state, _ = pipeline.start_pipeline(setup)
        for block in recording.iter_pieces("meas"):
            state, items = pipeline.step(setup, state, block)
            for item in items:
                if isinstance(item, PrcPoint):
                    points.setdefault(item.step, replace(item, twin=None))
    return tuple(points[step] for step in sorted(points))


def _make_response(values: NormalizedResponse | None) -> Response | None:
    return None if values is None else Response(**asdict(values))


def _make_record(response: Response | None) -> NormalizedResponse | None:
    return None if response is None else NormalizedResponse(**dict(response))


def prc_points(steps: Iterable[StepEntry]) -> list[PrcPoint]:
    """Return the PRC points of a summary's steps; a number that is missing or null is NaN."""
    return [
        PrcPoint(
            0,
            step.index,
            step.direction,
            step.frequency_hz,
            _make_record(step.measured),
            _make_record(step.twin),
            step.table_acc_peak_m_s2,
            step.table_acc_fundamental_m_s2,
            step.thd,
        )
        for step in steps
    ]


def _describe_level(point: PrcPoint, levels: tuple[Level, ...]) -> LevelResult | None:
    """Return the amplitude control results of a step; None if its level was not controlled."""
    step_levels = [level for level in levels if level.step == point.step]
    if not step_levels:
        return None
    last = step_levels[-1]
    measured_m_s2 = point.table_acc_fundamental_m_s2
    return LevelResult(
        demanded_m_s2=last.demanded_m_s2,
        error=measured_m_s2 / last.demanded_m_s2 - 1,
        error_uncorrected=measured_m_s2 / last.correction / last.demanded_m_s2 - 1,
        correction=last.correction,
        updates=last.update,
        accepted=last.accepted,
    )


def summarise_timing(records: tuple[Timing, ...]) -> TimingResult:
    """Return the twin latency in ms (scheduled last sample of a block to published Comparison).

    Also the missed deadlines and the timing of each component.
    """
    last = {record.component: record for record in records}
    twin = last.get("twin")
    twin = twin if twin is not None and twin.blocks else None
    return TimingResult(
        latency_ms=Latency(
            p50=twin.p50_ms if twin else None,
            p99=twin.p99_ms if twin else None,
            max=twin.max_ms if twin else None,
        ),
        missed_deadlines=sum(record.missed for record in last.values()) if last else None,
        components={
            name: ComponentTiming(
                **{key: value for key, value in asdict(record).items() if key != "component"}
            )
            for name, record in last.items()
        },
    )


def find_channel_noise(recording: Recording) -> ChannelNoise:
    """Return the noise of the channels of a recording, from its first samples at rest."""
    noise = ChannelNoise()
    for block in recording.iter_pieces("meas"):
        if noise.is_known:
            break
        noise = noise.add_block(block)
    return noise


def channel_nrmse(
    comparisons: ComparisonTable,
    parameters: Parameters,
    channels: Mapping[str, Channel],
    noise: ChannelNoise,
    failed: Container[str] = (),
) -> dict[str, ChannelError]:
    """Return the NRMSE by channel: `nrmse` of the restarted twin, `free_nrmse` of the free one.

    NRMSE = sqrt(sum of squared errors / sum of squared measurements); that of `mass_disp_m` is over
    the displacement relative to the table, because the motion of the table is measured and no
    prediction. The restarted twin shows the model error; the free one also the divergence between
    solutions. `noise_floor` is what the noise of the sensors alone would leave, as it is at rest.
    None for the force on an absent bumper, which is noise only, and of a twin that is among those
    that `failed`. `channels` is the registry of the rig.
    """
    gaps = {"right_bumper": parameters.gap_r, "left_bumper": parameters.gap_l}
    absent = {
        name
        for name, channel in channels.items()
        if channel.quantity == "force" and math.isinf(gaps.get(channel.body, 0.0))
    }
    extra = (channel.name for channel in select_predicted(channels.values()))
    names = (*COMPARED_CHANNELS, *(name for name in extra if name not in CHANNEL_BY_NAME))
    if comparisons.channels != names:
        return {}
    errors = {}
    for column, name in enumerate(names):
        # The motion of the table is measured and no prediction.
        moving = "rel_disp_m" if name == "mass_disp_m" else name
        measured = comparisons.measured_ss[:, names.index(moving)]
        is_known = np.isfinite(measured)
        total = measured[is_known].sum()
        rms = _compared_noise(noise, name)
        is_comparable = name not in absent
        errors[name] = ChannelError(
            nrmse=_compute_nrmse(comparisons.window_error_ss[:, column], measured)
            if is_comparable and "window" not in failed
            else None,
            free_nrmse=_compute_nrmse(comparisons.free_error_ss[:, column], measured)
            if is_comparable and "free" not in failed
            else None,
            noise_floor=rms * math.sqrt(comparisons.count[is_known].sum() / total)
            if total > 0 and is_comparable
            else None,
        )
        comparisons.release()
    return errors


def _compute_nrmse(error_ss: Float1D, measured_ss: Float1D) -> float | None:
    """Return the root of summed error squares over summed measured ones; None without a motion."""
    is_known = np.isfinite(error_ss) & np.isfinite(measured_ss)
    total = measured_ss[is_known].sum()
    return math.sqrt(error_ss[is_known].sum() / total) if total > 0 else None


def _compared_noise(noise: ChannelNoise, name: str) -> float:
    """Return the noise rms in the error of a compared channel; NaN if it is unknown.

    The error of both displacements of the mass is that of its motion relative to the table.
    """
    if name == "mass_disp_m":
        return noise.laser_difference_rms
    return noise.relative_displacement_rms if name == "rel_disp_m" else noise.channel_rms(name)


def _format_extent(summary: RunSummary, planned: int) -> str:
    """Format what of `planned` steps or orbits was measured."""
    if summary.orbits is not None:
        accepted = sum(orbit.accepted for orbit in summary.orbits)
        return f"{accepted} of {planned} orbits measured"
    if summary.swept_sine is not None:
        return format_swept_sine(summary.swept_sine)
    if summary.windows is not None:
        return f"{len(summary.windows)} windows" if summary.windows else "nothing measured"
    return f"{len(summary.steps)} steps"


def format_summary(summary: RunSummary, planned: int) -> str:
    """Format the result of a run of `planned` steps or orbits in one line."""
    parts = [f"{summary.verdict}: {_format_extent(summary, planned)}"]
    if summary.tracking:
        parts.append(format_tracking(summary.tracking))
    parts += [format_best_linear(result) for result in summary.best_linear]
    if summary.visits:
        parts.append(f"{len(summary.visits)} steps added during the test")
    parts += summary.findings
    for interval in summary.hysteresis:
        parts.append(f"{interval.kind} hysteresis {interval.from_hz:g} to {interval.to_hz:g} Hz")
    for jump in summary.jumps:
        parts.append(f"jump {jump.kind} {jump.from_hz:g} -> {jump.to_hz:g} Hz")
    error = summary.comparison.get("rel_disp_m", ChannelError()).nrmse
    if error is not None:
        parts.append(f"twin NRMSE of u {100 * error:.2g} %")
    latency = summary.timing.latency_ms.p99
    if latency is not None:
        parts.append(f"latency p99 {latency:.2g} ms")
    parts.append(f"{summary.gaps} dropouts")
    if summary.faults:
        parts.append(f"{len(summary.faults)} faults")
    if summary.alarms:
        parts.append(f"{len(summary.alarms)} alarms, the first: {summary.alarms[0].text}")
    if summary.verdict != "complete":
        parts.append(summary.reason)
    return "; ".join(parts)
