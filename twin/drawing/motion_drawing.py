"""Motions in figures: portraits, force loops, histories, contact bands, bumpers at rest."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from table_io.block import Float1D
from twin.drawing.panels import Canvas
from twin.drawing.plot_style import REST_LINE_STYLE, LineStyle
from twin.results.players import SystemMotion


def plot_phase_portrait(ax: Canvas, motion: SystemMotion, **style: Any) -> None:
    """Plot the phase portrait, velocity in mm/s over u in mm."""
    ax.plot(motion.u * 1e3, motion.v * 1e3, **style)


def plot_inertia_loop(
    ax: Canvas, motion: SystemMotion, mass: float, closed: bool = False, **style: Any
) -> None:
    """Plot the inertia force -M a in kN over u in mm; `closed` joins the ends of the loop."""
    _plot_loop(ax, motion.u * 1e3, -mass * motion.a / 1e3, closed, style)


def plot_bumper_loops(ax: Canvas, motion: SystemMotion, closed: bool = False, **style: Any) -> None:
    """Plot the contact force in kN over the bumper position in mm, both sides."""
    for position, force in ((motion.v_r, motion.force_r), (motion.v_l, motion.force_l)):
        _plot_loop(ax, position * 1e3, force / 1e3, closed, style)


def _plot_loop(ax: Canvas, x: Float1D, y: Float1D, closed: bool, style: LineStyle) -> None:
    ax.plot(*((np.append(x, x[0]), np.append(y, y[0])) if closed else (x, y)), **style)


def plot_history(axes: Sequence[Canvas], motion: SystemMotion, **style: Any) -> None:
    """Plot u in mm, acceleration in m/s2 and, where there is a third panel, forces in kN."""
    axes[0].plot(motion.time, motion.u * 1e3, **style)
    axes[1].plot(motion.time, motion.a, **style)
    for ax in axes[2:]:
        for force in (motion.force_r, motion.force_l):
            ax.plot(motion.time, force / 1e3, **style)


def shade_contact(
    ax: Canvas,
    motion: SystemMotion,
    colour: str,
    alphas: tuple[float, float],
    contact_n: float = 0.0,
    within: Any = True,
) -> None:
    """Shade each contact (right, left) as a vertical band, where the mask `within` is true."""
    for force, alpha in zip((motion.force_r, -motion.force_l), alphas, strict=True):
        edges = np.diff(np.pad(((force > contact_n) & within).astype(int), 1))
        for first, end in zip(np.flatnonzero(edges > 0), np.flatnonzero(edges < 0), strict=True):
            start, stop = motion.time[first], motion.time[end - 1]
            ax.axvspan(start, stop, color=colour, alpha=alpha, lw=0, zorder=0.5)


def draw_rest_lines(gaps_m: tuple[float, float], draw: Callable[..., Any], **style: Any) -> None:
    """Draw dashed lines at the bumpers at rest, or where contact of a precompressed one ends."""
    for position_mm in {gaps_m[0] * 1e3, -gaps_m[1] * 1e3}:
        draw(position_mm, **(REST_LINE_STYLE | style))
