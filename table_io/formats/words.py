"""What names and remarks in foreign tables say: units, quantities, and facts of the test."""

import re
from collections.abc import Iterable, Mapping, Sequence

from table_io.units import UNITS

UNIT_SPELLINGS = {
    "meter": "m", "meters": "m", "metre": "m", "metres": "m",
    "millimeter": "mm", "millimetre": "mm", "millimeters": "mm", "millimetres": "mm",
    "centimeter": "cm", "centimetre": "cm", "inch": "in", "inches": "in", '"': "in",
    "feet": "ft", "foot": "ft", "ms-2": "m/s2", "m*s-2": "m/s2",
    "gn": "g", "g's": "g", "gs": "g", "gal": "cm/s2",
    "g": "g", "cm": "cm", "mm": "mm", "hz": "Hz", "in": "in", "ft": "ft", "ms": "ms",
    "kip": "kip", "lbf": "lbf", "kgf": "kgf",
    "newton": "N", "newtons": "N", "n": "N", "kn": "kN", "kips": "kip", "lb": "lbf", "lbs": "lbf",
    "pounds": "lbf", "volt": "V", "volts": "V", "v": "V", "mv": "mV",
    "°c": "degC", "degc": "degC", "celsius": "degC",
    "sec": "s", "secs": "s", "second": "s", "seconds": "s", "msec": "ms", "msecs": "ms",
    "millisecond": "ms", "milliseconds": "ms", "millis": "ms", "micros": "us", "usec": "us",
    "usecs": "us", "microsecond": "us",
    "microseconds": "us", "nsec": "ns", "nanoseconds": "ns", "minute": "min",
    "minutes": "min", "mins": "min", "h": "hour", "hr": "hour", "hours": "hour", "d": "day",
    "days": "day",
}  # fmt: skip
TIME_UNITS = {
    "s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "hour": 3600.0, "day": 86400.0,
}  # fmt: skip
TIME_NAMES = ("s", "ms", "us")  # units that may be the name of a column
KNOWN_UNITS = {*UNITS, *TIME_UNITS, "Hz", "-"}
AMBIGUOUS_ENDINGS = ("d", "h")  # of a name: "acc_d" is not in days
BRACKETS = re.compile(r"\(([^()]+)\)|\[([^\[\]]+)\]|\{([^{}]+)\}|<([^<>]+)>")
# Of a unit, such as 10^3, x1000, 1e-3 and 1/100: with one of them the name tells no unit.
FACTOR = re.compile(r"\d\s*(?:\^|\*\*)|(?<!\*)[*×]\s*\d|\bx\s?10+\b|\d[eE][-+]?\d|\b1/\d")
MASS_UNITS_KG = {"kg": 1.0, "t": 1e3, "ton": 1e3, "tons": 1e3, "tonnes": 1e3, "lb": 0.45359237}
FACT_NAMES = {
    "rate_hz": (
        r"(?:sampling|sample|scan|acquisition|export|output|storage|logging|recording)"
        r"[ _]*(?:rate|frequency|freq)|rate_hz|fs|f_s"
        r"|samples[ _]*per[ _]*second|abtast(?:rate|frequenz)"
        r"|(?:tasa|frecuencia) de muestreo|frequenza di campionamento"
    ),
    "interval_s": (
        r"(?:sampling|sample|scan|time)[ _]*(?:interval|period|step|increment)(?:_s)?|dt|ts"
        r"|delta[ _]?t|wf_increment|intervalo de muestreo|passo di campionamento"
    ),
    "mass_kg": r"(?:total|moving|specimen|test|payload)?[ _]*mass(?:_kg)?|m_kg",
}
RATE_SPREAD = 0.01  # of rates that are the same, one of them by an interval with few digits
NUMBER = r"[-+]?\d+(?:[.,]\d+)?(?:[eE][-+]?\d+)?"
QUANTITY_WORDS = {
    "time": {"t", "time", "timestamp", "elapsed", "zeit", "tempo", "temps", "tiempo"},
    "displacement": {
        "x", "u", "d", "disp", "displ", "displacement", "dist", "distance", "pos", "position",
        "laser", "lvdt", "stroke", "deformation", "elongation", "spostamento", "weg",
    },
    "acceleration": {"a", "acc", "accel", "acceleration", "accelerometer", "accelerazione"},
    "force": {"f", "force", "forc", "load", "loadcell", "cell", "lc", "reaction", "forza", "kraft"},
    "velocity": {"v", "vel", "velocity", "speed"},
}  # fmt: skip
QUANTITY_UNITS = {"m": "displacement", "m/s2": "acceleration", "N": "force", "m/s": "velocity"}
LABEL_FIELDS = ("Name", "name", "label", "Label", "title")  # of an element of a structure array
UNIT_FIELDS = ("Unit", "unit", "units")  # next to its data
MIN_PREFIX_LETTERS = 4  # "accelero" is an accelerometer


def normalize_unit(unit: str) -> str:
    """Return the unit in canonical spelling if it is known."""
    text = re.sub(r"\s+since\s.*", "", unit.strip())  # "seconds since 2026-03-28" of netCDF
    text = text.replace("²", "2").replace("µ", "u").replace("μ", "u")
    for character in ("^", "**", " ", "(", ")", "[", "]"):
        text = text.replace(character, "")
    if text in KNOWN_UNITS:
        return text
    folded = text.lower()
    if "/" in folded:
        folded = re.sub("sec(?=2|/|$)", "s", folded).replace("/s/s", "/s2")
    known = UNIT_SPELLINGS.get(folded, folded if "/" in folded else text)
    return known if known in KNOWN_UNITS else text


def is_unit(text: str) -> bool:
    """Return True if the text is a unit that the reader knows."""
    return normalize_unit(text) in KNOWN_UNITS


def find_unit(name: str) -> str:
    """Return the unit in brackets in a column name, or at its end: "load/kN" or "load in kN"."""
    text = find_bracketed(name)
    if FACTOR.search(name):
        return ""
    if not text and (match := re.fullmatch(r"(.*\w)(?:\s*/\s*| in )([^/\s]+)", name.strip())):
        text = "" if is_unit(split_words(match[1])[-1]) else match[2]  # m/s is one unit
    return normalize_unit(text) if is_unit(text) else ""


def find_bracketed(name: str) -> str:
    """Return the unit in brackets in a column name, else what its last brackets hold, or ""."""
    texts = ["".join(filter(None, match.groups())).strip() for match in BRACKETS.finditer(name)]
    units = [text for text in texts if is_unit(text)]
    return units[0] if len({*map(normalize_unit, units)}) == 1 else "".join(texts[-1:])


def find_unknown_unit(name: str) -> str:
    """Return what stands for a unit in a column name and is none, such as "10 N" and "daN"."""
    text = find_bracketed(name)
    if is_unit(text):
        return name if FACTOR.search(name) else ""
    is_factor = re.search(r"\d", text) and any(map(is_unit, re.findall(r"[^\W\d_]+", text)))
    return text if is_factor or text.isalpha() or text == "%" else ""


def find_stated_unit(name: str, unit: str = "") -> str:
    """Return the unit of a column by the file, or by the end of its name (acc_m_s2), or ""."""
    stated = normalize_unit(unit) or find_unit(name)
    # In brackets with more than a unit, that may be a factor on it: "(10 mm)".
    if stated or re.search(r"\d", find_bracketed(name)) or FACTOR.search(name):
        return stated
    words = re.split(r"[^a-zA-Z0-9/²]+", name.strip(" )]"))
    if len(words) == 1 and len(name) > 1 and (alone := normalize_unit(name)) in TIME_NAMES:
        return alone  # a column named "sec" or "millis"
    if len(words) > 2 and is_unit("/".join(words[-2:])):
        return normalize_unit("/".join(words[-2:]))
    has_unit = len(words) > 1 and is_unit(words[-1]) and words[-1].lower() not in AMBIGUOUS_ENDINGS
    return normalize_unit(words[-1]) if has_unit else ""


def split_words(name: str) -> list[str]:
    """Return the lower-case words of a column name, without a unit in brackets at its end."""
    bare = re.sub(r"[(\[][^()\[\]]*[)\]]\s*$", "", name)
    spaced = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", bare)
    return [word for word in re.split(r"[^a-zA-Z0-9]+", spaced.lower()) if word]


def matches_words(words: Sequence[str], known: set[str]) -> bool:
    """Return True if one of the words is known, but for a number at its end or a longer ending."""
    return any(
        word.rstrip("0123456789") in known
        or word in known
        or (
            len(word) >= MIN_PREFIX_LETTERS
            and any(len(k) >= MIN_PREFIX_LETTERS and word.startswith(k) for k in known)
        )
        for word in words
    )


def find_quantity(name: str, unit: str = "") -> str:
    """Return the quantity of a column by its unit, else by its name; "" if neither tells.

    Beside another unit, as volts, a letter is no quantity: "Channel A" is the first one.
    """
    stated = find_stated_unit(name, unit)
    if stated in TIME_UNITS:
        return "time"
    if stated not in UNITS:
        return find_named_quantity(name)
    by_unit = QUANTITY_UNITS.get(UNITS[stated][0])
    return by_unit or find_named_quantity(name, with_letters=False)


def find_named_quantity(name: str, with_letters: bool = True) -> str:
    """Return the one quantity that the words of a name tell; "" if there is none, or several.

    Without `with_letters` a single letter is no word of it.
    """
    words = [word for word in split_words(name) if with_letters or len(word) > 1]
    long_words = [word for word in words if len(word.rstrip("0123456789")) > 1]
    quantities = [key for key, known in QUANTITY_WORDS.items() if matches_words(words, known)]
    if len(quantities) > 1:  # "acc x": a letter may be an axis
        quantities = [
            key for key, known in QUANTITY_WORDS.items() if matches_words(long_words, known)
        ] or quantities
    return quantities[0] if len(quantities) == 1 else ""


def find_label(texts: Mapping[str, str]) -> str:
    """Return the label of an element of a structure array by its texts, without a path; or ""."""
    label = next((texts[field] for field in LABEL_FIELDS if texts.get(field)), "")
    return re.split(r"/(?![^\[(]*[\])])", label)[-1]  # not at the slash of a unit in brackets


def read_facts(lines: Iterable[str]) -> dict[str, float]:
    """Return the facts of a test that lines of text state: `rate_hz`, `mass_kg`."""
    facts: dict[str, float] = {}
    for line in lines:
        for key, names in FACT_NAMES.items():
            brackets = r"(?:[(\[]([^)\]]*)[)\]])?"
            pattern = rf"(?i)(?<!\w)(?:{names})\s*{brackets}\s*[:=,;\s]\s*({NUMBER})\s*([a-z]*)"
            if match := re.search(pattern, line):
                add_fact(facts, key, _parse(match[2]), match[1] or match[3])
                if re.fullmatch(rf"(?:\s+{NUMBER})+\s*", rest := line[match.end() :]):
                    for word in rest.split():  # of further channels
                        add_fact(facts, key, _parse(word), match[1] or "")
    return facts


def _parse(number: str) -> float:
    return float(number.replace(",", "."))


def add_fact(facts: dict[str, float], key: str, value: float, unit: str = "") -> None:
    """Add a fact in SI: `rate_hz`, `mass_kg`, or the rate of an `interval_s`.

    A second rate that differs is `other_rate_hz`.
    """
    if value <= 0:
        return
    if key == "mass_kg":
        facts[key] = value * MASS_UNITS_KG.get(unit.lower(), 1.0)
        return
    if key == "interval_s":
        rate_hz = 1.0 / (value * TIME_UNITS.get(normalize_unit(unit), 1.0))
    else:
        rate_hz = value * (1e3 if unit.lower() == "khz" else 1.0)
    if abs(facts.setdefault("rate_hz", rate_hz) / rate_hz - 1.0) > RATE_SPREAD:
        facts["other_rate_hz"] = rate_hz


def find_fact(name: str) -> str:
    """Return the fact that a variable of this name holds: `rate_hz`, `interval_s`, `mass_kg`."""
    for key, names in FACT_NAMES.items():
        if re.fullmatch(rf"(?i)(?:{names})", name.rpartition("/")[2]):
            return key
    return ""
