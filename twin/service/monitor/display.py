"""A terminal as a sheet of lines, of which only what changes is written, and a source of keys."""

import os
import select
import sys
import termios
import tty
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from rich.console import Console
from rich.text import Text

BEGIN, END = "\x1b[?2026h", "\x1b[?2026l"  # of one picture: the terminal shows it at once


class Display:
    """The alternate screen of `console`; made by `display`."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._shown: list[Text] = []
        self._size = (0, 0)

    @property
    def size(self) -> tuple[int, int]:
        """(columns, lines) of the terminal now."""
        return self._console.size.width, self._console.size.height

    def show(self, lines: Sequence[Text]) -> None:
        """Put the lines on the screen; only those that changed go over the wire."""
        anew = self._size != self.size or len(self._shown) != len(lines)
        parts = ["\x1b[2J"] if anew else []
        for row, line in enumerate(lines):
            if anew or line != self._shown[row]:
                with self._console.capture() as drawn:
                    self._console.print(line, end="", soft_wrap=True, highlight=False)
                parts.append(f"\x1b[{row + 1};1H{drawn.get()}\x1b[K")
        self._shown, self._size = list(lines), self.size
        if parts:
            self._console.file.write(BEGIN + "".join(parts) + END)
            self._console.file.flush()

    def key(self) -> str:
        """The key that was pressed, "" where none was; "q" once the terminal is gone."""
        ready, _, _ = select.select([sys.stdin], [], [], 0.0)
        if not ready:
            return ""
        pressed = os.read(sys.stdin.fileno(), 64).decode(errors="replace")
        return pressed[:1] if pressed else "q"


@contextmanager
def display(console: Console) -> Iterator[Display]:
    """The terminal as a sheet; given back as it was, however this ends."""
    keyboard = sys.stdin.fileno()
    before = termios.tcgetattr(keyboard)
    try:
        tty.setcbreak(keyboard)
        with console.screen(hide_cursor=True):
            yield Display(console)
    finally:
        termios.tcsetattr(keyboard, termios.TCSADRAIN, before)
