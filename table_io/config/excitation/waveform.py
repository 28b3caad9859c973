"""Parts of waveforms: quintic blend, varying frequency, level over frequency, band limit.

A recorded motion is corrected for its baseline, limited in band and integrated twice.

Its filter has the gain of Butterworth filters of order 4 that run forward and backward,

    H(f) = 1 / (1 + (f_low / f)^8) / (1 + (f / f_high)^8),

which is 0.5 at the corners, and no phase, so the motion is not shifted in time. It is applied in
the frequency domain to the record between pads of zeros, and with it the integration twice,
-1 / (2 pi f)^2, which it keeps finite at f = 0: the displacement begins and ends at rest without
any fit to its drift. Source: Boore, On pads and filters: processing strong-motion data, Bulletin of
the Seismological Society of America 95(2), 2005; Boore and Bommer, Processing of strong-motion
accelerograms: needs, options and consequences, Soil Dynamics and Earthquake Engineering 25, 2005.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Literal

import numpy as np
from pydantic import ValidationInfo

from table_io.block import Float1D
from table_io.config.base import Positive
from table_io.errors import InputError

LevelPoints = tuple[tuple[Positive, Positive], ...]  # (frequency in Hz, level in g)
LEVEL_TOLERANCE = 1e-9  # of a frequency, at the ends of the break points


def smoothstep(x: Float1D) -> Float1D:
    """Return the quintic blend from 0 to 1 over x = 0 to 1, constant outside, (x,).

    Its first and second derivatives are 0 at both ends.
    """
    x = np.clip(x, 0.0, 1.0)
    return x**3 * (10.0 + x * (-15.0 + 6.0 * x))


def integrate_frequency(frequency_hz: Float1D, rate_hz: float) -> Float1D:
    """Return the phase in rad from 0 of a varying frequency, (sample,), by the trapezoidal rule."""
    steps = 0.5 * (frequency_hz[1:] + frequency_hz[:-1]) / rate_hz
    return 2.0 * np.pi * np.concatenate([[0.0], np.cumsum(steps)])


def repeat_with_pauses(pulse: Float1D, count: int, pause: int) -> Float1D:
    """Return a pulse from rest to rest `count` times with `pause` samples between, (sample,)."""
    gap = np.zeros(pause)
    parts = [part for _ in range(count) for part in (pulse, gap)]
    return np.concatenate(parts[: 2 * count - 1])


def interpolate_level(points: LevelPoints, frequency_hz: Float1D) -> Float1D:
    """Return the level in g at frequencies, (frequency,), linear in the logarithms of both."""
    f, level = np.log(np.array(points)).T
    return np.exp(np.interp(np.log(frequency_hz), f, level))


def check_level_points(points: LevelPoints, ends_hz: Sequence[float]) -> None:
    """Raise InputError unless break points ascend and cover the frequencies `ends_hz`."""
    frequencies = [f for f, _ in points]
    if len(points) == 1:
        raise InputError("level_points has one point", allowed="at least two, or acceleration_g")
    if any(after <= before for before, after in pairwise(frequencies)):
        raise InputError(
            f"the frequencies of level_points, {', '.join(f'{f:g}' for f in frequencies)} Hz, do "
            "not ascend",
            allowed="[[frequency in Hz, level in g], ...] in ascending order",
        )
    low, high = min(ends_hz), max(ends_hz)
    tolerance = LEVEL_TOLERANCE * high
    if frequencies and (frequencies[0] > low + tolerance or frequencies[-1] < high - tolerance):
        raise InputError(
            f"level_points ends at {frequencies[0]:g} and {frequencies[-1]:g} Hz",
            allowed=f"points that cover {low:g} to {high:g} Hz",
            remedy="add a point at each end",
        )


def check_points_in_band(points: LevelPoints, info: ValidationInfo) -> LevelPoints:
    """Check the break points of an excitation from start_hz to stop_hz: a validator of pydantic."""
    if points and {"start_hz", "stop_hz"} <= info.data.keys():
        check_level_points(points, (info.data["start_hz"], info.data["stop_hz"]))
    return points


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
