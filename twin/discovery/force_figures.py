"""Forces: the law of each effect, residual-force loops over u, u' and depth, and histories.

Measured data have the color of the direction, the fitted law or the model is black.
"""

from dataclasses import replace

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from table_io.block import Float1D
from twin.discovery.figure_data import (
    CloseUp,
    DiscoveryView,
    TermForces,
    compute_term_forces,
    entries_to_samples,
    is_force,
    measured_forces,
    select_close_ups,
)
from twin.discovery.residuals import LogResiduals
from twin.drawing.panels import CaptionedFigure, CaptionedFigures
from twin.drawing.plot_style import (
    DIRECTION_COLOURS,
    FIGURE_WIDTH_IN,
    GUIDE_COLOUR,
    SIDE_COLOURS,
    TWIN_COLOUR,
    LineStyle,
)

SIDES = ("right", "left")  # of residual rows 1 and 2
FORCE_NAMES = ("damper", "right bumper", "left bumper")
MAX_POINTS = 6000  # of a cloud
MIN_CYCLE_SAMPLES = 25.0  # of the main motion, for a line through the samples


def draw_residual_forces(view: DiscoveryView) -> CaptionedFigures:
    """Draw the law of each effect, then residual damper and bumper forces, before and after."""
    yield from _draw_laws(view)
    residuals, steps = view.log_residuals[view.worst_log], view.sweep_steps(view.worst_log)
    damper = _draw_damper(view, residuals, select_close_ups(residuals, steps, 0))
    sides = [row for row in (1, 2) if (residuals.entry_row == row).any()]
    close_ups = {
        close_up.title: close_up
        for row in sides
        for close_up in select_close_ups(residuals, steps, row)
    }
    bumpers = _draw_bumpers(view, residuals, sides, list(close_ups.values())[:4])
    squares = np.nansum(_forces(view).law ** 2, axis=1)
    in_bumpers = squares[0] < squares[1:].sum() or "bumper" in view.discovery.verdict.place
    for drawn in (bumpers, damper) if in_bumpers else (damper, bumpers):
        yield from drawn


def _forces(view: DiscoveryView) -> TermForces:
    """Return the forces to draw; if nothing was found, the residual of the base model alone."""
    if view.law_forces is not None:
        return view.law_forces
    residuals, null = view.log_residuals[view.worst_log], view.before_after[0]
    forces = compute_term_forces(residuals, null.fit.parameters, ())
    return replace(forces, law=np.zeros_like(forces.law))


def _draw_laws(view: DiscoveryView) -> CaptionedFigures:
    """Draw the force of each effect over displacement and rate: required by the data, and fitted.

    Over depth where it acts in a bumper.
    """
    drawn = [forces for forces in view.forces_of_each if np.nansum(forces.law**2) > 0]
    if not drawn:
        return
    m = view.log_residuals[view.worst_log].motion()
    figure = Figure(figsize=(FIGURE_WIDTH_IN, 2.9 * len(drawn) + 0.5))
    axes = figure.subplots(len(drawn), 2, sharey="row", squeeze=False)
    for row_axes, forces in zip(axes, drawn, strict=True):
        row = int(np.argmax(np.nansum(forces.law**2, axis=1)))
        used = np.flatnonzero(np.isfinite(forces.required[row]))
        used = used[:: max(used.size // MAX_POINTS, 1)]
        sign = -1.0 if row == 2 else 1.0
        depth = sign * m.u - (m.gaps_m[row - 1] if row else 0.0)
        names = ("depth in mm", "rate of depth in mm/s") if row else ("$u$ in mm", "$u'$ in mm/s")
        measured = forces.required[row, used]
        for ax, x, name in zip(row_axes, (depth, sign * m.v), names, strict=True):
            _draw_loop(ax, (1e3 * x[used], measured), DIRECTION_COLOURS["forward"])
            ax.xaxis.set_major_locator(MaxNLocator(6))
            ax.plot(1e3 * x[used], forces.law[row, used], ".", color=TWIN_COLOUR, ms=1.1, mew=0)
            ax.set_xlabel(name)
        remaining = forces.remaining[row]
        sizes = [float(np.nanstd(force)) for force in (forces.required[row], remaining)]
        row_axes[0].set_title(f"{forces.label}: {FORCE_NAMES[row]}")
        row_axes[1].set_title(
            f"rms {sizes[0]:.3g} N required, {sizes[1]:.3g} N remain", loc="right",
            color=GUIDE_COLOUR,
        )  # fmt: skip
        row_axes[0].set_ylabel("force in N")
    handles = [
        Line2D([], [], color=colour, marker=".", ls="", ms=size, label=text)
        for text, colour, size in (
            ("required of the effect", DIRECTION_COLOURS["forward"], 7),
            ("the law as fitted", TWIN_COLOUR, 4),
        )
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=3)
    caption = (
        "What measurement requires of each law, measured force minus that of the model without it, "
        "and the law itself, over the whole log with the largest residual."
    )
    title = f"Force of what was found, measured and fitted{view.title_suffix(view.worst_log)}"
    yield CaptionedFigure("laws", title, caption, figure)


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
    forces = _forces(view)
    wanted, law, remaining = forces.required[0], forces.law[0], forces.remaining[0]
    law = no_law if view.law is None else law
    u, v = ("$u$ in mm", 1e3 * m.u), ("$u'$ in mm/s", 1e3 * m.v)
    columns = [
        (*u, wanted, law),
        (*u, remaining, no_law),
        (*v, wanted, law),
        (*v, remaining, no_law),
    ]
    cycle = 2 * np.pi * residuals.scale.time_s / residuals.scale.sample_s
    # lines between few samples of a cycle would draw a polygon
    law_style: LineStyle = (
        {"lw": 0.8} if cycle > MIN_CYCLE_SAMPLES else {"ls": "", "marker": ".", "ms": 1.4, "mew": 0}
    )
    figure = Figure(figsize=(FIGURE_WIDTH_IN, 2.2 * len(close_ups) + 0.6))
    axes = figure.subplots(len(close_ups), 4, sharey="row", squeeze=False)
    for row_axes, close_up in zip(axes, close_ups, strict=True):
        for ax, (_, x, y, drawn) in zip(row_axes, columns, strict=True):
            _draw_loop(
                ax,
                (x[close_up.samples], y[close_up.samples]),
                DIRECTION_COLOURS[close_up.direction],
            )
            ax.plot(x[close_up.samples], drawn[close_up.samples], color=TWIN_COLOUR, **law_style)
            ax.xaxis.set_major_locator(MaxNLocator(4))
        row_axes[0].set_title(close_up.title)
        row_axes[0].set_ylabel("force in N")
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
    m, forces = residuals.motion(), _forces(view)
    figure = Figure(figsize=(FIGURE_WIDTH_IN, 2.2 * (2 if len(close_ups) > 2 else 1) + 0.6))
    axes = figure.subplots(-(-len(close_ups) // 2), 4, sharey="row", squeeze=False)
    pairs = axes.reshape(-1, 2)
    for ax in pairs[len(close_ups) :].flat:
        ax.remove()
    for pair, close_up in zip(pairs, close_ups, strict=False):
        for row in sides:
            depth = 1e3 * ((m.u, -m.u)[row - 1] - m.gaps_m[row - 1])
            wanted, law, remaining = (
                values[row, close_up.samples]
                for values in (forces.required, forces.law, forces.remaining)
            )
            colour = SIDE_COLOURS[SIDES[row - 1]]
            x = depth[close_up.samples]
            for ax, y in zip(pair, (wanted, remaining), strict=True):
                _draw_loop(ax, (x, y), colour)
            if view.law is not None:
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


def _add_legend(figure: Figure, view: DiscoveryView, dots: list[tuple[str, str]]) -> None:
    handles = [
        Line2D([], [], color=colour, marker=".", ls="", ms=7, label=text) for text, colour in dots
    ]
    if view.law is not None:
        handles.append(Line2D([], [], color=TWIN_COLOUR, label=view.law_name))
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
    for column, (fitted, title) in enumerate(
        zip(view.before_after, ("before", "after"), strict=True)
    ):
        for ax, row in zip(axes[:, column], rows, strict=True):
            measured = measured_forces(residuals, fitted.fit.parameters)
            error = entries_to_samples(
                residuals, row, view.evaluate(fitted, view.worst_log), fitted.fit.parameters
            )
            ax.plot(t, measured[row][k], color=DIRECTION_COLOURS[close_up.direction], lw=2.2)
            model: LineStyle = {"color": TWIN_COLOUR, "lw": 0.9}
            ax.plot(t, (measured[row] - error)[k], **model)
            ax.set_ylabel(f"{FORCE_NAMES[row]} in N" if column == 0 else "")
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
    before, after = (view.evaluate(fitted, view.worst_log) for fitted in view.before_after)
    gain = before**2 - after**2 if view.before_after[1].effects else before**2

    def mean_gain(close_up: CloseUp) -> float:
        return (
            float(gain[np.isin(residuals.entry_sample, close_up.samples)].sum())
            / close_up.samples.size
        )

    return max(close_ups, key=mean_gain, default=None)
