"""Noise density of a channel, from the record at rest and from the spectrum in motion."""

import math
from dataclasses import astuple, dataclass
from itertools import pairwise

import numpy as np
from scipy.signal import spectrogram, welch

from table_io.block import Bool1D, Bool2D, Float1D, Int1D
from twin.compare.hum import separate_hum

MIN_REST_SAMPLES = 100
SEGMENT_SAMPLES = 256  # of a spectrum; 50 % overlap
LONG_SEGMENT_SAMPLES = 8192  # of a residual: resolves slow drift
BANDS_PER_OCTAVE = 3
BAND_COUNT = 60  # up to 0.8 MHz
QUIET_SHARE = 0.3  # of the segments in motion that count as quiet
MIN_DEVIATION_SIGMA = 3.0  # standard deviations: a smaller deviation from white noise is chance
# The same for 1/f noise, which the few lowest lines show: their power is far from normal.
MIN_CORNER_SIGMA = 6.0
MIN_WHITE_CYCLES = 0.02  # cycles per sample: above it noise at rest shows the white level
PASSED_SHARE = 0.5  # of the frequency where a filter rolls off: below it, it passes all
MIN_NOISE_SHARE = 1e-4  # of a channel's rms: lower limit of the noise
# An anti-alias filter lowers the power by this factor within an octave, above this frequency; the
# resolution of a converter may stop the fall.
MIN_FILTER_FALL, MIN_FILTER_CYCLES = 4.0, 0.08  # -, cycles per sample
MIN_CORNER_REST_S = 0.9  # a shorter rest does not show 1/f noise
MIN_WHITE_SHARE = 0.1  # of the noise at rest that seems white
WHITE_FITS = 3  # of white and 1/f noise, each weighted by the one before
FILTER_CORNERS = 100  # tried between that frequency and the highest


@dataclass(frozen=True, eq=False)
class NoiseBands:
    """Power density in bands, (band,), 1 for white noise of rms 1, with its relative deviation.

    `frequency` is the centre of the band in cycles per sample.
    """

    frequency: Float1D
    power: Float1D
    sigma: Float1D


@dataclass(frozen=True, slots=True)
class RestNoise:
    """Noise of a channel at rest, SI and Hz.

    White noise of this rms, mains hum, the frequency below which 1/f noise exceeds white noise (0
    without), the smallest step of the readings (0 if noise exceeds it), and the frequencies where
    an anti-alias filter begins to act, and where it halves the power (inf without a filter).
    """

    rms: float
    hum_rms: float
    corner_hz: float
    resolution: float
    roll_off_hz: float
    filter_hz: float


def number_bands(hz: Float1D) -> Int1D:
    """Return the number of the band of each frequency, (frequency,): from 0, which ends at 1 Hz."""
    octaves = np.log2(np.maximum(hz, 2.0 ** (-1 / BANDS_PER_OCTAVE)))
    numbers: Int1D = np.floor(BANDS_PER_OCTAVE * octaves).astype(np.int64) + 1
    return numbers


def estimate_noise_density(values: Float1D, rest: Bool2D, frequency: Float1D) -> Float1D:
    """Return the noise density of a channel at frequencies in cycles per sample, (frequency,).

    White noise of rms s has the density s. The quiet segments in motion show the noise above the
    frequencies of the motion; below, it continues as white. The record at rest, which is short,
    shows whether it really does: it may be louder towards low frequency (1/f), or lowered by an
    anti-alias filter, and where the motion hides the noise, it gives its level. Without rest a
    filter cannot be told from the end of the band of the motion, and none is assumed.
    """
    finite, quiet = values[np.isfinite(values)], values[rest & np.isfinite(values)]
    motion = _estimate_quiet_bands(finite)
    at_rest = _estimate_rest_bands(quiet) if quiet.size >= MIN_REST_SAMPLES else None
    passed = motion.power.size
    if at_rest is not None:
        passed = _count_passed_bands(motion, _find_roll_off(at_rest))
    power, corner = motion.power.copy(), 0.0
    power[:passed] = _find_white_level(motion.power[:passed], motion.sigma[:passed])
    if at_rest is not None:
        level, corner = _compare_with_rest(at_rest, power[0], motion.frequency[passed - 1])
        power[:passed] = level
    power[passed:] = np.minimum(power[passed:], power[0])
    shape = np.interp(
        np.log(np.maximum(frequency, 1e-9)), np.log(motion.frequency), 0.5 * np.log(power)
    )
    slow = np.maximum(frequency, 0.5 / finite.size)
    density: Float1D = np.exp(shape) * np.sqrt(1.0 + corner / slow)
    least = max(_find_resolution(finite) / np.sqrt(12.0), MIN_NOISE_SHARE * float(finite.std()))
    return np.maximum(density, max(least, 1e-300))


def measure_rest_noise(values: Float1D, rest: Bool2D, rate_hz: float) -> RestNoise | None:
    """Return the noise of a channel at rest; None if the rest is too short."""
    quiet = values[rest & np.isfinite(values)]
    if quiet.size < MIN_REST_SAMPLES:
        return None
    resolution = _find_resolution(values)
    if not np.ptp(quiet) > resolution:
        return RestNoise(resolution / math.sqrt(12.0), 0.0, 0.0, resolution, math.inf, math.inf)
    quiet, hum_rms = separate_hum(quiet, rate_hz)
    bands = _estimate_rest_bands(quiet)
    roll_off = _find_roll_off(bands)
    # the resolution of a converter may hide the roll-off of a filter, which then looks like 1/f
    unfiltered = int(np.searchsorted(bands.frequency, MIN_FILTER_CYCLES))
    passed = min(_count_passed_bands(bands, roll_off), unfiltered)
    white, corner = _fit_white_and_slow(bands, max(passed, 3))
    corner = corner if quiet.size >= MIN_CORNER_REST_S * rate_hz else 0.0
    half_power = _fit_half_power(bands, white) if math.isfinite(roll_off) else math.inf
    rms = max(math.sqrt(white), resolution / math.sqrt(12.0))
    return RestNoise(
        rms, hum_rms, corner * rate_hz, resolution, roll_off * rate_hz, half_power * rate_hz
    )


def compare_with_white(values: Float1D, gain: Float1D) -> Float1D:
    """Return the power of a series over that of white noise of rms 1 after a gain, (frequency,).

    It is 1 where the series is not significantly louder. `values`, (sample,), has the frequencies
    of `gain`, equally spaced from 0 to half its sampling rate.
    """
    samples = min(LONG_SEGMENT_SAMPLES, values.size)
    hz, power = welch(values, 1.0, "blackmanharris", samples, detrend="linear")
    cycles = np.linspace(0.0, 0.5, gain.size)
    expected = np.interp(hz, cycles, gain**2) / np.mean(gain**2)
    passed = expected > 0.1
    segments = 0.5 * max(2 * values.size // samples - 1, 1)
    bands = _average_bands(
        hz[passed], 0.5 * power[passed] / expected[passed], 1.0 / np.sqrt(segments), True
    )
    louder = bands.power > 1.0 + MIN_DEVIATION_SIGMA * bands.sigma
    ratio = np.where(louder, bands.power, 1.0)
    slow = np.maximum(cycles, 0.5 / values.size)
    return np.exp(np.interp(np.log(slow), np.log(bands.frequency), np.log(ratio)))


def find_loudest_power(values: Float1D, rate_hz: float) -> NoiseBands:
    """Return the power of the loudest segment in each band, in Hz; white noise of rms 1 has 1.

    Spectral lines count.
    """
    samples = min(SEGMENT_SAMPLES, values.size)
    hz, _, power = spectrogram(values, rate_hz, "hann", samples, samples // 2, detrend="linear")
    segments = [
        _average_bands(hz, 0.5 * rate_hz * segment, 1.0, with_lines=True) for segment in power.T
    ]
    loudest = np.max([bands.power for bands in segments], axis=0)
    return NoiseBands(segments[0].frequency, loudest, segments[0].sigma)


def find_shown_roll_off(values: Float1D, rate_hz: float) -> float:
    """Return where quiet segments in motion fall as behind an anti-alias filter, Hz; inf: nowhere.

    There the motion may end, too; but behind a filter the fall goes on up to the highest frequency,
    where a motion that ends leaves noise.
    """
    quiet = _estimate_quiet_bands(values[np.isfinite(values)])
    goes_on = _mark_falls(quiet)[-1:].all()
    return _find_roll_off(quiet) * rate_hz if goes_on else math.inf


def _find_resolution(values: Float1D) -> float:
    """Return the step of a coarsely quantised channel; 0 where nearly all samples differ."""
    levels = np.unique(values)
    return float(np.diff(levels).min()) if 1 < levels.size < values.size / 8 else 0.0


def _estimate_quiet_bands(values: Float1D) -> NoiseBands:
    """Return the bands of the quiet segments of a record.

    The periodogram of noise is exponentially distributed, which gives its mean from a quantile.
    """
    samples = min(SEGMENT_SAMPLES, values.size)
    # differences take the leakage of the motion away, which would exceed the noise of a laser
    hz, _, power = spectrogram(
        np.diff(values, 2), 1.0, "blackmanharris", samples, samples // 2, detrend="linear"
    )
    power[1:] /= (2.0 * np.sin(np.pi * hz[1:, None])) ** 4
    share = QUIET_SHARE if power.shape[1] > 8 else 0.5
    mean = -np.log1p(-share)
    spread = np.sqrt(share / (1.0 - share) / power.shape[1]) / mean
    return _average_bands(hz, 0.5 * np.quantile(power, share, axis=1) / mean, spread)


def _estimate_rest_bands(values: Float1D) -> NoiseBands:
    samples = max(min(4 * SEGMENT_SAMPLES, values.size // 2), 32)
    hz, power = welch(values, 1.0, nperseg=samples, detrend="linear")
    segments = 0.75 * max(2 * values.size // samples - 1, 1)
    return _average_bands(hz, 0.5 * power, 1.0 / np.sqrt(segments))


def _average_bands(
    hz: Float1D, power: Float1D, spread: float, with_lines: bool = False
) -> NoiseBands:
    """Return the mean of each band without spectral lines; `spread` is the deviation of a bin."""
    lowest, highest = 1.5 * (hz[1] - hz[0]), hz[-1]
    count = max(round(BANDS_PER_OCTAVE * np.log2(highest / lowest)), 2)
    edges = np.unique(np.searchsorted(hz, np.geomspace(lowest, highest, count + 1)))
    bands = []
    for first, last in pairwise(edges):
        band = power[first:last]
        line_free = band if with_lines else band[band <= 4.0 * np.median(band)]
        bands.append((hz[first:last].mean(), line_free.mean(), spread / np.sqrt(line_free.size)))
    frequency, mean, sigma = (np.array(column) for column in zip(*bands, strict=True))
    return NoiseBands(frequency, np.maximum(mean, 1e-300), sigma)


def _find_roll_off(noise: NoiseBands) -> float:
    """Return the frequency above which an anti-alias filter lowers the noise; inf without one."""
    frequency, falls = noise.frequency[:-BANDS_PER_OCTAVE], _mark_falls(noise)
    rolling_off = np.flatnonzero(falls & (frequency > MIN_FILTER_CYCLES))
    return float(frequency[rolling_off[0]]) if rolling_off.size else math.inf


def _mark_falls(noise: NoiseBands) -> Bool1D:
    """Return from which bands, but those of the last octave, power falls as behind a filter."""
    octave = BANDS_PER_OCTAVE
    falls: Bool1D = noise.power[:-octave] > MIN_FILTER_FALL * noise.power[octave:]
    return falls


def _fit_white_and_slow(at_rest: NoiseBands, passed: int) -> tuple[float, float]:
    """Return level and corner, cycles per sample, of the power level x (1 + corner / f).

    `passed` bands are below the roll-off of a filter. Without a significant corner it is 0.
    """
    frequency, power, sigma = (values[:passed] for values in astuple(at_rest))
    weight = sigma**-2.0 * (frequency > MIN_WHITE_CYCLES)
    level = float(np.average(power, weights=weight if weight.any() else None))
    columns = np.stack([np.ones_like(frequency), 1.0 / frequency])
    expected = np.full_like(power, level)
    for _ in range(WHITE_FITS):
        scaled = columns / (sigma * expected)
        normal = np.linalg.pinv(scaled @ scaled.T)
        white, slow = normal @ (scaled @ (power / (sigma * expected)))
        expected = np.maximum(np.array([white, slow]) @ columns, MIN_WHITE_SHARE * level)
    white = max(white, MIN_WHITE_SHARE * level)
    information = float((columns[1] ** 2 / sigma**2).sum())
    is_clear = slow > MIN_DEVIATION_SIGMA * math.sqrt(normal[1, 1])
    if is_clear and slow / white > MIN_CORNER_SIGMA * information**-0.5:
        return float(white), float(slow / white)
    return level, 0.0


def _fit_half_power(at_rest: NoiseBands, white: float) -> float:
    """Return the half-power frequency of a filter of fourth order on noise of a white level.

    Far below the white level the resolution of the converter shows, not the filter.
    """
    fast = at_rest.frequency > MIN_WHITE_CYCLES
    corners = np.geomspace(MIN_FILTER_CYCLES, 0.5, FILTER_CORNERS)[:, None]
    expected = 1.0 / (1.0 + (at_rest.frequency[fast] / corners) ** 8)
    floor = 1.0 / MIN_FILTER_FALL**2
    difference = np.log(
        np.maximum(expected, floor) / np.maximum(at_rest.power[fast] / white, floor)
    )
    misfit = ((difference / at_rest.sigma[fast]) ** 2).sum(axis=1)
    return float(corners[int(misfit.argmin()), 0])


def _count_passed_bands(bands: NoiseBands, roll_off: float) -> int:
    """Return the number of bands that a filter passes whole, at least three."""
    return max(int(np.searchsorted(bands.frequency, PASSED_SHARE * roll_off)), 3)


def _find_white_level(power: Float1D, sigma: Float1D) -> float:
    """Return the mean power of the wide bands that are as low as the lowest: motion only adds.

    The least of the narrow bands is low by chance, and so is the lowest band alone.
    """
    is_wide = sigma <= 2.0 * sigma.min()
    lowest = power[is_wide].min()
    is_low = is_wide & (power <= lowest * (1.0 + MIN_DEVIATION_SIGMA * sigma))
    return float(np.average(power[is_low], weights=sigma[is_low] ** -2.0))


def _compare_with_rest(rest: NoiseBands, white: float, highest: float) -> tuple[float, float]:
    """Return (level, corner in cycles per sample) of the power level x (1 + corner / f).

    Without a significant deviation of the bands at rest up to `highest` it is `white`, corner 0.
    """
    ratio, weight = rest.power / white, rest.sigma**-2.0
    fast = (rest.frequency > MIN_WHITE_CYCLES) & (rest.frequency <= highest)
    level = 1.0
    if fast.any():
        at_rest = float(np.average(ratio[fast], weights=weight[fast]))
        sigma = float(weight[fast].sum()) ** -0.5
        # the motion can only add to the noise: above that at rest it counts less than below
        low, high = at_rest * (1.0 - MIN_DEVIATION_SIGMA * sigma), at_rest * (1.0 + sigma)
        level = min(max(1.0, low), high)
    slow = rest.frequency <= highest
    slope, excess = 1.0 / rest.frequency[slow], ratio[slow] / level - 1.0
    information = float((slope**2 * weight[slow]).sum())
    corner = float((slope * excess * weight[slow]).sum()) / max(information, 1e-300)
    is_significant = corner > MIN_CORNER_SIGMA * max(information, 1e-300) ** -0.5
    return white * level, corner if is_significant else 0.0
