"""Terminal table of the PRCs for `shaketwin prc`, followed by hysteresis intervals and jumps."""

from collections.abc import Callable

from rich.console import Console
from rich.table import Table

from table_io.units import GRAVITY_M_S2
from twin.results.contracts import Response, RunSummary, StepEntry
from twin.results.excitation_verdict import describe_peaks
from twin.system.terminal import fits_width, print_table


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
