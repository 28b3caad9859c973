"""The table's frequency response between and beyond its identified points."""

import cmath

import numpy as np
import pytest

from table_io.control.table_response import evaluate_gain, evaluate_transfer
from table_io.records import FrequencyResponse


def test_point_gives_a_constant_gain_and_a_constant_delay() -> None:
    fitted = FrequencyResponse(0, (2.0,), (0.9,), (-0.2,))
    for f in (0.5, 2.0, 8.0):
        assert evaluate_transfer(fitted, f) == pytest.approx(0.9 * cmath.exp(-0.1j * f))


POINTS_HZ = (7.0, 0.5, 11.0, 5.0, 3.0, 9.0)  # in any order
RANGE_HZ = np.array([*np.linspace(0.1, 11.0, 24), 12.0, 15.0])


@pytest.mark.parametrize("curvature", [-0.3, 0.0, 0.4])
@pytest.mark.parametrize("slope", [-0.5, 0.6])
def test_gain_between_the_points_is_quadratic_and_beyond_them_flat_or_linear(
    slope: float, curvature: float
) -> None:
    """Of 1 / gain^2 in f^2: quadratic inside, constant below, with the mean slope above."""

    def inverse(f: float) -> float:
        z = (f / 11.0) ** 2
        return 2.0 + slope * z + curvature * z**2

    fitted = FrequencyResponse(
        0, POINTS_HZ, tuple(inverse(f) ** -0.5 for f in POINTS_HZ), (0.0,) * len(POINTS_HZ)
    )
    squares = (np.array(POINTS_HZ) / 11.0) ** 2
    mean_slope = np.polyfit(squares, [inverse(f) for f in POINTS_HZ], 1)[0]
    for f in RANGE_HZ:
        expected = inverse(min(max(f, 0.5), 11.0))
        expected += mean_slope * max((f / 11.0) ** 2 - 1.0, 0.0)
        assert evaluate_gain(fitted, f) ** -2 == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_phase_is_odd_in_frequency_inside_and_beyond_the_points(sign: float) -> None:
    def angle(f: float) -> float:
        return sign * (0.05 * f + 2e-4 * f**3)

    phases = tuple(angle(f) for f in POINTS_HZ)
    fitted = FrequencyResponse(0, POINTS_HZ, (0.7,) * len(POINTS_HZ), phases)
    for f in RANGE_HZ:
        expected = 0.7 * cmath.exp(1j * angle(f))
        assert abs(evaluate_transfer(fitted, f) - expected) < 1e-9


@pytest.mark.parametrize("seed", range(4))
def test_noisy_points_are_fitted_by_least_squares_of_three_and_two_terms(seed: int) -> None:
    draw = np.random.default_rng(seed)
    ratio = np.array(POINTS_HZ) / 11.0
    inverse = 1.0 + 0.2 * ratio**2 + 0.05 * draw.standard_normal(ratio.size)
    phase = -0.6 * ratio + 0.05 * draw.standard_normal(ratio.size)
    fitted = FrequencyResponse(0, POINTS_HZ, tuple(inverse**-0.5), tuple(phase))
    curve = np.polyfit(ratio**2, inverse, 2)
    odd, *_ = np.linalg.lstsq(np.stack([ratio, ratio**3], axis=1), phase, rcond=None)
    for x in np.linspace(0.5 / 11.0, 1.0, 20):
        gain = np.polyval(curve, x**2) ** -0.5
        expected = gain * cmath.exp(1j * (odd[0] * x + odd[1] * x**3))
        assert abs(evaluate_transfer(fitted, 11.0 * x) - expected) < 1e-9


@pytest.mark.parametrize(("gain", "bound"), [((1.0, 0.5), 0.5 / 4.0), ((0.5, 0.6), 0.6 * 4.0)])
def test_extrapolated_gain_stays_within_four_times_the_identified_range(
    gain: tuple[float, float], bound: float
) -> None:
    fitted = FrequencyResponse(0, (1.0, 4.0), gain, (0.0, 0.0))
    trend = np.diff(np.array(gain) ** -2.0)[0] / (1.0 - 1.0 / 16.0)
    for f in np.linspace(4.0, 40.0, 37):
        linear = gain[1] ** -2.0 + trend * ((f / 4.0) ** 2 - 1.0)
        inside = linear > 0 and (linear**-0.5 > bound) == (bound < 0.5)
        expected = linear**-0.5 if inside else bound
        assert evaluate_gain(fitted, f) == pytest.approx(expected, rel=1e-9)
    assert evaluate_gain(fitted, 40.0) == pytest.approx(bound, rel=1e-12)


@pytest.mark.parametrize(("gap", "has_slope"), [(1.6e-3, False), (2.4e-3, True)])
def test_points_too_close_together_determine_no_slope(gap: float, has_slope: bool) -> None:
    """The singular values of two points have a ratio of half their distance; the bound is 1e-3."""
    fitted = FrequencyResponse(0, (1.0 - gap, 1.0), (0.9, 1.1), (0.0, 0.0))
    beyond = evaluate_gain(fitted, 1.5)
    if has_slope:
        assert beyond == pytest.approx(1.1 * 4.0)  # runs away to its bound
    else:
        assert 0.5 < beyond < 1.5
