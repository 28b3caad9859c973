"""Layout of a table of text cells: preamble, column names, units, first row of samples.

Laboratory files begin with what their program liked to write: remarks, a line of names, a line of
units. The samples begin at the first row of numbers that is followed by another of the same width;
the line above it holds the names, or the units below the names; all above that is preamble. Where
no row has numbers alone, a column may hold text, times of day, or numbers with their unit.
"""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from table_io.block import Float1D
from table_io.formats.table import MAX_MATRIX_COLUMNS
from table_io.formats.words import find_unit, is_unit, normalize_unit, read_facts

MAX_HEAD_ROWS = 200  # in which the first row of samples must be
COMMENT_MARKS = "#%!/;*'"
CONVERTED_MARK = "# variable "  # begins the remark above the columns of a converted record
MIN_ALIKE_SHARE = 0.9  # of the rows below the first one of samples, by which cells are text
DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+(?:[eE][-+]?\d+)?")
FORTRAN = re.compile(r"\s*[-+]?\d*\.?\d*[dD][-+]?\d+\s*")
# Words that loggers and spreadsheets write for a lost sample, in lower case.
LOST_MARKS = {
    "na", "n/a", "#n/a", "null", "-", "--", "---", "nan(ind)", "-nan(ind)", "1.#qnan", "-1.#qnan",
    "1.#ind", "-1.#ind", "#div/0!", "#num!", "#value!",
}  # fmt: skip
RULE = re.compile(r"[-=_]{2,}")  # below a head
# Minus signs, an apostrophe, and blanks that do not break, between thousands.
PLAIN_MARKS = str.maketrans(
    {"−": "-", "–": "-", "’": "'", "\u00a0": "'", "\u202f": "'", "\u2009": "'"}
)
# With marks of thousands that cannot be decimal commas: 1,234.5 and 1'234.
THOUSANDS = re.compile(r"\s*[-+]?\d{1,3}(?:(?:,\d{3})+\.\d*|(?:'\d{3})+(?:\.\d*)?)\s*")
COMMA_THOUSANDS = re.compile(r"\s*[-+]?\d{1,3}(?:\.\d{3})+,\d*\s*")  # 1.234,5
ROW_WORDS = ("TS", "RN", "NO.")  # units of a time stamp and of a row number, in loggers
# Line below the units of those loggers: how the samples of a column were reduced.
REDUCTIONS = {"", "Smp", "Avg", "Tot", "Max", "Min", "Std"}
START_ROW = re.compile(r"\W*(?:t0|start[ _]?times?)\W*", re.IGNORECASE)
UNIT_LINE = re.compile(r"\W*units?\s*[:=]\s*(\S+)", re.IGNORECASE)
UNIT_KEY = re.compile(r"\W*(?:[vy]|vertical)?\W*(?:axis)?\W*units?\W*", re.IGNORECASE)
QUANTITY = re.compile(r"([-+]?[\d.,]*\d[.,]?(?:[eE][-+]?\d+)?)\s*([^\d\s.,].*)")  # 12.3 mm
SIGNED = re.compile(r"([-+])\s+(?=[\d.])")  # + 1.02
HOUR_S, DAY_S = 3600.0, 86400.0
MINUTES = re.compile(r"(\d\d?):(\d\d[.,]\d+)")  # and seconds, as spreadsheets show short times
# Date, or days since the start, and time; its milliseconds may follow a colon: 23:59:59:500.
CLOCK = re.compile(
    r"(?:(\d{1,4})([-/.])(\d\d?)[-/.](\d{1,4})[ T]+|(\d+) days? )?"
    r"(\d\d?):(\d\d)(?::(\d\d(?:[.,]\d+|:\d{3})?))? ?([AP]M)?(Z|[-+]\d\d:?\d\d)?",
    re.IGNORECASE,
)
# 29-Mar-2026 of MATLAB, 29 March 2026, Mar 29, 2026, and 20260329T235959.
NAMED_MONTH = re.compile(r"(\d\d?)[-. /]([A-Z]{3})[a-z]*[-. /](\d{4})", re.IGNORECASE)
MONTH_FIRST = re.compile(r"([A-Z]{3})[a-z]* (\d\d?),? (\d{4})", re.IGNORECASE)
MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
BASIC_DATE = re.compile(r"(\d{4})(\d\d)(\d\d)T(\d\d)(\d\d)(?=\d\d)")


@dataclass(frozen=True)
class TableLayout:
    """Names and stated units of the columns, index of the first row of samples, stated facts.

    `names` is empty if the file has none; `spare` are names beyond the last column. `kinds` are
    those of the cells, by `_find_kind`. `head`: the cells of the rows above the samples.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    first_row: int
    kinds: str
    has_decimal_commas: bool = False
    spare: tuple[str, ...] = ()
    samples: int = 0  # rows of samples among the first ones
    facts: dict[str, float] = field(default_factory=dict)
    head: frozenset[tuple[str, ...]] = frozenset()

    @property
    def width(self) -> int:
        return len(self.kinds)

    @property
    def column_names(self) -> list[str]:
        """The names, or `column 1`, `column 2`, ... of those without one."""
        names = self.names or ("",) * self.width
        return [name or f"column {number}" for number, name in enumerate(names, 1)]


def find_layout(rows: Sequence[Sequence[str]]) -> TableLayout | None:
    """Find the layout of the first rows of a table of cells; None without a row of samples."""
    commas = _has_decimal_commas(rows)
    kinds = ["".join(_find_kind(cell, commas) for cell in _strip_end(row)) for row in rows]
    filled = [k for k, kind in enumerate(kinds) if kind.strip()]
    index = _find_numbers(rows, kinds, filled)
    if index is None:
        index = _find_samples(kinds, filled)
    if index is None:
        return None
    first, alike = filled.index(index), kinds[index]
    while first and _is_sample(kinds[filled[first - 1]], alike):
        first, index = first - 1, filled[first - 1]
    width = len(kinds[index])
    rows_below = [kinds[k].ljust(width) for k in filled[first:]]
    below = [row for row in rows_below if _is_alike(row, kinds[index])]
    kind = "".join(
        next((k for k in column if k != " "), " ") for column in zip(*below, strict=True)
    )
    names, units, above = _find_names(rows, filled[:first], kind)
    if len(names) == len(rows[index]) == len(kind) + 1:  # a last column whose first cell is empty
        last = "".join(_find_kind(rows[k][-1], commas) for k in filled[first:] if rows[k])
        kind, units = kind + last.strip()[:1].ljust(1), (*units, "")
    units = tuple(
        unit or find_unit(name) for unit, name in zip(units, names or units, strict=False)
    )
    remarks = [" ".join(rows[k]).strip() for k in above]
    if units == ("",):  # of a single column a line of its own may state the unit
        stated = [match[1] for line in remarks if (match := UNIT_LINE.match(line))]
        units = tuple(normalize_unit(unit) for unit in stated[:1]) or units
    facts = read_facts(remarks) | _compare_starts([rows[k] for k in above])
    samples = sum(_is_alike(kinds[k].ljust(len(kind)), kind) for k in filled[first:])
    spare = names[len(kind) :]
    head = frozenset(map(strip_cells, rows[:index]))
    return TableLayout(names[: len(kind)], units, index, kind, commas, spare, samples, facts, head)


def _compare_starts(rows: Iterable[Sequence[str]]) -> dict[str, float]:
    """Return as a fact how far the starts of channels are apart in s, if a row states them."""
    for row in rows:
        starts = [cell.strip() for cell in row[1:] if cell.strip()]
        is_one = CLOCK.fullmatch(" ".join(starts))  # a date, and its time in the next cell
        if START_ROW.fullmatch(row[0]) and len({*starts}) > 1 and not is_one:
            clock = ClockReader()
            try:
                times = [clock(cell) for cell in starts]
            except ValueError:
                times = [np.nan]
            return {"starts_apart_s": float(np.ptp(times))}
    return {}


def _find_numbers(
    rows: Sequence[Sequence[str]], kinds: Sequence[str], filled: Sequence[int]
) -> int | None:
    """Return the first row of numbers with another one below it, or names above it."""
    for place, index in enumerate(filled):
        below = filled[place + 1 :]
        if not set(kinds[index]) <= {"n", " "}:
            continue
        width = len(kinds[index])
        if below and set(kinds[below[0]]) <= {"n", " "} and len(kinds[below[0]]) == width:
            return index
        above = filled[place - 1] if place else index
        is_named = bool(place) and "t" in kinds[above] and bool(_fit_names(rows[above], width))
        if (not place and not below) or is_named:
            return index
    return None


def _is_sample(above: str, first: str) -> bool:
    """Return True if the row above the first that is alike with those below is a sample, too.

    It has notes: the numbers of the first one, and text where that has none. Or, above numbers with
    units, it has no text, as names have: a unit or a cell is missing.
    """
    if "q" in first and "t" not in above:
        return len(above) <= len(first)
    is_same = all(b in (a, " ") for a, b in zip(above, first, strict=False))
    return "t" in above and len(first) <= len(above) and is_same


def _find_samples(kinds: Sequence[str], filled: Sequence[int]) -> int | None:
    """Return the first row with numbers, or times, and text in the same places as those below."""
    for place, index in enumerate(filled[:-1]):
        kind, below = kinds[index], [kinds[k] for k in filled[place + 1 :]]
        # All rows below are compared only where the first two are alike: a table may be long.
        if (
            {"n", "c", "q"} & {*kind}
            and all(_is_alike(kind, other) for other in below[:2])
            and sum(_is_alike(kind, other) for other in below) >= MIN_ALIKE_SHARE * len(below)
        ):
            return index
    return None


def _is_alike(first: str, second: str) -> bool:
    return len(first) == len(second) and all(
        a == b or " " in (a, b) for a, b in zip(first, second, strict=True)
    )


def _find_names(
    rows: Sequence[Sequence[str]], above: Sequence[int], kinds: str
) -> tuple[tuple[str, ...], tuple[str, ...], Sequence[int]]:
    """Return (names, units, rows above them) from the filled rows above the samples."""
    width = len(kinds)
    units = ("",) * width
    place = len(above) - 1
    while (
        place > 0 and _is_remark(rows[above[place]]) and not _fit_names(rows[above[place]], width)
    ):
        place -= 1
    names = _fit_names(rows[above[place]], width) if above else ()
    if place > 0 and names and {*names} <= REDUCTIONS:
        place -= 1
        names = _fit_names(rows[above[place]], width)
    if not names:
        return (), units, above
    rest = above[:place]
    other = _fit_names(rows[rest[-1]], width) if rest else ()
    if _are_units(names, kinds if other else ""):
        units = tuple(normalize_unit(name) for name in names[:width])
        names = other
    elif _are_units(other):  # above the names
        units = tuple(normalize_unit(name) for name in other[:width])
    else:
        return *_find_keyed(rows, rest, names, units), rest
    return names, units, rest[:-1] if other else rest


def _find_keyed(
    rows: Sequence[Sequence[str]],
    above: Sequence[int],
    names: tuple[str, ...],
    units: tuple[str, ...],
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return (names, units); of lines that begin with a key, where all columns have one name."""
    width = len(units)
    if width < 3 or len({name for name in names[1:] if name}) != 1:
        return names, units
    for index in reversed(above):
        key, *cells = _fit_names(rows[index], width) or ("",)
        if len(cells) != width - 1:
            continue
        if UNIT_KEY.fullmatch(key) and all(map(is_unit, cells)):
            units = ("", *map(normalize_unit, cells))
        elif all(cells) and len({*cells}) == len(cells) and not any(map(is_number, cells)):
            return (names[0], *cells), units
    return names, units


def _are_units(names: Sequence[str], kinds: str = "") -> bool:
    """Return True if a row is one of units; with `kinds`, that of columns of text may be others."""
    return any(map(is_unit, names)) and all(
        not name or is_unit(name) or name in ROW_WORDS or kinds[k : k + 1] in ("c", "t")
        for k, name in enumerate(names)
    )


def _is_remark(row: Sequence[str]) -> bool:
    return row[0].lstrip()[:1] in ("#", "%")


def _fit_names(row: Sequence[str], width: int) -> tuple[str, ...]:
    """Return the cells of a row as names of `width` columns; () if they are no such names.

    A name more than columns is that of a last column without cells, such as remarks.
    """
    cells = [" ".join(cell.split("\n")).strip().rstrip(": ") for cell in _strip_end(row)]
    if row[0].startswith(CONVERTED_MARK):
        return ()
    if cells and cells[0] and cells[0][0] in COMMENT_MARKS:
        first = cells[0].lstrip(COMMENT_MARKS).strip()
        cells = ([first] if first else []) + cells[1:]
    if len(cells) > width:  # "disp (mm)" of a table separated by blanks
        joined: list[str] = []
        for cell in cells:
            if joined and cell[:1] in "([":
                joined[-1] += f" {cell}"
            else:
                joined.append(cell)
        cells = joined
    if all(is_number(cell) for cell in cells):
        return ()
    is_spare = len(cells) == width + 1 > 2 and not any(cell and is_unit(cell) for cell in cells)
    return tuple(cells) if len(cells) == width or is_spare else ()


def strip_cells(row: Sequence[str]) -> tuple[str, ...]:
    """Return the cells of a row without blanks, by which a head that is repeated is known."""
    return tuple(cell.strip() for cell in _strip_end(row))


def _strip_end(row: Sequence[str]) -> Sequence[str]:
    """Return the row without one empty cell at its end, the mark of a trailing delimiter."""
    return row[:-1] if len(row) > 1 and not row[-1].strip() else row


def _find_kind(cell: str, commas: bool) -> str:
    """Return the kind of a cell: n number, q number with its unit, c time of day, t text, or a
    blank if it is empty."""
    text = cell.strip()
    if not text or text.lower() in LOST_MARKS or RULE.fullmatch(text):
        return " "
    if is_number(use_decimal_point(text) if commas else text):
        return "n"
    if CLOCK.fullmatch(plain_date(text)) or MINUTES.fullmatch(text):
        return "c"
    number, unit = split_quantity(text)
    return "q" if unit and is_number(use_decimal_point(number) if commas else number) else "t"


def split_quantity(cell: str) -> tuple[str, str]:
    """Return the number and the unit of a cell such as "12.3 mm"; (the cell, "") of another one."""
    match = QUANTITY.fullmatch(cell.strip())
    return (match[1], normalize_unit(match[2])) if match and is_unit(match[2]) else (cell, "")


def plain_date(text: str) -> str:
    """Return a time with the name of its month, or without marks, as one with marks alone."""
    text = BASIC_DATE.sub(r"\1-\2-\3 \4:\5:", text)
    for pattern, order in ((NAMED_MONTH, (1, 2, 3)), (MONTH_FIRST, (2, 1, 3))):
        match = pattern.match(text)
        if match and match[order[1]].lower() in MONTHS:
            day, month, year = (match[k] for k in order)
            return f"{day}.{MONTHS.index(month.lower()) + 1}.{year}{text[match.end() :]}"
    return text


def is_number(cell: str) -> bool:
    """Return True if a cell of a table is a number, with a decimal point if any."""
    try:
        parse_number(cell)
    except ValueError:
        return False
    return True


def use_decimal_point(cell: str) -> str:
    """Return a number with a decimal comma, as 1.234,5 too, as one with a point."""
    is_marked = COMMA_THOUSANDS.fullmatch(cell)
    return (cell.replace(".", "") if is_marked else cell).replace(",", ".", 1)


def parse_number(cell: str) -> float:
    """Return the number of a cell, also 1.0D-03 of Fortran and 1,234.5; else ValueError."""
    cell = cell if cell.isascii() else cell.strip().translate(PLAIN_MARKS)
    try:
        return float(cell)
    except ValueError:
        if FORTRAN.fullmatch(cell):
            return float(cell.upper().replace("D", "E"))
        if THOUSANDS.fullmatch(cell):
            return float(re.sub("[,']", "", cell))
        if signed := SIGNED.match(cell.lstrip()):
            return float(signed[1] + cell.lstrip()[signed.end() :])
        raise


def _has_decimal_commas(rows: Sequence[Sequence[str]]) -> bool:
    """Return True if most numbers outside of remarks that have a decimal sign have a comma."""
    filled = [[split_quantity(cell)[0].strip() for cell in row if cell.strip()] for row in rows]
    numbers = [row for row in filled if all(is_number(use_decimal_point(cell)) for cell in row)]
    cells = [cell for row in (numbers if any(numbers) else filled) for cell in row]
    points = sum("." in cell and is_number(cell) for cell in cells)
    commas = (DECIMAL_COMMA.fullmatch(cell) or COMMA_THOUSANDS.fullmatch(cell) for cell in cells)
    return sum(match is not None for match in commas) > points


class ClockReader:
    """Converter of dates and times of day to seconds since the start of the first day, in UTC
    where they state their zone."""

    def __init__(self) -> None:
        self._first_day: int | None = None
        self._is_day_first = False  # of dates with slashes, once one of them tells

    def __call__(self, cell: str) -> float:
        """Return the time of a cell in s; NaN if it is empty, ValueError if it is no time."""
        text = plain_date(cell.strip())
        if short := MINUTES.fullmatch(text):
            return 60.0 * int(short[1]) + float(short[2].replace(",", "."))
        match = CLOCK.fullmatch(text)
        if match is None:
            if text:
                raise ValueError(text)
            return float("nan")
        first, mark, second, third, days, hours, minutes, seconds, half, zone = match.groups()
        hour = int(hours)
        if half:
            hour = hour % 12 + 12 * (half.upper() == "PM")
        time_s = DAY_S * int(days or 0) + 3600.0 * hour + 60.0 * int(minutes)
        time_s += float(re.sub("[,:]", ".", seconds or "0"))
        if zone and zone not in "Zz":
            ahead_s = 3600.0 * int(zone[1:3]) + 60.0 * int(zone[-2:])
            time_s += ahead_s if zone[0] == "-" else -ahead_s
        if not first:
            return time_s
        parts = int(first), int(second), int(third)
        year, month, day = parts
        if len(first) < 3:
            day, month, year = parts
            self._is_day_first |= mark == "." or day > 12
            if not self._is_day_first:
                day, month = month, day
        number = int(np.datetime64(f"{year:04d}-{month:02d}-{day:02d}").astype(int))
        self._first_day = number if self._first_day is None else self._first_day
        return time_s + DAY_S * (number - self._first_day)


class QuantityReader:
    """Converter of cells with a number and its unit, which is that of the first one, in `unit`."""

    def __init__(self) -> None:
        self.unit = ""

    def __call__(self, cell: str) -> float:
        """Return the number of a cell; NaN if it is empty, ValueError if it has another unit."""
        if not cell.strip():
            return float("nan")
        number, unit = split_quantity(cell)
        self.unit = self.unit or unit
        if unit != self.unit:
            raise ValueError(cell)
        return parse_number(number)


def turn_rows(rows: Sequence[Sequence[str]], layout: TableLayout) -> list[tuple[str, ...]]:
    """Return the columns of a table as its rows if its channels are in rows; else none.

    As in a matrix of a binary file, the samples are along the longer side.
    """
    is_named = any(_find_kind(name, layout.has_decimal_commas) == "t" for name in layout.names[1:])
    if is_named or not len(rows) <= MAX_MATRIX_COLUMNS < layout.width:
        return []
    stripped = [[*_strip_end(row)] for row in rows]
    return [*zip(*(row for row in stripped if len(row) == layout.width), strict=True)]


def start_at_zero(times: Float1D) -> Float1D:
    """Return times of day, or of an hour, in s from the first one, (row,), also where they pass
    midnight, or the hour."""
    whole_s = HOUR_S if np.nanmax(times) < HOUR_S else DAY_S
    passed = np.cumsum(np.diff(times, prepend=times[0]) < -0.5 * whole_s)
    from_first: Float1D = times + whole_s * passed - times[0]
    return np.round(from_first, 9)
