"""The rig as boxes, to be drawn in metres on a rig about two metres wide; x is right, z is up.

Motion is magnified, because millimetres on metres cannot be seen: `Scene.table_factor` for the
table, `Scene.factor` for everything on it, gaps too, so a bumper is touched in the picture exactly
when it is touched on the rig.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from table_io.block import Float1D, Float2D
from table_io.profile import Profile
from twin.stream.rerun.looks import CONTACT, IDLE, MASS, RUBBER, STEEL
from twin.stream.rerun.moving import Motion
from twin.stream.rerun.plots import nice_below

Float3D = npt.NDArray[np.float64]
Colours = npt.NDArray[np.uint8]

HALF_MASS = np.array([0.36, 0.30, 0.20])
HALF_TABLE = np.array([1.00, 0.50, 0.05])
BEARING_HEIGHT, BEARING_LAYERS = 0.27, 9
BUMPER_LENGTH, BUMPER_LEAST = 0.20, 0.03
HALF_WALL = np.array([0.035, 0.30, 0.37])


@dataclass(frozen=True, slots=True)
class Boxes:
    """Boxes over time, (frame, box, 3) each: centres and half sizes in drawn m, colours."""

    index: npt.NDArray[np.int64]
    centres: Float3D
    halves: Float3D
    colours: Colours


@dataclass(frozen=True, slots=True)
class Scene:
    """The rig to be drawn: gaps in m (right, left), contact threshold in N, magnifications."""

    gaps_m: tuple[float, float]
    contact_n: float
    table_factor: float
    factor: float

    @classmethod
    def of(cls, profile: Profile) -> "Scene":
        """The scene whose largest expected motions are drawn about a quarter of a metre long.

        Expected: the commanded table amplitude, and the gap plus what the free mass adds to it.
        """
        slowest = min(profile.sweep.steps, key=lambda step: step.frequency_hz)
        table = slowest.acceleration_m_s2 / (2 * math.pi * slowest.frequency_hz) ** 2
        level = profile.sweep.acceleration_g / 0.05
        u = min(max(*profile.specimen.gaps_m, 0.0) + 5e-3 * level, 30e-3 * level)
        gaps = profile.specimen.gaps_m
        return cls(
            gaps, profile.comparison.contact_n, nice_below(0.3 / table), nice_below(0.25 / u)
        )

    @property
    def sides(self) -> tuple[tuple[str, float, float], ...]:
        """(name, sign, gap in m) of every side that has a bumper."""
        both = zip(("right", "left"), (1.0, -1.0), self.gaps_m, strict=True)
        return tuple(side for side in both if math.isfinite(side[2]))

    def mass(self, moves: Motion) -> Float2D:
        """Centre of the mass in drawn m, (frame, 3)."""
        x = self.table_factor * moves.table + self.factor * moves.u
        height = BEARING_HEIGHT + HALF_MASS[2]
        return np.stack([x, np.zeros_like(x), np.full_like(x, height)], axis=1)

    def bodies(self, moves: Motion) -> Boxes:
        """Table, mass and the bumpers that there are, right first; lit while in contact."""
        x = self.table_factor * moves.table
        table = np.stack([x, np.zeros_like(x), np.full_like(x, -HALF_TABLE[2])], axis=1)
        centres = [table, self.mass(moves)]
        halves = [np.broadcast_to(size, table.shape) for size in (HALF_TABLE, HALF_MASS)]
        colours = [np.broadcast_to(np.array(one, np.uint8), table.shape) for one in (STEEL, MASS)]
        lit, idle = np.array(CONTACT, np.uint8), np.array(IDLE, np.uint8)
        for name, sign, gap in self.sides:
            force = moves.force_r if name == "right" else -moves.force_l
            centre, half = self._bumper(x, sign, gap, sign * moves.u)
            touches = np.where(np.isnan(force), sign * moves.u > gap, force > self.contact_n)
            centres.append(centre)
            halves.append(half)
            colours.append(np.where(touches[:, None], lit, idle))
        stacks = (np.stack(one, axis=1) for one in (centres, halves, colours))
        return Boxes(moves.index, *stacks)

    def _bumper(self, x: Float1D, sign: float, gap: float, u: Float1D) -> tuple[Float2D, Float2D]:
        """Centre and half size of a bumper; its tip rests at the gap or on the mass, (frame, 3)."""
        squeezed = self.factor * np.maximum(u - gap, 0)
        length = np.maximum(BUMPER_LENGTH - squeezed, BUMPER_LEAST)
        base = HALF_MASS[0] + self.factor * gap + BUMPER_LENGTH
        zero = np.zeros_like(x)
        height = zero + BEARING_HEIGHT + HALF_MASS[2]
        centre = np.stack([x + sign * (base - length / 2), zero, height], axis=1)
        return centre, np.stack([length / 2, zero + 0.11, zero + 0.09], axis=1)

    def frame(self, moves: Motion) -> Boxes:
        """The layers of the sheared bearing and, the walls."""
        x = self.table_factor * moves.table
        zero = np.zeros_like(x)
        thick = BEARING_HEIGHT / BEARING_LAYERS
        up = (np.arange(BEARING_LAYERS) + 0.5) / BEARING_LAYERS
        places = [(x + self.factor * moves.u * part, BEARING_HEIGHT * part) for part in up]
        sizes = [np.array([0.19, 0.19, 0.46 * thick])] * BEARING_LAYERS
        paint = [(RUBBER, STEEL)[layer % 2] for layer in range(BEARING_LAYERS)]
        for _, sign, gap in self.sides:
            places.append((x + sign * self._wall(gap), HALF_WALL[2]))
            sizes.append(HALF_WALL)
            paint.append(STEEL)
        centres = np.stack([np.stack([at, zero, zero + z], axis=1) for at, z in places], axis=1)
        halves = np.broadcast_to(np.array(sizes), centres.shape)
        return Boxes(
            moves.index, centres, halves, np.broadcast_to(np.array(paint, np.uint8), centres.shape)
        )

    def _wall(self, gap: float) -> float:
        """Drawn distance of a wall from the middle of the table."""
        return float(HALF_MASS[0] + self.factor * gap + BUMPER_LENGTH + HALF_WALL[0])

    def captions(self, mass_kg: float) -> list[str]:
        """What stands at the places of `names`."""
        return [f"mass {mass_kg:g} kg", "table", *(f"{name} bumper" for name, _, _ in self.sides)]

    def names(self, moves: Motion) -> Float3D:
        """Where the captions stand, bumpers above their walls: (frame, caption, 3)."""
        x = self.table_factor * moves.table
        zero = np.zeros_like(x)
        places = [(self.mass(moves)[:, 0], -HALF_MASS[1], BEARING_HEIGHT + HALF_MASS[2])]
        places.append((x, -HALF_TABLE[1], -HALF_TABLE[2]))
        above = 2 * HALF_WALL[2] + 0.1
        places += [(x + sign * self._wall(gap), 0.0, above) for _, sign, gap in self.sides]
        return np.stack([np.stack([at, zero + y, zero + z], axis=1) for at, y, z in places], axis=1)
