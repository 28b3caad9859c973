"""The level of the table over the steps: as measured, as it would have been without control."""

import numpy as np
from matplotlib.figure import Figure

from table_io.records import Level, Point
from table_io.units import GRAVITY_M_S2
from twin.service.close_ups import COLOUR, Drawn
from twin.service.evidence import DIRECTIONS, Run


def levels(run: Run) -> Drawn:
    """Error of the measured cycles, of the first look at each step, and the correction in force.

    What the uncorrected command would have reached is the measured level over the correction.
    """
    accepted = {one.step: one for one in run.recording.of(Level) if one.accepted}
    points = [one for one in run.recording.of(Point) if one.step in accepted]
    if not points:
        return
    demand = accepted[points[0].step].demanded_m_s2
    figure = Figure(figsize=(9.5, 4.6))
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    for direction in DIRECTIONS:
        some = [one for one in points if one.direction == direction]
        if not some:
            continue
        f = np.array([one.frequency_hz for one in some])
        reached = np.array([one.table_acc_fundamental_m_s2 for one in some])
        wanted = np.array([accepted[one.step].demanded_m_s2 for one in some])
        correction = np.array([accepted[one.step].correction for one in some])
        order = np.argsort(f)
        colour = COLOUR[direction]
        error, bare = 100 * (reached / wanted - 1), 100 * (reached / correction / wanted - 1)
        upper.plot(f[order], error[order], "o-", color=colour, ms=3, label=f"{direction}")
        upper.plot(
            f[order], bare[order], ":", color=colour, lw=1.2, label=f"{direction}, uncorrected"
        )
        lower.plot(f[order], correction[order], "o-", color=colour, ms=3)
    for sign in (-2, 2):
        upper.axhline(sign, color="#777777", lw=0.8, ls="--")
    upper.set_ylabel("level error [%]")
    upper.legend(ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    lower.set_ylabel("correction")
    lower.set_xlabel("frequency [Hz]")
    yield (
        "level",
        "Level of the table",
        f"Fundamental of the measured table acceleration against the demanded "
        f"{demand / GRAVITY_M_S2:.3g} g over the measured cycles of each step (dashed: ±2 %), what "
        "the same command would have reached without correction (dotted), and the correction.",
        figure,
    )
