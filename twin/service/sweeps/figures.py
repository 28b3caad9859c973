"""Pictures of a batch: the PRC family of each model over its gaps, the models beside each other at
a gap, and what resonance and hysteresis do over the gap."""

import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize, to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from table_io.block import Float1D
from twin.service.close_ups import DASH, GUIDE
from twin.service.figures import STYLE, Picture
from twin.service.summary import Json
from twin.service.sweeps import over_gap
from twin.service.sweeps.cases import gap_name
from twin.service.sweeps.rows import Row

Curves = dict[str, list[Row]]  # direction -> rows, upwards in frequency
Cases = dict[tuple[str, float], Curves]  # (model, gap in mm) -> curves
Panels = list[tuple[Axes, dict[str, int]]]  # what each shows: column -> sign
Drawn = Iterator[tuple[str, str, str, Figure]]  # name of the file, title, caption

PANELS = (
    (r"$\eta_d$, relative displacement", {"eta_d": 1}),
    (r"$\eta_a$, total acceleration", {"eta_a": 1}),
    (r"$\eta_j$, bumper deformation", {"eta_r": 1, "eta_l": -1}),
    (r"$r_j$, contact force over weight", {"r_r": 1, "r_l": -1}),
)
FREE = "#2e9e5b"
MODELS = ("#1559b0", "#c4161c", "#e08a00", "#7a3b9b", "#111111", "#3aa6b9", "#8c564b", "#7f7f7f")
# Dark for small gaps, and without the yellow that no line on white can be seen in.
SHADES = ListedColormap(mpl.colormaps["plasma"](np.linspace(0.0, 0.85, 256)))
NAMED = 9  # gaps that a key names; more are read off a scale
IN_LINE = 8  # names in a line of a key
MOST = 12  # pictures of a kind
HOW = (
    "Solid: forward; dashed: backward. Displacement, deformation and acceleration are divided by "
    "the model's free-flight maxima u*, a*; forces by the weight."
)


def draw_all(rows: Sequence[Row], summary: Json, folder: Path) -> list[Picture]:
    """The pictures of a batch as PNG files in `folder`, in the order of the page."""
    folder.mkdir(parents=True, exist_ok=True)
    pictures: list[Picture] = []
    with mpl.rc_context(STYLE):
        for name, title, caption, figure in _drawn(_cases(rows), summary["cases"]):
            path = folder / f"{_new(name, {one.path.stem for one in pictures})}.png"
            figure.savefig(path)
            pictures.append(Picture(path, title, caption))
    return pictures


def _cases(rows: Sequence[Row]) -> Cases:
    found: Cases = {}
    for row in rows:
        case = str(row["model"]), float(row["gap_mm"])
        found.setdefault(case, {}).setdefault(str(row["direction"]), []).append(row)
    for curves in found.values():
        for one in curves.values():
            one.sort(key=lambda row: float(row["frequency_hz"]))
    return found


def _new(name: str, taken: set[str]) -> str:
    """The name without what a file's must not have, and not one that is taken."""
    plain = re.sub(r"[^\w.-]+", "_", name)
    return f"{plain}_{len(taken)}" if plain in taken else plain


def _drawn(cases: Cases, told: list[Json]) -> Drawn:
    labels = list(dict.fromkeys(label for label, _ in cases))
    gaps = list(dict.fromkeys(gap for _, gap in cases))
    for label in labels[:MOST]:
        own = {gap: curves for (model, gap), curves in cases.items() if model == label}
        if len(own) > 1 or len(labels) == 1:
            yield _family(label, own)
        yield from over_gap.draw(label, [one for one in told if one["model"] == label])
    if len(labels) > 1:
        for gap in _spread(gaps):
            own_models = {model: curves for (model, at), curves in cases.items() if at == gap}
            yield _models(gap, own_models)


def _spread(gaps: list[float]) -> list[float]:
    """At most `MOST` of the gaps, first and last among them."""
    if len(gaps) <= MOST:
        return gaps
    return [gaps[round(place)] for place in np.linspace(0, len(gaps) - 1, MOST)]


def _frame(bumpers: bool) -> tuple[Figure, Panels]:
    panels = PANELS if bumpers else PANELS[:2]
    figure = Figure(figsize=(11, 7.8 if bumpers else 4.4))
    axes = figure.subplots(len(panels) // 2, 2, sharex=True, squeeze=False)
    for ax, (label, names) in zip(axes.flat, panels, strict=True):
        ax.set_ylabel(label)
        if len(names) == 2:
            ax.axhline(0, color="#333333", lw=0.7)
            ax.yaxis.set_major_formatter(lambda value, _: f"{abs(value):g}")
            for y, va, text in ((0.98, "top", "right"), (0.02, "bottom", "left")):
                ax.text(0.99, y, text, transform=ax.transAxes, ha="right", va=va, color=GUIDE)
    for ax in axes[-1]:
        ax.set_xlabel("frequency in Hz")
    return figure, [(ax, names) for ax, (_, names) in zip(axes.flat, panels, strict=True)]


def _touched(curves: Curves) -> bool:
    return any(row["eta_r"] or row["eta_l"] for rows in curves.values() for row in rows)


def _lines(axes: Panels, curves: Curves, look: dict[str, Any]) -> None:
    for ax, names in axes:
        if len(names) == 2 and not _touched(curves):
            continue
        for name, sign in names.items():
            for direction, rows in curves.items():
                f, y = (_column(rows, one) for one in ("frequency_hz", name))
                marker = "o" if f.size == 1 else ""
                ax.plot(f, sign * y, ls=DASH[direction], marker=marker, **look)


def _column(rows: list[Row], name: str) -> Float1D:
    return np.array([row[name] for row in rows], dtype=np.float64)


def _directions(curves: Curves) -> list[Line2D]:
    return [Line2D([], [], color=GUIDE, ls=DASH[one], label=one) for one in curves]


def _family(label: str, own: dict[float, Curves]) -> tuple[str, str, str, Figure]:
    figure, axes = _frame(any(map(_touched, own.values())))
    finite = sorted(gap for gap in own if math.isfinite(gap))
    few = len(finite) <= NAMED
    scale = Normalize(finite[0], finite[-1]) if finite else Normalize()
    keys = []
    for gap in sorted(own, reverse=True):
        colour = FREE
        if math.isfinite(gap):  # a few are told apart by their order, many are read off a scale
            share = finite.index(gap) / max(len(finite) - 1, 1) if few else float(scale(gap))
            colour = to_hex(tuple(np.ravel(SHADES(share)).tolist()))
        _lines(axes, own[gap], {"color": colour, "lw": 1.3 if few else 0.9})
        if few or math.isinf(gap):
            keys.append(Line2D([], [], color=colour, lw=2, label=_shown(gap)))
    if not few:
        shades = ScalarMappable(scale, SHADES)
        figure.colorbar(shades, ax=[ax for ax, _ in axes], label="total gap in mm", pad=0.01)
    _finish(figure, axes, [*keys, *_directions(next(iter(own.values())))])
    what = _shown(max(own)) if len(own) == 1 else f"{len(own)} gaps"
    return f"prc_{label}", f"Pseudo-resonance curves of {label}, {what}", HOW, figure


def _shown(gap: float) -> str:
    return gap_name(gap).replace("-", "−")


def _finish(figure: Figure, axes: Panels, keys: list[Line2D]) -> None:
    """Scales that start at zero, once everything is drawn, and the key in even rows."""
    for ax, _ in axes[:2]:
        ax.set_ylim(bottom=0)
    lines = math.ceil(len(keys) / IN_LINE)
    columns = math.ceil(len(keys) / lines)
    figure.legend(handles=keys, loc="outside upper center", ncols=columns)


def _models(gap: float, own: dict[str, Curves]) -> tuple[str, str, str, Figure]:
    figure, axes = _frame(any(map(_touched, own.values())))
    keys = []
    for place, (label, curves) in enumerate(own.items()):
        colour = MODELS[place % len(MODELS)]
        _lines(axes, curves, {"color": colour, "lw": 1.3 if place < len(MODELS) else 0.7})
        keys.append(Line2D([], [], color=colour, lw=2, label=label))
    _finish(figure, axes, [*keys, *_directions(next(iter(own.values())))])
    name = "inf" if math.isinf(gap) else f"{gap:g}"
    return f"models_g{name}", f"{len(own)} models, {_shown(gap)}", HOW, figure
