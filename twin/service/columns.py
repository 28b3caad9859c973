"""What the columns of somebody's table are: canonical channels in SI, and the samples' index.

Conversion is declared, never guessed; a unit that looks wrong is only pointed out.
"""

import difflib
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from pydantic import Field, ValidationInfo, field_validator

from table_io.block import Float1D, Int1D
from table_io.card import BadInput, Card, Finite, Positive, load
from table_io.channels import BY_NAME
from table_io.units import GRAVITY_M_S2, UNITS
from twin.service.sampling import stated_rate, uniform
from twin.stream.rows import LABELS, TIME, TWIN
from twin.stream.tables import MOST_NAMED, Table, bounded

KNOWN = (TIME, *BY_NAME, *LABELS)
BY_UNIT = {TIME: "s", **{name: one.unit for name, one in BY_NAME.items()}, **LABELS}
SPELLINGS = {
    "meter": "m", "meters": "m", "metre": "m", "metres": "m",
    "millimeter": "mm", "millimetre": "mm",
    "m/s/s": "m/s2", "ms-2": "m/s2", "m*s-2": "m/s2", "gn": "g", "newton": "N", "newtons": "N",
    "n": "N", "kn": "kN", "sec": "s", "second": "s", "seconds": "s", "hz": "Hz",
}  # fmt: skip
TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6}
SUSPECT = {1e3: "1000", 1e-3: "1/1000", GRAVITY_M_S2: "g", 1 / GRAVITY_M_S2: "1/g"}
RELATIVE_ACC = "mass_acc_m_s2 - table_acc_m_s2"
PAIRS = (
    ("table_disp_m", "table_acc_m_s2"),
    ("mass_disp_m", "mass_acc_m_s2"),
    ("rel_disp_m", RELATIVE_ACC),
)


class Column(Card):
    """Where a channel comes from: value in SI = column * gain * unit + offset (in SI).

    What the file itself says of the column's unit has to be `unit`; where a gain makes that of it,
    or the file is wrong, `file_unit` repeats what it says.
    """

    column: str
    unit: str = ""
    file_unit: str | None = None
    gain: Finite = 1.0
    offset: Finite = 0.0

    @field_validator("gain")
    @classmethod
    def _not_silent(cls, gain: float) -> float:
        if gain == 0:
            raise ValueError("gain is 0, so the channel would be silent; allowed: not 0")
        return gain

    def si(self, name: str, values: Float1D) -> Float1D:
        """The channel's values, (row,), in SI; without gain and offset to the bit as they are."""
        with np.errstate(all="ignore"):  # a NaN of another kind is a NaN too
            scaled = self.gain * _units(name).get(self.unit, 1.0) * values
            scaled = scaled + self.offset if self.offset else scaled
        if np.isinf(scaled).any():
            raise BadInput(f"{name}: {self.column!r} becomes infinite; mend its gain and offset")
        return scaled


class Map(Card):
    """A --columns file."""

    group: str = Field("", description="The group, structure or folder inside the file.")
    rate_hz: Positive | None = Field(None, description="Where there is no column of time.")
    columns: dict[str, Column] = Field(default_factory=dict)

    @field_validator("columns")
    @classmethod
    def _known(cls, columns: dict[str, Column], info: ValidationInfo) -> dict[str, Column]:
        for name, column in columns.items():
            if name not in KNOWN:
                raise ValueError(f"{name!r} is no channel; {_nearest(name)}")
            allowed = _units(name)
            if column.unit and column.unit not in allowed:
                raise ValueError(
                    f"{name}: unit {column.unit!r} does not fit; "
                    f"allowed: {', '.join(allowed) or 'none'}"
                )
        if TIME in columns and info.data.get("rate_hz") is not None:
            raise ValueError(f"{TIME} and rate_hz both say when samples were taken; keep one")
        return columns


def _nearest(name: str) -> str:
    near = difflib.get_close_matches(name, KNOWN, 1, 0.5)
    return f"did you mean {near[0]!r}?" if near else f"known: {', '.join(KNOWN)}"


def _units(name: str) -> dict[str, float]:
    """The units that a column may be in, and each in SI."""
    if name == TIME:
        return TIME_UNITS
    si = BY_NAME[name].unit if name in BY_NAME else LABELS[name]
    return {unit: factor for unit, (of, factor) in UNITS.items() if of == si} or (
        {si: 1.0} if si else {}
    )


@dataclass(frozen=True, eq=False)
class Samples:
    """Channels in SI, (row,) each, and the sample index of each row, rising.

    `labels` are the columns of LABELS, all of them or none.
    """

    rate_hz: float
    index: Int1D
    channels: dict[str, Float1D]
    said: tuple[str, ...]
    labels: dict[str, Float1D] = field(default_factory=dict)


def samples(table: Table, card: Map | None) -> Samples:
    """The table as samples; BadInput where a column is unknown or time is not uniform."""
    chosen, said = _chosen(table, card)
    for name, column in chosen.items():
        _agrees(table, name, column)
    _as_long(table, chosen)
    values = {name: column.si(name, table.read(column.column)) for name, column in chosen.items()}
    time = values.pop(TIME, _own_time(table, chosen, card))
    order = [name for name in BY_NAME if name in values]
    channels = {name: values[name] for name in order}
    if time is not None:
        rate, index, told = uniform(time, table)
        said += told
    else:
        held = [table.columns[column.column] for column in chosen.values()]
        rate, told = stated_rate(table, held, card.rate_hz if card is not None else None)
        index = np.arange(held[0].size)
        said += told
    missing = [name for name in BY_NAME if name not in channels]
    said.append(f"not in the file: {', '.join(missing)}")
    said += [f"{name}: all lost" for name in order if np.isnan(channels[name]).all()]
    labels = {name: values[name] for name in LABELS if name in values}
    return Samples(rate, index, channels, (*table.said, *said, *_suspects(channels, rate)), labels)


def _own_time(table: Table, chosen: dict[str, Column], card: Map | None) -> Float1D | None:
    """The times in s, (row,), that the file keeps for its columns, where the map has no rate."""
    clocks = {table.columns[column.column].clock for column in chosen.values()}
    if "" in clocks or TIME in chosen or (card is not None and card.rate_hz is not None):
        return None
    first, *rest = (table.read(clock) for clock in sorted(clocks))
    if any(not np.array_equal(first, other) for other in rest):
        raise BadInput(
            f"{table.path}: columns that were not sampled at the same times; import them one by one"
        )
    return first


def _chosen(table: Table, card: Map | None) -> tuple[dict[str, Column], list[str]]:
    """Where each channel comes from: the map, and columns that bear a channel's name."""
    mapped = dict(card.columns) if card is not None else {}
    for name, column in mapped.items():
        if column.column not in table.columns:
            raise _not_there(table, name, column.column)
    taken = {column.column for column in mapped.values()}
    left, twins = [], 0
    for name in table.columns:
        if name in taken or name in mapped:
            continue
        if name.startswith(TWIN):
            twins += 1
        elif name in KNOWN and (name != TIME or card is None or card.rate_hz is None):
            mapped[name] = Column(column=name)
        elif card is None:
            raise BadInput(
                f"{table.path}: column {name!r} is unknown; {_nearest(name)}; rename it, or "
                "say by --columns MAP which columns are which (the others are left out)"
            )
        else:
            left.append(name)
    some = [name for name in LABELS if name in mapped]
    if len(some) < len(LABELS):
        left += [mapped.pop(name).column for name in some]
    if not mapped.keys() & BY_NAME.keys():
        raise BadInput(
            f"{table.path}: no channel in it but time; there: {_few([*table.columns])}; "
            f"known: {', '.join(BY_NAME)}"
        )
    said = [f"{name} = column {one.column!r}" for name, one in mapped.items() if one.column != name]
    said += [f"left out: {_few(left)}"] if left else []
    said += [f"left out: {twins} columns of a twin; it is computed anew"] if twins else []
    return mapped, said


def _not_there(table: Table, name: str, column: str) -> BadInput:
    if column in table.others:
        return BadInput(
            f"{table.path}: {column!r}, meant for {name}, is no column: {table.others[column]}"
        )
    near = difflib.get_close_matches(column, table.columns, 1, 0.4)
    hint = f"did you mean {near[0]!r}? " if near else ""
    return BadInput(
        f"{table.path}: no column {column!r} for {name}; {hint}there: {_few([*table.columns])}"
    )


def _few(names: list[str]) -> str:
    more = f" and {len(names) - MOST_NAMED} more (all: --list)" if len(names) > MOST_NAMED else ""
    return ", ".join(names[:MOST_NAMED]) + more


def _agrees(table: Table, name: str, column: Column) -> None:
    """BadInput where the file's own unit is another than the map's, both named."""
    says = table.columns[column.column].unit
    if not says or (column.file_unit is not None and column.file_unit == says):
        return
    stated = column.file_unit or column.unit or BY_UNIT.get(name, "")
    if _plain(says) == stated:
        return
    who = "the map" if column.file_unit or column.unit else "its name"
    raise BadInput(
        f"{table.path}: column {column.column!r} is in {says!r} by the file, {name} in {stated!r} "
        f"by {who}; allowed: that they agree; state unit = ... in a --columns file, or file_unit = "
        f"{says!r} where a gain converts it"
    )


def _plain(unit: str) -> str:
    """The unit in our spelling, where it is one of ours."""
    text = unit.strip().replace("²", "2").replace("µ", "u").replace("μ", "u")
    for mark in ("^", "**", " ", "(", ")", "[", "]"):
        text = text.replace(mark, "")
    return SPELLINGS.get(text.lower(), text)


def _as_long(table: Table, chosen: dict[str, Column]) -> None:
    """BadInput where the columns are not equally long, or larger than they can be."""
    sizes = {column.column: table.columns[column.column].size for column in chosen.values()}
    if len(set(sizes.values())) > 1:
        told = _few([f"{name}: {size}" for name, size in sizes.items()])
        raise BadInput(
            f"{table.path}: columns of different length ({told}); take those of one recording, "
            "by `group` in a --columns file or one by one"
        )
    bounded(table, [*sizes])


def _suspects(channels: dict[str, Float1D], rate_hz: float) -> list[str]:
    """A warning where a displacement's second derivative is 1000 or g times an acceleration.

    Compared between the two by the sample spectra where both are loud: near the strongest
    frequency of the acceleration, weighted there by its power.
    """
    known = {name: one for name, one in channels.items() if np.isfinite(one).any()}
    if {"mass_acc_m_s2", "table_acc_m_s2"} <= known.keys():
        known[RELATIVE_ACC] = known["mass_acc_m_s2"] - known["table_acc_m_s2"]
    said = []
    for disp, acc in PAIRS:
        if not {disp, acc} <= known.keys():
            continue
        x, a = (np.nan_to_num(known[name] - np.nanmean(known[name])) for name in (disp, acc))
        window = np.hanning(x.size)
        spectrum_x, spectrum_a = np.fft.rfft(x * window), np.fft.rfft(a * window)
        w2 = (2 * np.pi * rate_hz * np.fft.rfftfreq(x.size)) ** 2
        loud = np.abs(spectrum_x * spectrum_a) >= 0.1 * np.abs(spectrum_x * spectrum_a).max()
        total = float(np.sum(np.abs(spectrum_a[loud]) ** 2))
        ratio = float(np.sqrt(np.sum(np.abs(w2 * spectrum_x)[loud] ** 2) / max(total, 1e-300)))
        for factor, name in SUSPECT.items():
            if abs(np.log(ratio / factor)) < 0.25:
                said.append(
                    f"warning: {disp} twice differentiated is {name} times {acc}; is a unit wrong? "
                    "State units by --columns"
                )
    return said


def read_map(path: Path | None) -> Map | None:
    """The --columns file; BadInput with every fault of it."""
    return None if path is None else load(path, Map, "map of columns")[0]
