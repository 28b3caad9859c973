"""A sine followed along a record: phase, amplitude, and how much of the motion is no sine."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from table_io.block import Bool2D, Float1D

QUARTER = 4  # fits a cycle
WINDOW_CYCLES = 2.0
NO_SINE = 0.25  # rms of the rest over the sine's amplitude: beyond it there is no sine
LEAST_SAMPLES = 8.0  # a cycle, for a sine to be followed
LOST_SHARE = 0.3  # of a window: more lost samples than this tell nothing
LOST_CYCLES = 3  # without a sine: then it is over
WEAK = 0.2  # of the amplitude a little earlier: then it is over
QUIET_S = 0.5  # between two bursts, at least
PIECE_S = 0.125
FIRST_S = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)  # windows in which a sine is looked for


@dataclass(frozen=True, eq=False)
class Track:
    """One burst of a sine, (fit,) each: `at` in samples, `phase` in cycles, `amplitude` in the
    signal's unit, `phase_noise` rms in cycles. Seen from sample `first` to `last`."""

    at: Float1D
    phase: Float1D
    amplitude: Float1D
    phase_noise: Float1D
    first: float
    last: float


@dataclass(frozen=True, slots=True)
class _Fit:
    at: float
    f: float  # cycles a sample
    phase: float
    amplitude: float
    phase_noise: float


def at_rest(signal: Float1D, rate_hz: float) -> Bool2D:
    """(sample,) True where for at least half a second there is nothing but noise.

    Nowhere, where the quietest parts are not quiet beside the loudest.
    """
    size = max(round(PIECE_S * rate_hz), 4)
    count = -(-signal.size // size)
    pieces = np.pad(filled(signal), (0, count * size - signal.size), mode="edge")
    spread = pieces.reshape(count, size).std(axis=1)
    quietest = np.sort(spread)[: round(QUIET_S / PIECE_S)]
    floor = max(2 * float(quietest[-1]), 2e-3 * float(spread.max()))
    if floor > 0.1 * spread.max():
        return np.zeros(signal.size, dtype=bool)
    still = spread <= floor
    edges = np.flatnonzero(np.diff(still, prepend=False, append=False)).reshape(-1, 2)
    for first, last in edges:
        still[first:last] = (last - first) * PIECE_S >= QUIET_S
    return np.repeat(still, size)[: signal.size]


def filled(signal: Float1D) -> Float1D:
    """The signal with straight lines through what is lost; zero where nothing is known."""
    known = np.isfinite(signal)
    if known.all() or not known.any():
        return np.nan_to_num(signal)
    places = np.arange(signal.size)
    return np.interp(places, places[known], signal[known])


def tracks(signal: Float1D, moving: Bool2D, rate_hz: float) -> Iterator[Track]:
    """Every sine in the moving parts of a signal, (sample,); NaN where samples are lost."""
    edges = np.flatnonzero(np.diff(moving, prepend=False, append=False)).reshape(-1, 2)
    for first, last in edges.tolist():
        at = first
        while at < last:
            f = _acquired(signal[at:last], rate_hz)
            if f is None:
                at += round(max(QUIET_S * rate_hz, 1))
                continue
            fits = _followed(signal, at + 0.5 / f, f, last)
            if len(fits) <= 2 * QUARTER:
                at += round(WINDOW_CYCLES / f)
                continue
            end = min(fits[-1].at + 0.5 * WINDOW_CYCLES / f, last)
            yield Track(
                np.array([one.at for one in fits]),
                np.array([one.phase for one in fits]),
                np.array([one.amplitude for one in fits]),
                np.array([one.phase_noise for one in fits]),
                float(at),
                float(end),
            )
            at = round(end) + 1


def _acquired(signal: Float1D, rate_hz: float) -> float | None:
    """Frequency in cycles a sample of the sine that the signal begins with; None without one."""
    for seconds in FIRST_S:
        start = filled(signal[: round(seconds * rate_hz)])
        if start.size < 2 * LEAST_SAMPLES:
            return None
        wave = (start - start.mean()) * np.hanning(start.size)
        power = np.abs(np.fft.rfft(wave, 4 * start.size)) ** 2
        f = float(np.argmax(power)) / (4 * start.size)
        if f * start.size < WINDOW_CYCLES or f * LEAST_SAMPLES > 1:
            continue
        if _fit(signal, 0.5 * start.size, f) is not None:
            return f
    return None


def _fit(signal: Float1D, at: float, f: float) -> _Fit | None:
    """Sine and mean by weighted least squares over two cycles round sample `at`; None without one.

    The sine may grow and drift in phase, linearly: so blends and soft starts are followed too.
    """
    half = 0.5 * WINDOW_CYCLES / f
    first, last = max(int(np.ceil(at - half)), 0), min(int(at + half) + 1, signal.size)
    x = signal[first:last]
    known = np.isfinite(x)
    if known.sum() < (1 - LOST_SHARE) * 2 * half:
        return None
    t = np.arange(first, last)[known] - at
    x = x[known]
    weight = 1 + np.cos(np.pi * t / half)
    turn = 2 * np.pi * f * t
    sin, cos, slope = np.sin(turn), np.cos(turn), t / half
    basis = np.array([sin, cos, np.ones(t.size), slope * sin, slope * cos])
    weighted = basis * weight
    found = np.linalg.solve(weighted @ basis.T, weighted @ x)
    a, b = found[:2]
    amplitude = float(np.hypot(a, b))
    rest = float(np.sqrt(weight @ (x - found @ basis) ** 2 / weight.sum()))
    if not rest <= NO_SINE * amplitude:
        return None
    noise = rest / amplitude * float(np.sqrt(2 * (weight @ weight))) / weight.sum() / (2 * np.pi)
    f += float(a * found[4] - b * found[3]) / amplitude**2 / half / (2 * np.pi)
    return _Fit(at, f, float(np.arctan2(b, a)) / (2 * np.pi), amplitude, noise)


def _followed(signal: Float1D, at: float, f: float, end: int) -> list[_Fit]:
    """Fits every quarter of a cycle from `at` on, phases unwrapped, until the sine is over."""
    fits: list[_Fit] = []
    missed = 0
    while at < end and missed <= LOST_CYCLES * QUARTER:
        fit = _fit(signal, at, f)
        if fit is None:
            missed += 1
        elif fits and fit.amplitude < WEAK * max(one.amplitude for one in fits[-12:]):
            break
        else:
            missed = 0
            expected = fits[-1].phase + f * (at - fits[-1].at) if fits else fit.phase
            phase = fit.phase + round(expected - fit.phase)
            fits.append(replace(fit, phase=phase))
            f = float(np.clip(fit.f, 0.7 * f, 1.4 * f))
        at += 1 / (QUARTER * f)
    return fits
