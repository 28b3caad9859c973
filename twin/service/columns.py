"""What the columns of somebody's table are: canonical channels in SI, and the samples' index.

Conversion is declared, never guessed; a unit that looks wrong is only pointed out.
"""

import difflib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import Field, ValidationInfo, field_validator

from table_io.block import Float1D, Int1D
from table_io.card import BadInput, Card, Finite, Positive, load
from table_io.channels import BY_NAME
from table_io.units import GRAVITY_M_S2, UNITS
from twin.stream.tables import Table

TIME = "time_s"
TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6}
UNEVEN = 0.2  # rms of a sample's time off the grid, in samples: half a sample at the most
SUSPECT = {1e3: "1000", 1e-3: "1/1000", GRAVITY_M_S2: "g", 1 / GRAVITY_M_S2: "1/g"}
RELATIVE_ACC = "mass_acc_m_s2 - table_acc_m_s2"
PAIRS = (
    ("table_disp_m", "table_acc_m_s2"),
    ("mass_disp_m", "mass_acc_m_s2"),
    ("rel_disp_m", RELATIVE_ACC),
)


class Column(Card):
    """Where a channel comes from: value in SI = column * gain * unit + offset (in SI)."""

    column: str
    unit: str = ""
    gain: Finite = 1.0
    offset: Finite = 0.0

    @field_validator("gain")
    @classmethod
    def _not_silent(cls, gain: float) -> float:
        if gain == 0:
            raise ValueError("gain is 0, so the channel would be silent; allowed: not 0")
        return gain


class Map(Card):
    """A --columns file."""

    rate_hz: Positive | None = Field(None, description="Where there is no column of time.")
    columns: dict[str, Column] = Field(default_factory=dict)

    @field_validator("columns")
    @classmethod
    def _known(cls, columns: dict[str, Column], info: ValidationInfo) -> dict[str, Column]:
        for name, column in columns.items():
            if name != TIME and name not in BY_NAME:
                raise ValueError(f"{name!r} is no channel; {_nearest(name)}")
            allowed = _units(name)
            if column.unit and column.unit not in allowed:
                raise ValueError(
                    f"{name}: unit {column.unit!r} does not fit; allowed: {', '.join(allowed)}"
                )
        if TIME in columns and info.data.get("rate_hz") is not None:
            raise ValueError(f"{TIME} and rate_hz both say when samples were taken; keep one")
        return columns


def _nearest(name: str) -> str:
    known = [TIME, *BY_NAME]
    near = difflib.get_close_matches(name, known, 1, 0.5)
    return f"did you mean {near[0]!r}?" if near else f"known: {', '.join(known)}"


def _units(name: str) -> dict[str, float]:
    """The units that a column may be in, and each in SI."""
    if name == TIME:
        return TIME_UNITS
    return {unit: factor for unit, (si, factor) in UNITS.items() if si == BY_NAME[name].unit}


@dataclass(frozen=True, eq=False)
class Samples:
    """Channels in SI, (row,) each, and the sample index of each row, rising."""

    rate_hz: float
    index: Int1D
    channels: dict[str, Float1D]
    said: tuple[str, ...]


def samples(table: Table, card: Map | None) -> Samples:
    """The table as samples; BadInput where a column is unknown or time is not uniform."""
    chosen, said = _chosen(table, card)
    values = {
        name: column.gain * _units(name).get(column.unit, 1.0) * table.columns[column.column]
        + column.offset
        for name, column in chosen.items()
    }
    time = values.pop(TIME, None)
    order = [name for name in BY_NAME if name in values]
    channels = {name: values[name] for name in order}
    if not channels:
        raise BadInput(f"{table.path}: no channel in it but time; known: {', '.join(BY_NAME)}")
    if time is None:
        rate = card.rate_hz if card is not None else None
        if rate is None:
            raise BadInput(
                f"{table.path}: no column {TIME}; add one, or state `rate_hz = ...` in a --columns "
                "file"
            )
        index = np.arange(next(iter(channels.values())).size)
    else:
        rate, index, told = _grid(time, table)
        said += told
    missing = [name for name in BY_NAME if name not in channels]
    said.append(f"not in the file: {', '.join(missing)}")
    said += [f"{name}: all lost" for name in order if np.isnan(channels[name]).all()]
    return Samples(rate, index, channels, (*table.said, *said, *_suspects(channels, rate)))


def _chosen(table: Table, card: Map | None) -> tuple[dict[str, Column], list[str]]:
    """Where each channel comes from: the map, and columns that bear a channel's name."""
    mapped = dict(card.columns) if card is not None else {}
    for name, column in mapped.items():
        if column.column not in table.columns:
            near = difflib.get_close_matches(column.column, table.columns, 1, 0.4)
            hint = f"did you mean {near[0]!r}? " if near else ""
            raise BadInput(
                f"{table.path}: no column {column.column!r} for {name}; {hint}"
                f"there: {', '.join(table.columns)}"
            )
    taken = {column.column for column in mapped.values()}
    left = []
    for name in table.columns:
        if name in taken or name in mapped:
            continue
        if name in BY_NAME or (name == TIME and (card is None or card.rate_hz is None)):
            mapped[name] = Column(column=name)
        elif card is None:
            raise BadInput(
                f"{table.path}: row 1: column {name!r} is unknown; {_nearest(name)} Rename it, or "
                "say by --columns MAP which columns are which (the others are left out)"
            )
        else:
            left.append(name)
    said = [f"{name} = column {one.column!r}" for name, one in mapped.items() if one.column != name]
    return mapped, [*said, *([f"left out: {', '.join(left)}"] if left else [])]


def _grid(time: Float1D, table: Table) -> tuple[float, Int1D, list[str]]:
    """(rate in Hz, index of each row, what a person is told) of times in s, (row,)."""

    def row(place: int) -> str:
        return f"{table.path}: row {place + table.first_row}, {TIME}"

    if np.isnan(time).any():
        raise BadInput(f"{row(int(np.argmax(np.isnan(time))))}: empty; every sample needs its time")
    if time.size < 3:
        raise BadInput(f"{table.path}: {time.size} samples; allowed: three or more")
    gaps = np.diff(time)
    if (gaps <= 0).any():
        at = int(np.argmax(gaps <= 0)) + 1
        raise BadInput(
            f"{row(at)}: {time[at]:.9g} s after {time[at - 1]:.9g} s; time must rise; sort the "
            "rows or take out the doubled ones"
        )
    near = gaps < 1.5 * np.median(gaps)
    index = np.concatenate([[0.0], np.cumsum(np.rint(gaps / gaps[near].mean()))])
    period, start = np.polyfit(index, time, 1)
    exact = (time - start) / period
    index = np.rint(exact).astype(np.int64)
    index -= index[0]
    off = exact - exact[0] - index
    off -= off.mean()
    doubled = np.diff(index) <= 0
    if doubled.any() or off.std() > UNEVEN:
        at = int(np.argmax(doubled if doubled.any() else np.abs(off)))
        raise BadInput(
            f"{row(at)}: {time[at]:.9g} s lies half a sample or more off a uniform "
            f"{1 / period:.6g} Hz; resample the table to a uniform rate"
        )
    rate = _round(1 / period, int(index[-1]))
    said = [f"sampled at {rate:.9g} Hz"]
    worst = float(np.abs(off).max())
    if worst > 0.01:
        said.append(f"time jitters by up to {worst:.2g} of a sample; taken as uniform")
    if abs(time[0]) > 0.5 / rate:
        said.append(f"time begins at {time[0]:.9g} s; sample 0 is there")
    return rate, index, said


def _round(rate_hz: float, last: int) -> float:
    """The roundest rate that is off by less than a tenth of a sample at the end of the record."""
    for digits in range(1, 15):
        rounded = float(f"{rate_hz:.{digits}g}")
        if abs(rounded / rate_hz - 1) * last < 0.1:
            return rounded
    return rate_hz


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


def holes(index: Int1D) -> list[tuple[int, int]]:
    """(first missing sample, how many) of every hole between the rows."""
    places = np.flatnonzero(np.diff(index) > 1)
    return [(int(index[k]) + 1, int(index[k + 1] - index[k]) - 1) for k in places]
