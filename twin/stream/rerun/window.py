"""The viewer that comes with Rerun: opened for a person, or made to draw a picture."""

import os
import subprocess
import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from socket import socket
from typing import Any

from rerun.experimental import ViewerClient

from table_io.card import BadInput

LOOK_S, LOOKS, LOOKS_LIVE = 1.0, 20, 3  # at what is drawn, until it stays as it is
TRIES = 5


def viewer() -> Path:
    """Path of the viewer that came with the SDK: the program itself, not the script on PATH."""
    spec = find_spec("rerun_cli")
    places = [Path(place) for place in spec.submodule_search_locations or ()] if spec else []
    names = ("rerun", "rerun.exe", "Rerun.app/Contents/MacOS/Rerun")
    for path in (place / name for place in places for name in names):
        if path.is_file():
            return path
    raise BadInput("the Rerun viewer is not installed; do: pip install rerun-sdk")


def open_viewer(source: Path | str) -> str:
    """What to tell a person, at once, after opening a file or a live URL in the native viewer."""
    if isinstance(source, Path) and not source.is_file():
        raise BadInput(f"{source}: no such file; give an .rrd file")
    program = viewer()
    screen = any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))
    if sys.platform == "linux" and not screen:
        return (
            f"no display here; where there is one: rerun {source}\n"
            f"or in a browser on this machine: {program} --web-viewer --bind 127.0.0.1 {source}"
        )
    return f"viewer opened (process {_launch(program, '--port', 'auto', str(source)).pid})"


def _launch(program: Path, *arguments: str) -> "subprocess.Popen[bytes]":
    """The viewer as a process of its own; it listens on every interface unless told otherwise."""
    quiet = subprocess.DEVNULL
    command = [str(program), "--bind", "127.0.0.1", *arguments]
    return subprocess.Popen(
        command, stdin=quiet, stdout=quiet, stderr=quiet, start_new_session=True
    )


def screenshot(source: Path | str, png: Path, at_s: float | None = None) -> list[str]:
    """Writes a 1920 x 1080 picture without a screen; returns what views complain of, if anything.

    `at_s` is the time shown, else nine tenths through a file, or now where it is a live URL.
    """
    live = isinstance(source, str)
    with socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = str(probe.getsockname()[1])
    process = _launch(viewer(), "--headless", "--port", port)
    try:
        client = _client(process, f"rerun+http://127.0.0.1:{port}/proxy")
        where = source if isinstance(source, str) else str(source.resolve())
        _patiently(lambda: client.open(where))
        end_s = _loaded(process, client, live)
        if at_s is not None or not live:
            at = 0.9 * end_s if at_s is None else at_s
            _patiently(lambda: client.set_time("time", duration=float(at), play_state="paused"))
        _settle(process, client, LOOKS_LIVE if live else LOOKS)
        _patiently(lambda: client.save_screenshot(str(png.resolve())))
        views = _patiently(client.get_state).views
        return [f"{view.name}: {one.summary}" for view in views for one in view.reports]
    finally:
        process.terminate()
        process.wait(10)


def _loaded(process: "subprocess.Popen[bytes]", client: Any, live: bool) -> float:
    """Time at the end of what the viewer has loaded, in s, once that is all or something live."""
    for _ in range(600):
        state = _patiently(client.get_state)
        timelines = [line for one in state.recordings for line in one.timelines]
        ends = [line.end for line in timelines if line.name == "time"]
        if ends and (live or not state.loading):
            return 1e-9 * float(max(ends))
        _wait(process, 0.1)
    raise BadInput(
        "the viewer finds no recording there; give an .rrd file or the URL of a live view"
    )


def _settle(process: "subprocess.Popen[bytes]", client: Any, looks: int) -> None:
    """Until two looks see the same: the first frames come without data, which is loaded late."""
    seen = b""
    for _ in range(looks):
        _wait(process, LOOK_S)
        before, seen = seen, _patiently(lambda: client.take_screenshot(max_size=960))
        if seen == before:
            return


def _patiently(ask: Callable[[], Any]) -> Any:
    """The viewer's answer, which on a busy machine takes longer than its client waits."""
    for _ in range(TRIES):
        try:
            return ask()
        except TimeoutError:
            continue
    raise BadInput("the Rerun viewer draws too slowly here: the machine is busy; try again later")


def _wait(process: "subprocess.Popen[bytes]", seconds: float) -> None:
    """Let time pass; BadInput if the viewer ends meanwhile."""
    try:
        process.wait(seconds)
    except subprocess.TimeoutExpired:
        return
    raise BadInput(
        "the Rerun viewer cannot draw here; it needs a graphics library: "
        "apt-get install mesa-vulkan-drivers libvulkan1 libxkbcommon-x11-0"
    )


def _client(process: "subprocess.Popen[bytes]", url: str) -> Any:
    """A client of the viewer once it answers, at most 15 s from now."""
    for _ in range(150):
        _wait(process, 0.1)
        try:
            return ViewerClient(url)
        except ConnectionError:
            continue
    raise BadInput("the Rerun viewer does not answer; see whether it starts by itself: rerun")
