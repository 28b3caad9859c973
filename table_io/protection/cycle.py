"""One whole cycle of the drive as a look sees it, and what a look may doubt."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from table_io.block import Float1D, Float2D
from table_io.profile import Profile
from table_io.protection.consistency import despiked
from table_io.rig import Rig
from table_io.tracking import Tracked, track_all

# The first and the last of three looks, half a cycle apart, have no sample in common.
LOOKS = 3
HARMONICS = 5  # told apart from the fundamental of the table's motion


@dataclass(frozen=True, slots=True)
class Doubt:
    """What one look has found, SI; `severity`: "stop", "alarm", or "sensor": as for its channel."""

    kind: str
    channel: str
    value: float
    limit: float
    text: str
    severity: str = "sensor"
    looks: int = LOOKS
    about: str = ""  # what doubts that follow one another have in common, if not the channel

    @property
    def key(self) -> tuple[str, str, str]:
        """The same for the same doubt at the next look."""
        return self.kind, self.about or self.channel, self.severity


@dataclass(frozen=True, eq=False)
class Bench:
    """The test, the machine, and the noise of its sensors: rms, and what counts as a spike."""

    profile: Profile
    rig: Rig
    sigma: Float1D  # (channel,)
    spike: Float1D

    @property
    def rate_hz(self) -> float:
        return self.profile.acquisition.rate_hz

    def range_si(self, name: str) -> float:
        """Range of a sensor either side, SI."""
        return self.rig.sensors[self.rig.channels.index(name)].range_si


@dataclass(frozen=True, eq=False)
class Cycle:
    """About one cycle of the drive: values (channel, sample), the rest (sample,); phase unwrapped.

    `level` and `label` are those of its last sample.
    """

    bench: Bench
    values: Float2D
    command: Float1D
    phase: Float1D
    level: float
    label: int

    @cached_property
    def _clean(self) -> Float2D:
        return despiked(self.values, self.bench.spike[:, None])

    @cached_property
    def _known(self) -> frozenset[str]:
        whole = np.flatnonzero(~np.isnan(self.values).any(axis=1)).tolist()
        return frozenset(self.bench.rig.channels[row] for row in whole)

    @cached_property
    def tones(self) -> dict[str, Tracked]:
        """Harmonics of the command ("command"), as read back, and of the table's two channels."""
        names = ("drive_disp_m", "table_disp_m", "table_acc_m_s2")
        rows = [*(self.clean(name) for name in names), self.command]
        found = track_all(np.array(rows), self.phase, HARMONICS)
        return dict(zip((*names, "command"), found, strict=True))

    def has(self, *names: str) -> bool:
        """True where the rig has these channels and no sample of them is lost."""
        return self._known.issuperset(names)

    def clean(self, name: str) -> Float1D:
        """A channel without single samples that are no motion, (sample,)."""
        row: Float1D = self._clean[self.bench.rig.channels.index(name)]
        return row

    @property
    def turns(self) -> float:
        """Cycles that the drive turns, the last sample's step included."""
        count = self.phase.size
        return float(self.phase[-1] - self.phase[0]) * count / (count - 1)

    @property
    def omega(self) -> float:
        """Angular frequency, rad/s."""
        return 2 * math.pi * self.turns * self.bench.rate_hz / self.phase.size

    def sigma(self, *names: str) -> float:
        """Noise of a sum of channels, rms."""
        return math.hypot(*(self.bench.sigma[self.bench.rig.channels.index(one)] for one in names))

    def relative(self) -> Float1D | None:
        """u in m, right positive; None where it is not measured."""
        if self.has("rel_disp_m"):
            return self.clean("rel_disp_m")
        if self.has("mass_disp_m", "table_disp_m"):
            return self.clean("mass_disp_m") - self.clean("table_disp_m")
        return None


def spoken(value: float, unit: str) -> str:
    """A value in SI as people say it."""
    return f"{1e3 * value:.4g} mm" if unit == "m" else f"{value:.4g} {unit}".strip()


def drifted(channel: str, value: float, limit: float, unit: str) -> Doubt:
    """The doubt of a sensor that shows `value` where it showed nothing at rest."""
    text = f"{channel} has drifted by {spoken(value, unit)}; allowed: {spoken(limit, unit)}"
    return Doubt("drift", channel, value, limit, text)
