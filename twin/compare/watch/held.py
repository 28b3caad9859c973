"""What the watch looks at: one whole held cycle, measured beside predicted, and the noise at rest.

Integrals over a cycle are taken against test functions that vanish at both ends with their slope,
so that what is not measured (velocities, end values) drops out by parts and no noise is
differentiated.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from table_io.block import Block, Float1D, Float2D, Label
from table_io.records import Step
from twin.model.model import Model

REST_S = 0.2  # of rest before anything moves: what the sensors say then is their noise
HARMONICS = 2  # of a cycle that the test functions see


@dataclass(frozen=True)
class WatchSetup:
    """What a watch knows of a run: the model, what counts as contact, the gaps in m, the rate."""

    model: Model
    rate_hz: float
    contact_n: float
    gaps_m: tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class Held:
    """A whole held cycle of a step; `true` is measured without what the model's sensors add."""

    step: Step
    number: int
    measured: Block
    true: Block
    predicted: Block

    @property
    def end(self) -> int:
        return self.measured.end

    def column(self, name: str) -> Float1D:
        """A channel of `true`, (sample,); NaN where it is missing."""
        one = self.true
        return one.channel(name) if name in one.channels else np.full(len(one), np.nan)


@dataclass(frozen=True, slots=True, eq=False)
class Noise:
    """rms of each channel's noise, SI, from the first samples at rest; NaN while not known."""

    channels: tuple[str, ...] = ()
    rms: Float1D | None = None
    waiting: Float2D | None = None  # (channel, sample)

    @property
    def known(self) -> bool:
        """True once enough was seen at rest."""
        return self.rms is not None

    def of(self, name: str) -> float:
        """rms of a channel; NaN where nothing was seen at rest."""
        if self.rms is None or name not in self.channels:
            return float("nan")
        return float(self.rms[self.channels.index(name)])

    def seen(self, block: Block) -> "Noise":
        """With the samples at rest of one more block; the same however it was cut."""
        if self.known:
            return self
        rest = block.values[:, block.label == Label.REST]
        waiting = rest if self.waiting is None else np.concatenate([self.waiting, rest], axis=1)
        count = round(REST_S * block.rate_hz)
        if waiting.shape[1] < count:
            return Noise(block.channels, None, waiting)
        rows = [row[np.isfinite(row)] for row in waiting[:, :count]]
        rms = [float(row.std()) if row.size else float("nan") for row in rows]
        return Noise(block.channels, np.array(rms))


@lru_cache(maxsize=64)
def functions(samples: int, rate_hz: float) -> tuple[Float2D, Float2D, Float2D]:
    """(phi, phi', phi'') of test functions over a stretch, (function, sample) each; per s, per s2.

    sin^2 times 1, cos and sin of the first harmonics, at the middle of each sampling interval.
    """
    x = 2 * np.pi * (np.arange(samples) + 0.5) / samples
    scale = 2 * np.pi * rate_hz / samples
    w = [0.5 * (1 - np.cos(x)), 0.5 * np.sin(x), 0.5 * np.cos(x)]
    rows: list[list[Float1D]] = [[], [], []]
    for k in range(HARMONICS + 1):
        c, s = np.cos(k * x), np.sin(k * x)
        waves = [[c, -k * s, -k * k * c], [s, k * c, -k * k * s]]
        for f in waves[: 2 if k else 1]:
            rows[0].append(w[0] * f[0])
            rows[1].append(scale * (w[1] * f[0] + w[0] * f[1]))
            rows[2].append(scale**2 * (w[2] * f[0] + 2 * w[1] * f[1] + w[0] * f[2]))
    phi, slope, bend = (np.array(one) for one in rows)
    return phi, slope, bend


def against(functions: Float2D, values: Float1D) -> Float1D:
    """Sum of the values times each test function, (function,)."""
    total: Float1D = (functions * values).sum(axis=1)
    return total
