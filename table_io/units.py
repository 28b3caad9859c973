"""Units allowed in config files, each with its SI unit and conversion factor.

Temperatures are recorded in degrees Celsius, the only recorded unit that is not SI.
"""

GRAVITY_M_S2 = 9.80665
INCH_M = 0.0254
POUND_FORCE_N = 4.4482216152605

UNITS: dict[str, tuple[str, float]] = {
    "m": ("m", 1.0), "mm": ("m", 1e-3), "um": ("m", 1e-6), "cm": ("m", 1e-2),
    "in": ("m", INCH_M), "ft": ("m", 12 * INCH_M),
    "m/s": ("m/s", 1.0), "mm/s": ("m/s", 1e-3), "cm/s": ("m/s", 1e-2), "in/s": ("m/s", INCH_M),
    "m/s2": ("m/s2", 1.0), "g": ("m/s2", GRAVITY_M_S2), "mg": ("m/s2", 1e-3 * GRAVITY_M_S2),
    "cm/s2": ("m/s2", 1e-2), "mm/s2": ("m/s2", 1e-3), "in/s2": ("m/s2", INCH_M),
    "N": ("N", 1.0), "kN": ("N", 1e3), "MN": ("N", 1e6),
    "lbf": ("N", POUND_FORCE_N), "kip": ("N", 1e3 * POUND_FORCE_N), "kgf": ("N", GRAVITY_M_S2),
    "rad": ("rad", 1.0), "mrad": ("rad", 1e-3), "rad/s": ("rad/s", 1.0), "mrad/s": ("rad/s", 1e-3),
    "m/m": ("m/m", 1.0), "um/m": ("m/m", 1e-6),
    "degC": ("degC", 1.0),
    "Pa": ("Pa", 1.0), "kPa": ("Pa", 1e3), "bar": ("Pa", 1e5), "MPa": ("Pa", 1e6),
    "V": ("V", 1.0), "mV": ("V", 1e-3),
}  # fmt: skip
