"""Mains hum: lines at the mains frequency and its harmonics, removed from the spectra of a record.

A harmonic of the drive may coincide with a line of the mains for some steps. What tells the two
apart is time: hum is there at rest and lasts for the whole record, a harmonic belongs to its steps.
What is in a channel while a harmonic lies at the line is never taken for hum, however weak it is.
"""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.fft import ifft, ifftshift, irfft, next_fast_len, rfft, rfftfreq
from scipy.ndimage import binary_dilation

from table_io.block import Bool1D, Bool2D, Float1D, Float2D, interpolate_missing
from twin.compare.spectra import FrequencyGrid, Spectrum

MAINS_HZ, MAINS_TOLERANCE = (50.0, 60.0), 0.002  # relative deviation of the mains frequency
MIN_REST_S = 0.5  # a shorter rest is not used
CLEAR_REST_S = 2.0  # from here on the rest alone shows whether there is hum
PART_COUNT = 4  # of a record without rest: hum is in every part
SURROUNDINGS_HZ = 5.0
MAX_HARMONIC_HZ = 0.5 * SURROUNDINGS_HZ / MAINS_TOLERANCE  # above it a line may be anywhere there
MIN_LINE_RATIO = 20.0  # power of a line over the mean around it; noise alone hardly reaches it
LINE_WIDTH_HZ = 0.15  # standard deviation of the Gaussian filter that follows a line over time
SETTLING_S = 1.0 / (2.0 * math.pi * LINE_WIDTH_HZ)  # standard deviation of its response
BEAT_HZ = 1.0  # machines with different slip
FILTER_WIDTHS = 4.0  # half width of that filter, in standard deviations
HUM_LASTING_S = 0.5 / (FILTER_WIDTHS * LINE_WIDTH_HZ)  # for which what is left keeps its phase
MAX_EXCESS = 3.0  # times the amplitude at rest: above it there is a harmonic of the drive
FREQUENCY_STEP_HZ = 0.1  # at most, between the values of a transform that measures a line


class _Line(NamedTuple):
    """Line of hum in a record: frequency, and by channel its amplitude, and if it stands out."""

    frequency_hz: float
    amplitudes: Float1D
    stands_out: Bool2D


def remove_hum(
    spectra: Mapping[str, Spectrum], grid: FrequencyGrid, at_rest: Bool2D, drive_hz: Float1D
) -> tuple[dict[str, Spectrum], tuple[float, ...]]:
    """Return the spectra, (frequency,) each, less the hum that stands out in any, and its lines.

    Where it beats, or a harmonic of the drive lies at it, some is left, which keeps its phase for
    `HUM_LASTING_S`. All channels are treated alike, so that a balance of their forces stays one.
    `at_rest` are the samples before the motion, `drive_hz` the frequency of the drive, NaN where it
    is not known; (sample,) each at the original rate.
    """
    rate_hz = grid.rate_hz / grid.decimation
    records = np.array([grid.to_time_domain(spectrum) for spectrum in spectra.values()])
    rest = records[:, at_rest[:: grid.decimation]]
    has_rest = rest.shape[1] >= MIN_REST_S * rate_hz
    lines_at_rest = _measure_lines(rest, rate_hz) if has_rest else itertools.repeat(None)
    cleaned, lines_hz = dict(spectra), list[float]()
    for resting, line in zip(lines_at_rest, _measure_lasting_lines(records, rate_hz), strict=False):
        line_hz, amplitudes, lasting = line
        is_hum = lasting
        if resting is not None:
            # one that does not stand out at rest must not be weaker there than in motion
            is_hum = lasting & (amplitudes <= MAX_EXCESS * resting.amplitudes)
            if rest.shape[1] >= CLEAR_REST_S * rate_hz:
                is_hum |= resting.stands_out
                amplitudes = np.where(resting.stands_out, resting.amplitudes, amplitudes)
                line_hz = line_hz if (is_hum & lasting).any() else resting.frequency_hz
        if is_hum.any():
            limits = np.where(is_hum, MAX_EXCESS * amplitudes, np.inf)
            cleaned = _remove_line(cleaned, grid, line_hz, limits, drive_hz)
            lines_hz.append(line_hz)
    return cleaned, tuple(lines_hz)


def subtract_hum(values: Float1D, rate_hz: float) -> Float1D:
    """Return a record with an unknown rest, (sample,), less the hum that lasts throughout it.

    With all near its lines, as hum may beat. What is most of the record is the motion, no hum.
    """
    if values.size < PART_COUNT * MIN_REST_S * rate_hz:
        return values
    known = interpolate_missing(values)
    spectrum, hz = rfft(known - known.mean()), rfftfreq(known.size, 1.0 / rate_hz)
    lines = _measure_lasting_lines(known[None], rate_hz)
    is_hum = find_near_lines(hz, [line.frequency_hz for line in lines if line.stands_out[0]])
    power = np.abs(spectrum) ** 2
    if power[is_hum].sum() > 0.5 * power.sum():
        return values
    return values - irfft(np.where(is_hum, spectrum, 0.0), known.size)


def find_near_lines(hz: Float1D, lines_hz: Sequence[float]) -> Bool1D:
    """Return which frequencies, (frequency,), lie where hum of these lines may beat."""
    far = np.abs(np.subtract.outer(hz, np.array(lines_hz))) >= BEAT_HZ
    return np.asarray(~far.all(axis=1))


def separate_hum(values: Float1D, rate_hz: float) -> tuple[Float1D, float]:
    """Return a record at rest, (sample,), without the hum that stands out, and the rms of it."""
    if values.size < MIN_REST_S * rate_hz:
        return values, 0.0
    lines = _measure_lines(values[None], rate_hz)
    frequencies_hz = np.array([line.frequency_hz for line in lines if line.stands_out[0]])
    phase = 2.0 * np.pi * np.outer(np.arange(values.size) / rate_hz, frequencies_hz)
    waves = np.hstack([np.cos(phase), np.sin(phase)])
    hum: Float1D = waves @ np.linalg.lstsq(waves, values - values.mean())[0]
    return values - hum, float(np.sqrt(np.mean(hum**2)))


def _measure_lines(records: Float2D, rate_hz: float) -> list[_Line]:
    """Return the highest line next to each harmonic of the mains, in records (channel, sample)."""
    size = records.shape[1]
    window = np.hanning(size)
    padded = next_fast_len(max(size, round(1.0 / FREQUENCY_STEP_HZ * rate_hz)), real=True)
    hz = rfftfreq(padded, 1.0 / rate_hz)
    tared = records - records.mean(axis=1, keepdims=True)
    spectra = [rfft(record * window, padded) for record in tared]
    lines = []
    for mains in MAINS_HZ:
        for nominal in np.arange(mains, min(rate_hz / 2 - SURROUNDINGS_HZ, MAX_HARMONIC_HZ), mains):
            first, last = np.searchsorted(
                hz, nominal + (SURROUNDINGS_HZ + 2 * rate_hz / size) * np.array([-1.0, 1.0])
            )
            distance = np.abs(hz[first:last] - nominal)
            tolerance = MAINS_TOLERANCE * nominal + rate_hz / size
            around = distance > tolerance + 2 * rate_hz / size  # beyond the main lobe
            power = np.array([np.abs(spectrum[first:last]) ** 2 for spectrum in spectra])
            inside = np.where(distance < tolerance, power, 0.0)
            level = np.maximum(power[:, around].mean(axis=1), np.finfo(float).tiny)
            ratio = inside.max(axis=1) / level
            frequency_hz = float(hz[first + inside[ratio.argmax()].argmax()])
            amplitudes = 2.0 * np.sqrt(inside.max(axis=1)) / window.sum()
            lines.append(_Line(frequency_hz, amplitudes, ratio > MIN_LINE_RATIO))
    return lines


def _measure_lasting_lines(records: Float2D, rate_hz: float) -> Iterator[_Line]:
    """Yield the medians of each line over the parts of records; it stands out if it does in all."""
    parts = [_measure_lines(part, rate_hz) for part in np.array_split(records, PART_COUNT, axis=1)]
    for in_parts in zip(*parts, strict=True):
        frequencies_hz, amplitudes, stands_out = zip(*in_parts, strict=True)
        yield _Line(
            float(np.median(frequencies_hz)),
            np.median(amplitudes, axis=0),
            np.logical_and.reduce(stands_out),
        )


def _remove_line(
    spectra: Mapping[str, Spectrum], grid: FrequencyGrid, line_hz: float, limits: Float1D,
    drive_hz: Float1D,
) -> dict[str, Spectrum]:  # fmt: skip
    """Return the spectra less one line of hum.

    The line is followed over time. Where its amplitude exceeds the limit of a channel, (channel,),
    where a harmonic of the drive lies at it, or the record ends, hum is interpolated from before
    and after.
    """
    line_spacing = grid.rate_hz / grid.padded_size
    centre, reach = round(line_hz / line_spacing), int(FILTER_WIDTHS * LINE_WIDTH_HZ / line_spacing)
    # from the line upwards, then from below up to it: the order of a transform of the envelope
    offset = ifftshift(np.arange(-reach, reach + 1))
    gain = np.exp(-0.5 * (offset * line_spacing / LINE_WIDTH_HZ) ** 2)
    scale = 2.0 * offset.size / grid.padded_size
    envelopes = scale * ifft([x[centre + offset] * gain for x in spectra.values()], axis=1)
    step_s = 1.0 / (offset.size * line_spacing)
    time_s = np.arange(offset.size) * step_s
    is_loud = (np.abs(envelopes) > limits[:, None]).any(axis=0)
    sample = np.minimum((time_s * grid.rate_hz).astype(np.int64), drive_hz.size - 1)
    order = np.rint(line_hz / drive_hz[sample])
    has_harmonic = np.abs(order * drive_hz[sample] - line_hz) < FILTER_WIDTHS * LINE_WIDTH_HZ
    end_s = 2.0 * SETTLING_S
    inside = (time_s > end_s) & (time_s < grid.size / grid.rate_hz - end_s)
    known = inside & _is_far_from(is_loud | has_harmonic, step_s)
    if known.sum() < 2:  # a slow drive has a harmonic at every line
        known = inside & _is_far_from(is_loud, step_s)
    if known.sum() < 2:
        return dict(spectra)
    # the envelope turns slowly: its frequency is between two lines of the spectrum
    pairs = known[1:] & known[:-1]
    turn = np.sum((envelopes[:, 1:] * envelopes[:, :-1].conj())[:, pairs])
    exact_hz = centre * line_spacing + float(np.angle(turn)) / (2 * np.pi * step_s)
    turning = np.exp(-2j * np.pi * (exact_hz - centre * line_spacing) * time_s)
    sample_s = np.arange(-(-grid.size // grid.decimation)) * grid.decimation / grid.rate_hz
    carrier = np.exp(2j * np.pi * exact_hz * sample_s)
    cleaned = {}
    for (name, spectrum), envelope in zip(spectra.items(), envelopes * turning, strict=True):
        hum = np.interp(sample_s, time_s[known], envelope[known]) * carrier
        cleaned[name] = spectrum - grid.from_time_domain(hum.real)
    return cleaned


def _is_far_from(marked: Bool1D, step_s: float) -> Bool1D:
    """Return the values of an envelope, (value,), on which its filter has no marked one act."""
    spread = math.ceil(FILTER_WIDTHS * SETTLING_S / step_s)
    return ~binary_dilation(marked, iterations=spread) if marked.any() else ~marked
