"""batch.csv: one row per model, gap, direction and frequency."""

import csv
import math
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from table_io.errors import InputError
from table_io.records import PrcPoint
from twin.studies.cases import StudyCase

Row = dict[str, str | float]

RATIO_COLUMNS = ("eta_d", "eta_a", "eta_r", "eta_l", "r_r", "r_l")
IMPACT_COLUMNS = ("impacts_right", "impacts_left")
COLUMNS = ("model", "gap_mm", "direction", "frequency_hz", *RATIO_COLUMNS, *IMPACT_COLUMNS)
TEXT_COLUMNS = ("model", "direction")


def make_rows(case: StudyCase, points: Sequence[PrcPoint]) -> Iterator[Row]:
    """Yield a row per PRC point; impacts are means per cycle."""
    for point in points:
        if point.twin is not None:
            yield {
                "model": case.label,
                "gap_mm": case.gap_mm,
                "direction": point.direction,
                "frequency_hz": point.frequency_hz,
                **{name: getattr(point.twin, name) for name in RATIO_COLUMNS},
                **{name: _mean_impacts(getattr(point.twin, name)) for name in IMPACT_COLUMNS},
            }


def _mean_impacts(counts: tuple[int, ...]) -> float:
    return sum(counts) / len(counts) if counts else math.nan


class BatchTable:
    """Writer of batch.csv; rows are flushed at once, so that an interrupted batch keeps them."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("x", newline="", encoding="utf-8")
        self._writer = csv.DictWriter(self._file, COLUMNS, lineterminator="\n")
        self._writer.writeheader()

    def write(self, rows: Iterable[Row]) -> None:
        self._writer.writerows(rows)
        self._file.flush()

    def __enter__(self) -> "BatchTable":
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()


def read_batch_rows(path: Path) -> list[Row]:
    """Read the rows of a batch.csv; raise InputError if it is not one."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            return [
                {name: row[name] if name in TEXT_COLUMNS else float(row[name]) for name in COLUMNS}
                for row in csv.DictReader(file)
            ]
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"not the table of a batch: {error!r}",
            where=path,
            remedy="give a folder written by simulate",
        ) from None
