"""Sampling of an imported table: uniform rate and the sample index of each row."""

from collections.abc import Sequence

import numpy as np

from table_io.block import Float1D, Int1D
from table_io.errors import InputError
from twin.exchange.formats import ColumnInfo, SampleTable
from twin.recording.tabular import TIME_COLUMN

MAX_JITTER_SAMPLES = 0.2  # rms deviation from the uniform grid, in samples
RATE_TOLERANCE = 1e-4  # UFF text has six digits of the sampling interval


def fit_uniform_rate(time: Float1D, table: SampleTable) -> tuple[float, Int1D, list[str]]:
    """Fit a uniform rate to times in s, (row,); return (rate in Hz, index of each row, notes).

    Raises InputError if time does not rise or is not uniform.
    """

    def describe_row(place: int) -> str:
        return f"{table.path}: row {place + table.first_row}, {TIME_COLUMN}"

    if np.isnan(time).any():
        raise InputError(
            "empty",
            where=describe_row(int(np.argmax(np.isnan(time)))),
            remedy="give every sample its time",
        )
    if time.size < 3:
        raise InputError(f"{time.size} samples", where=table.path, allowed="three or more")
    gaps = np.diff(time)
    if (gaps <= 0).any():
        position = int(np.argmax(gaps <= 0)) + 1
        raise InputError(
            f"{time[position]:.9g} s after {time[position - 1]:.9g} s, but time must rise",
            where=describe_row(position),
            remedy="sort the rows or remove the duplicates",
        )
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
            where=describe_row(position),
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


def resolve_stated_rate(
    table: SampleTable, columns: Sequence[ColumnInfo], rate_hz: float | None
) -> tuple[float, list[str]]:
    """Return (rate in Hz, notes) of a table without times, from the file or the column map."""
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
    if columns[0].size < 3:
        raise InputError(f"{columns[0].size} samples", where=table.path, allowed="three or more")
    notes = []
    if (
        file_rates
        and rate_hz is not None
        and abs(next(iter(file_rates)) / rate_hz - 1) > RATE_TOLERANCE
    ):
        raise InputError(
            f"the file states {next(iter(file_rates)):.9g} Hz",
            where=table.path,
            key="rate_hz",
            value=rate_hz,
            remedy="correct rate_hz in the --columns file, or leave it out",
        )
    if file_rates and rate_hz is None:
        rate_hz = _round_rate(next(iter(file_rates)), columns[0].size)
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
