"""Native Rerun viewer: open a window, or take a screenshot without a display."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from socket import socket
from typing import Any
from urllib.parse import quote

from rerun.experimental import ViewerClient

from table_io.errors import InputError, format_pip_line
from twin.viewer.address import find_free_address, is_listening, viewer_url

# Screenshots are compared until the picture is stable.
SETTLE_CHECK_S = 1.0
MAX_CHECKS = 20
MAX_CHECKS_LIVE = 3
MAX_TRIES = 5
EXIT_TIMEOUT_S = 2.0  # for a viewer that has broken the connection
WEB_VIEWER_ADDRESS, WEB_DATA_ADDRESS = "127.0.0.1:9090", "127.0.0.1:9900"


def find_viewer() -> Path:
    """Return the path of the viewer program of the SDK, not of the script on PATH."""
    spec = find_spec("rerun_cli")
    folders = [Path(folder) for folder in spec.submodule_search_locations or ()] if spec else []
    names = ("rerun", "rerun.exe", "Rerun.app/Contents/MacOS/Rerun")
    for path in (folder / name for folder in folders for name in names):
        if path.is_file():
            return path
    raise InputError("the Rerun viewer is not installed", remedy=format_pip_line("view"))


def open_viewer(source: Path | str) -> str:
    """Open a file or a live URL in the native viewer; return a message for the user."""
    if isinstance(source, Path) and not source.is_file():
        raise InputError("no such file", where=source, remedy="give an .rrd file")
    program = find_viewer()
    has_display = any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))
    if sys.platform == "linux" and not has_display:
        return (
            f"no display on this computer; on one with a display: rerun {source}\n"
            f"or in a browser on this computer: {program} --web-viewer --bind 127.0.0.1 {source}"
        )
    return f"viewer opened (process {_launch_viewer(program, '--port', 'auto', str(source)).pid})"


def _launch_viewer(program: Path, *arguments: str) -> "subprocess.Popen[bytes]":
    """Start the viewer as a separate process, bound to loopback (its default: all interfaces)."""
    devnull = subprocess.DEVNULL
    command = [str(program), "--bind", "127.0.0.1", *arguments]
    return subprocess.Popen(
        command, stdin=devnull, stdout=devnull, stderr=devnull, start_new_session=True
    )


@contextmanager
def serve_web_viewer(source: Path | str) -> Iterator[str]:
    """Serve a file or a live URL with the web viewer, on loopback; yield the address to open."""
    page = find_free_address(WEB_VIEWER_ADDRESS)
    data = find_free_address(WEB_DATA_ADDRESS)
    ports = (address.rpartition(":")[2] for address in (data, page))
    arguments = ("--serve-web", "--port", next(ports), "--web-viewer-port", next(ports))
    process = _launch_viewer(find_viewer(), *arguments, str(source))
    url = source if isinstance(source, str) else viewer_url(data)
    try:
        while not is_listening(page):
            _wait_or_fail(process, 0.1)
        yield f"http://{page}?url={quote(url, safe='')}"
    finally:
        process.terminate()
        process.wait(10)


def take_screenshot(source: Path | str, png: Path, at_s: float | None = None) -> list[str]:
    """Write a 1920 x 1080 screenshot without a display; return the error reports of the views.

    `at_s` is the time shown; by default 90 % of a file, or the current time of a live URL.
    """
    is_live = isinstance(source, str)
    with socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = str(probe.getsockname()[1])
    process = _launch_viewer(find_viewer(), "--headless", "--port", port)
    try:
        client = _connect_client(process, f"rerun+http://127.0.0.1:{port}/proxy")
        location = source if isinstance(source, str) else str(source.resolve())
        _retry_request(process, lambda: client.open(location))
        end_s = _wait_until_loaded(process, client, is_live)
        if at_s is not None or not is_live:
            shown_s = 0.9 * end_s if at_s is None else at_s
            _retry_request(
                process,
                lambda: client.set_time("time", duration=float(shown_s), play_state="paused"),
            )
        _wait_until_settled(process, client, MAX_CHECKS_LIVE if is_live else MAX_CHECKS)
        _retry_request(process, lambda: client.save_screenshot(str(png.resolve())))
        views = _retry_request(process, client.get_state).views
        return [f"{view.name}: {report.summary}" for view in views for report in view.reports]
    finally:
        process.terminate()
        process.wait(10)


def _wait_until_loaded(process: "subprocess.Popen[bytes]", client: Any, is_live: bool) -> float:
    """Wait until the file, or the first live data, is loaded; return its end time in s."""
    for _ in range(600):
        state = _retry_request(process, client.get_state)
        timelines = [timeline for recording in state.recordings for timeline in recording.timelines]
        ends = [timeline.end for timeline in timelines if timeline.name == "time"]
        if ends and (is_live or not state.loading):
            return 1e-9 * float(max(ends))
        _wait_or_fail(process, 0.1)
    raise InputError(
        "the viewer finds no recording", remedy="give an .rrd file or the URL of a live view"
    )


def _wait_until_settled(process: "subprocess.Popen[bytes]", client: Any, max_checks: int) -> None:
    """Wait until two screenshots are equal: the first frames lack data that load later."""
    image = b""
    for _ in range(max_checks):
        _wait_or_fail(process, SETTLE_CHECK_S)
        previous = image
        image = _retry_request(process, lambda: client.take_screenshot(max_size=960))
        if image == previous:
            return


def _retry_request(process: "subprocess.Popen[bytes]", request: Callable[[], Any]) -> Any:
    """Return the answer of the viewer; retry on a timeout, as on a busy computer."""
    for _ in range(MAX_TRIES):
        try:
            return request()
        except TimeoutError:
            continue
        except ConnectionError:  # a viewer that cannot draw exits
            _wait_or_fail(process, EXIT_TIMEOUT_S)
    raise InputError("the Rerun viewer does not answer in time", remedy="try again later")


def _wait_or_fail(process: "subprocess.Popen[bytes]", seconds: float) -> None:
    """Wait; raise InputError if the viewer exits meanwhile."""
    try:
        process.wait(seconds)
    except subprocess.TimeoutExpired:
        return
    raise InputError(
        "the Rerun viewer cannot draw: a graphics library is missing",
        remedy="run: apt-get install mesa-vulkan-drivers libvulkan1 libxkbcommon-x11-0",
    )


def _connect_client(process: "subprocess.Popen[bytes]", url: str) -> Any:
    """Return a client of the viewer as soon as it answers; wait at most 15 s."""
    for _ in range(150):
        _wait_or_fail(process, 0.1)
        try:
            return ViewerClient(url)
        except ConnectionError:
            continue
    raise InputError(
        "the Rerun viewer does not answer", remedy="check that it starts on its own: rerun"
    )
