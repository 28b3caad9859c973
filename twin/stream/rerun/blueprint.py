"""The layout: which view stands where, what it is called, and what does not change in it."""

from typing import Any

import rerun as rr
import rerun.blueprint as rrb

from table_io.channels import BY_NAME
from table_io.records import RunStart
from twin.stream.rerun.looks import CONTACT, DIM, GREY, LINES, RED, WHITE
from twin.stream.rerun.plots import PLANE_WIDTH, PRC_WIDTH
from twin.stream.rerun.scene import HALF_MASS, Scene
from twin.stream.rerun.sink import Sink

WINDOW_S, LEGEND_S = 5.0, 1.5  # time series: what slides by, and the room left for the legend
TRAIL_S = 2.0
BACKGROUND = (14, 16, 20)
# Made at import: the first such value makes pyarrow import pandas, 0.4 s that a run need not wait.
EYE = rrb.EyeControls3D(position=(0.0, -2.0, 0.75), look_target=(0.0, 0.0, 0.28))


def fix(sink: Sink, scene: Scene, mass_kg: float) -> None:
    """What does not change: names, colours, widths."""
    for entity, lines in LINES.items():
        sink.style(entity, lines)
    if scene.sides:
        sink.style("u/gaps", [("bumper", CONTACT, 1.0)] * len(scene.sides))
        sink.style("force/threshold", [("contact", CONTACT, 1.0)] * len(scene.sides))
    box, strip, dot = (kind.from_fields for kind in (rr.Boxes3D, rr.LineStrips2D, rr.Points2D))
    sink.fix("rig/bodies", box(fill_mode="solid"))
    sink.fix("rig/frame", box(fill_mode="solid"))
    sink.fix("rig/twin", box(half_sizes=1.01 * HALF_MASS, colors=WHITE, radii=-1.0))
    captions = scene.captions(mass_kg)
    words = rr.Points3D.from_fields(labels=captions, colors=WHITE, radii=0.0, show_labels=True)
    sink.fix("rig/names", words)
    for who, colour, width, order in (("measured", RED, -1.8, 1), ("twin", WHITE, -0.7, 2)):
        for plane in ("phase", "loop"):
            sink.fix(f"{plane}/data/{who}", strip(colors=colour, radii=width, draw_order=order))
        line = strip(radii=width, draw_order=order)
        sink.fix(f"prc/data/{who}", line, dot(radii=2 * width, draw_order=order))
    for plot in ("prc", "phase", "loop"):
        sink.fix(f"{plot}/grid", strip(radii=-0.5, draw_order=0))
        sink.fix(f"{plot}/numbers", dot(colors=GREY, radii=0.0, show_labels=True))
    for marks in ("prc/now", "phase/gaps", "loop/gaps"):
        sink.fix(marks, strip(colors=CONTACT, radii=-0.7))
    sink.fix("prc/ahead", strip(radii=-0.7, draw_order=3))
    for plot in ("u", "a", "force", "damper"):
        unseen = rr.SeriesPoints.from_fields(names="scale", colors=DIM, marker_sizes=0.3)
        sink.fix(f"{plot}/scale", unseen)
    marker = rr.SeriesPoints.from_fields(names="warning", colors=CONTACT, markers="diamond")
    sink.fix("disagreement/warnings", marker)


def _sliding(seconds: float, after: float = 0.0) -> Any:
    """The seconds before and after the cursor."""
    edge = rr.TimeRangeBoundary.cursor_relative
    return rr.TimeRange(start=edge(seconds=-seconds), end=edge(seconds=after))


def _so_far() -> Any:
    """Everything up to the cursor."""
    edge = rr.TimeRangeBoundary
    return rr.TimeRange(start=edge.infinite(), end=edge.cursor_relative(seconds=0.0))


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


def _course(origin: str, name: str) -> Any:
    """A time series of the whole run so far."""
    return rrb.TimeSeriesView(
        origin=origin,
        name=name,
        axis_x=rrb.TimeAxis(view_range=_so_far()),
        time_ranges=rrb.VisibleTimeRange("time", range=_so_far()),
        plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop),
        background=rrb.archetypes.PlotBackground(color=BACKGROUND),
    )


def _drawing(origin: str, name: str, width: float, **overrides: Any) -> Any:
    """A 2D view of a plot with drawn axes."""
    room = rrb.VisualBounds2D(x_range=(-0.2, width + 0.1), y_range=(-0.18, 1.26))
    return rrb.Spatial2DView(
        origin=origin, name=name, background=BACKGROUND, visual_bounds=room, **overrides
    )


def _plane(origin: str, name: str) -> Any:
    """A 2D view of the last two seconds of a trail."""
    recent = rrb.VisibleTimeRanges([rrb.VisibleTimeRange("time", range=_sliding(TRAIL_S))])
    trails = {f"/{origin}/data/{who}": recent for who in ("measured", "twin")}
    return _drawing(f"/{origin}", name, PLANE_WIDTH, overrides=trails)


def _left(scene: Scene, component: bool) -> Any:
    """The rig, what is going on, the PRC, the phase plane, the disagreement."""
    rig = rrb.Spatial3DView(
        origin="/rig",
        name=f"Rig: table x {scene.table_factor:g}, on it x {scene.factor:g}; free twin outlined",
        background=BACKGROUND,
        line_grid=False,
        eye_controls=EYE,
    )
    told = (("status", "Now"), ("ahead", "Next jump, by the model"), ("warning", "Last warning"))
    words = [rrb.TextDocumentView(origin=f"/{at}", name=name) for at, name in told]
    prc = "PRC, η_d: forward red, backward blue; free twin white, grey; now amber, next jump violet"
    phase = _plane("phase", "Phase plane: measured red, twin white")
    loop = _plane("loop", "Damper force on u")
    courses = rrb.Tabs(
        _course("/disagreement", "Disagreement: error / band"),
        _course("/drift", "Stiffness, damping [%]"),
        _course("/gaps", "Gaps [mm]"),
        _plot("/error", "Error of u [% of RMS]"),
    )
    return rrb.Vertical(
        rrb.Horizontal(rig, rrb.Vertical(*words, row_shares=[4, 3, 3]), column_shares=[5, 3]),
        _drawing("/prc", prc, PRC_WIDTH),
        rrb.Horizontal(rrb.Tabs(loop, phase) if component else phase, courses),
    )


def _right(start: RunStart, scene: Scene, component: bool) -> Any:
    """Time series, and what is said and counted."""
    plots = [
        _plot("/u", "Relative displacement u [mm], right positive"),
        _plot("/a", "Total acceleration of the mass [m/s²], right positive"),
    ]
    if component:
        plots.append(_plot("/damper", "Damper force [kN], resists motion to the right"))
    if scene.sides:
        plots.append(_plot("/force", "Contact forces F_R ≥ 0, F_L ≤ 0 [kN]"))
    hidden = rrb.encodings.TimelineColumn("time", visible=False)  # too narrow: the text says it
    kinds = rrb.encodings.TextLogColumnKind
    columns = rrb.TextLogColumns(
        timeline_columns=[hidden], text_log_columns=[kinds.LogLevel, kinds.Body]
    )
    events = [
        rrb.TextLogView(origin="/events", name="Events", columns=columns),
        _plot("/impacts", "Impacts per cycle"),
        _course("/latency", "Latency [ms]"),
        *[_plot("/other", "Other channels")] * any(name not in BY_NAME for name in start.channels),
    ]
    cycle = rrb.Tabs(
        rrb.TextDocumentView(origin="/cycle", name="Last cycle"),
        rrb.TextDocumentView(origin="/agreement", name="Agreement"),
        rrb.TextDocumentView(origin="/point", name="PRC point"),
    )
    words = rrb.Horizontal(cycle, rrb.Tabs(*events), column_shares=[3, 4])
    return rrb.Vertical(*plots, words, row_shares=[*[10 / len(plots)] * len(plots), 2.3])


def blueprint(start: RunStart, scene: Scene, live: bool) -> Any:
    """Left what the test is and where model and measurement part, right the time series."""
    component = "damper_force_n" in start.channels
    columns = _left(scene, component), _right(start, scene, component)
    play = "following" if live else "playing"
    return rrb.Blueprint(
        rrb.Horizontal(*columns, column_shares=[2, 3]),
        rrb.TimePanel(state="collapsed", timeline="time", play_state=play),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TopPanel(state="hidden"),
    )
