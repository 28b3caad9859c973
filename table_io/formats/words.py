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
    "g": "g", "cm": "cm", "mm": "mm", "hz": "Hz",
    "newton": "N", "newtons": "N", "n": "N", "kn": "kN", "kips": "kip", "lb": "lbf", "lbs": "lbf",
    "pounds": "lbf", "volt": "V", "volts": "V", "v": "V", "mv": "mV",
    "°c": "degC", "degc": "degC", "celsius": "degC",
    "sec": "s", "second": "s", "seconds": "s", "msec": "ms", "millisecond": "ms",
    "milliseconds": "ms", "microseconds": "us", "nanoseconds": "ns", "minute": "min",
    "minutes": "min", "mins": "min", "h": "hour", "hr": "hour", "hours": "hour", "d": "day",
    "days": "day",
}  # fmt: skip
TIME_UNITS = {
    "s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "hour": 3600.0, "day": 86400.0,
}  # fmt: skip
KNOWN_UNITS = {*UNITS, *TIME_UNITS, "Hz", "-"}
AMBIGUOUS_ENDINGS = ("d", "h")  # of a name: "acc_d" is not in days
MASS_UNITS_KG = {"kg": 1.0, "t": 1e3, "ton": 1e3, "tons": 1e3, "tonnes": 1e3, "lb": 0.45359237}
FACT_NAMES = {
    "rate_hz": (
        r"(?:sampling|sample|scan|acquisition)[ _]*(?:rate|frequency|freq)|rate_hz|fs|f_s"
        r"|samples[ _]*per[ _]*second|abtast(?:rate|frequenz)"
    ),
    "interval_s": (
        r"(?:sampling|sample|scan|time)[ _]*(?:interval|period|step|increment)(?:_s)?|dt|ts"
        r"|delta[ _]?t"
    ),
    "mass_kg": r"(?:total|moving|specimen|test|payload)?[ _]*mass(?:_kg)?|m_kg",
}
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
    text = unit.strip().replace("²", "2").replace("µ", "u").replace("μ", "u")
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
    """Return the unit at the end of a column name, as "load [kN]", "load/kN" or "load in kN"."""
    text = find_bracketed(name)
    if not text and (match := re.fullmatch(r"(.*\w)(?:\s*/\s*| in )([^/\s]+)", name.strip())):
        text = "" if is_unit(split_words(match[1])[-1]) else match[2]  # m/s is one unit
    return normalize_unit(text) if is_unit(text) else ""


def find_bracketed(name: str) -> str:
    """Return what stands in brackets at the end of a column name, or ""."""
    match = re.search(r"[(\[]([^()\[\]]+)[)\]][\s:]*$", name)
    return match[1].strip() if match else ""


def find_stated_unit(name: str, unit: str = "") -> str:
    """Return the unit of a column by the file, or by the end of its name (acc_m_s2), or ""."""
    stated = normalize_unit(unit) or find_unit(name)
    if stated:
        return stated
    words = re.split(r"[^a-zA-Z0-9/²]+", name.strip(" )]"))
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
    """Return the quantity of a column by its unit, else by its name; "" if neither tells."""
    stated = find_stated_unit(name, unit)
    if stated in TIME_UNITS:
        return "time"
    by_unit = QUANTITY_UNITS.get(UNITS[stated][0]) if stated in UNITS else None
    if by_unit:
        return by_unit
    words = split_words(name)
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
