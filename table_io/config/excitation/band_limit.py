"""Baseline correction, zero-phase band limit and double integration of a recorded motion.

The filter has the gain of Butterworth filters of order 4 that run forward and backward,

    H(f) = 1 / (1 + (f_low / f)^8) / (1 + (f / f_high)^8),

which is 0.5 at the corners, and no phase, so the motion is not shifted in time. It is applied in
the frequency domain to the record between pads of zeros, and with it the integration twice,
-1 / (2 pi f)^2, which it keeps finite at f = 0: the displacement begins and ends at rest without
any fit to its drift. Source: Boore, On pads and filters: processing strong-motion data, Bulletin of
the Seismological Society of America 95(2), 2005; Boore and Bommer, Processing of strong-motion
accelerograms: needs, options and consequences, Soil Dynamics and Earthquake Engineering 25, 2005.
"""

from typing import Literal

import numpy as np

from table_io.block import Float1D
from table_io.config.excitation.waveform import smoothstep

Baseline = Literal["none", "mean", "linear"]
FILTER_ORDER = 4
PAD_CYCLES = 6.0  # of the lower corner, before and after; Boore (2005) asks for 1.5 orders in all
REST_RATIO = 5e-3  # of the peak displacement: what is less before and after is cut


def correct_baseline(acceleration: Float1D, baseline: Baseline) -> Float1D:
    """Return an acceleration without its mean or its least-squares line, (sample,), same unit."""
    if baseline == "none":
        return acceleration
    corrected = acceleration - acceleration.mean()
    if baseline == "mean":
        return corrected
    x = np.arange(acceleration.size) - 0.5 * (acceleration.size - 1)
    return corrected - x * (x @ corrected) / (x @ x)


def limit_band(
    values: Float1D, rate_hz: float, band_hz: tuple[float, float], *, integrate: bool
) -> Float1D:
    """Return values within a band, (pad + sample + pad,), integrated twice if asked for.

    `values` (sample,) in m, or in m/s2 to integrate; the result is a displacement in m.
    """
    low_hz, high_hz = band_hz
    pad = round(PAD_CYCLES / low_hz * rate_hz)
    size = 1 << (values.size + 2 * pad - 1).bit_length()  # a fast length
    f = np.fft.rfftfreq(size, 1.0 / rate_hz)
    f[0] = 1.0  # its gain is set to 0 below
    gain = 1.0 / (1.0 + (low_hz / f) ** (2 * FILTER_ORDER))
    gain /= 1.0 + (f / high_hz) ** (2 * FILTER_ORDER)
    if integrate:
        gain *= -1.0 / (2.0 * np.pi * f) ** 2
    gain[0] = 0.0
    padded = np.concatenate([np.zeros(pad), values, np.zeros(pad)])
    return np.fft.irfft(np.fft.rfft(padded, size) * gain, size)[: padded.size]


def cut_rest(displacement: Float1D, ramp: int) -> Float1D:
    """Return a displacement without the rest around it, (sample,), with quintic ramps at its ends.

    The ramps of `ramp` samples each lie where it stays below REST_RATIO of its peak.
    """
    moving = np.flatnonzero(np.abs(displacement) > REST_RATIO * np.abs(displacement).max())
    if not moving.size:
        return displacement
    before, after = moving[0] - ramp, moving[-1] + 1 + ramp
    padded = np.concatenate([np.zeros(ramp), displacement, np.zeros(ramp)])
    kept = padded[before + ramp : after + ramp].copy()
    rise = smoothstep(np.arange(ramp) / ramp)
    kept[:ramp] *= rise
    kept[-ramp:] *= rise[::-1]
    return kept
