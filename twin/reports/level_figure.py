"""Figure of the table level over the steps, with and without amplitude control."""

import numpy as np
from matplotlib.figure import Figure

from table_io.records import Level, PrcPoint
from table_io.units import GRAVITY_M_S2
from twin.reports.report_data import DIRECTIONS, ReportData
from twin.reports.step_figures import DIRECTION_COLOURS, CaptionedFigures


def draw_level_figure(run: ReportData) -> CaptionedFigures:
    """Draw the level error of the measured cycles, the error without control, and the correction.

    The uncorrected level is the measured level divided by the correction.
    """
    accepted = {level.step: level for level in run.recording.records(Level) if level.accepted}
    points = [point for point in run.recording.records(PrcPoint) if point.step in accepted]
    if not points:
        return
    demand = accepted[points[0].step].demanded_m_s2
    figure = Figure(figsize=(9.5, 4.6))
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    for direction in DIRECTIONS:
        direction_points = [point for point in points if point.direction == direction]
        if not direction_points:
            continue
        f = np.array([point.frequency_hz for point in direction_points])
        reached = np.array([point.table_acc_fundamental_m_s2 for point in direction_points])
        demanded = np.array([accepted[point.step].demanded_m_s2 for point in direction_points])
        correction = np.array([accepted[point.step].correction for point in direction_points])
        order = np.argsort(f)
        colour = DIRECTION_COLOURS[direction]
        error, uncorrected_error = (
            100 * (reached / demanded - 1),
            100 * (reached / correction / demanded - 1),
        )
        upper.plot(f[order], error[order], "o-", color=colour, ms=3, label=f"{direction}")
        upper.plot(
            f[order],
            uncorrected_error[order],
            ":",
            color=colour,
            lw=1.2,
            label=f"{direction}, uncorrected",
        )
        lower.plot(f[order], correction[order], "o-", color=colour, ms=3)
    for tolerance_percent in (-2, 2):
        upper.axhline(tolerance_percent, color="#777777", lw=0.8, ls="--")
    upper.set_ylabel("level error [%]")
    upper.legend(ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    lower.set_ylabel("correction")
    lower.set_xlabel("frequency [Hz]")
    yield (
        "level",
        "Level of the table",
        f"Error of the fundamental of the measured table acceleration relative to the demanded "
        f"{demand / GRAVITY_M_S2:.3g} g over the measured cycles of each step (dashed: ±2 %), the "
        "same without correction of the command (dotted), and the correction factor.",
        figure,
    )
