"""Column mapping of an imported table: to channels in SI and sample indices.

Units are declared, never inferred; a unit that looks wrong causes a warning only.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from pydantic import Field, ValidationInfo, field_validator

from table_io.block import Float1D, Int1D
from table_io.channels import CHANNEL_BY_NAME, Channel
from table_io.config.base import ConfigModel, Finite, Positive, load_config
from table_io.errors import InputError, suggest
from table_io.units import GRAVITY_M_S2, UNITS
from twin.exchange.formats import MAX_LISTED_COLUMNS, SampleTable, check_size
from twin.exchange.sampling import fit_uniform_rate, resolve_stated_rate
from twin.recording.tabular import LABEL_UNITS, TIME_COLUMN, TWIN_PREFIX

UNIT_SPELLINGS = {
    "meter": "m", "meters": "m", "metre": "m", "metres": "m",
    "millimeter": "mm", "millimetre": "mm",
    "m/s/s": "m/s2", "ms-2": "m/s2", "m*s-2": "m/s2", "gn": "g", "newton": "N", "newtons": "N",
    "n": "N", "kn": "kN", "°c": "degC", "degc": "degC", "celsius": "degC",
    "sec": "s", "second": "s", "seconds": "s", "hz": "Hz",
}  # fmt: skip
TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6}
SUSPECT_FACTORS = {1e3: "1000", 1e-3: "1/1000", GRAVITY_M_S2: "g", 1 / GRAVITY_M_S2: "1/g"}
RELATIVE_ACC = "mass_acc_m_s2 - table_acc_m_s2"
DERIVATIVE_PAIRS = (
    ("table_disp_m", "table_acc_m_s2"),
    ("mass_disp_m", "mass_acc_m_s2"),
    ("rel_disp_m", RELATIVE_ACC),
)


class ColumnSource(ConfigModel):
    """Source column of a channel: value in SI = column * gain * unit + offset (in SI).

    A unit stated in the file must equal `unit`. Where `gain` converts it, or the file is wrong,
    `file_unit` must repeat the unit stated in the file.
    """

    column: str
    unit: str = ""
    file_unit: str | None = None
    gain: Finite = 1.0
    offset: Finite = 0.0

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
    columns: dict[str, ColumnSource] = Field(default_factory=dict)

    @field_validator("columns")
    @classmethod
    def _check_columns(
        cls, columns: dict[str, ColumnSource], info: ValidationInfo
    ) -> dict[str, ColumnSource]:
        if TIME_COLUMN in columns and info.data.get("rate_hz") is not None:
            raise ValueError(f"{TIME_COLUMN} and rate_hz both state the sampling times; keep one")
        return columns


@dataclass(frozen=True)
class ImportColumns:
    """Columns that an import knows: the channels of the rig, the time and the labels."""

    channels: Mapping[str, Channel]

    @property
    def names(self) -> tuple[str, ...]:
        return (TIME_COLUMN, *self.channels, *LABEL_UNITS)

    def recorded_unit(self, name: str) -> str:
        """Return the unit in which a column is recorded, "" without one."""
        units = {TIME_COLUMN: "s", **LABEL_UNITS}
        return self.channels[name].unit if name in self.channels else units[name]

    def unit_factors(self, name: str) -> dict[str, float]:
        """Return the allowed units of a column and their factors to SI."""
        if name == TIME_COLUMN:
            return TIME_UNITS
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
                    remedy="other channels are declared by [[channels]] in a rig file, see --rig",
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

    `labels` are the columns of LABEL_UNITS, all or none.
    """

    rate_hz: float
    index: Int1D
    channels: dict[str, Float1D]
    notes: tuple[str, ...]
    labels: dict[str, Float1D] = field(default_factory=dict)


def read_samples(
    table: SampleTable, column_map: ColumnMap | None, known: ImportColumns = CANONICAL_COLUMNS
) -> ImportedSamples:
    """Convert a table to samples; raise InputError for unknown columns or nonuniform time."""
    if column_map is not None:
        known.check_map(column_map)
    sources, notes = _select_columns(table, column_map, known)
    for name, column in sources.items():
        _check_unit(table, name, column, known.recorded_unit(name))
    _check_lengths(table, sources)
    values = {
        name: column.to_si(name, table.read_column(column.column), known.unit_factors(name))
        for name, column in sources.items()
    }
    time = values.pop(TIME_COLUMN, _read_file_time(table, sources, column_map))
    order = [name for name in known.channels if name in values]
    channels = {name: values[name] for name in order}
    if time is not None:
        rate, index, rate_notes = fit_uniform_rate(time, table)
        notes += rate_notes
    else:
        infos = [table.columns[column.column] for column in sources.values()]
        rate, rate_notes = resolve_stated_rate(
            table, infos, column_map.rate_hz if column_map is not None else None
        )
        index = np.arange(infos[0].size)
        notes += rate_notes
    missing = [name for name in known.channels if name not in channels]
    notes.append(f"not in the file: {', '.join(missing)}")
    notes += [f"{name}: all samples lost" for name in order if np.isnan(channels[name]).all()]
    labels = {name: values[name] for name in LABEL_UNITS if name in values}
    return ImportedSamples(
        rate, index, channels, (*table.notes, *notes, *_find_suspect_units(channels, rate)), labels
    )


def _read_file_time(
    table: SampleTable, sources: dict[str, ColumnSource], column_map: ColumnMap | None
) -> Float1D | None:
    """Return the times in s, (row,), stored with the columns; None if absent or overridden."""
    clocks = {table.columns[column.column].clock for column in sources.values()}
    if (
        "" in clocks
        or TIME_COLUMN in sources
        or (column_map is not None and column_map.rate_hz is not None)
    ):
        return None
    first, *rest = (table.read_column(clock) for clock in sorted(clocks))
    if any(not np.array_equal(first, other) for other in rest):
        raise InputError(
            "the columns have different sampling times",
            where=table.path,
            remedy="import them one by one",
        )
    return first


def _select_columns(
    table: SampleTable, column_map: ColumnMap | None, known: ImportColumns
) -> tuple[dict[str, ColumnSource], list[str]]:
    """Select the source of each channel, by the map and by name; return (sources, notes)."""
    mapped = dict(column_map.columns) if column_map is not None else {}
    for name, column in mapped.items():
        if column.column not in table.columns:
            raise _missing_column_error(table, name, column.column)
    used = {column.column for column in mapped.values()}
    left_out, twins = [], 0
    for name in table.columns:
        if name in used or name in mapped:
            continue
        if name.startswith(TWIN_PREFIX):
            twins += 1
        elif name in known.names and (
            name != TIME_COLUMN or column_map is None or column_map.rate_hz is None
        ):
            mapped[name] = ColumnSource(column=name)
        elif column_map is None:
            raise InputError(
                f"column {name!r} is unknown; {suggest(name, known.names)}",
                where=table.path,
                remedy="rename it, map the columns with --columns MAP (others are left out), or "
                "declare it by [[channels]] in a rig file and give that by --rig",
            )
        else:
            left_out.append(name)
    present_labels = [name for name in LABEL_UNITS if name in mapped]
    if len(present_labels) < len(LABEL_UNITS):
        left_out += [mapped.pop(name).column for name in present_labels]
    if not mapped.keys() & known.channels.keys():
        raise InputError(
            f"no channel in it; its columns: {_abbreviate([*table.columns])}",
            where=table.path,
            allowed=f"one or more of {', '.join(known.channels)}",
        )
    notes = [
        f"{name} = column {source.column!r}"
        for name, source in mapped.items()
        if source.column != name
    ]
    notes += [f"left out: {_abbreviate(left_out)}"] if left_out else []
    notes += [f"left out: {twins} columns of a twin; it is recomputed"] if twins else []
    return mapped, notes


def _missing_column_error(table: SampleTable, name: str, column: str) -> InputError:
    if column in table.skipped:
        return InputError(
            f"{column!r}, mapped to {name}, cannot be imported: {table.skipped[column]}",
            where=table.path,
        )
    return InputError(
        f"no column {column!r} for {name}",
        where=table.path,
        remedy=suggest(column, table.columns),
    )


def _abbreviate(names: list[str]) -> str:
    more = (
        f" and {len(names) - MAX_LISTED_COLUMNS} more (all: --list)"
        if len(names) > MAX_LISTED_COLUMNS
        else ""
    )
    return ", ".join(names[:MAX_LISTED_COLUMNS]) + more


def _check_unit(table: SampleTable, name: str, column: ColumnSource, recorded_unit: str) -> None:
    """Raise InputError if the unit in the file differs from that of the map or channel."""
    file_unit = table.columns[column.column].unit
    if not file_unit or (column.file_unit is not None and column.file_unit == file_unit):
        return
    stated = column.file_unit or column.unit or recorded_unit
    if _normalize_unit(file_unit) == stated:
        return
    declared_by = "the map" if column.file_unit or column.unit else "its name"
    raise InputError(
        f"column {column.column!r} is in {file_unit!r} by the file, {name} in {stated!r} by "
        f"{declared_by}",
        where=table.path,
        remedy=f"state unit = ... in a --columns file, or file_unit = {file_unit!r} if a gain "
        "converts it",
    )


def _normalize_unit(unit: str) -> str:
    """Return the unit in canonical spelling if it is known."""
    text = unit.strip().replace("²", "2").replace("µ", "u").replace("μ", "u")
    for character in ("^", "**", " ", "(", ")", "[", "]"):
        text = text.replace(character, "")
    return UNIT_SPELLINGS.get(text.lower(), text)


def _check_lengths(table: SampleTable, sources: dict[str, ColumnSource]) -> None:
    """Raise InputError if the columns differ in length or exceed the size limit."""
    sizes = {column.column: table.columns[column.column].size for column in sources.values()}
    if len(set(sizes.values())) > 1:
        lengths = _abbreviate([f"{name}: {size}" for name, size in sizes.items()])
        raise InputError(
            f"columns of different length ({lengths})",
            where=table.path,
            remedy="select those of one recording by `group` in a --columns file, or one by one",
        )
    check_size(table, [*sizes])


def _find_suspect_units(channels: dict[str, Float1D], rate_hz: float) -> list[str]:
    """Return warnings where a second derivative differs from an acceleration by 1000 or g.

    The rms ratio omega^2 |X| / |A| is taken over the spectral lines where |X A| is at least 0.1 of
    its maximum.
    """
    finite = {name: values for name, values in channels.items() if np.isfinite(values).any()}
    if {"mass_acc_m_s2", "table_acc_m_s2"} <= finite.keys():
        finite[RELATIVE_ACC] = finite["mass_acc_m_s2"] - finite["table_acc_m_s2"]
    warnings = []
    for disp, acc in DERIVATIVE_PAIRS:
        if not {disp, acc} <= finite.keys():
            continue
        x, a = (np.nan_to_num(finite[name] - np.nanmean(finite[name])) for name in (disp, acc))
        window = np.hanning(x.size)
        spectrum_x, spectrum_a = np.fft.rfft(x * window), np.fft.rfft(a * window)
        omega_squared = (2 * np.pi * rate_hz * np.fft.rfftfreq(x.size)) ** 2
        is_loud = np.abs(spectrum_x * spectrum_a) >= 0.1 * np.abs(spectrum_x * spectrum_a).max()
        total = float(np.sum(np.abs(spectrum_a[is_loud]) ** 2))
        ratio = float(
            np.sqrt(np.sum(np.abs(omega_squared * spectrum_x)[is_loud] ** 2) / max(total, 1e-300))
        )
        for factor, name in SUSPECT_FACTORS.items():
            if abs(np.log(ratio / factor)) < 0.25:
                warnings.append(
                    f"warning: the second derivative of {disp} is {name} times {acc}; if a unit is "
                    "wrong, state units with --columns"
                )
    return warnings


def read_column_map(path: Path | None) -> ColumnMap | None:
    """Read a --columns file; raise InputError that lists all its faults."""
    return None if path is None else load_config(path, ColumnMap, "column map")[0]
