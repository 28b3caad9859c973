"""Rerun with the project's layout, on a recording or on a running test."""

import os
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from table_io.card import BadInput
from table_io.clock import RealClock
from table_io.records import RunStart, RunStop
from twin.service.tell import person
from twin.service.terminal import say
from twin.stream.endpoint import STREAMS, running
from twin.stream.folder import log_path
from twin.stream.keys import Keys
from twin.stream.recording import read
from twin.stream.rerun.address import VIEW_ADDRESS, live_view, next_free, url
from twin.stream.rerun.view import RerunView, write_rrd
from twin.stream.rerun.window import open_viewer, screenshot
from twin.stream.resend import Inbox
from twin.stream.wire import TOPIC_TYPES, Item, WireError, decode
from twin.stream.zenoh_link import Link, open_spoke

BATCH_S = 0.1
TURN_S = 0.02
CAPACITY = 15_000  # pieces; what does not fit is dropped: a viewer never slows a test
MOST = 1000  # taken in at a time: a replay at full speed leaves time to draw
ANSWER_S = 2.0
QUIET_S = 5.0  # after which it is asked whether the rig is still there
LAST_S = 0.3  # after the end, for the last blocks
PICTURED_S = 6.0  # of a running test before it is drawn
RECORDS = tuple(one for one in TOPIC_TYPES if one not in STREAMS)


def show(
    log: Path | None,
    save: Path | None,
    picture: Path | None,
    connect: str,
    rig: str,
    keys: Keys | None = None,
) -> None:
    """The command: a recording, or without one a running test."""
    if log is not None:
        view_log(log_path(log), save, picture)
    elif save is not None:
        raise BadInput(f"--save {save}: of a recording only; give its LOG, or leave --save away")
    else:
        view_live(connect, rig, picture, keys)


def view_log(log: Path, save: Path | None, picture: Path | None) -> None:
    """Opens a recording; with `save` or `picture` it only writes these."""
    for new in (save, picture):
        _room(new)
    recording = read(log)
    if save is None and picture is None:
        rrd = Path(tempfile.mkdtemp(prefix="shaketwin-")) / "view.rrd"
        write_rrd(recording, rrd)
        say(open_viewer(rrd))
        return
    with tempfile.TemporaryDirectory() as folder:
        rrd = save if save is not None else Path(folder) / "view.rrd"
        write_rrd(recording, rrd)
        if picture is not None:
            screenshot(rrd, picture)
    for written in (save, picture):
        if written is not None:
            say(f"{written}")


def _room(new: Path | None) -> None:
    """BadInput where there is no folder for a new file."""
    if new is not None and not new.absolute().parent.is_dir():
        raise BadInput(f"{new}: its folder does not exist; make it, or give another place")


def view_live(
    connect: str, rig: str, picture: Path | None = None, keys: Keys | None = None
) -> None:
    """Serves a running test to Rerun until it ends or Ctrl-C; with `picture` only draws that."""
    _room(picture)
    link = open_spoke(rig, connect, ANSWER_S, keys)
    link.alive(f"observer.{person(keys)}.view-{os.getpid()}")
    address = next_free(VIEW_ADDRESS)
    live = Live(link, address)
    try:
        while live.view is None and not live.ended:
            live.listen(BATCH_S)
        if picture is not None:
            _draw(live, url(address), picture)
            return
        say(live_view(address))
        say(open_viewer(url(address)))
        while not live.ended:
            live.listen(BATCH_S)
        say(live.end)
    except KeyboardInterrupt:
        say("view closed; the test goes on")
    finally:
        live.close()
        link.close()


def _draw(live: "Live", source: str, picture: Path) -> None:
    """A picture of a running test, once there are samples enough to fill it."""
    clock = RealClock()
    until = clock.now() + PICTURED_S
    while clock.now() < until and not live.ended:
        live.listen(BATCH_S)
    if live.ended:
        raise BadInput(f"{live.end} before there was anything to draw; give its LOG")
    screenshot(source, picture)
    say(f"{picture}")


def serve(link: Link, address: str, given_up: Callable[[], bool]) -> None:
    """Feeds a view served at `address` until the run has ended."""
    live = Live(link, address)
    while not live.ended and not given_up():
        live.listen(BATCH_S)
    live.close()


class Live:
    """A running test as a view: configuration, events and PRC so far, and samples from now on.

    Samples of the past are not fetched: so the rest is there at once.
    """

    def __init__(self, link: Link, address: str) -> None:
        self.view: RerunView | None = None
        self.end = ""  # in words, once it has come
        self.ignored = 0  # payloads that are not what their topic promises, or another run's
        self._link = link
        self._address = address
        self._run = ""
        self._blocks = link.subscribe(tuple(STREAMS), history=False, capacity=CAPACITY)
        self._records = link.subscribe(RECORDS, history=True, capacity=CAPACITY)
        self._clock = RealClock()
        self._heard = self._clock.now()
        self._early: list[tuple[str, Item]] = []  # (run, item), before the run is known

    @property
    def ended(self) -> bool:
        return bool(self.end)

    def listen(self, seconds: float) -> None:
        """Put on the screen what arrives within `seconds`."""
        until = self._clock.now() + seconds
        arrived: list[tuple[str, Item]] = []
        more = self.view is None  # of the past is on its way: asked for a chunk at a time
        while (left := until - self._clock.now()) > 0:
            told = self._take(self._records, min(left, TURN_S) if more else 0.0)
            more = bool(told)
            arrived += told
            arrived += self._take(self._blocks, 0.0 if more else min(left, TURN_S))
        if any(isinstance(item, RunStop) for _, item in arrived):
            while late := self._take(self._blocks, LAST_S):
                arrived += late
        self._show(arrived)
        if self._clock.now() > self._heard + QUIET_S:
            self._heard = self._clock.now()
            if not running(self._link.components()):
                self.end = "the rig is not there any more"

    def _take(self, inbox: Inbox, seconds: float) -> list[tuple[str, Item]]:
        """(run, item) of what waits in an inbox, after at most `seconds` of waiting for it."""
        found: list[tuple[str, Item]] = []
        while len(found) < MOST and (arrived := inbox.get(seconds)) is not None:
            self._heard, seconds = self._clock.now(), 0.0
            try:
                found.append(decode(*arrived))
            except WireError:
                self.ignored += 1
        return found

    def _show(self, arrived: Sequence[tuple[str, Item]]) -> None:
        """Feed the view, which begins with the start of a run."""
        for _, item in arrived:
            if self.view is None and isinstance(item, RunStart):
                self._run, self.view = item.run, RerunView(item, serve=self._address)
        if self.view is None:
            self._early += arrived
            return
        items = [item for run, item in (*self._early, *arrived) if run == self._run]
        self.ignored += len(self._early) + len(arrived) - len(items)
        self._early = []
        self.view.feed(items)
        for stop in (item for item in items if isinstance(item, RunStop)):
            self.end = f"the test is over: {stop.verdict}, {stop.reason}"

    def close(self) -> None:
        """Stop serving."""
        if self.view is not None:
            self.view.close()
