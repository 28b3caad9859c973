"""Where a law was fitted, and where a run leaves that range: outside it the law is not known."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from table_io.block import Float1D
from twin.model.effects.effect_file import WrittenEffect
from twin.model.model import Model

# Of the width of a range: the end of a measured range is itself uncertain by noise.
RANGE_MARGIN = 0.02
VARIABLE_NAMES = {
    "u": "displacement", "v": "velocity", "d": "compression", "a": "table acceleration",
    "t": "time", "y": "table displacement",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class RangeExit:
    """First sample at which a run leaves the range in which a law was fitted, SI."""

    effect: str
    variable: str
    sample: int
    value: float
    low: float
    high: float

    def __str__(self) -> str:
        name = VARIABLE_NAMES[self.variable]
        return (
            f"the law {self.effect!r} is not known here: {name} {self.value:.3g}, fitted from "
            f"{self.low:.3g} to {self.high:.3g} (SI); its forces are a guess"
        )


def list_ranges(model: Model) -> tuple[tuple[str, str, float, float], ...]:
    """Return (effect, variable, low, high) of each range of the laws of effect files."""
    return tuple(
        (instance.effect.id, *limits)
        for instance in model.present_effects
        if isinstance(instance.effect, WrittenEffect)
        for limits in instance.effect.valid_range
    )


def find_range_exits(model: Model, motion: Mapping[str, Float1D]) -> Iterator[RangeExit]:
    """Yield the first exit of each range; `motion` (sample,) has u, v, t and what was measured."""
    for effect, variable, low, high in list_ranges(model):
        if variable != "d" and variable not in motion:
            continue
        if variable == "d":
            p = model.parameters
            values = np.maximum(motion["u"] - p.gap_r, -motion["u"] - p.gap_l)
        else:
            values = motion[variable]
        margin = RANGE_MARGIN * (high - low)
        # A bumper that is not touched has no compression.
        outside = values > high + margin
        if variable != "d":
            outside |= values < low - margin
        if outside.any():
            sample = int(outside.argmax())
            yield RangeExit(effect, variable, sample, float(values[sample]), low, high)
