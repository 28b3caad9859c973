"""Files of simulated sweeps: summary.json, and batch.csv with a row per point of each curve."""

import csv
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Literal

from pydantic import field_serializer

from table_io.errors import InputError
from table_io.records import RESPONSE_RATIOS
from twin.results.contract import Contract
from twin.results.contracts import HysteresisInterval, Jump

Row = dict[str, str | float]

IMPACT_COLUMNS = ("impacts_right", "impacts_left")
COLUMNS = ("model", "gap_mm", "direction", "frequency_hz", *RESPONSE_RATIOS, *IMPACT_COLUMNS)
TEXT_COLUMNS = ("model", "direction")
REMEDY = "give a folder written by simulate"


class SweepPoint(Contract):
    """A step of the sweep."""

    frequency_hz: float
    direction: str


class SweepPeak(SweepPoint):
    """The step of the largest eta_d."""

    eta_d: float


class CaseSummary(Contract):
    """Result of the sweep of a model at a total gap in mm; other values in SI.

    `peak`: None where no step is bounded; `unbounded_from`: the first step that is not.
    """

    model: str
    gap_mm: float
    u_star_m: float
    a_star_m_s2: float
    free_flight_hz: float
    peak: SweepPeak | None
    jumps: list[Jump]
    hysteresis: list[HysteresisInterval]
    unbounded_from: SweepPoint | None
    warnings: tuple[str, ...] = ()

    @field_serializer("gap_mm")
    def _name_gap(self, gap_mm: float) -> float | str:
        """Return "inf" without bumpers, as JSON has no infinity."""
        return gap_mm if math.isfinite(gap_mm) else "inf"

    def __str__(self) -> str:
        """Return the result in one line."""
        parts = []
        if self.peak:
            location = f"{self.peak.frequency_hz:g} Hz {self.peak.direction}"
            parts.append(f"largest eta_d {self.peak.eta_d:.3f} at {location}")
        parts += [
            f"{interval.kind} hysteresis {interval.from_hz:g} to {interval.to_hz:g} Hz"
            for interval in self.hysteresis
        ] or ["no hysteresis"]
        parts += [f"jump {jump.kind} {jump.from_hz:g} -> {jump.to_hz:g} Hz" for jump in self.jumps]
        if self.unbounded_from:
            point = self.unbounded_from
            parts.append(f"UNBOUNDED from {point.frequency_hz:g} Hz {point.direction}")
        return "; ".join(parts)


class SweepRun(Contract):
    """The test, and how its sweeps were simulated."""

    id: str
    name: str
    title: str
    source: str
    started_at: str
    host: str
    versions: dict[str, str]
    drive: str
    acceleration_m_s2: float
    cycles: int
    measured_cycles: int
    normalisation: str
    profile_toml: str
    workers: str
    seconds: float


class ModelText(Contract):
    """A model as it was given."""

    title: str
    toml: str


class SweepSummary(Contract):
    """summary.json of the sweeps of models at gaps."""

    run: SweepRun
    verdict: Literal["complete", "stopped"]
    reason: str
    models: dict[str, ModelText]
    cases: list[CaseSummary]


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
            f"not the table of a batch: {error!r}", where=path, remedy=REMEDY
        ) from None
