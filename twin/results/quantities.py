"""Numbers for people: SI values in mm, um, kN, with the digits that an interval allows."""

import math

SCALES: dict[str, tuple[tuple[float, str], ...]] = {  # of the smallest size, the unit shown
    "m": ((1e-4, "mm"), (0.0, "µm")),
    "m/s": ((0.0, "mm/s"),),
    "N": ((1e3, "kN"), (0.0, "N")),
    "N/m": ((1e3, "kN/m"), (0.0, "N/m")),
    "N s/m": ((1e4, "kN s/m"), (0.0, "N s/m")),
    "s": ((1.0, "s"), (0.0, "ms")),
    "m/s2": ((0.0, "m/s²"),),
}
FACTORS = {"mm": 1e3, "µm": 1e6, "mm/s": 1e3, "kN": 1e-3, "kN/m": 1e-3, "kN s/m": 1e-3, "ms": 1e3}
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
MAX_PLAIN = 1e5  # larger numbers are written as a power of ten
MIN_PLAIN = 1e-4


def format_quantity(
    value: float | None, unit: str, half_width: float | None = None, digits: int = 3
) -> str:
    """Format an SI value with its unit, and with ± half of its interval where that is known.

    The interval is written with two digits and determines those of the value; without it the value
    has `digits` significant digits.
    """
    if value is None or not math.isfinite(value):
        return "–"
    if half_width is not None and not math.isfinite(half_width):
        half_width = None
    size = max(abs(value), half_width or 0.0)
    shown = next(
        (name for least, name in SCALES.get(unit, ()) if size >= least),
        unit.translate(str.maketrans("23", "²³")),
    )
    factor = FACTORS.get(shown, 1.0)
    value *= factor
    half = half_width * factor if half_width is not None else None
    exponent = math.floor(math.log10(abs(value))) if value else 0
    power = ""
    if abs(value) >= MAX_PLAIN or 0 < abs(value) < MIN_PLAIN:
        value, half = value / 10.0**exponent, None if half is None else half / 10.0**exponent
        power, exponent = f"·10{str(exponent).translate(SUPERSCRIPTS)}", 0
    resolution = half if half else abs(value) * 10.0 ** (2 - digits) or 1.0
    decimals = max(0, 1 - math.floor(math.log10(resolution)))
    text = f"{value:.{decimals}f}"
    if half:
        text = f"{text} ± {half:.{decimals}f}"
        text = f"({text})" if power else text
    return f"{text}{power} {shown}".strip().replace("-", "−")
