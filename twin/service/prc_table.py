"""What `prc` prints: the curves as a table as wide as there is room, then jumps and hysteresis."""

from collections.abc import Callable

from rich.console import Console
from rich.table import Table

from twin.service.summary import Json
from twin.service.terminal import has_room, print_table

Cell = Callable[[Json], str]  # of a step's "measured" or "twin"


def _number(key: str) -> Cell:
    def cell(values: Json) -> str:
        value = values.get(key)
        return "-" if value is None else f"{value:.3f}"

    return cell


def _mean(key: str) -> Cell:
    def cell(values: Json) -> str:
        counts = values.get(key)
        return "-" if not counts else f"{sum(counts) / len(counts):.3g}"

    return cell


def _both(values: Json) -> str:
    return f"{_mean('impacts_right')(values)}/{_mean('impacts_left')(values)}"


COLUMNS: dict[str, Cell] = {
    "eta_d": _number("eta_d"), "eta_a": _number("eta_a"), "eta_R": _number("eta_r"),
    "eta_L": _number("eta_l"), "r_R": _number("r_r"), "r_L": _number("r_l"),
    "impacts R": _mean("impacts_right"), "impacts L": _mean("impacts_left"),
    "impacts R/L": _both,
}  # fmt: skip
ALL = tuple(name for name in COLUMNS if name != "impacts R/L")
FORMS = (ALL, ("eta_d", "eta_a", "impacts R/L"), ("eta_d", "impacts R/L"), ("eta_d",))


def print_prc(console: Console, found: Json) -> None:
    """The curves of a summary, measured | twin, then jumps and hysteresis."""
    names = _form(console, found)
    print_table(console, _table(found, names))
    if names != ALL:
        console.print(
            f"{console.width} columns are not enough for all of it: --json has it, and so has a "
            "wider terminal",
            highlight=False,
        )
    for text in (*found.get("found", ()), *_branches(found)):
        console.print(text, highlight=False, soft_wrap=True)


def _form(console: Console, found: Json) -> tuple[str, ...]:
    """The most columns for which there is room; the fewest where not even they have."""
    return next((one for one in FORMS if has_room(console, _table(found, one))), FORMS[-1])


def _table(found: Json, names: tuple[str, ...]) -> Table:
    table = Table(title=f"{found['run']['title']}: measured | twin")
    table.add_column("direction")
    for name in ("f [Hz]", *names):
        table.add_column(name, justify="right")
    for step in found["steps"]:
        cells = [_pair(step, name) for name in names]
        table.add_row(step["direction"], f"{step['frequency_hz']:.3f}", *cells)
    return table


def _pair(step: Json, name: str) -> str:
    return " | ".join(COLUMNS[name](step[who] or {}) for who in ("measured", "twin"))


def _branches(found: Json) -> list[str]:
    """A line for each hysteresis and each jump."""
    said = [
        f"{one['kind']} hysteresis from {one['from_hz']:g} to {one['to_hz']:g} Hz"
        for one in found["hysteresis"]
    ] or ["no hysteresis on this grid"]
    return said + [
        f"jump {one['kind']}, {one['direction']}, between {one['from_hz']:g} and "
        f"{one['to_hz']:g} Hz"
        for one in found["jumps"]
    ]
