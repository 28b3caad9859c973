"""The table's response between and beyond the frequencies at which it was identified.

Two quantities are nearly polynomials for any displacement servo: 1 / gain^2 in f^2 (exactly, of
second degree, for a loop of two poles) and the phase, odd in f, linear where a delay dominates.
Three terms and two terms of them are fitted, or as many as there are points.
"""

import math

import numpy as np

from table_io.block import Float1D
from table_io.records import Response

GAIN_TERMS, PHASE_TERMS = 3, 2
BEYOND = 4.0  # a gain is never more than this factor outside of those that were identified
ALIKE = 1e-3  # points that lie closer together than this do not tell a slope


def transfer_at(response: Response, frequency_hz: float) -> complex:
    """Table acceleration over command at a frequency, complex."""
    at = np.array(response.frequencies_hz)
    top = float(at.max())
    powers = 2 * np.arange(min(PHASE_TERMS, at.size)) + 1
    found = _solved((at / top)[:, None] ** powers, np.array(response.phase_rad))
    angle = float(found @ (frequency_hz / top) ** powers)
    return gain_at(response, frequency_hz) * complex(math.cos(angle), math.sin(angle))


def gain_at(response: Response, frequency_hz: float) -> float:
    """Gain of the table, acceleration over command, at a frequency.

    Below the identified band it stays what it is at its lower end: a servo is flat there. Above it
    1 / gain^2 goes on in f^2 along its chord: the curvature from a few points is mostly noise.
    """
    at = np.array(response.frequencies_hz)
    inverse = np.array(response.gain) ** -2.0
    low, top = float(at.min()), float(at.max())
    z = (at / top) ** 2
    curve = _polynomial(z, inverse, min(GAIN_TERMS, at.size))
    value = _value(curve, min(max(frequency_hz, low), top) / top)
    if frequency_hz > top:
        chord = _polynomial(z, inverse, min(2, at.size))
        value += _value(chord, frequency_hz / top) - _value(chord, 1.0)
    least, most = float(inverse.min()) / BEYOND**2, float(inverse.max()) * BEYOND**2
    return float(min(max(value, least), most) ** -0.5)


def _polynomial(z: Float1D, values: Float1D, terms: int) -> Float1D:
    """Coefficients, (terms,), of least squares through values at z, (point,)."""
    return _solved(z[:, None] ** np.arange(terms), values)


def _value(coefficients: Float1D, ratio: float) -> float:
    return float(coefficients @ ratio ** (2 * np.arange(coefficients.size)))


def _solved(basis: Float1D, values: Float1D) -> Float1D:
    return np.asarray(np.linalg.lstsq(basis, values, rcond=ALIKE)[0], dtype=np.float64)
