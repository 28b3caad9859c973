"""batch.csv: one row a model, gap, direction and frequency."""

import csv
import math
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from table_io.card import BadInput
from table_io.records import Point
from twin.service.sweeps.cases import Case

Row = dict[str, str | float]

RATIOS = ("eta_d", "eta_a", "eta_r", "eta_l", "r_r", "r_l")
IMPACTS = ("impacts_right", "impacts_left")
COLUMNS = ("model", "gap_mm", "direction", "frequency_hz", *RATIOS, *IMPACTS)
WORDS = ("model", "direction")


def rows(case: Case, points: Sequence[Point]) -> Iterator[Row]:
    """A row for each point; impacts are means per cycle."""
    for point in points:
        if point.twin is not None:
            yield {
                "model": case.label,
                "gap_mm": case.gap_mm,
                "direction": point.direction,
                "frequency_hz": point.frequency_hz,
                **{name: getattr(point.twin, name) for name in RATIOS},
                **{name: _mean(getattr(point.twin, name)) for name in IMPACTS},
            }


def _mean(counts: tuple[int, ...]) -> float:
    return sum(counts) / len(counts) if counts else math.nan


class Table:
    """batch.csv in a folder, open; what is put into it is there, whatever comes after."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("x", newline="", encoding="utf-8")
        self._writer = csv.DictWriter(self._file, COLUMNS, lineterminator="\n")
        self._writer.writeheader()

    def put(self, rows: Iterable[Row]) -> None:
        self._writer.writerows(rows)
        self._file.flush()

    def __enter__(self) -> "Table":
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()


def read_rows(path: Path) -> list[Row]:
    """The rows of a batch.csv; BadInput where it is none."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            return [
                {name: row[name] if name in WORDS else float(row[name]) for name in COLUMNS}
                for row in csv.DictReader(file)
            ]
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise BadInput(
            f"{path}: not the table of a batch: {error!r}; give the folder that simulate wrote"
        ) from None
