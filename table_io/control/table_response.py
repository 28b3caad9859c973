"""Frequency response of the table: interpolated and extrapolated from the identified frequencies.

Two quantities are nearly polynomials for any displacement servo: 1 / gain^2 in f^2 (exactly, of
second degree, for a loop with two poles) and the phase, odd in f, linear where a delay dominates.
Up to three terms of the first and two of the second are fitted, limited by the number of points.
"""

import math

import numpy as np

from table_io.block import Float1D
from table_io.records import FrequencyResponse

GAIN_TERMS, PHASE_TERMS = 3, 2
MAX_GAIN_EXTRAPOLATION = 4.0  # a gain stays within this factor of the identified range
LSTSQ_RCOND = 1e-3  # points closer together than this do not determine a slope


def evaluate_transfer(response: FrequencyResponse, frequency_hz: float) -> complex:
    """Evaluate the complex FRF, table acceleration over command, at a frequency in Hz."""
    frequencies = np.array(response.frequencies_hz)
    top = float(frequencies.max())
    powers = 2 * np.arange(min(PHASE_TERMS, frequencies.size)) + 1
    coefficients = _solve_least_squares(
        (frequencies / top)[:, None] ** powers, np.array(response.phase_rad)
    )
    angle = float(coefficients @ (frequency_hz / top) ** powers)
    return evaluate_gain(response, frequency_hz) * complex(math.cos(angle), math.sin(angle))


def evaluate_gain(response: FrequencyResponse, frequency_hz: float) -> float:
    """Evaluate the gain of the table, acceleration over command, at a frequency in Hz.

    Below the identified band it is constant, because a servo is flat there. Above it 1 / gain^2
    continues linearly in f^2, because the curvature from a few points is mostly noise.
    """
    frequencies = np.array(response.frequencies_hz)
    inverse = np.array(response.gain) ** -2.0
    low, top = float(frequencies.min()), float(frequencies.max())
    z = (frequencies / top) ** 2
    curve = _fit_polynomial(z, inverse, min(GAIN_TERMS, frequencies.size))
    value = _evaluate_polynomial(curve, min(max(frequency_hz, low), top) / top)
    if frequency_hz > top:
        chord = _fit_polynomial(z, inverse, min(2, frequencies.size))
        value += _evaluate_polynomial(chord, frequency_hz / top) - _evaluate_polynomial(chord, 1.0)
    min_inverse = float(inverse.min()) / MAX_GAIN_EXTRAPOLATION**2
    max_inverse = float(inverse.max()) * MAX_GAIN_EXTRAPOLATION**2
    return float(min(max(value, min_inverse), max_inverse) ** -0.5)


def _fit_polynomial(z: Float1D, values: Float1D, terms: int) -> Float1D:
    """Fit a polynomial to values at z, (point,), by least squares; coefficients, (terms,)."""
    return _solve_least_squares(z[:, None] ** np.arange(terms), values)


def _evaluate_polynomial(coefficients: Float1D, ratio: float) -> float:
    return float(coefficients @ ratio ** (2 * np.arange(coefficients.size)))


def _solve_least_squares(basis: Float1D, values: Float1D) -> Float1D:
    return np.asarray(np.linalg.lstsq(basis, values, rcond=LSTSQ_RCOND)[0], dtype=np.float64)
