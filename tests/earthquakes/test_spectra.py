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
    shock = compute_shock_spectrum(record, RATE_HZ, frequencies, damping, points)
    results = {
        ("absacce", "abs"): spectrum.absolute_acceleration_m_s2,
        ("pacce", "abs"): spectrum.pseudo_acceleration_m_s2,
        ("reldisp", "abs"): spectrum.relative_displacement_m,
        ("relvelo", "abs"): spectrum.relative_velocity_m_s,
        ("absacce", "poss"): shock.positive_m_s2,
        ("absacce", "negs"): -shock.negative_m_s2,
    }
    for k, hz in enumerate(frequencies.tolist()):
        # On the same straight lines: from rest, through the record, and one period to rest.
        count = max(1, math.ceil(points * hz / RATE_HZ - 1e-9))
        line = np.concatenate([[0.0], record, np.zeros(math.ceil(RATE_HZ / hz))])
        fine = np.interp(np.arange((line.size - 1) * count + 1) / count, np.arange(line.size), line)
        for (kind, peak), values in results.items():
            expected = srs.srs(
                fine[1:], RATE_HZ * count, [hz], 1 / (2 * damping),
                stype=kind, peak=peak, rolloff=None, parallel="no",
            )  # fmt: skip
            assert values[k] == pytest.approx(expected[0], rel=1e-6), (hz, kind, peak)


def test_resonance_of_a_steady_sine() -> None:
    """|a| = a0 sqrt(1 + 4 zeta^2) / (2 zeta) on the mass, |u| = a0 / (2 zeta w^2)."""
    damping, hz, rate_hz = 0.05, 2.0, 4000.0
    sine = np.sin(2 * np.pi * hz * np.arange(round(30 * rate_hz)) / rate_hz)
    spectrum = compute_response_spectrum(sine, rate_hz, np.array([hz]), damping)
    gain = math.sqrt(1 + 4 * damping**2) / (2 * damping)
    assert spectrum.absolute_acceleration_m_s2[0] == pytest.approx(gain, rel=2e-6)
    assert spectrum.pseudo_acceleration_m_s2[0] == pytest.approx(1 / (2 * damping), rel=2e-6)
    u = 1 / (2 * damping * (2 * np.pi * hz) ** 2)
    assert spectrum.relative_displacement_m[0] == pytest.approx(u, rel=2e-6)
    velocity = u * 2 * np.pi * hz
    assert spectrum.relative_velocity_m_s[0] == pytest.approx(velocity, rel=2e-6)


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
    assert shock.positive_m_s2[0] == pytest.approx(positive, rel=4.1e-3)
    assert shock.positive_m_s2[0] <= positive * (1 + 1e-6)
    assert shock.negative_m_s2[0] == pytest.approx(negative, rel=4.1e-3, abs=1e-6)


def test_limits_of_the_spectrum() -> None:
    """A stiff oscillator moves with the ground; the mass of a soft one stays where it is."""
    rate_hz = 500.0
    t = np.arange(round(20 * rate_hz)) / rate_hz
    displacement = 0.01 * np.sin(np.pi * t / t[-1]) ** 2 * np.sin(2 * np.pi * 2 * t)
    record = np.diff(displacement, 2, prepend=0.0, append=displacement[-1]) * rate_hz**2
    spectrum = compute_response_spectrum(record, rate_hz, np.array([0.005, 50.0, 100.0]))
    peak = np.abs(record).max()
    assert spectrum.absolute_acceleration_m_s2[1:] == pytest.approx(peak, rel=5e-3)
    assert spectrum.relative_displacement_m[0] == pytest.approx(0.01, rel=5e-3)


def test_input_energy_is_in_the_oscillator_without_damping() -> None:
    """A step of ground acceleration that ends: E = (v^2 + w^2 u^2) / 2, in closed form."""
    hz, rate_hz, count = 3.0, 10_000.0, 1200
    step = np.ones(count)
    energy = compute_response_spectrum(step, rate_hz, np.array([hz]), 0.0).input_energy_j_kg[0]
    # Rise and fall take one interval each: a step of count / rate_hz, smoothed over an interval.
    w, h = 2 * np.pi * hz, 1 / rate_hz
    smooth = np.sinc(w * h / (2 * np.pi))
    amplitude = 2 * math.sin(w * count * h / 2) * smooth / w**2
    assert energy == pytest.approx(w**2 * amplitude**2 / 2, rel=1e-9)


def test_input_energy_is_dissipated_by_the_end() -> None:
    """Integral of 2 zeta w v^2, and what is left in the oscillator after a period of rest."""
    hz, damping, rate_hz = 2.0, 0.3, 4000.0
    t = np.arange(round(4 * rate_hz)) / rate_hz
    record = np.sin(2 * np.pi * 1.3 * t) * np.sin(np.pi * t / t[-1])
    w, h, u, v, loss = 2 * np.pi * hz, 1 / rate_hz, 0.0, 0.0, 0.0
    for a0, a1 in zip(record, [*record[1:], 0.0], strict=True):  # Heun, an independent formula
        du, dv = v, -a0 - 2 * damping * w * v - w**2 * u
        u1, v1 = u + h * du, v + h * dv
        du1, dv1 = v1, -a1 - 2 * damping * w * v1 - w**2 * u1
        before = v
        u, v = u + h * (du + du1) / 2, v + h * (dv + dv1) / 2
        loss += h * damping * w * (before**2 + v**2)
    energy = compute_response_spectrum(record, rate_hz, np.array([hz]), damping).input_energy_j_kg
    assert energy[0] == pytest.approx(loss + (v**2 + w**2 * u**2) / 2, rel=1e-4)


def test_a_low_frequency_keeps_its_digits() -> None:
    """Below 1e-4 of the sampling rate; the same record at a coarser rate is the same line."""
    coarse = make_record(40.0, 25.0)
    positions = np.arange(40 * (coarse.size - 1) + 1) / 40
    fine = np.interp(positions, np.arange(coarse.size), coarse)
    # From rest, and to rest, in the interval of the coarse one.
    fine = np.concatenate(
        [coarse[0] * np.arange(1, 40) / 40, fine, coarse[-1] * np.arange(39, 0, -1) / 40]
    )
    f = np.array([0.02, 0.05, 0.1])
    a, b = compute_response_spectrum(coarse, 25.0, f), compute_response_spectrum(fine, 1000.0, f)
    ratio = b.relative_displacement_m / a.relative_displacement_m
    assert ratio == pytest.approx(1.0, abs=5e-5)  # a peak between two samples of the coarse one


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
def test_what_has_no_spectrum_is_refused(
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
