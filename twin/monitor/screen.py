"""Screen layout: lines of panels in columns, as many as fit."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from rich.text import Text

from table_io.block import Label
from table_io.config.excitation.stepped_sine import Sweep
from table_io.errors import replace_nonprintable
from table_io.records import LABEL_TEXTS
from twin.monitor import curves, panels
from twin.monitor.panels import (
    BAD_STYLE,
    DIM_STYLE,
    GOOD_STYLE,
    WARN_STYLE,
    SessionStatus,
    draw_bar,
    format_duration,
)
from twin.monitor.run_state import LiveRunState

MIN_SIZE = 40, 10
SILENT_S = 2.0  # without data; blocks arrive a hundred times per second
COLUMN_SPACING = 2  # blank cells between panels
RULE_STYLE = "grey35"
STATE_STYLES = {
    "running": GOOD_STYLE, "checking": GOOD_STYLE, "armed": GOOD_STYLE,
    "holding": WARN_STYLE, "stopping": WARN_STYLE,
    "at rest": "", "idle": "", "fault": BAD_STYLE,
    "waiting": WARN_STYLE, "following": GOOD_STYLE, "astray": BAD_STYLE, "left": BAD_STYLE,
}  # fmt: skip
STATE_TEXTS = {"astray": "drive lost", "left": "ended in motion"}  # shown for recorded states
COMMAND_KEYS = {"h": "hold", "r": "resume", "s": "stop", "a": "abort"}
ARROWS = {"forward": "↑", "backward": "↓"}
DrawPanel = Callable[[LiveRunState, int, int], list[Text]]


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
    f" [{curves.FORWARD_COLOUR}]━ forward[/] [{curves.BACKWARD_COLOUR}]━ backward[/]"
    f" [{curves.TWIN_COLOUR}]○ twin[/]"
)
LEVEL_PANEL = Panel("Level", panels.draw_level, 3, 3)
LIMITS_PANEL = Panel("Margins to limits, peak of 1 s", panels.draw_limits, 3, 12)
TWIN_PANEL = Panel("Measured | twin", panels.draw_twin, 8, 8)
PHASES_PANEL = Panel("Error of the last cycle by phase", panels.draw_phases, 8, 8)
SPECIMEN_PANEL = Panel("Identified parameters", panels.draw_specimen, 1, 7)
TIMING_PANEL = Panel("Latency in ms", panels.draw_timing, 4, 8)
ETA_D_PANEL = Panel("PRC η_d", curves.draw_prc, 8, 20, is_growing=True, legend=PRC_LEGEND)
ETA_A_PANEL = Panel("PRC η_a", partial(curves.draw_prc, value=curves.eta_a), 8, 20, is_growing=True)
IMPACT_RATE_PANEL = Panel(
    "Impacts per cycle, R + L",
    partial(curves.draw_prc, value=curves.impacts_per_cycle),
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


def draw_screen(
    run_state: LiveRunState, status: SessionStatus, width: int, height: int
) -> list[Text]:
    """Draw the screen as `height` lines of at most `width` cells."""
    if width < MIN_SIZE[0] or height < MIN_SIZE[1]:
        return [Text(f"needs {MIN_SIZE[0]} x {MIN_SIZE[1]}"[:width])] + [Text()] * (height - 1)
    top = [_draw_title(run_state, status, width), _draw_progress(run_state, width)]
    bottom = [_draw_keys(status, width)]
    if height >= 16:
        bottom.insert(0, _draw_footer(run_state, status, width))
    if height >= 16 and (width < 72 or height < 34):
        bottom.insert(0, panels.format_latency(run_state, width))
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
            _draw_column(run_state, column, column_width, body_height) for column in columns
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


def _draw_column(
    run_state: LiveRunState, candidates: Sequence[Panel], width: int, height: int
) -> list[Text]:
    """Draw the panels that fit into `height` lines; growing panels share the remaining lines."""
    visible: list[Panel] = []
    for panel in candidates:
        if sum(other.min_lines + 1 for other in (*visible, panel)) <= height:
            visible.append(panel)
    fixed_lines = {
        panel.title: panel.draw(run_state, width, panel.max_lines)
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
            panel_lines = panel.draw(run_state, width, heights[panel.title])
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


def _draw_title(run_state: LiveRunState, status: SessionStatus, width: int) -> Text:
    name = run_state.start.name if run_state.start else "no run"
    left = Text().append(name, "bold")
    right = _draw_state(run_state, status)
    title = f"  {run_state.rig.title}" if run_state.rig is not None else ""
    if left.cell_len + len(title) + right.cell_len < width:
        left.append(title, DIM_STYLE)
    return _justify(left, right, width)


def describe_state(run_state: LiveRunState, status: SessionStatus) -> tuple[str, str]:
    """Return the state of the run in words, and its style."""
    if run_state.stop is not None:
        style = GOOD_STYLE if run_state.stop.verdict == "complete" else BAD_STYLE
        return f"ended: {run_state.stop.verdict}", style
    if status.silent_s >= SILENT_S:
        return f"no data for {format_duration(status.silent_s)}", BAD_STYLE
    if not run_state.run:
        return "waiting for a run", DIM_STYLE
    state = STATE_TEXTS.get(run_state.rig_state, run_state.rig_state)
    return state or "joined", STATE_STYLES.get(run_state.rig_state, "")


def describe_activity(run_state: LiveRunState) -> str:
    """Return what the table is doing within the state, or "" if the state says it already."""
    activity = LABEL_TEXTS.get(Label(run_state.position[1]), "") if run_state.recent.blocks else ""
    return "" if activity == run_state.rig_state else activity


def _draw_state(run_state: LiveRunState, status: SessionStatus) -> Text:
    state, style = describe_state(run_state, status)
    if run_state.stop is not None or status.silent_s >= SILENT_S or not run_state.run:
        return Text(state, style)
    right = Text(f"● {state}", style)
    if activity := describe_activity(run_state):
        right.append(f", {activity}", "")
    return right.append(f"  {format_duration(run_state.index / run_state.rate_hz)}", DIM_STYLE)


def _draw_progress(run_state: LiveRunState, width: int) -> Text:
    """Draw step, progress of the test and planned remaining time."""
    left = Text(_format_step(run_state, width >= 100))
    share = run_state.progress
    if share is None:
        return left
    text = f" {100 * share:3.0f} %"
    if run_state.rig_state == "holding":
        text += "  until resumed"
    elif run_state.stop is None:
        remaining_s = run_state.remaining_s
        text += f"  {format_duration(abs(remaining_s))} {'left' if remaining_s >= 0 else 'over'}"
    bar_width = width - left.cell_len - len(text)
    if bar_width >= 4:
        left.append_text(draw_bar(share, bar_width, GOOD_STYLE))
    return _justify(left, Text(text), width) if bar_width < 4 else left.append(text)


def _format_step(run_state: LiveRunState, show_cycle: bool) -> str:
    """Format the current step with a fixed width, so that the text after it does not move."""
    step = run_state.step
    if step is None and run_state.start and not run_state.start.steps:
        windows = run_state.profile.plan.windows if run_state.profile else 0
        number = run_state.position[0] + 1
        return f"{f'window {number}/{windows}' if number else 'outside the history':<33}"
    if step is None:
        phase = "after" if run_state.stop else "between" if run_state.points else "before"
        return f"{f'{phase} the steps':<33}"
    text = f"step {step.index + 1:>2}/{run_state.step_count}  {step.frequency_hz:6.3f} Hz "
    text += f"{ARROWS.get(step.direction, '')} {step.direction:<8}"
    cycle_text = f"cycle {run_state.position[2] + 1}" if run_state.position[2] >= 0 else ""
    if cycle_text and run_state.profile and isinstance(run_state.profile.excitation, Sweep):
        cycle_text += f"/{run_state.profile.sweep.cycles}"
    return f"{text:<33}" + (f"  {cycle_text:<13}" if show_cycle else "")


def _draw_footer(run_state: LiveRunState, status: SessionStatus, width: int) -> Text:
    """Draw one line with the connected components and the gaps of the recording."""
    gaps = panels.format_gaps(run_state)
    components = panels.format_components(run_state, status, width - gaps.cell_len - 12)
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
