"""Sections of the web page: what the terminal monitor shows, as numbers in JSON.

A section is sent again only when its text has changed. Numbers are in the units that the page
shows; unknown ones are null.
"""

import json
import math
from collections.abc import Iterable

import numpy as np

from table_io.config.excitation.stepped_sine import Sweep
from table_io.records import Agreement, JumpForecast, Level
from table_io.units import GRAVITY_M_S2
from twin.monitor.curves import eta_d, select_prc_values
from twin.monitor.margins import compute_live_margins
from twin.monitor.panels import (
    ALARM_SHARE,
    BAD_STYLE,
    DIM_STYLE,
    GOOD_STYLE,
    WARN_SHARE,
    WARN_STYLE,
    SessionStatus,
    component_label,
    describe_channel,
)
from twin.monitor.run_state import LiveRunState
from twin.monitor.screen import describe_activity, describe_state

TONES = {GOOD_STYLE: "good", WARN_STYLE: "warn", BAD_STYLE: "bad", DIM_STYLE: "dim"}
MAX_PAGE_EVENTS = 50
TRACE_CYCLES = 3.0  # shown of the last cycles
IDLE_TRACE_S = 2.0  # shown outside a step
SIGNIFICANT_DIGITS = 5
Section = dict[str, object]


def build_sections(run_state: LiveRunState, status: SessionStatus) -> dict[str, str]:
    """Return the JSON text of every section by its name."""
    with np.errstate(all="ignore"):  # received numbers may have any size
        sections = _collect_sections(run_state, status)
    return {
        name: json.dumps(section, allow_nan=False, separators=(",", ":"))
        for name, section in sections.items()
    }


def _collect_sections(run_state: LiveRunState, status: SessionStatus) -> dict[str, Section]:
    return {
        "run": _describe_run(run_state),
        "state": _describe_progress(run_state, status),
        "level": _compare_level(run_state),
        "margins": {"rows": _list_margins(run_state), "warn": WARN_SHARE, "alarm": ALARM_SHARE},
        "trace": _collect_traces(run_state),
        "prc": _collect_curves(run_state),
        "twin": {"rows": _compare_twin(run_state)},
        "events": {"rows": _list_events(run_state)},
        "timing": {"rows": _list_timings(run_state)},
    }


def round_number(value: float | None) -> float | None:
    """Return a number with `SIGNIFICANT_DIGITS`, None if it is unknown or not finite."""
    if value is None or not math.isfinite(value):
        return None
    return float(f"{value:.{SIGNIFICANT_DIGITS}g}")


def _round_all(values: Iterable[float]) -> list[float | None]:
    return [round_number(value) for value in values]


def _describe_run(run_state: LiveRunState) -> Section:
    start, profile, rig = run_state.start, run_state.profile, run_state.rig
    return {
        "run": run_state.run,
        "name": start.name if start else "",
        "title": profile.title if profile else "",
        "rig": rig.title if rig else "",
    }


def _describe_progress(run_state: LiveRunState, status: SessionStatus) -> Section:
    state, style = describe_state(run_state, status)
    step, profile = run_state.step, run_state.profile
    cycles = profile.sweep.cycles if profile and isinstance(profile.excitation, Sweep) else None
    names = (component_label(name, run_state.run) for name in status.components)
    return {
        "state": state,
        "tone": TONES.get(style, ""),
        "held": run_state.rig_state == "holding",
        "activity": describe_activity(run_state),
        "time_s": round(run_state.index / run_state.rate_hz, 1),
        "progress": round_number(run_state.progress),
        "left_s": round(run_state.remaining_s, 1) if run_state.progress is not None else None,
        "step": None if step is None else step.index + 1,
        "steps": run_state.step_count,
        "frequency_hz": step and round_number(step.frequency_hz),
        "direction": step and step.direction,
        "cycle": run_state.position[2] + 1 if run_state.position[2] >= 0 else None,
        "cycles": cycles,
        "ended": run_state.stop is not None,
        "reason": run_state.stop.reason if run_state.stop else "",
        "dropouts": sum(count for _, count in run_state.gaps.values()),
        "components": sorted(names),
    }


def _compare_level(run_state: LiveRunState) -> Section:
    """Return the level of the table in g against demand, with the bounds of the protection."""
    step, level, profile = run_state.step, run_state.get_latest(Level), run_state.profile
    if step is None:
        return {}
    current = run_state.recent.table_level(step.frequency_hz)
    section: Section = {
        "demanded_g": round_number(step.acceleration_m_s2 / GRAVITY_M_S2),
        "current_g": None if current is None else round_number(current / GRAVITY_M_S2),
    }
    if profile is not None:
        section |= {
            "tolerance": profile.control.tolerance,
            "alarm": profile.protection.alarm,
            "abort_db": profile.protection.abort_db,
        }
    if level is not None and level.step == step.index:
        section |= {
            "accepted": level.accepted,
            "updates": level.update,
            "correction": round_number(level.correction),
        }
    return section


def _list_margins(run_state: LiveRunState) -> list[Section]:
    """Return the peaks of the last second relative to their limits."""
    if run_state.rig is None or run_state.profile is None or run_state.start is None:
        return []
    margins = compute_live_margins(
        run_state.rig, run_state.profile, run_state.start.tare, run_state.recent
    )
    return [
        {
            "name": describe_channel(margin.name)[0],
            "peak": round_number(margin.peak),
            "limit": round_number(margin.limit),
            "unit": margin.unit,
            "share": round_number(margin.share),
        }
        for margin in margins
    ]


def _collect_traces(run_state: LiveRunState) -> Section:
    """Return u in mm and the contact force in kN over time in s, relative to the last sample."""
    rate_hz, step = run_state.rate_hz, run_state.step
    span_s = TRACE_CYCLES / step.frequency_hz if step is not None else IDLE_TRACE_S
    tracks = run_state.traces.select_last(span_s * rate_hz)
    end = tracks["measured"][0, -1] if tracks else 0.0
    scales = {"t": 1.0 / rate_hz, "u": 1e3, "force": 1e-3}
    return {
        "span_s": round_number(span_s),
        "tracks": {
            name: {
                quantity: _round_all((scale * values).tolist())
                for (quantity, scale), values in zip(
                    scales.items(), (rows[0] - end, rows[1], rows[2]), strict=True
                )
            }
            for name, rows in tracks.items()
        },
    }


def _collect_curves(run_state: LiveRunState) -> Section:
    """Return the PRC so far, or the measured orbits over those of the plan, over frequency."""
    start, profile, step = run_state.start, run_state.profile, run_state.step
    points = sorted(run_state.points.values(), key=lambda point: point.step)
    frequencies_hz = [planned.frequency_hz for planned in start.steps] if start else []
    frequencies_hz += [point.frequency_hz for point in points]
    section: Section = {
        "label": "η_d",
        "count": len(points),
        "curves": [
            {"source": source, "direction": direction, "points": [*map(_round_all, samples)]}
            for source in ("twin", "measured")
            for direction in ("forward", "backward")
            if (samples := select_prc_values(points, source, direction, eta_d))
        ],
    }
    if profile is not None and profile.continuation is not None:
        planned = profile.continuation.orbit_plan.points
        frequencies_hz = [orbit.frequency_hz for orbit in planned]
        curves = {("twin", "forward"): planned} | {
            ("orbit", "forward" if is_accepted else "backward"): [
                orbit for orbit in run_state.orbits.values() if orbit.accepted is is_accepted
            ]
            for is_accepted in (True, False)
        }
        section = {
            "label": "amplitude in mm",
            "count": len(run_state.orbits),
            "curves": [
                {
                    "source": source,
                    "direction": direction,
                    "points": [
                        _round_all((orbit.frequency_hz, 1e3 * orbit.amplitude_m))
                        for orbit in orbits
                    ],
                }
                for (source, direction), orbits in curves.items()
            ],
        }
    forecast = run_state.get_latest(JumpForecast)
    return section | {
        "range_hz": [min(frequencies_hz), max(frequencies_hz)] if frequencies_hz else None,
        "step_hz": step and round_number(step.frequency_hz),
        "forecast": None
        if forecast is None
        else {
            "kind": forecast.kind,
            "jump_hz": round_number(forecast.jump_hz),
            "low_hz": round_number(forecast.low_hz),
            "high_hz": round_number(forecast.high_hz),
        },
    }


def _compare_twin(run_state: LiveRunState) -> list[Section]:
    """Return RMS, error of the restarted twin and its band of each compared channel."""
    errors, agreement = run_state.recent.twin_errors(), run_state.get_latest(Agreement)
    bands: dict[str, tuple[float, float]] = {}
    if agreement is not None:
        pairs = zip(agreement.error, agreement.band, strict=True)
        bands = dict(zip(agreement.channels, pairs, strict=True))
    rows = []
    for name in dict.fromkeys((*errors, *bands)):
        label, unit, size = describe_channel(name)
        rms, window, free = errors.get(name, (math.nan,) * 3)
        error, band = bands.get(name, (window, math.nan))
        numbers = {"rms": rms, "error": error, "band": band, "free": free}
        row: Section = {"name": label, "unit": unit}
        row |= {key: round_number(value / size) for key, value in numbers.items()}
        rows.append(row | {"exceeds": math.isfinite(band) and error > band})
    return rows


def _list_events(run_state: LiveRunState) -> list[Section]:
    """Return warnings and events, the newest first."""
    events = sorted(run_state.events.values(), key=lambda event: -event.index)
    return [
        {
            "time_s": round(event.index / run_state.rate_hz, 1),
            "level": event.level,
            "text": event.text,
        }
        for event in events[:MAX_PAGE_EVENTS]
    ]


def _list_timings(run_state: LiveRunState) -> list[Section]:
    """Return the latency in ms of each component."""
    return [
        {
            "component": timing.component,
            "p50": round_number(timing.p50_ms),
            "p99": round_number(timing.p99_ms),
            "max": round_number(timing.max_ms),
            "missed": timing.missed,
        }
        for timing in sorted(run_state.timings.values(), key=lambda timing: timing.component)
    ]
