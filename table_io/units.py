"""Units allowed in config files, each with its SI unit and conversion factor."""

GRAVITY_M_S2 = 9.80665

UNITS: dict[str, tuple[str, float]] = {
    "m": ("m", 1.0), "mm": ("m", 1e-3), "um": ("m", 1e-6),
    "m/s2": ("m/s2", 1.0), "g": ("m/s2", GRAVITY_M_S2),
    "N": ("N", 1.0), "kN": ("N", 1e3),
}  # fmt: skip
