"""Where a law was fitted, and where a run leaves that range: outside it the law is not known."""

from collections.abc import Container, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from table_io.block import Float1D
from twin.laws.effect import PLACES, Place
from twin.model.model import EffectInstance, Model
from twin.model.parameters import Parameters

# Of the width of a range: the end of a measured range is itself uncertain by noise.
RANGE_MARGIN = 0.02
RangeKey = tuple[str, str]  # effect and variable
EVENT_KIND = "law_range"  # of an exit in a recording
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

    @property
    def key(self) -> RangeKey:
        """What identifies the range: its effect and variable."""
        return self.effect, self.variable

    def __str__(self) -> str:
        name = VARIABLE_NAMES[self.variable]
        return (
            f"the law {self.effect!r} is not known here: {name} {self.value:.3g}, fitted from "
            f"{self.low:.3g} to {self.high:.3g} (SI); its forces are a guess"
        )


def list_ranges(model: Model) -> tuple[EffectInstance, ...]:
    """Return the effects whose laws are known in a range alone."""
    return tuple(instance for instance in model.present_effects if instance.effect.valid_range)


def list_inputs(
    place: Place, parameters: Parameters, opening_m: Any, motion: Mapping[str, Float1D]
) -> list[dict[str, Float1D]]:
    """Return what enters a law, by variable, (sample,): of the damper, or of each bumper.

    In a bumper d and v are NaN without contact. `motion` has u, v and what else was measured;
    `opening_m` is the drift of the gaps.
    """
    if place not in PLACES or place == "damper":
        return [dict(motion)]
    inputs = []
    for side in PLACES[place]:
        sign, gap = (1.0, parameters.gap_r) if side == 0 else (-1.0, parameters.gap_l)
        depth = sign * motion["u"] - gap - opening_m
        in_contact = depth > 0.0
        inputs.append(
            {
                **motion,
                "d": np.where(in_contact, depth, np.nan),
                "v": np.where(in_contact, sign * motion["v"], np.nan),
            }
        )
    return inputs


def find_range_exits(
    model: Model, motion: Mapping[str, Float1D], reported: Container[RangeKey] = ()
) -> Iterator[RangeExit]:
    """Yield the first exit of each range whose key is not in `reported`.

    `motion` (sample,) has u, v, t and what was measured.
    """
    opening_m = model.gap_opening_m(1.0) * motion["t"]
    for instance in list_ranges(model):
        effect = instance.effect
        sides = list_inputs(effect.place, model.parameters, opening_m, motion)
        for variable, low, high in effect.valid_range:
            if (effect.id, variable) in reported:
                continue
            margin = RANGE_MARGIN * (high - low)
            exits = [
                (int(outside.argmax()), values)
                for values in (inputs[variable] for inputs in sides if variable in inputs)
                if (outside := (values > high + margin) | (values < low - margin)).any()
            ]
            if exits:
                sample, values = min(exits, key=lambda pair: pair[0])
                yield RangeExit(effect.id, variable, sample, float(values[sample]), low, high)


def select_first_exits(exits: Iterable[RangeExit]) -> list[RangeExit]:
    """Return the first exit of each range, in order."""
    first: dict[RangeKey, RangeExit] = {}
    for range_exit in exits:
        first.setdefault(range_exit.key, range_exit)
    return [*first.values()]
