"""`compare`: two runs side by side, on the console, as JSON and as a page."""

from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import numpy as np
from rich.table import Table

from twin.drawing.charts import make_chart_script
from twin.drawing.page import render_page
from twin.drawing.panels import CaptionedFigure, CaptionedFigures, Key, PanelFigure
from twin.drawing.plot_style import DIRECTION_DASHES, FIGURE_WIDTH_IN, LineStyle
from twin.drawing.prc_drawing import (
    FREE_PANELS,
    PRC_PANELS,
    break_at_jumps,
    make_prc_panels,
    plot_prc,
)
from twin.recording.reader import read_recording
from twin.recording.run_paths import resolve_log_path
from twin.report.run_comparison import ComparedRun, RunComparison, compare_summaries
from twin.results.contract import format_json, write_json
from twin.results.contracts import RunSummary
from twin.results.quantities import format_quantity
from twin.results.recordings import read_recorded_config
from twin.results.report_data import DIRECTIONS, extract_prc
from twin.results.twin_verdict import CHANNEL_SYMBOLS
from twin.setup.folders import make_run_folder
from twin.system.terminal import console, print_line, print_table

RUN_COLOURS = ("#c8741a", "#0f7b7b")  # first, second: neither is that of a direction


def write_comparison_page(
    folder: Path, first: ComparedRun, second: ComparedRun, comparison: RunComparison
) -> Path:
    """Write compare.html into a folder; return the path of the page."""
    figures = list(draw_comparison(first, second))
    page = folder / "compare.html"
    page.write_text(
        render_page(
            Path(__file__).with_name("run_comparison.html"),
            comparison=comparison,
            figures=figures,
            script=make_chart_script(figures),
            quantity=format_quantity,
            symbols=CHANNEL_SYMBOLS,
        ),
        encoding="utf-8",
    )
    return page


def draw_comparison(first: ComparedRun, second: ComparedRun) -> CaptionedFigures:
    """Draw the curves of two runs over each other: measured wide and pale, twin thin on top."""
    points = [run.summary.steps for run in (first, second)]
    if not any(points):
        return
    has_bumpers = any(
        np.isfinite(extract_prc(of_run, source, direction, "r_r")[1]).any()
        for of_run in points
        for source in ("measured", "twin")
        for direction in DIRECTIONS
    )
    contents = PRC_PANELS if has_bumpers else FREE_PANELS
    figure = PanelFigure((FIGURE_WIDTH_IN, 3.6 * len(contents) / 2 + 0.3), len(contents) // 2, 2)
    panels = make_prc_panels(figure.panels, contents)
    keys = []
    named_runs = zip((first, second), points, RUN_COLOURS, ("first", "second"), strict=True)
    for run, of_run, colour, name in named_runs:
        for source, jumps in (("measured", run.summary.jumps), ("twin", run.summary.twin_jumps)):
            curves = break_at_jumps(partial(extract_prc, of_run, source), jumps)
            plot_prc(panels, curves, partial(_run_style, colour, source))
            keys.append(Key(f"{name}, {source}", _run_style(colour, source, "forward")))
    for direction in DIRECTIONS:
        style = {"color": "#555555", "lw": 1.0, "ls": DIRECTION_DASHES[direction]}
        keys.append(Key(direction, style))
    figure.legend(keys, columns=6)
    caption = (
        "One point per frequency step. Measured wide and pale, twin thin; solid forward, dashed "
        "backward; broken where it jumps. Each run is divided by its own u* and a*."
    )
    yield CaptionedFigure("prc", "Pseudo-resonance curves of both runs", caption, figure)


def _run_style(colour: str, source: str, direction: str) -> LineStyle:
    shape: LineStyle = (
        {"lw": 3.0, "alpha": 0.4} if source == "measured" else {"lw": 0.9, "alpha": 1.0}
    )
    return {"color": colour, "ls": DIRECTION_DASHES[direction], **shape}


@dataclass(frozen=True, eq=False)
class ComparedRuns:
    """Two runs and how they differ, `comparison`, which is the content of comparison.json."""

    first: ComparedRun
    second: ComparedRun
    comparison: RunComparison

    def write(self, folder: Path) -> Path:
        """Write comparison.json and compare.html to a folder; return the path of the page."""
        write_json(asdict(self.comparison), folder / "comparison.json")
        return write_comparison_page(folder, self.first, self.second, self.comparison)


def compare_runs(first: str | Path, second: str | Path) -> ComparedRuns:
    """Compare two runs by their logs or folders: curves, jumps, parameters, misfit.

    InputError for a run without summary.json.
    """
    runs = [_load_run(Path(path)) for path in (first, second)]
    return ComparedRuns(runs[0], runs[1], compare_summaries(*runs))


def print_compared_runs(first: Path, second: Path, as_json: bool, out: Path | None) -> None:
    """Print the comparison of two runs; write compare.html and comparison.json, unless as JSON.

    As JSON files are written only to `out`.
    """
    compared = compare_runs(first, second)
    if as_json:
        print(format_json(asdict(compared.comparison)))
    else:
        _print_comparison(compared.comparison)
    if as_json and out is None:
        return
    folder, _ = make_run_folder(out, "compare")
    page = compared.write(folder)
    if not as_json:
        print_line(f"{page}")


def _load_run(path: Path) -> ComparedRun:
    log = resolve_log_path(path)
    recording = read_recording(log, ())
    summary = RunSummary.read(log.parent / "summary.json", f"run `shaketwin report {log.parent}`")
    parameters = read_recorded_config(recording).model.flatten()
    return ComparedRun(log.parent, recording, summary, parameters)


def _print_comparison(comparison: RunComparison) -> None:
    table = Table(title="Two runs")
    for head in ("", "first", "second"):
        table.add_column(head)
    overviews = [asdict(run) for run in comparison.runs]
    for label, key in (("folder", "folder"), ("date", "started_at"), ("test", "title"),
                       ("model", "model"), ("test ended", "verdict"),
                       ("excitation", "excitation_verdict"), ("twin", "twin_verdict"),
                       ("warnings", "warnings")):  # fmt: skip
        cells = ["-" if row[key] is None else str(row[key]) for row in overviews]
        table.add_row(label, *cells)
    for channel, misfit in comparison.misfit.items():
        shares = ["-" if nrmse is None else f"{100 * nrmse:.3g} %" for nrmse in misfit.nrmse]
        table.add_row(f"misfit {channel}", *shares)
    for source, jumps in comparison.jumps.items():
        for jump in jumps:
            places = ["none" if p is None else f"{p[0]:g}-{p[1]:g} Hz" for p in jump.between_hz]
            table.add_row(f"{source} jump {jump.kind}, {jump.direction}", *places)
    for estimate in comparison.estimates:
        values = [
            format_quantity(value, estimate.unit, 2 * sd)
            for value, sd in zip(estimate.values, estimate.sd, strict=True)
        ]
        mark = f" (changed, {estimate.sigma:.2g} sigma)" if estimate.changed else ""
        table.add_row(estimate.name.replace("_", " ") + mark, *values)
    for parameter in comparison.model:
        if parameter.values[0] != parameter.values[1]:
            values = [format_quantity(v, parameter.unit, digits=5) for v in parameter.values]
            table.add_row(f"model {parameter.name}", *values)
    print_table(console, table)
