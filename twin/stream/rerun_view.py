"""The view: Blocks and records as moving pictures. The only file that knows rerun.

Everything goes out in columns, few entities with many instances, on one timeline `time` computed
from the sample index. Served, never connected outwards: a viewer that hangs cannot hold us up. What
is drawn depends on the samples only, never on how they were cut into blocks or batches.
"""

import os
import subprocess
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from socket import socket
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.experimental import ViewerClient

from table_io.block import Block, Float1D, Float2D, Int1D
from table_io.card import BadInput, parse
from table_io.channels import BY_NAME
from table_io.profile import Profile
from table_io.records import Comparison, Cycle, Point, Record, RunStart, Timing
from table_io.words import sentence
from twin.stream.recording import Recording
from twin.stream.rerun_layout import (
    CONTACT,
    DIM,
    GREY,
    HALF_MASS,
    LINES,
    RED,
    WHITE,
    Axes,
    Boxes,
    Curves,
    ErrorShare,
    Motion,
    Progress,
    Reach,
    Scene,
    Trail,
    cycle_table,
    impacts,
    motion,
    pieces,
    point_table,
    status,
    track,
)

WINDOW_S, LEGEND_S = 5.0, 1.5  # time series: what slides by, and the room left for the legend
TRAIL_S = 2.0
BATCH = 1000  # items of a log fed at once
BACKGROUND = (14, 16, 20)
MEMORY = "512MiB"  # what a late viewer can still get; the oldest goes first


class RerunView:
    """Feeds one run to a new file, to viewers on this machine ("127.0.0.1:PORT"), or to both."""

    def __init__(
        self, start: RunStart, *, save: Path | None = None, serve: str | None = None
    ) -> None:
        if save is None and serve is None:
            raise ValueError("a view needs a file to save to, an address to serve at, or both")
        profile = parse(start.profile_toml, Profile, f"profile of run {start.run}")
        rate = start.rate_hz
        self._start = start
        self._scene = Scene.of(profile)
        self._frame = max(1, round(rate / 100))
        stride, slope = max(1, round(rate / 400)), max(1, round(rate * 0.005))
        self._trails = {
            "measured": Trail(20 * stride, stride, slope),
            "twin": Trail(20 * stride, stride, 0),
        }
        hold = round(2 * TRAIL_S * rate / (20 * stride))
        self._reach = Reach(1.0, hold), Reach(10.0, hold)
        self._next: dict[str, int] = {}
        self._progress = Progress()
        self._curves = Curves(profile.sweep.start_hz, profile.sweep.stop_hz)
        self._errors = ErrorShare(rate)
        self._open(save, serve)
        self._still(profile)

    def _open(self, save: Path | None, serve: str | None) -> None:
        """Start the stream with its file, its server and its layout."""
        address = _address(serve) if serve else None
        sinks: list[Any] = []
        if save is not None:
            _claim(save)
            # The footer speeds up seeking, and keeps 0.2 MB in memory per second of a live run.
            short = self._start.planned_samples < 1200 * self._start.rate_hz
            sinks.append(rr.FileSink(save, write_footer=short))
        if address:
            sinks.append(rr.GrpcServerSink(*address, server_memory_limit=MEMORY))
        self.url = f"rerun+http://{serve}/proxy" if serve else ""
        self._rec = rr.RecordingStream("shaketwin")
        self._rec.set_sinks(*sinks, default_blueprint=_blueprint(self._scene, bool(serve)))
        self._rec.send_recording_name(f"{self._start.name} {self._start.run}")

    def feed(self, items: Sequence[Block | Record]) -> None:
        """Put a batch of whatever arrived on the screen; about every 100 ms is right."""
        for stream, draw in (("meas", self._measured), ("pred", self._predicted)):
            blocks = [one for one in items if isinstance(one, Block) and one.stream == stream]
            for piece in pieces(blocks):
                draw(piece)
        for item in items:
            if not isinstance(item, Block):
                self._record(item)

    def close(self) -> None:
        """Finish the file and stop serving."""
        self._rec.flush()
        self._rec.disconnect()

    def _send(self, entity: str, index: Sequence[int] | Int1D, *columns: Any) -> None:
        """All rows of an entity at once, at the true times of their samples."""
        if not len(index):
            return
        ns = np.rint(np.asarray(index, dtype=np.float64) * (1e9 / self._start.rate_hz))
        times = rr.TimeColumn("time", duration=ns.astype("timedelta64[ns]"))
        flat = [one for many in columns for one in many]
        rr.send_columns(entity, [times], flat, recording=self._rec)

    def _lines(self, entity: str, index: Int1D, *columns: Float1D) -> None:
        """The lines of an entity, (sample,) each; a NaN at the first lost sample lifts the pen."""
        values = np.stack(columns, axis=1)
        due = self._next.get(entity, int(index[0]))
        self._next[entity] = int(index[-1]) + 1
        if due < index[0]:
            index = np.concatenate([[due], index])
            values = np.concatenate([np.full((1, len(columns)), np.nan), values])
        self._send(entity, index, rr.Scalars.columns(scalars=values))

    def _measured(self, block: Block) -> None:
        moves = motion(block)
        self._lines("u/measured", moves.index, 1e3 * moves.u)
        self._lines("a/measured", moves.index, moves.acc, moves.table_acc)
        self._lines("force/measured", moves.index, 1e-3 * moves.force_r, 1e-3 * moves.force_l)
        for name in block.channels:
            if name not in BY_NAME:
                entity = f"other/{rr.escape_entity_path_part(name)}"
                self._lines(entity, moves.index, block.channel(name))
        frames = moves.known_every(self._frame)
        self._boxes("rig/bodies", self._scene.bodies(frames))
        self._boxes("rig/frame", self._scene.frame(frames))
        self._trail("measured", moves)
        for index, step, label in self._progress.add(block):
            self._document("status", index, status(self._start, step, label))
            now = self._start.steps[step : step + 1] if step >= 0 else ()
            marks = self._curves.axes.uprights(one.frequency_hz for one in now)
            self._strips("prc/now", index, marks)

    def _predicted(self, block: Block) -> None:
        free, window = motion(track(block, "free")), motion(track(block, "window"))
        self._lines("u/twin", window.index, 1e3 * free.u, 1e3 * window.u)
        self._lines("a/twin", window.index, free.acc, window.acc)
        self._lines("force/twin", window.index, 1e-3 * window.force_r, 1e-3 * window.force_l)
        frames = free.known_every(self._frame)
        self._send("rig/twin", frames.index, rr.Boxes3D.columns(centers=self._scene.mass(frames)))
        self._trail("twin", window)

    def _boxes(self, entity: str, boxes: Boxes) -> None:
        frames, count = boxes.centres.shape[:2]
        columns = rr.Boxes3D.columns(
            centers=boxes.centres.reshape(-1, 3),
            half_sizes=boxes.halves.reshape(-1, 3),
            colors=boxes.colours.reshape(-1, 3),
        )
        self._send(entity, boxes.index, columns.partition([count] * frames))

    def _trail(self, who: str, moves: Motion) -> None:
        """Phase plane: strips in mm and mm/s, and the axes that follow the measured size."""
        strips = list(self._trails[who].add(moves, self._start.rate_hz))
        if not strips:
            return
        lines = rr.LineStrips2D.columns(strips=[strip for _, strip in strips])
        self._send(f"phase/data/{who}", [end for end, _ in strips], lines)
        for end, strip in strips if who == "measured" else ():
            peaks = np.abs(strip).max(axis=0)
            changed = [one.see(peak) for one, peak in zip(self._reach, peaks, strict=True)]
            if any(changed):
                self._phase(end)

    def _phase(self, index: int) -> None:
        """The axes of the phase plane, and where the bumpers stand, from sample `index` on."""
        u, v = (one.value for one in self._reach)
        axes = Axes((-u, u), (-v, v), "u [mm]", "u' [mm/s]")
        self._axes("phase", index, axes)
        right, left = self._scene.gaps_m
        self._strips("phase/gaps", index, axes.uprights([1e3 * right, -1e3 * left]))

    def _strips(self, entity: str, index: int, strips: Sequence[Float2D]) -> None:
        lines = rr.LineStrips2D.columns(strips=strips)
        self._send(entity, [index], lines.partition([len(strips)]))

    def _axes(self, entity: str, index: int, axes: Axes) -> None:
        """Grid and numbers of a plot, and the map from data to drawing, from sample `index` on."""
        grid, (places, texts) = axes.grid(), axes.labels()
        colours = [GREY] + [DIM] * (len(grid) - 1)
        lines = rr.LineStrips2D.columns(strips=grid, colors=colours)
        marks = rr.Points2D.columns(positions=places, labels=texts)
        scale, origin = [(*axes.scale, 1.0)], [(*axes.origin, 0.0)]
        self._send(f"{entity}/grid", [index], lines.partition([len(grid)]))
        self._send(f"{entity}/numbers", [index], marks.partition([len(texts)]))
        place = rr.Transform3D.columns(scale=scale, translation=origin)
        self._send(f"{entity}/data", [index], place)

    def _record(self, item: Record) -> None:
        match item:
            case Point():
                self._point(item)
            case Cycle():
                self._send("impacts", [item.index], rr.Scalars.columns(scalars=impacts(item)))
                self._document("cycle", item.index, cycle_table(item))
            case Comparison():
                if (share := self._errors.add(item)) is not None:
                    self._send("error", [share[0]], rr.Scalars.columns(scalars=share[1]))
            case Timing():
                values = [[item.p50_ms, item.p99_ms, item.max_ms]]
                entity = f"latency/{rr.escape_entity_path_part(item.component)}"
                self._send(entity, [item.index], rr.Scalars.columns(scalars=values))
            case RunStart():
                pass
            case _:
                if told := sentence(item, self._start.rate_hz):
                    log = rr.TextLog.columns(text=[told[1]], level=[told[0]])
                    self._send("events", [item.index], log)

    def _point(self, point: Point) -> None:
        """The PRC so far, and the numbers of its newest point."""
        if self._curves.add(point):
            self._axes("prc", point.index, self._curves.axes)
        for who in ("measured", "twin"):
            if not (found := self._curves.of(who)):
                continue
            colours, curves = zip(*found, strict=True)
            dots, sizes = np.concatenate(curves), [len(curve) for curve in curves]
            paint = np.repeat(np.array(colours, np.uint8), sizes, axis=0)
            lines = rr.LineStrips2D.columns(strips=curves, colors=colours)
            marks = rr.Points2D.columns(positions=dots, colors=paint).partition([len(dots)])
            entity = f"prc/data/{who}"
            self._send(entity, [point.index], lines.partition([len(curves)]), marks)
        self._document("point", point.index, point_table(point))

    def _document(self, entity: str, index: int, text: str) -> None:
        columns = rr.TextDocument.columns(text=[text], media_type=["text/markdown"])
        self._send(entity, [index], columns)

    def _still(self, profile: Profile) -> None:
        """What does not change: names, colours, widths; and the axes to begin with."""

        def fix(entity: str, *archetypes: Any) -> None:
            rr.log(entity, *archetypes, static=True, recording=self._rec)

        policy = rr.components.AggregationPolicy.MinMax  # peaks survive any zoom
        for entity, lines in LINES.items():
            names, paint, widths = zip(*lines, strict=True)
            style = rr.SeriesLines(
                names=names, colors=paint, widths=widths, aggregation_policy=policy
            )
            fix(entity, style)
        sides = ["R", "L"] if self._scene.walls else []
        labels = ["table", f"mass {profile.specimen.mass_kg:g} kg", *sides]
        box, strip, dot = (kind.from_fields for kind in (rr.Boxes3D, rr.LineStrips2D, rr.Points2D))
        fix("rig/bodies", box(fill_mode="solid", labels=labels, show_labels=True))
        fix("rig/frame", box(fill_mode="solid"))
        fix("rig/twin", box(half_sizes=1.01 * HALF_MASS, colors=WHITE, radii=-1.0))
        for who, colour, width, order in (("measured", RED, -1.8, 1), ("twin", WHITE, -0.7, 2)):
            fix(f"phase/data/{who}", strip(colors=colour, radii=width, draw_order=order))
            line, dots = (
                strip(radii=width, draw_order=order),
                dot(radii=2 * width, draw_order=order),
            )
            fix(f"prc/data/{who}", line, dots)
        for plot in ("prc", "phase"):
            fix(f"{plot}/grid", strip(radii=-0.5, draw_order=0))
            fix(f"{plot}/numbers", dot(colors=GREY, radii=0.0, show_labels=True))
        fix("prc/now", strip(colors=CONTACT, radii=-0.7))
        fix("phase/gaps", strip(colors=CONTACT, radii=-0.7))
        self._phase(0)
        self._axes("prc", 0, self._curves.axes)


def _address(text: str) -> tuple[str, int]:
    """(host, port) of "127.0.0.1:PORT" with a free port."""
    host, _, port = text.rpartition(":")
    if host != "127.0.0.1" or not port.isdigit() or not 0 < int(port) < 65536:
        raise BadInput(f"view address {text!r}; allowed: 127.0.0.1:PORT, this machine only")
    with socket() as probe:
        if probe.connect_ex((host, int(port))) == 0:
            raise BadInput(f"view address {text}: the port is taken; choose another")
    return host, int(port)


def _claim(path: Path) -> None:
    """Make sure that the file is new and can be written."""
    try:
        path.open("xb").close()
    except FileExistsError:
        raise BadInput(f"{path}: exists already; nothing is ever overwritten") from None
    except OSError as error:
        raise BadInput(f"{path}: cannot write here: {error.strerror}") from None


def _sliding(seconds: float, after: float = 0.0) -> Any:
    """The seconds before and after the cursor."""
    edge = rr.TimeRangeBoundary.cursor_relative
    return rr.TimeRange(start=edge(seconds=-seconds), end=edge(seconds=after))


def _plot(origin: str, name: str) -> Any:
    """A time series that slides by, its legend in the room to the left of it."""
    return rrb.TimeSeriesView(
        origin=origin,
        name=name,
        axis_x=rrb.TimeAxis(view_range=_sliding(WINDOW_S + LEGEND_S, 0.15)),
        time_ranges=rrb.VisibleTimeRange("time", range=_sliding(WINDOW_S)),
        plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop),
        background=rrb.archetypes.PlotBackground(color=BACKGROUND),
    )


def _drawing(origin: str, name: str, **overrides: Any) -> Any:
    """A 2D view of a plot with drawn axes."""
    room = rrb.VisualBounds2D(x_range=(-0.14, Axes.WIDTH + 0.06), y_range=(-0.14, 1.24))
    return rrb.Spatial2DView(
        origin=origin, name=name, background=BACKGROUND, visual_bounds=room, **overrides
    )


def _blueprint(scene: Scene, live: bool) -> Any:
    """The layout: rig, PRC and phase plane on the left, time series and words on the right."""
    factors = f"table motion x {scene.table_factor:g}, motion and gaps on it x {scene.factor:g}"
    eye = rrb.EyeControls3D(position=(0.0, -1.75, 0.7), look_target=(0.0, 0.0, 0.27))
    rig = rrb.Spatial3DView(
        origin="/rig",
        name=f"Rig: {factors}; twin outlined",
        background=BACKGROUND,
        line_grid=False,
        eye_controls=eye,
    )
    recent = rrb.VisibleTimeRanges([rrb.VisibleTimeRange("time", range=_sliding(TRAIL_S))])
    trails = {f"/phase/data/{who}": recent for who in ("measured", "twin")}
    left = rrb.Vertical(
        rig,
        _drawing("/prc", "PRC: forward red, backward blue; twin white, grey"),
        _drawing(
            "/phase",
            f"Phase plane, last {TRAIL_S:g} s: measured (u' = slope over 10 ms) red, twin white",
            overrides=trails,
        ),
    )
    kinds = rrb.encodings.TextLogColumnKind
    columns = rrb.TextLogColumns(text_log_columns=[kinds.LogLevel, kinds.Body])
    words = rrb.Tabs(
        rrb.TextLogView(origin="/events", name="Events", columns=columns),
        rrb.TextDocumentView(origin="/point", name="Last PRC point"),
        _plot("/error", "Twin error [% of RMS]"),
        _plot("/impacts", "Impacts per cycle"),
        _plot("/latency", "Latency [ms]"),
        _plot("/other", "Other channels"),
    )
    now = rrb.TextDocumentView(origin="/status", name="Now")
    cycle = rrb.TextDocumentView(origin="/cycle", name="Last cycle")
    right = rrb.Vertical(
        _plot("/u", "Relative displacement u [mm], right positive"),
        _plot("/a", "Total acceleration of the mass [m/s²], right positive"),
        _plot("/force", "Contact forces F_R ≥ 0, F_L ≤ 0 [kN]"),
        rrb.Horizontal(now, cycle, words, column_shares=[2, 2, 4]),
        row_shares=[3, 3, 3, 2.2],
    )
    play = "following" if live else "playing"
    return rrb.Blueprint(
        rrb.Horizontal(left, right, column_shares=[2, 3]),
        rrb.TimePanel(state="collapsed", timeline="time", play_state=play),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TopPanel(state="hidden"),
    )


def write_rrd(recording: Recording, out: Path) -> None:
    """A whole log as a new .rrd file, every sample at its true time."""
    view = RerunView(recording.start, save=out)
    for first in range(0, len(recording.items), BATCH):
        view.feed(recording.items[first : first + BATCH])
    view.close()


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
        client.open(source if isinstance(source, str) else str(source.resolve()))
        end_s = _loaded(process, client, live)
        if at_s is not None or not live:
            at = 0.9 * end_s if at_s is None else at_s
            client.set_time("time", duration=float(at), play_state="paused")
        _wait(process, 3.0)  # the first frames come without data
        client.save_screenshot(str(png.resolve()))
        views = client.get_state().views
        return [f"{view.name}: {one.summary}" for view in views for one in view.reports]
    finally:
        process.terminate()
        process.wait(10)


def _loaded(process: "subprocess.Popen[bytes]", client: Any, live: bool) -> float:
    """Time at the end of what the viewer has loaded, in s, once that is all or something live."""
    for _ in range(600):
        state = client.get_state()
        timelines = [line for one in state.recordings for line in one.timelines]
        ends = [line.end for line in timelines if line.name == "time"]
        if ends and (live or not state.loading):
            return 1e-9 * float(max(ends))
        _wait(process, 0.1)
    raise BadInput(
        "the viewer finds no recording there; give an .rrd file or the URL of a live view"
    )


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
