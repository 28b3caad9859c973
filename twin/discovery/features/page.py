"""HTML report of a search by features and its figures; the numbers are those of features.json."""

import math
from collections.abc import Iterator
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from twin.discovery.features.config import Feature
from twin.discovery.features.curve import ResponseCurve
from twin.discovery.features.fit import FeatureFit
from twin.discovery.features.search import FeatureDiscovery, describe_effects
from twin.discovery.features.task import FeatureModel
from twin.discovery.result import FeatureVerdict, label_feature, name_fit
from twin.discovery.words import format_interval, name_effect
from twin.drawing.page import embed_images, write_page
from twin.drawing.panels import CaptionedFigure, Picture
from twin.drawing.pictures import save_figures
from twin.laws.library import find_effect
from twin.laws.typesetting import typeset_law

MAX_SHOWN_DISTANCE = 4.0  # in tolerances: what is farther off is drawn at the edge
ROW_HEIGHT_IN, MARGIN_IN = 0.235, 1.0
PANEL_COLUMNS, PANEL_HEIGHT_IN = 3, 2.35
RANGE_MARGIN_SHARE = 0.25  # of the frequencies of peaks and features, on either side
# Distinct on a light and on a dark ground: model as given, refitted base, best.
FIT_COLOURS = ("#8c8c8c", "#c0802a", "#3b82c4")
PUBLISHED_COLOUR = "#2b9a4f"
FIT_MARKERS = ("o", "D", "o")
HEADLINES = {
    "none needed": "No effect is needed: other parameters explain as much.",
    "named": "The model lacks {names}.",
    "ambiguous": "The features do not determine what is missing; {names} explains the most.",
}


def write_features_page(folder: Path, result: FeatureModel) -> Path:
    """Write folder/report.html and its figures to folder/figures; return the path of the page."""
    content, discovery = result.verdict, result.discovery
    pairs = _draw_pairs(discovery, content, folder / "figures")
    light, dark = (embed_images(pair[side] for pair in pairs) for side in (0, 1))
    best = content.best_fit
    return write_page(
        folder,
        Path(__file__).with_name("page.html"),
        content=content,
        headline=format_features_headline(content),
        best=best or content.refitted,
        name=name_fit,
        label=label_feature,
        quantity=format_interval,
        laws=[(typeset_law(find_effect(id).term), find_effect(id).residual) for id in content.best],
        terms=describe_effects,
        pictures=list(zip(light, dark, strict=True)),
        model=result.model_toml,
    )


def format_features_headline(content: FeatureVerdict) -> str:
    """Return the result of a search by features as one sentence."""
    names = " and ".join(name_effect(effect) for effect in content.best)
    return HEADLINES[content.verdict].format(names=names)


def _draw_pairs(
    discovery: FeatureDiscovery, content: FeatureVerdict, folder: Path
) -> list[tuple[Picture, Picture]]:
    """Draw the figures in `folder`; return pairs on a light and on a dark ground."""
    light = save_figures(_draw_figures(discovery, content), folder)
    dark = save_figures(_draw_figures(discovery, content), folder / "dark", dark=True)
    return list(zip(light, dark, strict=True))


def _draw_figures(
    discovery: FeatureDiscovery, content: FeatureVerdict
) -> Iterator[CaptionedFigure]:
    yield _draw_distances(discovery, content)
    yield _draw_curves(discovery)


def list_shown_fits(discovery: FeatureDiscovery) -> list[tuple[str, FeatureFit]]:
    """Return (label, fit) of the model as given, the refitted base and the best model."""
    base = discovery.base
    fits = [("model as given", base.given), ("base refitted", base.refitted)]
    if discovery.best.names:
        fits.append((f"with {name_fit(discovery.best.names)}", discovery.best))
    return fits


def _draw_distances(discovery: FeatureDiscovery, content: FeatureVerdict) -> CaptionedFigure:
    features, fits = content.features, list_shown_fits(discovery)
    figure = Figure(figsize=(10.0, MARGIN_IN + ROW_HEIGHT_IN * len(features)))
    axis = figure.subplots()
    rows = np.arange(len(features))
    axis.axvspan(0, 1, color=PUBLISHED_COLOUR, alpha=0.16, lw=0)
    axis.axvline(1, color=PUBLISHED_COLOUR, lw=1)
    shown = [
        [min(feature.distance, MAX_SHOWN_DISTANCE) for feature in fit.predicted] for _, fit in fits
    ]
    axis.plot([shown[0], shown[-1]], [rows, rows], color=FIT_COLOURS[0], lw=0.7, alpha=0.7)
    for (_, fit), x, colour, marker, size in zip(
        fits, shown, FIT_COLOURS, FIT_MARKERS, (6.5, 4.5, 7.0), strict=False
    ):
        is_hollow = fit is fits[0][1]
        axis.plot(
            x, rows, marker, ms=size, color=colour, mfc="none" if is_hollow else colour,
            clip_on=False, zorder=3,
        )  # fmt: skip
    axis.set_yticks(rows, [label_feature(entry) for entry in features], fontsize=8)
    axis.set_ylim(len(features) - 0.4, -0.6)
    axis.set_xlim(0, MAX_SHOWN_DISTANCE)
    ticks = np.arange(0, MAX_SHOWN_DISTANCE + 0.5)
    axis.set_xticks(ticks, [*(f"{t:g}" for t in ticks[:-1]), f"{ticks[-1]:g} or more"])
    axis.set_xlabel("distance from the published feature, in tolerances")
    axis.grid(axis="y", lw=0.3)
    handles = [
        Line2D([], [], ls="", marker=marker, color=colour,
               mfc="none" if number == 0 else colour, label=f"{label}: {fit.score} explained")
        for number, ((label, fit), colour, marker) in enumerate(
            zip(fits, FIT_COLOURS, FIT_MARKERS, strict=False)
        )
    ]  # fmt: skip
    figure.legend(handles=handles, loc="outside upper center", ncols=3)
    return CaptionedFigure(
        "features",
        "Published features, before and after",
        "A model explains the features in the green band: within their tolerance. What is beyond "
        f"{MAX_SHOWN_DISTANCE:g} tolerances, or absent, is drawn at the edge. 0: on the published "
        "value or within the published limits.",
        figure,
    )


def _draw_curves(discovery: FeatureDiscovery) -> CaptionedFigure:
    features = discovery.problem.features
    fits = list_shown_fits(discovery)
    rows = math.ceil(len(features.gaps_mm) / PANEL_COLUMNS)
    figure = Figure(figsize=(10.0, 0.5 + PANEL_HEIGHT_IN * rows))
    axes = np.ravel(figure.subplots(rows, PANEL_COLUMNS, squeeze=False))
    for axis, gap_mm in zip(axes, features.gaps_mm, strict=False):
        axis.set_title("G∞" if math.isinf(gap_mm) else f"G{gap_mm:g}".replace("-", "−"))
        curves = [
            (fit.curves[gap_mm], colour)
            for (_, fit), colour in zip(fits, FIT_COLOURS, strict=False)
        ]
        own = [feature for feature in features.features if feature.gap_mm == gap_mm]
        _set_range(axis, [curve for curve, _ in curves if curve], own)
        for feature in own:
            _mark_feature(axis, feature)
        for curve, colour in curves:
            if curve is not None:
                _draw_curve(axis, curve, colour)
        axis.set_ylim(bottom=0)
    for axis in axes[len(features.gaps_mm) :]:
        axis.set_visible(False)
    for axis in axes[-PANEL_COLUMNS:]:
        axis.set_xlabel("frequency [Hz]")
    for axis in axes[::PANEL_COLUMNS]:
        axis.set_ylabel("half swing of u [mm]")
    handles = [
        Line2D([], [], color=colour, label=label)
        for (label, _), colour in zip(fits, FIT_COLOURS, strict=False)
    ]
    handles.append(Line2D([], [], color=PUBLISHED_COLOUR, lw=5, alpha=0.35, label="published"))
    figure.legend(handles=handles, loc="outside upper center", ncols=4)
    return CaptionedFigure(
        "curves",
        "Response curves of each model, and what is published of them",
        "Along the primary resonance, dotted where no sweep can stay. Green: published frequencies "
        "of peaks and jumps and amplitudes with their tolerances, at the bottom where only a limit "
        "is published; dashed: frequencies inside a hysteresis. " + describe_methods(discovery),
        figure,
    )


def describe_methods(discovery: FeatureDiscovery) -> str:
    """Return by which methods the curves of the shown models were computed."""
    methods = sorted({
        curve.method for _, fit in list_shown_fits(discovery)
        for curve in fit.curves.values() if curve is not None
    })  # fmt: skip
    return f"Curves: {' and '.join(methods)}."


def _set_range(axis: Axes, curves: list[ResponseCurve], features: list[Feature]) -> None:
    """Limit a panel to the peaks, the hystereses and the published frequencies."""
    marks = [curve.find_peak()[0] for curve in curves]
    for curve in curves:
        middle, width = curve.measure_hysteresis()
        marks += [middle - width / 2, middle + width / 2]
    for feature in features:
        marks += [hz for hz in (feature.value_hz, *feature.inside_hz) if hz]
    marks = [mark for mark in marks if math.isfinite(mark)]
    if marks:
        axis.set_xlim(min(marks) * (1 - RANGE_MARGIN_SHARE), max(marks) * (1 + RANGE_MARGIN_SHARE))


def _mark_feature(axis: Axes, feature: Feature) -> None:
    if feature.kind in ("peak_frequency", "jump_up_frequency", "jump_down_frequency"):
        low, high = feature.limits
        tolerance = feature.tolerance
        edges = axis.get_xlim()
        axis.axvspan(
            max(low - tolerance, edges[0]), min(high + tolerance, edges[1]),
            color=PUBLISHED_COLOUR, alpha=0.22, lw=0,
            ymax=1.0 if low == high else 0.06,
        )  # fmt: skip
    for hz in feature.inside_hz:
        axis.axvline(hz, color=PUBLISHED_COLOUR, ls=(0, (4, 2)), lw=1.2)
    if feature.kind == "peak_displacement" and feature.value_mm is not None:
        axis.axhspan(
            feature.value_mm - feature.tolerance, feature.value_mm + feature.tolerance,
            color=PUBLISHED_COLOUR, alpha=0.13, lw=0,
        )  # fmt: skip
    if feature.kind == "displacement" and feature.at_hz is not None:
        low, high = feature.limits
        value = low if math.isfinite(low) else high
        axis.plot(feature.at_hz, value, "^", ms=5, color=PUBLISHED_COLOUR, zorder=4)


def _draw_curve(axis: Axes, curve: ResponseCurve, colour: str) -> None:
    x, y = curve.frequency_hz, 1e3 * curve.amplitude_m
    low, high = axis.get_xlim()
    inside = (x >= low - 1) & (x <= high + 1)
    stable = np.where(curve.stable & inside, y, np.nan)
    unstable = ~curve.stable
    unstable[:-1] |= ~curve.stable[1:]
    unstable[1:] |= ~curve.stable[:-1]
    axis.plot(x, np.where(unstable & inside, y, np.nan), color=colour, ls=(0, (1, 1.4)), lw=1.0)
    axis.plot(x, stable, color=colour, lw=mpl.rcParams["lines.linewidth"] * 1.3)
    axis.set_xlim(low, high)
