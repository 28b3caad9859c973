"""Sine tracking along a record: phase, amplitude and residual of a sliding sine fit."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from table_io.block import Bool2D, Float1D, find_stretches, interpolate_missing

FITS_PER_CYCLE = 4
WINDOW_CYCLES = 2.0
MAX_RESIDUAL_RATIO = 0.25  # rms residual over amplitude; beyond it the signal is no sine
MIN_SAMPLES_PER_CYCLE = 8.0
MAX_LOST_SHARE = 0.3  # of the samples of a window; with more lost there is no fit
MAX_MISSED_CYCLES = 3  # without a valid fit, after which the burst ends
MIN_AMPLITUDE_RATIO = 0.2  # of the recent amplitude, below which the burst ends
MIN_QUIET_S = 0.5  # shortest rest between two bursts
PIECE_S = 0.125
ACQUISITION_WINDOWS_S = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)  # tried in turn to acquire a sine


@dataclass(frozen=True, eq=False)
class SineTrack:
    """Track of one burst of a sine from sample `first` to `last`, arrays (fit,) each.

    `phase` in cycles, `amplitude` in the unit of the signal, `phase_noise` rms in cycles.
    """

    sample: Float1D
    phase: Float1D
    amplitude: Float1D
    phase_noise: Float1D
    first: float
    last: float


@dataclass(frozen=True, slots=True)
class _SineFit:
    sample: float
    f: float  # cycles a sample
    phase: float
    amplitude: float
    phase_noise: float


def detect_rest(signal: Float1D, rate_hz: float) -> Bool2D:
    """Detect rest, (sample,): True where the signal is only noise for at least half a second.

    All False if the quietest parts are not quiet compared with the loudest.
    """
    size = max(round(PIECE_S * rate_hz), 4)
    count = -(-signal.size // size)
    pieces = np.pad(interpolate_missing(signal), (0, count * size - signal.size), mode="edge")
    spread = pieces.reshape(count, size).std(axis=1)
    quietest = np.sort(spread)[: round(MIN_QUIET_S / PIECE_S)]
    floor = max(2 * float(quietest[-1]), 2e-3 * float(spread.max()))
    if floor > 0.1 * spread.max():
        return np.zeros(signal.size, dtype=bool)
    is_quiet = spread <= floor
    for first, last in find_stretches(is_quiet):
        is_quiet[first:last] = (last - first) * PIECE_S >= MIN_QUIET_S
    return np.repeat(is_quiet, size)[: signal.size]


def track_sines(signal: Float1D, moving: Bool2D, rate_hz: float) -> Iterator[SineTrack]:
    """Yield a track of every sine in the moving parts of a signal, (sample,), NaN if lost."""
    for first, last in find_stretches(moving):
        start = first
        while start < last:
            f = _acquire_frequency(signal[start:last], rate_hz)
            if f is None:
                start += round(max(MIN_QUIET_S * rate_hz, 1))
                continue
            fits = _follow_sine(signal, start + 0.5 / f, f, last)
            if len(fits) <= 2 * FITS_PER_CYCLE:
                start += round(WINDOW_CYCLES / f)
                continue
            end = min(fits[-1].sample + 0.5 * WINDOW_CYCLES / f, last)
            yield SineTrack(
                np.array([fit.sample for fit in fits]),
                np.array([fit.phase for fit in fits]),
                np.array([fit.amplitude for fit in fits]),
                np.array([fit.phase_noise for fit in fits]),
                float(start),
                float(end),
            )
            start = round(end) + 1


def _acquire_frequency(signal: Float1D, rate_hz: float) -> float | None:
    """Return the frequency, in cycles per sample, of the sine at the start; None without one."""
    for seconds in ACQUISITION_WINDOWS_S:
        segment = interpolate_missing(signal[: round(seconds * rate_hz)])
        if segment.size < 2 * MIN_SAMPLES_PER_CYCLE:
            return None
        wave = (segment - segment.mean()) * np.hanning(segment.size)
        power = np.abs(np.fft.rfft(wave, 4 * segment.size)) ** 2
        f = float(np.argmax(power)) / (4 * segment.size)
        if f * segment.size < WINDOW_CYCLES or f * MIN_SAMPLES_PER_CYCLE > 1:
            continue
        if _fit_sine(signal, 0.5 * segment.size, f) is not None:
            return f
    return None


def _fit_sine(signal: Float1D, sample: float, f: float) -> _SineFit | None:
    """Fit sine and mean by weighted least squares, two cycles around `sample`; None without one.

    Amplitude and phase may vary linearly, so blends and soft starts are tracked too.
    """
    half = 0.5 * WINDOW_CYCLES / f
    first, last = max(int(np.ceil(sample - half)), 0), min(int(sample + half) + 1, signal.size)
    x = signal[first:last]
    finite = np.isfinite(x)
    if finite.sum() < (1 - MAX_LOST_SHARE) * 2 * half:
        return None
    t = np.arange(first, last)[finite] - sample
    x = x[finite]
    weight = 1 + np.cos(np.pi * t / half)
    turn = 2 * np.pi * f * t
    sin, cos, slope = np.sin(turn), np.cos(turn), t / half
    basis = np.array([sin, cos, np.ones(t.size), slope * sin, slope * cos])
    weighted = basis * weight
    coefficients = np.linalg.solve(weighted @ basis.T, weighted @ x)
    a, b = coefficients[:2]
    amplitude = float(np.hypot(a, b))
    rest = float(np.sqrt(weight @ (x - coefficients @ basis) ** 2 / weight.sum()))
    if amplitude == 0.0 or not rest <= MAX_RESIDUAL_RATIO * amplitude:
        return None
    noise = rest / amplitude * float(np.sqrt(2 * (weight @ weight))) / weight.sum() / (2 * np.pi)
    f += float(a * coefficients[4] - b * coefficients[3]) / amplitude**2 / half / (2 * np.pi)
    return _SineFit(sample, f, float(np.arctan2(b, a)) / (2 * np.pi), amplitude, noise)


def _follow_sine(signal: Float1D, sample: float, f: float, end: int) -> list[_SineFit]:
    """Fit every quarter cycle from `sample` on, with unwrapped phase, until the sine ends."""
    fits: list[_SineFit] = []
    missed = 0
    while sample < end and missed <= MAX_MISSED_CYCLES * FITS_PER_CYCLE:
        fit = _fit_sine(signal, sample, f)
        if fit is None:
            missed += 1
        elif fits and fit.amplitude < MIN_AMPLITUDE_RATIO * max(
            previous.amplitude for previous in fits[-12:]
        ):
            break
        else:
            missed = 0
            expected = fits[-1].phase + f * (sample - fits[-1].sample) if fits else fit.phase
            phase = fit.phase + round(expected - fit.phase)
            fits.append(replace(fit, phase=phase))
            f = float(np.clip(fit.f, 0.7 * f, 1.4 * f))
        sample += 1 / (FITS_PER_CYCLE * f)
    return fits
