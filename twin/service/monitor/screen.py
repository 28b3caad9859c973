"""The whole screen as lines: panels side by side, as many as there is room for."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from rich.text import Text

from table_io.block import Label
from table_io.words import DOING, printable
from twin.service.monitor import curves, panels
from twin.service.monitor.board import Board
from twin.service.monitor.panels import BAD, DIM, GOOD, WARN, About, bar, clock

SMALLEST = 40, 10
SILENT_S = 2.0  # blocks come a hundred times a second, timings once
BETWEEN = 2  # columns of nothing between panels
RULE = "grey35"
STATES = {
    "running": GOOD, "checking": GOOD, "armed": GOOD, "holding": WARN, "stopping": WARN,
    "at rest": "", "idle": "", "fault": BAD,
    "waiting": WARN, "following": GOOD, "astray": BAD, "left": BAD,
}  # fmt: skip
ORDERS = {"h": "hold", "r": "resume", "s": "stop", "a": "abort"}
ARROWS = {"forward": "↑", "backward": "↓"}
Draw = Callable[[Board, int, int], list[Text]]


@dataclass(frozen=True, slots=True)
class Panel:
    """A title, what draws its lines, `least` to `most` of them or more where it `grows`.

    The legend is markup of rich.
    """

    title: str
    draw: Draw
    least: int
    most: int
    grows: bool = False
    legend: str = ""


LEGEND = f" [{curves.RED}]━ forward[/] [{curves.BLUE}]━ backward[/] [{curves.TWIN}]○ twin[/]"
LEVEL = Panel("Level", panels.level, 3, 3)
LIMITS = Panel("Nearest to a limit, peak of 1 s", panels.limits, 3, 12)
TWIN = Panel("Measured | twin", panels.twin, 8, 8)
PHASES = Panel("Error of the last cycle by phase", panels.phases, 8, 8)
SPECIMEN = Panel("Specimen as identified", panels.specimen, 1, 7)
TIMING = Panel("Latency in ms", panels.timing, 4, 8)
CURVE = Panel("PRC η_d", curves.curve, 8, 20, grows=True, legend=LEGEND)
CURVE_A = Panel("PRC η_a", partial(curves.curve, value=curves.eta_a), 8, 20, grows=True)
CURVE_I = Panel(
    "Impacts a cycle, R + L", partial(curves.curve, value=curves.impacts_a_cycle), 8, 16, grows=True
)
IMPACTS = Panel("Last cycle and last point", panels.impacts, 3, 3)
NEWS = Panel("Warnings and events", panels.news, 3, 6, grows=True)
# From top to bottom, column by column; what comes first is kept where there is little room.
NARROW = ((LEVEL, CURVE, IMPACTS, TWIN, NEWS, LIMITS),)
SHORT = ((LEVEL, TWIN, LIMITS, SPECIMEN), (CURVE, IMPACTS, NEWS))
USUAL = ((LEVEL, LIMITS, TWIN, SPECIMEN), (CURVE, IMPACTS, TIMING, NEWS))
LARGE = (
    (LEVEL, LIMITS, TWIN, PHASES, SPECIMEN, TIMING),
    (CURVE, CURVE_A),
    (IMPACTS, CURVE_I, NEWS),
)


def screen(board: Board, about: About, width: int, height: int) -> list[Text]:
    """`height` lines of at most `width` cells."""
    if width < SMALLEST[0] or height < SMALLEST[1]:
        return [Text(f"needs {SMALLEST[0]} x {SMALLEST[1]}"[:width])] + [Text()] * (height - 1)
    top = [_title(board, about, width), _progress(board, width)]
    bottom = [_keys(about, width)]
    if height >= 16:
        bottom.insert(0, _connected(board, about, width))
    if height >= 16 and (width < 72 or height < 34):
        bottom.insert(0, panels.punctual(board, width))
    columns = NARROW if width < 72 else SHORT if height < 34 else USUAL if width < 160 else LARGE
    wide = (width - BETWEEN * (len(columns) - 1)) // len(columns)
    room = height - len(top) - len(bottom)
    with np.errstate(all="ignore"):  # numbers from elsewhere may be of any size
        drawn = [_column(board, column, wide, room) for column in columns]
    return [
        *(_fitting(line, width) for line in top),
        *_beside(drawn, wide),
        *(_fitting(line, width) for line in bottom),
    ]


def _fitting(line: Text, width: int) -> Text:
    """The line within its width, and printable: a text from elsewhere commands no terminal."""
    if not line.plain.isprintable():
        line.plain = printable(line.plain)
    line.truncate(width)
    return line


def _column(board: Board, chosen: Sequence[Panel], width: int, height: int) -> list[Text]:
    """`height` lines: the panels that fit, those that grow sharing what is left."""
    kept: list[Panel] = []
    for panel in chosen:
        if sum(one.least + 1 for one in (*kept, panel)) <= height:
            kept.append(panel)
    drawn = {one.title: one.draw(board, width, one.most) for one in kept if not one.grows}
    rows = {one.title: one.least for one in kept}
    left = height - sum(one.least + 1 for one in kept)
    for one in kept:
        wanted = one.most if one.grows else len(drawn[one.title])
        more = min(max(wanted - one.least, 0), left)
        rows[one.title] += more
        left -= more
    growing = [one for one in kept if one.grows]
    for number, one in enumerate(growing):
        rows[one.title] += left * (number + 1) // len(growing) - left * number // len(growing)
    spaced = not growing and left >= len(kept)
    lines: list[Text] = []
    for one in kept:
        whole = drawn.get(one.title, ())
        if not 0 < len(whole) <= rows[one.title]:
            whole = one.draw(board, width, rows[one.title])
        blank = rows[one.title] - len(whole) + spaced
        lines += [_head(one, width), *whole, *[Text()] * blank]
    lines = [_fitting(line, width) for line in lines]
    return (lines + [Text()] * height)[:height]


def _head(panel: Panel, width: int) -> Text:
    head = Text.from_markup(f"[bold]{panel.title}[/]{panel.legend} ")
    return head.append("─" * (width - head.cell_len), RULE)


def _beside(columns: Sequence[Sequence[Text]], wide: int) -> list[Text]:
    lines = []
    for row in zip(*columns, strict=True):
        line = Text()
        for number, part in enumerate(row):
            line.append_text(part)
            if number + 1 < len(row):
                line.append(" " * (wide - part.cell_len + BETWEEN))
        lines.append(line)
    return lines


def _ends(left: Text, right: Text, width: int) -> Text:
    """Left and right in one line; where both have no room, the right one alone gives way."""
    space = width - left.cell_len - right.cell_len
    return left.append(" " * space).append_text(right) if space > 0 else left


def _title(board: Board, about: About, width: int) -> Text:
    name = board.start.name if board.start else "no run yet"
    left = Text().append(name, "bold")
    right = _state(board, about)
    title = f"  {board.rig.title}" if board.rig is not None else ""
    if left.cell_len + len(title) + right.cell_len < width:
        left.append(title, DIM)
    return _ends(left, right, width)


def _state(board: Board, about: About) -> Text:
    if board.stop is not None:
        style = GOOD if board.stop.verdict == "complete" else BAD
        return Text(f"over: {board.stop.verdict}", style)
    if about.silent_s >= SILENT_S:
        return Text(f"silent for {clock(about.silent_s)}", BAD)
    if not board.run:
        return Text("waits for a run", DIM)
    doing = DOING.get(Label(board.now[1]), "") if board.recent.blocks else ""
    style = STATES.get(board.state, "")
    right = Text(f"● {board.state or 'joined'}", style)
    if doing and doing != board.state:
        right.append(f", {doing}", "")
    return right.append(f"  {clock(board.index / board.rate_hz)}", DIM)


def _progress(board: Board, width: int) -> Text:
    """Step, how much of the test is done, and how long it still takes by the plan."""
    left = Text(_where(board, width >= 100))
    planned = board.start.planned_samples if board.start else 0
    if planned <= 0:
        return left
    share = min(board.index / planned, 1.0)
    words = f" {100 * share:3.0f} %"
    if board.state == "holding":
        words += "  until resumed"
    elif board.stop is None:
        left_s = (planned - board.index) / board.rate_hz
        words += f"  {clock(abs(left_s))} {'left' if left_s >= 0 else 'over'}"
    wide = width - left.cell_len - len(words)
    if wide >= 4:
        left.append_text(bar(share, wide, GOOD))
    return _ends(left, Text(words), width) if wide < 4 else left.append(words)


def _where(board: Board, cycles: bool) -> str:
    """The step under way, always as long, so that what follows does not jump."""
    step = board.step
    if step is None:
        when = "after" if board.stop else "between" if board.points else "before"
        return f"{f'{when} the steps':<33}"
    text = f"step {step.index + 1:>2}/{board.steps}  {step.frequency_hz:6.3f} Hz "
    text += f"{ARROWS.get(step.direction, '')} {step.direction:<8}"
    held = f"cycle {board.now[2] + 1}" if board.now[2] >= 0 else ""
    if held and board.profile:
        held += f"/{board.profile.sweep.cycles}"
    return f"{text:<33}" + (f"  {held:<13}" if cycles else "")


def _connected(board: Board, about: About, width: int) -> Text:
    """One line: who is connected, and what of the recording is missing."""
    gaps = panels.gaps(board)
    there = panels.connected(board, about, width - gaps.cell_len - 12)
    return _ends(Text("connected  ", DIM).append_text(there), gaps, width)


def _keys(about: About, width: int) -> Text:
    if about.asked:
        return Text(f"{about.asked} the test?  y = yes, any other key = no", f"reverse {WARN}")
    line = Text()
    for key, word in {"q": "quit", **(ORDERS if about.commands else {})}.items():
        line.append(key, "bold").append(f" {word}  "[: None if width >= 44 else -1], DIM)
    return line
