"""A picture of a drive before it is played: steps, amplitudes, levels and limits over time."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from table_io.block import Bool2D, Float1D, Label
from table_io.drive import Drive, Segment, smoothstep
from table_io.limits import ROOM, limits_of
from table_io.units import GRAVITY_M_S2
from twin.service.bundle import Bundle

if TYPE_CHECKING:
    from matplotlib.axes import Axes

DIRECTION = {"forward": "#1f4e79", "backward": "#c06014", "": "#7a7a7a"}
KIND = {
    "loop check": "#7a7a7a",
    "blend": "#d8dee6",
    "tuning": "#8fb3d9",
    "settling": "#5c8fc2",
    "measured": "#1f4e79",
}
LIMIT = "#b22222"
PEAK = 1.05  # of the level: what a blend may ask for
SHOWN_STEPS = 2  # played out in full
POINTS = 25  # of a segment
STYLE: dict[Any, Any] = {"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}


def draw_drive(bundle: Bundle, out: Path) -> Path:
    """Frequency, amplitude and level over time, and the beginning sample by sample, in `out`."""
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with rc_context(STYLE):
        figure = Figure(figsize=(10, 9.5), layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.subplots(4, 1, height_ratios=(1, 1.3, 1.1, 1.1))
        traces = [_traced(segment, bundle.drive) for segment in bundle.drive.segments]
        _frequency(axes[0], traces)
        _amplitude(axes[1], traces, bundle)
        _level(axes[2], traces, bundle)
        _beginning(axes[3], bundle)
        end_s = bundle.drive.planned_end / bundle.drive.rate_hz
        for axis in axes[:3]:
            axis.set_xlim(0, end_s)
            axis.grid(alpha=0.25)
        title = f"{bundle.profile.title}\nThe drive {_uses(bundle)}"
        figure.suptitle(title, x=0.01, ha="left", fontsize=10)
        figure.savefig(out, dpi=120)
    return out


@dataclass(frozen=True, slots=True)
class _Trace:
    """A segment over time, (point,): s, Hz, demanded level in g, amplitude of the command in mm."""

    time_s: Float1D
    frequency_hz: Float1D
    level_g: Float1D
    amplitude_mm: Float1D
    direction: str
    parts: tuple[tuple[str, Bool2D], ...]  # (kind, which points)


def _traced(segment: Segment, drive: Drive) -> _Trace:
    share = segment.settle / segment.cycles if segment.cycles else 0.0
    x = np.union1d(np.linspace(0.0, 1.0, POINTS), [share])
    s = smoothstep(x)
    f = segment.f0 + (segment.f1 - segment.f0) * s
    level = segment.level0 + (segment.level1 - segment.level0) * s
    ends = segment.level0 * segment.correction0, segment.level1 * segment.correction1
    command = ends[0] + (ends[1] - ends[0]) * s
    directions = {step.index: step.direction for step in drive.steps}
    settling, measured = x <= share, x >= share
    parts: tuple[tuple[str, Bool2D], ...]
    if segment.step < 0:
        parts = (("loop check", x >= 0),)
    elif segment.cycles:
        parts = (("settling", settling), ("measured", measured))
    else:
        parts = (("blend" if segment.label == Label.BLEND else "tuning", x >= 0),)
    return _Trace(
        (segment.start + x * segment.count) / drive.rate_hz,
        f,
        level / GRAVITY_M_S2,
        1e3 * command / (2 * np.pi * f) ** 2,
        directions.get(segment.step, ""),
        parts,
    )


def _frequency(axis: "Axes", traces: list[_Trace]) -> None:
    for trace in traces:
        axis.plot(trace.time_s, trace.frequency_hz, color=DIRECTION[trace.direction], lw=2)
    shown = {trace.direction for trace in traces}
    for name in (name for name in DIRECTION if name in shown):
        axis.plot([], [], color=DIRECTION[name], lw=2, label=name or "loop check")
    axis.set_ylim(0, None)
    axis.set_ylabel("frequency [Hz]")
    axis.legend(frameon=False, ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0))


def _amplitude(axis: "Axes", traces: list[_Trace], bundle: Bundle) -> None:
    """Amplitude of the command, logarithmic: it spans 400 to 1 between 0.5 and 10 Hz."""
    output, stroke = bundle.rig.output, bundle.rig.limits.stroke_mm
    for trace in traces:
        seen = trace.amplitude_mm > 1e-2 * output.lsb_m * 1e3
        amplitude = np.where(seen, trace.amplitude_mm, np.nan)
        axis.plot(trace.time_s, amplitude, color=DIRECTION[trace.direction], lw=2)
    most, lsb = min(stroke, output.span_mm), output.lsb_m * 1e3
    lines = (
        (most, "-", f"stroke {most:g} mm", "bottom", 0.5),
        (most / ROOM, ":", f"room to correct it by {100 * (ROOM - 1):.0f} %", "top", 0.5),
        (lsb * output.warn_lsb, ":", f"{output.warn_lsb} DAC steps", "bottom", 0.93),
        (lsb * output.least_lsb, "-", f"{output.least_lsb} DAC steps", "top", 0.93),
    )
    for value, style, text, side, place in lines:
        axis.axhline(value, color=LIMIT, lw=1, ls=style)
        _noted(axis, text, value, side, place)
    axis.set_yscale("log")
    axis.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axis.set_ylim(lsb * output.least_lsb / 3, most * 3)
    axis.set_ylabel("amplitude of the\ncommand [mm]")


def _noted(
    axis: "Axes", text: str, value: float, side: str = "bottom", place: float = 0.85
) -> None:
    """Words at a limit: on which side of its line, and where along it."""
    axis.annotate(
        text, (place, value), xycoords=("axes fraction", "data"), color=LIMIT, fontsize=8,
        ha="center", va=side, xytext=(0, 2 if side == "bottom" else -2),
        textcoords="offset points",
    )  # fmt: skip


def _level(axis: "Axes", traces: list[_Trace], bundle: Bundle) -> None:
    """The demanded level, filled by what is done with it."""
    for trace in traces:
        for kind, where in trace.parts:
            axis.fill_between(
                trace.time_s, trace.level_g, where=list(where), color=KIND[kind], lw=0
            )
    level, allowed = bundle.profile.sweep.acceleration_g, bundle.rig.limits.acceleration_g
    axis.axhline(PEAK * level, color=LIMIT, lw=1, ls=":")
    _noted(axis, f"{PEAK:g} of the level; the table can do {allowed:g} g", PEAK * level)
    axis.set_ylim(0, 1.3 * level)
    axis.set_ylabel("level [g]")
    axis.set_xlabel("time [s]")
    for kind, colour in KIND.items():
        axis.fill_between([], [], color=colour, label=kind)
    axis.legend(frameon=False, ncols=5, loc="upper left", fontsize=8)


def _beginning(axis: "Axes", bundle: Bundle) -> None:
    """Acceleration of the ideal table through the loop check and the first steps."""
    drive = bundle.drive
    last = max(one.end for one in drive.segments if one.step < SHOWN_STEPS)
    acceleration = drive.acceleration(0, last) / GRAVITY_M_S2
    time_s = np.arange(last) / drive.rate_hz
    colours = {
        Label.REST: KIND["loop check"],
        Label.CHECK: KIND["loop check"],
        Label.BLEND: "#9aa7b5",
        Label.SETTLE: KIND["settling"],
        Label.MEASURE: KIND["measured"],
    }
    _, label, _ = drive.labels(0, last)
    for kind, colour in colours.items():
        axis.plot(time_s, np.where(label == kind, acceleration, np.nan), color=colour, lw=0.9)
    level = bundle.profile.sweep.acceleration_g
    for sign in (-1, 1):
        axis.axhline(sign * PEAK * level, color=LIMIT, lw=1, ls=":")
    axis.set_xlim(0, last / drive.rate_hz)
    axis.set_ylabel("acceleration [g]")
    axis.set_xlabel(f"time [s]: the first {min(SHOWN_STEPS, len(drive.steps))} steps in full")
    axis.grid(alpha=0.25)


def _uses(bundle: Bundle) -> str:
    """The largest share of each limit, in words."""
    shares = (
        f"{100 * max(map(limit.used, bundle.margins)) / limit.allowed:.0f} % of {limit.name}"
        for limit in limits_of(bundle.rig)
    )
    return f"uses {', '.join(shares)}"
