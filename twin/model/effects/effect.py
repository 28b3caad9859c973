"""What every effect says of itself: its term, its parameters, what its absence looks like."""

import difflib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from table_io.card import BadInput

if TYPE_CHECKING:
    from twin.model.parameters import Parameters

# Where an effect acts, and so how the model with it is solved:
#   parameters  other `Parameters`; closed form
#   input       on the acceleration that drives the mass; closed form
#   linear      one more linear state, or gaps that move; exact linear propagation
#   force       a force law of any shape; integrated
#   sensor      on a predicted channel; the motion stays as it is
Acts = Literal["parameters", "input", "linear", "force", "sensor"]


@dataclass(frozen=True, slots=True)
class EffectParameter:
    """One number of an effect in SI, low <= value <= high.

    At `vanishing` the effect is absent; None: this one shapes the effect and cannot make it vanish.
    `typical` shows clearly on this rig: a start for fits and tests.
    """

    name: str
    unit: str
    low: float
    high: float
    vanishing: float | None
    typical: float
    meaning: str


@dataclass(frozen=True, slots=True)
class Effect:
    """A physical effect. `change` is that of `parameters`, `force` that of a plug-in's `force`.

    `force(u, v, c)` in N stands on the left side of the equation of motion, u in m, v in m/s, and
    c[i] is the value of parameters[i]. It is plain Python that numba can compile, without memory,
    smooth where v keeps its sign. The force laws of this package are compiled into the solver and
    leave it None.
    """

    id: str
    term: str
    parameters: tuple[EffectParameter, ...]
    acts: Acts
    residual: str  # what its absence leaves in measurement minus model
    confused_with: tuple[str, ...]
    change: "Callable[[Parameters, Mapping[str, float]], Parameters] | None" = None
    force: Callable[..., float] | None = None

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

    def absent(self, values: Mapping[str, float]) -> bool:
        """True where every parameter that can make the effect vanish does."""
        return all(
            values[parameter.name] == parameter.vanishing
            for parameter in self.parameters
            if parameter.vanishing is not None
        )

    def apply(self, parameters: "Parameters", values: Mapping[str, float]) -> "Parameters":
        """`parameters` with this effect; the very same where it is absent or acts elsewhere."""
        self.check(values)
        if self.change is None or self.absent(values):
            return parameters
        return self.change(parameters, values)
