"""The response between and beyond its points: one, two, three, eight, and noisy ones."""

import cmath
import math
from collections.abc import Callable

import numpy as np
import pytest

from table_io.records import FrequencyResponse
from table_io.safety.loop_check import evaluate_gain, evaluate_transfer


def double_pole(f: float, corner_hz: float = 31.0, delay_s: float = 5e-3) -> complex:
    return cmath.exp(-2j * math.pi * f * delay_s) / (1 + 1j * f / corner_hz) ** 2


def response(
    frequencies_hz: tuple[float, ...], true: Callable[[float], complex]
) -> FrequencyResponse:
    values = [true(f) for f in frequencies_hz]
    phase = np.unwrap(np.angle(values))
    return FrequencyResponse(0, frequencies_hz, tuple(map(abs, values)), tuple(phase.tolist()))


@pytest.mark.parametrize(
    ("frequencies_hz", "inside", "beyond"),
    [
        ((1.0, 3.16, 10.0), 0.004, 0.12),
        ((1.0, 10.0), 0.01, 0.12),
        ((0.5, 1.0, 2.0, 3.0, 5.0, 7.0, 8.5, 10.0), 0.004, 0.12),
    ],
)
def test_a_response_goes_smoothly_through_its_points_and_on(
    frequencies_hz: tuple[float, ...], inside: float, beyond: float
) -> None:
    fitted = response(frequencies_hz, double_pole)
    for f in np.linspace(0.2, 10.0, 50):
        assert abs(evaluate_transfer(fitted, f) / double_pole(f) - 1) < inside
        assert evaluate_gain(fitted, f) == pytest.approx(abs(evaluate_transfer(fitted, f)))
    for f in np.linspace(10.0, 25.0, 20):
        assert abs(evaluate_transfer(fitted, f) / double_pole(f) - 1) < beyond


def test_one_point_gives_a_constant_gain_and_a_constant_delay() -> None:
    fitted = FrequencyResponse(0, (2.0,), (0.9,), (-0.2,))
    for f in (0.5, 2.0, 8.0):
        assert evaluate_transfer(fitted, f) == pytest.approx(0.9 * cmath.exp(-0.1j * f))


def test_noise_in_points_close_together_does_not_run_away_beyond_them() -> None:
    generator = np.random.default_rng(3)
    for _ in range(50):
        gain = tuple(1.0 + 0.004 * generator.standard_normal(3))
        fitted = FrequencyResponse(0, (0.5, 0.632, 0.8), gain, (-0.047, -0.06, -0.075))
        assert evaluate_gain(fitted, 0.05) == pytest.approx(evaluate_gain(fitted, 0.5))
        assert 0.9 < evaluate_gain(fitted, 1.0) < 1.1
        assert 0.2 < evaluate_gain(fitted, 4.0) < 5.0
