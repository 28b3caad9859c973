"""`shaketwin view`: Rerun with the project's layout, on a recording or on a running test."""

import tempfile
from pathlib import Path

from rich.console import Console

from table_io.clock import RealClock
from table_io.records import RunStart, RunStop
from twin.service.processes import VIEWED
from twin.stream.mcap_log import read
from twin.stream.rerun_view import RerunView, open_viewer, screenshot, write_rrd
from twin.stream.wire import Item, decode

BATCH_S = 0.1


def view_log(log: Path, save: Path | None, picture: Path | None, console: Console) -> None:
    """Opens a recording; with `save` or `picture` it only writes these."""
    recording = read(log)
    if save is not None:
        write_rrd(recording, save)
        console.print(f"{save}", soft_wrap=True)
    with tempfile.TemporaryDirectory() as folder:
        rrd = save if save is not None else Path(folder) / "view.rrd"
        if save is None:
            write_rrd(recording, rrd)
        if picture is not None:
            screenshot(rrd, picture)
            console.print(f"{picture}", soft_wrap=True)
        if save is None and picture is None:
            open_viewer(rrd)


def view_live(endpoint: str, rig: str, address: str, console: Console) -> None:
    """Serves a running test to Rerun until it ends or Ctrl-C."""
    from twin.stream.zenoh_link import open_spoke

    link = open_spoke(rig, endpoint, 2.0)
    clock = RealClock()
    inbox = link.subscribe(VIEWED, history=True, capacity=5000)
    shown: RerunView | None = None
    try:
        waiting: list[Item] = []
        ended = False
        while not ended:
            until = clock.now() + BATCH_S
            while (left := until - clock.now()) > 0:
                if (arrived := inbox.get(left)) is not None:
                    waiting.append(decode(*arrived)[1])
            for item in waiting:
                ended = ended or isinstance(item, RunStop)
                if isinstance(item, RunStart) and shown is None:
                    shown = RerunView(item, serve=address)
                    console.print(f"live view: rerun rerun+http://{address}/proxy", soft_wrap=True)
            if shown is not None:
                shown.feed(waiting)
                waiting = []
    except KeyboardInterrupt:
        pass
    finally:
        if shown is not None:
            shown.close()
        link.close()
