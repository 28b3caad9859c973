"""Spectra of whole records: low-pass filtering and decimation."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.fft import irfft, next_fast_len, rfft, rfftfreq

from table_io.block import Bool2D, Float1D, interpolate_missing

TARGET_RATE_HZ = 500.0  # 50 samples of a contact of 0.1 s; noise above the band is removed
ROLL_OFF_START = 0.8  # of the new Nyquist frequency: start of the low-pass roll-off
PAD_S = 2.0
Spectrum = npt.NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class FrequencyGrid:
    """Time and frequency grid of a record: zero-padded FFT, low pass and decimation."""

    size: int
    rate_hz: float

    @property
    def decimation(self) -> int:
        return max(int(self.rate_hz // TARGET_RATE_HZ), 1)

    @cached_property
    def padded_size(self) -> int:
        pad = round(PAD_S * self.rate_hz)
        return self.decimation * next_fast_len(-(-(self.size + pad) // self.decimation), real=True)

    @cached_property
    def bin_count(self) -> int:
        return self.padded_size // self.decimation // 2 + 1

    @cached_property
    def omega(self) -> Float1D:
        """Angular frequencies in rad/s, (frequency,)."""
        return 2 * np.pi * rfftfreq(self.padded_size, 1.0 / self.rate_hz)[: self.bin_count]

    @cached_property
    def low_pass(self) -> Float1D:
        """Gain of the low pass, (frequency,); 1 everywhere without decimation."""
        if self.decimation == 1:
            return np.ones(self.bin_count)
        x = self.omega * self.decimation / (np.pi * self.rate_hz)
        low: Float1D = 0.5 + 0.5 * np.cos(
            np.pi * np.clip((x - ROLL_OFF_START) / (1 - ROLL_OFF_START), 0, 1)
        )
        return low

    def to_spectrum(self, values: Float1D, ends: tuple[Float1D, Float1D] | None = None) -> Spectrum:
        """Return the spectrum, (frequency,), of values at the original rate, (sample,).

        `ends` continue them before and after the record, up to half of `PAD_S` each; else by zeros.
        """
        whole = np.zeros(self.padded_size)
        whole[: self.size] = interpolate_missing(values)
        if ends is not None:
            before, after = ends
            whole[self.size : self.size + after.size] = after
            whole[whole.size - before.size :] = before
        return rfft(whole)[: self.bin_count]

    def apply_gain(self, values: Float1D, gain: Float1D) -> Float1D:
        """Filter values at the decimated rate, (sample,), with a gain, (frequency,)."""
        spectrum = rfft(values, self.padded_size // self.decimation)
        filtered: Float1D = irfft(spectrum * gain, self.padded_size // self.decimation)[
            : values.size
        ]
        return filtered

    def to_time_domain(self, spectrum: Spectrum) -> Float1D:
        """Return the values of a spectrum at the decimated rate, (sample,)."""
        count = -(-self.size // self.decimation)
        samples: Float1D = (
            irfft(spectrum, self.padded_size // self.decimation)[:count] / self.decimation
        )
        return samples

    def from_time_domain(self, values: Float1D) -> Spectrum:
        """Return the spectrum, (frequency,), of values at the decimated rate, (sample,)."""
        return self.decimation * rfft(values, self.padded_size // self.decimation)

    def white_noise_rms(self, gain: Float1D) -> float:
        """Return the rms of white noise of rms 1 (original rate) after a gain, (frequency,)."""
        return float(np.sqrt(np.sum(gain**2) / (self.padded_size / 2 + 1)))


def exclude_margins(good: Bool2D, before: int, after: int) -> Bool2D:
    """Return the samples, (sample,), that are good with as many before and after them."""
    lost = np.concatenate([[0], np.cumsum(~good)])
    sample = np.arange(good.size)
    first, end = np.maximum(sample - before, 0), np.minimum(sample + after + 1, good.size)
    usable: Bool2D = lost[end] == lost[first]
    return usable
