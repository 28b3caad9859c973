"""The monitor on a bus: who joins late, a rig that goes and comes, a terminal, a file, nobody."""

import errno
import fcntl
import io
import os
import pty
import re
import select
import struct
import subprocess
import sys
import termios
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest
from rich.console import Console
from rich.text import Text

from table_io.records import RunStop
from tests.builders.ports import free_endpoint
from tests.input_errors import raises_input_error
from tests.monitor.monitored import RUN, block, point, records, start, stream
from twin.monitor import app
from twin.monitor.app import MonitorClient, TerminalDisplay, run_event_loop, run_monitor
from twin.monitor.run_state import LiveRunState
from twin.monitor.run_view import RunView, SessionStatus
from twin.transport.codec import TOPIC_TYPES, Item, encode_item, topic_for
from twin.transport.zenoh_link import BusLink, open_hub, open_spoke

SHAKETWIN = str(Path(sys.executable).parent / "shaketwin")
MAX_ROUNDS = 200  # of 0.05 s: long enough for anything here


def publish(hub: BusLink, items: Sequence[Item], run: str = RUN) -> None:
    for item in items:
        hub.publish(topic_for(item), encode_item(item, run))


@contextmanager
def hub_at(place: str) -> Iterator[BusLink]:
    hub = open_hub("simulated", place)
    try:
        hub.declare(tuple(TOPIC_TYPES))
        yield hub
    finally:
        hub.close()


@contextmanager
def running(place: str) -> Iterator[None]:
    """A rig that has published what there is to know, and goes on with blocks; all may command."""
    over = threading.Event()
    with hub_at(place) as hub:
        roles = hub.declare_requests("state/role/*")

        def play() -> None:
            publish(hub, records())
            at = 7000
            while not over.wait(0.02):
                publish(hub, stream(at, at + 20))
                at += 20
                if (question := roles.poll()) is not None:
                    question.reply("command")

        player = threading.Thread(target=play)
        player.start()
        try:
            yield
        finally:
            over.set()
            player.join()


@contextmanager
def watching_at(place: str) -> Iterator[MonitorClient]:
    link = open_spoke("simulated", place, 5.0)
    try:
        yield MonitorClient(link, "ana")
    finally:
        link.close()


def until(watch: MonitorClient, hub: BusLink, what: Callable[[LiveRunState], object]) -> None:
    """Listen until something is true of the board."""
    for _ in range(MAX_ROUNDS):
        hub.serve()
        watch.listen(0.05)
        if what(watch.run_state):
            return
    raise AssertionError("it never came")


def test_late_monitor_gets_the_history_then_new_items() -> None:
    place = free_endpoint()
    with hub_at(place) as hub:
        publish(hub, [*records(), *stream(6000, 8000)])
        with watching_at(place) as watch:
            until(
                watch,
                hub,
                lambda b: b.start and len(b.points) == 3 and b.rig_state and len(b.events) == 4,
            )
            publish(hub, [block(8000)])
            until(watch, hub, lambda b: b.recent.end == 8020)
            # 50 s of old samples are nobody's wish
            assert [block.index for block in watch.run_state.recent.blocks] == [8000]
            assert watch.ignored == 0


def test_undecodable_bytes_are_ignored() -> None:
    place = free_endpoint()
    with hub_at(place) as hub, watching_at(place) as watch:
        hub.publish("/twin/point", b"\xff\xff garbage")
        publish(hub, [start(), point(1)])
        until(watch, hub, lambda b: b.points)
        assert watch.ignored == 1


def test_lost_rig_is_silent_and_a_new_run_is_shown() -> None:
    place = free_endpoint()
    with watching_after(place) as watch:
        watch.listen(0.1)
        assert watch.session_status().silent_s > 0.05
        with hub_at(place) as hub:
            publish(hub, [start("20260102-120000-next"), point(4)], "20260102-120000-next")
            until(watch, hub, lambda b: b.run.endswith("next") and list(b.points) == [4])


@contextmanager
def watching_after(place: str) -> Iterator[MonitorClient]:
    """A watch whose rig has gone after its records."""
    with hub_at(place) as hub:
        link = open_spoke("simulated", place, 5.0)
        watch = MonitorClient(link, "ana")
        publish(hub, records())
        until(watch, hub, lambda b: len(b.points) == 3)
    try:
        yield watch
    finally:
        link.close()


class Sheet(TerminalDisplay):
    """A display whose keys are told beforehand."""

    def __init__(self, keys: str) -> None:
        super().__init__(Console(file=io.StringIO()))
        self.keys = iter(keys)
        self.shown: list[str] = []

    def show(self, lines: Sequence[Text]) -> None:
        self.shown.append(lines[-1].plain)

    def read_key(self) -> str:
        return next(self.keys).replace("-", "")


class Still:
    """A watch at which nothing happens."""

    def __init__(self, commands: bool) -> None:
        self.run_state = LiveRunState()
        self.commands = commands

    def listen(self, seconds: float) -> list[Item]:
        return []

    def session_status(self) -> SessionStatus:
        return SessionStatus(may_command=self.commands)

    def view(self, pending: str = "") -> RunView:
        status = SessionStatus(may_command=self.commands, pending_command=pending)
        return RunView(self.run_state, status)


@pytest.mark.parametrize(
    ("keys", "commands", "orders"),
    [
        ("sy-q", True, ["stop"]),
        ("s--y-q", True, ["stop"]),
        ("snyq", True, []),
        ("sq-q", True, []),
        ("yq", True, []),
        ("hyryayq", True, ["hold", "resume", "abort"]),
        ("syhyq", False, []),
    ],
)
def test_command_is_sent_only_after_confirmation_with_the_role(
    keys: str, commands: bool, orders: list[str]
) -> None:
    given: list[str] = []

    def order(name: str) -> str:
        given.append(name)
        return f"told to {name}"

    watch, sheet = Still(commands), Sheet(keys)
    run_event_loop(watch, sheet, order)  # type: ignore[arg-type]
    assert given == orders
    assert [event.text for event in watch.run_state.events.values()] == [
        f"told to {order}" for order in orders
    ]
    assert any("y = yes" in line for line in sheet.shown) == (commands and keys != "yq")


def test_only_lines_that_changed_are_written() -> None:
    out = io.StringIO()
    sheet = TerminalDisplay(Console(file=out, width=20, height=3, force_terminal=True))
    sheet.show([Text("one"), Text("two")])
    assert "one" in out.getvalue()
    assert "\x1b[2J" in out.getvalue()
    out.truncate(0)
    sheet.show([Text("one"), Text("three", "red")])
    assert "one" not in out.getvalue()
    assert "three" in out.getvalue()
    assert "\x1b[2;1H" in out.getvalue()
    out.truncate(0)
    sheet.show([Text("one"), Text("three", "red")])
    assert out.getvalue().strip("\0") == ""


def test_snapshot_is_printed_or_written_as_svg(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(app, "SNAPSHOT_S", 0.2)
    place, picture = free_endpoint(), tmp_path / "now.svg"
    with running(place):
        run_monitor(place, "simulated", False, True, None, None)
        assert "watched" in capsys.readouterr().out
        run_monitor(place, "simulated", False, False, picture, None)
        assert "<svg" in picture.read_text()
        with raises_input_error(where=picture):
            run_monitor(place, "simulated", False, False, picture, None)
        with raises_input_error(
            where=tmp_path / "no" / "now.svg", problem=os.strerror(errno.ENOENT)
        ):
            run_monitor(place, "simulated", False, False, tmp_path / "no" / "now.svg", None)


def test_monitor_without_rig_or_run_reports_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(app, "ANSWER_TIMEOUT_S", 0.3)
    monkeypatch.setattr(app, "START_TIMEOUT_S", 0.3)
    place = free_endpoint()
    with raises_input_error(key="endpoint", value=place, problem="0.3 s"):
        run_monitor(place, "simulated", False, True, None, None)
    with raises_input_error(key="endpoint", value="nonsense"):
        run_monitor("nonsense", "simulated", True, True, None, None)
    with hub_at(place), raises_input_error(problem="0.3 s", remedy="shaketwin run"):
        run_monitor(place, "simulated", False, True, None, None)


def test_output_without_terminal_has_a_line_per_step() -> None:
    place = free_endpoint()
    with hub_at(place) as hub:
        publish(hub, [*records(), RunStop(8000, "complete", "all driven")])
        with subprocess.Popen(
            [SHAKETWIN, "monitor", "--connect", place],
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        ) as process:  # fmt: skip
            while process.poll() is None:
                hub.serve()
            output = process.stdout.read() if process.stdout else ""
    assert process.returncode == 0, output
    assert [line.split()[0] for line in output.splitlines() if "forward" in line] == [
        "1/10", "2/10", "3/10",
    ]  # fmt: skip
    assert "complete: all driven" in output


def test_terminal_is_drawn_and_restored(tmp_path: Path) -> None:
    place = free_endpoint()
    here, terminal = pty.openpty()
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    before = termios.tcgetattr(terminal)
    with running(place):
        process = subprocess.Popen(
            [SHAKETWIN, "monitor", "--connect", place],
            stdin=terminal, stdout=terminal, stderr=terminal,
            env={**os.environ, "TERM": "xterm-256color", "COLUMNS": "", "LINES": ""},
        )  # fmt: skip
        shown = read_until(here, rb"Warnings and events.*abort")
        assert b"\x1b[?1049h" in shown
        assert termios.tcgetattr(terminal)[3] != before[3]
        os.write(here, b"q")
        shown = read_until(here, rb"\x1b\[\?1049l")
        assert process.wait(20) == 0
    assert termios.tcgetattr(terminal) == before
    os.close(here)
    os.close(terminal)


def read_until(terminal: int, what: bytes) -> bytes:
    """What a terminal shows until that is in it."""
    shown = b""
    while not re.search(what, shown, re.DOTALL):
        assert select.select([terminal], [], [], 20.0)[0], f"never shown: {what!r}"
        shown += os.read(terminal, 65536)
        assert len(shown) < 200_000, f"never shown: {what!r}"
    return shown
