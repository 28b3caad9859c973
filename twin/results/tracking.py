"""Tracking error of a table: how closely its motion is the target, in a band and in full.

The three criteria of Chen, Kek, Hu and Lai (Earthquakes and Structures 15(6), 2018, 595-603, from
1,209 tests of the NCREE): rms error of the acceleration, share of the response spectrum beyond a
tolerance within the band of interest, and peak ground acceleration. A constant lag does no harm to
a test and is found and stated apart: the target is delayed by it before the errors are taken.

"In the band" is the part of either motion with frequencies in the band, cut sharply in the Fourier
spectrum with rest around the record, in phase. "In full" is every frequency that is sampled, with
the noise of the sensor and the ringing of the table.
"""

import math

import numpy as np
import numpy.typing as npt

from table_io.block import Float1D
from table_io.config.excitation import find_energy_band
from twin.results.contracts import TrackingError
from twin.results.spectra import (
    DEFAULT_DAMPING,
    FINE_PER_OCTAVE,
    USUAL_PER_OCTAVE,
    compute_absolute_velocity,
    compute_arias_intensity,
    compute_response_spectrum,
    list_octave_frequencies,
)

BAND_WIDENING = 2.0  # factor by which both ends of the band of the energy are moved out: an octave
MAX_BAND_RATIO = 0.1  # of the sampling rate: a spectrum needs ten samples a period
SA_TOLERANCE = 0.1  # of the target, as in Chen et al.
MAX_LAG_S = 0.5  # that is looked for, on either side
LAG_ITERATIONS, MASK_ITERATIONS = 20, 10
Bool1D = npt.NDArray[np.bool_]
Complex1D = npt.NDArray[np.complex128]


def judge_tracking(
    target_acc: Float1D,
    achieved_acc: Float1D,
    rate_hz: float,
    band_hz: tuple[float, float] | None = None,
    *,
    damping: float = DEFAULT_DAMPING,
    target_disp: Float1D | None = None,
    achieved_disp: Float1D | None = None,
) -> TrackingError:
    """Return the tracking error of a table acceleration in m/s2, (sample,), against its target.

    Both begin at the same sample and have the same length; before and after them the target is at
    rest. Lost samples of the achieved motion are NaN. Without `band_hz` it is `find_band` of the
    target. Displacements in m, (sample,), are optional; the lag is that of the acceleration.
    ValueError if the lengths differ, a sample of the target is missing, the target is at rest
    throughout, or nothing was measured.
    """
    _check_pair(target_acc, achieved_acc)
    low_hz, high_hz = band = find_band(target_acc, rate_hz) if band_hz is None else band_hz
    if not 0.0 < low_hz < high_hz <= rate_hz / 2:
        raise ValueError(
            f"a band of {low_hz:g} to {high_hz:g} Hz is not within 0 to {rate_hz / 2:g} Hz"
        )
    known = np.isfinite(achieved_acc)
    lag_s = find_lag(target_acc, achieved_acc, rate_hz, band)
    target = delay_record(target_acc, lag_s, rate_hz)
    rms_band, rms_full = _find_rms_errors(target, achieved_acc, rate_hz, band)
    pga_band = sa_share = worst_ratio = worst_hz = fine_share = arias = cav = math.nan
    sa_count = 0
    if known.all():
        pga_band = _divide(
            _find_peak(keep_band(achieved_acc, rate_hz, band)),
            _find_peak(keep_band(target_acc, rate_hz, band)),
        )
        hz, ratios = compare_spectra(target_acc, achieved_acc, rate_hz, band, damping)
        sa_count = hz.size
        if sa_count:
            sa_share = _find_share(ratios)
            fine = compare_spectra(
                target_acc, achieved_acc, rate_hz, band, damping, FINE_PER_OCTAVE
            )
            fine_share = _find_share(fine[1])
            worst = int(np.argmax(np.abs(np.log(ratios))))
            worst_ratio, worst_hz = float(ratios[worst]), float(hz[worst])
        arias = float(
            compute_arias_intensity(achieved_acc, rate_hz)[-1]
            / compute_arias_intensity(target_acc, rate_hz)[-1]
        )
        cav = compute_absolute_velocity(achieved_acc, rate_hz) / compute_absolute_velocity(
            target_acc, rate_hz
        )
    disp_band = disp_full = math.nan
    if target_disp is not None and achieved_disp is not None:
        _check_pair(target_disp, achieved_disp)
        disp_band, disp_full = _find_rms_errors(
            delay_record(target_disp, lag_s, rate_hz), achieved_disp, rate_hz, band
        )
    return TrackingError(
        band_hz=(float(low_hz), float(high_hz)),
        damping=damping,
        lag_s=lag_s,
        acc_rms_error_band=rms_band,
        acc_rms_error_full=rms_full,
        pga_ratio_band=pga_band,
        pga_ratio_full=_divide(_find_peak(achieved_acc[known]), _find_peak(target[known])),
        sa_share=sa_share,
        sa_count=sa_count,
        sa_worst_ratio=worst_ratio,
        sa_worst_hz=worst_hz,
        sa_fine_share=fine_share,
        arias_ratio=arias,
        cav_ratio=cav,
        disp_rms_error_band=disp_band,
        disp_rms_error_full=disp_full,
        lost_samples=int(np.count_nonzero(~known)),
    )


def align_record(record_acc: Float1D, target_acc: Float1D) -> Float1D:
    """Return a record at the samples of the target that was made of it, (sample,).

    Both have one time scale; the target begins with rest and blends. Its place is that of the
    highest cross-correlation, which a zero-phase filter does not move.
    """
    size = 1 << (record_acc.size + target_acc.size).bit_length()
    cross = np.fft.irfft(
        np.fft.rfft(target_acc, size) * np.conj(np.fft.rfft(record_acc, size)), size
    )
    shift = int(np.argmax(cross))
    shift -= size if shift > size // 2 else 0
    aligned = np.zeros(target_acc.size)
    first, last = max(shift, 0), min(shift + record_acc.size, target_acc.size)
    aligned[first:last] = record_acc[first - shift : last - shift]
    return aligned


def find_record_error(
    record_acc: Float1D,
    target_acc: Float1D,
    motion_acc: Float1D,
    rate_hz: float,
    band_hz: tuple[float, float],
    lag_s: float = 0.0,
) -> float:
    """Return the rms error of a motion in a band against the record itself, over its rms there.

    The record is as it was before the filter of its profile (`align_record`). NaN if samples of
    the motion are missing.
    """
    record = delay_record(align_record(record_acc, target_acc), lag_s, rate_hz)
    return _find_rms_errors(record, motion_acc, rate_hz, band_hz)[0]


def find_band(target_acc: Float1D, rate_hz: float) -> tuple[float, float]:
    """Return the band (low, high) in Hz in which a target is judged if none is stated.

    From an octave below the frequency with 5 % of the energy of the acceleration below it to an
    octave above that with 95 %, a tenth of the sampling rate at most. The field states a band per
    laboratory or standard (1.3 to 33.3 Hz in ICC-ES AC156, 0.3 to 33 Hz in IEEE 693), not per
    record; the octave is what a spectral ordinate at either end takes its motion from. ValueError
    if the target is at rest throughout.
    """
    low_hz, high_hz = find_energy_band(target_acc, rate_hz)
    high_hz = min(high_hz * BAND_WIDENING, MAX_BAND_RATIO * rate_hz)
    return min(low_hz, high_hz) / BAND_WIDENING, high_hz


def find_lag(
    target: Float1D, achieved: Float1D, rate_hz: float, band_hz: tuple[float, float]
) -> float:
    """Return the lag of the achieved motion behind its target in s, positive if it is late.

    It is the highest peak of their cross-correlation in the band, to a part of a sample: the delay
    at which the phase of the cross spectrum, weighted by its magnitude, has no slope, and at which
    the rms error is least. Lost samples (NaN) do not count. Searched within MAX_LAG_S.
    """
    known = np.isfinite(achieved)
    filled = np.where(known, achieved, 0.0)
    lag_s = _find_correlation_peak(target, filled, rate_hz, band_hz)
    # What was lost is taken as the target with the lag and the gain so far, until these no longer
    # change: least squares over the known samples. It enters the lag alone, no error.
    for _ in range(0 if known.all() else MASK_ITERATIONS):
        late = delay_record(target, lag_s, rate_hz)
        gain = _divide(float(achieved[known] @ late[known]), float(late[known] @ late[known]))
        if not math.isfinite(gain):
            break
        filled = np.where(known, achieved, gain * late)
        lag_s = _find_correlation_peak(target, filled, rate_hz, band_hz)
    return lag_s


def _find_correlation_peak(
    target: Float1D, achieved: Float1D, rate_hz: float, band_hz: tuple[float, float]
) -> float:
    """Return the lag in s of the highest peak of the cross-correlation in a band."""
    first, w = _transform(target, rate_hz)
    second, _ = _transform(achieved, rate_hz)
    cross = np.conj(first) * second * _is_inside(w, band_hz)
    size = 2 * (cross.size - 1)
    correlation = np.fft.irfft(cross, size)
    reach = min(round(MAX_LAG_S * rate_hz), size // 2 - 1)
    lags = np.arange(-reach, reach + 1)
    lag_s = float(lags[int(np.argmax(correlation[lags]))]) / rate_hz
    for _ in range(LAG_ITERATIONS):
        aligned = cross * np.exp(1j * w * lag_s)
        curvature = float(np.sum(w**2 * aligned.real))
        if curvature <= 0.0:
            break
        # Newton's step to the maximum of the correlation; the start is within half a sample of it.
        step_s = float(-np.sum(w * aligned.imag)) / curvature
        lag_s += min(max(step_s, -1.0 / rate_hz), 1.0 / rate_hz)
        if abs(step_s) < 1e-9:
            break
    return lag_s


def delay_record(values: Float1D, lag_s: float, rate_hz: float) -> Float1D:
    """Return values delayed by a time that need not be whole samples; rest outside, (sample,)."""
    spectrum, w = _transform(values, rate_hz)
    size = 2 * (spectrum.size - 1)
    return np.fft.irfft(spectrum * np.exp(-1j * w * lag_s), size)[: values.size].astype(np.float64)


def keep_band(values: Float1D, rate_hz: float, band_hz: tuple[float, float]) -> Float1D:
    """Return the part of values in a band of frequencies in Hz, without shift, (sample,)."""
    spectrum, w = _transform(values, rate_hz)
    size = 2 * (spectrum.size - 1)
    return np.fft.irfft(spectrum * _is_inside(w, band_hz), size)[: values.size].astype(np.float64)


def compare_spectra(
    target_acc: Float1D,
    achieved_acc: Float1D,
    rate_hz: float,
    band_hz: tuple[float, float],
    damping: float = DEFAULT_DAMPING,
    per_octave: int = USUAL_PER_OCTAVE,
) -> tuple[Float1D, Float1D]:
    """Return (frequency in Hz, achieved over target), (ordinate,) each, of the SA in a band.

    SA is the response spectrum of the absolute acceleration. ValueError if a sample is missing.
    """
    hz = list_octave_frequencies(*band_hz, per_octave)
    target, achieved = (
        compute_response_spectrum(record, rate_hz, hz, damping)
        for record in (target_acc, achieved_acc)
    )
    return hz, achieved / target


def _check_pair(target: Float1D, achieved: Float1D) -> None:
    if target.ndim != 1 or target.shape != achieved.shape or target.size < 2:
        raise ValueError(f"target {target.shape} and achieved {achieved.shape} are no pair")
    if not np.isfinite(target).all():
        raise ValueError("samples of the target are missing")
    if not target.any():
        raise ValueError("the target is at rest throughout")
    if not np.isfinite(achieved).any():
        raise ValueError("nothing was measured: every sample is missing")


def _find_rms_errors(
    target: Float1D, achieved: Float1D, rate_hz: float, band_hz: tuple[float, float]
) -> tuple[float, float]:
    """Return the rms error over the rms of an aligned target (in the band, in full).

    In full over the known samples alone; in the band NaN if samples are lost.
    """
    known = np.isfinite(achieved)
    full = _divide(_find_rms((achieved - target)[known]), _find_rms(target[known]))
    if not known.all():
        return math.nan, full
    error, w = _transform(achieved - target, rate_hz)
    reference, _ = _transform(target, rate_hz)
    inside = _is_inside(w, band_hz)
    return _divide(_find_rms(np.abs(error[inside])), _find_rms(np.abs(reference[inside]))), full


def _transform(values: Float1D, rate_hz: float) -> tuple[Complex1D, Float1D]:
    """Return (Fourier spectrum with rest after the values, angular frequency), (bin,) each.

    The rest is at least MAX_LAG_S, so that nothing that is shifted comes round.
    """
    size = 1 << (values.size + round(MAX_LAG_S * rate_hz)).bit_length()
    spectrum = np.fft.rfft(values, size)
    return spectrum, np.arange(spectrum.size, dtype=np.float64) * (2 * math.pi * rate_hz / size)


def _is_inside(w: Float1D, band_hz: tuple[float, float]) -> Bool1D:
    return (2 * math.pi * band_hz[0] <= w) & (w <= 2 * math.pi * band_hz[1])


def _find_rms(values: Float1D) -> float:
    """Return the rms; NaN of nothing."""
    return float(np.sqrt(np.mean(np.square(values)))) if values.size else math.nan


def _find_share(ratios: Float1D) -> float:
    """Return the share of ordinates within SA_TOLERANCE of the target."""
    return float(np.mean(np.abs(ratios - 1.0) <= SA_TOLERANCE))


def _divide(value: float, by: float) -> float:
    """Return a ratio; NaN to nothing, as of a target at rest where it was measured."""
    return value / by if by > 0.0 else math.nan


def _find_peak(values: Float1D) -> float:
    return float(np.abs(values).max())
