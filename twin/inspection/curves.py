"""`prc`: the response curves of a recording, or of every run of a campaign."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

from table_io.errors import InputError
from table_io.units import GRAVITY_M_S2
from twin.campaign import STATE_FILE
from twin.results.contract import format_json
from twin.results.contracts import Response, RunSummary, StepEntry
from twin.results.excitation_verdict import describe_peaks
from twin.results.recordings import open_recording, read_recorded_config
from twin.results.summary import summarise
from twin.system.terminal import console, fits_width, print_table

CURVE_KEYS = ("run", "u_star_m", "a_star_m_s2", "steps", "jumps", "hysteresis")


def _format_mean(counts: list[int]) -> str:
    return f"{sum(counts) / len(counts):.3g}" if counts else "-"


# How each column shows the response of specimen or twin.
COLUMNS: dict[str, Callable[[Response], str]] = {
    "eta_d": lambda response: f"{response.eta_d:.3f}",
    "eta_a": lambda response: f"{response.eta_a:.3f}",
    "eta_R": lambda response: f"{response.eta_r:.3f}",
    "eta_L": lambda response: f"{response.eta_l:.3f}",
    "r_R": lambda response: f"{response.r_r:.3f}",
    "r_L": lambda response: f"{response.r_l:.3f}",
    "impacts R": lambda response: _format_mean(response.impacts_right),
    "impacts L": lambda response: _format_mean(response.impacts_left),
    "impacts R/L": lambda response: (
        f"{_format_mean(response.impacts_right)}/{_format_mean(response.impacts_left)}"
    ),
}
LEVEL = "level, peak [g]"  # of the table: its fundamental, which is controlled, and its peak
ALL_COLUMNS = (LEVEL, *(name for name in COLUMNS if name != "impacts R/L"))
COLUMN_SETS = (
    ALL_COLUMNS,
    (LEVEL, "eta_d", "eta_a", "impacts R/L"),
    (LEVEL, "eta_d", "impacts R/L"),
    (LEVEL, "eta_d"),
    ("eta_d",),
)


def print_prc(console: Console, summary: RunSummary) -> None:
    """Print the PRCs of a summary, measured | twin, then hysteresis intervals and jumps."""
    names = _fit_columns(console, summary)
    print_table(console, _build_table(summary, names))
    if names != ALL_COLUMNS:
        console.print(
            f"some columns do not fit into a width of {console.width}; "
            "use --json or widen the terminal",
            highlight=False,
        )
    for text in (*summary.findings, *describe_peaks(summary.steps), *_format_branches(summary)):
        console.print(text, highlight=False, soft_wrap=True)


def _fit_columns(console: Console, summary: RunSummary) -> tuple[str, ...]:
    """Return the largest set of columns that fits the console width, or the smallest set."""
    return next(
        (columns for columns in COLUMN_SETS if fits_width(console, _build_table(summary, columns))),
        COLUMN_SETS[-1],
    )


def _build_table(summary: RunSummary, names: tuple[str, ...]) -> Table:
    table = Table(title=f"{summary.run.title}: measured | twin")
    table.add_column("direction")
    for name in ("f [Hz]", *names):
        table.add_column(name, justify="right")
    for step in summary.steps:
        cells = [_format_pair(step, name) for name in names]
        table.add_row(step.direction, f"{step.frequency_hz:.3f}", *cells)
    return table


def _format_pair(step: StepEntry, name: str) -> str:
    if name == LEVEL:
        levels = (step.table_acc_fundamental_m_s2, step.table_acc_peak_m_s2)
        return " | ".join(f"{level / GRAVITY_M_S2:.4f}" for level in levels).replace("nan", "-")
    cells = (
        COLUMNS[name](response or Response()).replace("nan", "-")
        for response in (step.measured, step.twin)
    )
    return " | ".join(cells)


def _format_branches(summary: RunSummary) -> list[str]:
    """Format one line per hysteresis interval and per jump."""
    lines = [
        f"{interval.kind} hysteresis from {interval.from_hz:g} to {interval.to_hz:g} Hz"
        for interval in summary.hysteresis
    ] or ["no hysteresis of two or more grid frequencies"]
    return lines + [
        f"jump {jump.kind}, {jump.direction}, between {jump.from_hz:g} and {jump.to_hz:g} Hz"
        for jump in summary.jumps
    ]


@dataclass(frozen=True, eq=False)
class RecordedCurves:
    """Summaries of the runs with curves, one by one; `is_campaign`: of those of a campaign."""

    runs: tuple[RunSummary, ...]
    is_campaign: bool

    def to_plain(self) -> Mapping[str, object]:
        """Return what `prc --json` prints."""
        curves = [{key: run.to_plain()[key] for key in CURVE_KEYS} for run in self.runs]
        return {"runs": curves} if self.is_campaign else curves[0]


def read_curves(log: str | Path) -> RecordedCurves:
    """Return the curves, jumps and hysteresis of a recording, or of every run of a campaign.

    InputError for a recording of a displacement history, which has no curves.
    """
    log = Path(log)
    if (log / STATE_FILE).is_file():
        from twin.campaign.summary import read_campaign  # it draws

        runs = (run.summary for run in read_campaign(log).runs if run.profile.steps)
        return RecordedCurves(tuple(runs), is_campaign=True)
    recording = open_recording(log)
    if not recording.start.steps:
        raise InputError(
            "a test without steps has no curves over frequency",
            where=recording.path,
            allowed="recordings of a stepped sine",
            remedy="see the windows in summary.json, or in report.html by `shaketwin report`",
        )
    summary = summarise(recording, read_recorded_config(recording).parameters)
    return RecordedCurves((summary,), is_campaign=False)


def print_curves(log: Path, as_json: bool) -> None:
    """Print the PRC of a recording, or of every run of a campaign, as a table or JSON."""
    curves = read_curves(log)
    if as_json:
        print(format_json(curves.to_plain()))
        return
    for run in curves.runs:
        print_prc(console, run)
