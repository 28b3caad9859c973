"""Where the view goes: files, this machine's ports, the viewer and its picture."""

import re
import socket
import urllib.request
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import numpy as np
import pytest

from table_io.errors import InputError
from tests.input_errors import raises_input_error
from tests.viewer.example_run import (
    blocks,
    recording,
    records,
    scalars,
    start,
)
from twin.viewer import window
from twin.viewer.address import find_free_address, format_live_view, parse_address, viewer_url
from twin.viewer.plots import BACKGROUND_COLOUR, LINE_STYLES, Rgb
from twin.viewer.view import RerunView
from twin.viewer.window import open_viewer, serve_web_viewer, take_screenshot


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return int(probe.getsockname()[1])


def test_file_and_server_at_once(tmp_path: Path) -> None:
    port = free_port()
    view = RerunView(start(), save=tmp_path / "v.rrd", serve=f"127.0.0.1:{port}")
    with raises_input_error(key="view address", value=f"127.0.0.1:{port}"):
        RerunView(start(), serve=f"127.0.0.1:{port}")
    view.feed(blocks()[:20])
    view.close()
    assert scalars(tmp_path / "v.rrd", "/u/measured")[0].size == 200 / 4  # lines of 500 Hz


def test_open_viewer_without_display_names_the_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert "--bind 127.0.0.1" in open_viewer("rerun+http://127.0.0.1:9876/proxy")
    with raises_input_error(where=tmp_path / "none.rrd"):
        open_viewer(tmp_path / "none.rrd")
    monkeypatch.setattr(window, "find_spec", lambda _: None)
    with raises_input_error(remedy="shaketwin[view]"):
        open_viewer("rerun+http://127.0.0.1:9876/proxy")


@pytest.mark.slow  # 5 s
def test_the_picture_of_a_running_test(tmp_path: Path) -> None:
    address = f"127.0.0.1:{free_port()}"
    view = RerunView(start(), serve=address)
    items = recording([*blocks(), *records()]).items
    view.feed([item for item in items if item.index < 8000])
    assert draw_views(viewer_url(address), tmp_path / "live.png") == []
    view.close()
    picture = pixels(tmp_path / "live.png")
    height, width = picture.shape[:2]
    assert redness(picture[: int(0.8 * height), width // 2 :]) > 300


def draw_views(source: Path | str, png: Path, at_s: float | None = None) -> list[str]:
    """What views complain of; skips where nothing can be drawn, and nowhere else."""
    try:
        return take_screenshot(source, png, at_s)
    except InputError as error:
        if not re.search("graphics library is missing|not answer in time", str(error)):
            raise
        pytest.skip(str(error))


def pixels(path: Path) -> Any:
    """(row, column, colour) of a picture."""
    image = pytest.importorskip("PIL.Image")
    return np.asarray(image.open(path).convert("RGB")).astype(int)


def redness(picture: Any) -> int:
    """How many pixels have the colour of what is measured."""
    red = (picture[..., 0] > 200) & (picture[..., 1] < 140) & (picture[..., 2] < 140)
    return int(red.sum())


def test_the_picture(whole: Path, tmp_path: Path) -> None:
    assert draw_views(whole, tmp_path / "view.png", 4.0) == []
    picture = pixels(tmp_path / "view.png")
    height, width = picture.shape[:2]
    for rows in np.array_split(np.arange(int(0.8 * height)), 3):
        assert redness(picture[rows][:, width // 2 :]) > 100  # u, acceleration, force
    assert redness(picture[height // 3 : 2 * height // 3, : width // 3]) > 20  # PRC
    assert redness(picture[2 * height // 3 :, : width // 5]) > 100  # phase plane
    assert np.unique(picture[: height // 3, : width // 4].reshape(-1, 3), axis=0).shape[0] > 50


def test_screenshot_without_graphics_library_names_the_remedy(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WGPU_BACKEND", "vulkan")
    for name in ("VK_DRIVER_FILES", "VK_ICD_FILENAMES"):  # new and old name of the drivers' list
        monkeypatch.setenv(name, str(tmp_path / "none.json"))
    with raises_input_error(problem="a graphics library is missing"):
        take_screenshot(whole, tmp_path / "view.png")


def test_a_view_on_a_taken_port_takes_the_next() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        with pytest.raises(InputError) as refused:
            parse_address(f"127.0.0.1:{port}")
        assert refused.value.value == f"127.0.0.1:{port}"
        host, _, other = find_free_address(f"127.0.0.1:{port}").rpartition(":")
        assert host == "127.0.0.1"
        assert int(other) > port
        assert parse_address(f"{host}:{other}") == (host, int(other))
    assert "127.0.0.1:9876" in format_live_view("127.0.0.1:9877")
    assert "(" not in format_live_view("127.0.0.1:9876")


def test_the_web_viewer_serves_on_this_computer_until_the_end(whole: Path) -> None:
    with serve_web_viewer(whole) as url:
        page, _, source = url.partition("?url=")
        with urllib.request.urlopen(page) as answer:
            assert answer.status == 200
        host, port = urlsplit(page).netloc.split(":")
        assert host == "127.0.0.1"
        assert re.fullmatch(r"rerun\+http://127\.0\.0\.1:\d+/proxy", unquote(source))
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection((host, int(port)))


@pytest.mark.parametrize(
    "colour", sorted({line[1] for lines in LINE_STYLES.values() for line in lines})
)
def test_lines_are_legible_in_both_themes(colour: Rgb) -> None:
    for background in ((255, 255, 255), BACKGROUND_COLOUR):
        dark, light = sorted(map(luminance, (colour, background)))
        assert (light + 0.05) / (dark + 0.05) >= 3.0


def luminance(colour: Rgb) -> float:
    """Relative luminance after WCAG 2."""
    parts = [c / 255 for c in colour]
    linear = [p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]
