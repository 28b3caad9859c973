"""Monitor application: event loop with bus link, terminal and keyboard."""

import io
import os
import select
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.text import Text

from table_io.clock import RealClock
from table_io.errors import InputError
from table_io.records import Comparison
from twin.live.control import send_command
from twin.monitor.run_state import LiveRunState, update_run_state
from twin.monitor.run_view import SILENT_S, RunView, SessionStatus
from twin.monitor.screen import COMMAND_KEYS, draw_screen
from twin.security.access_control import user_name
from twin.security.credentials import Credentials
from twin.system.progress import RunProgress
from twin.system.terminal import console, print_line
from twin.transport.codec import RECORD_TOPICS, Item, WireError, decode_item
from twin.transport.endpoint import MEAS_TOPIC, STREAM_TOPICS, check_endpoint
from twin.transport.reliable_subscriber import ReliableSubscriber
from twin.transport.zenoh_link import BusLink, open_spoke

ANSWER_TIMEOUT_S = 2.0
FRAME_S = 0.25
POLL_S = 0.05  # period of keyboard polling
SNAPSHOT_S = 1.5  # listening time for a snapshot, which shows the last second
START_TIMEOUT_S = 5.0  # wait for the start record of a run
QUEUE_CAPACITY = 5000
MAX_ITEMS = 1000  # per drain, so that a replay at full speed leaves time to draw
COMPARISON_TOPIC = RECORD_TOPICS[Comparison]
LIVE_TOPICS = (MEAS_TOPIC, COMPARISON_TOPIC)  # without history: old samples are not shown
HISTORY_TOPICS = tuple(topic for topic in RECORD_TOPICS.values() if topic not in STREAM_TOPICS)
DEFAULT_SIZE = 120, 40
CommandSender = Callable[[str], str]  # command -> result for the user
# Synchronized update: the terminal shows a frame at once.
BEGIN_UPDATE = "\x1b[?2026h"
END_UPDATE = "\x1b[?2026l"


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


class MonitorClient:
    """Bus client that receives a run and updates its run state."""

    def __init__(
        self, link: BusLink, user: str, live_topics: tuple[str, ...] = LIVE_TOPICS
    ) -> None:
        self.run_state = LiveRunState()
        self.ignored = 0
        self.role = ""  # of the user, as the gateway has it
        self._link = link
        self._user = user
        self._components = link.watch_components()
        self._records = link.subscribe(HISTORY_TOPICS, history=True, capacity=QUEUE_CAPACITY)
        self._blocks = link.subscribe(live_topics, history=False, capacity=QUEUE_CAPACITY)
        self._clock = RealClock()
        self._last_arrival_s = self._clock.now()

    def listen(self, seconds: float) -> list[Item]:
        """Receive for `seconds` and update the run state; return the received records."""
        deadline = self._clock.now() + seconds
        items = self._drain(self._records, seconds)
        while (remaining_s := deadline - self._clock.now()) > 0:
            items += self._drain(self._records, remaining_s)
        self._drain(self._blocks, 0.0)
        return items

    def _drain(self, subscriber: ReliableSubscriber, seconds: float) -> list[Item]:
        """Process queued messages and return their items; wait at most `seconds` for the first."""
        items: list[Item] = []
        while len(items) < MAX_ITEMS and (message := subscriber.get(seconds)) is not None:
            self._last_arrival_s, seconds = self._clock.now(), 0.0
            try:
                run, item = decode_item(*message)
            except WireError:
                self.ignored += 1
                continue
            previous, self.run_state = self.run_state, update_run_state(self.run_state, run, item)
            if previous.run != self.run_state.run:
                self.role = (self._link.query(f"state/role/{self._user}") or b"").decode()
            items.append(item)
        return items

    def session_status(self, pending_command: str = "") -> SessionStatus:
        """Return the session status shown on the screen in addition to the run state."""
        silent_s = self._clock.now() - self._last_arrival_s
        return SessionStatus(
            frozenset(self._components), silent_s, self.role == "command", pending_command
        )

    def view(self, pending_command: str = "") -> RunView:
        """Return what is shown of the run now."""
        return RunView(self.run_state, self.session_status(pending_command))

    def wait_for_run(self, wait: bool) -> None:
        """Listen until a run is known and one second of it received.

        Without `wait`, raise InputError if none appears within `START_TIMEOUT_S`.
        """
        deadline = self._clock.now() + START_TIMEOUT_S
        while self.run_state.start is None:
            self.listen(POLL_S)
            if not wait and self._clock.now() > deadline:
                raise InputError(
                    f"no test at the endpoint within {START_TIMEOUT_S:g} s",
                    allowed="a test that is running or has just ended",
                    remedy="start one with `shaketwin run`",
                )
        self.listen(SNAPSHOT_S)


def run_monitor(
    connect: str,
    rig: str,
    wait: bool,
    once: bool,
    picture: Path | None,
    credentials: Credentials | None,
) -> None:
    """Run the monitor: interactive in a terminal, otherwise line output; or one snapshot."""
    user = user_name(credentials)
    link = connect_observer(connect, rig, wait, credentials)
    if link is None:
        return
    link.declare_alive(f"observer.{user}.monitor-{os.getpid()}")
    try:
        client = MonitorClient(link, user)
        if once or picture is not None:
            client.wait_for_run(wait)
            write_snapshot(client, picture)
        elif sys.stdin.isatty() and console.is_terminal:
            signal.signal(signal.SIGTERM, signal.default_int_handler)
            with open_display(console) as display:
                run_event_loop(
                    client,
                    display,
                    lambda command: submit_command(command, connect, rig, credentials),
                )
        else:
            print_progress(client)
    except KeyboardInterrupt:
        print_line("monitor closed; the test continues")
    finally:
        link.close()


def connect_observer(
    connect: str,
    rig: str,
    wait: bool,
    credentials: Credentials | None,
    should_stop: Callable[[], bool] = lambda: False,
) -> BusLink | None:
    """Connect to the endpoint; with `wait`, retry until it answers and print the reason once.

    None only if `should_stop()` before that.
    """
    check_endpoint(rig, connect, credentials is not None)
    is_reported = False
    while not should_stop():
        try:
            return open_spoke(rig, connect, ANSWER_TIMEOUT_S, credentials)
        except InputError as error:
            if not wait:
                raise
            if not is_reported:
                print_line(f"waiting: {error}")
            is_reported = True
    return None


def run_event_loop(client: MonitorClient, display: TerminalDisplay, send: CommandSender) -> None:
    """Draw the screen and handle keys until `q`; a command is sent only after `y`."""
    clock, pending, drawn_s = RealClock(), "", float("-inf")
    while (key := display.read_key()) != "q" or pending:
        if pending and key:
            if key == "y":
                client.run_state.add_message(send(pending))
            pending = ""
        elif not pending and client.session_status().may_command:
            pending = COMMAND_KEYS.get(key, "")
        client.listen(POLL_S)
        if key or clock.now() >= drawn_s + FRAME_S:
            drawn_s = clock.now()
            display.show(draw_screen(client.view(pending), *display.size))


def submit_command(command: str, connect: str, rig: str, credentials: Credentials | None) -> str:
    """Send a command as `shaketwin control` does; return its result in one sentence."""
    try:
        return send_command(command, "requested from the monitor", connect, rig, credentials)
    except InputError as error:
        return f"refused: {error}"


def print_progress(client: MonitorClient) -> None:
    """Print one line per step and event until the run ends, for output without a terminal."""
    items = client.listen(FRAME_S)
    while client.run_state.start is None:
        items += client.listen(FRAME_S)
    with RunProgress(
        console, client.run_state.step_count, client.run_state.start.planned_samples
    ) as progress:
        is_silent = False
        while True:
            for item in items:
                progress(item)
            if client.run_state.stop is not None:
                progress.print_line(
                    f"ended: {client.run_state.stop.verdict}: {client.run_state.stop.reason}"
                )
                return
            items, was_silent = client.listen(FRAME_S), is_silent
            is_silent = client.session_status().silent_s > SILENT_S
            if is_silent and not was_silent:
                progress.print_line("no data received; waiting (Ctrl-C to quit)")


def write_snapshot(client: MonitorClient, picture: Path | None) -> None:
    """Write the screen once, as text to the console or as a new .svg file."""
    width, height = console.size if console.is_terminal or "COLUMNS" in os.environ else DEFAULT_SIZE
    lines = draw_screen(client.view(), width, height)
    if picture is None:
        for line in lines:
            console.print(line, soft_wrap=True, highlight=False)
        return
    svg_console = Console(record=True, width=width, height=height, file=io.StringIO())
    for line in lines:
        svg_console.print(line, highlight=False)
    try:
        with picture.open("x") as file:
            file.write(svg_console.export_svg(title="shaketwin monitor"))
    except FileExistsError:
        raise InputError("exists already", where=picture, remedy="choose another name") from None
    except OSError as error:
        raise InputError(f"cannot write here: {error.strerror}", where=picture) from None
    print_line(f"{picture}")


@contextmanager
def open_display(console: Console) -> Iterator[TerminalDisplay]:
    """Open the display; the terminal settings are restored on exit."""
    import termios  # not on Windows, where only this display is missing
    import tty

    keyboard = sys.stdin.fileno()
    attributes = termios.tcgetattr(keyboard)
    try:
        tty.setcbreak(keyboard)
        with console.screen(hide_cursor=True):
            yield TerminalDisplay(console)
    finally:
        termios.tcsetattr(keyboard, termios.TCSADRAIN, attributes)
