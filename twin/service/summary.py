"""summary.json: what a run found, from its recording alone. Keys as users script against them."""

import json
import math
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from table_io.card import parse
from table_io.channels import LEFT_CELLS, RIGHT_CELLS
from table_io.profile import Profile
from table_io.records import (
    Check,
    Comparison,
    Decided,
    Estimate,
    Event,
    Fault,
    Gap,
    Level,
    Point,
    Quantities,
    Timing,
    Trip,
)
from twin.compare import COMPARED
from twin.compare.curves import branches
from twin.compare.watch import KINDS as WATCHED
from twin.model.model import Model
from twin.model.parameters import Parameters, resonance
from twin.stream.recording import Recording

Json = dict[str, Any]
ESTIMATED = ("value", "sd", "drift", "drift_sd")


def summarise(recording: Recording, parameters: Parameters) -> Json:
    """The summary of a recording whose twin ran with these parameters."""
    start = recording.start
    profile = parse(start.profile_toml, Profile, "recorded profile")
    level = max(step.acceleration_m_s2 for step in start.steps)
    u_star, a_star, peak_hz = resonance(parameters, level)
    points = _points(recording, parameters, profile)
    source = "twin" if start.source == "model" else "measured"
    reasons = {one.step: one.reason for one in recording.of(Decided)}
    planned = [point for point in points if point.step not in reasons]
    jumps, intervals = branches(planned, source)
    twin_jumps, twin_intervals = branches(planned, "twin")
    looks = recording.of(Level)
    stop = recording.stop
    end = stop.index if stop else max((one.end for one in recording.blocks("meas")), default=0)
    samples = max(end - start.index, 0)
    return {
        "run": {
            "id": start.run,
            "name": start.name,
            "title": profile.title,
            "source": start.source,
            "started_at": start.started_at,
            "host": start.host,
            "rate_hz": start.rate_hz,
            "samples": samples,
            "duration_s": samples / start.rate_hz,
            "normalisation": (
                f"u* and a* are the maxima of the model in free flight, continuous in frequency "
                f"(at {peak_hz:.3f} Hz, {level:.4g} m/s2)"
            ),
            "branches_from": source,
        },
        "verdict": stop.verdict if stop else "halted",
        "reason": stop.reason if stop else "the recording ends without a stop record",
        "gaps": len(recording.of(Gap)) + (1 if recording.missing_samples else 0),
        "lost_samples": recording.missing_samples,
        "faults": [asdict(fault) for fault in recording.of(Fault)],
        "u_star_m": u_star,
        "a_star_m_s2": a_star,
        "checks": [asdict(check) for check in recording.of(Check)],
        "trips": [asdict(trip) for trip in recording.of(Trip)],
        "steps": [_step(point) | _level(point, looks) for point in planned],
        # What a test decided on as it went: no points of a curve.
        "visits": [
            {**_step(point), "reason": reasons[point.step]}
            for point in points
            if point.step in reasons
        ],
        "found": [event.text for event in recording.of(Event) if event.kind == "found"],
        "jumps": [asdict(jump) for jump in jumps],
        "hysteresis": [asdict(interval) for interval in intervals],
        "twin_jumps": [asdict(jump) for jump in twin_jumps],
        "twin_hysteresis": [asdict(interval) for interval in twin_intervals],
        "timing": _timing(recording.of(Timing)),
        "comparison": nrmse(recording.of(Comparison), parameters),
        "estimates": _estimates(recording.of(Estimate)),
        "warnings": [
            {"at_s": event.index / start.rate_hz, "kind": event.kind, "text": event.text}
            for event in recording.of(Event)
            if event.kind in WATCHED and event.kind != "jump"
        ],
    }


def _estimates(told: tuple[Estimate, ...]) -> Json:
    """The specimen as last identified while the test ran, SI; `drift` since the start."""
    if not told:
        return {}
    last = told[-1]
    rows = zip(last.names, last.values, last.sd, last.drift, last.drift_sd, strict=True)
    return {name: dict(zip(ESTIMATED, row, strict=True)) for name, *row in rows}


def _points(recording: Recording, parameters: Parameters, profile: Profile) -> tuple[Point, ...]:
    """The recorded points, and the measured part of those that a dead twin could not make."""
    recorded = {point.step: point for point in recording.of(Point)}
    if recording.of(Fault):
        from twin.compare import pipeline

        setup = pipeline.prepare(profile, Model(parameters), recording.start.steps)
        setup = pipeline.knowing(setup, *recording.of(Decided))
        state, _ = pipeline.start(setup)
        for block in recording.pieces("meas"):
            state, items = pipeline.step(setup, state, block)
            for item in items:
                if isinstance(item, Point):
                    recorded.setdefault(item.step, replace(item, twin=None))
    return tuple(recorded[step] for step in sorted(recorded))


def _step(point: Point) -> Json:
    def block(values: Quantities | None) -> Json | None:
        return None if values is None else asdict(values)

    return {
        "index": point.step,
        "direction": point.direction,
        "frequency_hz": point.frequency_hz,
        "measured": block(point.measured),
        "twin": block(point.twin),
        "table_acc_peak_m_s2": point.table_acc_peak_m_s2,
        "table_acc_fundamental_m_s2": point.table_acc_fundamental_m_s2,
        "thd": point.thd,
    }


def _level(point: Point, looks: tuple[Level, ...]) -> Json:
    """How the level of a step was reached; empty where nobody looked."""
    own = [one for one in looks if one.step == point.step]
    if not own:
        return {}
    last = own[-1]
    reached = point.table_acc_fundamental_m_s2
    return {
        "level": {
            "demanded_m_s2": last.demanded_m_s2,
            "error": reached / last.demanded_m_s2 - 1,
            "error_uncorrected": reached / last.correction / last.demanded_m_s2 - 1,
            "correction": last.correction,
            "updates": last.update,
            "accepted": last.accepted,
        }
    }


def _timing(records: tuple[Timing, ...]) -> Json:
    """Latency of the twin: last sample of a block scheduled -> its Comparison put."""
    last = {record.component: record for record in records}
    twin = last.get("twin")
    twin = twin if twin is not None and twin.blocks else None  # nobody timed it
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


def nrmse(comparisons: tuple[Comparison, ...], parameters: Parameters) -> Json:
    """Root of error squares over measured squares; `nrmse` of the restarted twin, and of the free.

    The restarted twin measures the model; the free one also carries where two solutions part.
    A load cell where there is no bumper measures its own noise: nothing to compare, null.
    """
    absent = {
        cell
        for cells, gap in ((RIGHT_CELLS, parameters.gap_r), (LEFT_CELLS, parameters.gap_l))
        for cell in cells
        if math.isinf(gap)
    }
    comparisons = tuple(one for one in comparisons if one.channels == COMPARED)
    if not comparisons:
        return {}
    measured, free, window = (
        np.array([getattr(one, name) for one in comparisons])
        for name in ("measured_ss", "free_error_ss", "window_error_ss")
    )
    out: Json = {}
    for place, name in enumerate(COMPARED):
        values = {}
        for key, error in (("nrmse", window), ("free_nrmse", free)):
            known = np.isfinite(error[:, place]) & np.isfinite(measured[:, place])
            total = measured[known, place].sum()
            values[key] = (
                math.sqrt(error[known, place].sum() / total)
                if total > 0 and name not in absent
                else None
            )
        out[name] = values
    return out


def sentence(found: Json) -> str:
    """What happened in a run, in one line."""
    parts = [f"{found['verdict']}: {len(found['steps'])} steps"]
    if found.get("visits"):
        parts.append(f"{len(found['visits'])} visits decided on as it went")
    parts += found.get("found", [])
    for interval in found["hysteresis"]:
        parts.append(
            f"{interval['kind']} hysteresis {interval['from_hz']:g} to {interval['to_hz']:g} Hz"
        )
    for jump in found["jumps"]:
        parts.append(f"jump {jump['kind']} {jump['from_hz']:g} -> {jump['to_hz']:g} Hz")
    error = found["comparison"].get("rel_disp_m", {}).get("nrmse")
    if error is not None:
        parts.append(f"twin NRMSE of u {100 * error:.2g} %")
    latency = found["timing"]["latency_ms"]["p99"]
    if latency is not None:
        parts.append(f"latency p99 {latency:.2g} ms")
    parts.append(f"{found['gaps']} gaps")
    if found["faults"]:
        parts.append(f"{len(found['faults'])} faults")
    if found["verdict"] != "complete":
        parts.append(found["reason"])
    return "; ".join(parts)


def write(summary: Json, path: Path) -> None:
    """Write a summary as strict JSON: what is not a number becomes null."""
    path.write_text(dumps(summary) + "\n")


def dumps(summary: Json) -> str:
    """Strict JSON text of a summary."""
    return json.dumps(_clean(summary), indent=1, allow_nan=False)


def _clean(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, dict):
        return {key: _clean(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_clean(one) for one in value]
    return value
