"""3D scene of the rig as boxes, in drawn meters on a rig about 2 m wide; x is right, z is up.

Motion is magnified to be visible: `Scene.table_factor` for the table, `Scene.factor` for relative
displacement and gaps alike, so that drawn contact coincides with contact on the rig.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from table_io.block import Float1D, Float2D
from table_io.config.excitation import ExcitationPlan
from table_io.config.profile import Profile
from table_io.units import GRAVITY_M_S2
from twin.viewer.motion import BlockMotion
from twin.viewer.plots import (
    CONTACT_COLOUR,
    IDLE_COLOUR,
    MASS_COLOUR,
    RUBBER_COLOUR,
    STEEL_COLOUR,
    nice_floor,
)

Float3D = npt.NDArray[np.float64]
Colours = npt.NDArray[np.uint8]

HALF_MASS = np.array([0.36, 0.30, 0.20])
HALF_TABLE = np.array([1.00, 0.50, 0.05])
BEARING_HEIGHT, BEARING_LAYERS = 0.27, 9
BUMPER_LENGTH, MIN_BUMPER_LENGTH = 0.20, 0.03
HALF_WALL = np.array([0.035, 0.30, 0.37])


@dataclass(frozen=True, slots=True)
class BoxFrames:
    """Boxes over time, (frame, box, 3) each: centers and half sizes in drawn m, colors."""

    index: npt.NDArray[np.int64]
    centres: Float3D
    half_sizes: Float3D
    colours: Colours


def _table_amplitude(plan: ExcitationPlan) -> float:
    """Return the largest displacement in m of the commanded table motion."""
    if not plan.steps:
        return float(np.abs(plan.history_m).max(initial=plan.swept_disp_m))
    slowest = min(plan.steps, key=lambda step: step.frequency_hz)
    return slowest.acceleration_m_s2 / (2 * math.pi * slowest.frequency_hz) ** 2


@dataclass(frozen=True, slots=True)
class Scene:
    """Scene parameters: gaps in m (right, left), contact threshold in N, magnifications."""

    gaps_m: tuple[float, float]
    contact_n: float
    table_factor: float
    factor: float

    @classmethod
    def from_profile(cls, profile: Profile) -> "Scene":
        """Choose magnifications that draw the largest expected motions about 0.25 m long.

        Expected motions: the commanded table amplitude; the gap plus a bumper deformation, limited
        by free flight.
        """
        table = _table_amplitude(profile.plan)
        level = profile.plan.level_m_s2 / GRAVITY_M_S2 / 0.05
        u = min(max(*profile.specimen.gaps_m, 0.0) + 5e-3 * level, 30e-3 * level)
        gaps = profile.specimen.gaps_m
        return cls(
            gaps, profile.comparison.contact_n, nice_floor(0.3 / table), nice_floor(0.25 / u)
        )

    @property
    def sides(self) -> tuple[tuple[str, float, float], ...]:
        """Sides with a bumper, as (name, sign, gap in m)."""
        sides = zip(("right", "left"), (1.0, -1.0), self.gaps_m, strict=True)
        return tuple(side for side in sides if math.isfinite(side[2]))

    def mass_centres(self, motion: BlockMotion) -> Float2D:
        """Return the center of the mass in drawn m, (frame, 3)."""
        x = self.table_factor * motion.table_disp + self.factor * motion.u
        height = BEARING_HEIGHT + HALF_MASS[2]
        return np.stack([x, np.zeros_like(x), np.full_like(x, height)], axis=1)

    def body_boxes(self, motion: BlockMotion) -> BoxFrames:
        """Return the boxes of table, mass and bumpers, right first; bumpers in contact are lit."""
        x = self.table_factor * motion.table_disp
        table = np.stack([x, np.zeros_like(x), np.full_like(x, -HALF_TABLE[2])], axis=1)
        centres = [table, self.mass_centres(motion)]
        half_sizes = [np.broadcast_to(size, table.shape) for size in (HALF_TABLE, HALF_MASS)]
        colours = [
            np.broadcast_to(np.array(colour, np.uint8), table.shape)
            for colour in (STEEL_COLOUR, MASS_COLOUR)
        ]
        contact_colour = np.array(CONTACT_COLOUR, np.uint8)
        idle_colour = np.array(IDLE_COLOUR, np.uint8)
        for name, sign, gap in self.sides:
            force = motion.force_r if name == "right" else -motion.force_l
            centre, half_size = self._bumper_box(x, sign, gap, sign * motion.u)
            in_contact = np.where(np.isnan(force), sign * motion.u > gap, force > self.contact_n)
            centres.append(centre)
            half_sizes.append(half_size)
            colours.append(np.where(in_contact[:, None], contact_colour, idle_colour))
        arrays = (np.stack(boxes, axis=1) for boxes in (centres, half_sizes, colours))
        return BoxFrames(motion.index, *arrays)

    def _bumper_box(
        self, x: Float1D, sign: float, gap: float, u: Float1D
    ) -> tuple[Float2D, Float2D]:
        """Return center and half size of a bumper, (frame, 3); its tip is at the gap or mass."""
        deformation = self.factor * np.maximum(u - gap, 0)
        length = np.maximum(BUMPER_LENGTH - deformation, MIN_BUMPER_LENGTH)
        base = HALF_MASS[0] + self.factor * gap + BUMPER_LENGTH
        zero = np.zeros_like(x)
        height = zero + BEARING_HEIGHT + HALF_MASS[2]
        centre = np.stack([x + sign * (base - length / 2), zero, height], axis=1)
        return centre, np.stack([length / 2, zero + 0.11, zero + 0.09], axis=1)

    def frame_boxes(self, motion: BlockMotion) -> BoxFrames:
        """Return the boxes of the sheared bearing layers and of the walls behind the bumpers."""
        x = self.table_factor * motion.table_disp
        zero = np.zeros_like(x)
        layer_height = BEARING_HEIGHT / BEARING_LAYERS
        fractions = (np.arange(BEARING_LAYERS) + 0.5) / BEARING_LAYERS
        positions = [
            (x + self.factor * motion.u * fraction, BEARING_HEIGHT * fraction)
            for fraction in fractions
        ]
        sizes = [np.array([0.19, 0.19, 0.46 * layer_height])] * BEARING_LAYERS
        colours = [(RUBBER_COLOUR, STEEL_COLOUR)[layer % 2] for layer in range(BEARING_LAYERS)]
        for _, sign, gap in self.sides:
            positions.append((x + sign * self._wall_distance(gap), HALF_WALL[2]))
            sizes.append(HALF_WALL)
            colours.append(STEEL_COLOUR)
        centres = np.stack(
            [np.stack([x_position, zero, zero + z], axis=1) for x_position, z in positions], axis=1
        )
        half_sizes = np.broadcast_to(np.array(sizes), centres.shape)
        return BoxFrames(
            motion.index,
            centres,
            half_sizes,
            np.broadcast_to(np.array(colours, np.uint8), centres.shape),
        )

    def _wall_distance(self, gap: float) -> float:
        """Return the drawn distance of a wall from the middle of the table in m."""
        return float(HALF_MASS[0] + self.factor * gap + BUMPER_LENGTH + HALF_WALL[0])

    def caption_texts(self, mass_kg: float) -> list[str]:
        """Return the texts for `caption_positions`, in the same order."""
        return [f"mass {mass_kg:g} kg", "table", *(f"{name} bumper" for name, _, _ in self.sides)]

    def caption_positions(self, motion: BlockMotion) -> Float3D:
        """Return the positions of the captions in drawn m, (frame, caption, 3)."""
        x = self.table_factor * motion.table_disp
        zero = np.zeros_like(x)
        positions = [
            (self.mass_centres(motion)[:, 0], -HALF_MASS[1], BEARING_HEIGHT + HALF_MASS[2])
        ]
        positions.append((x, -HALF_TABLE[1], -HALF_TABLE[2]))
        caption_height = 2 * HALF_WALL[2] + 0.1
        positions += [
            (x + sign * self._wall_distance(gap), 0.0, caption_height)
            for _, sign, gap in self.sides
        ]
        return np.stack(
            [np.stack([x_position, zero + y, zero + z], axis=1) for x_position, y, z in positions],
            axis=1,
        )
