"""Spectra against an independent implementation, closed forms and balances of energy."""

import math
import time

import numpy as np
import pytest

from table_io.block import Float1D
from table_io.units import GRAVITY_M_S2
from twin.results.spectra import (
    FINE_PER_OCTAVE,
    compute_absolute_velocity,
    compute_arias_intensity,
    compute_fourier_spectrum,
    compute_response_spectrum,
    compute_shock_spectrum,
    list_octave_frequencies,
)

RATE_HZ = 1000.0


def make_record(seconds: float = 8.0, rate_hz: float = RATE_HZ) -> Float1D:
    """Noise of all frequencies under an envelope, 1 m/s2; its ends are not zero."""
    noise = np.random.default_rng(7).standard_normal(round(seconds * rate_hz))
    return noise * (0.05 + np.sin(np.linspace(0.0, np.pi, noise.size)) ** 2)


@pytest.mark.parametrize("damping", [0.005, 0.05, 0.2])
@pytest.mark.parametrize("points", [0, 36])
def test_spectra_are_those_of_an_independent_implementation(damping: float, points: int) -> None:
    """Pyyeti filters each frequency by the closed-form coefficients of ISO 18431-4."""
    with np.printoptions():  # which importing it changes for the process
        srs = pytest.importorskip("pyyeti.srs", reason="pip install shaketwin[test] brings it")
    record = make_record()
    frequencies = list_octave_frequencies(0.2, 100.0, 6)
    spectrum = compute_response_spectrum(record, RATE_HZ, frequencies, damping, points)
    positive, negative = compute_shock_spectrum(record, RATE_HZ, frequencies, damping, points)
    results = {"abs": spectrum, "poss": positive, "negs": -negative}
    for k, hz in enumerate(frequencies.tolist()):
        # On the same straight lines: from rest, through the record, and one period to rest.
        count = max(1, math.ceil(points * hz / RATE_HZ - 1e-9))
        line = np.concatenate([[0.0], record, np.zeros(math.ceil(RATE_HZ / hz))])
        fine = np.interp(np.arange((line.size - 1) * count + 1) / count, np.arange(line.size), line)
        for peak, values in results.items():
            expected = srs.srs(
                fine[1:], RATE_HZ * count, [hz], 1 / (2 * damping),
                stype="absacce", peak=peak, rolloff=None, parallel="no",
            )  # fmt: skip
            assert values[k] == pytest.approx(expected[0], rel=1e-6), (hz, peak)


def test_resonance_of_a_steady_sine() -> None:
    """|a| = a0 sqrt(1 + 4 zeta^2) / (2 zeta) on the mass."""
    damping, hz, rate_hz = 0.05, 2.0, 4000.0
    sine = np.sin(2 * np.pi * hz * np.arange(round(30 * rate_hz)) / rate_hz)
    spectrum = compute_response_spectrum(sine, rate_hz, np.array([hz]), damping)
    gain = math.sqrt(1 + 4 * damping**2) / (2 * damping)
    assert spectrum[0] == pytest.approx(gain, rel=2e-6)


@pytest.mark.parametrize("ratio", [0.2, 0.4, 0.8, 1.5, 3.0])
def test_shock_spectrum_of_a_half_sine(ratio: float) -> None:
    """Without damping, with f = ratio / T of a pulse of length T: peaks in it and after it."""
    length_s, rate_hz = 0.011, 200_000.0
    count = round(length_s * rate_hz)
    pulse = np.concatenate([np.sin(np.pi * np.arange(count) / count), np.zeros(2)])
    w, p = 2 * np.pi * ratio / length_s, np.pi / length_s

    def response(t: Float1D) -> Float1D:  # absolute acceleration on sin(p t), from rest
        return (np.sin(p * t) - p / w * np.sin(w * t)) / (1 - (p / w) ** 2)

    during = response(np.linspace(0.0, length_s, 200_001))
    # Free motion from the end on: without damping the absolute motion is smooth there.
    rate = p * (-1 - math.cos(w * length_s)) / (1 - (p / w) ** 2)
    free = math.hypot(float(during[-1]), rate / w)
    shock = compute_shock_spectrum(pulse, rate_hz, np.array([ratio / length_s]), 0.0)
    positive = max(float(during.max()), free)
    negative = max(-float(during.min()), free)
    assert shock[0][0] == pytest.approx(positive, rel=4.1e-3)
    assert shock[0][0] <= positive * (1 + 1e-6)
    assert shock[1][0] == pytest.approx(negative, rel=4.1e-3, abs=1e-6)


def test_limits_of_the_spectrum() -> None:
    """A stiff oscillator moves with the ground."""
    rate_hz = 500.0
    t = np.arange(round(20 * rate_hz)) / rate_hz
    displacement = 0.01 * np.sin(np.pi * t / t[-1]) ** 2 * np.sin(2 * np.pi * 2 * t)
    record = np.diff(displacement, 2, prepend=0.0, append=displacement[-1]) * rate_hz**2
    spectrum = compute_response_spectrum(record, rate_hz, np.array([50.0, 100.0]))
    assert spectrum == pytest.approx(np.abs(record).max(), rel=5e-3)


def test_a_low_frequency_keeps_its_digits() -> None:
    """Below 1e-4 of the sampling rate; the same record at a coarser rate is the same line."""
    coarse = make_record(40.0, 25.0)
    positions = np.arange(40 * (coarse.size - 1) + 1) / 40
    fine = np.interp(positions, np.arange(coarse.size), coarse)
    # From rest, and to rest, in the interval of the coarse one.
    fine = np.concatenate(
        [coarse[0] * np.arange(1, 40) / 40, fine, coarse[-1] * np.arange(39, 0, -1) / 40]
    )
    for hz in (0.02, 0.05, 0.1):  # with the peaks sought at the samples of the fine one
        a, b = (
            compute_response_spectrum(*line, np.array([hz]), points_per_cycle=1000.0 / hz)
            for line in ((coarse, 25.0), (fine, 1000.0))
        )
        assert b / a == pytest.approx(1.0, abs=1e-9)


def test_arias_intensity_and_absolute_velocity_of_a_sine() -> None:
    rate_hz, hz = 2000.0, 2.0
    sine = 3.0 * np.sin(2 * np.pi * hz * np.arange(round(5 * rate_hz) + 1) / rate_hz)
    arias = compute_arias_intensity(sine, rate_hz)
    assert arias.shape == sine.shape
    assert arias[-1] == pytest.approx(np.pi / (2 * GRAVITY_M_S2) * 9.0 * 5.0 / 2, rel=1e-4)
    assert (np.diff(arias) >= 0).all()
    assert compute_absolute_velocity(sine, rate_hz) == pytest.approx(3 * 5 * 2 / np.pi, rel=1e-4)
    assert compute_absolute_velocity(np.array([1.0, -1.0, 1.0]), 1.0) == pytest.approx(1.0)


def test_fourier_amplitude_of_a_sine_is_half_its_length() -> None:
    rate_hz, seconds = 500.0, 8.0
    sine = 2.0 * np.sin(2 * np.pi * 5.0 * np.arange(round(seconds * rate_hz)) / rate_hz)
    hz, amplitude = compute_fourier_spectrum(sine, rate_hz)
    assert hz[int(np.argmax(amplitude))] == pytest.approx(5.0)
    assert amplitude.max() == pytest.approx(2.0 * seconds / 2)


def test_frequencies_lie_on_one_grid() -> None:
    grid = list_octave_frequencies(0.5, 8.0, 6)
    assert (grid[0], grid[-1], grid.size) == (0.5, 8.0, 25)
    assert 1.0 in grid
    assert set(list_octave_frequencies(0.7, 6.0, 6)) <= set(grid)
    fine = list_octave_frequencies(0.5, 8.0, FINE_PER_OCTAVE)
    assert fine[::12] == pytest.approx(grid)
    with pytest.raises(ValueError, match="no range"):
        list_octave_frequencies(0.0, 8.0, 6)


@pytest.mark.parametrize(
    ("record", "damping", "hz", "message"),
    [
        ([0.0, math.nan, 1.0], 0.05, 1.0, "1 samples are missing"),
        ([0.0], 0.05, 1.0, "no record"),
        ([0.0, 1.0], 1.0, 1.0, "damping"),
        ([0.0, 1.0], 0.05, 0.0, "not positive"),
    ],
)
def test_compute_response_spectrum_refuses_invalid_input(
    record: list[float], damping: float, hz: float, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        compute_response_spectrum(np.array(record), 100.0, np.array([hz]), damping)


def test_a_fine_spectrum_of_a_minute_takes_seconds_at_most() -> None:
    record = make_record(60.0)
    frequencies = list_octave_frequencies(0.1, 50.0, FINE_PER_OCTAVE)
    compute_response_spectrum(record[:100], RATE_HZ, frequencies[:2])  # compiled before
    start = time.perf_counter()
    compute_response_spectrum(record, RATE_HZ, frequencies)
    assert time.perf_counter() - start < 5.0  # 0.3 s on one core
