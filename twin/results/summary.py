"""summary.json: results of a run, computed from its recording; the keys are a stable interface."""

import json
import math
import tomllib
from collections.abc import Container, Iterable, Mapping
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ValidationError

from table_io.channels import CHANNEL_BY_NAME, Channel
from table_io.config.base import parse_toml
from table_io.config.channel import read_channels
from table_io.config.profile import Profile
from table_io.errors import InputError
from table_io.records import (
    Check,
    Comparison,
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
from twin.compare import COMPARED_CHANNELS
from twin.compare.curves import PrcJump, detect_hysteresis
from twin.compare.extra_channels import select_predicted
from twin.compare.monitoring.cycle import ChannelNoise
from twin.compare.pipeline import EVENT_KINDS
from twin.model.model import Model
from twin.model.parameters import Parameters, free_flight_resonance
from twin.recording.reader import Recording
from twin.results.contract import Contract
from twin.results.contracts import RunSummary
from twin.results.excitation_verdict import judge_excitation
from twin.results.orbits import find_measured_folds, summarise_orbits
from twin.results.table_motion import format_tracking, summarise_tracking
from twin.results.twin_verdict import (
    compare_branches,
    find_clipped_cycles,
    judge_twin,
    list_clipped_channels,
    sum_free_errors,
    summarise_agreement,
)
from twin.results.windows import summarise_windows

Json = dict[str, Any]
ESTIMATE_KEYS = ("value", "sd", "drift", "drift_sd")


def summarise(recording: Recording, parameters: Parameters) -> Json:
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
    clipped = find_clipped_cycles(recording)
    agreement = summarise_agreement(
        recording,
        parameters,
        profile,
        {name: _compared_noise(noise, name) for name in COMPARED_CHANNELS},
        clipped,
    )

    demanded: dict[int, Step | StepAdded] = {step.index: step for step in start.steps}
    demanded |= {addition.step: addition for addition in recording.records(StepAdded)}
    measured_cycles = profile.sweep.measured_cycles if start.steps and points else 0
    free_errors = sum_free_errors(
        recording.records(Comparison),
        points,
        {index: measured_cycles / step.frequency_hz for index, step in demanded.items()},
        start.rate_hz,
    )

    def describe_step(point: PrcPoint) -> Json:
        entry = _step_entry(point)
        if point.step in demanded:
            entry["demanded_m_s2"] = demanded[point.step].acceleration_m_s2
        if point.step in agreement:
            entry["agreement"] = agreement[point.step]
        free_error = free_errors.get(point.step, math.nan)
        branch = compare_branches(point, free_error, noise, u_star)
        return entry | ({} if branch is None else {"branch": branch})

    stop = recording.stop
    summary = {
        "run": _run_entry(recording, profile)
        | {"normalisation": normalisation, "branches_from": source},
        "verdict": stop.verdict if stop else "halted",
        "reason": stop.reason if stop else "the recording ends without a stop record",
        "gaps": len(recording.records(SampleGap)) + (1 if recording.missing_samples else 0),
        "lost_samples": recording.missing_samples,
        "clipped_channels": list_clipped_channels(recording),
        "clipped_steps": sorted({*clipped.values()}),
        "faults": [asdict(fault) for fault in recording.records(Fault)],
        "u_star_m": u_star,
        "a_star_m_s2": a_star,
        "checks": [asdict(check) for check in recording.records(Check)],
        "trips": [asdict(trip) for trip in recording.records(Trip)],
        "planned_steps": len(start.steps),
        "steps": [describe_step(point) | _level_entry(point, levels) for point in planned],
        **_windows_entry(recording, parameters, profile),
        **_orbits_entry(recording, profile),
        # Steps added during the test are not part of the PRC grid.
        "visits": [
            {**describe_step(point), "reason": reasons[point.step]}
            for point in points
            if point.step in reasons
        ],
        "found": [event.text for event in recording.records(Event) if event.kind == "found"],
        "jumps": [asdict(jump) for jump in jumps],
        "hysteresis": [asdict(interval) for interval in intervals],
        "twin_jumps": [asdict(jump) for jump in twin_jumps],
        "twin_hysteresis": [asdict(interval) for interval in twin_intervals],
        "timing": summarise_timing(recording.records(Timing)),
        "comparison": channel_nrmse(
            recording.records(Comparison),
            parameters,
            read_channels(start.rig_toml),
            noise,
        ),
        "estimates": _estimates_entry(recording.records(Estimate)),
        "warnings": _warning_entries(recording, clipped),
    }
    summary["excitation_verdict"] = judge_excitation(summary, profile)
    return summary | {"twin_verdict": judge_twin(summary)}


def _run_entry(recording: Recording, profile: Profile) -> Json:
    """Return what was run, where and when."""
    start, stop = recording.start, recording.stop
    end = stop.index if stop else max((block.end for block in recording.blocks("meas")), default=0)
    samples = max(end - start.index, 0)
    return {
        "id": start.run,
        "name": start.name,
        "title": profile.title,
        "source": start.source,
        "started_at": start.started_at,
        "host": start.host,
        "rate_hz": start.rate_hz,
        "samples": samples,
        "duration_s": samples / start.rate_hz,
        "gap_m": sum(profile.specimen.gaps_m),  # infinite without bumpers: null in the file
        "model": parse_toml_tables(start.model_toml).get("title"),
    }


def _warning_entries(recording: Recording, clipped: Container[int]) -> list[Json]:
    """Return the warnings of the monitoring; `clipped` are ends of cycles with a clipped sensor."""
    return [
        {
            "at_s": event.index / recording.start.rate_hz,
            "kind": event.kind,
            "text": event.text,
            "is_clipped": event.index in clipped,
        }
        for event in recording.records(Event)
        if event.kind in EVENT_KINDS and event.kind != "jump"
    ]


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


def _windows_entry(recording: Recording, parameters: Parameters, profile: Profile) -> Json:
    """Return windows and tracking error of a displacement history; {} for a stepped sine."""
    if recording.start.steps:
        return {}

    channels, noise = read_channels(recording.start.rig_toml), find_channel_noise(recording)

    def compare(comparisons: tuple[Comparison, ...]) -> Json:
        return channel_nrmse(comparisons, parameters, channels, noise)

    windows = summarise_windows(recording, profile.comparison.contact_n, compare)
    return {"windows": windows, "tracking": summarise_tracking(recording, profile)}


def _orbits_entry(recording: Recording, profile: Profile) -> Json:
    """Return the measured orbits of a continuation; {} for other tests."""
    if profile.continuation is None:
        return {}
    plan = profile.continuation.orbit_plan
    orbits = summarise_orbits(recording, plan)
    folds = [] if plan.condition == "phase" else find_measured_folds(orbits)
    return {"orbits": orbits, "folds": folds}


def _estimates_entry(estimates: tuple[Estimate, ...]) -> Json:
    """Return the last parameter estimates of the run, SI; `drift` since the start."""
    if not estimates:
        return {}
    last = estimates[-1]
    rows = zip(last.names, last.values, last.sd, last.drift, last.drift_sd, strict=True)
    return {name: dict(zip(ESTIMATE_KEYS, row, strict=True)) for name, *row in rows}


def _collect_points(
    recording: Recording, parameters: Parameters, profile: Profile
) -> tuple[PrcPoint, ...]:
    """Return the recorded PRC points; recompute the measured part of those lost to a fault."""
    points = {point.step: point for point in recording.records(PrcPoint)}
    if recording.start.steps and recording.records(Fault):
        from twin.compare import pipeline

        setup = pipeline.prepare_pipeline(profile, Model(parameters), recording.start.steps)
        setup = pipeline.add_steps(setup, *recording.records(StepAdded))
        state, _ = pipeline.start_pipeline(setup)
        for block in recording.contiguous_blocks("meas"):
            state, items = pipeline.step(setup, state, block)
            for item in items:
                if isinstance(item, PrcPoint):
                    points.setdefault(item.step, replace(item, twin=None))
    return tuple(points[step] for step in sorted(points))


def _step_entry(point: PrcPoint) -> Json:
    def to_json(values: NormalizedResponse | None) -> Json | None:
        return None if values is None else asdict(values)

    return {
        "index": point.step,
        "direction": point.direction,
        "frequency_hz": point.frequency_hz,
        "measured": to_json(point.measured),
        "twin": to_json(point.twin),
        "table_acc_peak_m_s2": point.table_acc_peak_m_s2,
        "table_acc_fundamental_m_s2": point.table_acc_fundamental_m_s2,
        "thd": point.thd,
    }


def prc_points(steps: Iterable[Json]) -> list[PrcPoint]:
    """Return the PRC points of a summary's steps; a number that is missing or null is NaN."""
    return [
        PrcPoint(
            0, step["index"], step["direction"], step["frequency_hz"],
            _parse_response(step.get("measured")), _parse_response(step.get("twin")),
            *(
                number_or_nan(step.get(name))
                for name in ("table_acc_peak_m_s2", "table_acc_fundamental_m_s2", "thd")
            ),
        )
        for step in steps
    ]  # fmt: skip


def parse_jumps(summary: Json, source: str) -> list[PrcJump]:
    """Return the jumps in a summary, of "measured" or "twin"."""
    key = "jumps" if source == "measured" else "twin_jumps"
    return [PrcJump(**jump) for jump in summary.get(key) or []]


def _parse_response(values: Json | None) -> NormalizedResponse | None:
    if values is None:
        return None
    known: Json = {
        field.name: tuple(values.get(field.name) or ())
        if field.name.startswith("impacts")
        else number_or_nan(values.get(field.name))
        for field in fields(NormalizedResponse)
    }
    return NormalizedResponse(**known)


def number_or_nan(value: float | None) -> float:
    """Return a number of a summary; NaN for null, as JSON has no NaN."""
    return math.nan if value is None else value


def _level_entry(point: PrcPoint, levels: tuple[Level, ...]) -> Json:
    """Return the amplitude control results of a step; {} if its level was not controlled."""
    step_levels = [level for level in levels if level.step == point.step]
    if not step_levels:
        return {}
    last = step_levels[-1]
    measured_m_s2 = point.table_acc_fundamental_m_s2
    return {
        "level": {
            "demanded_m_s2": last.demanded_m_s2,
            "error": measured_m_s2 / last.demanded_m_s2 - 1,
            "error_uncorrected": measured_m_s2 / last.correction / last.demanded_m_s2 - 1,
            "correction": last.correction,
            "updates": last.update,
            "accepted": last.accepted,
        }
    }


def summarise_timing(records: tuple[Timing, ...]) -> Json:
    """Return the twin latency in ms (scheduled last sample of a block to published Comparison).

    Also the missed deadlines and the timing of each component.
    """
    last = {record.component: record for record in records}
    twin = last.get("twin")
    twin = twin if twin is not None and twin.blocks else None
    return {
        "latency_ms": {
            "p50": twin.p50_ms if twin else None,
            "p99": twin.p99_ms if twin else None,
            "max": twin.max_ms if twin else None,
        },
        "missed_deadlines": sum(record.missed for record in last.values()) if last else None,
        "components": {
            name: {key: value for key, value in asdict(record).items() if key != "component"}
            for name, record in last.items()
        },
    }


def find_channel_noise(recording: Recording) -> ChannelNoise:
    """Return the noise of the channels of a recording, from its first samples at rest."""
    noise = ChannelNoise()
    for block in recording.blocks("meas"):
        if noise.is_known:
            break
        noise = noise.add_block(block)
    return noise


def channel_nrmse(
    comparisons: tuple[Comparison, ...],
    parameters: Parameters,
    channels: Mapping[str, Channel],
    noise: ChannelNoise,
) -> Json:
    """Return the NRMSE by channel: `nrmse` of the restarted twin, `free_nrmse` of the free one.

    NRMSE = sqrt(sum of squared errors / sum of squared measurements); that of `mass_disp_m` is over
    the displacement relative to the table, because the motion of the table is measured and no
    prediction. The restarted twin shows the model error; the free one also the divergence between
    solutions. `noise_floor` is what the noise of the sensors alone would leave, as it is at rest.
    None for the force on an absent bumper, which is noise only. `channels` is the registry of the
    rig.
    """
    gaps = {"right_bumper": parameters.gap_r, "left_bumper": parameters.gap_l}
    absent = {
        name
        for name, channel in channels.items()
        if channel.quantity == "force" and math.isinf(gaps.get(channel.body, 0.0))
    }
    extra = (channel.name for channel in select_predicted(channels.values()))
    names = (*COMPARED_CHANNELS, *(name for name in extra if name not in CHANNEL_BY_NAME))
    comparisons = tuple(comparison for comparison in comparisons if comparison.channels == names)
    if not comparisons:
        return {}
    measured, free, window = (
        np.array([getattr(comparison, name) for comparison in comparisons])
        for name in ("measured_ss", "free_error_ss", "window_error_ss")
    )
    measured[:, names.index("mass_disp_m")] = measured[:, names.index("rel_disp_m")]
    counts = np.array([comparison.count for comparison in comparisons])
    entries: Json = {}
    for column, name in enumerate(names):
        values = {}
        for key, error in (("nrmse", window), ("free_nrmse", free)):
            is_known = np.isfinite(error[:, column]) & np.isfinite(measured[:, column])
            total = measured[is_known, column].sum()
            values[key] = (
                math.sqrt(error[is_known, column].sum() / total)
                if total > 0 and name not in absent
                else None
            )
        is_known = np.isfinite(measured[:, column])
        total = measured[is_known, column].sum()
        rms = _compared_noise(noise, name)
        values["noise_floor"] = (
            rms * math.sqrt(counts[is_known].sum() / total)
            if total > 0 and math.isfinite(rms) and name not in absent
            else None
        )
        entries[name] = values
    return entries


def _compared_noise(noise: ChannelNoise, name: str) -> float:
    """Return the noise rms in the error of a compared channel; NaN if it is unknown.

    The error of both displacements of the mass is that of its motion relative to the table.
    """
    if name == "mass_disp_m":
        return noise.laser_difference_rms
    return noise.relative_displacement_rms if name == "rel_disp_m" else noise.channel_rms(name)


def format_summary(summary: Json, planned: int) -> str:
    """Format the result of a run of `planned` steps or orbits in one line."""
    windows = summary.get("windows")
    orbits = summary.get("orbits")
    if orbits is not None:
        accepted = sum(orbit["accepted"] for orbit in orbits)
        done = f"{accepted} of {planned} orbits measured"
    else:
        done = f"{len(summary['steps'])} steps" if windows is None else f"{len(windows)} windows"
    parts = [f"{summary['verdict']}: {done}"]
    if summary.get("tracking"):
        parts.append(format_tracking(summary["tracking"]))
    if summary.get("visits"):
        parts.append(f"{len(summary['visits'])} steps added during the test")
    parts += summary.get("found", [])
    for interval in summary["hysteresis"]:
        parts.append(
            f"{interval['kind']} hysteresis {interval['from_hz']:g} to {interval['to_hz']:g} Hz"
        )
    for jump in summary["jumps"]:
        parts.append(f"jump {jump['kind']} {jump['from_hz']:g} -> {jump['to_hz']:g} Hz")
    error = summary["comparison"].get("rel_disp_m", {}).get("nrmse")
    if error is not None:
        parts.append(f"twin NRMSE of u {100 * error:.2g} %")
    latency = summary["timing"]["latency_ms"]["p99"]
    if latency is not None:
        parts.append(f"latency p99 {latency:.2g} ms")
    parts.append(f"{summary['gaps']} dropouts")
    if summary["faults"]:
        parts.append(f"{len(summary['faults'])} faults")
    if summary["verdict"] != "complete":
        parts.append(summary["reason"])
    return "; ".join(parts)


def write_summary(summary: Json, path: Path) -> None:
    """Write the summary.json of a run."""
    path.write_text(dump_contract(RunSummary, summary) + "\n")


def write_json(content: Json, path: Path) -> None:
    """Write strict JSON; non-finite numbers become null."""
    path.write_text(dump_strict_json(content) + "\n")


def dump_contract(contract: type[Contract], content: Json) -> str:
    """Return strict JSON text as the contract demands.

    ValidationError if a key is unknown or missing, or a value of a wrong type.
    """
    plain = _replace_nonfinite(content)
    contract.model_validate(plain, strict=True)
    return _format_json(plain)


def load_summary(path: Path, contract: type[BaseModel], remedy: str) -> Json:
    """Return the content of a summary.json; InputError if it is missing or breaks the contract."""
    try:
        summary = json.loads(path.read_text(encoding="utf-8"))
        contract.model_validate(summary)
    except FileNotFoundError:
        raise InputError("file not found", where=path, remedy=remedy) from None
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"]))
        raise InputError(first["msg"], where=path, key=key, remedy=remedy) from None
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read the summary: {error}", where=path, remedy=remedy) from None
    return dict(summary)


def dump_strict_json(summary: Json) -> str:
    """Return a summary as strict JSON text; non-finite numbers become null."""
    return _format_json(_replace_nonfinite(summary))


def _format_json(plain: Any) -> str:
    return json.dumps(plain, indent=1, allow_nan=False)


def _replace_nonfinite(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, dict):
        return {key: _replace_nonfinite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_replace_nonfinite(item) for item in value]
    return value
