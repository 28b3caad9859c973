"""A run and its steps as rows of tables: columns of the catalogue, of `runs` and its page."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, get_args

Cell = str | float | list[str] | None  # of a table; a whole number or a truth is a number
Row = dict[str, Cell]


@dataclass(frozen=True, slots=True)
class RunRow:
    """A run; what neither its summary nor its recording states is None.

    `values` are numbers by column: parameters of the model in SI (`model_...`), estimates of the
    condition monitoring with their 95 % intervals (`stiffness`, `stiffness_low`, ...), and errors
    of the twin by channel (`nrmse_...`, `free_nrmse_...`). `problem`: why the rest is missing.
    """

    folder: str
    started_at: str | None = None
    test: str | None = None
    title: str | None = None
    source: str | None = None  # table or model
    gap_m: float | None = None
    verdict: str | None = None
    twin_verdict: str | None = None
    excitation_verdict: str | None = None
    misfit: float | None = None  # of u in multiples of the noise: median over the steps
    misfit_worst: float | None = None  # the same at the worst step
    nrmse: float | None = None  # of u, restarted twin
    warnings: int | None = None
    dropouts: int | None = None
    model: str | None = None
    problem: str | None = None
    note: str | None = None  # of notes.toml
    tags: tuple[str, ...] = ()
    run: str | None = None
    reason: str | None = None
    twin_reason: str | None = None
    gap_mm: float | None = None
    level_g: float | None = None  # largest level of the steps
    mass_kg: float | None = None
    temperature_c: float | None = None
    rig: str | None = None
    host: str | None = None
    code_version: str | None = None
    recorded_notes: str | None = None  # of the profile, before the test
    rate_hz: float | None = None
    duration_s: float | None = None
    steps: int | None = None
    steps_outside: int | None = None
    steps_apart: int | None = None
    jumps: int | None = None
    twin_jumps: int | None = None
    hysteresis: int | None = None
    excitation_error: float | None = None
    lost_samples: int | None = None
    faults: int | None = None
    trips: int | None = None
    u_star_m: float | None = None
    a_star_m_s2: float | None = None
    sha256: str | None = None  # of run.mcap; only in a catalogue
    summary_sha256: str | None = None
    files: str | None = None  # size and last change of the files, by which a change is noticed
    root: str | None = None  # folder that was catalogued, seen from the catalogue
    values: Mapping[str, float | None] | None = None

    def to_columns(self) -> Row:
        """Return the row by column."""
        row: Row = {name: getattr(self, name) for name in NAMES}
        row |= {alias: row[name] for alias, name in ALIASES.items()}
        return row | {"tags": [*self.tags]} | dict(self.values or {})

    @classmethod
    def from_columns(cls, row: Row) -> "RunRow":
        """Return the run of a row; columns that the class does not name are its `values`."""
        values: dict[str, Any] = dict(row)
        stated = {name: values.pop(name) for name in NAMES if name in values}
        for alias in ALIASES:
            values.pop(alias, None)
        stated["tags"] = tuple(stated.get("tags") or ())
        return cls(**stated, values=values)


def replace_nonfinite(row: Row) -> Row:
    """Return a row as JSON has it, without numbers that are not finite."""
    return {
        name: None if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in row.items()
    }


NAMES = tuple(field.name for field in fields(RunRow) if field.name != "values")
# Columns under a second name, as expressions are written.
ALIASES = {"twin_misfit": "misfit", "twin_misfit_worst": "misfit_worst"}
# Types of the columns in SQL; those that are not named hold numbers.
NUMBER_TYPE, LIST_TYPE = "DOUBLE", "VARCHAR[]"
SQL_TYPES = {str: "VARCHAR", int: "BIGINT"}
COLUMN_TYPES = {
    field.name: sql
    for field in fields(RunRow)
    for kind, sql in SQL_TYPES.items()
    if kind in (get_args(field.type) or (field.type,))
} | {"tags": LIST_TYPE}
STEP_TYPES = {
    "root": "VARCHAR", "folder": "VARCHAR", "run": "VARCHAR", "step": "BIGINT",
    "direction": "VARCHAR", "same_branch": "BOOLEAN",
}  # fmt: skip
