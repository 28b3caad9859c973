"""Figures in a page: panels described for `charts.js`, which draws them with uPlot.

A page holds the marks of every panel with their limits, and columns of numbers. Long columns are
reduced to what a screen can show: of every piece of a line the samples that reach farthest.
"""

import base64
import html
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from table_io.block import Float1D
from twin.drawing.panels import AXES_COORDINATES, Call, CaptionedFigure, FigurePanel, PanelFigure

MAX_POINTS = 1200  # of a line in a page
MAX_PLAIN_COLUMN = 300  # numbers that are written as text; longer columns in 16 bits each
MISSING_CODE = 65535  # of 16 bits: no number
LIMIT_MARGIN = 0.05  # of the range of the data around it
PIXELS_PER_INCH, MIN_HEIGHT_PX = 100.0, 130.0
TEXT_DIGITS = 7  # of numbers as text
NAMED_DASHES: Mapping[Any, list[float]] = {"-": [], "--": [4.0, 2.0], ":": [1.0, 1.6]}
GREEK_LETTERS = {
    "eta": "η",
    "varphi": "φ",
    "zeta": "ζ",
    "omega": "ω",
    "Delta": "Δ",
    "gamma": "γ",
    "mu": "µ",
}
SCRIPT_FOLDER = Path(__file__).parent


def make_chart_script(figures: Iterable[CaptionedFigure]) -> Markup:
    """Return the script of a page that draws the figures into the elements of their names."""
    columns: list[Any] = []
    described = [
        {"name": each.name, **_describe_figure(each.figure, columns)}
        for each in figures
        if isinstance(each.figure, PanelFigure)
    ]
    data = json.dumps({"columns": columns, "figures": described}, separators=(",", ":"))
    scripts = (
        (SCRIPT_FOLDER / name).read_text(encoding="utf-8") for name in ("uplot.js", "charts.js")
    )
    text = f"const CHARTS={data};\n{''.join(scripts)}".replace("</", r"<\/")
    return Markup(f"<script>{text}</script>")


def _describe_figure(figure: PanelFigure, columns: list[Any]) -> dict[str, Any]:
    names = {_describe_style(key.style)["id"]: key.label for key in figure.keys}
    limits = _find_limits(figure)
    height_px = PIXELS_PER_INCH * (figure.size_in[1] - 0.6) / sum(figure.heights)
    rows: list[list[dict[str, Any]]] = [[] for _ in figure.heights]
    for row, column, panel in figure.list_panels():
        described = _describe_panel(panel, names, columns, limits[row, column][0])
        described["height"] = round(max(MIN_HEIGHT_PX, height_px * figure.heights[row]))
        described["width"] = figure.widths[column]
        described["x"], described["y"] = limits[row, column]
        if figure.sharex:
            described["link"] = column if figure.sharex == "col" else 0
        rows[row].append(described)
    keys = [
        {"label": _format_label(key.label), "patch": key.is_patch} | _describe_style(key.style)
        for key in figure.keys
    ]
    return {"rows": rows, "keys": keys}


def _describe_panel(
    panel: FigurePanel, names: Mapping[str, str], columns: list[Any], x_limits: Sequence[float]
) -> dict[str, Any]:
    """Return labels, scales and marks of a panel."""
    described: dict[str, Any] = {"marks": [], "keys": []}
    for key in ("title", "xlabel", "ylabel"):
        texts = [call.arguments[0] for call in panel.find(f"set_{key}")]
        described[key] = _format_label(texts[-1]) if texts else ""
    described["absolute"] = any(panel.find("set_absolute_labels"))
    described["log"] = ["log" in scales for scales in _find_scales(panel)]
    for call in panel.calls:
        mark = _describe_mark(call, columns, x_limits)
        if mark is None:
            continue
        style = _describe_style(call.style)
        label = call.style.get("label") or names.get(style["id"], "")
        described["marks"].append({**style, **mark, "label": _format_label(label)})
    if any(panel.find("legend")):
        labelled = (mark for mark in described["marks"] if mark["label"])
        described["keys"] = [{k: v for k, v in mark.items() if k not in "xy"} for mark in labelled]
    return described


def _find_scales(panel: FigurePanel) -> tuple[set[str], set[str]]:
    x, y = ({call.arguments[0] for call in panel.find(f"set_{axis}scale")} for axis in "xy")
    return x, y


def _describe_mark(
    call: Call, columns: list[Any], x_limits: Sequence[float]
) -> dict[str, Any] | None:
    """Return what a call draws, None for one that draws nothing."""
    a = call.arguments
    match call.name:
        case "plot":
            x, y = np.asarray(a[0], float), np.asarray(a[1], float)
            shown = np.flatnonzero((x >= x_limits[0]) & (x <= x_limits[1]))
            if shown.size:
                part = slice(max(0, shown[0] - 1), shown[-1] + 2)
                x, y = reduce_line(x[part], y[part])
            return {"kind": "line", "x": _add(columns, x), "y": _add(columns, y)}
        case "fill_between":
            low, high = (np.broadcast_to(np.asarray(v, float), np.shape(a[0])) for v in a[1:])
            x, low, high = reduce_envelope(np.asarray(a[0], float), low, high)
            return {"kind": "fill"} | {
                key: _add(columns, values)
                for key, values in zip("xyz", (x, low, high), strict=True)
            }
        case "vlines" | "errorbar":
            x, low, high = (np.broadcast_to(np.asarray(v, float), np.shape(a[0])) for v in a)
            if call.name == "errorbar":
                low, high = low - high, low + high
            return {"kind": "bars"} | {
                key: _add(columns, values)
                for key, values in zip("xyz", (x, low, high), strict=True)
            }
        case "axhline" | "axvline":
            return {"kind": call.name[2] + "line", "at": _round(a[0])}
        case "axhspan" | "axvspan":
            return {"kind": call.name[2] + "span", "at": [_round(a[0]), _round(a[1])]}
        case "text":
            is_inside = call.style.get("transform") == AXES_COORDINATES
            return {"kind": "text", "text": a[2], "at": [_round(a[0]), _round(a[1])],
                    "inside": [is_inside, is_inside], "shift": 0} | _align(call.style)  # fmt: skip
        case "annotate" if "arrowprops" in call.style:
            return {"kind": "arrow", "at": [*map(_round, a[2]), *map(_round, a[1])],
                    "colour": call.style["arrowprops"]["color"]}  # fmt: skip
        case "annotate":
            is_above = "xycoords" in call.style
            return {"kind": "text", "text": a[0], "at": [*map(_round, a[1])],
                    "inside": [False, is_above], "shift": a[2][0] if a[2] else 0,
                    } | _align(call.style)  # fmt: skip
    return None


def _align(style: Mapping[str, Any]) -> dict[str, Any]:
    return {"ha": style.get("ha", "left"), "va": style.get("va", "bottom")}


def _describe_style(style: Mapping[str, Any]) -> dict[str, Any]:
    """Return colour, width, dashes and marker of a style; `id` is equal for what looks equal."""
    width = style.get("lw", 1.1)
    dash = style.get("ls", "-")
    has_line = dash not in ("", "none", "None")
    pattern = dash[1] if isinstance(dash, tuple) else NAMED_DASHES.get(dash, [])
    face = style.get("mfc", style.get("color", ""))
    described = {
        "colour": style.get("color", style.get("mec", "#111111")),
        "line": has_line,
        "width": width,
        "dash": list(pattern),
        "alpha": style.get("alpha", 1.0),
        "marker": style.get("marker", style.get("fmt", "")) or "",
        "size": style.get("ms", 3.6),
        "face": face,
        "edge": style.get("mec", ""),
    }
    appearance = json.dumps([described[k] for k in ("colour", "line", "dash", "alpha", "width")])
    return described | {"id": f"{appearance}{described['marker']}{face if not has_line else ''}"}


def _find_limits(figure: PanelFigure) -> dict[tuple[int, int], tuple[list[float], list[float]]]:
    """Return the limits of both axes of each panel, shared ones alike."""
    own = {
        (row, column): [_find_own_limits(panel, axis) for axis in (0, 1)]
        for row, column, panel in figure.list_panels()
    }
    result: dict[tuple[int, int], tuple[list[float], list[float]]] = {}
    for place in own:
        both = []
        for axis, share in enumerate((figure.sharex, figure.sharey)):
            group = [
                limits[axis]
                for other, limits in own.items()
                if other == place
                or share == "all"
                or (share == "col" and other[1] == place[1])
                or (share == "row" and other[0] == place[0])
            ]
            both.append([min(low for low, _ in group), max(high for _, high in group)])
        result[place] = both[0], both[1]
    return result


def _find_own_limits(panel: FigurePanel, axis: int) -> tuple[float, float]:
    """Return the limits of an axis (0 x, 1 y): those that were set, else of what is drawn."""
    is_log = "log" in _find_scales(panel)[axis]
    parts: list[Float1D] = []
    for call in panel.calls:
        a = call.arguments
        if call.name == "plot":
            parts.append(np.asarray(a[axis], float))
        elif call.name in ("fill_between", "vlines"):
            parts += [np.asarray(a[0], float)] if axis == 0 else [np.ravel(v) for v in a[1:]]
        elif call.name == "errorbar":
            parts += (
                [np.asarray(a[0], float)]
                if axis == 0
                else [np.subtract(a[1], a[2]), np.add(a[1], a[2])]
            )
        elif call.name == ("axvline", "axhline")[axis]:
            parts.append(np.array([a[0]], float))
        elif call.name == ("axvspan", "axhspan")[axis]:
            parts.append(np.array(a, float))
    values = np.concatenate([np.ravel(part) for part in parts]) if parts else np.empty(0)
    values = values[np.isfinite(values) & ((values > 0) | (not is_log))]
    low, high = (float(values.min()), float(values.max())) if values.size else (0.1, 1.0)
    if is_log:
        factor = (high / low) ** LIMIT_MARGIN if high > low else 2.0
        low, high = low / factor, high * factor
    else:
        margin = LIMIT_MARGIN * (high - low) or 0.5
        low, high = low - margin, high + margin
    for call in panel.find("set_xlim" if axis == 0 else "set_ylim"):
        first, last = call.arguments
        low, high = low if first is None else float(first), high if last is None else float(last)
    return low, high


def reduce_line(x: Float1D, y: Float1D) -> tuple[Float1D, Float1D]:
    """Return at most about MAX_POINTS points of a line, (points,) each, that look the same.

    Of every piece of equally many samples those at the extremes of x and y, in order, and a missing
    one; so no peak and no gap is lost.
    """
    if x.size <= MAX_POINTS:
        return x, y
    length = -(-4 * x.size // MAX_POINTS)
    starts = np.arange(0, x.size, length)
    kept = {0, x.size - 1}
    for values in (x, y):
        padded = np.full(starts.size * length, np.nan)
        padded[: x.size] = values
        pieces = padded.reshape(starts.size, length)
        missing = np.isnan(pieces)
        for extreme, filler in ((np.argmin, np.inf), (np.argmax, -np.inf)):
            kept.update((starts + extreme(np.where(missing, filler, pieces), axis=1)).tolist())
        kept.update((starts + np.argmax(missing, axis=1))[missing.any(axis=1)].tolist())
    index = np.array(sorted(each for each in kept if each < x.size))
    return x[index], y[index]


def reduce_envelope(x: Float1D, low: Float1D, high: Float1D) -> tuple[Float1D, Float1D, Float1D]:
    """Return at most MAX_POINTS points of an envelope, with the extremes of those joined."""
    if x.size <= MAX_POINTS:
        return x, low, high
    starts = np.arange(0, x.size, -(-x.size // MAX_POINTS))
    return x[starts], np.fmin.reduceat(low, starts), np.fmax.reduceat(high, starts)


def _add(columns: list[Any], values: Float1D) -> int:
    """Add a column of numbers; return its index."""
    if values.size <= MAX_PLAIN_COLUMN:
        columns.append([_round(value) for value in values.tolist()])
        return len(columns) - 1
    known = np.isfinite(values)
    low, high = (float(values[known].min()), float(values[known].max())) if known.any() else (0, 0)
    step = (high - low) / (MISSING_CODE - 1) or 1.0
    codes = np.where(known, np.round((np.where(known, values, low) - low) / step), MISSING_CODE)
    packed = base64.b64encode(codes.astype("<u2").tobytes()).decode()
    columns.append({"low": low, "step": step, "codes": packed})
    return len(columns) - 1


def _round(value: float) -> float | None:
    value = float(value)
    return float(f"{value:.{TEXT_DIGITS}g}") if np.isfinite(value) else None


def _format_label(text: str) -> str:
    """Return a label with mathematics between dollar signs as HTML."""
    parts = html.escape(text, quote=False).replace("\n", " ").split("$")
    return "".join(_format_mathematics(part) if n % 2 else part for n, part in enumerate(parts))


def _format_mathematics(text: str) -> str:
    text = re.sub(r"\\([A-Za-z]+)", lambda match: GREEK_LETTERS.get(match[1], match[1]), text)
    text = re.sub(r"_\{?(\w+)\}?", r"<sub>\1</sub>", text)
    text = re.sub(r"\^\{?([\w*]+)\}?", r"<sup>\1</sup>", text)
    return f"<i>{text.replace(chr(39), '′')}</i>"
