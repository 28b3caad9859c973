"""Terminal display that writes only changed lines, and reads keys."""

import os
import select
import sys
import termios
import tty
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from rich.console import Console
from rich.text import Text

BEGIN_UPDATE, END_UPDATE = (
    "\x1b[?2026h",
    "\x1b[?2026l",
)  # synchronized update: the terminal shows a frame at once


class TerminalDisplay:
    """Alternate screen of `console`; created by `open_display`."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._lines: list[Text] = []
        self._size = (0, 0)

    @property
    def size(self) -> tuple[int, int]:
        """Current size of the terminal (columns, lines)."""
        return self._console.size.width, self._console.size.height

    def show(self, lines: Sequence[Text]) -> None:
        """Show the lines; only changed lines are written."""
        redraw = self._size != self.size or len(self._lines) != len(lines)
        parts = ["\x1b[2J"] if redraw else []
        for row, line in enumerate(lines):
            if redraw or line != self._lines[row]:
                with self._console.capture() as output:
                    self._console.print(line, end="", soft_wrap=True, highlight=False)
                parts.append(f"\x1b[{row + 1};1H{output.get()}\x1b[K")
        self._lines, self._size = list(lines), self.size
        if parts:
            self._console.file.write(BEGIN_UPDATE + "".join(parts) + END_UPDATE)
            self._console.file.flush()

    def read_key(self) -> str:
        """Return the pressed key, "" if none, "q" if the terminal is closed."""
        ready, _, _ = select.select([sys.stdin], [], [], 0.0)
        if not ready:
            return ""
        keys = os.read(sys.stdin.fileno(), 64).decode(errors="replace")
        return keys[:1] if keys else "q"


@contextmanager
def open_display(console: Console) -> Iterator[TerminalDisplay]:
    """Open the display; the terminal settings are restored on exit."""
    keyboard = sys.stdin.fileno()
    attributes = termios.tcgetattr(keyboard)
    try:
        tty.setcbreak(keyboard)
        with console.screen(hide_cursor=True):
            yield TerminalDisplay(console)
    finally:
        termios.tcsetattr(keyboard, termios.TCSADRAIN, attributes)
