"""Description of a physical effect: its term, its parameters, the residual of its absence."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from table_io.errors import InputError, suggest

if TYPE_CHECKING:
    from twin.model.parameters import Parameters

# Where an effect acts, which decides how the model is solved:
#   parameters  changed `Parameters`; closed form
#   input       on the acceleration that drives the mass; closed form
#   linear      an additional linear state, or moving gaps; exact linear propagation
#   force       a force law of any shape; integrated
#   sensor      on a predicted channel; the motion is unchanged
Acts = Literal["parameters", "input", "linear", "force", "sensor"]
Place = Literal["damper", "bumpers", "right_bumper", "left_bumper", "input", "mass", "sensor"]


@dataclass(frozen=True, slots=True)
class EffectParameter:
    """One parameter of an effect in SI, low <= value <= high.

    The bounds guard model files against slips of the pen, for specimens of any size; where one is
    the vanishing value, the other sign is not physical. Fits have bounds of their own.

    At `vanishing` the effect is absent; None: the parameter only shapes the effect. `typical` has a
    clear effect on this rig: a start value for fits and tests.
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
    """A physical effect: all that solver, identification and discovery know of it.

    An effect brings, by `acts`:

    - parameters: `change(parameters, values)`, the changed parameters.
    - input: `input_acceleration(table_disp, values)` in m/s2, added to the table acceleration as
      the mass feels it; table_disp in m, (n,) or a number.
    - force: a law, `force` in N. A law with memory has `states`, zero when relaxed, and `rates`,
      their d/dt as a tuple of floats. `place` "bumpers" is the same law in both bumpers.

    Both functions take, by these names, those of their arguments that they need:
        q, w  deformation in m and its rate in m/s. At the damper u and u', and the force is on the
              left side of the equation of motion; in a bumper its compression and the rate of it,
              and the force pushes
        a     acceleration in m/s2 of the table, as the mass feels it
        t     time in s since sample 0 of the run; a law with it has no steady state
        s     s[i] is the value of states[i]
        c     `constants(base parameters, values)`, by default the values of the parameters in turn
    so `force(q, w, c)` is a law without memory, and `rates(q, w, a, s, c)` are those of a mass that
    rides along. They are plain Python that numba can compile, continuous, and smooth where w keeps
    its sign. In a bumper the force is zero where q, w and s are; if it is not linear in w, it
    opposes w. Force laws of this package may instead be compiled into the solver: `force` is None.
    """

    id: str
    term: str
    parameters: tuple[EffectParameter, ...]
    acts: Acts
    residual: str  # signature in measurement minus a model without the effect
    confused_with: tuple[str, ...]
    change: "Callable[[Parameters, Mapping[str, float]], Parameters] | None" = None
    force: Callable[..., float] | None = None
    place: Place = "damper"
    states: tuple[str, ...] = ()
    rates: Callable[..., tuple[float, ...]] | None = None
    constants: "Callable[[Parameters, Mapping[str, float]], tuple[float, ...]] | None" = None
    input_acceleration: Callable[[Any, Mapping[str, float]], Any] | None = None
    valid_range: tuple[tuple[str, float, float], ...] = ()  # (variable, low, high) of its fit, SI
    required_channels: tuple[str, ...] = ()  # without which it is not observable
    is_threshold: bool = False  # its amplitude is a threshold: no slope where it vanishes
    is_dry_friction: bool = False  # sticks; fits replace its jump at u' = 0 by a steep slope
    limits: tuple[str, ...] = ()  # effects that it becomes for extreme shapes
    is_drift: bool = False  # changes with time otherwise than by a law that takes t

    @property
    def is_in_bumpers(self) -> bool:
        """Return whether only a test with contact shows it."""
        return self.place in ("bumpers", "right_bumper", "left_bumper")

    def validate(self, values: Mapping[str, float]) -> None:
        """Raise InputError unless `values` has each parameter, nothing else, within its bounds."""
        known = [parameter.name for parameter in self.parameters]
        for name in values:
            if name not in known:
                raise InputError(
                    "unknown parameter",
                    where=f"effect {self.id!r}",
                    key=name,
                    remedy=suggest(name, known),
                )
        for parameter in self.parameters:
            name, unit = parameter.name, parameter.unit
            allowed = f"{parameter.low:g} to {parameter.high:g} {unit}".rstrip()
            if name not in values:
                raise InputError(
                    "missing",
                    where=f"effect {self.id!r}",
                    key=name,
                    allowed=allowed,
                    remedy="add it",
                )
            if not parameter.low <= values[name] <= parameter.high:
                raise InputError(
                    "out of range",
                    where=f"effect {self.id!r}",
                    key=name,
                    value=float(values[name]),
                    allowed=allowed,
                )

    def is_absent(self, values: Mapping[str, float]) -> bool:
        """Return whether every parameter with a vanishing value has that value."""
        return all(
            values[parameter.name] == parameter.vanishing
            for parameter in self.parameters
            if parameter.vanishing is not None
        )

    def apply(self, parameters: "Parameters", values: Mapping[str, float]) -> "Parameters":
        """Return `parameters` with this effect; unchanged if it is absent or acts elsewhere."""
        if self.change is None or self.is_absent(values):
            return parameters
        return self.change(parameters, values)
