"""The view: Blocks and records as moving pictures. The only file that knows rerun.

Everything goes out in columns, few entities with many instances, on one timeline `time` computed
from the sample index. Served, never connected outwards: a viewer that hangs cannot hold us up. What
is drawn depends on the samples only, never on how they were cut into blocks or batches.
"""

import os
import subprocess
import sys

from collections.abc import Iterable, Sequence
from importlib.util import find_spec
from pathlib import Path
from socket import socket
from typing import Any

import numpy as np
import numpy.typing as npt
import rerun as rr
import rerun.blueprint as rrb
from rerun.experimental import ViewerClient

from table_io.block import Block, Float1D
from table_io.channels import BY_NAME
from table_io.profile import BadInput, Profile, parse
from table_io.records import (
    Comparison,
    Cycle,
    Event,
    Fault,
    Gap,
    Point,
    Record,
    RunStart,
    RunStop,
    Timing,
)
from twin.stream.mcap_log import Recording
from twin.stream.rerun_layout import (
    BLUE,
    DIM,
    GREY,
    HALF_MASS,
    RED,
    WHITE,
    Axes,
    Boxes,
    Motion,
    Reach,
    Scene,
    Trail,
    curve,
    motion,
    nice,
    pieces,
    point_table,
    sentence,
    status,
    track,
)

Rgb = tuple[int, int, int]
WINDOW_S = 5.0
TRAIL_S = 2.0
FRAMES_HZ = 100.0
BACKGROUND = (14, 16, 20)
MEMORY = "512MiB"  # what a late viewer still gets; the oldest goes first

# Legend name, colour and width of every line, in the order of the columns sent.
RESTARTED, FREE = "twin, restarted", "twin, free-running"
LINES: dict[str, tuple[tuple[str, Rgb, float], ...]] = {
    "u/measured": (("measured", RED, 3.0),),
    "u/twin": ((RESTARTED, WHITE, 1.3), (FREE, GREY, 1.1)),
    "a/measured": (("measured", RED, 3.0), ("table, measured", BLUE, 1.3)),
    "a/twin": ((RESTARTED, WHITE, 1.3), (FREE, GREY, 1.1)),
    "force/measured": (("right, measured", RED, 3.0), ("left, measured", BLUE, 3.0)),
    "force/twin": ((f"right, {RESTARTED}", WHITE, 1.3), (f"left, {RESTARTED}", WHITE, 1.3)),
    "error": ((f"u, {RESTARTED}", RED, 2.0), (f"u, {FREE}", GREY, 2.0)),
    "impacts": tuple(
        (f"{side}, {who}", colour, width)
        for who, width in (("measured", 3.0), ("twin", 1.3))
        for side, colour in (("right", RED), ("left", BLUE))
    ),
}
PRC_COLOURS: dict[str, tuple[Rgb, Rgb]] = {"measured": (RED, BLUE), "twin": (WHITE, GREY)}


class RerunView:
    """Feeds one run to a file, to viewers on this machine, or to both."""

    def __init__(
        self, start: RunStart, *, save: Path | None = None, serve: str | None = None
    ) -> None:
        if save is None and serve is None:
            raise ValueError("a view needs a file to save to, an address to serve at, or both")
        profile = parse(start.profile_toml, Profile, f"profile of run {start.run}")
        self._start = start
        self._scene = Scene.of(profile)
        self._open(profile, save, serve)
        self._stride = max(1, round(start.rate_hz / FRAMES_HZ))
        stride = max(1, round(start.rate_hz / 400))
        margin = max(1, round(start.rate_hz * 0.005))
        self._trails = {
            "measured": Trail(20 * stride, stride, margin),
            "twin": Trail(20 * stride, stride, 0),
        }
        hold = round(2 * TRAIL_S * start.rate_hz / (20 * stride))
        self._reach = {"u": Reach(1.0, hold), "v": Reach(10.0, hold)}
        self._next: dict[str, int] = {}
        self._now: tuple[int, int] | None = None
        self._points: list[Point] = []
        self._errors = np.zeros((3, 0))
        self._eta = 1.0
        self._sweep_hz = (profile.sweep.start_hz, profile.sweep.stop_hz)
        self._static(profile)

    def _open(self, profile: Profile, save: Path | None, serve: str | None) -> None:
        """Start the recording stream with its file, its server and its layout."""
        sinks: list[Any] = []
        self.url = ""
        if serve is not None:
            server = _server(serve)
            sinks.append(server)
            self.url = str(server.uri).replace("0.0.0.0", "127.0.0.1")
        if save is not None:
            sinks.append(_new_file(save, footer=serve is None))
        name = f"{self._start.name} {self._start.run}".strip()
        self._rec = rr.RecordingStream("shaketwin", recording_id=self._start.run or None)
        self._rec.set_sinks(*sinks, default_blueprint=blueprint(self._scene, serve is not None))
        self._rec.send_recording_name(name)

    def feed(self, items: Sequence[Block | Record]) -> None:
        """Put a batch of whatever arrived on the screen; about every 100 ms is right."""
        measured = [one for one in items if isinstance(one, Block) and one.stream == "meas"]
        predicted = [one for one in items if isinstance(one, Block) and one.stream == "pred"]
        for piece in pieces(measured):
            self._measured(piece)
        for piece in pieces(predicted):
            self._predicted(piece)
        for item in items:
            match item:
                case Point():
                    self._point(item)
                case Cycle():
                    self._cycle(item)
                case Comparison():
                    self._comparison(item)
                case Timing():
                    self._timing(item)
                case Event() | Gap() | Fault() | RunStop():
                    self._text(item.index, *sentence(item, self._start.rate_hz))

    def close(self) -> None:
        """Finish the file and stop serving."""
        self._rec.flush()
        self._rec.disconnect()

    def _send(self, entity: str, index: Iterable[int], *columns: Any) -> None:
        """One send for all rows of an entity, at the true times of their samples."""
        ns = np.rint(np.asarray(index, dtype=np.float64) * (1e9 / self._start.rate_hz))
        times = rr.TimeColumn("time", duration=ns.astype("timedelta64[ns]"))
        rr.send_columns(
            entity, [times], [one for many in columns for one in many], recording=self._rec
        )

    def _lines(self, entity: str, index: npt.NDArray[np.int64], columns: Sequence[Float1D]) -> None:
        """Rows of an entity's lines (sample,) each; a NaN at the first lost sample lifts the pen."""
        values = np.stack(columns, axis=1)
        if self._next.get(entity, int(index[0])) != index[0]:
            index = np.concatenate([[self._next[entity]], index])
            values = np.concatenate([np.full((1, values.shape[1]), np.nan), values])
        self._next[entity] = int(index[-1]) + 1
        self._send(entity, index, rr.Scalars.columns(scalars=values))

    def _measured(self, block: Block) -> None:
        moves = motion(block)
        self._lines("u/measured", moves.index, [1e3 * moves.u])
        self._lines("a/measured", moves.index, [moves.acc, moves.table_acc])
        forces = [1e-3 * moves.force_r, 1e-3 * moves.force_l]
        self._lines("force/measured", moves.index, forces)
        own = [name for name in block.channels if name not in BY_NAME]
        for name in own:
            self._lines(
                f"other/{rr.escape_entity_path_part(name)}", moves.index, [block.channel(name)]
            )
        frames = self._frames(moves)
        if frames.index.size:
            self._boxes("rig/bodies", self._scene.bodies(frames))
            self._boxes("rig/frame", self._scene.frame(frames))
        self._trail("measured", moves)
        self._progress(block)

    def _predicted(self, block: Block) -> None:
        free, window = motion(track(block, "free")), motion(track(block, "window"))
        self._lines("u/twin", window.index, [1e3 * window.u, 1e3 * free.u])
        self._lines("a/twin", window.index, [window.acc, free.acc])
        self._lines("force/twin", window.index, [1e-3 * window.force_r, 1e-3 * window.force_l])
        frames = self._frames(free)
        if frames.index.size:
            centres = self._scene.mass_centres(frames)
            halves = np.broadcast_to(HALF_MASS * 1.01, centres.shape)
            boxes = rr.Boxes3D.columns(centers=centres, half_sizes=halves)
            self._send("rig/twin", frames.index, boxes)
        self._trail("twin", window)

    def _frames(self, moves: Motion) -> Motion:
        """The samples drawn in the scene: about 100 a second, where the rig's place is known."""
        place = np.isfinite(moves.u) & np.isfinite(moves.table)
        at = np.flatnonzero((moves.index % self._stride == 0) & place)
        return Motion(*(getattr(moves, name)[at] for name in Motion.__slots__))

    def _boxes(self, entity: str, boxes: Boxes) -> None:
        frames, count = boxes.centres.shape[:2]
        columns = rr.Boxes3D.columns(
            centers=boxes.centres.reshape(-1, 3),
            half_sizes=boxes.halves.reshape(-1, 3),
            colors=boxes.colours.reshape(-1, 3),
        )
        self._send(entity, boxes.index, columns.partition([count] * frames))

    def _trail(self, who: str, moves: Motion) -> None:
        """Phase plane: strips in mm and mm/s, and the axes that follow their size."""
        strips = list(self._trails[who].add(moves, self._start.rate_hz))
        if not strips:
            return
        ends = [end for end, _ in strips]
        lines = rr.LineStrips2D.columns(strips=[strip for _, strip in strips])
        self._send(f"phase/data/{who}", ends, lines)
        if who == "measured":
            for end, strip in strips:
                peaks = np.abs(strip).max(axis=0)
                changed = [self._reach["u"].see(peaks[0]), self._reach["v"].see(peaks[1])]
                if any(changed):
                    self._axes("phase", end, self._phase_axes())

    def _phase_axes(self) -> Axes:
        u, v = self._reach["u"].value, self._reach["v"].value
        return Axes((-u, u), (-v, v), "u [mm]", "u' [mm/s]")

    def _prc_axes(self) -> Axes:
        low, high = self._sweep_hz
        room = max(0.03 * (high - low), 0.05)
        return Axes((low - room, high + room), (0.0, self._eta), "f [Hz]", "η_d [-]")

    def _axes(self, entity: str, index: int, axes: Axes) -> None:
        """Grid and numbers of a plot, and the map from data to drawing, from sample `index` on."""
        grid, (places, texts) = axes.grid(), axes.labels()
        colours = [GREY] + [DIM] * (len(grid) - 1)
        lines = rr.LineStrips2D.columns(strips=grid, colors=colours).partition([len(grid)])
        marks = rr.Points2D.columns(positions=places, labels=texts).partition([len(texts)])
        place = rr.Transform3D.columns(
            scale=[(*axes.scale, 1.0)], translation=[(*axes.origin, 0.0)]
        )
        self._send(f"{entity}/grid", [index], lines)
        self._send(f"{entity}/numbers", [index], marks)
        self._send(f"{entity}/data", [index], place)

    def _progress(self, block: Block) -> None:
        """Where in the sweep we are, at every sample at which that changes."""
        state = np.stack([block.step, block.label])
        at = np.flatnonzero(np.any(np.diff(state, axis=1) != 0, axis=0)) + 1
        for place in (0, *at.tolist()):
            now = (int(block.step[place]), int(block.label[place]))
            if now == self._now:
                continue
            before, self._now = self._now, now
            index = block.index + place
            text = rr.TextDocument.columns(
                text=[status(self._start, *now)], media_type=["text/markdown"]
            )
            self._send("status", [index], text)
            if before is None or before[0] != now[0]:
                self._marker(index, now[0])

    def _marker(self, index: int, step: int) -> None:
        """A line at the frequency of the step, none outside the sweep."""
        axes, lines = self._prc_axes(), []
        if 0 <= step < len(self._start.steps):
            x = axes.origin[0] + axes.scale[0] * self._start.steps[step].frequency_hz
            lines.append(np.array([[x, 0.0], [x, axes.HEIGHT]]))
        columns = rr.LineStrips2D.columns(strips=lines).partition([len(lines)])
        self._send("prc/now", [index], columns)

    def _point(self, point: Point) -> None:
        """The PRC so far, and the numbers of its newest point."""
        self._points.append(point)
        etas = [getattr(who, "eta_d", np.nan) for who in (point.measured, point.twin)]
        highest = max((eta for eta in etas if np.isfinite(eta)), default=0.0)
        if highest > self._eta:
            self._eta = nice(1.05 * highest)
            self._axes("prc", point.index, self._prc_axes())
        for who in ("measured", "twin"):
            ways = zip(("forward", "backward"), PRC_COLOURS[who], strict=True)
            curves = [(colour, curve(self._points, way, who)) for way, colour in ways]
            self._prc(who, point.index, [one for one in curves if len(one[1])])
        text = rr.TextDocument.columns(text=[point_table(point)], media_type=["text/markdown"])
        self._send("point", [point.index], text)

    def _prc(self, who: str, index: int, shown: Sequence[tuple[Rgb, Any]]) -> None:
        if not shown:
            return
        colours, curves = zip(*shown, strict=True)
        lines = rr.LineStrips2D.columns(strips=curves, colors=colours).partition([len(curves)])
        dots = np.concatenate(curves)
        paint = np.repeat(np.uint8(colours), [len(curve) for curve in curves], axis=0)
        marks = rr.Points2D.columns(positions=dots, colors=paint).partition([len(dots)])
        self._send(f"prc/data/{who}", [index], lines, marks)

    def _cycle(self, cycle: Cycle) -> None:
        counts = [
            np.nan if one is None else len(one.onsets_r if side == "r" else one.onsets_l)
            for one in (cycle.measured, cycle.twin)
            for side in "rl"
        ]
        self._send("impacts", [cycle.index], rr.Scalars.columns(scalars=np.array([counts])))

    def _comparison(self, comparison: Comparison) -> None:
        """Twin error of u as a share of the measured RMS, gathered over half a second."""
        if "rel_disp_m" not in comparison.channels:
            return
        at = comparison.channels.index("rel_disp_m")
        sums = [
            getattr(comparison, name)[at]
            for name in ("measured_ss", "window_error_ss", "free_error_ss")
        ]
        self._errors = np.concatenate([self._errors, np.array(sums)[:, None]], axis=1)
        half = round(self._start.rate_hz / 2)
        end = comparison.index + comparison.count
        if end // half == comparison.index // half:
            return
        total = self._errors.sum(axis=1)
        share = 100 * np.sqrt(total[1:] / total[0]) if total[0] > 0 else np.full(2, np.nan)
        self._send("error", [end], rr.Scalars.columns(scalars=share[None, :]))
        self._errors = np.zeros((3, 0))

    def _timing(self, timing: Timing) -> None:
        values = np.array([[timing.p50_ms, timing.p99_ms, timing.max_ms]])
        entity = f"latency/{rr.escape_entity_path_part(timing.component)}"
        self._send(entity, [timing.index], rr.Scalars.columns(scalars=values))

    def _text(self, index: int, level: str, text: str) -> None:
        self._send("events", [index], rr.TextLog.columns(text=[text], level=[level]))

    def _fixed(self, entity: str, *archetypes: Any) -> None:
        rr.log(entity, *archetypes, static=True, recording=self._rec)

    def _static(self, profile: Profile) -> None:
        """Names, colours and widths, once; and the empty axes."""
        for entity, lines in LINES.items():
            names, colours, widths = zip(*lines, strict=True)
            policy = rr.components.AggregationPolicy.MinMax  # peaks survive any zoom
            self._fixed(
                entity,
                rr.SeriesLines(
                    names=names, colors=colours, widths=widths, aggregation_policy=policy
                ),
            )
        mass = f"mass {profile.specimen.mass_kg:g} kg"
        sides = ["right bumper", "left bumper"] if self._scene.walls else []
        labels = ["table", mass, *sides]
        self._fixed(
            "rig/bodies", rr.Boxes3D.from_fields(fill_mode="solid", labels=labels, show_labels=True)
        )
        self._fixed("rig/frame", rr.Boxes3D.from_fields(fill_mode="solid"))
        self._fixed(
            "rig/twin",
            rr.Boxes3D.from_fields(colors=WHITE, radii=-1.5, labels="twin", show_labels=False),
        )
        for plot in ("prc", "phase"):
            self._fixed(f"{plot}/grid", rr.LineStrips2D.from_fields(radii=-0.5))
            self._fixed(
                f"{plot}/numbers", rr.Points2D.from_fields(colors=GREY, radii=0.0, show_labels=True)
            )
        for who, colour, width in (("measured", RED, -1.8), ("twin", WHITE, -0.8)):
            self._fixed(
                f"phase/data/{who}", rr.LineStrips2D.from_fields(colors=colour, radii=width)
            )
            self._fixed(
                f"prc/data/{who}",
                rr.LineStrips2D.from_fields(radii=width),
                rr.Points2D.from_fields(radii=2 * width),
            )
        self._fixed("prc/now", rr.LineStrips2D.from_fields(colors=GREY, radii=-0.6))
        self._axes("phase", 0, self._phase_axes())
        self._axes("prc", 0, self._prc_axes())


def _server(address: str) -> Any:
    """A server that listens on this machine only, at "127.0.0.1:PORT"."""
    host, _, port = address.rpartition(":")
    if host != "127.0.0.1" or not port.isdigit() or not 0 < int(port) < 65536:
        raise BadInput(f"view address {address!r}; allowed: 127.0.0.1:PORT, this machine only")
    with socket() as probe:
        if probe.connect_ex((host, int(port))) == 0:
            raise BadInput(f"view address {address}: the port is taken; choose another")
    return rr.GrpcServerSink(host, int(port), server_memory_limit=MEMORY)


def _new_file(path: Path, footer: bool = True) -> Any:
    """A sink into a file that did not exist."""
    try:
        path.open("xb").close()
    except FileExistsError:
        raise BadInput(f"{path}: exists already; nothing is ever overwritten") from None
    except OSError as error:
        raise BadInput(f"{path}: cannot write here: {error.strerror}") from None
    return rr.FileSink(path, write_footer=footer)


def _sliding(seconds: float) -> Any:
    """The last seconds before the cursor."""
    edge = rr.TimeRangeBoundary.cursor_relative
    return rr.TimeRange(start=edge(seconds=-seconds), end=edge(seconds=0.0))


def _plot(origin: str, name: str, contents: str | None = None) -> Any:
    """A sliding time-series view."""
    return rrb.TimeSeriesView(
        origin=origin,
        contents=contents or "$origin/**",
        name=name,
        axis_x=rrb.TimeAxis(view_range=_sliding(WINDOW_S)),
        time_ranges=rrb.VisibleTimeRange("time", range=_sliding(WINDOW_S)),
        plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop),
        background=rrb.archetypes.PlotBackground(color=BACKGROUND),
    )


def _drawing(origin: str, name: str, trail_s: float | None = None) -> Any:
    """A 2D view of a plot drawn by hand."""
    ranges = None if trail_s is None else rrb.VisibleTimeRange("time", range=_sliding(trail_s))
    bounds = rrb.VisualBounds2D(x_range=(-0.14, Axes.WIDTH + 0.06), y_range=(-0.14, 1.2))
    return rrb.Spatial2DView(
        origin=origin, name=name, background=BACKGROUND, visual_bounds=bounds, time_ranges=ranges
    )


def blueprint(scene: Scene, live: bool) -> Any:
    """The layout: rig, curves and phase plane on the left, time series and words on the right."""
    rig = rrb.Spatial3DView(
        origin="/rig",
        name=f"Rig: table motion x {scene.table_factor:g}, motion and gaps on it x {scene.factor:g}",
        background=BACKGROUND,
        line_grid=False,
        eye_controls=rrb.EyeControls3D(position=(0.0, -3.0, 1.1), look_target=(0.0, 0.0, 0.28)),
    )
    left = rrb.Vertical(
        rig,
        _drawing("/prc", "PRC: η_d over f; forward red, backward blue, twin white and grey"),
        _drawing(
            "/phase",
            "Phase plane, last 2 s; measured red (u' = slope of u over 10 ms), twin white",
            TRAIL_S,
        ),
    )
    words = rrb.Tabs(
        rrb.TextLogView(origin="/events", name="Events"),
        rrb.TextDocumentView(origin="/point", name="Last PRC point"),
        _plot("/error", "Twin error [% of RMS]"),
        _plot("/impacts", "Impacts per cycle"),
        _plot("/latency", "Latency [ms]"),
        _plot("/other", "Other channels"),
    )
    right = rrb.Vertical(
        _plot("/u", "Relative displacement u [mm]"),
        _plot("/a", "Mass acceleration [m/s²]"),
        _plot("/force", "Contact force F_R > 0, F_L < 0 [kN]"),
        rrb.Horizontal(
            rrb.TextDocumentView(origin="/status", name="Now"), words, column_shares=[2, 3]
        ),
        row_shares=[3, 3, 3, 2],
    )
    return rrb.Blueprint(
        rrb.Horizontal(left, right, column_shares=[2, 3]),
        rrb.TimePanel(
            state="collapsed", timeline="time", play_state="following" if live else "playing"
        ),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TopPanel(state="hidden"),
    )


BATCH = 1000


def write_rrd(recording: Recording, out: Path) -> None:
    """A whole log as a new .rrd file, every sample at its true time."""
    view = RerunView(recording.start, save=out)
    for first in range(0, len(recording.items), BATCH):
        view.feed(recording.items[first : first + BATCH])
    view.close()


def viewer() -> Path:
    """Path of the native viewer that came with the SDK; BadInput where there is none."""
    spec = find_spec("rerun_cli")
    places = list(spec.submodule_search_locations or ()) if spec else []
    found = [
        path
        for place in places
        for path in Path(place).glob("rerun*")
        if path.suffix in ("", ".exe")
    ]
    if not found:
        raise BadInput("the Rerun viewer is not installed; run: pip install rerun-sdk")
    return found[0]


def has_display() -> bool:
    """True where a window can be opened."""
    if sys.platform in ("darwin", "win32"):
        return True
    return any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


def open_viewer(source: Path | str) -> str:
    """Opens a file or a live URL in the native viewer; returns at once with what to tell the user."""
    if isinstance(source, Path) and not source.is_file():
        raise BadInput(f"{source}: no such file; give an .rrd file")
    program = viewer()
    if not has_display():
        return (
            f"no display here. On a machine with a screen: rerun {source}\n"
            f"or through the browser: {program} --web-viewer --bind 127.0.0.1 {source}\n"
            "and open the address that it prints"
        )
    process = _start(program, str(source), "--port", "auto")
    return f"viewer opened (process {process.pid})"


def _start(program: Path, *arguments: str) -> "subprocess.Popen[bytes]":
    return subprocess.Popen(
        [str(program), "--bind", "127.0.0.1", *arguments],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        stdin=subprocess.DEVNULL,
        start_new_session=True,
    )


def screenshot(source: Path | str, png: Path, at_s: float | None = None) -> list[str]:
    """Writes a 1920 x 1080 picture without a screen; returns what the views complain of, if anything.

    `at_s` is the time shown, the end where none is given.
    """
    with socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    process = _start(viewer(), "--headless", "--port", str(port))
    try:
        client = _connected(process, f"rerun+http://127.0.0.1:{port}/proxy")
        client.open(str(source))
        while client.get_state().loading:
            _wait(process, 0.1)
        client.set_time("time", duration=at_s, play_state="paused")
        _wait(process, 3.0)  # the first frames come without data
        client.save_screenshot(str(png.resolve()))
        views = client.get_state().views
        return [f"{view.name}: {one.summary}" for view in views for one in view.reports]
    finally:
        process.terminate()
        process.wait(10)


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


def _connected(process: "subprocess.Popen[bytes]", url: str) -> Any:
    """A client of the viewer once it answers, at most 15 s from now."""
    for _ in range(150):
        _wait(process, 0.1)
        try:
            return ViewerClient(url)
        except ConnectionError:
            continue
    raise BadInput("the Rerun viewer does not answer; try again, or look whether it starts: rerun")
