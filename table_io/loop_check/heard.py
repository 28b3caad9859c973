"""What a loop check has recorded, read channel by channel: rest, held motions, tones.

A tone is the fundamental of a channel over a held motion, complex, over the peak acceleration that
was commanded: so it is 1 for a perfect table. Displacements are read as the acceleration that goes
with them (-w^2 x), forces in N per m/s2.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from table_io.block import Block, Float1D, Label
from table_io.channels import BY_NAME
from table_io.drive import Drive, Segment
from table_io.profile import Profile
from table_io.rig import Rig
from table_io.tracking import track, track_all

Complex1D = npt.NDArray[np.complex128]
ORDERS = 5  # tracked together; more change nothing over whole cycles
QUIET_S = 1.0  # at the end of the rest after the motion: by then all should be still


@dataclass(frozen=True)
class Heard:
    """`block`: rest, the motions of the check, rest after them; SI, tared.

    `tare_noise` is the rms of each channel at the tare, where it is known.
    """

    block: Block
    drive: Drive
    profile: Profile
    rig: Rig
    tare_noise: dict[str, float]

    @cached_property
    def holds(self) -> tuple[Segment, ...]:
        """The held motions, lowest frequency first."""
        held = [one for one in self.drive.segments if one.step < 0 and one.label == Label.CHECK]
        inside = [one for one in held if self.block.index <= one.start < one.end <= self.block.end]
        return tuple(sorted(inside, key=lambda one: one.f0))

    @cached_property
    def frequencies_hz(self) -> Float1D:
        """Frequency of each held motion, (hold,)."""
        return np.array([hold.f0 for hold in self.holds])

    @cached_property
    def before(self) -> Block:
        """The rest before the motion."""
        return self.block.cut(self.block.index, self._moving[0])

    @cached_property
    def after(self) -> Block:
        """The last of the rest after the motion."""
        rest = self.block.end - self._moving[1]
        count = min(rest, math.ceil(QUIET_S * self.block.rate_hz))
        return self.block.cut(self.block.end - count, self.block.end)

    @cached_property
    def moving(self) -> Block:
        """From the first held motion to the end of the last one."""
        return self.block.cut(min(h.start for h in self.holds), max(h.end for h in self.holds))

    @cached_property
    def _moving(self) -> tuple[int, int]:
        check = [one for one in self.drive.segments if one.step < 0]
        return check[0].start, max(one.end for one in check)

    @property
    def level(self) -> float:
        """Peak acceleration of the test itself, m/s2."""
        return self.profile.sweep.steps[0].acceleration_m_s2

    def has(self, *names: str) -> bool:
        """True where all of these channels are there and not altogether lost."""
        return all(
            name in self.block.channels and np.isfinite(self.block.channel(name)).any()
            for name in names
        )

    def window(self, hold: Segment) -> Block:
        """The last whole cycles of a held motion, without its first one: that one settles."""
        cycles = max(math.floor(hold.count * hold.f0 / self.block.rate_hz + 1e-6) - 1, 1)
        count = min(round(cycles * self.block.rate_hz / hold.f0), hold.count)
        return self.block.cut(hold.end - count, hold.end)

    def phase(self, window: Block) -> Float1D:
        """Phase of the drive over a window, in cycles, (sample,)."""
        return self.drive.phase(window.index, len(window))

    def tones(self, name: str) -> Complex1D:
        """Tone of a channel at each held motion, (hold,); NaN where it is lost."""
        units = np.array([self._unit(name, hold) for hold in self.holds])
        return self._fundamentals[self.block.channels.index(name)] * units

    @cached_property
    def _fundamentals(self) -> npt.NDArray[np.complex128]:
        """Fundamental of every channel at each held motion, (channel, hold)."""
        found = np.empty((len(self.block.channels), len(self.holds)), dtype=np.complex128)
        for k, hold in enumerate(self.holds):
            window = self.window(hold)
            phase = self.phase(window)
            for n, one in enumerate(track_all(window.values, phase, ORDERS)):
                values = window.values[n]
                known = np.isfinite(values)
                some = one if known.all() else track(values[known], phase[known], ORDERS)
                found[n, k] = some.amplitudes[0]
        return found

    def errors(self, name: str) -> Float1D:
        """Standard error of |tone| at each held motion that the noise at rest makes, (hold,)."""
        noise = self.noise(name)
        return np.array(
            [
                noise * math.sqrt(2.0 / len(self.window(hold))) * abs(self._unit(name, hold))
                for hold in self.holds
            ]
        )

    def clear(self, name: str) -> float:
        """The clearest tone of a channel over its standard error; 0 where all of it is lost."""
        ratios = np.abs(self.tones(name)) / self.errors(name)
        return float(np.nan_to_num(ratios, nan=0.0).max())

    def _unit(self, name: str, hold: Segment) -> float:
        """What turns an amplitude of the channel into a tone."""
        level = hold.level0 * hold.correction0
        return (-((2 * math.pi * hold.f0) ** 2) if BY_NAME[name].unit == "m" else 1.0) / level

    def noise(self, name: str) -> float:
        """rms of a channel at rest about its mean, SI; at least what its converter rounds."""
        resting = _spread(self.before.channel(name))
        least = self.lsb(name) / math.sqrt(12.0)
        return max(resting, self.tare_noise.get(name, 0.0), least) if resting >= 0 else math.nan

    def lsb(self, name: str) -> float:
        """One step of a channel's converter, SI."""
        sensor = next(one for one in self.rig.sensors if one.channel == name)
        return 2.0 * sensor.range_si / 2.0**sensor.bits


def _spread(values: Float1D) -> float:
    known = values[np.isfinite(values)]
    return float(known.std()) if known.size else math.nan


def mismatch(
    displacement: tuple[Float1D, float],
    acceleration: tuple[Float1D, float],
    phase: Float1D,
    omega: float,
    rate_hz: float,
) -> tuple[float, float]:
    """(|ratio - 1|, its standard error): second derivative of a displacement over an acceleration.

    Each comes as (samples, noise rms), SI, over one window at the constant angular frequency
    `omega`. Weak form: integral phi'' x dt = integral phi a dt with phi = sin^4 times the drive's
    tone, which vanishes with three derivatives at both ends: exact for any motion, offsets drop
    out, and no noise is differentiated.
    """
    x, a = displacement[0], acceleration[0]
    length_s = x.size / rate_hz
    turn = np.pi * (np.arange(x.size) + 0.5) / x.size
    sin2, cos2 = np.sin(turn) ** 2, np.cos(turn) ** 2
    window = sin2**2
    first = 4 * math.pi / length_s * sin2 * np.sin(turn) * np.cos(turn)
    second = (math.pi / length_s) ** 2 * (12 * sin2 * cos2 - 4 * sin2**2)
    tone = np.exp(-2j * np.pi * phase)
    phi = window * tone
    phi_2 = (second - 2j * omega * first - omega**2 * window) * tone
    twice, once = complex(phi_2 @ x), complex(phi @ a)
    scatter = math.hypot(
        displacement[1] * float(np.linalg.norm(phi_2)), acceleration[1] * float(np.linalg.norm(phi))
    )
    if once == 0:
        return math.nan, math.inf
    return abs(twice / once - 1.0), scatter / max(abs(once), abs(twice))
