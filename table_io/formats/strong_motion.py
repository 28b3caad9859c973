"""Readers of strong-motion records: PEER AT2 and DT2, CSMIP and COSMOS Volume 2, K-NET, SMC.

ESM, ITACA and others whose header lines are `KEY: value` are text tables of one column (`text`).
Sources: https://ngawest2.berkeley.edu, format of .AT2 and .DT2, old and new headers; California
Strong Motion Instrumentation Program, Report OSMS 85-03 (line "points of accel data equally spaced
at"); K-NET ASCII format (https://www.kyoshin.bosai.go.jp); Strong-motion data format of COSMOS,
V1.20 (line "acceleration pts", time step in entry 34 of the real header); USGS Open-File Report
92-296A, format SMC (11 lines of text, 48 integers, 50 real numbers, remarks, samples).
"""

import math
import re
from collections.abc import Callable
from pathlib import Path, PurePath
from typing import TextIO

import numpy as np

from table_io.errors import InputError
from table_io.formats.layout import is_number
from table_io.formats.table import ForeignColumn, ForeignTable
from table_io.formats.words import normalize_unit

PEER_SUFFIXES = (".at2", ".dt2", ".vt2")
PEER_KIND, VOLUME_2_KIND = "a PEER record", "a CSMIP or COSMOS V2 record"
KNET_KIND = "a K-NET record"
KNET_WORDS = "Origin Time"
SMC_KIND = "an SMC record of USGS"
SMC_WORDS = re.compile(
    r"\s*([1-4]) (?:(?:un)?corrected )?(accelerogram|velocity|displacement)", re.I
)
SMC_UNITS = {"accelerogram": "cm/s2", "displacement": "cm"}
SMC_HEADERS = ((11, 6, 10), (17, 10, 15))  # lines before, lines, width: integers, real numbers
SMC_WIDTH = 10  # of a sample
HISTORY_UNITS = ("g", "cm/s2", "m/s2", "mm/s2", "cm", "mm", "m")
MAX_HEADER_CHARS = 200  # of a line, in which a header is looked for
COSMOS_STEP_ENTRY = 34  # of the real header: time between samples in s
NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[EeDd][-+]?\d+)?"
INTEGRALS = re.compile(
    r"\s*\d+\s+(?:points of (?:veloc|displ)\w* data equally|(?:velocity|displacement) pts)",
    re.IGNORECASE,
)
BLOCK_ENDS = ("/&", "end-of-data")


def is_volume_2(name: str) -> bool:
    """Return whether a file is a corrected accelerogram by its name: .v2, .V2c."""
    return PurePath(name).suffix.lower().startswith(".v2")


def parse_peer(file: TextIO, path: Path) -> ForeignTable:
    """Read a file of the PEER ground motion database: header with NPTS and DT, then values in g."""
    lines = file.read().splitlines()
    pattern = re.compile(
        rf"NPTS\s*=\s*(?P<n>\d+).*?DT\s*=\s*(?P<dt>{NUMBER})"
        rf"|^\s*(?P<n0>\d+)\s+(?P<dt0>{NUMBER})\s+NPTS",
        re.IGNORECASE,
    )
    matches = _find_lines(lines, pattern)
    if not matches:
        raise InputError(
            f"{PEER_KIND} without a line of NPTS and DT",
            where=path,
            allowed="the header of a PEER file, such as NPTS= 4000, DT= .0100 SEC",
        )
    at, match = matches[0]
    units = _find_lines(lines[: at + 1], re.compile(r"UNITS OF\s+(\S+)", re.IGNORECASE))
    unit = _read_unit(units[0][1][1] if units else "g", f"{path}")
    values = _parse_words(lines[at + 1 :], path, at + 2, str.split)
    place = f"{path}: row {at + 1}"
    _check_count(place, int(match["n"] or match["n0"]), len(values))
    step_s = _parse_step(match["dt"] or match["dt0"], place)
    return ForeignTable(
        path, PEER_KIND, {"history": _make_history(values, unit, step_s, 1)}, first_row=at + 2
    )


def parse_knet(file: TextIO, path: Path) -> ForeignTable:
    """Read a record of K-NET or KiK-net: header, then counts, eight a line, about their mean."""
    lines = file.read().splitlines()
    patterns = {
        "rate": rf"^Sampling Freq\(Hz\)\s+({NUMBER})",
        "scale": rf"^Scale Factor\s+({NUMBER})\(gal\)/({NUMBER})",
        "end": r"^Memo\.",
    }
    places = {key: _find_lines(lines, re.compile(text)) for key, text in patterns.items()}
    if not all(places.values()):
        raise InputError(
            f"{KNET_KIND} without {', '.join(key for key, lines in places.items() if not lines)}",
            where=path,
            allowed="lines of Sampling Freq(Hz), Scale Factor and Memo.",
        )
    at = places["end"][0][0]
    counts = np.array(_parse_words(lines[at + 1 :], path, at + 2, str.split))
    scale = places["scale"][0][1]
    factor = float(scale[1]) / float(scale[2])
    values = factor * (counts - counts.mean()) if counts.size else counts
    step_s = 1.0 / float(places["rate"][0][1][1])
    return ForeignTable(
        path, KNET_KIND, {"history": _make_history([*values], "cm/s2", step_s, 1)}, first_row=at + 2
    )


def parse_smc(file: TextIO, path: Path) -> ForeignTable:
    """Read a record of the strong-motion CDs of USGS: fixed columns, headers without names."""
    lines = file.read().splitlines()
    quantity = (SMC_WORDS.match(lines[0]) or [""] * 3)[2].lower()
    integers, numbers = (
        [
            float(word) if is_number(word) else math.nan
            for line in lines[before : before + count]
            for word in _make_splitter(width)(line)
        ]
        for before, count, width in SMC_HEADERS
    )
    if len(integers) < 17 or len(numbers) < 2 or not math.isfinite(integers[15] + integers[16]):
        raise InputError(f"{SMC_KIND} whose header is cut off", where=path, remedy="get it whole")
    unit = _read_unit(SMC_UNITS.get(quantity, quantity), f"{path}")
    first = sum(SMC_HEADERS[1][:2]) + int(integers[15])  # below as many remarks
    values = _parse_words(lines[first:], path, first + 1, _make_splitter(SMC_WIDTH))
    _check_count(f"{path}", int(integers[16]), len(values))
    step_s = _parse_step(f"{1.0 / numbers[1] if numbers[1] else math.nan}", f"{path}: row 18")
    history = _make_history(values, unit, step_s, 1)
    return ForeignTable(path, SMC_KIND, {"history": history}, first_row=first + 1)


def parse_volume_2(file: TextIO, path: Path) -> ForeignTable:
    """Read the accelerations of all channels of a corrected accelerogram, as `channel 1`, ..."""
    lines = file.read().splitlines()
    pattern = re.compile(
        rf"^\s*(?P<n>\d+)\s+(?:points of accel\w* data equally spaced at\s*(?P<dt>{NUMBER})\s*sec"
        rf"|acceleration pts)(?P<rest>.*)",
        re.IGNORECASE,
    )
    table = ForeignTable(path, VOLUME_2_KIND)
    for number, (at, match) in enumerate(_find_lines(lines, pattern), 1):
        place, rest = f"{path}: row {at + 1}", match["rest"]
        unit_match = re.search(r"(?:units\s*=\s*|\bin\s+)([a-z/^0-9]+)", rest, re.IGNORECASE)
        unit = _read_unit(unit_match[1] if unit_match else "", place)
        step_s = _parse_step(match["dt"] or _find_cosmos_step(lines[:at], path), place)
        width = re.search(r"[FEG](\d+)\.\d", rest, re.IGNORECASE)
        count = int(match["n"])
        values: list[float] = []
        for row, line in enumerate(lines[at + 1 :], at + 2):
            if len(values) >= count or line.lower().startswith(BLOCK_ENDS):
                break
            values += _parse_words([line], path, row, _make_splitter(int(width[1]) if width else 0))
        _check_count(place, count, len(values))
        table.columns[f"channel {number}"] = _make_history(values, unit, step_s, number)
    if not table.columns:
        raise InputError(f"{VOLUME_2_KIND} with 0 channels of acceleration", where=path)
    return table


def drop_integrals(text: str) -> str:
    """Return the text of a V2 file without its blocks of velocity and displacement."""
    kept, is_integral = list[str](), False
    for line in text.split("\n"):
        if INTEGRALS.match(line[:MAX_HEADER_CHARS]):
            is_integral = True
        elif line.lower().startswith(BLOCK_ENDS):
            is_integral = False
        if not is_integral:
            kept.append(line)
    return "\n".join(kept)


def _make_history(values: list[float], unit: str, step_s: float, number: int) -> ForeignColumn:
    history = np.array(values)
    return ForeignColumn(history.size, (number,), unit, 1.0 / step_s, values=history)


def _make_splitter(width: int) -> Callable[[str], list[str]]:
    """Return the function that cuts a line into numbers: by width, since they may touch; or 0."""
    if not width:
        return str.split
    return lambda line: [line[k : k + width] for k in range(0, len(line.rstrip()), width)]


def _find_cosmos_step(lines: list[str], path: Path) -> str:
    """Return the time step of the last real header in a part of a COSMOS file, as text."""
    pattern = re.compile(r"real-header values follow on\s*(\d+)\s*lines.*?\(\d*[FEG](\d+)", re.I)
    headers = _find_lines(lines, pattern)
    if not headers:
        raise InputError(f"{VOLUME_2_KIND} without a real header of the time step", where=path)
    at, match = headers[-1]
    split = _make_splitter(int(match[2]))
    cells = [cell for line in lines[at + 1 : at + 1 + int(match[1])] for cell in split(line)]
    return cells[COSMOS_STEP_ENTRY - 1] if len(cells) >= COSMOS_STEP_ENTRY else ""


def _find_lines(lines: list[str], pattern: re.Pattern[str]) -> list[tuple[int, re.Match[str]]]:
    """Return (index, match) of the lines in whose beginning the pattern is found."""
    return [
        (at, match)
        for at, line in enumerate(lines)
        if (match := pattern.search(line[:MAX_HEADER_CHARS]))
    ]


def _parse_step(text: str, place: str) -> float:
    """Return the time step in s of a header."""
    number = text.replace("D", "E").replace("d", "e")
    step_s = float(number) if is_number(number) else math.nan
    if not 0.0 < step_s < math.inf:
        raise InputError(f"{text.strip()!r} is no time step", where=place, allowed="above 0 s")
    return step_s


def _read_unit(text: str, place: str) -> str:
    """Return the unit of a header; InputError if it is of no displacement or acceleration."""
    unit = normalize_unit(text.strip(".,;()"))
    if unit not in HISTORY_UNITS:
        raise InputError(
            f"its unit {text!r} is not read",
            where=place,
            allowed=", ".join(HISTORY_UNITS),
            remedy="give the file of the acceleration",
        )
    return unit


def _check_count(place: str, stated: int, count: int) -> None:
    if stated != count:
        raise InputError(
            f"the header states {stated} samples, but {count} follow",
            where=place,
            remedy="get the whole file",
        )


def _parse_words(
    lines: list[str], path: Path, first: int, split: Callable[[str], list[str]]
) -> list[float]:
    """Return the numbers of lines, of which the first has the number `first`."""
    values: list[float] = []
    for number, line in enumerate(lines, first):
        try:
            numbers = [float(word) for word in split(line)]
        except ValueError:
            numbers = [math.nan]
        if not all(map(math.isfinite, numbers)):
            raise InputError(
                f"{line.strip()[:40]!r} is not a line of finite numbers",
                where=f"{path}: row {number}",
                remedy="get the whole file, or correct the line",
            )
        values += numbers
    return values
