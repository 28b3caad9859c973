"""Harmonics by least squares, which control, loop check, protection and comparison share."""

import numpy as np
import pytest

from table_io.block import Float1D
from table_io.harmonics import (
    HARMONIC_COUNT,
    estimate_harmonic_error,
    find_steady_extremes,
    track_channels,
    track_harmonics,
)

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


@pytest.mark.parametrize("samples", [100, 200, 400])  # of a cycle
def test_a_short_impact_is_not_smoothed_into_its_swing(samples: int) -> None:
    """A stiff bumper for a fiftieth of a cycle; 30 harmonics would take a fifth of it away."""
    phase = 0.123 + np.arange(8 * samples) / samples
    pushed = np.maximum(np.cos(2 * np.pi * (phase - 0.25)), 0.0) ** 400
    u = np.sin(2 * np.pi * phase) + 0.02 * pushed
    noisy = u + np.random.default_rng(1).normal(0.0, 3e-4, u.size)
    ends = find_steady_extremes(noisy, phase)
    assert ends is None or ends[0] == pytest.approx(1.02, abs=1e-3)
    smooth = np.sin(2 * np.pi * phase) + 0.02 * np.sin(6 * np.pi * phase)
    assert find_steady_extremes(smooth + noisy - u, phase) is not None


def test_the_mean_of_cycles_is_no_error_of_harmonics() -> None:
    values, phase = wave(3.0, 10, [1.0])
    means = np.random.default_rng(4).normal(0.0, 0.1, 11)[np.floor(phase - phase[0]).astype(int)]
    assert estimate_harmonic_error(values + means, phase, 3) < 0.01


def test_a_trend_between_cycles_is_no_noise_of_the_harmonics() -> None:
    phase = np.arange(800) / 100.0
    steady, trend = np.sin(2 * np.pi * phase), np.linspace(1.0, -0.5, phase.size)
    noise = np.random.default_rng(2).normal(0.0, 0.01, phase.size)
    known = estimate_harmonic_error(steady + noise, phase, 3)
    error = estimate_harmonic_error(trend * steady + noise, phase, 3)
    assert 0.0 < known < 0.01
    assert error < 0.05  # the scatter of the cycles would be 0.17
