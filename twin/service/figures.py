"""Pictures of a run, arranged and coloured as in Stefani, De Angelis, Andreaus, Figs. 2 to 12.

Measured: red forward, blue backward. Twin: black, solid forward, dashed backward. Histories,
portraits and loops show the frequencies that `report.chosen` picks: the middle of a hysteresis
interval, the largest excursion, the most impacts per cycle; at most four, both directions each.

Only this file knows matplotlib; it is imported when somebody wants pictures, not before.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from table_io.block import Block, Float1D
from table_io.channels import rel_disp
from twin.service.report import (
    DIRECTIONS,
    SIDES,
    Motion,
    Run,
    Summary,
    chosen,
    gather,
    motion,
    quantity,
    step_errors,
)
from twin.stream.mcap_log import Recording

COLOUR = {"forward": "#c4161c", "backward": "#1559b0"}
DASH: dict[str, Any] = {"forward": "-", "backward": (0, (4, 1.8))}
MARKER = {"forward": 4.6, "backward": 2.6}  # both show where they coincide
BAND = {"right": "#fff0a8", "left": "#b9f0f4"}
TWIN, GUIDE = "#111111", "#555555"
WIDTH, BINS, HISTORY_CYCLES, LABELLED_JUMPS = 10.0, 1600, 3, 4
STYLE: dict[Any, Any] = {
    "font.size": 9, "axes.titlesize": 9.5, "axes.titlelocation": "left", "axes.linewidth": 0.7,
    "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True,
    "grid.color": "#e4e4e4", "grid.linewidth": 0.6, "axes.axisbelow": True, "savefig.dpi": 150,
    "legend.frameon": False, "lines.linewidth": 1.1, "lines.markersize": 3.6,
    "figure.constrained_layout.use": True, "figure.constrained_layout.hspace": 0.06,
}  # fmt: skip
Drawn = Iterator[tuple[str, str, str, Figure]]


@dataclass(frozen=True, slots=True)
class Picture:
    """A PNG file, its title and the caption that belongs under it."""

    path: Path
    title: str
    caption: str


def draw_all(recording: Recording, summary: Summary, folder: Path) -> list[Picture]:
    """The pictures that this run can give, as PNG files in `folder`, in the order of the report."""
    folder.mkdir(parents=True, exist_ok=True)
    for stale in folder.glob("histories_*hz.png"):
        stale.unlink()
    run = gather(recording, summary)
    pictures = []
    with mpl.rc_context(STYLE):
        for draw in (_curves, _impacts, _histories, _cycles, _errors, _overview):
            for name, title, caption, figure in draw(run):
                figure.savefig(folder / f"{name}.png")
                pictures.append(Picture(folder / f"{name}.png", title, caption))
    return pictures


def _curve(run: Run, who: str, direction: str, name: str) -> tuple[Float1D, Float1D]:
    """(frequency in Hz, quantity) of one direction, upwards; NaN where there is none."""
    points = sorted(
        (step["frequency_hz"], quantity(step, who, name))
        for step in run.steps
        if step["direction"] == direction
    )
    table = np.array(points, dtype=np.float64).reshape(-1, 2)
    return table[:, 0], table[:, 1]


def _key(run: Run, figure: Figure, *more: Line2D | Patch, marker: str = "") -> None:
    """The legend above the panels: who is which line."""
    lines: list[Line2D | Patch] = []
    driven = [one for one in DIRECTIONS if any(step["direction"] == one for step in run.steps)]
    if run.who == "measured":
        lines += [
            Line2D([], [], color=COLOUR[one], marker=marker, label=f"measured {one}")
            for one in driven
        ]
    lines += [Line2D([], [], color=TWIN, ls=DASH[one], label=f"twin {one}") for one in driven]
    figure.legend(handles=[*lines, *more], loc="outside upper center", ncols=6)


def _mirrored(ax: Axes) -> None:
    """Right above the axis, left below it, both read as positive numbers."""
    ax.axhline(0, color="#333333", lw=0.7)
    ax.yaxis.set_major_formatter(lambda value, _: f"{abs(value):g}")
    for y, va, text in ((0.98, "top", "right"), (0.02, "bottom", "left")):
        ax.text(0.99, y, text, transform=ax.transAxes, ha="right", va=va, color=GUIDE)


def _curves(run: Run) -> Drawn:
    """Pseudo-resonance curves (Figs. 2 and 11)."""
    panels = [
        (r"$\eta_d$, relative displacement", {"eta_d": 1}),
        (r"$\eta_a$, total acceleration", {"eta_a": 1}),
    ]
    if run.bumpers:
        panels += [
            (r"$\eta_j$, bumper deformation", {"eta_r": 1, "eta_l": -1}),
            (r"$r_j$, contact force over weight", {"r_r": 1, "r_l": -1}),
        ]
    if not any(np.isfinite(_curve(run, run.who, one, "eta_d")[1]).any() for one in DIRECTIONS):
        return
    figure = Figure(figsize=(WIDTH, 3.6 * len(panels) / 2 + 0.3))
    axes = figure.subplots(len(panels) // 2, 2, sharex=True, squeeze=False)
    intervals = run.summary.get("hysteresis") or []
    for ax, (label, names) in zip(axes.flat, panels, strict=True):
        for one in intervals:
            ax.axvspan(one["from_hz"], one["to_hz"], color=BAND[one["kind"]], lw=0)
        for name, sign in names.items():
            _prc_lines(run, ax, name, sign)
            _jumps(run, ax, name, sign)
        ax.set_ylabel(label)
        if len(names) == 2:
            _mirrored(ax)
        else:
            ax.set_ylim(bottom=0)
    for ax in axes[-1]:
        ax.set_xlabel("frequency in Hz")
    kinds = sorted({one["kind"] for one in intervals})
    _key(
        run,
        figure,
        *(Patch(color=BAND[kind], label=f"{kind} hysteresis") for kind in kinds),
        marker="o",
    )
    caption = (
        "Per frequency step, on its steady cycles. Arrows mark jumps, between the two grid "
        "frequencies they lie between. Displacement, deformation and acceleration are divided by "
        "the free-flight maxima u*, a*; forces by the weight."
    )
    yield "prc", "Pseudo-resonance curves", caption, figure


def _prc_lines(run: Run, ax: Axes, name: str, sign: int) -> None:
    for one in DIRECTIONS:
        f, y = _curve(run, "measured", one, name)
        ax.plot(f, sign * y, "o-", color=COLOUR[one], ms=MARKER[one], lw=2.2)
    for one in DIRECTIONS:
        f, y = _curve(run, "twin", one, name)
        ax.plot(f, sign * y, color=TWIN, ls=DASH[one], lw=0.8, marker="." if f.size == 1 else "")


def _jumps(run: Run, ax: Axes, name: str, sign: int) -> None:
    jumps = run.summary.get("jumps") or []
    for number, jump in enumerate(jumps, 1):
        f, y = _curve(run, run.who, jump["direction"], name)
        ends = [y[np.isclose(f, jump[end])] for end in ("from_hz", "to_hz")]
        if not all(end.size and np.isfinite(end[0]) for end in ends):
            continue
        x, (start, stop) = (jump["from_hz"] + jump["to_hz"]) / 2, (sign * end[0] for end in ends)
        colour = COLOUR[jump["direction"]]
        style = {"arrowstyle": "-|>", "color": colour, "lw": 1.6, "shrinkA": 0, "shrinkB": 0}
        ax.annotate("", (x, stop), (x, start), arrowprops=style)
        if name == "eta_d":
            few = len(jumps) <= LABELLED_JUMPS
            low, high = sorted((jump["from_hz"], jump["to_hz"]))
            text = f"{low:g}–{high:g} Hz" if few else f"{number}"
            right = jump["to_hz"] >= jump["from_hz"] and x < f[0] + 0.85 * (f[-1] - f[0])
            ax.annotate(
                text, (x, (start + stop) / 2), (5 if right else -5, 0), color=colour, size=8,
                textcoords="offset points", ha="left" if right else "right", va="center",
                bbox={"facecolor": "white", "alpha": 0.85, "lw": 0, "pad": 1}, zorder=5,
            )  # fmt: skip


def _impacts(run: Run) -> Drawn:
    """Impacts per forcing cycle of both sides, one row a direction."""
    driven = [one for one in DIRECTIONS if _curve(run, run.who, one, SIDES[0])[0].size]
    found = [_curve(run, run.who, one, side)[1] for one in driven for side in SIDES]
    if not run.bumpers or not any(np.isfinite(one).any() for one in found):
        return
    figure = Figure(figsize=(WIDTH, 2.3 * len(driven) + 0.4))
    rows = figure.subplots(len(driven), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
    for ax, one in zip(rows, driven, strict=True):
        for side, sign in zip(SIDES, (1, -1), strict=True):
            f, y = _curve(run, "measured", one, side)
            ax.vlines(f, 0, sign * y, color=COLOUR[one], lw=3, alpha=0.35)
            ax.plot(f, sign * y, "o", color=COLOUR[one])
            f, y = _curve(run, "twin", one, side)
            ax.plot(f, sign * y, "o", ms=6.5, mfc="none", mec=TWIN, mew=0.8)
        ax.set_ylabel("impacts per cycle")
        ax.set_title(one)
        ax.yaxis.set_major_locator(MaxNLocator(integer=True))
        _mirrored(ax)
    rows[-1].set_xlabel("frequency in Hz")
    handles = [Line2D([], [], color=TWIN, marker="o", ms=6.5, mfc="none", ls="", label="twin")]
    if run.who == "measured":
        handles += [
            Line2D([], [], color=COLOUR[one], marker="o", label=f"measured {one}") for one in driven
        ]
    figure.legend(handles=handles, loc="outside upper center", ncols=3)
    caption = (
        "Mean over the steady cycles of a step; between whole numbers the count changes from cycle "
        "to cycle."
    )
    yield "impacts", "Impacts per forcing cycle", caption, figure


def _pairs(run: Run, hz: float) -> list[tuple[str, Motion | None, Motion | None]]:
    """(direction, measured, twin) of a frequency, for each direction that has cycles there."""
    pairs = []
    for step in run.steps:
        if step["frequency_hz"] == hz:
            both = motion(run, "meas", step["index"]), motion(run, "pred", step["index"])
            if any(one is not None and np.isfinite(one.u).any() for one in both):
                pairs.append((step["direction"], *both))
    return pairs


def _guides(run: Run, draw: Callable[..., Any]) -> None:
    """Dashed lines where the bumpers stand."""
    if run.gaps_m is not None:
        for place in {run.gaps_m[0] * 1e3, -run.gaps_m[1] * 1e3}:
            draw(place, color=GUIDE, ls=(0, (5, 3)), lw=0.8)


def _histories(run: Run) -> Drawn:
    """u, a and contact forces over the last cycles, a picture a frequency (Figs. 7 and 12)."""
    for hz, why in chosen(run).items():
        pairs = _pairs(run, hz)
        rows = 3 if run.bumpers else 2
        if not pairs:
            continue
        figure = Figure(figsize=(WIDTH, 1.75 * rows + 0.5))
        axes = figure.subplots(rows, len(pairs), sharex=True, sharey="row", squeeze=False)
        for column, (one, measured, twin) in zip(axes.T, pairs, strict=True):
            column[0].set_title(f"{one}, {hz:g} Hz")
            column[-1].set_xlabel("time in s")
            for data, look in ((measured, _rig(one)), (twin, _twin(one))):
                if data is not None:
                    _history(run, column, data.last(HISTORY_CYCLES), look)
            shown = measured if measured is not None else twin
            if shown is not None:
                _bands(run, column, shown.last(HISTORY_CYCLES), COLOUR[one])
            _guides(run, column[0].axhline)
        labels = ("$u$ in mm", "$a$ in m/s²", "$F_R$, $F_L$ in kN")
        for ax, label in zip(axes[:, 0], labels, strict=False):
            ax.set_ylabel(label)
        _key(run, figure, *_guide_key(run))
        caption = (
            "Last measured cycles. Shaded: contact, dark on the right, light on the left. "
            "The twin runs freely on the measured table acceleration; where the motion is chaotic "
            "it cannot follow sample by sample."
        )
        yield f"histories_{hz:g}hz", f"Histories at {hz:g} Hz: {why}", caption, figure


def _rig(direction: str) -> dict[str, Any]:
    """Wide, so that it shows beside a twin that lies on it."""
    return {"color": COLOUR[direction], "lw": 2.2}


def _twin(direction: str) -> dict[str, Any]:
    return {"color": TWIN, "ls": DASH[direction], "lw": 0.8}


def _guide_key(run: Run) -> list[Line2D | Patch]:
    if run.gaps_m is None:
        return []
    name = "bumper at rest" if min(run.gaps_m) >= 0 else "precompression"
    return [Line2D([], [], color=GUIDE, ls=(0, (5, 3)), lw=0.8, label=name)]


def _history(run: Run, column: Any, data: Motion, look: dict[str, Any]) -> None:
    column[0].plot(data.time, data.u * 1e3, **look)
    column[1].plot(data.time, data.a, **look)
    for force in (data.force_r, data.force_l) if run.bumpers else ():
        column[2].plot(data.time, force / 1e3, **look)


def _bands(run: Run, column: Any, data: Motion, colour: str) -> None:
    """Contact phases behind every row."""
    for touch, alpha in ((data.force_r, 0.22), (-data.force_l, 0.10)):
        for ax in column:
            ax.fill_between(
                data.time, 0, 1, where=touch > run.contact_n, transform=ax.get_xaxis_transform(),
                color=colour, alpha=alpha, lw=0,
            )  # fmt: skip


def _cycles(run: Run) -> Drawn:
    """Phase portraits, inertia force loops and bumper loops (Figs. 3, 6, 9 and 11)."""
    mass = run.specimen.mass_kg if run.specimen else None
    columns = {hz: pairs for hz in chosen(run) if (pairs := _pairs(run, hz))}

    def portrait(ax: Axes, data: Motion, look: dict[str, Any]) -> None:
        ax.plot(data.u * 1e3, data.v * 1e3, **look)

    def inertia(ax: Axes, data: Motion, look: dict[str, Any]) -> None:
        ax.plot(data.u * 1e3, -(mass or np.nan) * data.a / 1e3, **look)

    def bumper(ax: Axes, data: Motion, look: dict[str, Any]) -> None:
        for force in (data.force_r, data.force_l):
            touching = np.abs(force) > run.contact_n
            ax.plot(data.u * 1e3, np.where(touching, force, np.nan) / 1e3, **look)

    yield from _grid(
        run, columns, portrait, ("portraits", "Phase portraits", "$u$ in mm", "$u'$ in mm/s"),
        "Relative displacement and its rate over all measured cycles. The rig does not measure "
        "u'; here it is a Savitzky-Golay derivative of u over 20 ms, for this picture only.",
    )  # fmt: skip
    if mass is not None:
        yield from _grid(
            run, columns, inertia, ("loops", "Inertia force loops", "$u$ in mm", "$F_I$ in kN"),
            "Inertia force F_I = −M a against relative displacement.",
        )  # fmt: skip
    if run.bumpers:
        yield from _grid(
            run, columns, bumper, ("bumpers", "Bumper loops", "$v_j$ in mm", "$F_j$ in kN"),
            "Contact force against bumper position, right positive, left negative. In contact the "
            "bumper stands where the mass does, v_j = u; flight is left out.",
        )  # fmt: skip


def _grid(
    run: Run,
    columns: dict[float, list[tuple[str, Motion | None, Motion | None]]],
    draw: Callable[[Axes, Motion, dict[str, Any]], None],
    names: tuple[str, str, str, str],
    caption: str,
) -> Drawn:
    """One picture: a column a frequency, a row a direction."""
    driven = [one for one in DIRECTIONS if any(one == p[0] for c in columns.values() for p in c)]
    if not driven:
        return
    figure = Figure(figsize=(WIDTH, 2.5 * len(driven) + 0.6))
    axes = figure.subplots(len(driven), max(len(columns), 3), sharex="col", squeeze=False)
    for ax in axes[:, len(columns) :].flat:
        ax.remove()
    for column, (hz, pairs) in zip(axes.T, columns.items(), strict=False):
        for one, measured, twin in pairs:
            ax = column[driven.index(one)]
            ax.axhline(0, color=GUIDE, lw=0.5)
            ax.set_title(f"{hz:g} Hz {one}")
            for data, look in ((measured, _rig(one)), (twin, _twin(one))):
                if data is not None:
                    draw(ax, data, look)
            if not any(np.isfinite(line.get_ydata()).any() for line in ax.lines[1:]):
                ax.text(0.5, 0.6, "no contact", transform=ax.transAxes, ha="center", color=GUIDE)
                ax.set_yticks([0])
            _guides(run, ax.axvline)
        column[-1].set_xlabel(names[2])
    for ax in axes[:, 0]:
        ax.set_ylabel(names[3])
    _key(run, figure, *_guide_key(run))
    yield names[0], names[1], caption, figure


def _errors(run: Run) -> Drawn:
    """NRMSE of the free-running and of the restarted twin over frequency."""
    errors = {part: found for part, found in step_errors(run).items() if _finite(found)}
    if not errors:
        return
    figure = Figure(figsize=(WIDTH, 2.5 * ((len(errors) + 1) // 2) + 0.4))
    axes = figure.subplots((len(errors) + 1) // 2, 2, sharex=True, sharey=True, squeeze=False)
    for ax, (part, found) in zip(axes.flat, errors.items(), strict=False):
        for one in DIRECTIONS:
            steps = [s for s in run.steps if s["direction"] == one and s["index"] in found]
            f = [step["frequency_hz"] for step in steps]
            both = np.array([found[step["index"]] for step in steps]).reshape(-1, 2)
            ax.semilogy(f, both[:, 0], "o-", color=COLOUR[one], lw=0.9)
            ax.semilogy(f, both[:, 1], "o:", color=COLOUR[one], lw=0.9, mfc="white")
        ax.set_title(f"${part}$")
    for ax in axes[:, 0]:
        ax.set_ylabel("NRMSE")
    for ax in axes[-1]:
        ax.set_xlabel("frequency in Hz")
    handles = [
        Line2D([], [], color=COLOUR[one], marker="o", ls=ls, mfc=face, label=f"{who}, {one}")
        for one in DIRECTIONS
        for who, ls, face in (("free-running", "-", COLOUR[one]), ("restarted", ":", "white"))
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=4)
    caption = (
        "Root mean square error over root mean square measurement, on the measured cycles of each "
        "step; 1 is as bad as predicting nothing. The restarted twin begins anew from the measured "
        "state every window. Contact forces only where there was contact."
    )
    yield "comparison", "Twin against measurement", caption, figure


def _finite(found: dict[int, tuple[float, float]]) -> bool:
    return any(np.isfinite(one).any() for one in found.values())


def _overview(run: Run) -> Drawn:
    """Envelopes of table and mass over the whole run, the steps shaded."""
    name, track = ("meas", "") if run.who == "measured" else ("pred", "free/")
    pieces = run.streams[name] or run.streams["meas"]

    def get(block: Block, channel: str) -> Float1D:
        lost = np.full(len(block), np.nan)
        return block.channel(track + channel) if track + channel in block.channels else lost

    rows = {
        "table in mm": lambda block: get(block, "table_disp_m") * 1e3,
        "table in m/s²": lambda block: get(block, "table_acc_m_s2"),
        "$u$ in mm": lambda block: (get(block, "rel_disp_m") if track else rel_disp(block)) * 1e3,
    }
    low_hz = min((step["frequency_hz"] for step in run.steps), default=1.0)
    every = {
        label: [_envelope(piece, of, low_hz) for piece in pieces] for label, of in rows.items()
    }
    drawn = {
        label: envelopes
        for label, envelopes in every.items()
        if any(np.isfinite(low).any() for _, low, _ in envelopes)
    }
    if not drawn:
        return
    figure = Figure(figsize=(WIDTH, 1.7 * len(drawn) + 0.4))
    axes = figure.subplots(len(drawn), 1, sharex=True, squeeze=False)[:, 0]
    for ax, (label, envelopes) in zip(axes, drawn.items(), strict=True):
        for time, low, high in envelopes:
            ax.fill_between(time, low, high, color="#8b929c", lw=0)
        ax.set_ylabel(label)
        _shade_steps(run, ax, pieces, ax is axes[0])
        if label.startswith("$u$"):
            _guides(run, ax.axhline)
    peaks = {step.acceleration_m_s2 for step in run.recording.start.steps}
    for ax in axes[1:2] if "table in m/s²" in drawn else ():
        for peak in peaks:
            ax.axhline(peak, color="#111111", ls="--", lw=0.9)
            ax.axhline(-peak, color="#111111", ls="--", lw=0.9)
    axes[-1].set_xlabel("time in s")
    axes[-1].set_xlim(pieces[0].time_s[0], pieces[-1].time_s[-1])
    caption = (
        "Envelopes. The steps are shaded in turn, red forward, blue backward; numbers on top are "
        "their frequencies in Hz. Dashed: demanded peak acceleration, and the bumpers at rest."
    )
    yield "overview", "The drive and the answer", caption, figure


def _envelope(
    block: Block, of: Callable[[Block], Float1D], low_hz: float
) -> tuple[Float1D, Float1D, Float1D]:
    """(time, smallest, largest) of bins that hold a whole cycle; NaN where nothing was sampled."""
    width = max(len(block) // BINS, round(block.rate_hz / low_hz), 1)
    starts = np.arange(0, len(block), width)
    values = of(block)
    middle = block.time_s[np.minimum(starts + width // 2, len(block) - 1)]
    return middle, np.fmin.reduceat(values, starts), np.fmax.reduceat(values, starts)


def _shade_steps(run: Run, ax: Axes, pieces: tuple[Block, ...], numbered: bool) -> None:
    direction = {step["index"]: step for step in run.steps}
    total = pieces[-1].time_s[-1] - pieces[0].time_s[0]
    free_from = 0.0
    for piece in pieces:
        cuts = np.flatnonzero(np.diff(piece.step)) + 1
        for first, last in zip([0, *cuts], [*cuts, len(piece)], strict=True):
            step = direction.get(int(piece.step[first]))
            if step is None:
                continue
            start, stop = piece.time_s[first], piece.time_s[last - 1]
            shade = 0.20 if step["index"] % 2 else 0.09
            ax.axvspan(start, stop, color=COLOUR[step["direction"]], alpha=shade, lw=0, zorder=0)
            if numbered and start >= free_from:
                middle = (start + stop) / 2
                ax.annotate(
                    f"{step['frequency_hz']:g}", (middle, 1.02), xycoords=("data", "axes fraction"),
                    ha="center", size=8, color=GUIDE,
                )  # fmt: skip
                free_from = start + total / 22
