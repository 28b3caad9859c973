"""Sections of the web page: the values of `RunView` as JSON.

A section is sent again only when its text has changed. Numbers are in the units that the page
shows; unknown ones are null.
"""

import json
import math
from dataclasses import asdict

import numpy as np

from twin.monitor.run_view import Progress, RunView, eta_d, margin_tone
from twin.viewer.view_model import describe_channel

MAX_PAGE_EVENTS = 50
SIGNIFICANT_DIGITS = 5
Section = dict[str, object]


def build_sections(view: RunView) -> dict[str, str]:
    """Return the JSON text of every section by its name."""
    with np.errstate(all="ignore"):  # received numbers may have any size
        sections = _collect_sections(view)
    return {
        name: json.dumps(_round_numbers(section), allow_nan=False, separators=(",", ":"))
        for name, section in sections.items()
    }


def _round_numbers(value: object) -> object:
    """Return a section with `SIGNIFICANT_DIGITS` of each number, None for those not finite."""
    match value:
        case float():
            return float(f"{value:.{SIGNIFICANT_DIGITS}g}") if math.isfinite(value) else None
        case dict():
            return {key: _round_numbers(entry) for key, entry in value.items()}
        case list() | tuple():
            return [_round_numbers(entry) for entry in value]
    return value


def _collect_sections(view: RunView) -> dict[str, Section]:
    progress, plot, forecast = view.progress, view.plot(eta_d), view.forecast
    connection: Section = {
        "dropouts": view.dropouts,
        "components": sorted(view.components.elements()),
    }
    jump = (
        None
        if forecast is None
        else {key: getattr(forecast, key) for key in ("kind", "jump_hz", "low_hz", "high_hz")}
    )
    return {
        "run": {
            "run": view.run_state.run,
            "name": view.name,
            "title": view.title,
            "rig": view.rig_title,
        },
        "state": asdict(progress) | connection | _whole_seconds(progress),
        "level": {} if view.level is None else asdict(view.level),
        "margins": {"rows": _list_margins(view)},
        "trace": _collect_traces(view),
        "prc": {
            "label": plot.label,
            "count": plot.count,
            "curves": [
                {"source": curve.source, "direction": curve.direction, "points": curve.points}
                for curve in plot.curves
            ],
            "range_hz": plot.range_hz,
            "step_hz": plot.step_hz,
            "forecast": jump,
        },
        "twin": {"rows": _list_twin_rows(view)},
        "events": {"rows": _list_events(view)},
        "timing": {"rows": [asdict(timing) for timing in view.timings]},
    }


def _whole_seconds(progress: Progress) -> Section:
    """Return the times of a test as integers, which are not rounded to significant digits."""
    left_s = None if progress.left_s is None else int(progress.left_s)
    return {"time_s": int(progress.time_s), "left_s": left_s}


def _list_margins(view: RunView) -> list[Section]:
    return [
        {
            "name": describe_channel(margin.name).label,
            "peak": margin.peak,
            "limit": margin.limit,
            "unit": margin.unit,
            "share": margin.share,
            "tone": margin_tone(margin),
        }
        for margin in view.margins or ()
    ]


def _collect_traces(view: RunView) -> Section:
    """Return u in mm and the contact force in kN over time in s, relative to the last sample."""
    traces = view.traces
    end = traces["measured"][0, -1] if traces else 0.0
    return {
        "span_s": view.trace_span_s,
        "tracks": {
            name: {
                "t": ((index - end) / view.run_state.rate_hz).tolist(),
                "u": (1e3 * u).tolist(),
                "force": (1e-3 * force).tolist(),
            }
            for name, (index, u, force) in traces.items()
        },
    }


def _list_twin_rows(view: RunView) -> list[Section]:
    """Return RMS, error of the restarted twin and its band of each compared channel."""
    rows = []
    for row in view.twin_rows:
        label, unit, size = describe_channel(row.channel)
        numbers = {key: getattr(row, key) / size for key in ("rms", "error", "band", "free")}
        rows.append({"name": label, "unit": unit, **numbers, "exceeds": row.exceeds})
    return rows


def _list_events(view: RunView) -> list[Section]:
    return [
        {
            "time_s": int(event.index / view.run_state.rate_hz),
            "level": event.level,
            "text": event.text,
        }
        for event in view.events[:MAX_PAGE_EVENTS]
    ]
