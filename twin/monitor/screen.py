"""Screen layout: lines of panels in columns, as many as fit."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from rich.text import Text

from table_io.errors import replace_nonprintable
from twin.monitor import panels
from twin.monitor.panels import DIM_STYLE, GOOD_STYLE, STYLES, WARN_STYLE, draw_bar
from twin.monitor.run_view import Progress, RunView, SessionStatus, eta_a, format_duration
from twin.viewer.view_model import impacts_per_cycle

MIN_SIZE = 40, 10
COLUMN_SPACING = 2  # blank cells between panels
RULE_STYLE = "grey35"
COMMAND_KEYS = {"h": "hold", "r": "resume", "s": "stop", "a": "abort"}
ARROWS = {"forward": "↑", "backward": "↓"}
DrawPanel = Callable[[RunView, int, int], list[Text]]


@dataclass(frozen=True, slots=True)
class Panel:
    """Panel: title, draw function, `min_lines` to `max_lines` or more if `is_growing`.

    The legend is rich markup.
    """

    title: str
    draw: DrawPanel
    min_lines: int
    max_lines: int
    is_growing: bool = False
    legend: str = ""


PRC_LEGEND = (
    f" [{panels.FORWARD_COLOUR}]━ forward[/] [{panels.BACKWARD_COLOUR}]━ backward[/]"
    f" [{panels.TWIN_COLOUR}]○ twin[/]"
)
LEVEL_PANEL = Panel("Level", panels.draw_level, 3, 3)
LIMITS_PANEL = Panel("Margins to limits, peak of 1 s", panels.draw_limits, 3, 12)
TWIN_PANEL = Panel("Measured | twin", panels.draw_twin, 8, 8)
PHASES_PANEL = Panel("Error of the last cycle by phase", panels.draw_phases, 8, 8)
SPECIMEN_PANEL = Panel("Identified parameters", panels.draw_specimen, 1, 7)
TIMING_PANEL = Panel("Latency in ms", panels.draw_timing, 4, 8)
ETA_D_PANEL = Panel("PRC η_d", panels.draw_prc, 8, 20, is_growing=True, legend=PRC_LEGEND)
ETA_A_PANEL = Panel("PRC η_a", partial(panels.draw_prc, value=eta_a), 8, 20, is_growing=True)
IMPACT_RATE_PANEL = Panel(
    "Impacts per cycle, R + L",
    partial(panels.draw_prc, value=impacts_per_cycle),
    8,
    16,
    is_growing=True,
)
IMPACTS_PANEL = Panel("Last cycle and last point", panels.draw_impacts, 3, 3)
EVENTS_PANEL = Panel("Warnings and events", panels.draw_events, 3, 6, is_growing=True)
# From top to bottom, column by column; the first panels are kept if space is short.
NARROW_LAYOUT = ((LEVEL_PANEL, ETA_D_PANEL, IMPACTS_PANEL, TWIN_PANEL, EVENTS_PANEL, LIMITS_PANEL),)
SHORT_LAYOUT = (
    (LEVEL_PANEL, TWIN_PANEL, LIMITS_PANEL, SPECIMEN_PANEL),
    (ETA_D_PANEL, IMPACTS_PANEL, EVENTS_PANEL),
)
DEFAULT_LAYOUT = (
    (LEVEL_PANEL, LIMITS_PANEL, TWIN_PANEL, SPECIMEN_PANEL),
    (ETA_D_PANEL, IMPACTS_PANEL, TIMING_PANEL, EVENTS_PANEL),
)
LARGE_LAYOUT = (
    (LEVEL_PANEL, LIMITS_PANEL, TWIN_PANEL, PHASES_PANEL, SPECIMEN_PANEL, TIMING_PANEL),
    (ETA_D_PANEL, ETA_A_PANEL),
    (IMPACTS_PANEL, IMPACT_RATE_PANEL, EVENTS_PANEL),
)


def draw_screen(view: RunView, width: int, height: int) -> list[Text]:
    """Draw the screen as `height` lines of at most `width` cells."""
    if width < MIN_SIZE[0] or height < MIN_SIZE[1]:
        return [Text(f"needs {MIN_SIZE[0]} x {MIN_SIZE[1]}"[:width])] + [Text()] * (height - 1)
    top = [_draw_title(view, width), _draw_progress(view.progress, width)]
    bottom = [_draw_keys(view.status, width)]
    if height >= 16:
        bottom.insert(0, _draw_footer(view, width))
    if height >= 16 and (width < 72 or height < 34):
        bottom.insert(0, panels.format_latency(view, width))
    columns = (
        NARROW_LAYOUT
        if width < 72
        else SHORT_LAYOUT
        if height < 34
        else DEFAULT_LAYOUT
        if width < 160
        else LARGE_LAYOUT
    )
    column_width = (width - COLUMN_SPACING * (len(columns) - 1)) // len(columns)
    body_height = height - len(top) - len(bottom)
    with np.errstate(all="ignore"):  # received numbers may have any size
        drawn_columns = [
            _draw_column(view, column, column_width, body_height) for column in columns
        ]
    return [
        *(_fit_line(line, width) for line in top),
        *_join_columns(drawn_columns, column_width),
        *(_fit_line(line, width) for line in bottom),
    ]


def _fit_line(line: Text, width: int) -> Text:
    """Truncate a line to `width` and make it printable: received text must not send escapes."""
    if not line.plain.isprintable():
        line.plain = replace_nonprintable(line.plain)
    line.truncate(width)
    return line


def _draw_column(view: RunView, candidates: Sequence[Panel], width: int, height: int) -> list[Text]:
    """Draw the panels that fit into `height` lines; growing panels share the remaining lines."""
    visible: list[Panel] = []
    for panel in candidates:
        if sum(other.min_lines + 1 for other in (*visible, panel)) <= height:
            visible.append(panel)
    fixed_lines = {
        panel.title: panel.draw(view, width, panel.max_lines)
        for panel in visible
        if not panel.is_growing
    }
    heights = {panel.title: panel.min_lines for panel in visible}
    spare = height - sum(panel.min_lines + 1 for panel in visible)
    for panel in visible:
        wanted_lines = panel.max_lines if panel.is_growing else len(fixed_lines[panel.title])
        extra = min(max(wanted_lines - panel.min_lines, 0), spare)
        heights[panel.title] += extra
        spare -= extra
    growing = [panel for panel in visible if panel.is_growing]
    for number, panel in enumerate(growing):
        heights[panel.title] += spare * (number + 1) // len(growing) - spare * number // len(
            growing
        )
    is_spaced = not growing and spare >= len(visible)
    lines: list[Text] = []
    for panel in visible:
        panel_lines = fixed_lines.get(panel.title, ())
        if not 0 < len(panel_lines) <= heights[panel.title]:
            panel_lines = panel.draw(view, width, heights[panel.title])
        blank_count = heights[panel.title] - len(panel_lines) + is_spaced
        lines += [_draw_header(panel, width), *panel_lines, *[Text()] * blank_count]
    lines = [_fit_line(line, width) for line in lines]
    return (lines + [Text()] * height)[:height]


def _draw_header(panel: Panel, width: int) -> Text:
    header = Text.from_markup(f"[bold]{panel.title}[/]{panel.legend} ")
    return header.append("─" * (width - header.cell_len), RULE_STYLE)


def _join_columns(columns: Sequence[Sequence[Text]], width: int) -> list[Text]:
    lines = []
    for row in zip(*columns, strict=True):
        line = Text()
        for number, cell in enumerate(row):
            line.append_text(cell)
            if number + 1 < len(row):
                line.append(" " * (width - cell.cell_len + COLUMN_SPACING))
        lines.append(line)
    return lines


def _justify(left: Text, right: Text, width: int) -> Text:
    """Join left and right text in one line; drop the right text if both do not fit."""
    space = width - left.cell_len - right.cell_len
    return left.append(" " * space).append_text(right) if space > 0 else left


def _draw_title(view: RunView, width: int) -> Text:
    left, right = Text().append(view.name or "no run", "bold"), _draw_state(view.progress)
    title = f"  {view.rig_title}" if view.rig_title else ""
    if left.cell_len + len(title) + right.cell_len < width:
        left.append(title, DIM_STYLE)
    return _justify(left, right, width)


def _draw_state(progress: Progress) -> Text:
    style = STYLES[progress.tone]
    if not progress.is_live:
        return Text(progress.state, style)
    right = Text(f"● {progress.state}", style)
    if progress.activity:
        right.append(f", {progress.activity}", "")
    return right.append(f"  {format_duration(progress.time_s)}", DIM_STYLE)


def _draw_progress(progress: Progress, width: int) -> Text:
    """Draw step, progress of the test and expected remaining time."""
    left = Text(_format_step(progress, width >= 100))
    if progress.progress is None or progress.left_s is None:
        return left
    text = f" {100 * progress.progress:3.0f} %"
    if progress.held:
        text += "  until resumed"
    elif not progress.ended:
        time_text = format_duration(abs(progress.left_s))
        text += f"  {time_text} {'left' if progress.left_s >= 0 else 'over'}"
    bar_width = width - left.cell_len - len(text)
    if bar_width >= 4:
        left.append_text(draw_bar(progress.progress, bar_width, GOOD_STYLE))
    return _justify(left, Text(text), width) if bar_width < 4 else left.append(text)


def _format_step(progress: Progress, show_cycle: bool) -> str:
    """Format the current step with a fixed width, so that the text after it does not move."""
    if progress.windows is not None:
        number = progress.window
        text = f"window {number}/{progress.windows}" if number else "outside the history"
        return f"{text:<33}"
    if progress.step is None:
        return f"{f'{progress.phase} the steps':<33}"
    text = f"step {progress.step:>2}/{progress.steps}  {progress.frequency_hz:6.3f} Hz "
    text += f"{ARROWS.get(progress.direction, '')} {progress.direction:<8}"
    cycle_text = f"cycle {progress.cycle}" if progress.cycle else ""
    if cycle_text and progress.cycles:
        cycle_text += f"/{progress.cycles}"
    return f"{text:<33}" + (f"  {cycle_text:<13}" if show_cycle else "")


def _draw_footer(view: RunView, width: int) -> Text:
    """Draw one line with the connected components and the gaps of the recording."""
    gaps = panels.format_gaps(view)
    components = panels.format_components(view, width - gaps.cell_len - 12)
    return _justify(Text("connected  ", DIM_STYLE).append_text(components), gaps, width)


def _draw_keys(status: SessionStatus, width: int) -> Text:
    if status.pending_command:
        return Text(
            f"{status.pending_command} the test?  y = yes, any other key = no",
            f"reverse {WARN_STYLE}",
        )
    line = Text()
    for key, name in {"q": "quit", **(COMMAND_KEYS if status.may_command else {})}.items():
        line.append(key, "bold").append(f" {name}  "[: None if width >= 44 else -1], DIM_STYLE)
    return line
