"""What every effect says of itself: its term, its parameters, what its absence looks like."""

import difflib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from table_io.profile import BadInput

if TYPE_CHECKING:
    from twin.model.parameters import Parameters


@dataclass(frozen=True, slots=True)
class EffectParameter:
    """One number of an effect in SI, low <= value <= high; at `vanishing` the effect is absent."""

    name: str
    unit: str
    low: float
    high: float
    vanishing: float
    meaning: str


@dataclass(frozen=True, slots=True)
class Effect:
    """A physical effect that keeps the model piecewise linear: it changes `Parameters` only."""

    id: str
    term: str
    parameters: tuple[EffectParameter, ...]
    change: "Callable[[Parameters, Mapping[str, float]], Parameters]"
    residual: str  # what its absence leaves in measurement minus model
    confused_with: tuple[str, ...]

    def check(self, values: Mapping[str, float]) -> None:
        """BadInput unless `values` holds each parameter, nothing else, within its bounds."""
        known = [parameter.name for parameter in self.parameters]
        for name in values:
            if name not in known:
                near = difflib.get_close_matches(name, known, 1, 0.4) or known
                raise BadInput(
                    f"effect {self.id!r} has no parameter {name!r}; did you mean {near[0]!r}?"
                )
        for parameter in self.parameters:
            name, unit = parameter.name, parameter.unit
            allowed = f"allowed: {parameter.low:g} to {parameter.high:g} {unit}".rstrip()
            if name not in values:
                raise BadInput(f"effect {self.id!r} lacks {name!r}; add it, {allowed}")
            if not parameter.low <= values[name] <= parameter.high:
                raise BadInput(f"effect {self.id!r}: {name} = {values[name]:g}; {allowed}")

    def apply(self, parameters: "Parameters", values: Mapping[str, float]) -> "Parameters":
        """`parameters` with this effect; the very same where every value is the vanishing one."""
        self.check(values)
        if all(values[parameter.name] == parameter.vanishing for parameter in self.parameters):
            return parameters
        return self.change(parameters, values)
