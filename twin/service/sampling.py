"""When the rows of somebody's table were taken: one uniform rate, an index each, or a refusal."""

from collections.abc import Sequence

import numpy as np

from table_io.block import Float1D, Int1D
from table_io.card import BadInput
from twin.stream.rows import TIME
from twin.stream.tables import Held, Table

UNEVEN = 0.2  # rms of a sample's time off the grid, in samples: half a sample at the most
SAME_RATE = 1e-4  # UFF's text has six digits of the time between two samples


def uniform(time: Float1D, table: Table) -> tuple[float, Int1D, list[str]]:
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


def stated_rate(
    table: Table, columns: Sequence[Held], rate_hz: float | None
) -> tuple[float, list[str]]:
    """(rate in Hz, what a person is told) where there is no time: the map's, or the file's own."""
    own = {held.rate_hz for held in columns if held.rate_hz is not None}
    if len(own) > 1 or len({held.start_s for held in columns}) > 1:
        told = ", ".join(
            f"{held.rate_hz:.9g} Hz from {held.start_s:g} s" for held in columns if held.rate_hz
        )
        raise BadInput(
            f"{table.path}: columns that were not sampled together ({told}); import them one by one"
        )
    if columns[0].size < 3:
        raise BadInput(f"{table.path}: {columns[0].size} samples; allowed: three or more")
    said = []
    if own and rate_hz is not None and abs(next(iter(own)) / rate_hz - 1) > SAME_RATE:
        raise BadInput(
            f"{table.path}: sampled at {next(iter(own)):.9g} Hz by the file, at {rate_hz:.9g} Hz "
            "by the map; allowed: that they agree; mend rate_hz"
        )
    if own and rate_hz is None:
        rate_hz = _round(next(iter(own)), columns[0].size)
        said.append(f"sampled at {rate_hz:.9g} Hz, as the file says")
    if rate_hz is None:
        raise BadInput(
            f"{table.path}: no column {TIME}; add one, or state `rate_hz = ...` in a --columns file"
        )
    if columns[0].start_s:
        said.append(f"time begins at {columns[0].start_s:.9g} s; sample 0 is there")
    return rate_hz, said


def _round(rate_hz: float, last: int) -> float:
    """The roundest rate that is off by less than a tenth of a sample at the end of the record."""
    for digits in range(1, 15):
        rounded = float(f"{rate_hz:.{digits}g}")
        if abs(rounded / rate_hz - 1) * last < 0.1:
            return rounded
    return rate_hz


def holes(index: Int1D) -> list[tuple[int, int]]:
    """(first missing sample, how many) of every hole between the rows."""
    places = np.flatnonzero(np.diff(index) > 1)
    return [(int(index[k]) + 1, int(index[k + 1] - index[k]) - 1) for k in places]
