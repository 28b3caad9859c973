"""The channels of a log as spectra; a motion is made from them for any belief about the sensors.

Gain, lag and offset of a sensor are plain factors on its spectrum, so that a fit may try them.
"""

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from table_io.block import Block, Bool2D, Float1D, Int1D, Label, join
from table_io.card import BadInput
from table_io.channels import LEFT_CELLS, RIGHT_CELLS
from twin.learn.motion import Motion, Noise, Surprise
from twin.learn.spectra import Grid, Spectrum, believed, white_noise
from twin.model.model import Sensor

EDGE_S = 0.3  # next to a lost sample nothing is believed: the bridge spreads in the fusion
OPEN_END_S = 0.5  # a record that does not begin or end at rest is not believed so long
BODIES = (("mass", "mass_disp_m", "mass_acc_m_s2"), ("table", "table_disp_m", "table_acc_m_s2"))
USED = (
    "rel_disp_m", "mass_disp_m", "table_disp_m", "mass_acc_m_s2", "table_acc_m_s2",
    *RIGHT_CELLS, *LEFT_CELLS, "damper_force_n",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Readings:
    """A log made ready: `spectra` and raw `noise` rms of each channel, what it is, its labels."""

    name: str
    mass_kg: float
    gaps_m: tuple[float, float]
    grid: Grid
    w: Float1D
    low: Float1D
    ones: Spectrum
    spectra: Mapping[str, Spectrum]
    noise: Mapping[str, float]
    rest: Mapping[str, tuple[float, float]]  # (mean, its deviation) before anything moved, SI
    time_s: Float1D
    step: Int1D
    label: Int1D
    cycle: Int1D
    good: Bool2D

    @property
    def channels(self) -> tuple[str, ...]:
        return tuple(self.spectra)

    @property
    def zeros(self) -> dict[str, tuple[tuple[str, float], ...]]:
        """Of u, acc, table (its acc), right, left: the channels that make it, with their signs.

        Only what was tared: what reads something at rest, before anything moves.
        """
        lasers = (("mass_disp_m", 1.0), ("table_disp_m", -1.0))
        made = {
            "u": lasers if "mass_disp_m" in self.spectra else (("rel_disp_m", 1.0),),
            "acc": (("mass_acc_m_s2", 1.0),),
            "table": (("table_acc_m_s2", 1.0),),
            "right": tuple((one, 1.0) for one in RIGHT_CELLS if one in self.spectra),
            "left": tuple((one, 1.0) for one in LEFT_CELLS if one in self.spectra),
        }
        return {
            name: channels
            for name, channels in made.items()
            if channels and {one for one, _ in channels} <= self.rest.keys()
        }

    def at_rest(self, name: str) -> tuple[float, float]:
        """(mean of one of `zeros` at rest, its deviation), SI.

        What pressed-in bumpers make it read then is real: of the tare nothing is known but its
        deviation.
        """
        known = [(sign, *self.rest[one]) for one, sign in self.zeros[name]]
        pressed = min(self.gaps_m) <= 0
        mean = 0.0 if pressed else sum(sign * mean for sign, mean, _ in known)
        return mean, float(np.hypot.reduce([sd for _, _, sd in known])) / float(np.sqrt(2.0))

    def whitening(self, stiffness: float, damping: float) -> Float1D:
        """(frequency,) gain per kg that makes the balance's noise white and of rms 1, where the
        acceleration of the mass comes from its displacement.

        The noise of u then enters as -w^2 u'' and as K u + C u' alike: for a stiffness in N/(m kg)
        and a damping in N s/(m kg) it is s_u |K - w^2 + i w C|, small where the signal is large.
        """
        displacement = "rel_disp_m" if "rel_disp_m" in self.noise else "mass_disp_m"
        s_u = self.noise[displacement] * np.abs(stiffness - self.w**2 + 1j * self.w * damping)
        gain: Float1D = self.low / np.hypot(s_u, self.noise["table_acc_m_s2"])
        return gain / self.grid.rms(self.low)

    def motion(self, sensors: Sequence[Sensor] = ()) -> Motion:
        """The motion, where these sensors read gain x value(t - lag) + offset."""
        believed = dict(self.spectra)
        for one in sensors:
            if one.channel in believed:
                there = believed[one.channel] - one.offset * self.ones
                believed[one.channel] = there * np.exp(1j * self.w * one.lag) / one.gain
        noise = dict(self.noise)
        for one in sensors:
            if one.channel in noise:
                noise[one.channel] /= abs(one.gain)
        return _Fusion(self, believed, noise).motion()


def derives_acc(channels: Container[str]) -> bool:
    """True where the mass has no accelerometer and its displacement must do."""
    return "mass_acc_m_s2" not in channels and "table_acc_m_s2" in channels


class _Fusion:
    """One motion in the making."""

    def __init__(
        self, readings: Readings, spectra: Mapping[str, Spectrum], noise: Mapping[str, float]
    ) -> None:
        self.r, self.spectra, self.noise = readings, spectra, noise
        self.grid, self.w, self.low = readings.grid, readings.w, readings.low
        self.nothing = np.full(readings.time_s.size, np.nan)

    def motion(self) -> Motion:
        r = self.r
        position, noise_u, noise_v, surprises = self._relative()
        right, noise_right = self._total(RIGHT_CELLS)
        left, noise_left = self._total(LEFT_CELLS)
        keep = self.grid.rms(self.low)
        acc, noise_acc = self._channel("mass_acc_m_s2"), self._rms("mass_acc_m_s2") * keep
        if derives_acc(self.spectra):
            acc = self.grid.back((self.spectra["table_acc_m_s2"] - self.w**2 * position) * self.low)
        noise = Noise(
            noise_u, noise_v, noise_acc, noise_right * keep, noise_left * keep,
            self._rms("damper_force_n") * keep,
        )  # fmt: skip
        surprises += self._shares()
        damper = self._channel("damper_force_n") if "damper_force_n" in self.spectra else None
        return Motion(
            r.name, self.grid.rate_hz / self.grid.every, r.mass_kg, r.gaps_m, r.time_s,
            self.grid.back(position * self.low), self.grid.back(1j * self.w * position * self.low),
            acc, self._channel("table_acc_m_s2"), self._channel("table_disp_m"), right, left,
            r.step, r.label, r.cycle, r.good, noise, surprises, damper,
        )  # fmt: skip

    def _relative(self) -> tuple[Spectrum, float, float, tuple[Surprise, ...]]:
        """(spectrum of u, noise of u, of v, the surprises)."""
        there = self.spectra
        if {"mass_disp_m", "table_disp_m"} <= there.keys():
            pairs = [self._fused(*body) for body in BODIES]
            noises = np.hypot(pairs[0][1], pairs[1][1])
            found = tuple(pair[2] for pair in pairs if pair[2] is not None)
            return pairs[0][0] - pairs[1][0], self._u(noises), self._v(noises), found
        acc, noise = None, 0.0
        if {"mass_acc_m_s2", "table_acc_m_s2"} <= there.keys():
            acc = there["mass_acc_m_s2"] - there["table_acc_m_s2"]
            noise = float(np.hypot(self._rms("mass_acc_m_s2"), self._rms("table_acc_m_s2")))
        spectrum, noises, surprise = self._fuse(
            "mass against table", there["rel_disp_m"], self._rms("rel_disp_m"), acc, noise
        )
        return spectrum, self._u(noises), self._v(noises), (surprise,) if surprise else ()

    def _fused(self, body: str, laser: str, meter: str) -> tuple[Spectrum, Float1D, Any]:
        acc = self.spectra.get(meter)
        return self._fuse(body, self.spectra[laser], self._rms(laser), acc, self._rms(meter))

    def _fuse(
        self, body: str, position: Spectrum, s_x: float, acc: Spectrum | None, s_a: float
    ) -> tuple[Spectrum, Float1D, Surprise | None]:
        """(spectrum, its noise per frequency over white, what the two do not agree on)."""
        if acc is None:
            return position, np.full(self.w.size, s_x), None
        w2 = self.w**2
        both = s_a**2 + w2**2 * s_x**2
        fused = (s_a**2 * position - w2 * s_x**2 * acc) / both
        odd = self.grid.back((acc + w2 * position) / np.sqrt(both) * self.low)
        whole = self.grid.rms(self.low)
        surprise = Surprise(body, odd / whole, 1.0 / (s_a * whole))
        return fused, s_a * s_x / np.sqrt(both), surprise

    def _shares(self) -> tuple[Surprise, ...]:
        """Where two load cells of a side do not bear the same, over their noise."""
        found = []
        for side, (one, other) in (("right cells", RIGHT_CELLS), ("left cells", LEFT_CELLS)):
            if {one, other} <= self.spectra.keys():
                odd = self._channel(one) - self._channel(other)
                noise = np.hypot(self._rms(one), self._rms(other)) * self.grid.rms(self.low)
                found.append(Surprise(side, odd / noise))
        return tuple(found)

    def _u(self, noises: Float1D) -> float:
        return self.grid.rms(noises * self.low)

    def _v(self, noises: Float1D) -> float:
        return self.grid.rms(self.w * noises * self.low)

    def _channel(self, name: str) -> Float1D:
        return (
            self.grid.back(self.spectra[name] * self.low) if name in self.spectra else self.nothing
        )

    def _rms(self, name: str) -> float:
        return self.noise.get(name, float("nan"))

    def _total(self, cells: tuple[str, ...]) -> tuple[Float1D, float]:
        """(force of the cells of a side, its raw noise)."""
        present = [name for name in cells if name in self.spectra]
        if not present:
            return self.nothing, float("nan")
        total = np.sum([self.spectra[name] for name in present], axis=0)
        return self.grid.back(total * self.low), float(np.hypot.reduce([*map(self._rms, present)]))


def readings_of(
    blocks: tuple[Block, ...], name: str, mass_kg: float, gaps_m: tuple[float, float]
) -> Readings:
    """The readings in measured blocks; BadInput where nobody measured the displacement."""
    whole = _filled(blocks, name)
    columns = {
        key: whole.channel(key)
        for key in USED
        if key in whole.channels and alive(whole.channel(key))
    }
    if "rel_disp_m" not in columns and not {"mass_disp_m", "table_disp_m"} <= columns.keys():
        raise BadInput(
            f"{name}: no displacement of the mass against the table; needed: rel_disp_m, or "
            "mass_disp_m and table_disp_m; nothing can be learned without"
        )
    rest = _at_rest(whole)
    good = np.logical_and.reduce([np.isfinite(values) for values in columns.values()])
    grid = Grid(len(whole), whole.rate_hz)
    sure = believed(good, round(EDGE_S * whole.rate_hz))
    margin = round(OPEN_END_S * whole.rate_hz)
    if whole.label[0] != Label.REST:
        sure[:margin] = False
    if whole.label[-1] != Label.REST:
        sure[-margin:] = False
    size = -(-len(whole) // grid.every)
    noise = {key: white_noise(values, rest) for key, values in columns.items()}
    return Readings(
        name, mass_kg, gaps_m, grid, grid.w, grid.low, grid.spectrum(np.ones(len(whole))),
        {key: grid.spectrum(values) for key, values in columns.items()},
        noise,
        _rest(columns, rest, noise),
        (whole.index + grid.every * np.arange(size)) / whole.rate_hz,
        whole.step[:: grid.every], whole.label[:: grid.every], whole.cycle[:: grid.every],
        sure[:: grid.every],
    )  # fmt: skip


def alive(values: Float1D) -> bool:
    """False where nothing was measured, or always the same: a dead channel."""
    known = values[np.isfinite(values)]
    return bool(known.size and np.ptp(known) > 0.0)


def _filled(blocks: tuple[Block, ...], name: str) -> Block:
    """One block from pieces; samples that are missing between them are NaN."""
    if not blocks:
        raise BadInput(f"{name}: holds no measured samples")
    parts: list[Block] = []
    for block in blocks:
        if parts and parts[-1].end < block.index:
            parts.append(_nothing(parts[-1], block.index))
        parts.append(block)
    return join(parts)


def _nothing(before: Block, until: int) -> Block:
    count = until - before.end
    outside = np.full(count, -1, dtype=np.int64)
    values = np.full((len(before.channels), count), np.nan)
    label = np.zeros(count, dtype=np.int64)
    return Block(
        before.stream, before.end, before.rate_hz, before.channels, values, outside, label, outside
    )


def _at_rest(block: Block) -> Bool2D:
    """Samples of the rest before anything moved: there all that is measured is noise."""
    moved = np.flatnonzero(block.label != Label.REST)
    rest = np.zeros(len(block), dtype=bool)
    rest[: moved[0] if moved.size else 0] = True
    return rest


def _rest(
    columns: Mapping[str, Float1D], rest: Bool2D, noise: Mapping[str, float]
) -> dict[str, tuple[float, float]]:
    """What the channels read at rest, to be zero after a tare; the tare is no better known."""
    found = {}
    for key, values in columns.items():
        known = values[rest & np.isfinite(values)]
        if known.size >= 100:
            found[key] = float(known.mean()), noise[key] * float(np.sqrt(2.0 / known.size))
    return found
