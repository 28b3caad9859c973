"""Figures of a run: selected steps, histories over time, level of a swept sine, measured orbits.

Steps come from `report_data.select_frequencies`: at most four frequencies, both directions each.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from table_io.block import Block, Float1D
from table_io.channels import contact_forces, relative_displacement
from table_io.units import GRAVITY_M_S2
from twin.drawing.motion_drawing import (
    draw_rest_lines,
    plot_bumper_loops,
    plot_history,
    plot_inertia_loop,
    plot_phase_portrait,
    shade_contact,
)
from twin.drawing.panels import CaptionedFigure, CaptionedFigures, FigurePanel, Key, PanelFigure
from twin.drawing.plot_style import (
    DIRECTION_COLOURS,
    FIGURE_WIDTH_IN,
    GUIDE_COLOUR,
    REST_LINE_STYLE,
    TWIN_COLOUR,
    UNSTABLE_STYLE,
    direction_keys,
    measured_style,
    twin_style,
)
from twin.results.orbits import read_planned_branch
from twin.results.report_data import (
    DIRECTIONS,
    ReportData,
    StepMotion,
    pair_motions,
    select_frequencies,
)
from twin.results.summary import parse_toml_tables
from twin.results.windows import extract_free_twin, join_channel

HISTORY_CYCLES = 3
CONTACT_ALPHAS = 0.22, 0.10  # right, left
BAND_COLOUR = "#cfe8d5"
MIN_LEVEL_M_S2 = 1e-6  # that is drawn: a distortion below its noise is 0


def draw_legend(run: ReportData, figure: PanelFigure, *keys: Key, marker: str = "") -> None:
    """Draw the legend of measured and twin lines above the panels."""
    lines: list[Key] = []
    directions = [
        direction
        for direction in DIRECTIONS
        if any(step.direction == direction for step in run.steps)
    ]
    if run.source == "measured":
        lines += direction_keys(
            lambda direction: measured_style(direction) | {"marker": marker},
            "measured ",
            directions,
        )
    lines += direction_keys(twin_style, "twin ", directions)
    figure.legend([*lines, *keys], columns=6)


def draw_histories(run: ReportData) -> CaptionedFigures:
    """Draw u, a and contact forces over the last cycles, one figure per frequency (Figs. 7, 12)."""
    for hz, reason in select_frequencies(run).items():
        motions = pair_motions(run, hz)
        rows = 3 if run.has_bumpers else 2
        if not motions:
            continue
        has_residuals = any(measured and twin for _, measured, twin in motions)
        heights = [2.0, 0.9] * rows if has_residuals else [2.0] * rows
        size_in = FIGURE_WIDTH_IN, 0.8 * sum(heights) + 0.6
        figure = PanelFigure(
            size_in, len(heights), len(motions), sharex="col", sharey="row", heights=heights
        )
        axes = figure.panels
        stride = 2 if has_residuals else 1
        for column, (direction, measured, twin) in zip(axes.T, motions, strict=True):
            histories = column[::stride]
            histories[0].set_title(f"{direction}, {hz:g} Hz")
            column[-1].set_xlabel("time in s")
            for motion, style in (
                (measured, measured_style(direction)),
                (twin, twin_style(direction)),
            ):
                if motion is not None:
                    plot_history(histories, motion.select_last(HISTORY_CYCLES), **style)
            contact_motion = twin if run.source == "twin" or measured is None else measured
            if contact_motion is not None:
                shown = contact_motion.select_last(HISTORY_CYCLES)
                colour = DIRECTION_COLOURS[direction]
                for ax in histories:
                    shade_contact(ax, shown, colour, CONTACT_ALPHAS, run.contact_n)
            if run.gaps_m is not None:
                draw_rest_lines(run.gaps_m, histories[0].axhline)
            if has_residuals and measured and twin:
                _draw_residuals(
                    column[1::2],
                    measured.select_last(HISTORY_CYCLES),
                    twin.select_last(HISTORY_CYCLES),
                    _find_bands(run, direction, hz),
                )
        labels = ("$u$ in mm", "$a$ in m/s²", "$F_R$, $F_L$ in kN")
        for ax, label in zip(axes[::stride, 0], labels, strict=False):
            ax.set_ylabel(label)
        for ax in axes[1::2, 0] if has_residuals else ():
            ax.set_ylabel("residual")
        keys = _list_gap_line_keys(run)
        if has_residuals:
            keys.append(Key("tolerance", {"color": BAND_COLOUR}, is_patch=True))
        draw_legend(run, figure, *keys)
        caption = (
            "Last measured cycles; below each history, measured minus twin in the same unit, and "
            "the tolerance of the restarted twin. Shaded: contact, dark for the right bumper, "
            "light for the left. "
            "The twin is free-running on the measured table acceleration; a chaotic motion cannot "
            "be reproduced sample by sample."
        )
        title = f"Histories at {hz:g} Hz: {reason}"
        yield CaptionedFigure(f"histories_{hz:g}hz", title, caption, figure)


def _find_bands(run: ReportData, direction: str, hz: float) -> dict[str, float]:
    """Return the tolerance of u in m and of a in m/s2 at a step; empty if it is unknown."""
    for step in run.steps:
        if step.direction == direction and step.frequency_hz == hz:
            return {name: misfit.band for name, misfit in step.agreement.items()}
    return {}


def _draw_residuals(
    axes: Sequence[FigurePanel], measured: StepMotion, twin: StepMotion, bands: dict[str, float]
) -> None:
    """Draw measured minus twin of u, a and the forces, each with its tolerance band."""
    count = min(measured.time.size, twin.time.size)
    scales = (("u", 1e3, "rel_disp_m"), ("a", 1.0, "mass_acc_m_s2"))
    for ax, (name, scale, channel) in zip(axes, scales, strict=False):
        difference = getattr(measured, name)[:count] - getattr(twin, name)[:count]
        ax.plot(measured.time[:count], scale * difference, color=TWIN_COLOUR, lw=0.8)
        if channel in bands:
            half = scale * bands[channel]
            ax.axhspan(-half, half, color=BAND_COLOUR, lw=0, zorder=0.4)
    for ax in axes[2:]:
        for name in ("force_r", "force_l"):
            difference = getattr(measured, name)[:count] - getattr(twin, name)[:count]
            ax.plot(measured.time[:count], difference / 1e3, color=TWIN_COLOUR, lw=0.8)
    for ax in axes:
        ax.axhline(0, color=GUIDE_COLOUR, lw=0.5)


def _list_gap_line_keys(run: ReportData) -> list[Key]:
    if run.gaps_m is None:
        return []
    name = "bumper at rest" if min(run.gaps_m) >= 0 else "precompression"
    return [Key(name, REST_LINE_STYLE)]


def draw_loop_figures(run: ReportData) -> CaptionedFigures:
    """Draw phase portraits, inertia force loops and bumper loops (Figs. 3, 6, 9 and 11)."""
    mass = run.specimen.mass_kg if run.specimen else None
    columns = {hz: motions for hz in select_frequencies(run) if (motions := pair_motions(run, hz))}

    def plot_inertia(ax: FigurePanel, motion: StepMotion, **style: Any) -> None:
        plot_inertia_loop(ax, motion, mass or np.nan, **style)

    yield from _draw_grid(
        run, columns, plot_phase_portrait,
        ("portraits", "Phase portraits", "$u$ in mm", "$u'$ in mm/s"),
        "Relative velocity u' over relative displacement u, all measured cycles. The measured u' "
        "is a Savitzky-Golay derivative of u over 20 ms, used only in this figure.",
    )  # fmt: skip
    if mass is not None:
        yield from _draw_grid(
            run, columns, plot_inertia,
            ("loops", "Inertia force loops", "$u$ in mm", "$F_I$ in kN"),
            "Inertia force F_I = −M a against relative displacement.",
        )  # fmt: skip
    if run.has_bumpers:
        yield from _draw_grid(
            run, columns, plot_bumper_loops,
            ("bumpers", "Bumper loops", "$v_j$ in mm", "$F_j$ in kN"),
            "Contact force over bumper position, right positive, left negative. In contact the "
            "bumper moves with the mass, v_j = u; flight is not shown.",
        )  # fmt: skip


def _draw_grid(
    run: ReportData,
    columns: dict[float, list[tuple[str, StepMotion | None, StepMotion | None]]],
    plot: Callable[..., None],
    names: tuple[str, str, str, str],
    caption: str,
) -> CaptionedFigures:
    """Draw one figure with a column per frequency and a row per direction."""
    directions = [
        direction
        for direction in DIRECTIONS
        if any(direction == entry[0] for entries in columns.values() for entry in entries)
    ]
    if not directions:
        return
    size_in = FIGURE_WIDTH_IN, 2.5 * len(directions) + 0.6
    figure = PanelFigure(size_in, len(directions), max(len(columns), 3), sharex="col", sharey="col")
    axes = figure.panels
    axes[:, len(columns) :] = None
    axes = axes[:, : len(columns)]
    for column, (hz, motions) in zip(axes.T, columns.items(), strict=False):
        for direction, measured, twin in motions:
            ax = column[directions.index(direction)]
            ax.axhline(0, color=GUIDE_COLOUR, lw=0.5)
            ax.set_title(f"{hz:g} Hz {direction}")
            for motion, style in (
                (measured, measured_style(direction)),
                (twin, twin_style(direction)),
            ):
                if motion is not None:
                    plot(ax, motion, **style)
            if not any(np.isfinite(call.arguments).all(axis=0).any() for call in ax.find("plot")):
                ax.text(
                    0.5, 0.6, "no contact", transform=ax.transAxes, ha="center", color=GUIDE_COLOUR
                )
            if run.gaps_m is not None:
                draw_rest_lines(run.gaps_m, ax.axvline)
        column[-1].set_xlabel(names[2])
    for ax in axes[:, 0]:
        ax.set_ylabel(names[3])
    draw_legend(run, figure, *_list_gap_line_keys(run))
    yield CaptionedFigure(names[0], names[1], caption, figure)


MAX_PLOTTED_SAMPLES = 20_000
RESIDUALS: tuple[tuple[str, float, Callable[[Block], Float1D]], ...] = (
    ("residual\n$u$ in mm", 1e3, relative_displacement),
    ("residual\n$a$ in m/s²", 1.0, lambda block: join_channel([block], "mass_acc_m_s2")),
)


def draw_window_histories(run: ReportData) -> CaptionedFigures:
    """Draw table, u, a and contact forces over the whole history, measured and twin."""
    windows = run.windows
    if not windows:
        return
    rate_hz = run.recording.start.rate_hz
    first, end = round(windows[0].from_s * rate_hz), round(windows[-1].to_s * rate_hz)
    measured = run.read_stream("meas", first, end)
    twin = [extract_free_twin(block) for block in run.read_stream("pred", first, end)]
    rows = 4 if run.has_bumpers else 3
    strips = RESIDUALS if run.source == "measured" and twin else ()
    heights = [2.0] * rows + [1.0] * len(strips)
    size_in = FIGURE_WIDTH_IN, 0.88 * sum(heights) + 0.5
    figure = PanelFigure(size_in, len(heights), heights=heights)
    axes = figure.panels[:, 0]
    sources = [(twin, twin_style("forward"))]
    if run.source == "measured":
        sources.insert(0, (measured, measured_style("forward")))
    stride = max(1, (end - first) // MAX_PLOTTED_SAMPLES)
    for block in measured:
        axes[0].plot(
            block.time_s[::stride],
            block.channel("table_disp_m")[::stride] * 1e3,
            color=GUIDE_COLOUR,
        )
    for blocks, style in sources:
        for block in blocks:
            right, left = contact_forces(block)
            acceleration = join_channel([block], "mass_acc_m_s2")
            curves = relative_displacement(block) * 1e3, acceleration, right * 1e-3, left * 1e-3
            for row, curve in zip((1, 2, 3, 3), curves, strict=True):
                if row < rows:
                    axes[row].plot(block.time_s[::stride], curve[::stride], **style)
    time_s = np.arange(first, end)[::stride] / rate_hz
    for axis, (label, scale, extract) in zip(axes[rows:], strips, strict=True):
        difference = _join(measured, extract, first, end) - _join(twin, extract, first, end)
        axis.plot(time_s, scale * difference[::stride], color=TWIN_COLOUR, lw=0.8)
        axis.axhline(0, color=GUIDE_COLOUR, lw=0.5)
        axis.set_ylabel(label)
    if run.gaps_m is not None:
        draw_rest_lines(run.gaps_m, axes[1].axhline)
    labels = ("table in mm", "$u$ in mm", "$a$ in m/s²", "$F_R$, $F_L$ in kN")[:rows]
    for axis, label in zip(axes, labels, strict=False):
        axis.set_ylabel(label)
        for window in windows[1::2]:
            axis.axvspan(window.from_s, window.to_s, color=GUIDE_COLOUR, alpha=0.07, lw=0)
    axes[-1].set_xlabel("time in s")
    axes[-1].set_xlim(windows[0].from_s, windows[-1].to_s)
    caption = (
        "Wide and pale: measured. Black: twin, free-running on the measured table acceleration; "
        "after an impact in a chaotic motion it cannot be reproduced sample by sample. Residual: "
        "measured minus twin. Bands: windows."
    )
    yield CaptionedFigure("history", "Response over time", caption, figure)


def _join(
    blocks: Sequence[Block], extract: Callable[[Block], Float1D], first: int, end: int
) -> Float1D:
    """Return a quantity of blocks at the samples first .. end - 1, NaN where there is none."""
    values = np.full(end - first, np.nan)
    for block in blocks:
        values[block.index - first : block.end - first] = extract(block)
    return values


TOLERANCE_COLOUR, PREDICTED_COLOUR = "#e9edf3", "#2e9e5b"


def draw_best_linear(run: ReportData) -> CaptionedFigures:
    """Draw the best linear approximations of table and specimen, and what is noise in them."""
    results = run.summary.best_linear
    if not results:
        return
    figure = PanelFigure((FIGURE_WIDTH_IN, 5.4), 2, len(results), heights=(1.4, 1.0))
    for column, result in enumerate(results):
        gain, level = figure.panels[:, column]
        hz, known, half = np.array([result.frequency_hz, result.gain, result.half_width])
        gain.fill_between(hz, known - half, known + half, color=BAND_COLOUR, lw=0)
        gain.plot(hz, known, **measured_style("forward"))
        gain.set_title(f"{result.output} over {result.input}")
        for values, label, colour in (
            (result.level_m_s2, "acceleration", DIRECTION_COLOURS["forward"]),
            (result.distortion_m_s2, "nonlinear distortion", DIRECTION_COLOURS["backward"]),
            (result.noise_m_s2, "noise", GUIDE_COLOUR),
        ):
            decibels = 20.0 * np.log10(np.maximum(values, MIN_LEVEL_M_S2))
            label_once = {} if column else {"label": label}
            level.plot(hz, decibels, color=colour, lw=0.9, **label_once)
        for axis in (gain, level):
            axis.set_xscale("log")
        level.set_xlabel("frequency in Hz")
    figure.panels[0, 0].set_ylabel("gain")
    figure.panels[1, 0].set_ylabel("dB re 1 m/s²")
    figure.panels[1, 0].legend()
    caption = (
        "Above: best linear approximation with the circle of 95 % about it. Below, by excited "
        "line: the acceleration, what in it changes with the phases of the excitation (nonlinear "
        "distortion), and what changes from period to period (noise)."
    )
    yield CaptionedFigure("best_linear", "Best linear approximation", caption, figure)


def draw_swept_sine(run: ReportData) -> CaptionedFigures:
    """Draw the level of each pass, up and down, with its tolerance and what it deviates by."""
    result = run.summary.swept_sine
    if result is None:
        return
    figure = PanelFigure((FIGURE_WIDTH_IN, 5.4), 2, heights=(2.2, 1.0))
    level, ratio = figure.panels[:, 0]
    grid = sorted({(point.frequency_hz, point.reference_m_s2) for point in result.points})
    hz, reference = np.array(grid).T
    level.plot(hz, reference / GRAVITY_M_S2, color=GUIDE_COLOUR, lw=0.9, label="level of the test")
    low, high = 1.0 - result.tolerance, 1.0 + result.tolerance
    ratio.axhspan(low, high, color=TOLERANCE_COLOUR, lw=0, label=f"+-{100 * result.tolerance:g} %")
    abort = 10.0 ** (result.abort_db / 20.0)
    if max(result.highest_ratio, 1.0 / result.lowest_ratio) > 1.0 + 4.0 * result.tolerance:
        for bound in (abort, 1.0 / abort):
            ratio.axhline(bound, color="#c4161c", lw=0.8, ls="--")
    labelled: set[str] = set()
    for sweep in sorted({point.sweep for point in result.points}):
        points = [point for point in result.points if point.sweep == sweep]
        direction = points[0].direction
        if direction == "dwell":
            continue
        style = measured_style(direction)
        f, demanded, achieved, predicted = np.array(
            [(p.frequency_hz, p.demanded_m_s2, p.achieved_m_s2, p.predicted_m_s2) for p in points]
        ).T
        foreseen = np.isfinite(predicted)
        if foreseen.any():
            label = {} if labelled else {"label": "predicted notch"}
            predicted_g = predicted[foreseen] / GRAVITY_M_S2
            level.plot(f[foreseen], predicted_g, color=PREDICTED_COLOUR, lw=1.0, **label)
        label = {} if direction in labelled else {"label": f"achieved, {direction}"}
        level.plot(f, achieved / GRAVITY_M_S2, **style, **label)
        ratio.plot(f, achieved / demanded, **style)
        labelled.add(direction)
    level.set_ylabel("level in g")
    level.set_yscale("log")
    ratio.set_ylabel("achieved / demanded")
    ratio.set_xlabel("frequency in Hz")
    ratio.set_xscale("log")
    level.set_xscale("log")
    for entry in result.resonances:
        level.axvline(entry.frequency_hz, color=GUIDE_COLOUR, lw=0.6, ls=":")
    level.legend()
    ratio.legend()
    caption = (
        "Fundamental of the control channels over a few cycles at each point. The demand is the "
        "level of the test, reduced where a limit needs it (a notch). Band: tolerance of the "
        "profile; dotted: resonances found."
    )
    yield CaptionedFigure("swept_sine", "Level of the swept sine", caption, figure)


REFUSED_COLOUR = "#f4ac3d"


def draw_orbits(run: ReportData) -> CaptionedFigures:
    """Draw amplitude, feedback and Floquet multiplier of the measured orbits over frequency."""
    orbits = run.orbits
    if not orbits:
        return
    branch = read_planned_branch(parse_toml_tables(run.recording.start.profile_toml))
    measured = [orbit for orbit in orbits if orbit.multiplier_sd is not None]
    is_backbone = branch is not None and branch.is_backbone
    heights = (2.2, 1.0, 1.2) if measured or is_backbone else (2.2, 1.0)
    size_in = FIGURE_WIDTH_IN, 6.2 if len(heights) == 2 else 8.0
    figure = PanelFigure(size_in, len(heights), heights=heights)
    axes = figure.panels[:, 0]
    branch_axis, feedback_axis = axes[:2]
    if branch is not None:
        amplitudes_mm = 1e3 * branch.amplitudes_m
        stable, unstable = (
            np.where(mask | np.append(mask[1:], mask[-1]), amplitudes_mm, np.nan)
            for mask in (branch.stable, ~branch.stable)
        )
        frequencies = branch.frequencies_hz
        branch_axis.plot(frequencies, stable, color=TWIN_COLOUR, lw=1.0, label="twin, stable")
        if not branch.stable.all():
            branch_axis.plot(frequencies, unstable, **UNSTABLE_STYLE, label="twin, unstable")
    for is_accepted, colour, label in (
        (True, DIRECTION_COLOURS["forward"], "measured"),
        (False, REFUSED_COLOUR, "not accepted"),
    ):
        own = [orbit for orbit in orbits if orbit.accepted is is_accepted]
        frequencies = np.array([orbit.frequency_hz for orbit in own])
        amplitudes = np.array([orbit.amplitude_m for orbit in own])
        shares = np.array([orbit.feedback_share for orbit in own])
        if own:
            branch_axis.plot(
                frequencies, 1e3 * amplitudes, marker="o", ls="", color=colour, label=label
            )
            feedback_axis.plot(frequencies, 100 * shares, marker="o", ls="", color=colour)
    folds = run.summary.folds
    if folds:
        branch_axis.plot(
            [fold.frequency_hz for fold in folds],
            [1e3 * fold.amplitude_m for fold in folds],
            marker="x", ls="", color=DIRECTION_COLOURS["backward"], label="fold, by its neighbours",
        )  # fmt: skip
    noise = [
        orbit.noise_m * orbit.feedback_share / orbit.feedback_m if orbit.feedback_m else np.nan
        for orbit in orbits
    ]
    feedback_axis.plot(
        [orbit.frequency_hz for orbit in orbits], 100 * np.array(noise), marker="_", ls="",
        color=GUIDE_COLOUR, label="noise, by the scatter of cycles",
    )  # fmt: skip
    branch_axis.set_ylabel("amplitude of $u$ in mm")
    feedback_axis.set_ylabel("feedback in % of the command")
    feedback_axis.set_yscale("log")
    if is_backbone:
        axes[2].plot(
            [orbit.frequency_hz for orbit in orbits],
            [orbit.phase_deg for orbit in orbits],
            marker="o", ls="", color=DIRECTION_COLOURS["forward"],
        )  # fmt: skip
        axes[2].axhline(90.0, color=GUIDE_COLOUR, lw=0.8)
        axes[2].set_ylabel("phase in degrees")
    elif measured:
        if branch is not None:
            axes[2].plot(branch.frequencies_hz, branch.multipliers, color=TWIN_COLOUR, lw=1.0)
        axes[2].errorbar(
            [orbit.frequency_hz for orbit in measured],
            [orbit.multiplier for orbit in measured],
            [orbit.multiplier_sd for orbit in measured],
            fmt="o", color=DIRECTION_COLOURS["forward"], capsize=2.0,
        )  # fmt: skip
        axes[2].axhline(1.0, color=GUIDE_COLOUR, lw=0.8)
        axes[2].set_ylabel("multiplier")
    axes[-1].set_xlabel("frequency in Hz")
    branch_axis.legend()
    feedback_axis.legend()
    accepted = sum(orbit.accepted for orbit in orbits)
    if is_backbone:
        yield CaptionedFigure(
            "orbits",
            "Measured backbone",
            f"{accepted} of {len(orbits)} points accepted. At each level of the table the "
            "frequency was controlled until u led the table's acceleration by 90 degrees (phase, "
            "below), held by feedback until the feedback had vanished. Line: backbone of the twin.",
            figure,
        )
        return
    yield CaptionedFigure(
        "orbits",
        "Measured branch of periodic orbits",
        f"{accepted} of {len(orbits)} orbits accepted. Each was held by feedback until the "
        "feedback had vanished, so it is an orbit of the specimen without feedback, stable or not. "
        "Lines: orbits of the twin as planned before the test. Multiplier: growth of a departure "
        "in one period while the feedback was released, with its standard deviation.",
        figure,
    )
