"""Least squares that control, loop check and protection share: orders and the response."""

import cmath

import numpy as np
import pytest

from table_io.block import Float1D
from table_io.control.order_tracking import (
    HARMONIC_COUNT,
    estimate_harmonic_error,
    evaluate_gain,
    evaluate_transfer,
    track_channels,
    track_harmonics,
)
from table_io.records import FrequencyResponse

RATE_HZ = 2000.0


def wave(
    frequency_hz: float, cycles: float, amplitudes: list[complex], offset: float = 0.0
) -> tuple[Float1D, np.ndarray]:
    """(samples, phase in cycles) of a sum of harmonics."""
    phase = 0.3 + np.arange(round(cycles * RATE_HZ / frequency_hz)) * frequency_hz / RATE_HZ
    orders = np.arange(1, len(amplitudes) + 1)
    turns = np.exp(2j * np.pi * np.outer(orders, phase))
    return offset + np.imag(np.array(amplitudes) @ turns), phase


def test_phase_that_the_drive_blends_is_followed() -> None:
    time = np.arange(4000) / RATE_HZ
    phase = 2.0 * time + 0.4 * time**2  # a chirp
    fit = track_harmonics(0.7 * np.sin(2 * np.pi * phase + 0.2), phase)
    assert fit.fundamental == pytest.approx(0.7, rel=1e-9)
    assert np.angle(fit.amplitudes[0]) == pytest.approx(0.2, abs=1e-9)


def test_several_channels_at_once_are_each_alone() -> None:
    low, phase = wave(3.0, 2, [1.0, 0.2])
    other, _ = wave(3.0, 2, [0.5j])
    both = track_channels(np.array([low, other]), phase)
    for fit, alone in zip(both, (low, other), strict=True):
        np.testing.assert_array_equal(fit.amplitudes, track_harmonics(alone, phase).amplitudes)


@pytest.mark.parametrize("harmonics", [1, 2, 3, 10])
@pytest.mark.parametrize("samples_per_cycle", [3.9, 4.0, 7.9, 8.0, 12.0, 20.5, 41.0, 300.0])
def test_fit_is_the_least_squares_solution_with_the_orders_that_the_samples_resolve(
    samples_per_cycle: float, harmonics: int
) -> None:
    phase = 0.3 + np.arange(300) / samples_per_cycle
    values = np.random.default_rng(harmonics).standard_normal(phase.size)
    fit = track_harmonics(values, phase, harmonics)
    orders = min(harmonics, int(300 * samples_per_cycle / (4 * 299)))
    if orders == 0:
        assert np.isnan([fit.offset, fit.residual_rms, fit.fundamental]).all()
        return
    turns = 2 * np.pi * np.outer(phase, np.arange(1, orders + 1))
    basis = np.hstack([np.ones((phase.size, 1)), np.sin(turns), np.cos(turns)])
    solution, squares, *_ = np.linalg.lstsq(basis, values, rcond=None)
    expected = np.zeros(harmonics, dtype=complex)
    expected[:orders] = solution[1 : orders + 1] + 1j * solution[orders + 1 :]
    assert fit.offset == pytest.approx(solution[0], abs=1e-9)
    np.testing.assert_allclose(fit.amplitudes, expected, rtol=0, atol=1e-9)
    assert (fit.amplitudes[orders:] == 0.0).all()
    assert fit.residual_rms == pytest.approx(np.sqrt(squares[0] / phase.size), rel=1e-9)


@pytest.mark.parametrize("orders", [1, 2, 3])
def test_fit_needs_two_samples_for_each_coefficient(orders: int) -> None:
    for count in range(1, 20):
        phase = np.arange(count) / 100.0
        fit = track_harmonics(np.cos(phase), phase, orders)
        assert np.isfinite(fit.offset) == (count >= 2 * (2 * orders + 1))


@pytest.mark.parametrize("lost", [np.nan, np.inf, -np.inf])
def test_lost_sample_leaves_no_order_with_a_number(lost: float) -> None:
    values, phase = wave(100.0, 30, [1.0])  # five orders of ten
    values[7] = lost
    fit = track_harmonics(values, phase)
    assert fit.amplitudes.size == HARMONIC_COUNT
    assert np.isnan(fit.amplitudes).all()
    assert np.isnan([fit.offset, fit.residual_rms]).all()


# The response between and beyond its points


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


@pytest.mark.parametrize("smoothed", [1, 60])
def test_error_of_harmonics_is_that_of_repeated_measurements(smoothed: int) -> None:
    """White noise, and noise through a low-pass of 30 ms, as feedback to the command passes one."""
    rng, orders = np.random.default_rng(3), 9
    motion, phase = wave(3.0, 10, [1.0, 0.2j, 0.05], offset=0.1)
    truth, fits, stated = track_harmonics(motion, phase, orders), [], []
    for _ in range(60):
        noise = rng.standard_normal(phase.size + smoothed - 1)
        values = motion + 0.1 * np.convolve(noise, np.ones(smoothed) / smoothed, "valid")
        fit = track_harmonics(values, phase, orders)
        fits.append([fit.offset - truth.offset, *np.abs(fit.amplitudes - truth.amplitudes)])
        stated.append(estimate_harmonic_error(values, phase, orders))
    true = np.sqrt(np.mean(np.sum(np.square(fits), axis=1)))
    assert np.sqrt(np.mean(np.square(stated))) == pytest.approx(true, rel=0.08)
    assert estimate_harmonic_error(motion, phase, orders) < 1e-12


def test_error_of_harmonics_needs_two_cycles_and_every_sample() -> None:
    values, phase = wave(3.0, 2, [1.0])
    assert np.isfinite(estimate_harmonic_error(values, phase, 3))
    assert np.isnan(estimate_harmonic_error(values[:700], phase[:700], 3))
    values[5] = np.nan
    assert np.isnan(estimate_harmonic_error(values, phase, 3))
