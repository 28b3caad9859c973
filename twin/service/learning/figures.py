"""Pictures of a discovery: where it disagrees, what was tried, when; `draw_all` draws all of them.

The close-ups of forces stand in `figures_forces`, the twin before and after in `figures_twin`.
"""

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from table_io.block import Float1D, Float2D
from table_io.records import Step
from twin.learn.general import GENERAL
from twin.learn.guess import ZERO
from twin.learn.naming import MINOR
from twin.learn.sheet import FORCES, Sheet
from twin.learn.where import Cell
from twin.service.close_ups import COLOUR, GUIDE, WIDTH, Drawn
from twin.service.figures import STYLE, Picture
from twin.service.learning.figures_evidence import Shown, phases_of, repeats
from twin.service.learning.figures_forces import forces, histories
from twin.service.learning.figures_twin import curves
from twin.service.learning.running_free import Runs
from twin.service.learning.told import Json

MOST_LOGS, MOST_BARS, MOST_TICKS = 6, 24, 24
ROOMY = 0.3  # of the longest bar: one that is longer has its note inside
LEAST_EXCESS = 0.1  # of the noise: where the colours begin
LEAST_TOP = 10.0  # where they end at least: what is but noise stays pale
SIGNIFICANT = 3.0  # standard errors: a cell with more is marked
SHORT = {
    "flight": "flight", "contact_right": "right", "contact_left": "left", "contact_both": "both",
}  # fmt: skip
BEFORE, AFTER, BEST, OUTSIDE = "#8b929c", "#1a7f37", "#1a7f37", "#d98a1f"


def draw_all(
    shown: Shown, told: Json, runs: dict[int, Runs], folder: Path
) -> dict[str, list[Picture]]:
    """Section of the page -> its pictures, as PNG files in `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    with mpl.rc_context(STYLE):
        drawn = {
            "where": _maps(shown), "candidates": _candidates(told), "forces": forces(shown),
            "histories": histories(shown), "twin": curves(shown, runs, chosen_logs(shown)),
            "time": _time(shown),
        }  # fmt: skip
        return {
            section: [_saved(folder, *one) for one in pictures]
            for section, pictures in drawn.items()
        }


def _saved(folder: Path, name: str, title: str, caption: str, figure: Figure) -> Picture:
    figure.savefig(folder / f"{name}.png")
    return Picture(folder / f"{name}.png", title, caption)


def chosen_logs(shown: Shown) -> list[int]:
    """The logs that are drawn, the worst of them where there are many."""
    squares = [float(one @ one) / max(one.size, 1) for one in shown.pair[0].left]
    return sorted(np.argsort(squares)[::-1][:MOST_LOGS].tolist())


def _maps(shown: Shown) -> Drawn:
    """The map before and after, a picture a log."""
    for number in chosen_logs(shown):
        sheet, steps = shown.sheets[number], shown.steps(number)
        mine = [
            [one for one in cells if one.log == number]
            for cells in (shown.found.map_before, shown.found.map_after)
        ]
        if steps and mine[0]:
            figure = _map(sheet, steps, mine)
            caption = (
                "Mean square of measured minus model over that of the noise, less the floor, on "
                "what was held out. Steps in the order in which they were driven: red forward, "
                "blue backward. A dot marks what chance does not explain (more than "
                f"{SIGNIFICANT:g} standard errors). Hatched: the measured motion does not repeat "
                "from period to period (chaos, or a passage); forces along it still compare."
            )
            yield f"map_{number}", f"Disagreement{shown.of_log(number)}", caption, figure


def _map(sheet: Sheet, steps: Sequence[Step], maps: list[list[Cell]]) -> Figure:
    """Panels: a row of the residual each, before left, after right."""
    present = {one.row for one in maps[0]}
    rows = {name: phases_of(sheet, k) for k, name in enumerate(sheet.rows) if name in present}
    heights = [len(phases) + 0.4 for phases in rows.values()]
    figure = Figure(figsize=(WIDTH, 0.21 * sum(heights) + 0.22 * len(rows) + 1.3))
    axes = figure.subplots(len(rows), 2, sharey="row", squeeze=False, height_ratios=heights)
    top = max([one.excess for cells in maps for one in cells] + [LEAST_TOP])
    norm = LogNorm(LEAST_EXCESS, top, clip=True)
    image = None
    for column, cells in enumerate(maps):
        for ax, (name, phases) in zip(axes[:, column], rows.items(), strict=True):
            excess, errors = _table([one for one in cells if one.row == name], steps, phases)
            shaded = np.where(np.isnan(excess), np.nan, np.maximum(excess, LEAST_EXCESS))
            image = ax.imshow(
                shaded, norm=norm, cmap="YlOrRd", aspect="auto", interpolation="nearest"
            )
            y, x = np.nonzero((errors > SIGNIFICANT) & (excess > 0))
            ax.plot(x, y, "o", color="#111111", ms=1.8)
            _map_axes(ax, sheet, steps, phases)
        axes[0, column].set_title(("before: the model alone", "after")[column], pad=14)
        _map_names(axes[:, column].tolist(), list(rows))
        _map_steps(axes[-1, column], steps)
    if image is not None:
        bar = figure.colorbar(image, ax=axes, fraction=0.025, pad=0.015)
        bar.set_label("excess over the noise")
    return figure


def _map_names(axes: Sequence[Axes], names: list[str]) -> None:
    for ax, name in zip(axes, names, strict=True):
        text = {"right": "right bumper", "left": "left bumper"}.get(name, name)
        if name not in FORCES:
            text = f"{text}: sensors against each other"
        ax.annotate(
            text, (0, 1), (0, 2), xycoords="axes fraction", textcoords="offset points", size=8,
            color=GUIDE,
        )  # fmt: skip


def _table(cells: list[Cell], steps: Sequence[Step], phases: list[str]) -> tuple[Float2D, Float2D]:
    """(excess, standard errors) of a row's cells, (phase, step); NaN where there is none."""
    place = {one.index: k for k, one in enumerate(steps)}
    excess = np.full((len(phases), len(steps)), np.nan)
    errors = np.full(excess.shape, np.nan)
    for one in cells:
        if one.step in place:
            at = phases.index(one.phase), place[one.step]
            excess[at], errors[at] = one.excess, one.errors
    return excess, errors


def _map_axes(ax: Axes, sheet: Sheet, steps: Sequence[Step], phases: list[str]) -> None:
    ax.grid(visible=False)
    ax.set_facecolor("#f3f4f6")
    ax.set_yticks(range(len(phases)), [SHORT[one] for one in phases], size=7.5)
    ax.set_xticks([])
    ax.tick_params(length=0)
    for k, one in enumerate(steps):
        if k and one.direction != steps[k - 1].direction:
            ax.axvline(k - 0.5, color=GUIDE, lw=0.8)
        if not repeats(sheet, one):
            ax.axvspan(k - 0.5, k + 0.5, fc="none", ec="#00000038", hatch="////", lw=0)


def _map_steps(ax: Axes, steps: Sequence[Step]) -> None:
    """The frequencies under the lowest panel, in the colour of their direction."""
    places = range(0, len(steps), -(-len(steps) // MOST_TICKS))
    ax.set_xticks(places, [f"{steps[k].frequency_hz:.3g}" for k in places], size=7, rotation=90)
    for label, k in zip(ax.get_xticklabels(), places, strict=True):
        label.set_color(COLOUR[steps[k].direction])
    ax.set_xlabel("step, frequency in Hz")


def _candidates(told: Json) -> Drawn:
    """Held-out error of every set that was tried, the best first."""
    every = told["candidates"]
    null = next(one for one in every if one["id"] == "nothing added")
    sets = every[:MOST_BARS]
    if null not in sets:
        sets = [*sets[:-1], null]
    added = {".".join(filter(None, (e["id"], e.get("channel")))) for e in told["effects"]}
    floor, best = told["gap"]["noise_floor"], sets[0]["held_out_error"]
    figure = Figure(figsize=(WIDTH, 0.23 * len(sets) + 1.2))
    ax = figure.subplots()
    far = sets[-1]["held_out_error"] > 8 * min(best, floor)
    for y, one in enumerate(sets):
        ax.barh(y, one["held_out_error"], color=_bar(one, null, added), height=0.68)
        inside = bool(_doubts(one)) and one["held_out_error"] > ROOMY * sets[-1]["held_out_error"]
        ax.annotate(
            f"{one['held_out_error']:.3g}{_doubts(one)}", (one["held_out_error"], y),
            (-4 if inside else 4, 0), textcoords="offset points", va="center", size=7.5,
            ha="right" if inside else "left", color="#111111" if inside else GUIDE,
        )  # fmt: skip
    ax.set_yticks(range(len(sets)), [one["id"].replace(f"{GENERAL}.", "") for one in sets], size=8)
    ax.set_ylim(len(sets) - 0.4, -0.6)
    if far:
        ax.set_xscale("log")
        ax.xaxis.set_major_formatter("{x:g}")
        ax.set_xlim(0.7 * min(best, floor), 2 * sets[-1]["held_out_error"])
    else:
        ax.set_xlim(0, 1.15 * max(sets[-1]["held_out_error"], floor))
    ax.axvline(floor, color="#111111", ls="--", lw=1)
    ax.grid(visible=False, axis="y")
    ax.set_xlabel("rms of measured minus model over the noise, held out")
    kinds = {"nothing added": BEFORE, "what was taken": BEST, "named, tried": "#9db7d5",
             "with a term that has no name": OUTSIDE}  # fmt: skip
    drawn = {_bar(one, null, added) for one in sets}
    handles = [Patch(color=c, label=text) for text, c in kinds.items() if c in drawn]
    handles_ = [*handles, Line2D([], [], color="#111111", ls="--", label="noise floor")]
    figure.legend(handles=handles_, loc="outside upper center", ncols=5)
    more = len(every) - len(sets)
    caption = (
        "Every set was fitted on two thirds of the steps and judged on the third that was left "
        "out, in turn, together with the model's own parameters. A further effect is taken only "
        f"where it closes {100 * MINOR:g} % of the first gap at least, and more than chance does."
    )
    caption += f" {more} worse sets are not drawn." if more > 0 else ""
    yield "candidates", "What was tried", caption, figure


def _doubts(one: Json) -> str:
    """What speaks against a fit; that a tare is at the end of its doubt does not."""
    stuck = [name for name in one.get("at_bound", ()) if not name.startswith(ZERO)]
    found = "" if one["converged"] else ", not converged"
    return f"{found}, {stuck[0].removeprefix(f'{GENERAL}.')} at its bound" if stuck else found


def _bar(one: Json, null: Json, added: set[str]) -> str:
    if one is null:
        return BEFORE
    if GENERAL in one["id"]:
        return OUTSIDE
    return BEST if set(one["id"].split(" + ")) == added else "#9db7d5"


def _time(shown: Shown) -> Drawn:
    """Mean square of each block over the test, before and after: a drift shows here."""
    for number in chosen_logs(shown):
        sheet = shown.sheets[number]
        rows = {"damper": [0], "bumpers": [1, 2]}
        rows = {k: v for k, v in rows.items() if np.isin(sheet.row_of, v).any()}
        figure = Figure(figsize=(WIDTH, 1.8 * len(rows) + 0.6))
        axes = figure.subplots(len(rows), 1, sharex=True, squeeze=False)[:, 0]
        for one, colour in zip(shown.pair, (BEFORE, AFTER), strict=True):
            for ax, mine in zip(axes, rows.values(), strict=True):
                t, squares = _blocks(sheet, one.left[number], mine)
                look = {"ms": 4.5, "mfc": "none"} if colour == BEFORE else {"ms": 2.6}
                ax.semilogy(t, squares, "o", color=colour, **look)
                ax.yaxis.set_major_formatter("{x:g}")
                ax.yaxis.set_minor_formatter("")
        for ax, name in zip(axes, rows, strict=True):
            floor, (low, high) = shown.found.verdict.floor, ax.get_ylim()
            ax.axhline(floor, color="#111111", ls="--", lw=0.9)
            ax.set_ylim(min(low, 0.08 * floor), max(high, 12 * floor))
            ax.set_ylabel(name)
        axes[-1].set_xlabel("time in s")
        handles = [
            Line2D([], [], color=BEFORE, marker="o", mfc="none", ls="", label="before"),
            Line2D([], [], color=AFTER, marker="o", ls="", label="after"),
            Line2D([], [], color="#111111", ls="--", label="noise floor"),
        ]
        figure.legend(handles=handles, loc="outside upper center", ncols=3)
        caption = (
            "Mean square of measured minus model over that of the noise, held out, one point a "
            "forcing cycle (a second where nothing is held). What grows or falls along the test "
            "is a drift; what follows the steps is not."
        )
        title = f"Over the test{shown.of_log(number)}"
        yield f"time_{number}", title, caption, figure


def _blocks(sheet: Sheet, left: Float1D, rows: list[int]) -> tuple[Float1D, Float1D]:
    """(middle in s, mean square over the noise) of every block with entries in these rows."""
    mine = np.isin(sheet.row_of, rows)
    blocks = np.unique(sheet.block_of[mine], return_inverse=True)[1]
    count = np.bincount(blocks)
    t = np.bincount(blocks, weights=sheet.readings.time_s[sheet.sample_of[mine]]) / count
    return t, np.bincount(blocks, weights=left[mine] ** 2) / count
