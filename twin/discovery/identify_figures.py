"""Figures of an identification: force laws against measurement, and estimates from subsets."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from twin.discovery.cross_checks import fitted_gap
from twin.discovery.identify import IdentificationResult
from twin.discovery.parameters import is_correction
from twin.discovery.residuals import LogResiduals
from twin.drawing.panels import CaptionedFigure, CaptionedFigures, Picture
from twin.drawing.pictures import save_figures
from twin.drawing.plot_style import (
    DIRECTION_COLOURS,
    FIGURE_WIDTH_IN,
    GUIDE_COLOUR,
    SIDE_COLOURS,
    TWIN_COLOUR,
)
from twin.evidence.linear import INTERVAL_SIGMA

MAX_POINTS = 6000  # of a scatter plot
CLOUD_STYLE = {"ls": "", "marker": ".", "ms": 1.6, "mew": 0, "alpha": 0.6, "rasterized": True}


def draw_identification_figures(result: IdentificationResult, folder: Path) -> list[Picture]:
    """Write laws<log>.png, correlation.png and sources.png to the folder; return them in order."""
    return save_figures(_draw_figures(result), folder)


def _draw_figures(result: IdentificationResult) -> CaptionedFigures:
    for residuals in result.problem.log_residuals:
        caption = (
            "Measured forces over the measured motion, less what the other terms explain, and the "
            "identified laws. Below right: gap of each side from single contacts."
        )
        title = f"Force laws, {residuals.signals.name}"
        name = f"laws{residuals.log_number}"
        yield CaptionedFigure(name, title, caption, _draw_laws(result, residuals))
    if result.subsets:
        caption = (
            "Each parameter from one subset of the samples, with its 95 % interval; the grey band "
            "is the interval of the joint fit. A point without a bar has too few cycles for one."
        )
        title = "Estimates from subsets of the samples"
        yield CaptionedFigure("sources", title, caption, _draw_subsets(result))
    caption = "Near ±1, only a combination of the two parameters is determined."
    yield CaptionedFigure("correlation", "Correlation of the estimates", caption,
                          _draw_correlation(result))  # fmt: skip


def _draw_laws(result: IdentificationResult, residuals: LogResiduals) -> Figure:
    """Draw damper force over u and u', bumper forces over depth, and gaps from contact onsets."""
    figure = Figure(figsize=(FIGURE_WIDTH_IN, 7.0))
    figure.suptitle(residuals.signals.name, x=0.01, ha="left", fontsize=10)
    (over_u, over_v), (bumper, places) = figure.subplots(2, 2)
    _draw_damper(result, residuals, over_u, over_v)
    _draw_bumpers(result, residuals, bumper)
    _draw_onsets(result, residuals, places)
    return figure


def _thin(mask: np.ndarray) -> np.ndarray:
    samples = np.flatnonzero(mask)
    return samples[:: max(samples.size // MAX_POINTS, 1)]


def _draw_damper(
    result: IdentificationResult, residuals: LogResiduals, over_u: Axes, over_v: Axes
) -> None:
    m = residuals.motion(result.fit.parameters.assumed_sensors())
    p = result.fit.parameters.model_for_log(residuals.log_number, m).parameters
    cells = (m.right - m.left) if m.has_load_cells else 0.0
    force = m.damper if m.damper is not None else -m.mass_kg * m.acc - cells
    samples = _thin(m.moving & np.isfinite(force))
    u, v = m.u[samples], m.v[samples]
    for ax, x, rest, slope, label in (
        (over_u, 1e3 * u, force[samples] - p.damping * v, 1e-3 * p.stiffness, "K u"),
        (over_v, v, force[samples] - p.stiffness * u, p.damping, "C u'"),
    ):
        ax.plot(x, rest, color=DIRECTION_COLOURS["backward"], **CLOUD_STYLE)  # type: ignore[arg-type]
        ends = np.array([x.min(), x.max()])
        ax.plot(ends, slope * ends, color=TWIN_COLOUR, lw=1, label=label)
        ax.legend(loc="upper left")
    over_u.set(xlabel="u in mm", ylabel="D − C u' in N", title="damper: spring")
    over_v.set(xlabel="u' in m/s", ylabel="D − K u in N", title="damper: dashpot")


def _draw_bumpers(result: IdentificationResult, residuals: LogResiduals, ax: Axes) -> None:
    m = residuals.motion(result.fit.parameters.assumed_sensors())
    p = result.fit.parameters.model_for_log(residuals.log_number, m).parameters
    deepest = 0.0
    for side, sign, k, c, force, row in (
        ("right", 1, p.bumper_stiffness_r, p.bumper_damping_r, m.right, 0),
        ("left", -1, p.bumper_stiffness_l, p.bumper_damping_l, m.left, 1),
    ):
        samples = _thin(m.moving & (residuals.contact_state[row] > 0))
        if not samples.size:
            continue
        depth = sign * m.u[samples] - fitted_gap(residuals, result.fit, side)
        ax.plot(1e3 * depth, force[samples], color=SIDE_COLOURS[side], **CLOUD_STYLE | {"ms": 3.2})  # type: ignore[arg-type]
        law = k * depth + c * sign * m.v[samples]
        ax.plot(1e3 * depth, law, color=TWIN_COLOUR, **CLOUD_STYLE | {"ms": 0.8})  # type: ignore[arg-type]
        ax.plot([], [], ".", color=SIDE_COLOURS[side], label=f"{side}, measured")
        deepest = max(deepest, float(depth.max()))
    if deepest:
        line = np.array([0.0, deepest])
        ax.plot(
            1e3 * line,
            p.bumper_stiffness_r * line,
            color=GUIDE_COLOUR,
            ls="--",
            lw=0.9,
            label="K_j u_j",
        )
        ax.plot([], [], ".", color=TWIN_COLOUR, label="law at the same samples")
        ax.legend(loc="upper left")
    else:
        ax.text(0.5, 0.5, "no contact was measured", ha="center", transform=ax.transAxes)
    ax.set(xlabel="depth in mm", ylabel="F_j in N", title="bumpers")


def _draw_onsets(result: IdentificationResult, residuals: LogResiduals, ax: Axes) -> None:
    log_gaps = [gaps for gaps in result.contact_gaps if gaps.log == residuals.log_number]
    for gaps in log_gaps:
        middle, width = gaps.value, max(5 * gaps.scatter, 1e-6)
        near = gaps.gaps[np.abs(gaps.gaps - middle) < width]
        is_onset = gaps.kind == "onset"
        ax.hist(
            1e3 * near, 30, histtype="stepfilled" if is_onset else "step",
            color=SIDE_COLOURS[gaps.side],
            alpha=0.45 if is_onset else 1.0, label=f"{gaps.side} {gaps.kind}s, {gaps.gaps.size}",
        )  # fmt: skip
    for side in ("right", "left"):
        gap = 1e3 * fitted_gap(residuals, result.fit, side)
        if np.isfinite(gap) and log_gaps:
            ax.axvline(gap, color=SIDE_COLOURS[side], ls="--" if side == "left" else "-", lw=1.2)
    if log_gaps:
        ax.legend(loc="upper left", fontsize=7)
    else:
        ax.text(0.5, 0.5, "no onset was measured", ha="center", transform=ax.transAxes)
    ax.set(xlabel="gap of a side in mm", ylabel="contacts", title="onsets and releases; lines: fit")


def _draw_correlation(result: IdentificationResult) -> Figure:
    kept = [k for k, parameter in enumerate(result.fit.free) if not is_correction(parameter.key)]
    names = [result.fit.free[k].name for k in kept]
    matrix = result.fit.correlation[np.ix_(kept, kept)]
    figure = Figure(figsize=(FIGURE_WIDTH_IN, 0.5 * len(kept) + 1.2))
    ax = figure.subplots()
    ax.imshow(matrix, cmap="RdBu_r", vmin=-1, vmax=1)
    ax.grid(False)
    ax.set_xticks(range(len(kept)), names, rotation=45, ha="right")
    ax.set_yticks(range(len(kept)), names)
    for (i, k), value in np.ndenumerate(matrix):
        ax.text(k, i, f"{value:+.2f}", ha="center", va="center", fontsize=7,
                color="white" if abs(value) > 0.6 else TWIN_COLOUR)  # fmt: skip
    return figure


def _draw_subsets(result: IdentificationResult) -> Figure:
    """Draw each parameter from each subset with its 95 % interval; the band is the joint fit."""
    free = [
        parameter
        for parameter in result.fit.free
        if any(parameter.key in p.values for p in result.subsets)
    ]
    figure = Figure(figsize=(FIGURE_WIDTH_IN, 0.28 * len(result.subsets) + 1.6))
    axes = figure.subplots(1, len(free), sharey=True, squeeze=False)[0]
    for ax, parameter in zip(axes, free, strict=True):
        scale = 1e3 if parameter.unit == "m" else 1.0
        value, sd = result.fit.values[parameter.key], result.fit.interval_error(parameter.key)
        if np.isfinite(sd):
            ax.axvspan(
                scale * (value - INTERVAL_SIGMA * sd),
                scale * (value + INTERVAL_SIGMA * sd),
                color="#d4d4d4",
                lw=0,
            )
        ax.axvline(scale * value, color=GUIDE_COLOUR, lw=0.9)
        for row, part in enumerate(result.subsets):
            if parameter.key in part.values:
                x, sx = part.values[parameter.key]
                ax.errorbar(
                    scale * x,
                    row,
                    xerr=scale * INTERVAL_SIGMA * sx if np.isfinite(sx) else None,
                    fmt="o",
                    color=TWIN_COLOUR,
                    ms=3,
                    lw=1,
                )
        ax.set_title(
            f"{parameter.name}\nin {'mm' if parameter.unit == 'm' else parameter.unit}", fontsize=8
        )
        ax.tick_params(axis="x", labelrotation=45, labelsize=7)
    axes[0].set_yticks(range(len(result.subsets)), [part.source for part in result.subsets])
    axes[0].invert_yaxis()
    return figure
