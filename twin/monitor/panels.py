"""Panels of the screen: each returns the lines of one subject within a width and height.

Pure functions of `RunView`. Every number has its unit; unknown values are dashes.
"""

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise

import numpy as np
from rich.text import Text

from table_io.block import Float2D
from table_io.records import JumpForecast
from twin.monitor.run_view import RunView, eta_d, format_duration, is_jump_near, margin_tone
from twin.viewer.plots import nice_ceil
from twin.viewer.view_model import ParameterRow, ResponseQuantity, describe_channel, label_parameter

DIM_STYLE, GOOD_STYLE, WARN_STYLE, BAD_STYLE = "grey62", "green3", "yellow1", "bold bright_red"
STYLES = {"good": GOOD_STYLE, "warn": WARN_STYLE, "bad": BAD_STYLE, "dim": DIM_STYLE, "": ""}
FORWARD_COLOUR, BACKWARD_COLOUR = "bright_red", "dodger_blue1"
TWIN_COLOUR, STEP_COLOUR = "white", "grey30"
CURVE_MARKS = {  # style and mark
    ("twin", "forward"): (TWIN_COLOUR, "○"), ("twin", "backward"): (DIM_STYLE, "○"),
    ("measured", "forward"): (FORWARD_COLOUR, ""), ("measured", "backward"): (BACKWARD_COLOUR, ""),
    ("orbit", "forward"): (FORWARD_COLOUR, "●"), ("orbit", "backward"): (BACKWARD_COLOUR, "●"),
}  # fmt: skip
DOT_BITS = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]])
BLANK_BRAILLE = 0x2800
AXIS_STYLE = "grey50"
MAX_DOT = 1e4  # dots: points farther out are clipped
MIN_MARK_SPACING = 3  # cells between the marks of a curve
WIDE_LEVEL = 46  # cells of a column, from which the peak of the table fits next to its fundamental
LEVEL_STYLES = {"INFO": "", "WARN": WARN_STYLE, "ERROR": BAD_STYLE}


def format_number(value: float | None) -> str:
    """Format a number in at most six characters; a dash if unknown."""
    if value is None or not math.isfinite(value):
        return "–"
    size = abs(value)
    if size >= 1e6:
        return f"{value:.0e}"
    return f"{value:.{0 if size >= 1000 else 1 if size >= 100 else 2 if size >= 10 else 3}f}"


def format_percent(share: float) -> str:
    """Format a share in percent in at most five characters plus sign."""
    size = 100.0 * share
    return f"{size:.{0 if abs(size) >= 9.95 else 1}f} %" if math.isfinite(size) else "–"


def draw_level(view: RunView, width: int, height: int) -> list[Text]:
    """Draw the table level against demand: the current value and the last amplitude correction."""
    level = view.level
    if level is None:
        return [Text("no step in progress", DIM_STYLE)]
    lines = [Text(f"demanded  {level.demanded_g:8.4f} g"), Text("now       ")]
    if level.current_g is None or level.deviation is None:
        lines[1].append("       –  not steady yet", DIM_STYLE)
    else:
        lines[1].append(f"{level.current_g:8.4f} g")
        lines[1].append(f"  {100 * level.deviation:+.2f} %", STYLES[level.tone])
        if level.peak_g is not None and width >= WIDE_LEVEL:
            lines[1].append(f"  peak {level.peak_g:.4f} g", DIM_STYLE)
    if level.correction is not None and level.thd is not None:
        lines[0].append(f"  command × {level.correction:.3f}", DIM_STYLE)
        outcome = "accepted" if level.accepted else "being tuned"
        text = f"{outcome}, corrected {level.updates} ×, thd {format_percent(level.thd)}"
        lines.append(Text(text, DIM_STYLE))
    return lines


def draw_limits(view: RunView, width: int, height: int) -> list[Text]:
    """Draw peaks of the last second as bars relative to their limits, the tightest that fit."""
    if view.margins is None:
        return [Text("waiting for the rig file", DIM_STYLE)]
    tightest = sorted(
        view.margins, key=lambda row: -row.share if math.isfinite(row.share) else -math.inf
    )
    lines = []
    for row in (row for row in view.margins if row in tightest[:height]):
        is_known, style = math.isfinite(row.share), STYLES[margin_tone(row)]
        peak, share = format_number(row.peak) if is_known else "lost", format_percent(row.share)
        text = f" {peak:>6}/{row.limit:<4.4g} {row.unit:<4} "
        bar_width = max(width - 11 - len(text) - max(len(share), 5), 1)
        line = Text(f"{describe_channel(row.name).label:<10} ")
        line.append_text(
            draw_bar(min(row.share, 1.0) if is_known else 0.0, bar_width, style)
        ).append(text)
        lines.append(line.append(f"{share:>5}", style))
    return lines or [Text("waiting for the first samples", DIM_STYLE)]


def draw_bar(share: float, width: int, style: str) -> Text:
    """Draw a bar of `width` cells with `share` of it filled."""
    filled = round(share * width)
    return Text("━" * filled, style).append("─" * (width - filled), "grey35")


def draw_twin(view: RunView, width: int, height: int) -> list[Text]:
    """Draw RMS over one second, error of the restarted twin and its band, per channel."""
    is_wide, has_bands = width >= 52, view.agreement is not None
    head = f"{'':<10}{'rms':>7}{'error':>7}{'band':>7}"
    if is_wide:
        head += f"{'':>6}{'of band' if has_bands else 'of rms':>9}{'free':>8}"
    lines = [Text(head, DIM_STYLE)]
    for row in view.twin_rows:
        label, unit, size = describe_channel(row.channel)
        line = Text(f"{label:<10}{format_number(row.rms / size):>7}")
        line.append(f"{format_number(row.error / size):>7}", BAD_STYLE if row.exceeds else "")
        line.append(f"{format_number(row.band / size):>7} {unit:<4}", DIM_STYLE)
        if is_wide:
            share = format_percent(row.share_of_band if has_bands else row.share_of_rms)
            line.append(f"{share:>8}{format_number(row.free / size):>8}", DIM_STYLE)
        lines.append(line.append(" ◀" if row.exceeds else "  ", BAD_STYLE))
    return lines[:height] if len(lines) > 1 else [Text("nothing compared yet", DIM_STYLE)]


def draw_phases(view: RunView, width: int, height: int) -> list[Text]:
    """Draw the error of the restarted twin over the last cycle by contact regime."""
    if view.agreement is None:
        return [Text("no cycle compared yet", DIM_STYLE)]
    lines = [Text(f"{'':<10}{'flight':>8}{'right':>8}{'left':>8}", DIM_STYLE)]
    for row in view.twin_rows:
        if row.channel in view.agreement.channels:
            label, unit, size = describe_channel(row.channel)
            numbers = "".join(f"{format_number(error / size):>8}" for error in row.phases)
            lines.append(Text(f"{label:<10}{numbers}").append(f" {unit}", DIM_STYLE))
    return lines[:height]


def draw_impacts(view: RunView, width: int, height: int) -> list[Text]:
    """Draw impacts and peak of the last cycle and the last PRC point, measured and twin."""
    lines = [Text(f"{'':<9}{'R':>3}{'L':>3}{'u peak':>10}{'η_d':>7}{'η_a':>7}", DIM_STYLE)]
    for row in view.response_rows:
        counts = (row.impacts_right, row.impacts_left)
        right, left = ("–" if count is None else str(count) for count in counts)
        peak = format_number(None if row.u_peak_m is None else 1e3 * row.u_peak_m)
        text = f"{row.source:<9}{right:>3}{left:>3}{peak:>7} mm"
        text += f"{format_number(row.eta_d):>7}{format_number(row.eta_a):>7}"
        lines.append(Text(text, "" if row.source == "measured" else DIM_STYLE))
    return lines


def draw_specimen(view: RunView, width: int, height: int) -> list[Text]:
    """Draw the jump forecast and the identified parameters, drifted parameters first."""
    lines = [_format_parameter(row) for row in view.parameters]
    drifted_count = sum(row.has_drifted for row in view.parameters)
    lines.insert(drifted_count, _format_forecast(view.forecast))
    return lines[:height]


def _format_parameter(row: ParameterRow) -> Text:
    label, unit, size = label_parameter(row.name)
    line = Text(f"{label:<9} ")
    line.append(f"{format_number(row.value / size):>6}±{format_number(row.sd / size):<5} {unit:<5}")
    if math.isfinite(row.drift_sd):  # no trend is fitted for some parameters
        share, share_sd = (100.0 * drift / row.drift_size for drift in (row.drift, row.drift_sd))
        digits = 1 if abs(share) < 10 else 0
        line.append(
            f" {share:+.{digits}f}±{share_sd:.{digits}f} %",
            WARN_STYLE if row.has_drifted else DIM_STYLE,
        )
    return line


def _format_forecast(forecast: JumpForecast | None) -> Text:
    if forecast is None:
        return Text("no jump forecast yet", DIM_STYLE)
    if not forecast.kind:
        return Text("no jump ahead on this branch", DIM_STYLE)
    text = (
        f"jump {forecast.kind} at {forecast.jump_hz:.3f} Hz "
        f"({forecast.low_hz:.2f} to {forecast.high_hz:.2f})"
    )
    return Text(text, WARN_STYLE if is_jump_near(forecast) else "")


def draw_events(view: RunView, width: int, height: int) -> list[Text]:
    """Draw warnings and events with their times, newest first, with line wrapping."""
    lines: list[Text] = []
    for event in view.events:
        time_text = f"{format_duration(event.index / view.run_state.rate_hz):>7} "
        for row, part in enumerate(_wrap_text(event.text, width - len(time_text))):
            lines.append(
                Text(" " * len(time_text) if row else time_text, DIM_STYLE).append(
                    part, LEVEL_STYLES[event.level]
                )
            )
        if len(lines) >= height:
            break
    return lines[:height] or [Text("no events yet", DIM_STYLE)]


def _wrap_text(text: str, width: int) -> list[str]:
    """Wrap text to lines of at most `width` characters, between words where possible."""
    return textwrap.wrap(text, max(width, 1)) or [""]


def draw_timing(view: RunView, width: int, height: int) -> list[Text]:
    """Draw latency percentiles and missed deadlines of each component."""
    lines = [Text(f"{'':<9}{'p50':>7}{'p99':>8}{'max':>8}{'missed':>7}", DIM_STYLE)]
    for timing in view.timings:
        text = f"{timing.component[:9]:<9}{format_number(timing.p50_ms):>7}"
        text += f"{format_number(timing.p99_ms):>8}"
        line = Text(f"{text}{format_number(timing.max_ms):>8}")
        lines.append(line.append(f"{timing.missed:>7}", WARN_STYLE if timing.missed else ""))
    return lines[:height] if len(lines) > 1 else [Text("no latencies yet", DIM_STYLE)]


def format_gaps(view: RunView) -> Text:
    """Format the number of invalid samples and their channels."""
    if not view.dropouts:
        return Text("0 dropouts", GOOD_STYLE)
    names = ", ".join(view.dropout_channels)
    return Text(f"dropouts: {view.dropouts} samples, {names}", BAD_STYLE)


def format_latency(view: RunView, width: int) -> Text:
    """Format p99 latencies in ms in one line: of each component, or the worst if too long."""
    if not view.timings:
        return Text("no latencies yet", DIM_STYLE)
    missed = sum(timing.missed for timing in view.timings)
    text = "  ".join(f"{timing.component} {timing.p99_ms:.1f}" for timing in view.timings)
    suffix = f" ms  {missed} missed"
    if len(text) + len(suffix) + 5 > width:
        text = f"{max(timing.p99_ms for timing in view.timings):.1f}"
    return (
        Text("p99  ", DIM_STYLE)
        .append(text, "default")
        .append(suffix, WARN_STYLE if missed else GOOD_STYLE)
    )


def format_components(view: RunView, width: int) -> Text:
    """Format the connected components, one word each, with counts."""
    counts = sorted(view.components.items())
    words = [f"{name}×{count}" if count > 1 else name for name, count in counts]
    shown_count = len(words)
    while shown_count and len("  ".join(words[:shown_count])) > width - 4:
        shown_count -= 1
    suffix = f" +{len(words) - shown_count}" if shown_count < len(words) else ""
    return Text(("  ".join(words[:shown_count]) or "none") + suffix)


@dataclass(frozen=True, slots=True)
class PlotCurve:
    """Curve of points (x, y) joined by lines, with a rich style and a mark where it fits."""

    style: str
    mark: str
    points: Sequence[tuple[float, float]]


def draw_prc(view: RunView, width: int, height: int, value: ResponseQuantity = eta_d) -> list[Text]:
    """Plot the PRC so far, measured in color, twin in white, with the frequency of the step.

    Of a continuation, the amplitudes of measured orbits in mm over those of the plan.
    """
    plot = view.plot(value)
    if plot.range_hz is None:
        is_known = view.run_state.start is not None
        text = "a test without steps has no curves over frequency"
        return [Text(text if is_known else "waiting for the test plan", DIM_STYLE)]
    y_max = nice_ceil(plot.highest or 1.0)
    curves = [
        PlotCurve(*CURVE_MARKS[curve.source, curve.direction], curve.points)
        for curve in plot.curves
    ]
    if plot.newest is not None:
        style, _ = CURVE_MARKS["orbit", plot.newest.direction]
        curves.append(PlotCurve(style, "●", plot.newest.points))
    if plot.step_hz is not None:
        line = [(plot.step_hz, 0.0), (plot.step_hz, y_max)]
        curves.insert(0, PlotCurve(STEP_COLOUR, "", line))
    return plot_curves(curves, plot.range_hz, y_max, width, height, "Hz")


def plot_curves(
    curves: Sequence[PlotCurve],
    x: tuple[float, float],
    top: float,
    width: int,
    height: int,
    unit: str,
) -> list[Text]:
    """Plot curves over the range `x` from 0 to `top` with axis labels.

    Returns `height` lines of at most `width` cells. The later curve sets the style of a shared
    character.
    """
    margin = max(len(_format_number(top)), len(_format_number(top / 2)))
    columns, rows = max(width - margin - 1, 1), max(height - 2, 1)
    cells = np.full((rows, columns), BLANK_BRAILLE)
    styles = np.full((rows, columns), -1)
    marks: dict[tuple[int, int], tuple[str, str]] = {}
    scale = np.array([(2 * columns - 1) / ((x[1] - x[0]) or 1.0), (4 * rows - 1) / (top or 1.0)])
    for number, curve in enumerate(curves):
        dots = (np.array(curve.points, dtype=float).reshape(-1, 2) - (x[0], 0.0)) * scale
        dots = dots[np.isfinite(dots).all(axis=1)].clip(-MAX_DOT, MAX_DOT)
        for column, row in _rasterize(dots):
            if 0 <= column < 2 * columns and 0 <= row < 4 * rows:
                cell = (4 * rows - 1 - row) // 4, column // 2
                cells[cell] |= DOT_BITS[(4 * rows - 1 - row) % 4, column % 2]
                styles[cell] = number
        last_mark = -MIN_MARK_SPACING
        for column, row in np.rint(dots).astype(int).tolist() if curve.mark else ():
            if column // 2 >= last_mark + MIN_MARK_SPACING and 0 <= row < 4 * rows:
                last_mark = column // 2
                marks[(4 * rows - 1 - row) // 4, last_mark] = curve.mark, curve.style
    numbers = {0: _format_number(top), rows // 2: _format_number(top / 2)}
    lines = []
    for row in range(rows):
        line = Text(f"{numbers.get(row, ''):>{margin}}", AXIS_STYLE).append(
            "┤" if row in numbers else "│"
        )
        letters = [
            marks.get((row, column)) or _cell_text(cells[row, column], styles[row, column], curves)
            for column in range(columns)
        ]
        for style, cells_in_style in groupby(letters, key=lambda cell: cell[1]):
            line.append("".join(letter for letter, _ in cells_in_style), style)
        lines.append(line)
    return [*lines, *_draw_x_axis(x, margin, columns, unit)]


def _cell_text(dots: int, number: int, curves: Sequence[PlotCurve]) -> tuple[str, str]:
    """Return (character, style); a space without dots: not every font has the blank braille."""
    return (" ", "") if dots == BLANK_BRAILLE else (chr(dots), curves[number].style)


def _rasterize(points: Float2D) -> list[tuple[int, int]]:
    """Return every dot (column, row) on the straight lines between the points."""
    dots = [tuple(np.rint(points[0]).astype(int))] if len(points) else []
    for a, b in pairwise(points):
        count = max(int(np.ceil(np.abs(b - a).max())), 1)
        line = a + (b - a) * np.linspace(0.0, 1.0, count + 1)[:, None]
        dots += [tuple(dot) for dot in np.rint(line).astype(int)]
    return dots


def _draw_x_axis(x: tuple[float, float], margin: int, columns: int, unit: str) -> list[Text]:
    """Draw the x axis and its labels: both ends, and the middle if there is space."""
    ticks = {0: x[0], columns - 1: x[1]}
    if columns >= 30:
        ticks[columns // 2] = (x[0] + x[1]) / 2
    axis = "".join("┴" if column in ticks else "─" for column in range(columns))
    labels = [" "] * (margin + 1 + columns)
    for column, value in ticks.items():
        text = f"{value:.3g}" + (f" {unit}" if column == columns - 1 else "")
        start = (
            margin
            + 1
            + column
            - (0 if column == 0 else len(text) - 1 if column == columns - 1 else 2)
        )
        labels[start : start + len(text)] = text
    return [Text(f"{'0':>{margin}}└{axis}", AXIS_STYLE), Text("".join(labels), AXIS_STYLE)]


def _format_number(value: float) -> str:
    return f"{value:.3g}"
