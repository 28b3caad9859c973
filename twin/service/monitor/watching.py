"""The monitor's shell: link, terminal and keyboard round the board."""

import contextlib
import io
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path

from rich.console import Console

from table_io.card import BadInput
from table_io.clock import RealClock
from table_io.records import Comparison
from twin.service.monitor.board import Board, step
from twin.service.monitor.display import Display, display
from twin.service.monitor.panels import About
from twin.service.monitor.screen import ORDERS, SILENT_S, screen
from twin.service.progress import RunProgress
from twin.service.tell import person, tell
from twin.service.terminal import console, say
from twin.stream.endpoint import check
from twin.stream.keys import Keys
from twin.stream.resend import Inbox
from twin.stream.wire import MEAS_TOPIC, RECORD_TOPICS, Item, WireError, decode
from twin.stream.zenoh_link import Link, open_spoke

ANSWER_S = 2.0
FRAME_S = 0.25
TURN_S = 0.05  # a key is looked for as often
ONCE_S = 1.5  # of listening for one picture, once the run is known; it shows the last second
FIRST_S = 5.0  # for the run to be known
CAPACITY = 5000
MOST = 1000  # items taken in at a time: a replay at full speed leaves time to draw
COMPARED = RECORD_TOPICS[Comparison]
NEWEST = (MEAS_TOPIC, COMPARED)  # begin now: nobody wants to see 50 s of old samples
WITH_HISTORY = tuple(one for one in RECORD_TOPICS.values() if one != COMPARED)
PLAIN_SIZE = 120, 40
Tell = Callable[[str], str]  # an order -> what came of it


class Watch:
    """What is heard at the end of a link, and the board that it fills."""

    def __init__(self, link: Link, who: str) -> None:
        self.board = Board()
        self.ignored = 0
        self._link = link
        self._who = who
        self._role = ""
        self._there = link.presence()
        self._records = link.subscribe(WITH_HISTORY, history=True, capacity=CAPACITY)
        self._blocks = link.subscribe(NEWEST, history=False, capacity=CAPACITY)
        self._clock = RealClock()
        self._heard = self._clock.now()

    def listen(self, seconds: float) -> list[Item]:
        """Take in what arrives within `seconds`; what it was, samples left out."""
        until = self._clock.now() + seconds
        items = self._take(self._records, seconds)
        while (left := until - self._clock.now()) > 0:
            items += self._take(self._records, left)
        self._take(self._blocks, 0.0)
        return items

    def _take(self, inbox: Inbox, seconds: float) -> list[Item]:
        """What waits in an inbox, after at most `seconds` of waiting for it."""
        items: list[Item] = []
        while len(items) < MOST and (arrived := inbox.get(seconds)) is not None:
            self._heard, seconds = self._clock.now(), 0.0
            try:
                run, item = decode(*arrived)
            except WireError:
                self.ignored += 1
                continue
            before, self.board = self.board, step(self.board, run, item)
            if before.run != self.board.run:
                self._role = (self._link.inquire(f"state/role/{self._who}") or b"").decode()
            items.append(item)
        return items

    def about(self, asked: str = "") -> About:
        """What the screen shows beside the board."""
        silent_s = self._clock.now() - self._heard
        return About(frozenset(self._there), silent_s, self._role == "command", asked)

    def until_known(self, wait: bool) -> None:
        """Listen until the run is known and a second of it heard; BadInput where none comes soon.

        Unless told to `wait`.
        """
        until = self._clock.now() + FIRST_S
        while self.board.start is None:
            self.listen(TURN_S)
            if not wait and self._clock.now() > until:
                raise BadInput(
                    f"no test at the endpoint within {FIRST_S:g} s; allowed: one that runs or has "
                    "just ended; start it with `shaketwin run`"
                )
        self.listen(ONCE_S)


def monitor(
    connect: str, rig: str, wait: bool, once: bool, picture: Path | None, keys: Keys | None
) -> None:
    """The command: a screen where there is a terminal, else lines; or one snapshot."""
    who = person(keys)
    link = _joined(connect, rig, wait, keys)
    link.alive(f"observer.{who}.monitor-{os.getpid()}")
    try:
        watch = Watch(link, who)
        if once or picture is not None:
            watch.until_known(wait)
            snapshot(watch, picture)
        elif sys.stdin.isatty() and console.is_terminal:
            signal.signal(signal.SIGTERM, signal.default_int_handler)
            with display(console) as sheet:
                attend(watch, sheet, lambda order: told(order, connect, rig, keys))
        else:
            follow(watch)
    except KeyboardInterrupt:
        say("monitor closed; the test goes on")
    finally:
        link.close()


def _joined(connect: str, rig: str, wait: bool, keys: Keys | None) -> Link:
    """A spoke at the endpoint; where nobody is there yet, waits if asked to and says why."""
    check(rig, connect, keys is not None)
    said = False
    while True:
        try:
            return open_spoke(rig, connect, ANSWER_S, keys)
        except BadInput as error:
            if not wait:
                raise
            if not said:
                say(f"waits: {error}")
            said = True


def attend(watch: Watch, sheet: Display, order: Tell) -> None:
    """Draw and obey keys until `q`; orders go out only after a `y`."""
    clock, asked, drawn = RealClock(), "", float("-inf")
    while (key := sheet.key()) != "q" or asked:
        if asked and key:
            if key == "y":
                watch.board.remark(order(asked))
            asked = ""
        elif not asked and watch.about().commands:
            asked = ORDERS.get(key, "")
        watch.listen(TURN_S)
        if key or clock.now() >= drawn + FRAME_S:
            drawn = clock.now()
            sheet.show(screen(watch.board, watch.about(asked), *sheet.size))


def told(order: str, connect: str, rig: str, keys: Keys | None) -> str:
    """Give an order as `shaketwin tell` does; its answer in one sentence."""
    words = io.StringIO()
    try:
        with contextlib.redirect_stdout(words):
            tell(order, "asked at a monitor", connect, rig, keys)
    except BadInput as error:
        return f"refused: {error}"
    return " ".join(words.getvalue().split())


def follow(watch: Watch) -> None:
    """Where there is no terminal: a line a step and an event, until the run has ended."""
    items = watch.listen(FRAME_S)
    while watch.board.start is None:
        items += watch.listen(FRAME_S)
    with RunProgress(console, watch.board.steps, watch.board.start.planned_samples) as progress:
        silent = False
        while True:
            for item in items:
                progress(item)
            if watch.board.stop is not None:
                progress.say(f"over: {watch.board.stop.verdict}: {watch.board.stop.reason}")
                return
            items, before = watch.listen(FRAME_S), silent
            silent = watch.about().silent_s > SILENT_S
            if silent and not before:
                progress.say("silent; waits until it is heard again, Ctrl-C ends this")


def snapshot(watch: Watch, picture: Path | None) -> None:
    """The screen once: as text, or as a new .svg file."""
    wide, high = console.size if console.is_terminal or "COLUMNS" in os.environ else PLAIN_SIZE
    lines = screen(watch.board, watch.about(), wide, high)
    if picture is None:
        for line in lines:
            console.print(line, soft_wrap=True, highlight=False)
        return
    paper = Console(record=True, width=wide, height=high, file=io.StringIO())
    for line in lines:
        paper.print(line, highlight=False)
    try:
        with picture.open("x") as file:
            file.write(paper.export_svg(title="shaketwin monitor"))
    except FileExistsError:
        raise BadInput(f"{picture}: exists already; nothing is ever overwritten") from None
    except OSError as error:
        raise BadInput(f"{picture}: cannot write here: {error.strerror}") from None
    say(f"{picture}")
