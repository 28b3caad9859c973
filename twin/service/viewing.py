"""Rerun with the project's layout, on a recording or on a running test."""

import tempfile
from collections.abc import Callable
from pathlib import Path

from table_io.card import BadInput
from table_io.clock import RealClock
from table_io.records import RunStart, RunStop
from twin.service.driving import VIEW_ADDRESS
from twin.service.terminal import say
from twin.stream.folder import log_path
from twin.stream.recording import read
from twin.stream.rerun_view import RerunView, open_viewer, screenshot, write_rrd
from twin.stream.wire import TOPIC_TYPES, Item, decode
from twin.stream.zenoh_link import Link, open_spoke

BATCH_S = 0.1
CAPACITY = 5000  # what does not fit is dropped: a viewer never slows a test
ANSWER_S = 2.0


def show(log: Path | None, save: Path | None, picture: Path | None, connect: str, rig: str) -> None:
    """The command: a recording, or without one a running test."""
    if log is None:
        view_live(connect, rig, VIEW_ADDRESS)
    else:
        view_log(log_path(log), save, picture)


def view_log(log: Path, save: Path | None, picture: Path | None) -> None:
    """Opens a recording; with `save` or `picture` it only writes these."""
    for new in (save, picture):
        if new is not None and not new.absolute().parent.is_dir():
            raise BadInput(f"{new}: its folder does not exist; make it, or give another place")
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


def view_live(endpoint: str, rig: str, address: str) -> None:
    """Serves a running test to Rerun until it ends or Ctrl-C."""
    link = open_spoke(rig, endpoint, ANSWER_S)
    say(f"live view: rerun rerun+http://{address}/proxy")
    try:
        serve(link, address, lambda: False)
    except KeyboardInterrupt:
        say("view closed; the test goes on")
    finally:
        link.close()


def serve(link: Link, address: str, given_up: Callable[[], bool]) -> None:
    """Feeds a view served at `address` in batches of 100 ms until the run has ended."""
    inbox = link.subscribe(tuple(TOPIC_TYPES), history=True, capacity=CAPACITY)
    clock = RealClock()
    view: RerunView | None = None
    waiting: list[Item] = []
    ended = False
    while not ended and not given_up():
        until = clock.now() + BATCH_S
        while (left := until - clock.now()) > 0:
            if (arrived := inbox.get(left)) is not None:
                waiting.append(decode(*arrived)[1])
        ended = any(isinstance(item, RunStop) for item in waiting)
        if view is None:
            starts = [item for item in waiting if isinstance(item, RunStart)]
            view = RerunView(starts[0], serve=address) if starts else None
        if view is not None:
            view.feed(waiting)
            waiting = []
    if view is not None:
        view.close()
