"""Laws of the comparison of sensors: planted errors of either sign come back, at any rate."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from table_io.safety.consistency import (
    MIN_AMPLITUDE_RATIO,
    MIN_AMPLITUDE_SNR,
    WeakFormPair,
    compare_motion,
    fit_cell_pair,
    make_window,
    remove_spikes,
)
from table_io.sensor_errors import PairErrors

LAW = settings(max_examples=25, derandomize=True)
RATES = st.sampled_from([500.0, 1000.0, 2000.0, 4000.0])
SIGNS = st.sampled_from([-1.0, 1.0])
PHASES = st.floats(0.0, 1.0)
AMPLITUDE_M = 3e-3


def make_pair(
    rate_hz: float,
    cycles: float = 3.0,
    phase: float = 0.2,
    noise: tuple[float, float] = (0.0, 0.0),
    offset: float = 0.0,
    position: float = 0.0,
    gain: float = 1.0,
) -> WeakFormPair:
    """Return the pair of a tone of `AMPLITUDE_M` with `cycles` in 1.5 s."""
    samples = round(1.5 * rate_hz)
    omega = 2 * math.pi * cycles / 1.5
    t = (np.arange(samples) + 0.5) / rate_hz
    x = AMPLITUDE_M * np.cos(2 * math.pi * (phase - cycles / 2) + omega * t)
    window = make_window(samples, cycles, phase, rate_hz)
    filtered = (np.zeros(samples), 0.0)
    return compare_motion(window, x + position, -gain * omega**2 * x + offset, noise, filtered)


def acceleration_of(cycles: float) -> float:
    """Amplitude of that tone in m/s2."""
    return AMPLITUDE_M * (2 * math.pi * cycles / 1.5) ** 2


@settings(max_examples=8, derandomize=True)
@given(RATES, st.floats(2.0, 5.0), PHASES, st.floats(0.0, 6.0), st.integers(0, 99))
def test_compare_motion_takes_derivatives_by_parts(
    rate_hz: float, cycles: float, phase: float, low_cut: float, seed: int
) -> None:
    """Integration by parts: phi' x is -phi x', and phi'' x is phi x'', at all three orders."""
    chance = np.random.default_rng(seed)
    samples = round(1.5 * rate_hz)
    t = (np.arange(samples) + 0.5) / rate_hz
    x, speed, a, jerk, filtered = np.full((5, samples), [[0.02], [0.0], [0.0], [0.0], [0.0]])
    for tone in 2 * math.pi * chance.uniform(0.1, 8.0, 4) / 1.5:
        wave = AMPLITUDE_M * np.exp(1j * (tone * t + chance.uniform(0.0, 2 * math.pi)))
        x += wave.real
        speed += (1j * tone * wave).real
        a += ((1j * tone) ** 2 * wave).real
        jerk += ((1j * tone) ** 3 * wave).real
        filtered += (1j * tone / (1j * tone + low_cut) * wave).real
    window = make_window(samples, cycles, phase, rate_hz)
    pair = compare_motion(window, x, a, (0.0, 0.0), (filtered, low_cut))
    expected = window.phi @ np.array([a, low_cut * filtered - speed, jerk]).T
    size = np.abs(expected).max(axis=0)
    for row, amplitudes in enumerate((pair.displacement, pair.low_cut_term, -pair.delay_term)):
        assert amplitudes == pytest.approx(expected[:, row], abs=1e-6 * size[row])
    assert pair.acceleration == pytest.approx(expected[:, 0], abs=1e-12 * size[0])
    # The tone that a window is made for, at its middle: the phase by definition.
    tone = np.exp(2j * math.pi * (phase + cycles * (t / 1.5 - 0.5)))
    bell = np.sin(math.pi * t / 1.5) ** 4
    for order in (1, 2):
        expected_phi = 2.0 * bell * tone.conj() ** order / bell.sum()
        assert window.phi[order] == pytest.approx(expected_phi, abs=1e-12)
    assert window.phi[0] == pytest.approx(bell / bell.sum(), abs=1e-12)


@LAW
@given(RATES, st.floats(0.001, 0.3), SIGNS)
def test_mismatch_is_proportional_to_a_gain_error(
    rate_hz: float, error: float, sign: float
) -> None:
    pair = make_pair(rate_hz, gain=1.0 + sign * error)
    expected = error * acceleration_of(3.0)
    assert pair.mismatch == pytest.approx(expected, rel=1e-2)
    assert pair.fundamental_mismatch == pytest.approx(expected, rel=1e-2)
    noisy = replace(pair, sigma=np.full(3, expected / 12))
    assert noisy.fundamental_mismatch == pytest.approx(expected / 2, rel=3e-2)
    assert noisy.mismatch == pytest.approx(expected / 2, rel=3e-2)
    assert replace(pair, sigma=np.full(3, expected / 5)).fundamental_mismatch == 0.0
    assert replace(pair, sigma=np.full(3, expected / 5)).mismatch == 0.0


@LAW
@given(RATES, st.floats(0.01, 2.0), SIGNS, PHASES)
def test_offset_with_its_sign(rate_hz: float, size: float, sign: float, phase: float) -> None:
    pair = make_pair(rate_hz, 3.4, phase, offset=sign * size)
    assert pair.offset == pytest.approx(sign * size, rel=1e-6)
    assert pair.mismatch_without_offset < 1e-6
    assert pair.average == pytest.approx(abs(pair.acceleration[0].real))
    assert pair.average > 0.9 * size - 0.02 * acceleration_of(3.4)


def test_sigma_offset_is_the_scatter_of_draws() -> None:
    chance = np.random.default_rng(5)
    pair = make_pair(1000.0, 3.4)
    sigma = np.array([0.02, 0.05, 0.1])
    offsets = []
    for _ in range(4000):
        noise = sigma * (chance.standard_normal(3) + 1j * chance.standard_normal(3))
        offsets.append(replace(pair, acceleration=pair.acceleration + noise).offset)
    assert np.std(offsets) == pytest.approx(replace(pair, sigma=sigma).sigma_offset, rel=0.05)


@pytest.mark.parametrize("order", [0, 1, 2])
@pytest.mark.parametrize("sign", [-1.0, 1.0, 1.0j])
def test_mismatch_leaves_out_the_average(order: int, sign: complex) -> None:
    """Of the three orders the average is left out, and of the others the largest is taken."""
    values = np.array([2.0, 3.0, 4.0], dtype=np.complex128)
    zeros = np.zeros(3, dtype=np.complex128)
    moved = values.copy()
    moved[order] += 5.0 * sign
    sigma = np.array([0.1, 0.25, 0.5])
    beyond_noise = (0.0, 5.0 - 6.0 * sigma[1], 5.0 - 6.0 * sigma[2])[order]
    constant = np.array([1.0, 0.0, 0.0], dtype=np.complex128)
    for pair in (
        WeakFormPair(values, moved, constant, sigma, zeros, zeros),
        WeakFormPair(moved, values, constant, sigma, zeros, zeros),
    ):
        assert pair.mismatch == pytest.approx(beyond_noise)
        assert pair.mismatch_without_offset == pytest.approx(beyond_noise)
        assert pair.fundamental_mismatch == pytest.approx(beyond_noise if order == 1 else 0.0)
        averages = abs(values[0].real), abs(moved[0].real)
        assert pair.average == pytest.approx(max(averages))


@LAW
@given(st.floats(0.01, 100.0), st.floats(1e-4, 10.0), st.integers(0, 99))
def test_normal_equations_are_weighted_without_offset(
    scale: float, noise: float, seed: int
) -> None:
    """In units of hypot(1 % of the largest amplitude, standard error), an offset eliminated."""
    chance = np.random.default_rng(seed)
    draws = scale * (chance.standard_normal((5, 3)) + 1j * chance.standard_normal((5, 3)))
    displacement, acceleration, constant, low_cut_term, delay_term = draws
    sigma = noise * np.array([1.0, 2.0, 3.0])
    pair = WeakFormPair(displacement, acceleration, constant, sigma, low_cut_term, delay_term)
    largest = max(abs(displacement[1:]).max(), abs(acceleration[1:]).max())
    error = np.hypot(0.01 * largest, sigma)
    columns = np.array([displacement, low_cut_term, delay_term, acceleration, constant]) / error
    columns = np.hstack([columns.real, columns.imag])
    *rows, offset = columns
    free = np.array(rows) - np.outer(np.array(rows) @ offset, offset) / (offset @ offset)
    matrix, rhs = pair.normal_equations()
    assert matrix == pytest.approx(free[:3] @ free[:3].T)
    assert rhs == pytest.approx(free[:3] @ free[3])


@LAW
@given(RATES, st.floats(1e-5, 1e-2), st.floats(1e-3, 1.0))
def test_sigma_of_white_noise(rate_hz: float, in_m: float, in_m_s2: float) -> None:
    quiet, first, second, both = (
        make_pair(rate_hz, noise=noise).sigma
        for noise in ((0.0, 0.0), (in_m, 0.0), (0.0, in_m_s2), (in_m, in_m_s2))
    )
    assert not quiet.any()
    assert both == pytest.approx(np.hypot(first, second))
    # The window has a fourth power of a sine: sum of squares 35/128 of n, sum 3/8 of n.
    samples = round(1.5 * rate_hz)
    assert second == pytest.approx(
        in_m_s2 * math.sqrt(35 / 128 * samples) / (0.375 * samples) * np.array([1.0, 2.0, 2.0])
    )


@pytest.mark.parametrize("limit", ["noise", "motion"])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_is_clear_at_its_thresholds(limit: str, sign: float) -> None:
    pair = make_pair(1000.0)
    for factor in (0.98, 1.02):
        amplitudes = np.array([0.0, sign, 0.0], dtype=np.complex128)
        sigma = np.array([0.0, 1e-9, 0.0])
        if limit == "noise":
            sigma[1] = 1.0 / (factor * MIN_AMPLITUDE_SNR)
        else:
            amplitudes[2] = 1.0 / (factor * MIN_AMPLITUDE_RATIO)
        planted = replace(pair, displacement=amplitudes, acceleration=0 * amplitudes, sigma=sigma)
        assert planted.is_clear == (factor > 1.0)
    # The threshold itself is not clear.
    exact = replace(pair, displacement=np.array([0.0, 20.0, 0.0]), sigma=np.full(3, 1.0))
    assert not exact.is_clear


@LAW
@given(st.floats(-2.0, 2.0), st.floats(-2e-3, 2e-3), st.floats(0.9, 1.1), st.floats(-4.0, 4.0))
def test_remove_errors_of_low_cut_and_delay(
    low_cut: float, delay_s: float, gain: float, offset: float
) -> None:
    chance = np.random.default_rng(7)
    draws = chance.standard_normal((4, 3)) + 1j * chance.standard_normal((4, 3))
    displacement, low_cut_term, delay_term, constant = draws * [[3.0], [1.0], [100.0], [1.0]]
    pair = WeakFormPair(
        displacement,
        gain * (displacement + low_cut * low_cut_term) + delay_s * delay_term,
        constant,
        np.full(3, 1e-3),
        low_cut_term,
        delay_term,
    )
    corrected = pair.remove_errors(PairErrors(gain, low_cut, delay_s))
    assert corrected.acceleration == pytest.approx(corrected.displacement)
    moved = replace(pair, acceleration=pair.acceleration + offset * constant)
    assert np.linalg.solve(*moved.normal_equations()) == pytest.approx(
        [gain, gain * low_cut, delay_s], abs=1e-9
    )


@LAW
@given(st.floats(0.0, 0.2), st.floats(1e-5, 1e-3), SIGNS, st.floats(-4.0, 4.0))
def test_fit_phase_errors_at_a_gain_of_one(
    low_cut: float, size_s: float, sign: float, offset: float
) -> None:
    chance = np.random.default_rng(8)
    draws = chance.standard_normal((4, 3)) + 1j * chance.standard_normal((4, 3))
    displacement, low_cut_term, delay_term, constant = draws * [[3.0], [1e3], [1e5], [1.0]]
    acceleration = displacement + low_cut * low_cut_term + sign * size_s * delay_term
    acceleration[0] += offset * constant[0]  # the order that an offset spoils is not used
    sigma = np.full(3, 1e-6)
    pair = WeakFormPair(displacement, acceleration, constant, sigma, low_cut_term, delay_term)
    errors = pair.fit_phase_errors()
    assert errors.gain == 1.0
    assert errors.low_cut == pytest.approx(low_cut, rel=0.02, abs=1e-3)
    assert errors.delay_s == pytest.approx(sign * size_s, rel=0.02, abs=1e-6)


@pytest.mark.parametrize("order", [1, 2])
def test_size_is_the_largest_amplitude(order: int) -> None:
    pair = make_pair(1000.0)
    amplitudes = np.array([9.0, 1.0, 1.0], dtype=np.complex128)
    large = amplitudes.copy()
    large[order] = -2.0
    assert replace(pair, displacement=large, acceleration=amplitudes).size == 2.0
    assert replace(pair, displacement=amplitudes, acceleration=large).size == 2.0


@LAW
@given(st.floats(-math.pi / 4, 3 * math.pi / 4 - 2e-3), st.floats(1.0, 5e3), st.floats(-50.0, 50.0))
def test_fit_cell_pair_at_any_angle(angle: float, size_n: float, mean_n: float) -> None:
    force = size_n * np.sin(0.1 * np.arange(500))
    force -= force.mean()
    fit = fit_cell_pair(force * math.cos(angle) + mean_n, force * math.sin(angle) - mean_n, 2.0)
    assert fit.angle == pytest.approx(angle, abs=1e-9)
    assert fit.means == pytest.approx((mean_n, -mean_n))
    assert fit.rms == pytest.approx(force.std())
    assert fit.sigma == pytest.approx(2.0 / math.sqrt(500))
    assert fit.sigma_angle == pytest.approx(fit.sigma / fit.rms)


@pytest.mark.parametrize(("below", "turned"), [(0.9e-3, 0.0), (1.1e-3, math.pi), (0.3, math.pi)])
def test_fit_cell_pair_of_a_reversed_cell(below: float, turned: float) -> None:
    angle = -math.pi / 4 - below
    force = np.sin(0.1 * np.arange(500))
    fit = fit_cell_pair(force * math.cos(angle), force * math.sin(angle), 0.0)
    assert fit.angle == pytest.approx(angle + turned, abs=1e-9)
    assert fit_cell_pair(np.full(9, 3.0), np.full(9, 4.0), 1.0).sigma_angle == math.inf


@LAW
@given(SIGNS, st.integers(1, 8), st.sampled_from([0, 1]), st.floats(1.05, 50.0), SIGNS)
def test_remove_spikes_by_the_median_of_three(
    sign: float, place: int, channel: int, size: float, slope: float
) -> None:
    clean = slope * np.vstack([np.arange(10.0), 3.0 * np.arange(10.0)])
    limit = np.array([[1.0], [3.0]])
    spiked = clean.copy()
    spiked[channel, place] += sign * size * (limit[channel, 0] + abs(clean[channel, 1]))
    repaired = remove_spikes(spiked, limit)
    neighbor = clean[channel, place + round(sign * slope)]
    expected = clean.copy()
    expected[channel, place] = neighbor
    assert repaired == pytest.approx(expected)
    assert remove_spikes(clean, limit) == pytest.approx(clean)
    small = clean.copy()
    small[channel, place] += sign * 0.95 * (limit[channel, 0] + abs(clean[channel, 1]))
    assert remove_spikes(small, limit) == pytest.approx(small)
