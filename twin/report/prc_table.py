"""Terminal table of the PRCs for `shaketwin prc`, followed by hysteresis intervals and jumps."""

from collections.abc import Callable

from rich.console import Console
from rich.table import Table

from twin.results.summary import Json
from twin.system.terminal import fits_width, print_table

Cell = Callable[[Json], str]  # formats a value of the "measured" or "twin" entry of a step


def _format_number(key: str) -> Cell:
    def cell(values: Json) -> str:
        value = values.get(key)
        return "-" if value is None else f"{value:.3f}"

    return cell


def _format_mean(key: str) -> Cell:
    def cell(values: Json) -> str:
        counts = values.get(key)
        return "-" if not counts else f"{sum(counts) / len(counts):.3g}"

    return cell


def _format_impacts(values: Json) -> str:
    return f"{_format_mean('impacts_right')(values)}/{_format_mean('impacts_left')(values)}"


COLUMNS: dict[str, Cell] = {
    "eta_d": _format_number("eta_d"), "eta_a": _format_number("eta_a"),
    "eta_R": _format_number("eta_r"), "eta_L": _format_number("eta_l"),
    "r_R": _format_number("r_r"), "r_L": _format_number("r_l"),
    "impacts R": _format_mean("impacts_right"), "impacts L": _format_mean("impacts_left"),
    "impacts R/L": _format_impacts,
}  # fmt: skip
ALL_COLUMNS = tuple(name for name in COLUMNS if name != "impacts R/L")
COLUMN_SETS = (ALL_COLUMNS, ("eta_d", "eta_a", "impacts R/L"), ("eta_d", "impacts R/L"), ("eta_d",))


def print_prc(console: Console, summary: Json) -> None:
    """Print the PRCs of a summary, measured | twin, then hysteresis intervals and jumps."""
    names = _fit_columns(console, summary)
    print_table(console, _build_table(summary, names))
    if names != ALL_COLUMNS:
        console.print(
            f"some columns do not fit into a width of {console.width}; "
            "use --json or widen the terminal",
            highlight=False,
        )
    for text in (*summary.get("found", ()), *_format_branches(summary)):
        console.print(text, highlight=False, soft_wrap=True)


def _fit_columns(console: Console, summary: Json) -> tuple[str, ...]:
    """Return the largest set of columns that fits the console width, or the smallest set."""
    return next(
        (columns for columns in COLUMN_SETS if fits_width(console, _build_table(summary, columns))),
        COLUMN_SETS[-1],
    )


def _build_table(summary: Json, names: tuple[str, ...]) -> Table:
    table = Table(title=f"{summary['run']['title']}: measured | twin")
    table.add_column("direction")
    for name in ("f [Hz]", *names):
        table.add_column(name, justify="right")
    for step in summary["steps"]:
        cells = [_format_pair(step, name) for name in names]
        table.add_row(step["direction"], f"{step['frequency_hz']:.3f}", *cells)
    return table


def _format_pair(step: Json, name: str) -> str:
    return " | ".join(COLUMNS[name](step[source] or {}) for source in ("measured", "twin"))


def _format_branches(summary: Json) -> list[str]:
    """Format one line per hysteresis interval and per jump."""
    lines = [
        f"{interval['kind']} hysteresis from {interval['from_hz']:g} to {interval['to_hz']:g} Hz"
        for interval in summary["hysteresis"]
    ] or ["no hysteresis of two or more grid frequencies"]
    return lines + [
        f"jump {jump['kind']}, {jump['direction']}, between {jump['from_hz']:g} and "
        f"{jump['to_hz']:g} Hz"
        for jump in summary["jumps"]
    ]
