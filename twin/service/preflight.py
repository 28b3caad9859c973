"""What `check` and `prc` print: the plan with its margins, and the curves as a table."""

from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from table_io.limits import warnings
from table_io.units import GRAVITY_M_S2
from twin.service.bundle import Bundle
from twin.service.summary import Json


def print_plan(console: Console, bundle: Bundle) -> None:
    """The plan of a test: steps, duration, amplitudes, and margins against the machine card."""
    profile, rig, drive = bundle.profile, bundle.rig, bundle.drive
    sweep = profile.sweep
    right, left = profile.specimen.gaps_m
    console.print(f"[bold]{profile.title}[/bold]", highlight=False)
    console.print(
        f"  specimen  {profile.specimen.mass_kg:g} kg, gap right {right * 1e3:g} mm, "
        f"left {left * 1e3:g} mm\n"
        f"  sweep     {sweep.start_hz:g} to {sweep.stop_hz:g} Hz by {sweep.step_hz:g}, "
        f"{' then '.join(sweep.directions)}, {sweep.cycles} cycles a step, "
        f"the last {sweep.measured_cycles} measured\n"
        f"  level     {sweep.acceleration_g:g} g peak table acceleration\n"
        f"  duration  {drive.planned_end / drive.rate_hz:.1f} s, {len(bundle.steps)} steps, "
        f"{profile.acquisition.rate_hz:g} Hz sampling\n"
        f"  table     {rig.title}",
        highlight=False,
        soft_wrap=True,
    )
    limits = rig.limits
    table = Table("asks of the table", "most", "at", "allowed", "used")
    for label, unit, scale, allowed, name in (
        ("displacement", "mm", 1e3, min(limits.stroke_mm, rig.output.span_mm), "displacement_m"),
        ("velocity", "mm/s", 1e3, limits.velocity_mm_s, "velocity_m_s"),
        ("acceleration", "g", 1 / GRAVITY_M_S2, limits.acceleration_g, "acceleration_m_s2"),
        ("force", "kN", 1e-3, limits.force_kn, "force_n"),
    ):
        worst = max(bundle.margins, key=lambda row, name=name: float(getattr(row, name)))  # type: ignore[misc]
        value = getattr(worst, name) * scale
        table.add_row(
            f"{label}, {unit}",
            f"{value:.4g}",
            f"{worst.frequency_hz:g} Hz {worst.direction}",
            f"{allowed:g}",
            f"{100 * value / allowed:.0f} %",
        )
    coarse = min(bundle.margins, key=lambda row: row.lsb)
    table.add_row(
        "amplitude in DAC steps",
        f"{coarse.lsb:.0f} (least)",
        f"{coarse.frequency_hz:g} Hz",
        f">= {rig.output.least_lsb}",
        "",
    )
    console.print(table)
    for sentence in warnings(bundle.margins, rig):
        console.print(f"warning: {sentence}", highlight=False)
    console.print("ready: nothing exceeds the machine card", highlight=False)


def draw_drive(bundle: Bundle, out: Path) -> Path:
    """A picture of the drive: displacement and acceleration over time, in `out`."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    drive = bundle.drive
    every = max(drive.planned_end // 400_000, 1)
    time_s = np.arange(0, drive.planned_end, every) / drive.rate_hz
    figure = Figure(figsize=(10, 5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, 1, sharex=True)
    level = bundle.profile.sweep.acceleration_g
    for axis, values, label in (
        (axes[0], drive.command(0, drive.planned_end) * 1e3, "displacement [mm]"),
        (axes[1], drive.acceleration(0, drive.planned_end) / GRAVITY_M_S2, "acceleration [g]"),
    ):
        axis.plot(time_s, values[::every], lw=0.4, color="#1f4e79")
        axis.set_ylabel(label)
        axis.grid(alpha=0.3)
    for sign in (-1, 1):
        axes[1].axhline(1.05 * sign * level, color="#b22222", lw=0.8, ls="--")
    axes[0].set_title(f"{bundle.profile.title}: command; dashed: 1.05 of the level")
    axes[1].set_xlabel("time [s]")
    figure.savefig(out, dpi=120)
    return out


def print_prc(console: Console, found: Json) -> None:
    """The curves of a summary as a table, then jumps and hysteresis."""
    table = Table(title=f"{found['run']['title']}: measured | twin")
    heads = ("f [Hz]", "eta_d", "eta_a", "eta_R", "eta_L", "r_R", "r_L", "impacts R", "impacts L")
    table.add_column("direction")
    for head in heads:
        table.add_column(head, justify="right")
    keys = ("eta_d", "eta_a", "eta_r", "eta_l", "r_r", "r_l")
    for step in found["steps"]:
        measured, twin = step["measured"] or {}, step["twin"] or {}
        cells = [f"{_number(measured.get(key))} | {_number(twin.get(key))}" for key in keys]
        for key in ("impacts_right", "impacts_left"):
            cells.append(f"{_mean(measured.get(key))} | {_mean(twin.get(key))}")
        table.add_row(step["direction"], f"{step['frequency_hz']:.3f}", *cells)
    console.print(table)
    for interval in found["hysteresis"]:
        console.print(
            f"{interval['kind']} hysteresis from {interval['from_hz']:g} to "
            f"{interval['to_hz']:g} Hz",
            highlight=False,
        )
    for jump in found["jumps"]:
        console.print(
            f"jump {jump['kind']}, {jump['direction']}, between {jump['from_hz']:g} and "
            f"{jump['to_hz']:g} Hz",
            highlight=False,
        )
    if not found["hysteresis"]:
        console.print("no hysteresis on this grid", highlight=False)


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def _mean(values: list[int] | tuple[int, ...] | None) -> str:
    return "-" if not values else f"{sum(values) / len(values):.3g}"
