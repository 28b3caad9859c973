"""Input of the monitoring: a whole held cycle, measured and predicted, and the noise at rest.

Integrals over a cycle are weighted with test functions that vanish at both ends with their slope
(weak form), so that unmeasured quantities (velocities, end values) drop out by integration by
parts and no noise is differentiated.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from table_io.block import Block, Float1D, Float2D, Label
from table_io.records import Step
from twin.model.model import Model

NOISE_REST_S = 0.2  # of samples at rest, which give the sensor noise
WEIGHT_HARMONICS = 2  # of a cycle, in the test functions


@dataclass(frozen=True)
class MonitoringSetup:
    """Setup of the monitoring: model, sampling rate, contact threshold in N, gaps in m."""

    model: Model
    rate_hz: float
    contact_n: float
    gaps_m: tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class CycleData:
    """A whole held cycle of a step.

    `measured` is without the low cuts of accelerometers, `corrected` also without the model's
    sensor errors. `recorded` is as recorded, but without the latter.
    """

    step: Step
    number: int
    measured: Block
    corrected: Block
    predicted: Block
    recorded: Block | None = None  # None: there are no low cuts

    @property
    def end(self) -> int:
        return self.measured.end

    def channel_values(self, name: str) -> Float1D:
        """Return a channel of `corrected`, (sample,); NaN if it is missing."""
        block = self.corrected
        return block.channel(name) if name in block.channels else np.full(len(block), np.nan)


@dataclass(frozen=True, slots=True, eq=False)
class ChannelNoise:
    """Noise rms of each channel, SI, from the first samples at rest; NaN while unknown."""

    channels: tuple[str, ...] = ()
    rms: Float1D | None = None
    pending: Float2D | None = None  # (channel, sample)

    @property
    def is_known(self) -> bool:
        """True after enough samples at rest."""
        return self.rms is not None

    def channel_rms(self, name: str) -> float:
        """Return the noise rms of a channel; NaN without samples at rest."""
        if self.rms is None or name not in self.channels:
            return float("nan")
        return float(self.rms[self.channels.index(name)])

    @property
    def relative_displacement_rms(self) -> float:
        """Noise rms of u in m: of its own sensor, else of both lasers; NaN while unknown."""
        rms = self.channel_rms("rel_disp_m")
        return self.laser_difference_rms if np.isnan(rms) else rms

    @property
    def laser_difference_rms(self) -> float:
        """Noise rms of the difference of the lasers of mass and table in m; NaN while unknown."""
        return float(np.hypot(self.channel_rms("mass_disp_m"), self.channel_rms("table_disp_m")))

    def add_block(self, block: Block) -> "ChannelNoise":
        """Update with a block's samples at rest; independent of the division into blocks."""
        if self.is_known:
            return self
        rest = block.values[:, block.label == Label.REST]
        pending = rest if self.pending is None else np.concatenate([self.pending, rest], axis=1)
        count = round(NOISE_REST_S * block.rate_hz)
        if pending.shape[1] < count:
            return ChannelNoise(block.channels, None, pending)
        rows = [row[np.isfinite(row)] for row in pending[:, :count]]
        rms = [float(row.std()) if row.size else float("nan") for row in rows]
        return ChannelNoise(block.channels, np.array(rms))


@lru_cache(maxsize=64)
def weight_functions(samples: int, rate_hz: float) -> tuple[Float2D, Float2D, Float2D]:
    """Return test functions (phi, phi', phi''), (function, sample) each; 1, per s, per s2.

    sin^2 times 1, cos and sin of the first harmonics, at the middle of each sampling interval.
    """
    x = 2 * np.pi * (np.arange(samples) + 0.5) / samples
    scale = 2 * np.pi * rate_hz / samples
    w = [0.5 * (1 - np.cos(x)), 0.5 * np.sin(x), 0.5 * np.cos(x)]
    rows: list[list[Float1D]] = [[], [], []]
    for k in range(WEIGHT_HARMONICS + 1):
        c, s = np.cos(k * x), np.sin(k * x)
        waves = [[c, -k * s, -k * k * c], [s, k * c, -k * k * s]]
        for f in waves[: 2 if k else 1]:
            rows[0].append(w[0] * f[0])
            rows[1].append(scale * (w[1] * f[0] + w[0] * f[1]))
            rows[2].append(scale**2 * (w[2] * f[0] + 2 * w[1] * f[1] + w[0] * f[2]))
    phi, slope, curvature = (np.array(row) for row in rows)
    return phi, slope, curvature


@lru_cache(maxsize=64)
def weight_norms(samples: int, rate_hz: float) -> tuple[Float1D, Float1D]:
    """Return the root sums of squares of phi and phi'', (function,) each."""
    phi, _, curvature = weight_functions(samples, rate_hz)
    return np.sqrt((phi**2).sum(axis=1)), np.sqrt((curvature**2).sum(axis=1))


def weighted_sums(functions: Float2D, values: npt.ArrayLike) -> Float2D:
    """Return the sum of values (..., sample) times each test function, (..., function)."""
    total: Float2D = (functions * np.asarray(values)[..., None, :]).sum(axis=-1)
    return total
