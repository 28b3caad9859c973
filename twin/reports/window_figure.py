"""Figure of a displacement history: table, specimen and twin over time."""

from matplotlib.figure import Figure

from table_io.channels import contact_forces, relative_displacement
from twin.reports.motion_drawing import draw_rest_lines
from twin.reports.plot_style import (
    DIRECTION_COLOURS,
    FIGURE_WIDTH_IN,
    GUIDE_COLOUR,
    TWIN_COLOUR,
    CaptionedFigure,
    CaptionedFigures,
)
from twin.reports.report_data import ReportData
from twin.reports.windows import cut_blocks, extract_free_twin, join_channel

MAX_PLOTTED_SAMPLES = 20_000


def draw_window_histories(run: ReportData) -> CaptionedFigures:
    """Draw table, u, a and contact forces over the whole history, measured and twin."""
    windows = run.windows
    if not windows:
        return
    rate_hz = run.recording.start.rate_hz
    first, end = round(windows[0]["from_s"] * rate_hz), round(windows[-1]["to_s"] * rate_hz)
    measured = cut_blocks(run.streams["meas"], first, end)
    twin = [extract_free_twin(block) for block in cut_blocks(run.streams["pred"], first, end)]
    rows = 4 if run.has_bumpers else 3
    figure = Figure(figsize=(FIGURE_WIDTH_IN, 1.75 * rows + 0.5))
    axes = figure.subplots(rows, 1, sharex=True)
    sources = [(twin, TWIN_COLOUR, 0.8)]
    if run.source == "measured":
        sources.insert(0, (measured, DIRECTION_COLOURS["forward"], 2.2))
    stride = max(1, (end - first) // MAX_PLOTTED_SAMPLES)
    for block in measured:
        axes[0].plot(
            block.time_s[::stride],
            block.channel("table_disp_m")[::stride] * 1e3,
            color=GUIDE_COLOUR,
        )
    for blocks, colour, width in sources:
        for block in blocks:
            right, left = contact_forces(block)
            acceleration = join_channel([block], "mass_acc_m_s2")
            curves = relative_displacement(block) * 1e3, acceleration, right * 1e-3, left * 1e-3
            for row, curve in zip((1, 2, 3, 3), curves, strict=True):
                if row < rows:
                    axes[row].plot(block.time_s[::stride], curve[::stride], color=colour, lw=width)
    if run.gaps_m is not None:
        draw_rest_lines(run.gaps_m, axes[1].axhline)
    labels = ("table in mm", "$u$ in mm", "$a$ in m/s²", "$F_R$, $F_L$ in kN")
    for axis, label in zip(axes, labels, strict=False):
        axis.set_ylabel(label)
        for window in windows[1::2]:
            axis.axvspan(window["from_s"], window["to_s"], color=GUIDE_COLOUR, alpha=0.07, lw=0)
    axes[-1].set_xlabel("time in s")
    axes[-1].set_xlim(windows[0]["from_s"], windows[-1]["to_s"])
    caption = (
        "Red: measured. Black: twin, free-running on the measured table acceleration; after an "
        "impact in a chaotic motion it cannot be reproduced sample by sample. Bands: windows."
    )
    yield CaptionedFigure("history", "Response to the displacement history", caption, figure)
