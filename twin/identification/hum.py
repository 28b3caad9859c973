"""Mains hum: lines at the mains frequency and its harmonics, removed from the spectra of a record.

A harmonic of the drive may coincide with a line of the mains for some steps. What tells the two
apart is time: hum is there at rest and lasts for the whole record, a harmonic belongs to its steps.
"""

import math
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.fft import fft, ifft, ifftshift, rfft, rfftfreq
from scipy.ndimage import binary_dilation

from table_io.block import Bool2D, Float1D
from twin.identification.spectra import FrequencyGrid, Spectrum

MAINS_HZ, MAINS_TOLERANCE = (50.0, 60.0), 0.002  # relative deviation of the mains frequency
MIN_REST_S = 2.0  # from here on the rest alone shows whether there is hum
PART_COUNT = 4  # of a record without rest: hum is in every part
SURROUNDINGS_HZ = 3.0
MIN_LINE_RATIO = 20.0  # power of a line over the mean around it; noise alone hardly reaches it
LINE_WIDTH_HZ = 0.15  # standard deviation of the Gaussian filter that follows a line over time
FILTER_WIDTHS = 4.0  # half width of that filter, in standard deviations
MAX_EXCESS = 3.0  # times the amplitude at rest: above it there is a harmonic of the drive
ZERO_PADDING = 8  # of a transform that measures the frequency of a line


def remove_hum(
    spectra: Mapping[str, Spectrum], grid: FrequencyGrid, at_rest: Bool2D
) -> dict[str, Spectrum]:
    """Return the spectra, (frequency,) each, less the hum that stands out in any of them.

    All channels are treated alike, so that a balance of their forces stays one. `at_rest` are the
    samples before the motion, (sample,) at the original rate.
    """
    rate_hz = grid.rate_hz / grid.decimation
    records = [grid.to_time_domain(spectrum) for spectrum in spectra.values()]
    rest = at_rest[:: grid.decimation]
    parts = [[values[rest] for values in records]]
    if rest.sum() < MIN_REST_S * rate_hz:
        parts = [
            list(part)
            for part in zip(
                *(np.array_split(values, PART_COUNT) for values in records), strict=True
            )
        ]
    cleaned = dict(spectra)
    for mains in MAINS_HZ:
        for nominal in np.arange(mains, rate_hz / 2 - SURROUNDINGS_HZ, mains):
            found = [_find_line(part, rate_hz, nominal) for part in parts]
            if all(line_hz for line_hz, _ in found):
                amplitudes = np.median([amplitude for _, amplitude in found], axis=0)
                line_hz = float(np.median([line_hz for line_hz, _ in found]))
                cleaned = _remove_line(cleaned, grid, line_hz, amplitudes)
    return cleaned


def _find_line(records: Sequence[Float1D], rate_hz: float, nominal: float) -> tuple[float, Float1D]:
    """Return the frequency of a line, 0 if none stands out, and its amplitudes, (channel,).

    The amplitude is infinite in a channel in which the line does not stand out.
    """
    size = records[0].size
    window = np.hanning(size)
    hz = rfftfreq(ZERO_PADDING * size, 1.0 / rate_hz)
    tolerance = MAINS_TOLERANCE * nominal + rate_hz / size
    near = np.abs(hz - nominal) < SURROUNDINGS_HZ + 2 * rate_hz / size
    inside = np.abs(hz - nominal)[near] < tolerance
    # the main lobe of the window about a line anywhere inside
    around = np.abs(hz - nominal)[near] > tolerance + 2 * rate_hz / size
    amplitudes, best_ratio, line_hz = np.full(len(records), np.inf), MIN_LINE_RATIO, 0.0
    for channel, values in enumerate(records):
        spectrum = rfft((values - values.mean()) * window, ZERO_PADDING * size)[near]
        power = np.abs(spectrum) ** 2
        peak = int(np.argmax(np.where(inside, power, 0.0)))
        ratio = power[peak] / max(float(power[around].mean()), np.finfo(float).tiny)
        if ratio > MIN_LINE_RATIO:
            amplitudes[channel] = 2.0 * np.sqrt(power[peak]) / window.sum()
        if ratio > best_ratio:
            best_ratio, line_hz = ratio, float(hz[near][peak])
    return line_hz, amplitudes


def _remove_line(
    spectra: Mapping[str, Spectrum], grid: FrequencyGrid, line_hz: float, amplitudes: Float1D
) -> dict[str, Spectrum]:
    """Return the spectra less one line of hum, of known amplitudes, (channel,), at rest.

    The line is followed over time; where a channel is far louder than at rest, or the record ends,
    hum is interpolated from before and after.
    """
    line_spacing = grid.rate_hz / grid.padded_size
    centre, reach = round(line_hz / line_spacing), int(FILTER_WIDTHS * LINE_WIDTH_HZ / line_spacing)
    # from the line upwards, then from below up to it: the order of a transform of the envelope
    offset = ifftshift(np.arange(-reach, reach + 1))
    gain = np.exp(-0.5 * (offset * line_spacing / LINE_WIDTH_HZ) ** 2)
    lines, count = centre + offset, offset.size
    envelope = ifft([spectrum[lines] * gain for spectrum in spectra.values()], axis=1)
    amplitude = 2.0 * np.abs(envelope) * count / grid.padded_size
    step_s = 1.0 / (count * line_spacing)
    time_s = np.arange(count) * step_s
    settling_s = 1.0 / (2 * np.pi * LINE_WIDTH_HZ)
    is_loud = (amplitude > MAX_EXCESS * amplitudes[:, None]).any(axis=0)
    spread = math.ceil(FILTER_WIDTHS * settling_s / step_s)
    known = ~binary_dilation(is_loud, iterations=spread) if is_loud.any() else ~is_loud
    known &= (time_s > settling_s) & (time_s < grid.size / grid.rate_hz - settling_s)
    cleaned = dict(spectra)
    if known.any():
        for name, values in zip(spectra, envelope, strict=True):
            cleaned[name] = spectra[name].copy()
            hum = np.interp(time_s, time_s[known], values[known], period=count * step_s)
            cleaned[name][lines] -= fft(hum)
    return cleaned
