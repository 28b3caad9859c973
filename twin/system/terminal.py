"""Terminal output, and interruption by Ctrl-C."""

import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, RenderableType
from rich.errors import LiveError
from rich.markup import escape
from rich.segment import Segment
from rich.table import Table

from table_io.errors import replace_escapes

STOP_SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT")  # Ctrl-C, kill, a closed window, Ctrl-\\
ANNOUNCE_AFTER_S = 1.5  # longer than loading from a cache
VERDICT_COLOURS = {
    "agrees": "green", "reached": "green", "departs": "red", "missed": "red",
    "not judged": "yellow",
}  # fmt: skip
FILE_COLUMNS = 400  # of output to a file or pipe, where lines need no wrapping


def _console_columns() -> int | None:
    """Return the columns of standard output, or None to ask the terminal or COLUMNS."""
    return None if sys.stdout.isatty() or os.environ.get("COLUMNS", "").isdigit() else FILE_COLUMNS


class SafeConsole(Console):
    """Console that replaces what a terminal would obey in text: names and titles may be foreign.

    For the same reason brackets in text are no markup; styles are arguments.
    """

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterator[Segment]:
        for segment in super().render(renderable, options):
            is_text = segment.control is None
            yield Segment(replace_escapes(segment.text), segment.style) if is_text else segment


console = SafeConsole(width=_console_columns(), markup=False)
error_console = SafeConsole(stderr=True, markup=False)


def print_line(text: str) -> None:
    """Print a line verbatim, without markup; only the terminal wraps it."""
    console.print(text, highlight=False, soft_wrap=True)


def draw_qr_code(text: str) -> list[str]:
    """Return the lines of a QR code in half-block characters, light modules filled."""
    import segno

    rows = [[*row] for row in segno.make(text, error="l").matrix_iter(border=2)]
    rows += [[0] * len(rows[0])] * (len(rows) % 2)
    return [
        "".join("█▀▄ "[2 * top + bottom] for top, bottom in zip(upper, lower, strict=True))
        for upper, lower in zip(rows[::2], rows[1::2], strict=True)
    ]


def print_qr_code(text: str) -> None:
    """Print text as a QR code on a terminal; nothing to a file or pipe."""
    for line in draw_qr_code(text) if console.is_terminal else ():
        console.print(line, style="white on black", highlight=False, soft_wrap=True)


def fits_width(on: Console, table: Table) -> bool:
    """Return True if the console is wide enough for every cell of a table in one line."""
    for column in table.columns:  # once: rich measures every cell again where no width is set
        texts = (replace_escapes(str(cell)) for cell in (column.header, *column.cells))
        column.width = max(cell_len(line) for text in texts for line in text.split("\n"))
    return on.measure(table, options=on.options.update(width=FILE_COLUMNS)).maximum <= on.width


def print_table(on: Console, table: Table) -> None:
    """Print a table, or one line per row if the console is too narrow."""
    if fits_width(on, table):
        on.print(table)
        return
    if table.title:
        on.print(table.title, highlight=False, soft_wrap=True)
    name_column, *columns = table.columns
    for row, name in enumerate(map(str, name_column.cells)):
        cells = [(str(column.header), str([*column.cells][row])) for column in columns]
        text = ", ".join(f"{head} {cell}" for head, cell in cells if cell)
        on.print(f"  {name_column.header} {name}: {text}", highlight=False, soft_wrap=True)


@contextmanager
def catch_interrupts(
    sentence: str = "stopping: the table decays to rest",
) -> Iterator[Callable[[], str | None]]:
    """Catch the signals of `STOP_SIGNALS`; yield a function that returns the reason to stop.

    It returns None before a signal; the sentence is printed at the first one. A SIGHUP that is
    ignored stays ignored: a test started with `nohup` outlives its terminal.
    """
    signals: list[int] = []

    def handle_signal(number: int, _: object) -> None:
        if not signals:
            print_line(sentence)
        signals.append(number)

    numbers = [getattr(signal, name) for name in STOP_SIGNALS if hasattr(signal, name)]
    old_handlers = {
        number: signal.signal(number, handle_signal)
        for number in numbers
        if number != getattr(signal, "SIGHUP", None) or signal.getsignal(number) != signal.SIG_IGN
    }
    try:
        yield lambda: f"interrupted ({signal.Signals(signals[0]).name})" if signals else None
    finally:
        for number, handler in old_handlers.items():
            signal.signal(number, handler)


@contextmanager
def show_status(text: str) -> Iterator[Callable[[str], None]]:
    """Show a line on a terminal while something silent runs; yield a function that adds a part.

    Nothing is shown under another progress bar.
    """
    status = console.status(text)
    with suppress(LiveError):
        if console.is_terminal:
            status.start()
    try:
        yield lambda part: status.update(f"{text}: {escape(part)}")
    finally:
        status.stop()


@contextmanager
def announce_if_slow(sentence: str, after_s: float = ANNOUNCE_AFTER_S) -> Iterator[None]:
    """Print a sentence if the body takes longer than `after_s`; on Windows never."""
    if not hasattr(signal, "SIGALRM"):
        yield
        return
    old_handler = signal.signal(signal.SIGALRM, lambda *_: print_line(sentence))
    signal.setitimer(signal.ITIMER_REAL, after_s)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, old_handler)
