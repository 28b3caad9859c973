"""What a guess leaves of the measured forces, along the measured motion.

    damper          -M a - F_R - F_L - D     (the damper's force from the balance, or measured)
    right, left     F_R - model's, -(F_L - model's), where contact was measured
    mass, table     the kinematic gates, see `readings`; right and left cells: do they agree
    right, left pull  what a side pulls just after it let go, where every law of ours has no force
    rest            what each channel reads before anything moves, and u; one entry each
each divided by its noise. Without load cells the damper row holds all forces, and the model says
where it touches. Nothing is simulated, so a fit converges from far and in chaos.

Residuals of real rigs are coloured: statistics are taken over blocks, never over samples.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt

from table_io.block import Bool2D, Float1D, Float2D, Int1D
from twin.learn.general import GENERAL, Scale, forces
from twin.learn.guess import SLIP, Guess
from twin.learn.motion import Motion, Surprise
from twin.learn.readings import Readings, derives_acc
from twin.model.forced import along, tilting
from twin.model.model import Model, Sensor

CONTACT_NOISES = 8.0  # a load cell above so many of its noise bears something
EDGE_S = 0.012  # next to a measured touch or release the low pass smears the jump
BLOCK_S = 1.0  # of a block where there are no forcing cycles
FORCES = ("damper", "right", "left")
TARED = ("acc", "right", "left")
PULLS = ("right pull", "left pull")
SWING = 0.005  # of the largest push: by so much the low pass swings through zero after a release
KEPT = 3  # motions of other beliefs that are remembered
MOST_SAMPLES = 500_000  # in motion, of all logs together: more would ask for too much memory


@dataclass(frozen=True, eq=False)
class Sheet:
    """A log prepared for fits: which samples count in which row, and in which block they lie.

    `number` is its place among the logs; `reference` gives the stiffnesses by which errors of the
    motion become errors of forces.
    """

    number: int
    readings: Readings
    contact_n: float
    reference: Model
    scale: Scale
    weight: float = 1.0  # of the noise: above 1 where the model's error, not noise, is the limit
    thinned: int = 1  # of each step's cycles, and of the blocks outside them, one part in so many
    _motions: list[tuple[tuple[Sensor, ...], Motion]] = field(default_factory=list)

    def motion(self, sensors: tuple[Sensor, ...] = ()) -> Motion:
        """The motion for a belief about the sensors; the last few are remembered."""
        found = next((m for key, m in self._motions if key == sensors), None)
        if found is None:
            found = self.readings.motion(sensors)
            plain = [pair for pair in self._motions if not pair[0]]
            last = [pair for pair in self._motions if pair[0]][-KEPT + 1 :]
            self._motions[:] = [*plain, *last, (sensors, found)]  # at once: others may be asking
        return found

    @cached_property
    def touched(self) -> npt.NDArray[np.int8]:
        """(2, sample): 1 where a side was measured to bear, 0 where not, -1 where nobody knows."""
        m = self.motion()
        if not m.cells:
            known = -1 if any(math.isfinite(gap) for gap in m.gaps_m) else 0
            return np.full((2, m.u.size), known, dtype=np.int8)
        sides = []
        for push, rms, gap in (
            (m.right, m.noise.right, m.gaps_m[0]),
            (m.left, m.noise.left, m.gaps_m[1]),
        ):
            idle = float(np.median(push[~m.moving])) if gap > 0 and (~m.moving).any() else 0.0
            sides.append(push - idle > max(self.contact_n, CONTACT_NOISES * rms))
        return np.array(sides, dtype=np.int8)

    @cached_property
    def used(self) -> Bool2D:
        """(row, sample): what counts in the rows."""
        m = self.motion()
        used = np.zeros((len(self.rows), m.u.size), dtype=bool)
        used[0] = m.moving & np.isfinite(self.measured(m, m.mass_kg)[0])
        margin = max(round(EDGE_S * m.rate_hz), 1)
        window = np.ones(2 * margin + 1)
        if m.cells and m.damper is None:
            for row in range(2):
                touched = self.touched[row] > 0
                used[1 + row] = m.moving & touched & (np.convolve(~touched, window, "same") == 0)
        recent = np.concatenate([np.zeros(margin), np.ones(margin + 1)])
        change = np.abs(np.diff(self.touched, axis=1, prepend=self.touched[:, :1])).any(axis=0)
        smooth = np.convolve(change, window, "same") == 0
        for row, name in enumerate(self.rows):
            if name in PULLS:
                touched = self.touched[PULLS.index(name)] > 0
                used[row] = m.moving & ~touched & (np.convolve(touched, recent, "same") > 0)
            elif row >= len(FORCES):
                side = {"right cells": 0, "left cells": 1}.get(name)
                used[row] = m.moving & smooth if side is None else used[1 + side]
        return used & self._counting

    @cached_property
    def _counting(self) -> Bool2D:
        """(sample,) of a thinned log: the last cycles of each step, and each so manyth block else.

        At least two cycles, one after the other: what does not repeat in them is the noise.
        """
        m = self.motion()
        if self.thinned == 1:
            return np.ones(m.u.size, dtype=bool)
        held = np.zeros(int(m.step.max(initial=-1)) + 2, dtype=np.int64)
        np.maximum.at(held, m.step, m.cycle + 1)  # step -1 is the last entry
        last = m.cycle >= (held - np.maximum(held // self.thinned, 2))[m.step]
        counting: Bool2D = np.where(m.cycle >= 0, last, self.blocks % self.thinned == 0)
        return counting

    @cached_property
    def resting(self) -> tuple[str, ...]:
        """The channels of which it is known that they should read nothing at rest."""
        if min(self.readings.gaps_m) <= 0:  # pressed in: what is read then is real
            return ()
        return tuple(self.readings.rest)

    @cached_property
    def rows(self) -> tuple[str, ...]:
        """The names of the rows that have samples; the one after them is that of the rest."""
        m = self.motion()
        pulls = PULLS if m.cells and m.damper is None else ()
        return (*FORCES, *(one.body for one in m.surprises), *pulls)

    @cached_property
    def row_of(self) -> Int1D:
        """(entry,) row of each entry of a residual."""
        rows = np.repeat(np.arange(len(self.rows)), self.used.sum(axis=1))
        return np.concatenate([rows, np.full(self._last, len(self.rows))])

    @property
    def _last(self) -> int:
        """Entries of a residual that are of the rest and of the zero."""
        return len(self.resting) + len(self.readings.zeros)

    @cached_property
    def sample_of(self) -> Int1D:
        """(entry,) sample of each entry of a residual."""
        samples = [np.flatnonzero(row) for row in self.used]
        return np.concatenate([*samples, np.zeros(self._last, dtype=np.int64)])

    @cached_property
    def block_of(self) -> Int1D:
        """(entry,) block of each entry of a residual."""
        return self.blocks[self.sample_of]

    @cached_property
    def whole_contacts(self) -> Int1D:
        """(entry,) block of each entry, a contact that reaches into the next block with the first.

        Slow errors of u pull C_j one way while the mass goes in and back again while it comes out;
        cut in two, a contact would look like two strong pulls. A lasting contact is cut all the
        same.
        """
        free = (self.touched <= 0).all(axis=0)
        before = np.maximum.accumulate(np.where(free, np.arange(free.size), 0))
        began = self.blocks[before]
        whole: Int1D = np.where(self.blocks - began <= 1, began, self.blocks)
        return whole[self.sample_of]

    def measured(self, m: Motion, mass_kg: float, guess: Guess | None = None) -> Float2D:
        """(3, sample): damper force from the balance of a mass, F_R, -F_L in N."""
        off = {what: guess.zero(self.number, what) if guess else 0.0 for what in TARED}
        if m.damper is not None:
            nothing = np.full(m.u.size, np.nan)
            return np.array([m.damper, nothing, nothing])
        inertia, right, left = (
            -mass_kg * (m.acc - off["acc"]), m.right - off["right"], m.left - off["left"]
        )  # fmt: skip
        return np.array([inertia - right + left if m.cells else inertia, right, left])

    def noise(self, m: Motion, mass_kg: float) -> Float1D:
        """(3,) rms of the force rows in N, from the sensors alone, for a belief about them.

        With the mass and the gains that are believed: else a smaller mass would seem to fit
        better, for no reason but that it makes less of the accelerometer's noise.
        """
        n, p = m.noise, self.reference.parameters
        motion = math.hypot(p.stiffness * n.u, p.damping * n.v)
        sides = [
            math.hypot(cells, k * n.u, c * n.v)
            for cells, k, c in (
                (n.right, p.bumper_stiffness_r, p.bumper_damping_r),
                (n.left, p.bumper_stiffness_l, p.bumper_damping_l),
            )
        ]
        if m.damper is not None:
            return np.array([math.hypot(n.force, motion), np.nan, np.nan])
        cells = (n.right, n.left) if m.cells else ()
        if self.whitening is not None:
            return np.array([mass_kg, *sides])
        return np.array([math.hypot(mass_kg * n.acc, motion, *cells), *sides])

    @cached_property
    def whitening(self) -> Float1D | None:
        """(frequency,) the filter of the damper row where the mass has no accelerometer."""
        if not derives_acc(self.readings.channels) or self.motion().damper is not None:
            return None
        p = self.reference.parameters
        return self.readings.whitening(p.stiffness / p.mass, p.damping / p.mass)

    @cached_property
    def blocks(self) -> Int1D:
        """(sample,) number of the block that a sample lies in: a forcing cycle, else a second."""
        m = self.motion()
        seconds = (m.time_s / BLOCK_S).astype(np.int64)
        loose = np.where(m.cycle >= 0, 0, seconds)
        key = np.stack([m.step, m.cycle, loose])
        change = np.any(np.diff(key, axis=1) != 0, axis=0)
        numbers: Int1D = np.concatenate([[0], np.cumsum(change)])
        return numbers

    def residual(self, guess: Guess) -> Float1D:
        """(entry,) measured minus model over noise, row after row, where a row counts."""
        m = self.motion(guess.sensors())
        model = guess.local(self.number, m)
        u = m.u - guess.zero(self.number, "u")
        d, right, left = along(model, u, m.v, m.time_s, self.touched)
        if SLIP in guess.values:
            fc = model.value("coulomb_friction", "fc") or 0.0
            d = d + fc * (np.tanh(m.v / guess.values[SLIP]) - np.where(m.v > 0, 1.0, -1.0))
        if not m.cells and m.damper is None:
            d = d + right + left
        if model.value("table_tilt", "tilt"):
            d = d + tilting(model, m.table_disp)
        expected = np.array([d, right, -left])
        if any(name.startswith(GENERAL) for name in guess.values):
            p = model.parameters
            more = forces(guess.values, m, (p.gap_r, p.gap_l), self.touched, self.scale)
            expected += more
        mass = model.parameters.mass
        rows = self.measured(m, mass, guess) - expected
        rows /= self.noise(m, mass)[:, None]
        if self.whitening is not None:
            rows[0] = self.readings.grid.filtered(rows[0], self.whitening)
        everything = [*rows, *(self._surprise(one, guess) for one in m.surprises)]
        if m.cells and m.damper is None:
            everything += [*self._pulls(m, guess)]
        samples = [row[used] for row, used in zip(everything, self.used, strict=True)]
        return np.concatenate([*samples, self._at_rest(guess)]) / self.weight

    def _surprise(self, one: Surprise, guess: Guess) -> Float1D:
        """A surprise as far as the tares of the accelerometers do not make it."""
        parts = {"mass": (1, 0), "table": (0, 1), "mass against table": (1, -1)}
        mass, table = parts.get(one.body, (0, 0))
        off = mass * guess.zero(self.number, "acc") + table * guess.zero(self.number, "table")
        return one.values - one.per_acc * off if off else one.values

    def _pulls(self, m: Motion, guess: Guess) -> Float2D:
        """(2, sample) pull of each side over the noise of its cells; what it pushes is no pull.

        Of mean square 1 at the most where there is noise alone: half of it counts. The low pass
        swings through zero by a small part of the push that ended; that is no pull either.
        """
        sides = (m.right, "right", m.noise.right), (m.left, "left", m.noise.left)
        return np.array([
            np.minimum(push - guess.zero(self.number, name) + SWING * np.nanmax(push), 0.0)
            * math.sqrt(2.0) / rms
            for push, name, rms in sides
        ])  # fmt: skip

    def _at_rest(self, guess: Guess) -> Float1D:
        """What is read at rest beyond the sensors' own offsets, and beyond the doubt of a tare."""
        offset = {one.channel: one.offset for one in guess.sensors()}
        known = [(self.readings.rest[name], offset.get(name, 0.0)) for name in self.resting]
        entries = [(mean - there) / sd for (mean, sd), there in known]
        for what, channels in self.readings.zeros.items():
            mean, sd = self.readings.at_rest(what)
            own = sum(sign * offset.get(name, 0.0) for name, sign in channels)
            entries.append((mean - own - guess.zero(self.number, what)) / sd)
        return np.array(entries)


def sheets_of(
    logs: Sequence[tuple[Readings, float]], reference: Model, weights: Sequence[float] = ()
) -> tuple[Sheet, ...]:
    """The sheets of several logs, (readings, contact threshold in N) each, on one scale."""
    motions = [readings.motion() for readings, _ in logs]
    u = max(float(np.abs(m.u[m.moving]).max(initial=0.0)) for m in motions) or 1.0
    v = max(float(np.abs(m.v[m.moving]).max(initial=0.0)) for m in motions) or 1.0
    gaps = [gap for m in motions for gap in m.gaps_m if math.isfinite(gap)]
    depth = max(u - min(gaps), 1e-2 * u) if gaps else u
    scale = Scale(u, v, depth)
    thinned = math.ceil(sum(int(m.moving.sum()) for m in motions) / MOST_SAMPLES) or 1
    rated = zip(logs, weights or [1.0] * len(logs), strict=True)
    return tuple(
        Sheet(number, readings, contact_n, reference, scale, weight, thinned)
        for number, ((readings, contact_n), weight) in enumerate(rated)
    )
