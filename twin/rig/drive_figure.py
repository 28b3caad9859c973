"""Figures of a planned drive: frequency, amplitude, level or motion, and limits over time."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from table_io.block import Bool2D, Float1D, Label
from table_io.config.excitation.waveform import smoothstep
from table_io.excitation.drive import Drive, Segment
from table_io.safety.preflight import CORRECTION_HEADROOM, list_limits
from table_io.units import GRAVITY_M_S2
from twin.drawing.pictures import RC_PARAMS
from twin.setup.run_config import RunConfig

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SWEEP_COLOURS = {"forward": "#1f4e79", "backward": "#c06014", "": "#7a7a7a"}
SEGMENT_COLOURS = {
    "loop check": "#7a7a7a",
    "blend": "#d8dee6",
    "tuning": "#8fb3d9",
    "settling": "#5c8fc2",
    "measured": "#1f4e79",
}
LIMIT_COLOUR = "#b22222"
MAX_BLEND_RATIO = 1.05  # largest amplitude in a blend over the level
SHOWN_STEPS = 2  # steps whose waveform is plotted
POINTS_PER_SEGMENT = 25


def draw_drive(run_config: RunConfig, out: Path) -> Path:
    """Draw frequency, amplitude, level and the first waveforms into `out`; return `out`.

    Of a displacement history draw displacement, velocity and acceleration.
    """
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    if not run_config.steps:
        return _draw_history(run_config, out)
    with rc_context(RC_PARAMS):
        figure = Figure(figsize=(10, 9.5))
        FigureCanvasAgg(figure)
        axes = figure.subplots(4, 1, height_ratios=(1, 1.3, 1.1, 1.1))
        traces = [
            _trace_segment(segment, run_config.drive) for segment in run_config.drive.sine_segments
        ]
        _plot_frequency(axes[0], traces)
        _plot_amplitude(axes[1], traces, run_config)
        _plot_level(axes[2], traces, run_config)
        _plot_beginning(axes[3], run_config)
        end_s = run_config.drive.planned_end / run_config.drive.rate_hz
        for axis in axes[:3]:
            axis.set_xlim(0, end_s)
        title = f"{run_config.profile.title}\nThe drive {_format_usage(run_config)}"
        figure.suptitle(title, x=0.01, ha="left", fontsize=10)
        figure.savefig(out)
    return out


def _draw_history(run_config: RunConfig, out: Path) -> Path:
    """Draw displacement, velocity and acceleration of the whole drive into `out`; return `out`."""
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    drive, limits = run_config.drive, list_limits(run_config.rig)[:3]
    count = drive.planned_end
    displacement = drive.command(0, count)
    motion = (
        displacement * 1e3,
        np.gradient(displacement) * drive.rate_hz * 1e3,
        drive.acceleration(0, count) / GRAVITY_M_S2,
    )
    time_s, (window, _, _) = np.arange(count) / drive.rate_hz, drive.labels(0, count)
    with rc_context(RC_PARAMS):
        figure = Figure(figsize=(10, 8), layout="constrained")
        FigureCanvasAgg(figure)
        for axis, limit, values in zip(
            figure.subplots(3, 1, sharex=True), limits, motion, strict=True
        ):
            axis.plot(time_s, np.where(window < 0, values, np.nan), color=SWEEP_COLOURS[""], lw=0.9)
            for parity, colour in enumerate(
                (SEGMENT_COLOURS["measured"], SWEEP_COLOURS["backward"])
            ):
                is_shown = (window >= 0) & (window % 2 == parity)
                axis.plot(time_s, np.where(is_shown, values, np.nan), color=colour, lw=0.9)
            peak = 1.2 * float(np.abs(values).max())
            axis.set_ylim(-peak, peak)
            axis.set_ylabel(f"{limit.name} [{limit.unit}]")
            axis.set_title(f"limit of the table {limit.allowed:g} {limit.unit}", fontsize=8)
            axis.grid(alpha=0.25)
        axis.set_xlabel("time [s]; grey: loop check; the colors change from window to window")
        axis.set_xlim(0, count / drive.rate_hz)
        title = f"{run_config.profile.title}\nThe drive {_format_usage(run_config)}"
        figure.suptitle(title, x=0.01, ha="left", fontsize=10)
        figure.savefig(out, dpi=120)
    return out


@dataclass(frozen=True, slots=True)
class _SegmentTrace:
    """Segment of the drive over time, (point,) each; level is demanded, amplitude commanded."""

    time_s: Float1D
    frequency_hz: Float1D
    level_g: Float1D
    amplitude_mm: Float1D
    direction: str
    parts: tuple[tuple[str, Bool2D], ...]  # (kind, mask of the points)


def _trace_segment(segment: Segment, drive: Drive) -> _SegmentTrace:
    settle_share = segment.settle / segment.cycles if segment.cycles else 0.0
    x = np.union1d(np.linspace(0.0, 1.0, POINTS_PER_SEGMENT), [settle_share])
    s = smoothstep(x)
    f = segment.f0 + (segment.f1 - segment.f0) * s
    level = segment.level0 + (segment.level1 - segment.level0) * s
    end_commands = segment.level0 * segment.correction0, segment.level1 * segment.correction1
    command = end_commands[0] + (end_commands[1] - end_commands[0]) * s
    directions = {step.index: step.direction for step in drive.steps}
    settling, measured = x <= settle_share, x >= settle_share
    parts: tuple[tuple[str, Bool2D], ...]
    if segment.step < 0:
        parts = (("loop check", x >= 0),)
    elif segment.cycles:
        parts = (("settling", settling), ("measured", measured))
    else:
        parts = (("blend" if segment.label == Label.BLEND else "tuning", x >= 0),)
    return _SegmentTrace(
        (segment.start + x * segment.count) / drive.rate_hz,
        f,
        level / GRAVITY_M_S2,
        1e3 * command / (2 * np.pi * f) ** 2,
        directions.get(segment.step, ""),
        parts,
    )


def _plot_frequency(axis: "Axes", traces: list[_SegmentTrace]) -> None:
    for trace in traces:
        axis.plot(trace.time_s, trace.frequency_hz, color=SWEEP_COLOURS[trace.direction], lw=2)
    directions = {trace.direction for trace in traces}
    for direction in (name for name in SWEEP_COLOURS if name in directions):
        axis.plot([], [], color=SWEEP_COLOURS[direction], lw=2, label=direction or "loop check")
    axis.set_ylim(0, None)
    axis.set_ylabel("frequency in Hz")
    axis.legend(ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0))


def _plot_amplitude(axis: "Axes", traces: list[_SegmentTrace], run_config: RunConfig) -> None:
    """Plot the command amplitude on a log axis: it spans 400 to 1 between 0.5 and 10 Hz."""
    output, stroke = run_config.rig.output, run_config.rig.limits.stroke_mm
    for trace in traces:
        is_visible = trace.amplitude_mm > 1e-2 * output.lsb_m * 1e3
        amplitude = np.where(is_visible, trace.amplitude_mm, np.nan)
        axis.plot(trace.time_s, amplitude, color=SWEEP_COLOURS[trace.direction], lw=2)
    max_amplitude_mm, lsb_mm = min(stroke, output.span_mm), output.lsb_m * 1e3
    lines = (
        (max_amplitude_mm, "-", f"stroke {max_amplitude_mm:g} mm", "bottom", 0.5),
        (
            max_amplitude_mm / CORRECTION_HEADROOM,
            ":",
            f"headroom for a correction of {100 * (CORRECTION_HEADROOM - 1):.0f} %",
            "top",
            0.5,
        ),
        (lsb_mm * output.warn_lsb, ":", f"{output.warn_lsb} DAC steps", "bottom", 0.93),
        (lsb_mm * output.least_lsb, "-", f"{output.least_lsb} DAC steps", "top", 0.93),
    )
    for value, style, text, side, position in lines:
        axis.axhline(value, color=LIMIT_COLOUR, lw=1, ls=style)
        _annotate_limit(axis, text, value, side, position)
    axis.set_yscale("log")
    axis.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axis.set_ylim(lsb_mm * output.least_lsb / 3, max_amplitude_mm * 3)
    axis.set_ylabel("amplitude of the\ncommand in mm")


def _annotate_limit(
    axis: "Axes", text: str, value: float, side: str = "bottom", position: float = 0.85
) -> None:
    """Label a limit line: `side` of the line, `position` along the axis from 0 to 1."""
    axis.annotate(
        text, (position, value), xycoords=("axes fraction", "data"), color=LIMIT_COLOUR, fontsize=8,
        ha="center", va=side, xytext=(0, 2 if side == "bottom" else -2),
        textcoords="offset points",
    )  # fmt: skip


def _plot_level(axis: "Axes", traces: list[_SegmentTrace], run_config: RunConfig) -> None:
    """Plot the demanded level, colored by kind of segment."""
    for trace in traces:
        for kind, mask in trace.parts:
            axis.fill_between(
                trace.time_s, trace.level_g, where=list(mask), color=SEGMENT_COLOURS[kind], lw=0
            )
    level = run_config.profile.plan.level_m_s2 / GRAVITY_M_S2
    allowed = run_config.rig.limits.acceleration_g
    axis.axhline(MAX_BLEND_RATIO * level, color=LIMIT_COLOUR, lw=1, ls=":")
    _annotate_limit(
        axis,
        f"{MAX_BLEND_RATIO:g} × level; limit of the table {allowed:g} g",
        MAX_BLEND_RATIO * level,
    )
    axis.set_ylim(0, 1.3 * level)
    axis.set_ylabel("level in g")
    axis.set_xlabel("time in s")
    for kind, colour in SEGMENT_COLOURS.items():
        axis.fill_between([], [], color=colour, label=kind)
    axis.legend(ncols=5, loc="upper left", fontsize=8)


def _plot_beginning(axis: "Axes", run_config: RunConfig) -> None:
    """Plot the ideal table acceleration during the loop check and the first steps."""
    drive = run_config.drive
    end = max(segment.end for segment in drive.sine_segments if segment.step < SHOWN_STEPS)
    acceleration = drive.acceleration(0, end) / GRAVITY_M_S2
    time_s = np.arange(end) / drive.rate_hz
    colours = {
        Label.REST: SEGMENT_COLOURS["loop check"],
        Label.CHECK: SEGMENT_COLOURS["loop check"],
        Label.BLEND: "#9aa7b5",
        Label.SETTLE: SEGMENT_COLOURS["settling"],
        Label.MEASURE: SEGMENT_COLOURS["measured"],
    }
    _, label, _ = drive.labels(0, end)
    for kind, colour in colours.items():
        axis.plot(time_s, np.where(label == kind, acceleration, np.nan), color=colour, lw=0.9)
    level = run_config.profile.plan.level_m_s2 / GRAVITY_M_S2
    for sign in (-1, 1):
        axis.axhline(sign * MAX_BLEND_RATIO * level, color=LIMIT_COLOUR, lw=1, ls=":")
    axis.set_xlim(0, end / drive.rate_hz)
    axis.set_ylabel("acceleration in g")
    axis.set_xlabel(f"time in s, first {min(SHOWN_STEPS, len(drive.steps))} steps")


def _format_usage(run_config: RunConfig) -> str:
    """Format the largest utilization of each limit as text."""
    shares = (
        f"{100 * max(map(limit.demand, run_config.margins)) / limit.allowed:.0f} % of {limit.name}"
        for limit in list_limits(run_config.rig)
    )
    return f"uses {', '.join(shares)}"
