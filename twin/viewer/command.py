"""`shaketwin view`: show a recording or a running test in Rerun."""

import os
import signal
import tempfile
from contextlib import nullcontext, suppress
from pathlib import Path

from table_io.clock import RealClock
from table_io.errors import InputError
from twin.recording.reader import read_recording
from twin.recording.run_paths import resolve_log_path
from twin.results.rerun import restore_predictions
from twin.security.access_control import user_name
from twin.security.credentials import Credentials
from twin.system.files import VIEW_PREFIX, lock_folder, make_private_folder
from twin.system.terminal import print_line
from twin.transport.zenoh_link import open_spoke
from twin.viewer.address import VIEW_ADDRESS, find_free_address, format_live_view, viewer_url
from twin.viewer.live_view import BATCH_S, LiveView
from twin.viewer.view import write_rrd
from twin.viewer.window import open_viewer, serve_web_viewer, take_screenshot

ANSWER_TIMEOUT_S = 2.0
CAPTURE_S = 6.0  # of a running test before its screenshot


def show_view(
    log: Path | None,
    save: Path | None,
    picture: Path | None,
    connect: str,
    rig: str,
    keys: Credentials | None = None,
    web: bool = False,
) -> None:
    """Show a recording, or a running test if `log` is None; with `web` in a browser."""
    if web and (save is not None or picture is not None):
        raise InputError(
            "does not go with --save and --picture", key="--web", remedy="give one of them"
        )
    if web:  # a SIGTERM ends the web viewer too
        signal.signal(signal.SIGTERM, signal.default_int_handler)
    if log is not None and web:
        view_log_in_browser(resolve_log_path(log))
    elif log is not None:
        view_log(resolve_log_path(log), save, picture)
    elif save is not None:
        raise InputError(
            "only a recording can be saved",
            where=f"--save {save}",
            remedy="give its LOG, or omit --save",
        )
    else:
        view_live(connect, rig, picture, keys, web)


def view_log(log: Path, save: Path | None, picture: Path | None) -> None:
    """Open a recording in Rerun; with `save` or `picture` only write these files."""
    for path in (save, picture):
        _require_parent(path)
    recording = restore_predictions(read_recording(log))
    if save is None and picture is None:
        rrd = make_private_folder(VIEW_PREFIX) / "view.rrd"
        write_rrd(recording, rrd)
        print_line(open_viewer(rrd))
        return
    with tempfile.TemporaryDirectory() as folder:
        rrd = save if save is not None else Path(folder) / "view.rrd"
        write_rrd(recording, rrd)
        if picture is not None:
            take_screenshot(rrd, picture)
    for path in (save, picture):
        if path is not None:
            print_line(f"{path}")


def view_log_in_browser(log: Path) -> None:
    """Serve a recording with the web viewer of Rerun until Ctrl-C."""
    with tempfile.TemporaryDirectory(prefix=VIEW_PREFIX) as folder, suppress(KeyboardInterrupt):
        lock_folder(Path(folder))
        rrd = Path(folder) / "view.rrd"
        write_rrd(restore_predictions(read_recording(log)), rrd)
        with serve_web_viewer(rrd) as url:
            print_line(f"page: {url}")
            print_line("Ctrl-C ends it")
            clock = RealClock()
            while True:
                clock.wait_until(clock.now() + 1.0)


def _require_parent(path: Path | None) -> None:
    """Raise InputError if the folder of a new file does not exist."""
    if path is not None and not path.absolute().parent.is_dir():
        raise InputError(
            "its folder does not exist", where=path, remedy="make it, or give another place"
        )


def view_live(
    connect: str,
    rig: str,
    picture: Path | None = None,
    keys: Credentials | None = None,
    web: bool = False,
) -> None:
    """Show a running test in Rerun until its end or Ctrl-C; with `picture` only a screenshot."""
    _require_parent(picture)
    link = open_spoke(rig, connect, ANSWER_TIMEOUT_S, keys)
    link.declare_alive(f"observer.{user_name(keys)}.view-{os.getpid()}")
    address = find_free_address(VIEW_ADDRESS)
    live = LiveView(link, address)
    try:
        while live.view is None and not live.is_over:
            live.listen(BATCH_S)
        if picture is not None:
            _take_screenshot(live, viewer_url(address), picture)
            return
        print_line(format_live_view(address))
        with serve_web_viewer(viewer_url(address)) if web else nullcontext("") as url:
            print_line(f"page: {url}" if web else open_viewer(viewer_url(address)))
            while not live.is_over:
                live.listen(BATCH_S)
            print_line(live.end_reason)
    except KeyboardInterrupt:
        print_line("view closed; the test goes on")
    finally:
        live.close()
        link.close()


def _take_screenshot(live: LiveView, source: str, picture: Path) -> None:
    """Write a screenshot of a running test after `CAPTURE_S`."""
    clock = RealClock()
    deadline_s = clock.now() + CAPTURE_S
    while clock.now() < deadline_s and not live.is_over:
        live.listen(BATCH_S)
    if live.is_over:
        raise InputError(f"{live.end_reason} before there was anything to draw; give its LOG")
    take_screenshot(source, picture)
    print_line(f"{picture}")
