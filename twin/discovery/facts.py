"""Facts of a residual: its slow components in each block, in place of its samples.

Along a measured motion a residual carries the noise of that motion through the forces of the model:
that of the velocity alone, at high frequency, would exceed everything else, and a candidate that
filters the motion would seem to explain it. So a block of samples (a forcing cycle, a contact, a
second) enters by its components in the band where the measured forces exceed their noise. There the
noise is small, no candidate changes it, and slopes are not attenuated by it.

The components are those of the orthonormal discrete cosine transform: white noise of a density
keeps it, and that of any other density has nearly that at the frequency of the component. This is
the weak form of the balance; for a block of one period it is a fit of its harmonics (Pintelon and
Schoukens, System Identification: A Frequency Domain Approach, 2012).
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from table_io.block import Float1D, Float2D, Int1D
from twin.compare.hum import HUM_LASTING_S

MAX_TABLES = 4096  # of cosines, by number of samples and components


@dataclass(frozen=True, eq=False)
class BlockBasis:
    """Cosine components of the blocks of one row: `block` of each sample of the row, in order.

    The components are those up to `band_hz`, at `rate_hz` samples a second. Of the lines of hum
    `hum_hz` they tell nothing: what the blocks of `HUM_LASTING_S` have of one, in any phase and
    growing or not, is taken off. `sample` is the number of each sample of the row.
    """

    block: Int1D
    rate_hz: float
    band_hz: float
    sample: Int1D
    hum_hz: tuple[float, ...] = ()

    @cached_property
    def _starts(self) -> Int1D:
        """First sample of each block, (block,)."""
        return np.flatnonzero(np.diff(self.block, prepend=-1 if self.block.size else 0))

    @cached_property
    def _sizes(self) -> Int1D:
        """Number of samples of each block, (block,)."""
        return np.diff(self._starts, append=self.block.size)

    @cached_property
    def counts(self) -> Int1D:
        """Number of components of each block, (block,)."""
        wanted = np.floor(2.0 * self.band_hz / self.rate_hz * self._sizes).astype(np.int64) + 1
        return np.minimum(wanted, self._sizes)

    @property
    def size(self) -> int:
        """Number of components of all blocks."""
        return int(self.counts.sum())

    @cached_property
    def order(self) -> Int1D:
        """Order of each component within its block, (fact,)."""
        first = np.cumsum(self.counts) - self.counts
        return np.arange(self.size) - np.repeat(first, self.counts)

    @cached_property
    def frequency_hz(self) -> Float1D:
        """Frequency of each component, (fact,)."""
        return 0.5 * self.rate_hz * self.order / np.repeat(self._sizes, self.counts)

    @cached_property
    def middle(self) -> Int1D:
        """Sample in the middle of the block of each component, (fact,)."""
        return np.repeat(self._starts + self._sizes // 2, self.counts)

    @cached_property
    def _groups(self) -> list[tuple[Int1D, Int1D, Float2D]]:
        """(samples (block, sample), facts (block, component), cosines) by size of the blocks."""
        groups, first = [], np.cumsum(self.counts) - self.counts
        for size in np.unique(self._sizes):
            blocks = np.flatnonzero(self._sizes == size)
            count = int(self.counts[blocks[0]])
            samples = self._starts[blocks][:, None] + np.arange(size)
            facts = first[blocks][:, None] + np.arange(count)
            groups.append((samples, facts, _tabulate_cosines(int(size), count)))
        return groups

    def project(self, values: Float1D) -> Float1D:
        """Return the components of a row, (fact,), from its samples, (sample,)."""
        return self._take_off(self._transform(values), self._hum_waves)

    def _transform(self, values: Float1D) -> Float1D:
        components = np.empty(self.size)
        for samples, facts, cosines in self._groups:
            components[facts] = values[samples] @ cosines
        return components

    @cached_property
    def _hum_groups(self) -> Int1D:
        """Number of the stretch in which hum keeps its phase, of each component, (fact,)."""
        starts = self.sample[self._starts] / (HUM_LASTING_S * self.rate_hz)
        return np.repeat(np.unique(starts.astype(np.int64), return_inverse=True)[1], self.counts)

    @cached_property
    def _hum_waves(self) -> list[tuple[Float1D, Float1D]]:
        """Both phases of each line of hum, constant and growing, and their squares by stretch.

        They are orthogonal, (fact,) each.
        """
        waves: list[tuple[Float1D, Float1D]] = []
        for hz in self.hum_hz if self.size else ():
            time_s = self.sample / self.rate_hz
            phases = np.cos(2.0 * np.pi * hz * time_s), np.sin(2.0 * np.pi * hz * time_s)
            for values in (*phases, *(time_s * phase for phase in phases)):
                wave = self._take_off(self._transform(values), waves)
                squares = np.bincount(self._hum_groups, wave**2)
                waves.append((wave, np.maximum(squares, np.finfo(float).tiny)))
        return waves

    def _take_off(self, values: Float1D, waves: list[tuple[Float1D, Float1D]]) -> Float1D:
        """Return components, (fact,), less what they have of each of the waves."""
        for wave, squares in waves:
            share = np.bincount(self._hum_groups, values * wave) / squares
            values = values - share[self._hum_groups] * wave
        return values


@lru_cache(MAX_TABLES)
def _tabulate_cosines(size: int, count: int) -> Float2D:
    """Return the orthonormal cosines, (sample, component)."""
    angle = np.pi / size * np.outer(np.arange(size) + 0.5, np.arange(count))
    cosines = np.sqrt(2.0 / size) * np.cos(angle)
    cosines[:, 0] = np.sqrt(1.0 / size)
    return cosines
