"""Layout of a table of text cells: preamble, column names, units, first row of numbers.

Laboratory files begin with what their program liked to write: remarks, a line of names, a line of
units. The samples begin at the first row of numbers that is followed by another of the same width;
the line above it holds the names, or the units below the names; all above that is preamble.
"""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from table_io.units import UNITS

MAX_HEAD_ROWS = 200  # in which the first row of numbers must be
COMMENT_MARKS = "#%!/;*'"
UNIT_SPELLINGS = {
    "meter": "m", "meters": "m", "metre": "m", "metres": "m",
    "millimeter": "mm", "millimetre": "mm", "millimeters": "mm", "millimetres": "mm",
    "centimeter": "cm", "centimetre": "cm", "inch": "in", "inches": "in", '"': "in",
    "feet": "ft", "foot": "ft",
    "m/s/s": "m/s2", "ms-2": "m/s2", "m*s-2": "m/s2", "m/sec2": "m/s2", "m/s^2": "m/s2",
    "gn": "g", "g's": "g", "gs": "g", "gal": "cm/s2", "cm/sec2": "cm/s2", "in/sec2": "in/s2",
    "mm/sec": "mm/s", "m/sec": "m/s", "in/sec": "in/s", "cm/sec": "cm/s",
    "newton": "N", "newtons": "N", "n": "N", "kn": "kN", "kips": "kip", "lb": "lbf", "lbs": "lbf",
    "pounds": "lbf", "volt": "V", "volts": "V", "v": "V", "mv": "mV",
    "°c": "degC", "degc": "degC", "celsius": "degC",
    "sec": "s", "second": "s", "seconds": "s", "msec": "ms", "hz": "Hz",
}  # fmt: skip
TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "min": 60.0}
MASS_UNITS_KG = {"kg": 1.0, "t": 1e3, "ton": 1e3, "tons": 1e3, "tonnes": 1e3, "lb": 0.45359237}
FACT_NAMES = {
    "rate_hz": (r"(?:sampling|sample|scan|acquisition)[ _]*(?:rate|frequency|freq)|rate_hz|fs|f_s"),
    "interval_s": (
        r"(?:sampling|sample|time)[ _]*(?:interval|period|step|increment)|dt|ts|delta_?t"
    ),
    "mass_kg": r"(?:total|moving|specimen|test|payload)?[ _]*mass(?:_kg)?|m_kg",
}
NUMBER = r"[-+]?\d+(?:[.,]\d+)?(?:[eE][-+]?\d+)?"


@dataclass(frozen=True)
class TableLayout:
    """Names and stated units of the columns, index of the first row of numbers, stated facts.

    `facts` may hold `rate_hz` and `mass_kg`. `names` is empty if the file has none.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    first_row: int
    width: int
    has_decimal_commas: bool = False
    facts: dict[str, float] = field(default_factory=dict)


def find_layout(rows: Sequence[Sequence[str]]) -> TableLayout | None:
    """Find the layout of the first rows of a table of cells; None without a row of numbers."""
    commas = _has_decimal_commas(rows)
    numeric = [_is_row_of_numbers(row, commas) for row in rows]
    for index, row in enumerate(rows):
        width = len(_strip_end(row))
        following = [k for k in range(index + 1, len(rows)) if any(map(str.strip, rows[k]))]
        is_last = not following
        if numeric[index] and (
            is_last
            or (numeric[following[0]] and len(_strip_end(rows[following[0]])) == width)
            or (index > 0 and _names_above(rows, index, width))
        ):
            break
    else:
        return None
    above = [k for k in range(index) if any(map(str.strip, rows[k]))]
    names: tuple[str, ...] = ()
    units = ("",) * width
    if above and (header := _fit_names(rows[above[-1]], width)):
        names, above = header, above[:-1]
        if all(not name or is_unit(name) for name in names) and any(names):
            units = tuple(normalize_unit(name) for name in names)
            names = _fit_names(rows[above[-1]], width) if above else ()
            above = above[:-1] if names else above
    units = tuple(unit or find_unit(name) for unit, name in zip(units, names or units, strict=True))
    facts = read_facts(" ".join(rows[k]).strip() for k in above)
    return TableLayout(names, units, index, width, commas, facts)


def _names_above(rows: Sequence[Sequence[str]], index: int, width: int) -> bool:
    """Return True if the nearest filled row above names as many columns."""
    above = [row for row in rows[:index] if any(map(str.strip, row))]
    return bool(above) and bool(_fit_names(above[-1], width))


def _fit_names(row: Sequence[str], width: int) -> tuple[str, ...]:
    """Return the cells of a row as `width` names; () if they are numbers or of another count."""
    cells = [cell.strip() for cell in _strip_end(row)]
    if cells and cells[0][:1] in COMMENT_MARKS:
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
    if len(cells) != width or all(is_number(cell) for cell in cells):
        return ()
    return tuple(cells)


def _strip_end(row: Sequence[str]) -> Sequence[str]:
    """Return the row without one empty cell at its end, the mark of a trailing delimiter."""
    return row[:-1] if len(row) > 1 and not row[-1].strip() else row


def _is_row_of_numbers(row: Sequence[str], commas: bool) -> bool:
    cells = [cell.strip() for cell in row]
    return any(cells) and all(
        not cell or is_number(cell.replace(",", ".") if commas else cell) for cell in cells
    )


def is_number(cell: str) -> bool:
    """Return True if a cell of a table is a number, with a decimal point if any."""
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _has_decimal_commas(rows: Sequence[Sequence[str]]) -> bool:
    """Return True if numbers have decimal commas, and none a decimal point."""
    cells = [cell.strip() for row in rows for cell in row]
    if any("." in cell and is_number(cell) for cell in cells):
        return False
    return any(re.fullmatch(r"[-+]?\d*,\d+(?:[eE][-+]?\d+)?", cell) for cell in cells)


def normalize_unit(unit: str) -> str:
    """Return the unit in canonical spelling if it is known."""
    text = unit.strip().replace("²", "2").replace("µ", "u").replace("μ", "u")
    for character in ("^", "**", " ", "(", ")", "[", "]"):
        text = text.replace(character, "")
    return text if text in UNITS else UNIT_SPELLINGS.get(text.lower(), text)


def is_unit(text: str) -> bool:
    """Return True if the text is a unit that an import knows."""
    return normalize_unit(text) in {*UNITS, *TIME_UNITS, "Hz", "-"}


def find_unit(name: str) -> str:
    """Return the unit that a column name states in brackets at its end, as "load [kN]", or ""."""
    match = re.search(r"[(\[]([^()\[\]]+)[)\]]\s*$", name)
    return normalize_unit(match[1]) if match and is_unit(match[1]) else ""


def read_facts(lines: Iterable[str]) -> dict[str, float]:
    """Return the facts of a test that lines of text state: `rate_hz`, `mass_kg`."""
    facts: dict[str, float] = {}
    for line in lines:
        for key, names in FACT_NAMES.items():
            brackets = r"(?:[(\[]([^)\]]*)[)\]])?"
            pattern = rf"(?i)(?<!\w)(?:{names})\s*{brackets}\s*[:=,;\s]\s*({NUMBER})\s*([a-z]*)"
            if match := re.search(pattern, line):
                value = float(match[2].replace(",", "."))
                add_fact(facts, key, value, match[1] or match[3])
    return facts


def add_fact(facts: dict[str, float], key: str, value: float, unit: str = "") -> None:
    """Add a fact in SI: `rate_hz`, `mass_kg`, or the rate of an `interval_s`."""
    if value <= 0:
        return
    if key == "mass_kg":
        facts[key] = value * MASS_UNITS_KG.get(unit.lower(), 1.0)
    elif key == "interval_s":
        facts.setdefault("rate_hz", 1.0 / (value * TIME_UNITS.get(normalize_unit(unit), 1.0)))
    else:
        facts["rate_hz"] = value * (1e3 if unit.lower() == "khz" else 1.0)


def find_fact(name: str) -> str:
    """Return the fact that a variable of this name holds: `rate_hz`, `interval_s`, `mass_kg`."""
    for key, names in FACT_NAMES.items():
        if re.fullmatch(rf"(?i)(?:{names})", name.rpartition("/")[2]):
            return key
    return ""
