"""A physical effect as data: place, parameters with units and bounds, force and rates as text.

The one notation of a law. The library, plug-ins, effect files and the terms of a law search are
all written in it; solver kernels, fits, pages and the guide are derived from it.

Expressions follow the grammar of `expression`. By place they may use
    damper    u, v    displacement and velocity of the mass relative to the table; the force is on
                      the left side of the equation of motion
    bumpers   d, v    compression and its rate, and the force pushes; the same law in both bumpers,
                      or in one: right_bumper, left_bumper
    both      a, t    acceleration of the table as the mass feels it; time since sample 0 of the
                      run: a law with it has no steady state
    input     y       table displacement; an acceleration added to that of the table
and the names of states, constants and parameters. A law is continuous, apart from `break_away`, and
smooth where v keeps its sign. In a bumper the force is zero where d, v and the states are; if it is
not linear in v, it opposes v.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, Literal

from table_io.errors import InputError, suggest
from table_io.units import GRAVITY_M_S2
from twin.laws.expression import Expression, parse_expression

# Where an effect acts, which decides how the model is solved:
#   parameters  changed base parameters; closed form
#   input       on the acceleration that drives the mass; closed form
#   linear      an additional linear state, or moving gaps; exact linear propagation
#   force       a force law of any shape; integrated
#   sensor      on a predicted channel; the motion is unchanged
Acts = Literal["parameters", "input", "linear", "force", "sensor"]
Place = Literal["damper", "bumpers", "right_bumper", "left_bumper", "input", "mass", "sensor"]
DAMPER = -1  # a bumper has the number of its side: 0 right, 1 left
PLACES = {"damper": (DAMPER,), "bumpers": (0, 1), "right_bumper": (0,), "left_bumper": (1,)}
DAMPER_VARIABLES = {"u": "m", "v": "m/s", "a": "m/s2", "t": "s"}
BUMPER_VARIABLES = {"d": "m", "v": "m/s", "a": "m/s2", "t": "s"}
INPUT_VARIABLES = {"y": "m"}
# Names that `constants`, `changes` and thresholds may use: base parameters with unit and a usual
# value, at which laws are checked, and natural constants.
BASE_PARAMETERS = {
    "mass": ("kg", 1e3), "stiffness": ("N/m", 1e5), "damping": ("N s/m", 1e3),
    "bumper_stiffness_r": ("N/m", 1e6), "bumper_damping_r": ("N s/m", 1e3),
    "bumper_stiffness_l": ("N/m", 1e6), "bumper_damping_l": ("N s/m", 1e3),
    "gap_r": ("m", 1e-3), "gap_l": ("m", 1e-3),
}  # fmt: skip
NATURAL_CONSTANTS = {"pi": ("", math.pi), "g": ("m/s2", GRAVITY_M_S2)}
USUAL_BASE = {name: value for name, (_, value) in BASE_PARAMETERS.items()}


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
    meaning: str = ""


@dataclass(frozen=True, slots=True)
class State:
    """Internal state of a law, zero when relaxed: its unit, and its rate per second."""

    unit: str
    rate: str


@dataclass(frozen=True, slots=True)
class Effect:
    """A physical effect: all that solver, identification and discovery know of it.

    `force` is the law in N; at place "input" an acceleration in m/s2. `constants` are abbreviations
    of the law, worked out once from parameters, base parameters and earlier constants. `changes`
    gives base parameters new values. An effect on a sensor has parameters alone.

    Dry friction adds `break_away` sign(v), in N, to `force`, and sticks up to it. `pull_off` is the
    tension in N at which a contact ends, `gap_rate` the speed in m/s at which both gaps open.

    `compiled` names the coefficients of the solver's own form of the whole law, which is faster or
    exact; a test holds it against the expressions. Everything else is for a reader and for fits.
    """

    id: str
    parameters: tuple[EffectParameter, ...]
    term: str = ""  # the law for a reader
    place: Place = "damper"
    force: str = ""
    states: Mapping[str, State] = field(default_factory=dict, hash=False)
    constants: Mapping[str, str] = field(default_factory=dict, hash=False)
    changes: Mapping[str, str] = field(default_factory=dict, hash=False)
    break_away: str = ""
    pull_off: str = ""
    gap_rate: str = ""
    compiled: Mapping[str, str] = field(default_factory=dict, hash=False)
    is_linear: bool = False  # in motion and states; the solver propagates it exactly
    dissipates: bool = False  # must never feed energy in
    title: str = ""
    description: str = ""  # what it is, its equations and its source; by default `title`
    residual: str = ""  # signature in measurement minus a model without the effect
    confused_with: tuple[str, ...] = ()
    limits: tuple[str, ...] = ()  # effects that it becomes for extreme shapes
    required_channels: tuple[str, ...] = ()  # without which it is not observable
    valid_range: tuple[tuple[str, float, float], ...] = ()  # (variable, low, high) of its fit, SI
    citation: str = ""
    is_of_file: bool = False  # of an effect file, not of the library or a plug-in

    @property
    def acts(self) -> Acts:
        """Where the effect acts."""
        if self.place == "sensor":
            return "sensor"
        if self.changes:
            return "parameters"
        if self.place == "input":
            return "input"
        return "linear" if self.is_linear else "force"

    @property
    def is_in_bumpers(self) -> bool:
        """Return whether only a test with contact shows it."""
        return self.place in ("bumpers", "right_bumper", "left_bumper")

    @property
    def is_added_law(self) -> bool:
        """Return whether `force` is compiled as it stands: the solver has no form of its own."""
        return bool(self.force) and not self.compiled and self.place in PLACES

    @property
    def is_dry_friction(self) -> bool:
        """Return whether it sticks; fits replace its jump at v = 0 by a steep slope."""
        return bool(self.break_away)

    @property
    def is_threshold(self) -> bool:
        """Return whether its amplitude is a threshold: no slope where it vanishes."""
        return bool(self.pull_off)

    @property
    def has_resonance(self) -> bool:
        """Return whether it has a frequency of its own, which a fit must find."""
        return any(parameter.unit == "Hz" for parameter in self.parameters)

    @property
    def changes_with_time(self) -> bool:
        """Return whether it depends on the time since the start of the run."""
        return bool(self.gap_rate) or "t" in self.used_names

    @property
    def summary(self) -> str:
        """The effect in a few words of physics."""
        text = self.description.replace("\n", " ") or self.term
        return re.split(r"[:,.]", text, maxsplit=1)[0]

    @property
    def variables(self) -> Mapping[str, str]:
        """Variables of the law, each with its unit."""
        return list_variables(self.place)

    @property
    def typical_values(self) -> dict[str, float]:
        """The typical value of each parameter."""
        return {parameter.name: parameter.typical for parameter in self.parameters}

    def parameter(self, name: str) -> EffectParameter:
        """Return a parameter by its name."""
        return next(own for own in self.parameters if own.name == name)

    @property
    def parsed_force(self) -> Expression:
        """The expression of the force."""
        return self._parse(self.force, "force")

    @property
    def parsed_rates(self) -> dict[str, Expression]:
        """The expressions of the rates of the states."""
        return {
            name: self._parse(state.rate, f"states.{name}.rate")
            for name, state in self.states.items()
        }

    def _parse(self, text: str, key: str) -> Expression:
        names = (*self.variables, *self.states, *self.constants, *self._parameter_names)
        return _parse(text, names, key)

    @property
    def _parameter_names(self) -> tuple[str, ...]:
        return tuple(parameter.name for parameter in self.parameters)

    @property
    def used_names(self) -> frozenset[str]:
        """Names that force and rates use."""
        force = [self.parsed_force] if self.force else []
        return frozenset().union(*(part.names for part in (*force, *self.parsed_rates.values())))

    @property
    def constant_names(self) -> tuple[str, ...]:
        """Names of the numbers in the law, in the order of `list_constants`."""
        used = self.used_names
        return tuple(name for name in (*self.constants, *self._parameter_names) if name in used)

    def list_constants(
        self, base: Mapping[str, float], values: Mapping[str, float]
    ) -> tuple[float, ...]:
        """Return the numbers in the law, in the order of `constant_names`."""
        known = self.work_out_constants(base, values)
        return tuple(known[name] for name in self.constant_names)

    def work_out_constants(
        self, base: Mapping[str, float], values: Mapping[str, float]
    ) -> dict[str, float]:
        """Return the parameters and the constants by name."""
        known = dict(values)
        for name, text in self.constants.items():
            known[name] = self._work_out(text, base, known)
        return known

    def _work_out(self, text: str, base: Mapping[str, float], known: Mapping[str, float]) -> float:
        """Return the value of an expression without variables."""
        natural = {name: value for name, (_, value) in NATURAL_CONSTANTS.items()}
        given = natural | dict(base) | dict(known)
        return float(_parse(text, tuple(given), "").evaluate(given))

    def work_out_coefficients(
        self, base: Mapping[str, float], values: Mapping[str, float]
    ) -> dict[str, float]:
        """Return what the solver knows of the effect by its coefficients, by name."""
        texts = {"fc": self.break_away, "pull": self.pull_off, "drift": self.gap_rate}
        known = self.work_out_constants(base, values)
        return {
            name: self._work_out(text, base, known)
            for name, text in {**texts, **self.compiled}.items()
            if text
        }

    def change_base(
        self, base: Mapping[str, float], values: Mapping[str, float]
    ) -> dict[str, float]:
        """Return new values of the base parameters that the effect changes; none if absent."""
        if self.is_absent(values):
            return {}
        known = {**base, **self.work_out_constants(base, values)}
        return {name: self._work_out(text, base, known) for name, text in self.changes.items()}

    def evaluate_force(self, values: Mapping[str, float], inputs: Mapping[str, Any]) -> Any:
        """Return the force for numbers or arrays of the variables and states; m/s2 on the input."""
        return self.parsed_force.evaluate({**self.work_out_constants({}, values), **inputs})

    def validate(self, values: Mapping[str, float]) -> None:
        """Raise InputError unless `values` has each parameter, nothing else, within its bounds."""
        where = f"effect {self.id!r}"
        for name in values:
            if name not in self._parameter_names:
                raise InputError(
                    "unknown parameter", where=where, key=name,
                    remedy=suggest(name, self._parameter_names),
                )  # fmt: skip
        for parameter in self.parameters:
            name = parameter.name
            allowed = f"{parameter.low:g} to {parameter.high:g} {parameter.unit}".rstrip()
            if name not in values:
                raise InputError("missing", where=where, key=name, allowed=allowed, remedy="add it")
            if not parameter.low <= values[name] <= parameter.high:
                raise InputError(
                    "out of range", where=where, key=name, value=float(values[name]),
                    allowed=allowed,
                )  # fmt: skip

    def is_absent(self, values: Mapping[str, float]) -> bool:
        """Return whether every parameter with a vanishing value has that value."""
        return all(
            values[parameter.name] == parameter.vanishing
            for parameter in self.parameters
            if parameter.vanishing is not None
        )


def list_variables(place: str) -> Mapping[str, str]:
    """Return the variables of a law at a place, each with its unit."""
    if place == "input":
        return INPUT_VARIABLES
    if place not in PLACES:
        return {}
    return DAMPER_VARIABLES if place == "damper" else BUMPER_VARIABLES


@lru_cache(maxsize=4096)
def _parse(text: str, names: tuple[str, ...], key: str) -> Expression:
    try:
        return parse_expression(text, names)
    except InputError as error:
        raise error.replace(key=key) from None
