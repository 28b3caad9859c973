"""The physical effects a model may have. Adding one: a file here and a line in `EFFECTS`."""

from twin.model.effects.bumper_asymmetry import BUMPER_ASYMMETRY
from twin.model.effects.effect import Effect
from twin.model.effects.gap_offset import GAP_OFFSET

EFFECTS: tuple[Effect, ...] = (
    BUMPER_ASYMMETRY,
    GAP_OFFSET,
)
