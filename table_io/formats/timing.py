"""When the samples of a foreign table were taken: the one place that judges its times.

Times come from a column of times, from the interval or rate that the file states, or from an option
of the user. Two sources that contradict each other are an error that names both values.
"""

from collections.abc import Sequence

import numpy as np

from table_io.block import Float1D, Int1D
from table_io.channels import TIME_COLUMN
from table_io.errors import InputError
from table_io.formats.table import ForeignColumn, ForeignTable
from table_io.formats.words import find_quantity

MAX_JITTER_SAMPLES = 0.2  # rms deviation from the uniform grid, in samples
MAX_INTERVAL_ERROR = 0.01  # of the mean interval, of times that a machine is to follow
RATE_TOLERANCE = 1e-4  # UFF text has six digits of the sampling interval
INTERVAL_SPREAD = 0.01  # relative, of the steps of a column of times without a name that tells


def find_time_column(table: ForeignTable, names: Sequence[str]) -> str:
    """Return the column of times, "" without one: by its name, else by numbers that rise evenly."""
    quantities = {name: find_quantity(name, table.columns[name].unit) for name in names}
    by_name = [name for name in names if quantities[name] == "time" or name == TIME_COLUMN]
    for name in by_name or [name for name in names if not quantities[name]]:
        steps = np.diff(table.read_column(name))
        if steps.size > 1 and (steps > 0).all():
            spread = float(np.std(steps) / np.mean(steps))
            if by_name or spread < INTERVAL_SPREAD:
                return name
    return ""


def check_rate(
    stated_hz: float, measured_hz: float, where: object, source: str, tolerance: float, key: str
) -> None:
    """Raise InputError if the rate that a user states is not that of the file, in Hz.

    `source` is the part of the file that states or shows it.
    """
    if abs(measured_hz / stated_hz - 1.0) > tolerance:
        is_step = key == "step_s"
        value = 1.0 / stated_hz if is_step else stated_hz
        unit = f"{1.0 / measured_hz:.6g} s" if is_step else f"{measured_hz:.9g} Hz"
        raise InputError(
            f"{source} has {unit}",
            where=where,
            key=key,
            value=float(f"{value:.12g}"),
            remedy=f"correct {key}, or leave it out",
        )


def resolve_times(
    time: Float1D | None,
    table: ForeignTable,
    columns: Sequence[ForeignColumn],
    stated_hz: float | None,
) -> tuple[float, Int1D, list[str]]:
    """Return (rate in Hz, index of each row, notes) by the times in s, (row,), or without them.

    `columns` are those to import, which may state a rate; `stated_hz` is that of the user. Times
    that do not rise evenly, because they are rounded, yield to a stated rate that is theirs.
    """
    if time is None:
        rate_hz, notes = _resolve_stated_rate(table, columns, stated_hz)
        return rate_hz, np.arange(min(column.size for column in columns)), notes
    try:
        rate_hz, index, notes = fit_uniform_rate(time, table)
    except InputError as error:
        if stated_hz is None or time.size < 3 or not np.isfinite(time[[0, -1]]).all():
            raise
        mean_hz = (time.size - 1) / float(time[-1] - time[0])
        check_rate(stated_hz, mean_hz, table.path, TIME_COLUMN, MAX_INTERVAL_ERROR, "rate_hz")
        note = f"the stated {stated_hz:.9g} Hz replace the times of the file: {error.problem}"
        return stated_hz, np.arange(time.size), [note]
    if stated_hz is not None:
        check_rate(stated_hz, rate_hz, table.path, TIME_COLUMN, RATE_TOLERANCE, "rate_hz")
    return rate_hz, index, notes


def fit_uniform_rate(time: Float1D, table: ForeignTable) -> tuple[float, Int1D, list[str]]:
    """Fit a uniform rate to times in s, (row,); return (rate in Hz, index of each row, notes).

    Raises InputError if time does not rise or is not uniform.
    """
    if time.size < 3:
        raise InputError(f"{time.size} samples", where=table.path, allowed="three or more")
    gaps = _measure_gaps(time, table)
    is_regular = gaps < 1.5 * np.median(gaps)
    index = np.concatenate([[0.0], np.cumsum(np.rint(gaps / gaps[is_regular].mean()))])
    period, start = np.polyfit(index, time, 1)
    positions = (time - start) / period
    index = np.rint(positions).astype(np.int64)
    index -= index[0]
    deviation = positions - positions[0] - index
    deviation -= deviation.mean()
    is_doubled = np.diff(index) <= 0
    if is_doubled.any() or deviation.std() > MAX_JITTER_SAMPLES:
        position = int(np.argmax(is_doubled if is_doubled.any() else np.abs(deviation)))
        raise InputError(
            f"{time[position]:.9g} s does not fit a uniform rate of {1 / period:.6g} Hz",
            where=f"{table.describe_row(position)}, {TIME_COLUMN}",
            remedy="resample the table to a uniform rate",
        )
    rate = _round_rate(1 / period, int(index[-1]))
    notes = [f"sampled at {rate:.9g} Hz"]
    worst = float(np.abs(deviation).max())
    if worst > 0.01:
        notes.append(f"time jitters by up to {worst:.2g} of a sample; treated as uniform")
    if abs(time[0]) > 0.5 / rate:
        notes.append(f"time begins at {time[0]:.9g} s; this is sample 0")
    return rate, index, notes


def measure_rate(time: Float1D, table: ForeignTable) -> float:
    """Return the mean rate in Hz of times in s, (row,), that a machine is to follow.

    Raises InputError that names the row where they do not rise, or rise unevenly.
    """
    gaps = _measure_gaps(time, table)
    interval_s = float(time[-1] - time[0]) / (time.size - 1)
    is_uneven = np.abs(gaps - interval_s) > MAX_INTERVAL_ERROR * abs(interval_s)
    if is_uneven.any():
        raise InputError(
            f"the sampling is not uniform: {interval_s:.6g} s on average",
            where=table.describe_row(int(np.argmax(is_uneven)) + 1),
            remedy="resample it; or if the file has no times, set step_s and column",
        )
    return 1.0 / interval_s


def _measure_gaps(time: Float1D, table: ForeignTable) -> Float1D:
    """Return the steps of times, (row - 1,); InputError names the row where they do not rise."""
    if np.isnan(time).any():
        raise InputError(
            "empty",
            where=f"{table.describe_row(int(np.argmax(np.isnan(time))))}, {TIME_COLUMN}",
            remedy="give every sample its time",
        )
    gaps: Float1D = np.diff(time)
    if (gaps <= 0).any():
        position = int(np.argmax(gaps <= 0)) + 1
        raise InputError(
            f"{time[position]:.9g} s after {time[position - 1]:.9g} s, but time must rise",
            where=f"{table.describe_row(position)}, {TIME_COLUMN}",
            remedy="sort the rows or remove the duplicates; or if these are no times, state the "
            "rate (--rate HZ, or step_s of a record)",
        )
    return gaps


def _resolve_stated_rate(
    table: ForeignTable, columns: Sequence[ForeignColumn], rate_hz: float | None
) -> tuple[float, list[str]]:
    """Return (rate in Hz, notes) of a table without times, from the file or from the user."""
    file_rates = {column.rate_hz for column in columns if column.rate_hz is not None}
    if len(file_rates) > 1 or len({column.start_s for column in columns}) > 1:
        rates = ", ".join(
            f"{column.rate_hz:.9g} Hz from {column.start_s:g} s"
            for column in columns
            if column.rate_hz
        )
        raise InputError(
            f"the columns have different sampling ({rates})",
            where=table.path,
            remedy="import them one by one",
        )
    size = min(column.size for column in columns)
    if size < 3:
        raise InputError(f"{size} samples", where=table.path, allowed="three or more")
    notes = []
    if file_rates:
        (file_hz,) = file_rates
        if rate_hz is not None:
            check_rate(rate_hz, file_hz, table.path, "the file", RATE_TOLERANCE, "rate_hz")
        else:
            rate_hz = _round_rate(file_hz, size)
            notes.append(f"sampled at {rate_hz:.9g} Hz, as stated in the file")
    if rate_hz is None:
        raise InputError(
            f"no column {TIME_COLUMN}",
            where=table.path,
            remedy="add one, or state `rate_hz = ...` in a --columns file",
        )
    if columns[0].start_s:
        notes.append(f"time begins at {columns[0].start_s:.9g} s; this is sample 0")
    return rate_hz, notes


def _round_rate(rate_hz: float, last: int) -> float:
    """Return the roundest rate whose drift at sample `last` is below a tenth of a sample."""
    for digits in range(1, 15):
        rounded = float(f"{rate_hz:.{digits}g}")
        if abs(rounded / rate_hz - 1) * last < 0.1:
            return rounded
    return rate_hz


def find_holes(index: Int1D) -> list[tuple[int, int]]:
    """Return (first missing sample, count) of every gap between rows."""
    places = np.flatnonzero(np.diff(index) > 1)
    return [(int(index[k]) + 1, int(index[k + 1] - index[k]) - 1) for k in places]
