"""PDF report of a run: verdicts, facts, every figure as vectors with its caption, steps table."""

import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path

import matplotlib as mpl
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure

from table_io.records import RESPONSE_RATIOS, format_kind
from twin.drawing.pictures import RC_PARAMS, render_figure
from twin.drawing.plot_style import FIGURE_WIDTH_IN
from twin.report.figures import draw_figures
from twin.report.report import format_headline
from twin.results.excitation_verdict import format_excitation_verdict
from twin.results.report_data import ReportData, step_quantity
from twin.results.twin_verdict import format_jump, format_twin_verdict

PAGE_IN = (FIGURE_WIDTH_IN, FIGURE_WIDTH_IN * 2**0.5)  # as A4
LINES_PER_PAGE, COLUMNS = 78, 122


def write_pdf_report(run: ReportData, path: Path) -> None:
    """Write the report of a run as a PDF file; figures stay vectors, text can be searched."""
    with mpl.rc_context(RC_PARAMS | {"pdf.fonttype": 42}), PdfPages(path) as pdf:
        title = run.summary.run.title or run.recording.start.name
        for page in _make_text_pages(title, _describe_run(run)):
            pdf.savefig(page)
        for number, drawing in enumerate(draw_figures(run), 1):
            caption = textwrap.fill(drawing.caption, 130)
            heading = f"Figure {number}. {drawing.title}"
            figure = render_figure(drawing.figure)
            figure.text(0.0, 1.06, heading, weight="bold", va="bottom")
            figure.text(0.0, -0.02, caption, va="top", size=8)
            pdf.savefig(figure, bbox_inches="tight", pad_inches=0.4)
        for page in _make_text_pages("Steps, measured | twin", _tabulate_steps(run)):
            pdf.savefig(page)


def _describe_run(run: ReportData) -> list[str]:
    summary, start = run.summary, run.recording.start
    lines = [f"Test {summary.verdict} ({summary.reason}): {format_headline(run)}", ""]
    if summary.twin_verdict and summary.is_twin_judged:
        if summary.excitation_verdict:
            lines.append(format_excitation_verdict(summary.excitation_verdict))
        lines += [*format_twin_verdict(summary.twin_verdict, run.recording.path.parent), ""]
    lines += [f"Run      {start.run}", f"Started  {start.started_at} on {start.host}"]
    lines.append(f"Gap      {_format_gap(run)}")
    lines += [f"Model    {summary.run.model or 'not stated'}", "", "Jumps and hysteresis"]
    lines += [f"  measured: {format_jump(jump)}" for jump in summary.jumps]
    lines += [f"  twin: {format_jump(jump)}" for jump in summary.twin_jumps]
    lines += ["", "Warnings"]
    lines += [
        f"  {warning.at_s:.1f} s  {format_kind(warning.kind)}: {warning.text}"
        for warning in summary.warnings
    ]
    return lines


def _format_gap(run: ReportData) -> str:
    if run.gaps_m is None:
        return "no bumpers, or unknown"
    right, left = (1e3 * gap for gap in run.gaps_m)
    return f"right {right:g} mm, left {left:g} mm"


def _tabulate_steps(run: ReportData) -> list[str]:
    heads = "".join(f"{name:>16}" for name in RESPONSE_RATIOS)
    lines = [f"{'f in Hz':>8} {'':9}{heads}"] if run.steps else []
    for step in run.steps:
        pairs = [
            [step_quantity(step, source, name) for source in ("measured", "twin")]
            for name in RESPONSE_RATIOS
        ]
        cells = "".join(f"{measured:8.3f}|{twin:<7.3f}" for measured, twin in pairs)
        lines.append(f"{step.frequency_hz:8.3f} {step.direction:9}{cells}")
    return lines


def _make_text_pages(title: str, lines: Sequence[str]) -> Iterator[Figure]:
    """Yield pages with a title and lines of text, wrapped; none without lines."""
    wrapped = [
        part
        for line in lines
        for part in textwrap.wrap(line, COLUMNS, subsequent_indent="    ") or [""]
    ]
    for first in range(0, len(wrapped), LINES_PER_PAGE):
        page = Figure(figsize=PAGE_IN)
        page.text(0.07, 0.95, title, size=15, weight="bold", va="top")
        text = "\n".join(wrapped[first : first + LINES_PER_PAGE])
        page.text(0.07, 0.92, text, family="monospace", size=8, va="top")
        yield page
