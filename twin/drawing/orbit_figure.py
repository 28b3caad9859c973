"""Figure of a continuation: branch and multipliers over the twin's, and the feedback's rest."""

import numpy as np

from twin.drawing.panels import CaptionedFigure, CaptionedFigures, PanelFigure
from twin.drawing.plot_style import (
    DIRECTION_COLOURS,
    FIGURE_WIDTH_IN,
    GUIDE_COLOUR,
    TWIN_COLOUR,
    UNSTABLE_STYLE,
)
from twin.results.orbits import read_planned_branch
from twin.results.report_data import ReportData
from twin.results.summary import parse_toml_tables

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
        color=GUIDE_COLOUR, label="explained by sensor noise",
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
