"""Figure of a swept sine: demand, predicted notch and achieved level, with its tolerance."""

import numpy as np

from table_io.units import GRAVITY_M_S2
from twin.drawing.panels import CaptionedFigure, CaptionedFigures, PanelFigure
from twin.drawing.plot_style import FIGURE_WIDTH_IN, GUIDE_COLOUR, measured_style
from twin.results.report_data import ReportData

BAND_COLOUR, PREDICTED_COLOUR = "#e9edf3", "#2e9e5b"


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
    ratio.axhspan(low, high, color=BAND_COLOUR, lw=0, label=f"+-{100 * result.tolerance:g} %")
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
