"""Layout of the Rerun view: arrangement and titles of the views, and static styles."""

from typing import Any

import rerun as rr
import rerun.blueprint as rrb

from table_io.channels import CHANNEL_BY_NAME
from table_io.records import RunStart
from twin.viewer.plots import (
    BACKGROUND_COLOUR,
    CONTACT_COLOUR,
    DARK_GREY,
    LINE_STYLES,
    PLANE_WIDTH,
    PRC_WIDTH,
    RED,
    TEAL,
    WHITE,
)
from twin.viewer.scene import HALF_MASS, Scene
from twin.viewer.sink import RerunSink

WINDOW_S, LEGEND_S = 5.0, 1.5  # of a sliding time series: visible span, and space for the legend
TRAIL_S = 2.0
# Created at import: the first such value makes pyarrow import pandas, which delays a run by 0.4 s.
EYE_CONTROLS = rrb.EyeControls3D(position=(0.0, -2.0, 0.75), look_target=(0.0, 0.0, 0.28))


def log_static(sink: RerunSink, scene: Scene, mass_kg: float) -> None:
    """Log the static names, colors and line widths of all entities."""
    for entity, lines in LINE_STYLES.items():
        sink.log_line_styles(entity, lines)
    if scene.sides:
        sink.log_line_styles("u/gaps", [("bumper", CONTACT_COLOUR, 1.0)] * len(scene.sides))
        sink.log_line_styles(
            "force/threshold", [("contact", CONTACT_COLOUR, 1.0)] * len(scene.sides)
        )
    box, strip, dot = (kind.from_fields for kind in (rr.Boxes3D, rr.LineStrips2D, rr.Points2D))
    sink.log_static("rig/bodies", box(fill_mode="solid"))
    sink.log_static("rig/frame", box(fill_mode="solid"))
    sink.log_static("rig/twin", box(half_sizes=1.01 * HALF_MASS, colors=TEAL, radii=-1.0))
    captions = scene.caption_texts(mass_kg)
    caption_points = rr.Points3D.from_fields(
        labels=captions, colors=WHITE, radii=0.0, show_labels=True
    )
    sink.log_static("rig/names", caption_points)
    for source, colour, width, order in (("measured", RED, -1.8, 1), ("twin", TEAL, -0.9, 2)):
        for plane in ("phase", "loop"):
            sink.log_static(
                f"{plane}/data/{source}", strip(colors=colour, radii=width, draw_order=order)
            )
        line = strip(radii=width, draw_order=order)
        sink.log_static(f"prc/data/{source}", line, dot(radii=2 * width, draw_order=order))
    for plot in ("prc", "phase", "loop"):
        sink.log_static(f"{plot}/grid", strip(radii=-0.5, draw_order=0))
        sink.log_static(f"{plot}/numbers", dot(colors=WHITE, radii=0.0, show_labels=True))
    for marks in ("prc/now", "phase/gaps", "loop/gaps"):
        sink.log_static(marks, strip(colors=CONTACT_COLOUR, radii=-0.7))
    sink.log_static("prc/ahead", strip(radii=-0.7, draw_order=3))
    sink.log_static("prc/data/branches", strip(radii=-0.8, draw_order=0.5))
    for plot in ("u", "a", "force", "damper"):
        scale_points = rr.SeriesPoints.from_fields(
            names="scale", colors=DARK_GREY, marker_sizes=0.3
        )
        sink.log_static(f"{plot}/scale", scale_points)
    marker = rr.SeriesPoints.from_fields(names="warning", colors=CONTACT_COLOUR, markers="diamond")
    sink.log_static("disagreement/warnings", marker)


def _sliding_range(before_s: float, after_s: float = 0.0) -> Any:
    """Return the time range from `before_s` to `after_s` around the cursor."""
    boundary = rr.TimeRangeBoundary.cursor_relative
    return rr.TimeRange(start=boundary(seconds=-before_s), end=boundary(seconds=after_s))


def _elapsed_range() -> Any:
    """Return the time range from the beginning to the cursor."""
    boundary = rr.TimeRangeBoundary
    return rr.TimeRange(start=boundary.infinite(), end=boundary.cursor_relative(seconds=0.0))


def _make_sliding_plot(origin: str, name: str) -> Any:
    """Make a sliding time-series view, with space for the legend on the left."""
    return rrb.TimeSeriesView(
        origin=origin,
        name=name,
        axis_x=rrb.TimeAxis(view_range=_sliding_range(WINDOW_S + LEGEND_S, 0.15)),
        time_ranges=rrb.VisibleTimeRange("time", range=_sliding_range(WINDOW_S)),
        plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop),
    )


def _make_run_plot(origin: str, name: str) -> Any:
    """Make a time-series view of the whole run up to the cursor."""
    return rrb.TimeSeriesView(
        origin=origin,
        name=name,
        axis_x=rrb.TimeAxis(view_range=_elapsed_range()),
        time_ranges=rrb.VisibleTimeRange("time", range=_elapsed_range()),
        plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop),
    )


def _make_drawn_view(origin: str, name: str, width: float, **overrides: Any) -> Any:
    """Make a 2D view of a plot with drawn axes."""
    bounds = rrb.VisualBounds2D(x_range=(-0.2, width + 0.1), y_range=(-0.18, 1.26))
    return rrb.Spatial2DView(
        origin=origin, name=name, background=BACKGROUND_COLOUR, visual_bounds=bounds, **overrides
    )


def _make_plane_view(origin: str, name: str) -> Any:
    """Make a 2D view of the last `TRAIL_S` of a trail."""
    recent = rrb.VisibleTimeRanges([rrb.VisibleTimeRange("time", range=_sliding_range(TRAIL_S))])
    trails = {f"/{origin}/data/{source}": recent for source in ("measured", "twin")}
    return _make_drawn_view(f"/{origin}", name, PLANE_WIDTH, overrides=trails)


def _make_left_column(scene: Scene, has_damper: bool) -> Any:
    """Make the left column: rig, status, PRC, phase plane, disagreement."""
    rig = rrb.Spatial3DView(
        origin="/rig",
        name=f"Rig: table x {scene.table_factor:g}, mass x {scene.factor:g}; free twin outlined",
        background=BACKGROUND_COLOUR,
        line_grid=False,
        eye_controls=EYE_CONTROLS,
    )
    documents = (
        ("status", "Status"),
        ("ahead", "Next jump (model forecast)"),
        ("warning", "Last warning"),
    )
    document_views = [
        rrb.TextDocumentView(origin=f"/{origin}", name=name) for origin, name in documents
    ]
    prc = (
        "PRC, η_d: forward red, backward blue; free twin teal, grey; branches thin; step amber, "
        "next jump violet"
    )
    phase = _make_plane_view("phase", "Phase plane: measured red, twin teal")
    loop = _make_plane_view("loop", "Damper force over u")
    run_plots = rrb.Tabs(
        _make_run_plot("/disagreement", "Disagreement: error / band"),
        _make_run_plot("/drift", "Stiffness, damping [%]"),
        _make_run_plot("/gaps", "Gaps [mm]"),
        _make_sliding_plot("/error", "Error of u [% of RMS]"),
    )
    return rrb.Vertical(
        rrb.Horizontal(
            rig, rrb.Vertical(*document_views, row_shares=[4, 3, 3]), column_shares=[5, 3]
        ),
        _make_drawn_view("/prc", prc, PRC_WIDTH),
        rrb.Horizontal(rrb.Tabs(loop, phase) if has_damper else phase, run_plots),
    )


def _make_right_column(start: RunStart, scene: Scene, has_damper: bool) -> Any:
    """Make the right column: time series, texts, events and counts."""
    plots = [
        _make_sliding_plot("/u", "Relative displacement u [mm], right positive"),
        _make_sliding_plot("/a", "Total acceleration of the mass [m/s²], right positive"),
    ]
    if has_damper:
        plots.append(
            _make_sliding_plot("/damper", "Damper force [kN], resists motion to the right")
        )
    if scene.sides:
        plots.append(_make_sliding_plot("/force", "Contact forces F_R ≥ 0, F_L ≤ 0 [kN]"))
    time_column = rrb.encodings.TimelineColumn(
        "time", visible=False
    )  # too narrow for the time, which the text contains
    kinds = rrb.encodings.TextLogColumnKind
    columns = rrb.TextLogColumns(
        timeline_columns=[time_column], text_log_columns=[kinds.LogLevel, kinds.Body]
    )
    event_views = [
        rrb.TextLogView(origin="/events", name="Events", columns=columns),
        _make_sliding_plot("/impacts", "Impacts per cycle"),
        _make_run_plot("/latency", "Latency [ms]"),
        *[_make_sliding_plot("/other", "Other channels")]
        * any(name not in CHANNEL_BY_NAME for name in start.channels),
    ]
    cycle_tabs = rrb.Tabs(
        rrb.TextDocumentView(origin="/cycle", name="Last cycle"),
        rrb.TextDocumentView(origin="/agreement", name="Agreement"),
        rrb.TextDocumentView(origin="/point", name="PRC point"),
    )
    text_row = rrb.Horizontal(cycle_tabs, rrb.Tabs(*event_views), column_shares=[3, 4])
    return rrb.Vertical(*plots, text_row, row_shares=[*[10 / len(plots)] * len(plots), 2.3])


def make_blueprint(start: RunStart, scene: Scene, is_live: bool) -> Any:
    """Make the layout: left rig, status and disagreement with the model, right time series."""
    has_damper = "damper_force_n" in start.channels
    columns = _make_left_column(scene, has_damper), _make_right_column(start, scene, has_damper)
    play_state = "following" if is_live else "playing"
    return rrb.Blueprint(
        rrb.Horizontal(*columns, column_shares=[2, 3]),
        rrb.TimePanel(state="collapsed", timeline="time", play_state=play_state),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TopPanel(state="hidden"),
    )
