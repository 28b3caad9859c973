"""Spectra of whole records: the low pass to a lower rate, and how noisy a channel is."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.fft import irfft, next_fast_len, rfft, rfftfreq
from scipy.signal import welch

from table_io.block import Bool2D, Float1D

RATE_HZ = 500.0  # contacts last 0.1 s: fifty samples; noise beyond is thrown away
ROLL_OFF = 0.8  # of the new Nyquist frequency: from here on the low pass falls
PAD_S = 2.0
SEGMENT, BANDS = 1024, 8  # samples of a spectrum that is averaged; the quietest band is noise
LEAST_NOISE = 1e-4  # of a channel's rms: no sensor is better
Spectrum = npt.NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class Grid:
    """Samples in time, frequencies up to the new rate, and the low pass between the two."""

    size: int
    rate_hz: float

    @property
    def every(self) -> int:
        return max(int(self.rate_hz // RATE_HZ), 1)

    @property
    def padded(self) -> int:
        pad = round(PAD_S * self.rate_hz)
        return self.every * next_fast_len(-(-(self.size + pad) // self.every), real=True)

    @property
    def kept(self) -> int:
        return self.padded // self.every // 2 + 1

    @property
    def w(self) -> Float1D:
        """(frequency,) in 1/s."""
        return 2 * np.pi * rfftfreq(self.padded, 1.0 / self.rate_hz)[: self.kept]

    @property
    def low(self) -> Float1D:
        """(frequency,) the low pass; one everywhere where no sample is left out."""
        if self.every == 1:
            return np.ones(self.kept)
        x = self.w * self.every / (np.pi * self.rate_hz)
        low: Float1D = 0.5 + 0.5 * np.cos(np.pi * np.clip((x - ROLL_OFF) / (1 - ROLL_OFF), 0, 1))
        return low

    def spectrum(self, values: Float1D) -> Spectrum:
        """(frequency,) of (sample,) at the old rate."""
        return rfft(bridged(values), self.padded)[: self.kept]

    def filtered(self, values: Float1D, gain: Float1D) -> Float1D:
        """(sample,) at the new rate through a gain, (frequency,)."""
        spectrum = rfft(values, self.padded // self.every)
        found: Float1D = irfft(spectrum * gain, self.padded // self.every)[: values.size]
        return found

    def back(self, spectrum: Spectrum) -> Float1D:
        """(sample,) at the new rate."""
        count = -(-self.size // self.every)
        found: Float1D = irfft(spectrum, self.padded // self.every)[:count] / self.every
        return found

    @property
    def neighbours(self) -> float:
        """Correlation of the noise of two neighbouring samples at the new rate."""
        power = self.low**2
        return float(np.sum(power * np.cos(self.w * self.every / self.rate_hz)) / power.sum())

    def rms(self, density: Float1D) -> float:
        """Of what white noise of rms 1 at the old rate becomes through a gain, (frequency,)."""
        return float(np.sqrt(np.sum(density**2) / (self.padded / 2 + 1)))


def white_noise(values: Float1D, rest: Bool2D) -> float:
    """Noise of a channel, taken for white: its scatter at rest, else the floor of its spectrum.

    Where the two agree within what a short rest can tell, the floor is the more exact one.
    """
    known = values[rest & np.isfinite(values)]
    every = values[np.isfinite(values)]
    _, density = welch(every, 1.0, nperseg=min(SEGMENT, every.size))
    bands = np.array_split(density[1:-1], BANDS)
    found = float(np.sqrt(0.5 * min(float(np.median(band)) for band in bands)))
    if known.size >= 100:
        scatter = float(known.std())
        if abs(found - scatter) > 3.0 * scatter / np.sqrt(2.0 * known.size):
            found = scatter
    return max(found, LEAST_NOISE * float(every.std()), 1e-300)


def bridged(values: Float1D) -> Float1D:
    """The channel with lost samples bridged by straight lines; what they say is not believed."""
    known = np.isfinite(values)
    if known.all():
        return values
    places = np.arange(values.size)
    return np.interp(places, places[known], values[known])


def believed(good: Bool2D, margin: int) -> Bool2D:
    """Good samples that have no lost one within `margin`."""
    if good.all():
        return good.copy()
    spread = np.convolve(~good, np.ones(2 * margin + 1), "same") > 0
    kept: Bool2D = ~spread
    return kept
