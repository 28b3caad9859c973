"""Figure of a displacement history: table, specimen and twin over time."""

from collections.abc import Callable, Sequence

import numpy as np

from table_io.block import Block, Float1D
from table_io.channels import contact_forces, relative_displacement
from twin.drawing.motion_drawing import draw_rest_lines
from twin.drawing.panels import CaptionedFigure, CaptionedFigures, PanelFigure
from twin.drawing.plot_style import (
    FIGURE_WIDTH_IN,
    GUIDE_COLOUR,
    TWIN_COLOUR,
    measured_style,
    twin_style,
)
from twin.results.report_data import ReportData
from twin.results.windows import cut_blocks, extract_free_twin, join_channel

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
    measured = cut_blocks(run.streams["meas"], first, end)
    twin = [extract_free_twin(block) for block in cut_blocks(run.streams["pred"], first, end)]
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
