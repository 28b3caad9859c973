"""Column mapping of an imported table: to channels in SI and sample indices.

Units are declared, never inferred. Numbers that are absurd in a unit which nobody stated are
refused; in a stated unit they cause a warning.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from pydantic import Field, field_validator

from table_io.block import Float1D, Int1D
from table_io.channels import (
    CHANNEL_BY_NAME,
    RELATIVE_DISP,
    RELATIVE_DISP_SOURCES,
    TIME_COLUMN,
    Channel,
)
from table_io.config.base import ConfigModel, Finite, Number, Positive
from table_io.errors import InputError, suggest
from table_io.formats import MAX_LISTED_COLUMNS
from table_io.formats.table import ForeignTable
from table_io.formats.timing import (
    SAMPLE_UNIT,
    align_starts,
    check_unused_times,
    resolve_times,
)
from table_io.formats.words import TIME_UNITS, normalize_unit
from table_io.records import SampleGap
from table_io.units import UNITS
from twin.compare.quality import ChannelDoubt, describe_gaps, find_bad_samples, find_doubts
from twin.exchange.integration import (
    EXTERNAL_FORCE,
    convert_external_force,
    integrate_accelerations,
)
from twin.exchange.plausibility import list_implausible
from twin.recording.tabular import LABEL_UNITS, TWIN_PREFIX, UNIX_TIME_COLUMN

MAX_SAMPLES_PER_ROW = 10  # beyond, the rows are not one recording


class ColumnSource(ConfigModel):
    """Source column of a channel: value in SI = column * gain * unit + offset (in SI).

    A unit stated in the file must equal `unit`. Where `gain` converts it, or the file is wrong,
    `file_unit` must repeat the unit stated in the file.
    """

    column: str = Field(description="Name of the column in the file.")
    unit: str = Field("", description="Unit of the column; empty: SI.")
    file_unit: str | None = Field(
        None, description="Unit stated in the file, where it is not `unit`."
    )
    gain: Finite = Field(1.0, description="Factor on the column.")
    offset: Finite = Field(0.0, description="Added after scaling, in SI.")
    trusted: bool = Field(
        False, description="Its samples are right as they are, whatever they look like."
    )

    @field_validator("gain")
    @classmethod
    def _check_gain(cls, gain: float) -> float:
        if gain == 0:
            raise ValueError("gain is 0, so the channel would be constant; allowed: not 0")
        return gain

    def to_si(self, name: str, values: Float1D, factors: Mapping[str, float]) -> Float1D:
        """Return the channel in SI, (row,); bit-identical without gain, unit and offset.

        `factors` are those of the allowed units.
        """
        with np.errstate(all="ignore"):  # no warnings for signaling NaNs
            scaled = self.gain * factors.get(self.unit, 1.0) * values
            scaled = scaled + self.offset if self.offset else scaled
        if np.isinf(scaled).any():
            raise InputError(
                f"{self.column!r} becomes infinite", where=name, remedy="correct gain and offset"
            )
        return scaled


class ColumnMap(ConfigModel):
    """Column map: the content of a --columns file."""

    group: str = Field("", description="Group, structure or folder inside the file.")
    rate_hz: Positive | None = Field(None, description="Sampling rate of a file without times.")
    mass_kg: Positive | None = Field(None, description="Moving mass; a component test has none.")
    gap_mm: Number | None = Field(
        None, gt=-math.inf, description="Gap, right plus left; inf = no bumpers."
    )
    from_s: Finite | None = Field(None, description="First time of the file that is imported.")
    to_s: Finite | None = Field(None, description="Last time of the file that is imported.")
    rest: bool | None = Field(
        None,
        description="Still parts are at rest, at zero; by default, but for a component test that "
        "stands still off its zero.",
    )
    detrend: Literal["", "mean", "line"] = Field("", description="Remove it from each channel.")
    integrate_hz: tuple[Positive, Positive] | None = Field(
        None, description="Band in which rel_disp_m is integrated from the accelerations."
    )
    columns: dict[str, ColumnSource] = Field(default_factory=dict)

    @field_validator("integrate_hz")
    @classmethod
    def _check_band(cls, band: tuple[float, float] | None) -> tuple[float, float] | None:
        if band is not None and not band[0] < band[1]:
            raise InputError("not a band", value=list(band), allowed="[LOW, HIGH] with LOW < HIGH")
        return band


@dataclass(frozen=True)
class ImportColumns:
    """Columns that an import knows: channels of the rig, time, labels and an external force."""

    channels: Mapping[str, Channel]

    @property
    def names(self) -> tuple[str, ...]:
        return (TIME_COLUMN, *self.channels, EXTERNAL_FORCE, *LABEL_UNITS)

    def recorded_unit(self, name: str) -> str:
        """Return the unit in which a column is recorded, "" without one."""
        units = {TIME_COLUMN: "s", EXTERNAL_FORCE: "N", **LABEL_UNITS}
        return self.channels[name].unit if name in self.channels else units[name]

    def unit_factors(self, name: str) -> dict[str, float]:
        """Return the allowed units of a column and their factors to SI."""
        if name == TIME_COLUMN:
            return {**TIME_UNITS, SAMPLE_UNIT: 1.0}
        si = self.recorded_unit(name)
        return {unit: factor for unit, (si_unit, factor) in UNITS.items() if si_unit == si} or (
            {si: 1.0} if si else {}
        )

    def check_map(self, column_map: ColumnMap) -> None:
        """Raise InputError for a mapped name that is no column, or a unit that does not fit."""
        for name, column in column_map.columns.items():
            if name not in self.names:
                raise InputError(
                    f"{name!r} is not a channel; {suggest(name, self.names)}",
                    where="column map",
                    key="columns",
                    remedy="other channels are declared by [[channels]] in a rig file, see --table",
                )
            allowed = self.unit_factors(name)
            if column.unit and column.unit not in allowed:
                raise InputError(
                    f"{name}: unit {column.unit!r} does not fit",
                    where="column map",
                    key="columns",
                    allowed=", ".join(allowed) or "none",
                )


CANONICAL_COLUMNS = ImportColumns(CHANNEL_BY_NAME)


@dataclass(frozen=True, eq=False)
class ImportedSamples:
    """Imported channels in SI, (row,) each, and the rising sample index of each row.

    `labels` are the columns of LABEL_UNITS, all or none. `bad` samples are NaN in the channels;
    `doubts` say what makes channels impossible.
    """

    rate_hz: float
    index: Int1D
    channels: dict[str, Float1D]
    notes: tuple[str, ...]
    labels: dict[str, Float1D] = field(default_factory=dict)
    bad: tuple[SampleGap, ...] = ()
    doubts: tuple[ChannelDoubt, ...] = ()

    def to_grid(self, values: Float1D) -> Float1D:
        """Return values, (row,), on the uniform time grid, (sample,); NaN in the holes."""
        grid = np.full(int(self.index[-1]) + 1, np.nan)
        grid[self.index] = values
        return grid


def read_samples(
    table: ForeignTable,
    column_map: ColumnMap | None,
    known: ImportColumns = CANONICAL_COLUMNS,
    *,
    leave_out: bool | None = None,
) -> ImportedSamples:
    """Convert a table to samples; raise InputError for unknown columns or nonuniform time.

    `leave_out`: unknown columns are left out, else refused; by default as far as there is a map.
    """
    if column_map is not None:
        known.check_map(column_map)
    if leave_out is None:
        leave_out = column_map is not None
    sources, notes = _select_columns(table, column_map, known, leave_out)
    for name, column in sources.items():
        _check_unit(table, name, column, known.recorded_unit(name))
    table.check_size([source.column for source in sources.values()])
    infos = [table.columns[source.column] for source in sources.values()]
    stated_hz = column_map.rate_hz if column_map is not None else None
    rows, size, length_notes = _find_common_rows(table, sources)
    notes += length_notes
    values = {
        name: source.to_si(
            name,
            table.read_column(source.column)[first : first + size],
            _find_factors(source, known.unit_factors(name), stated_hz),
        )
        for (name, source), first in zip(sources.items(), rows, strict=True)
    }
    if _is_derived_disp(values):  # of an export of ours
        del values[RELATIVE_DISP]
        notes.append(f"left out: {RELATIVE_DISP}; it is the difference of two other channels")
    time = values.pop(TIME_COLUMN, None)
    if time is None:
        time = _read_clock(table, sources, size)
    if time is None and stated_hz is not None:
        check_unused_times(table, size, stated_hz)
    times = resolve_times(time, table, infos, stated_hz)
    if column_map is not None and (column_map.from_s, column_map.to_s) != (None, None):
        seconds = time if time is not None else times.start_s + times.index / times.rate_hz
        part, note = _select_rows(table, column_map, seconds)
        values = {name: column[part] for name, column in values.items()}
        times = resolve_times(time[part] if time is not None else None, table, infos, stated_hz)
        times = replace(times, index=times.index[: part.stop - part.start])
        notes.append(note)
    rate, index = times.rate_hz, times.index[: next(iter(values.values())).size]
    force = values.pop(EXTERNAL_FORCE, None)
    channels = {name: values[name] for name in known.channels if name in values}
    if force is not None:
        mass_kg = column_map.mass_kg if column_map is not None else None
        channels |= convert_external_force(channels, force, mass_kg)
        channels = {name: channels[name] for name in known.channels if name in channels}
        notes.append(f"{EXTERNAL_FORCE} on the mass is recorded as a table acceleration, -F / M")
    notes += times.notes
    missing = [name for name in known.channels if name not in channels]
    notes.append(f"not in the file: {', '.join(missing)}")
    notes += [f"{name}: all samples lost" for name in channels if np.isnan(channels[name]).all()]
    labels = {name: values[name] for name in LABEL_UNITS if name in values}
    samples = ImportedSamples(rate, index, channels, (*table.notes, *notes), labels)
    if not (table.texts or labels):  # an export of ours keeps every bit
        samples = _judge_quality(samples, table, sources)
    warnings, absurd = _check_plausibility(table, sources, samples.channels, known, rate)
    samples = replace(samples, notes=(*samples.notes, *warnings), doubts=(*samples.doubts, *absurd))
    return condition_samples(samples, column_map) if column_map is not None else samples


def _is_derived_disp(values: Mapping[str, Float1D]) -> bool:
    """Return whether `rel_disp_m` is computed from the displacements of mass and table."""
    mass_disp, table_disp = (values.get(source) for source in RELATIVE_DISP_SOURCES)
    derived = values.get(RELATIVE_DISP)
    return (
        derived is not None
        and mass_disp is not None
        and table_disp is not None
        and np.array_equal(derived, mass_disp - table_disp, equal_nan=True)
    )


def _read_clock(table: ForeignTable, sources: dict[str, ColumnSource], size: int) -> Float1D | None:
    """Return the times in s, (row,), stored with the columns; None if some have none."""
    clocks = {table.columns[source.column].clock for source in sources.values()}
    if "" in clocks:
        return None
    first, *rest = (table.read_column(clock)[:size] for clock in sorted(clocks))
    if any(not np.array_equal(first, other) for other in rest):
        raise InputError(
            "the columns have different sampling times",
            where=table.path,
            remedy="import them one by one",
        )
    return first


def is_added_column(name: str) -> bool:
    """Return True for a column that a table of a log has in addition to time and channels."""
    return name in (*LABEL_UNITS, UNIX_TIME_COLUMN) or name.startswith(TWIN_PREFIX)


def _select_columns(
    table: ForeignTable, column_map: ColumnMap | None, known: ImportColumns, leave_out: bool
) -> tuple[dict[str, ColumnSource], list[str]]:
    """Select the source of each channel, by the map and by name; return (sources, notes)."""
    mapped = dict(column_map.columns) if column_map is not None else {}
    for name, column in mapped.items():
        if column.column not in table.columns:
            raise _missing_column_error(table, name, column.column)
    used = {column.column for column in mapped.values()}
    left_out, twins = [], 0
    for name in table.columns:
        if name in used or name in mapped or name == UNIX_TIME_COLUMN:
            continue
        if name.startswith(TWIN_PREFIX):
            twins += 1
        elif name in known.names:
            mapped[name] = ColumnSource(column=name)
        elif not leave_out:
            raise InputError(
                f"column {name!r} is unknown; {suggest(name, known.names)}",
                where=table.path,
                remedy="`import FILE` without -o proposes a map; or map the columns with --columns "
                "MAP (others are left out), or declare it by [[channels]] in a rig file and give "
                "that by --table",
            )
        else:
            left_out.append(name)
    present_labels = [name for name in LABEL_UNITS if name in mapped]
    if len(present_labels) < len(LABEL_UNITS):
        left_out += [mapped.pop(name).column for name in present_labels]
    if not mapped.keys() & known.channels.keys():
        raise InputError(
            f"no channel in it; its columns: {abbreviate([*table.columns])}",
            where=table.path,
            allowed=f"one or more of {', '.join(known.channels)}",
        )
    notes = [
        f"{name} = column {source.column!r}"
        for name, source in mapped.items()
        if source.column != name
    ]
    left_out += [
        f"{name} ({why})" for name, why in table.dropped.items() if name not in table.texts
    ]
    notes += [f"left out: {abbreviate(left_out)}"] if left_out else []
    notes += [f"left out: {twins} columns of a twin; it is recomputed"] if twins else []
    return mapped, notes


def _missing_column_error(table: ForeignTable, name: str, column: str) -> InputError:
    if column in table.dropped:
        return InputError(
            f"{column!r}, mapped to {name}, cannot be imported: {table.dropped[column]}",
            where=table.path,
        )
    return InputError(
        f"no column {column!r} for {name}",
        where=table.path,
        remedy=suggest(column, table.columns),
    )


def abbreviate(names: list[str]) -> str:
    """Return the first names of a list, and how many more."""
    more = (
        f" and {len(names) - MAX_LISTED_COLUMNS} more (all: --list)"
        if len(names) > MAX_LISTED_COLUMNS
        else ""
    )
    return ", ".join(names[:MAX_LISTED_COLUMNS]) + more


def _check_unit(table: ForeignTable, name: str, column: ColumnSource, recorded_unit: str) -> None:
    """Raise InputError if the unit in the file differs from that of the map or channel."""
    file_unit = table.columns[column.column].unit
    if not file_unit or (column.file_unit is not None and column.file_unit == file_unit):
        return
    stated = column.file_unit or column.unit or recorded_unit
    if normalize_unit(file_unit) == stated:
        return
    declared_by = "the map" if column.file_unit or column.unit else "its name"
    raise InputError(
        f"column {column.column!r} is in {file_unit!r} by the file, {name} in {stated!r} by "
        f"{declared_by}",
        where=table.path,
        remedy=f"state unit = ... in a --columns file, or file_unit = {file_unit!r} if a gain "
        "converts it",
    )


def _find_factors(
    source: ColumnSource, factors: dict[str, float], stated_hz: float | None
) -> dict[str, float]:
    """Return the factors to SI of a column, with that of a count of samples at a stated rate."""
    if source.unit != SAMPLE_UNIT:
        return factors
    if stated_hz is None:
        raise InputError(
            f"column {source.column!r} counts samples, and no rate is stated",
            key="rate_hz",
            remedy="state rate_hz in the map, or --rate HZ",
        )
    return {SAMPLE_UNIT: 1.0 / stated_hz}


def _find_common_rows(
    table: ForeignTable, sources: dict[str, ColumnSource]
) -> tuple[list[int], int, list[str]]:
    """Return (first row of each column, rows that all have from there, notes); InputError if no
    rate tells that they are the same rows."""
    columns = [table.columns[source.column] for source in sources.values()]
    firsts = align_starts(table, columns)
    sizes = [column.size - first for column, first in zip(columns, firsts, strict=True)]
    size = min(sizes)
    lengths = abbreviate(
        [f"{source.column}: {c.size}" for source, c in zip(sources.values(), columns, strict=True)]
    )
    notes = []
    if any(firsts):
        starts = sorted({column.start_s for column in columns})
        notes.append(
            f"warning: the columns start at {starts[0]:.9g} to {starts[-1]:.9g} s: their common "
            f"part of {size} samples is taken"
        )
    elif size < max(sizes):
        times = {(column.rate_hz, bool(column.clock)) for column in columns}
        if len(times) > 1 or None in next(iter(times)):
            raise InputError(
                f"{table.kind}; columns of different length ({lengths})",
                where=table.path,
                remedy="select those of one recording by `group` in a --columns file, or one by "
                "one",
            )
        text = f"warning: columns of different length ({lengths}): the first {size} are taken"
        notes.append(text)
    return firsts, size, notes


def _select_rows(table: ForeignTable, column_map: ColumnMap, time: Float1D) -> tuple[slice, str]:
    """Return (rows from `from_s` to `to_s`, note); raise InputError if none is between them."""
    first_s = -np.inf if column_map.from_s is None else column_map.from_s
    last_s = np.inf if column_map.to_s is None else column_map.to_s
    inside = np.flatnonzero((time >= first_s) & (time <= last_s))
    if not inside.size:
        raise InputError(
            f"no sample from {first_s:g} to {last_s:g} s",
            where=table.path,
            key="--from, --to",
            allowed=f"{time[0]:g} to {time[-1]:g} s",
        )
    rows = slice(int(inside[0]), int(inside[-1]) + 1)
    return rows, f"only {time[rows.start]:.6g} to {time[rows.stop - 1]:.6g} s of the file"


def _judge_quality(
    samples: ImportedSamples, table: ForeignTable, sources: Mapping[str, ColumnSource]
) -> ImportedSamples:
    """Return the samples without the bad ones, with what makes their channels impossible."""
    size, rate_hz = int(samples.index[-1]) + 1, samples.rate_hz
    if size > MAX_SAMPLES_PER_ROW * samples.index.size:
        raise InputError(
            f"{samples.index.size} rows over {size / rate_hz:.6g} s at {rate_hz:g} Hz: most "
            "samples are missing",
            where=table.path,
            remedy="import its parts one by one",
        )
    channels = {
        name: samples.to_grid(values)
        for name, values in samples.channels.items()
        if not (name in sources and sources[name].trusted)
    }
    bad = find_bad_samples(channels)
    lines = [f"warning: {line}" for line in describe_gaps(bad, channels)]
    for gap in bad:
        channels[gap.channel][gap.index : gap.end] = np.nan
    cleaned = {name: values[samples.index] for name, values in channels.items()}
    return replace(
        samples,
        channels={**samples.channels, **cleaned},
        notes=(*samples.notes, *lines),
        bad=(*bad,),
        doubts=(*find_doubts(channels, rate_hz),),
    )


def _check_plausibility(
    table: ForeignTable,
    sources: dict[str, ColumnSource],
    channels: dict[str, Float1D],
    known: ImportColumns,
    rate_hz: float,
) -> tuple[list[str], list[ChannelDoubt]]:
    """Return (warnings, doubts) of absurd numbers in stated units; InputError where none is."""
    units = {name: known.recorded_unit(name) for name in channels}
    warnings: list[str] = []
    doubts: list[ChannelDoubt] = []
    channels = {
        name: values
        for name, values in channels.items()
        if name in sources and not sources[name].trusted
    }
    for implausible in list_implausible(channels, units, rate_hz):
        unstated = [
            sources[name].column
            for name in implausible.channels
            if not (
                sources[name].unit
                or sources[name].gain != 1.0
                or table.columns[sources[name].column].unit
            )
        ]
        if unstated and not implausible.is_possible:
            raise InputError(
                f"{implausible.problem}; the unit of {', '.join(unstated)} is nowhere stated",
                where=table.path,
                key=implausible.channels[0],
                allowed=", ".join(known.unit_factors(implausible.channels[0])),
                remedy="state unit = ... in a --columns file, also if the numbers are right",
            )
        warnings.append(f"warning: {implausible.problem}; check the units in the map")
        if len(implausible.channels) == 1 and not implausible.is_possible:
            doubts.append(
                ChannelDoubt("unit", implausible.channels, implausible.problem, "correct its unit")
            )
    return warnings, doubts


def condition_samples(samples: ImportedSamples, column_map: ColumnMap) -> ImportedSamples:
    """Return the samples detrended, and integrated, as the map demands, with notes."""
    channels, notes = dict(samples.channels), [*samples.notes]
    if column_map.detrend:
        degree = 0 if column_map.detrend == "mean" else 1
        channels = {
            name: _remove_trend(values, samples.index, degree) for name, values in channels.items()
        }
        notes.append(f"{column_map.detrend} removed from every channel")
    if column_map.integrate_hz is not None:
        channels, note = integrate_accelerations(
            channels, samples.index, samples.rate_hz, column_map.integrate_hz
        )
        notes.append(note)
    return replace(samples, channels=channels, notes=tuple(notes))


def _remove_trend(values: Float1D, index: Int1D, degree: int) -> Float1D:
    """Return the channel less its mean or its straight line, (row,)."""
    is_finite = np.isfinite(values)
    if is_finite.sum() <= degree:
        return values
    line = np.polynomial.Polynomial.fit(index[is_finite], values[is_finite], degree)
    detrended: Float1D = values - line(index)
    return detrended
