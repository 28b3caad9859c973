"""Numbers for people: units and digits."""

import pytest

from twin.results.quantities import format_quantity


@pytest.mark.parametrize(
    ("value", "unit", "half", "text"),
    [
        (0.00204567, "m", None, "2.05 mm"),
        (-8.2e-6, "m", None, "−8.20 µm"),
        (510343.49704, "N/m", 1234.5, "510.3 ± 1.2 kN/m"),
        (510343.49704, "N/m", 123.45, "510.34 ± 0.12 kN/m"),
        (60.0, "N", 7.0, "60.0 ± 7.0 N"),
        (1.234e7, "N/m3", 2.0e5, "(1.234 ± 0.020)·10⁷ N/m³"),
        (0.0, "m/s2", None, "0.0 m/s²"),
        (1.05, "", 0.0021, "1.0500 ± 0.0021"),
        (float("nan"), "m", None, "–"),
        (None, "m", None, "–"),
    ],
)
def test_digits_follow_the_interval(
    value: float | None, unit: str, half: float | None, text: str
) -> None:
    assert format_quantity(value, unit, half) == text
