"""The terminal: what is printed on it, and how a person stops what goes on."""

import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.table import Table

DECAYS = "stopping: the table decays to rest"
LONG_S = 1.5  # what comes out of a cache is there before
WIDE = 400  # columns of what is no terminal: a file has no edge at which a line must end


def _width() -> int | None:
    """Columns of standard output where nobody has to ask for them; None: the terminal knows."""
    asked = os.environ.get("COLUMNS", "").isdigit()
    return None if sys.stdout.isatty() or asked else WIDE


console = Console(width=_width())


def say(text: str) -> None:
    """One line as it is, whatever is in it; the terminal folds it, a file keeps it whole."""
    console.print(text, highlight=False, markup=False, soft_wrap=True)


def has_room(on: Console, table: Table) -> bool:
    """Whether a table can be read there: every cell in one line."""
    return on.measure(table, options=on.options.update(width=WIDE)).maximum <= on.width


def print_table(on: Console, table: Table) -> None:
    """The table, or where it has no room a line for each of its rows."""
    if has_room(on, table):
        on.print(table)
        return
    if table.title:
        on.print(table.title, highlight=False, soft_wrap=True)
    first, *rest = table.columns
    for place, name in enumerate(map(str, first.cells)):
        cells = [(str(one.header), str([*one.cells][place])) for one in rest]
        text = ", ".join(f"{head} {cell}" for head, cell in cells if cell)
        on.print(f"  {first.header} {name}: {text}", highlight=False, soft_wrap=True)


@contextmanager
def interruptible(
    sentence: str = "stopping: the table decays to rest",
) -> Iterator[Callable[[], str | None]]:
    """A question that answers why to stop once Ctrl-C or a termination was asked for.

    The sentence is said when that happens.
    """
    asked: list[int] = []

    def ask(number: int, _: object) -> None:
        if not asked:
            say(sentence)
        asked.append(number)

    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, ask) for number in numbers]
    try:
        yield lambda: f"interrupted ({signal.Signals(asked[0]).name})" if asked else None
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


@contextmanager
def said_if_long(sentence: str) -> Iterator[None]:
    """Says what is waited for once it has taken `LONG_S`."""
    before = signal.signal(signal.SIGALRM, lambda *_: say(sentence))
    signal.setitimer(signal.ITIMER_REAL, LONG_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
