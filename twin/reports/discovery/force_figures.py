"""Force close-ups: residual-force loops over u, u' and depth, and force histories.

Measured data have the color of the direction, the fitted law or the model is black.
"""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from table_io.block import Float1D
from twin.identification.parameters import GENERIC_PREFIX, ParameterSet
from twin.identification.residuals import LogResiduals
from twin.reports.discovery.figure_data import (
    CloseUp,
    DiscoveryView,
    entries_to_samples,
    is_force,
    measured_forces,
    select_close_ups,
)
from twin.reports.plot_style import (
    DIRECTION_COLOURS,
    FIGURE_WIDTH_IN,
    GUIDE_COLOUR,
    SIDE_COLOURS,
    TWIN_COLOUR,
    CaptionedFigure,
    CaptionedFigures,
)

SIDES = ("right", "left")  # of residual rows 1 and 2


def draw_residual_forces(view: DiscoveryView) -> CaptionedFigures:
    """Draw residual damper force over u and u', bumper forces over depth, before and after."""
    residuals, steps = view.log_residuals[view.worst_log], view.sweep_steps(view.worst_log)
    damper = _draw_damper(view, residuals, select_close_ups(residuals, steps, 0))
    sides = [row for row in (1, 2) if (residuals.entry_row == row).any()]
    close_ups = {
        close_up.title: close_up
        for row in sides
        for close_up in select_close_ups(residuals, steps, row)
    }
    bumpers = _draw_bumpers(view, residuals, sides, list(close_ups.values())[:4])
    law_squares = np.nan_to_num(_force_entries(view)[1]) ** 2
    bumpers_dominate = (
        law_squares[residuals.entry_row == 0].sum()
        < law_squares[np.isin(residuals.entry_row, sides)].sum()
    )
    for drawn in (bumpers, damper) if bumpers_dominate else (damper, bumpers):
        yield from drawn


def _force_entries(view: DiscoveryView) -> tuple[Float1D, Float1D, Float1D]:
    """Return (measured minus model without the effects found, their force, residual), (entry,).

    If nothing was found, the first is the residual of the base model and the force is NaN.
    """
    if view.law_forces is not None:
        return view.law_forces
    before, after = (fitted.held_out[view.worst_log] for fitted in view.before_after)
    return before, np.full_like(before, np.nan), after


def _entry_parameters(view: DiscoveryView) -> ParameterSet:
    """Return the parameter set that belongs to the entries of `_force_entries`."""
    return (view.law or view.before_after[0]).fit.parameters


def _format_caption(view: DiscoveryView) -> str:
    if view.law is None:
        return "Measured force minus that of the model; no effect was found that explains it."
    return (
        f"Left of each pair: measured force minus that of the model without {view.law_name}; "
        f"black: the fitted law. Right: residual with this law, on the same scale."
    )


def _draw_damper(
    view: DiscoveryView, residuals: LogResiduals, close_ups: list[CloseUp]
) -> CaptionedFigures:
    if not close_ups:
        return
    m, no_law = residuals.motion(), np.full(residuals.signals.time_s.size, np.nan)
    wanted, law, remaining = (
        entries_to_samples(residuals, 0, values, _entry_parameters(view))
        for values in _force_entries(view)
    )
    u, v = ("$u$ in mm", 1e3 * m.u), ("$u'$ in mm/s", 1e3 * m.v)
    columns = [
        (*u, wanted, law),
        (*u, remaining, no_law),
        (*v, wanted, law),
        (*v, remaining, no_law),
    ]
    figure = Figure(figsize=(FIGURE_WIDTH_IN, 2.2 * len(close_ups) + 0.6))
    axes = figure.subplots(len(close_ups), 4, sharey="row", squeeze=False)
    for row_axes, close_up in zip(axes, close_ups, strict=True):
        for ax, (_, x, y, drawn) in zip(row_axes, columns, strict=True):
            _draw_loop(
                ax,
                (x[close_up.samples], y[close_up.samples]),
                DIRECTION_COLOURS[close_up.direction],
            )
            ax.plot(x[close_up.samples], drawn[close_up.samples], color=TWIN_COLOUR, lw=0.8)
        row_axes[0].set_title(close_up.title)
        row_axes[0].set_ylabel(_force_label(residuals, "damper"))
    for ax, text in zip(axes[0], ("before", "after", "before", "after"), strict=True):
        ax.set_title(text, loc="right", color=GUIDE_COLOUR)
    for ax, (label, *_) in zip(axes[-1], columns, strict=True):
        ax.set_xlabel(label)
    _add_legend(figure, view, [("measured minus model", DIRECTION_COLOURS["forward"])])
    title = "Damper force, measured minus model"
    yield CaptionedFigure("damper_force", title, _format_caption(view), figure)


def _draw_bumpers(
    view: DiscoveryView, residuals: LogResiduals, sides: list[int], close_ups: list[CloseUp]
) -> CaptionedFigures:
    if not close_ups:
        return
    m, entries, parameters = residuals.motion(), _force_entries(view), _entry_parameters(view)
    figure = Figure(figsize=(FIGURE_WIDTH_IN, 2.2 * (2 if len(close_ups) > 2 else 1) + 0.6))
    axes = figure.subplots(-(-len(close_ups) // 2), 4, sharey="row", squeeze=False)
    pairs = axes.reshape(-1, 2)
    for ax in pairs[len(close_ups) :].flat:
        ax.remove()
    for pair, close_up in zip(pairs, close_ups, strict=False):
        for row in sides:
            depth = 1e3 * ((m.u, -m.u)[row - 1] - m.gaps_m[row - 1])
            wanted, law, remaining = (
                entries_to_samples(residuals, row, values, parameters)[close_up.samples]
                for values in entries
            )
            colour = SIDE_COLOURS[SIDES[row - 1]]
            x = depth[close_up.samples]
            for ax, y in zip(pair, (wanted, remaining), strict=True):
                _draw_loop(ax, (x, y), colour)
            pair[0].plot(x, law, color=TWIN_COLOUR, lw=0.8, ls="-" if row == 1 else "--")
        pair[0].set_title(close_up.title)
        pair[0].set_ylabel("force in N")
        for ax, text in zip(pair, ("before", "after"), strict=True):
            ax.set_title(text, loc="right", color=GUIDE_COLOUR)
            ax.set_xlabel("depth in mm")
    names = [SIDES[row - 1] for row in sides]
    _add_legend(figure, view, [(f"{side} bumper", SIDE_COLOURS[side]) for side in names])
    caption = f"{_format_caption(view)} Depth: u beyond the gap stated in the log."
    yield CaptionedFigure("bumper_force", "Bumper forces, measured minus model", caption, figure)


def _draw_loop(ax: Axes, curve: tuple[Float1D, Float1D], colour: str) -> None:
    ax.axhline(0, color=GUIDE_COLOUR, lw=0.6)
    ax.plot(*curve, ".", color=colour, ms=3.2, alpha=0.6, mew=0)


def _force_label(residuals: LogResiduals, row: str) -> str:
    return "force in N" if is_force(residuals, 0) else f"{row} force over its noise"


def _add_legend(figure: Figure, view: DiscoveryView, dots: list[tuple[str, str]]) -> None:
    handles = [
        Line2D([], [], color=colour, marker=".", ls="", ms=7, label=text) for text, colour in dots
    ]
    if view.law is not None:
        handles.append(
            Line2D(
                [], [], color=TWIN_COLOUR, label=view.law_name.removeprefix(f"{GENERIC_PREFIX}.")
            )
        )
    figure.legend(handles=handles, loc="outside upper center", ncols=4)


def draw_force_histories(view: DiscoveryView) -> CaptionedFigures:
    """Draw measured and modelled forces over two cycles of the most improved step, held out."""
    residuals = view.log_residuals[view.worst_log]
    close_up = _find_best_close_up(view, residuals)
    if close_up is None or not is_force(residuals, 0):
        return
    rows_present = residuals.entry_row[np.isin(residuals.entry_sample, close_up.samples)]
    rows = [row for row in range(3) if (rows_present == row).any()]
    m, k = residuals.motion(), close_up.samples
    t = m.time_s[k] - m.time_s[k[0]]
    figure = Figure(figsize=(FIGURE_WIDTH_IN, 1.8 * len(rows) + 0.6))
    axes = figure.subplots(len(rows), 2, sharex=True, sharey="row", squeeze=False)
    names = ("damper", "right bumper", "left bumper")
    for column, (fitted, title) in enumerate(
        zip(view.before_after, ("before", "after"), strict=True)
    ):
        for ax, row in zip(axes[:, column], rows, strict=True):
            measured = measured_forces(residuals, fitted.fit.parameters)
            error = entries_to_samples(
                residuals, row, fitted.held_out[view.worst_log], fitted.fit.parameters
            )
            ax.plot(t, measured[row][k], color=DIRECTION_COLOURS[close_up.direction], lw=2.2)
            model: dict[str, Any] = {"color": TWIN_COLOUR, "lw": 0.9}
            ax.plot(t, (measured[row] - error)[k], **model)
            ax.set_ylabel(f"{names[row]} in N" if column == 0 else "")
        axes[0, column].set_title(f"{title}, {close_up.title}")
        axes[-1, column].set_xlabel("time in s")
    handles = [
        Line2D([], [], color=DIRECTION_COLOURS[close_up.direction], lw=2.2, label="measured"),
        Line2D([], [], color=TWIN_COLOUR, lw=0.9, label="model on the measured motion"),
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=2)
    caption = (
        "The close-up with the largest improvement. The model parameters are those of the fit "
        "without these samples. Samples that are not used have no line: near contact and "
        "release, and bumper forces without contact."
    )
    yield CaptionedFigure("histories", "Force histories, held out", caption, figure)


def _find_best_close_up(view: DiscoveryView, residuals: LogResiduals) -> CloseUp | None:
    """Return the close-up of all force rows with the largest gain, or else largest residual."""
    steps = view.sweep_steps(view.worst_log)
    close_ups = [
        close_up
        for row in range(3)
        if residuals.row_mask[row].any()
        for close_up in select_close_ups(residuals, steps, row)
    ]
    before, after = (fitted.held_out[view.worst_log] for fitted in view.before_after)
    gain = before**2 - after**2 if view.before_after[1].effects else before**2

    def mean_gain(close_up: CloseUp) -> float:
        return (
            float(gain[np.isin(residuals.entry_sample, close_up.samples)].sum())
            / close_up.samples.size
        )

    return max(close_ups, key=mean_gain, default=None)
