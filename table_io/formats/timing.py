"""When the samples of a foreign table were taken: the one place that judges its times.

Times come from a column of times, from the interval or rate that the file states, or from an option
of the user. Two sources that contradict each other are an error that names both values; a unit that
is nowhere stated is taken only if it is the only one that is plausible, and never in silence.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from table_io.block import Float1D, Int1D
from table_io.channels import TIME_COLUMN
from table_io.errors import InputError
from table_io.formats.table import ForeignColumn, ForeignTable
from table_io.formats.words import (
    TIME_UNITS,
    find_quantity,
    find_stated_unit,
    find_unknown_unit,
)

MAX_JITTER_SAMPLES = 0.2  # rms deviation from the uniform grid, in samples
MAX_INTERVAL_ERROR = 0.01  # of the mean interval, of times that a machine is to follow
RATE_TOLERANCE = 1e-4  # UFF text has six digits of the sampling interval
INTERVAL_SPREAD = 0.01  # relative, of the steps of a column of times without a name that tells
MIN_RATE_HZ, MAX_RATE_HZ = 0.1, 1e6  # of a test on a table or a component
MAX_PAUSES = 10  # in the notes
MAX_WRAPPED_SHARE = 0.5  # of the mean square step down a column: that along a row of one series
MAX_TURN = 4.0  # mean square of a step to the next row over that along a row, of one series
PAUSE_SAMPLES = 10  # from which a gap is a pause, after which the clock may stand elsewhere
MAX_APART_S = 1e4  # of two columns of times that may be those of different channels
HOUR_S = 3600.0  # by which local clocks are moved for summer time
SAMPLE_UNIT = "sample"  # of a column that counts samples; its rate is stated
MIN_PLAIN_RATE_HZ = 0.5  # below it a step without a unit is hardly in seconds
# Of the strongest line of a test: outside, the times are hardly in seconds.
MIN_MOTION_HZ, MAX_MOTION_HZ = 0.01, 50.0
# First times by which a count is that of a computer or of a spreadsheet: years 2000 to 2050.
EPOCH_S, SERIAL_DAYS = (9.46e8, 2.53e9), (36526.0, 54789.0)
SERIAL_START_S = -2209161600.0  # day 0 of spreadsheets in s of Unix time


@dataclass(frozen=True, slots=True)
class TimeUnit:
    """Unit of a column of times, why it is that one, and what a person must answer, "" if sure."""

    unit: str
    reason: str
    question: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class SampleTimes:
    """Times of the rows of a table: rate in Hz and index of each row, (row,), from 0.

    `start_s` is the time of the file at index 0; `source` is the part of it, or the option, that
    tells the times.
    """

    rate_hz: float
    index: Int1D
    start_s: float
    source: str
    notes: tuple[str, ...] = ()


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


def describe_unusable_times(table: ForeignTable, names: Sequence[str]) -> str:
    """Return what is wrong with a column that is perhaps one of times, "" without one."""
    for name, why in table.dropped.items():
        if find_quantity(name) == "time":
            return f"column {name!r} is {why}"
    quantities = {name: find_quantity(name, table.columns[name].unit) for name in names}
    for name, quantity in quantities.items():
        if quantity == "time":
            try:
                _measure_gaps(table.read_column(name), table)
            except InputError as error:
                return f"column {name!r}: {error.where.rpartition(': ')[2]}: {error.problem}"
    for name, quantity in quantities.items():
        steps = np.diff(table.read_column(name))
        if not quantity and steps.size > 1 and (steps > 0).all():
            return f"column {name!r} rises throughout, but unevenly, and is no time by its name"
    return ""


def describe_wrapped(table: ForeignTable) -> str:
    """Return that the rows of a table without names continue one another as one series, or "".

    Then a step along a row is smaller than one down a column, which skips as many samples, and
    like one from the end of a row to the next: sensors that move together turn back there.
    """
    names = [*table.columns]
    sizes = {column.size for column in table.columns.values()}
    is_unnamed = all(name == f"column {table.columns[name].key[0]}" for name in names)
    if len(names) < 3 or len(sizes) != 1 or not is_unnamed or table.dropped:
        return ""
    samples = np.array([table.read_column(name) for name in names]).T
    along, down = np.diff(samples, axis=1), np.diff(samples, axis=0)
    turn = samples[1:, 0] - samples[:-1, -1]
    squares = [float(np.nanmean(steps**2)) for steps in (along, turn)]
    if not max(squares) < min(MAX_WRAPPED_SHARE * np.nanmean(down**2), MAX_TURN * squares[0]):
        return ""
    return (
        f"its rows continue one another, a series of {samples.size} values in lines of "
        f"{len(names)}: write one value a line, or see what format it is"
    )


def find_remark_rate(table: ForeignTable) -> float | None:
    """Return the rate in Hz that remarks in a file without times state, None without.

    InputError if they state two, one that is hardly that of a test, or channels that start apart.
    """
    rate_hz, other_hz = (table.facts.get(key) for key in ("rate_hz", "other_rate_hz"))
    problem = ""
    if "starts_apart_s" in table.facts:
        problem = f"its channels start {table.facts['starts_apart_s']:.9g} s apart"
    elif rate_hz and other_hz:
        problem = f"its remarks state {rate_hz:.9g} Hz and {other_hz:.9g} Hz"
    elif rate_hz and rate_hz < MIN_PLAIN_RATE_HZ:
        problem = f"its remarks state {rate_hz:.9g} Hz, perhaps in another unit"
    if problem:
        raise InputError(f"{table.kind}; {problem}", where=table.path, remedy="state the rate")
    return rate_hz


def describe_other_times(table: ForeignTable, names: Sequence[str], chosen: str) -> str:
    """Return how the times of another column differ from those chosen, "" if none do.

    A column of dates next to one of seconds differs by years.
    """
    units = {name: find_stated_unit(name, table.columns[name].unit) for name in names}
    first = TIME_UNITS.get(units[chosen], 1.0) * table.read_column(chosen)
    for name in names:
        is_time = name != chosen and find_quantity(name, table.columns[name].unit) == "time"
        if not is_time or table.columns[name].size != first.size:
            continue
        times = TIME_UNITS.get(units[name] or units[chosen], 1.0) * table.read_column(name)
        apart = np.abs(times - first)
        step = float(np.median(np.diff(first)))
        most_s = float(np.nanmax(apart))
        if MAX_JITTER_SAMPLES * step < most_s < MAX_APART_S and (np.diff(times) > 0).all():
            return (
                f"columns {chosen!r} and {name!r} are different times, up to {most_s:.4g} s apart: "
                "do the channels have one clock?"
            )
    return ""


def judge_time_unit(table: ForeignTable, name: str, stated_hz: float | None = None) -> TimeUnit:
    """Return the unit of a column of times: as stated, or the only one that is plausible.

    `stated_hz` is the rate that the user states; else a rate that the file states helps.
    """
    unit = find_stated_unit(name, table.columns[name].unit)
    if unit in TIME_UNITS:
        return TimeUnit(unit, "stated in the file")
    unknown = unit or find_unknown_unit(name)
    is_known = unknown in ("", "-") or (unknown.isalpha() and not unit)
    times = table.read_column(name)
    step = float(np.median(np.diff(times)))
    known_hz = stated_hz or table.facts.get("rate_hz")
    rates = {unit: 1.0 / (step * factor) for unit, factor in TIME_UNITS.items()} if step else {}
    for unit, rate_hz in rates.items():
        if known_hz and abs(rate_hz / known_hz - 1) < INTERVAL_SPREAD:
            whose = "stated" if stated_hz else "of the file"
            return TimeUnit(unit, f"agrees with the {known_hz:g} Hz {whose}")
    is_count = step == 1.0 and bool((times == np.rint(times)).all())
    if is_count and known_hz:
        whose = "stated" if stated_hz else "file's"
        return TimeUnit(SAMPLE_UNIT, f"counts samples, at the {whose} {known_hz:g} Hz")
    for unit, date in _find_dates(float(times[0])).items():
        if is_known and MIN_PLAIN_RATE_HZ <= rates.get(unit, 0.0) <= MAX_RATE_HZ:
            since = "1899-12-30" if unit == "day" else "1970"
            return TimeUnit(unit, f"counts {unit} since {since}, from {date}; no unit is stated")
    if is_known and not is_count and _is_in_seconds(table, name, rates.get("s", 0.0)):
        return TimeUnit("s", f"a step of {step:.4g} s; no unit is stated")
    possible = [
        f"{rate_hz:.4g} Hz in {unit}"
        for unit, rate_hz in rates.items()
        if MIN_RATE_HZ <= rate_hz <= MAX_RATE_HZ
    ]
    return TimeUnit(
        "s",
        f"a step of {step:.4g}",
        f"column {name!r}: the unit of its times is not "
        f"{f'known, {unknown!r}' if unknown else 'stated'}, a step of {step:.4g} is "
        f"{' or '.join(possible) or 'no rate of a test'}"
        f"{', or it counts samples' if is_count else ''}: state it in a map, or --rate HZ",
    )


def _find_dates(first: float) -> dict[str, str]:
    """Return the first date of a count by its unit, where it is one of our time."""
    dates = {}
    for unit in ("s", "ms", "us", "ns"):
        if EPOCH_S[0] <= first * TIME_UNITS[unit] <= EPOCH_S[1]:
            dates[unit] = first * TIME_UNITS[unit]
    if SERIAL_DAYS[0] <= first <= SERIAL_DAYS[1]:
        dates["day"] = SERIAL_START_S + first * TIME_UNITS["day"]
    return {
        unit: str(np.datetime64(round(seconds), "s")).replace("T", " ")
        for unit, seconds in dates.items()
    }


def _is_in_seconds(table: ForeignTable, name: str, rate_hz: float) -> bool:
    """Return True if a test is plausible whose times are in seconds: by rate and motion."""
    if not MIN_PLAIN_RATE_HZ <= rate_hz <= MAX_RATE_HZ:
        return False
    lines = []
    for other, column in table.columns.items():
        if other == name or column.size != table.columns[name].size:
            continue
        if find_quantity(other, column.unit) not in ("", "time"):
            values = table.read_column(other)
            values = np.nan_to_num(values - np.nanmean(values))
            lines.append(float(np.argmax(np.abs(np.fft.rfft(values)))) * rate_hz / values.size)
    return not lines or (max(lines) >= MIN_MOTION_HZ and min(lines) <= MAX_MOTION_HZ)


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


def check_plausible_rate(rate_hz: float, table: ForeignTable, source: str) -> None:
    """Raise InputError if no test has this rate: its times are in another unit."""
    if not MIN_RATE_HZ <= rate_hz <= MAX_RATE_HZ:
        raise InputError(
            f"{table.kind}; {source} tells {rate_hz:.4g} samples per second",
            where=table.path,
            allowed=f"{MIN_RATE_HZ:g} Hz to {MAX_RATE_HZ:g} Hz",
            remedy="state the unit of the times, in the header as t [ms] or in a --columns file as "
            'unit = "day", or correct the rate',
        )


def resolve_times(
    time: Float1D | None,
    table: ForeignTable,
    columns: Sequence[ForeignColumn],
    stated_hz: float | None,
) -> SampleTimes:
    """Return the times by those in s, (row,), or without them by a rate that is stated.

    `columns` are those to import, which may state a rate; `stated_hz` is that of the user. Times
    that do not rise evenly, because they are rounded, yield to a stated rate that is theirs.
    """
    if time is None:
        times = _resolve_stated_rate(table, columns, stated_hz)
    else:
        times = _resolve_column(time, table, stated_hz)
    check_plausible_rate(times.rate_hz, table, times.source)
    file_rates = [table.facts[key] for key in ("rate_hz", "other_rate_hz") if key in table.facts]
    is_settled = time is not None and stated_hz is not None
    differ = [hz for hz in file_rates if abs(times.rate_hz / hz - 1.0) > MAX_INTERVAL_ERROR]
    if differ and len(differ) == len(file_rates) and not is_settled:
        raise InputError(
            f"{table.kind}; it states {differ[0]:.9g} Hz, but {times.source} tells "
            f"{times.rate_hz:.9g} Hz",
            where=table.path,
            remedy="find out which one is right: state rate_hz in a map if it is that of the "
            "times, else correct the file",
        )
    return times


def _resolve_column(time: Float1D, table: ForeignTable, stated_hz: float | None) -> SampleTimes:
    """Return the times of a column, in s, which must be those of a stated rate."""
    source = "its column of times"
    try:
        rate_hz, index, notes = fit_uniform_rate(time, table)
    except InputError as error:
        if stated_hz is None or time.size < 3 or not np.isfinite(time[[0, -1]]).all():
            raise
        mean_hz = (time.size - 1) / float(time[-1] - time[0]) if time[-1] > time[0] else 0.0
        check_rate(stated_hz, mean_hz, table.path, TIME_COLUMN, MAX_INTERVAL_ERROR, "rate_hz")
        note = f"the stated {stated_hz:.9g} Hz replace the times of the file: {error.problem}"
        return SampleTimes(stated_hz, np.arange(time.size), float(time[0]), "the map", (note,))
    if stated_hz is not None:
        check_rate(stated_hz, rate_hz, table.path, TIME_COLUMN, RATE_TOLERANCE, "rate_hz")
    return SampleTimes(rate_hz, index, float(time[0]), source, (*notes,))


def fit_uniform_rate(time: Float1D, table: ForeignTable) -> tuple[float, Int1D, list[str]]:
    """Fit a uniform rate to times in s, (row,); return (rate in Hz, index of each row, notes).

    After a pause the clock may stand between two samples: the pause is rounded to whole ones.
    Raises InputError if time does not rise or is not uniform.
    """
    if time.size < 3:
        raise InputError(f"{time.size} samples", where=table.path, allowed="three or more")
    gaps = _measure_gaps(time, table)
    elapsed = time - time[0]
    is_regular = gaps < 1.5 * np.median(gaps)
    counts = np.rint(gaps / gaps[is_regular].mean())
    is_pause = counts > PAUSE_SAMPLES
    segment = np.concatenate([[0], np.cumsum(is_pause)])
    period = _fit_period(elapsed, np.concatenate([[0.0], np.cumsum(counts)]), segment)
    steps = np.where(is_pause, gaps / period, counts)
    places, moved = (
        np.concatenate([[0.0], np.cumsum(each)]) for each in (steps, steps - np.rint(steps))
    )
    start = float(np.mean(elapsed - period * places))
    positions = (elapsed - start) / period - moved
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
    notes += [
        f"warning: a pause of {gaps[k]:.9g} s after {table.describe_row(k).rpartition(': ')[2]}"
        for k in np.flatnonzero(is_pause)[:MAX_PAUSES]
    ]
    worst = float(np.abs(deviation).max())
    if worst > 0.01:
        notes.append(f"time jitters by up to {worst:.2g} of a sample; treated as uniform")
    if abs(time[0]) > 0.5 / rate:
        notes.append(f"time begins at {time[0]:.9g} s; this is sample 0")
    return rate, index, notes


def _fit_period(elapsed: Float1D, index: Float1D, segment: Int1D) -> float:
    """Return the interval in s of times, (row,), by their index within each segment."""
    size = np.bincount(segment)
    place = index - (np.bincount(segment, index) / size)[segment]
    times = elapsed - (np.bincount(segment, elapsed) / size)[segment]
    return float(place @ times / (place @ place))


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
    usual = float(np.median(gaps))
    is_hour = np.abs(np.abs(gaps - usual) - HOUR_S) < max(2.0 * abs(usual), 1e-3)
    if is_hour.any() and abs(usual) < 1.0:
        raise InputError(
            "the clock jumps by one hour, as local time does in spring and autumn",
            where=table.describe_row(int(np.argmax(is_hour)) + 1),
            remedy="export the times in UTC or in seconds, or state the rate (--rate HZ) and leave "
            "the times out",
        )
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
) -> SampleTimes:
    """Return the times of a table without any, from the file or from the user."""
    file_rates = {column.rate_hz for column in columns if column.rate_hz is not None}
    if len(file_rates) > 1:
        rates = ", ".join(f"{rate:.9g} Hz" for rate in sorted(file_rates))
        raise InputError(
            f"{table.kind}; its columns have different rates ({rates})",
            where=table.path,
            remedy="import them one by one",
        )
    size = min(column.size for column in columns)
    if size < 3:
        raise InputError(f"{size} samples", where=table.path, allowed="three or more")
    notes = []
    source = "the map"
    if file_rates:
        (file_hz,) = file_rates
        if rate_hz is not None:
            check_rate(rate_hz, file_hz, table.path, "the file", RATE_TOLERANCE, "rate_hz")
        else:
            rate_hz = _round_rate(file_hz, size)
            source = "the file"
            notes.append(f"sampled at {rate_hz:.9g} Hz, as stated in the file")
    elif rate_hz is None and (rate_hz := find_remark_rate(table)):
        source = "a remark in the file"
        notes.append(f"sampled at {rate_hz:.9g} Hz, by a remark in the file")
    if rate_hz is None:
        raise InputError(
            f"{table.kind} without times: no column {TIME_COLUMN}",
            where=table.path,
            remedy="add one, or state `rate_hz = ...` in a --columns file",
        )
    start_s = max(column.start_s for column in columns)
    if start_s:
        notes.append(f"time begins at {start_s:.9g} s; this is sample 0")
    return SampleTimes(rate_hz, np.arange(size), start_s, source, (*notes,))


def check_unused_times(table: ForeignTable, size: int, stated_hz: float) -> None:
    """Raise InputError if a stated rate is that of no unit of a column of times, left unused."""
    names = [
        name
        for name, column in table.columns.items()
        if column.size >= size and find_quantity(name, column.unit) == "time"
    ]
    name = find_time_column(table, names) if names else ""
    if not name:
        return
    times = table.read_column(name)
    step = float(times[-1] - times[0]) / (times.size - 1)
    unit = find_stated_unit(name, table.columns[name].unit)
    rates = [1.0 / (step * TIME_UNITS[each]) for each in ([unit] if unit else TIME_UNITS)]
    is_count = step == 1.0 and not unit
    if not is_count and all(abs(rate / stated_hz - 1.0) > MAX_INTERVAL_ERROR for rate in rates):
        check_rate(
            stated_hz, rates[0], table.path, f"column {name!r}", MAX_INTERVAL_ERROR, "rate_hz"
        )


def align_starts(table: ForeignTable, columns: Sequence[ForeignColumn]) -> list[int]:
    """Return the first row of each column that all have, by the start times that the file states.

    InputError if the columns were sampled at different instants, or share none.
    """
    rate_hz = max((column.rate_hz or 0.0 for column in columns), default=0.0)
    starts = [column.start_s for column in columns]
    if len({*starts}) < 2 or not rate_hz or any(column.clock for column in columns):
        return [0] * len(columns)
    rows = [(max(starts) - start) * rate_hz for start in starts]
    if any(abs(row - round(row)) > MAX_JITTER_SAMPLES for row in rows):
        raise InputError(
            f"{table.kind}; its columns start at {min(starts):.9g} s and {max(starts):.9g} s, "
            f"which is no whole number of samples at {rate_hz:.9g} Hz",
            where=table.path,
            remedy="resample them to one clock, or import them one by one",
        )
    firsts = [round(row) for row in rows]
    if min(column.size - first for column, first in zip(columns, firsts, strict=True)) < 3:
        raise InputError(
            f"{table.kind}; its columns start at {min(starts):.9g} s and {max(starts):.9g} s and "
            "have no time in common",
            where=table.path,
            remedy="import them one by one",
        )
    return firsts


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
