"""Input and output of the cycle checks: one whole cycle of the drive, and a suspicion."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from table_io.block import Float1D, Float2D
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig
from table_io.control.order_tracking import HarmonicFit, track_channels
from table_io.safety.protection.consistency import (
    WeakFormWindow,
    make_window,
    remove_spikes,
)

# Checks are half a cycle apart, so the first and the last of three share no sample.
CONFIRMATION_CHECKS = 3
TRACKED_HARMONICS = 5  # separated from the fundamental of the table's motion


@dataclass(frozen=True, slots=True)
class Suspicion:
    """Suspected fault from one cycle check, SI.

    `severity` is "stop", "alarm" or "sensor" (stop or alarm, depending on the channel).
    """

    kind: str
    channel: str
    value: float
    limit: float
    text: str
    severity: str = "sensor"
    required_checks: int = CONFIRMATION_CHECKS
    group: str = ""  # key shared by successive suspicions where the channel may change

    @property
    def key(self) -> tuple[str, str, str]:
        """Key by which successive suspicions count as the same."""
        return self.kind, self.group or self.channel, self.severity


@dataclass(frozen=True, eq=False)
class ProtectionContext:
    """Profile, rig, and noise of its sensors at rest: rms and spike threshold, SI, (channel,)."""

    profile: Profile
    rig: RigConfig
    sigma: Float1D  # (channel,)
    spike_limit: Float1D

    @property
    def rate_hz(self) -> float:
        return self.profile.acquisition.rate_hz

    def range_si(self, name: str) -> float:
        """Return the full-scale range of a sensor on either side, SI."""
        return self.rig.sensors[self.rig.channels.index(name)].range_si


@dataclass(frozen=True, eq=False)
class DriveCycle:
    """About one cycle of the drive: values (channel, sample), command and phase (sample,).

    The phase is unwrapped; `level` and `label` are those of the last sample.
    """

    context: ProtectionContext
    values: Float2D
    command: Float1D
    phase: Float1D
    level: float
    label: int

    @cached_property
    def _clean_values(self) -> Float2D:
        return remove_spikes(self.values, self.context.spike_limit[:, None])

    @cached_property
    def _complete_channels(self) -> frozenset[str]:
        rows = np.flatnonzero(~np.isnan(self.values).any(axis=1)).tolist()
        return frozenset(self.context.rig.channels[row] for row in rows)

    @cached_property
    def tones(self) -> dict[str, HarmonicFit]:
        """Harmonics of the command ("command"), of its read-back and of the table's channels."""
        names = ("drive_disp_m", "table_disp_m", "table_acc_m_s2")
        rows = [*(self.clean_channel(name) for name in names), self.command]
        tracked = track_channels(np.array(rows), self.phase, TRACKED_HARMONICS)
        return dict(zip((*names, "command"), tracked, strict=True))

    @cached_property
    def window(self) -> WeakFormWindow:
        """Test functions over the cycle."""
        middle = 0.5 * float(self.phase[0] + self.phase[-1])
        return make_window(self.phase.size, self.cycle_count, middle, self.context.rate_hz)

    def has(self, *names: str) -> bool:
        """Return True if the rig has these channels and no sample of them is lost."""
        return self._complete_channels.issuperset(names)

    def clean_channel(self, name: str) -> Float1D:
        """Return a channel with spikes of one sample removed, (sample,)."""
        row: Float1D = self._clean_values[self.context.rig.channels.index(name)]
        return row

    @property
    def cycle_count(self) -> float:
        """Cycles of the drive, including the interval after the last sample."""
        count = self.phase.size
        return float(self.phase[-1] - self.phase[0]) * count / (count - 1)

    @property
    def omega(self) -> float:
        """Angular frequency, rad/s."""
        return 2 * math.pi * self.cycle_count * self.context.rate_hz / self.phase.size

    def sigma(self, *names: str) -> float:
        """Return the rms noise of a sum of channels."""
        return math.hypot(
            *(self.context.sigma[self.context.rig.channels.index(name)] for name in names)
        )

    def relative_displacement(self) -> Float1D | None:
        """Return u in m, right positive, (sample,); None where it is not measured."""
        if self.has("rel_disp_m"):
            return self.clean_channel("rel_disp_m")
        if self.has("mass_disp_m", "table_disp_m"):
            return self.clean_channel("mass_disp_m") - self.clean_channel("table_disp_m")
        return None


def format_si(value: float, unit: str) -> str:
    """Format a value with its unit, m as mm."""
    return f"{1e3 * value:.4g} mm" if unit == "m" else f"{value:.4g} {unit}".strip()


def suspect_drift(channel: str, value: float, limit: float, unit: str) -> Suspicion:
    """Make the suspicion that a sensor has drifted by `value`."""
    text = f"{channel} has drifted by {format_si(value, unit)}; allowed: {format_si(limit, unit)}"
    return Suspicion("drift", channel, value, limit, text)
