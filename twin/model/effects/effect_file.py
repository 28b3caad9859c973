"""Effect files: a force law that is not in the library, as TOML, without code.

    id = "softening_spring"
    place = "damper"
    force = "-k * u * abs(u) / (1 + abs(u) / w)"
    [parameters]
    k = { unit = "N/m2", low = 0.0, high = 1e9, vanishing = 0.0, typical = 1e6 }
    w = { unit = "m", low = 1e-4, high = 1.0, typical = 1e-2 }
    [range]
    u = [-0.006, 0.006]

A model file names it (`file = "softening_spring.toml"` in its [[effects]] entry) or holds it (as
[effects.law]). The expressions follow the grammar of `expression`; units are checked.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from table_io.config.base import ConfigModel, Finite, parse_toml
from table_io.config.toml_text import format_toml
from table_io.errors import InputError
from twin.model.effects import EFFECTS
from twin.model.effects.effect import Effect, EffectParameter
from twin.model.effects.expression import (
    Expression,
    build_function,
    format_dimension,
    parse_expression,
    parse_unit,
)
from twin.model.effects.law import LAW_ARGUMENTS, find_law_problem

LawPlace = Literal["damper", "bumpers", "right_bumper", "left_bumper", "input"]
# Variables of a law by place, with unit: deformation and its rate; of the input that of the table.
DAMPER_VARIABLES = {"u": "m", "v": "m/s", "a": "m/s2", "t": "s"}
BUMPER_VARIABLES = {"d": "m", "v": "m/s", "a": "m/s2", "t": "s"}
INPUT_VARIABLES = {"y": "m"}
MAX_STATES, MAX_PARAMETERS = 6, 16  # as many as the laws of a model may have together
MAX_JUMP_SHARE = 1e-9  # of the largest force: rounding
LEAST_SPEED_M_S = 1e-300  # on either side of a reversal
Points = dict[str, Any]
PROBE_SHARES = (-1.0, -0.3, 0.0, 0.3, 1.0)  # of the range, where a law must be finite
DEFAULT_RANGE = {"u": 0.03, "d": 0.003, "v": 0.3, "a": 5.0, "y": 0.03}  # SI
DEFAULT_DURATION_S = 600.0


def list_variables(place: str) -> Mapping[str, str]:
    """Return the variables of a law at a place, each with its unit."""
    if place == "input":
        return INPUT_VARIABLES
    return DAMPER_VARIABLES if place == "damper" else BUMPER_VARIABLES


@dataclass(frozen=True, slots=True)
class WrittenEffect(Effect):
    """An effect of an effect file: `source` is its text, `valid_range` where it was fitted.

    Variables of `valid_range` are those of `list_variables`.
    """

    source: str = ""

    @property
    def law(self) -> "EffectFile":
        """The effect file."""
        return _read_law(self.source)

    @property
    def expression(self) -> Expression:
        """The expression of the force."""
        return _read_force(self.source)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle as text: functions that were built from it have no importable name."""
        return build_written_effect, (self.source,)


class LawParameter(ConfigModel):
    """A parameter of a law, in SI."""

    unit: str = Field(description='Unit, such as "N s2/m2"; "" for a pure number.')
    low: Finite = Field(description="Least allowed value.")
    high: Finite = Field(description="Largest allowed value.")
    vanishing: Finite | None = Field(
        None, description="Value at which the effect is absent; omitted for a shape."
    )
    typical: Finite = Field(description="Value with a clear effect; a fit starts near it.")
    meaning: str = Field("", description="What it is, in words.")

    @field_validator("unit")
    @classmethod
    def _check_unit(cls, unit: str) -> str:
        parse_unit(unit)
        return unit

    @model_validator(mode="after")
    def _check_order(self) -> "LawParameter":
        for key, value in (("typical", self.typical), ("vanishing", self.vanishing)):
            if value is not None and not self.low <= value <= self.high:
                raise InputError(
                    "not between low and high", key=key, value=value,
                    allowed=f"{self.low:g} to {self.high:g}",
                )  # fmt: skip
        return self


class LawState(ConfigModel):
    """An internal state of a law, zero when relaxed."""

    unit: str = Field(description="Unit of the state.")
    rate: str = Field(description="Expression of its rate of change per second.")

    @field_validator("unit")
    @classmethod
    def _check_unit(cls, unit: str) -> str:
        parse_unit(unit)
        return unit


class EffectFile(ConfigModel):
    """A force law of an effect file. Variables: u, v of the damper; d, v of a bumper; a, t; y."""

    id: str = Field(description="Name of the effect.", pattern="^[a-z][a-z0-9_]{0,60}$")
    title: str = Field("", description="The effect in words.")
    place: LawPlace = Field("damper", description="Where the force acts; input: on the table.")
    force: str = Field(
        description="Force in N; in a bumper the push. With place input: an acceleration in m/s2, "
        "added to that of the table."
    )
    parameters: dict[str, LawParameter] = Field(
        description="Parameters by name.", max_length=MAX_PARAMETERS
    )
    states: dict[str, LawState] = Field(
        {}, description="Internal states by name.", max_length=MAX_STATES
    )
    range: dict[str, tuple[Finite, Finite]] = Field(
        {}, description="Measured range of each variable; outside it the law is not known."
    )
    residual: str = Field("", description="What its absence leaves in the residual.")
    nearest: str = Field("", description="Effect of the library that fits nearly as well.")
    dissipates: bool = Field(False, description="Whether it must never feed energy in.")
    citation: str = Field("", description="Source or recordings.")

    @field_validator("range")
    @classmethod
    def _check_range(cls, valid_range: dict[str, tuple[float, float]]) -> Any:
        for name, (low, high) in valid_range.items():
            if not low < high:
                raise InputError("not a range", key=name, value=[low, high], allowed="low < high")
        return valid_range

    @model_validator(mode="after")
    def _check_law(self) -> "EffectFile":
        if any(effect.id == self.id for effect in EFFECTS):
            raise InputError("an effect of the library", key="id", value=self.id, remedy="rename")
        variables = list_variables(self.place)
        named = [*variables, *self.states, *self.parameters]
        repeated = sorted({name for name in named if named.count(name) > 1})
        if repeated:
            raise InputError("a name with two meanings", key=repeated[0], remedy="rename it")
        if unknown := sorted(self.range.keys() - variables.keys()):
            raise InputError(
                "not a variable of this law", key=f"range.{unknown[0]}",
                allowed=", ".join(variables),
            )  # fmt: skip
        if not any(parameter.vanishing is not None for parameter in self.parameters.values()):
            raise InputError(
                "no parameter makes the law vanish", key="parameters",
                remedy="give the amplitude `vanishing = 0.0`",
            )  # fmt: skip
        if self.place == "input" and self.states:
            raise InputError("a law on the input has no states", key="states", remedy="remove them")
        self._check_dimension("force", self.parsed_force, "m/s2" if self.place == "input" else "N")
        for name, rate in self.parsed_rates.items():
            unit = self.states[name].unit
            per_second = f"{unit} s" if "/" in unit else f"{unit or '1'}/s"
            self._check_dimension(f"states.{name}.rate", rate, per_second)
        self._check_values()
        return self

    @property
    def parsed_force(self) -> Expression:
        """The expression of the force."""
        return self._parse("force", self.force)

    @property
    def parsed_rates(self) -> dict[str, Expression]:
        """The expressions of the rates of the states."""
        return {
            name: self._parse(f"states.{name}.rate", state.rate)
            for name, state in self.states.items()
        }

    def _parse(self, key: str, text: str) -> Expression:
        try:
            return parse_expression(text, [*self.units])
        except InputError as error:
            raise error.replace(key=key) from None

    @property
    def units(self) -> dict[str, str]:
        """Units of all names of the law."""
        return {
            **list_variables(self.place),
            **{name: state.unit for name, state in self.states.items()},
            **{name: parameter.unit for name, parameter in self.parameters.items()},
        }

    def _check_dimension(self, key: str, expression: Expression, unit: str) -> None:
        try:
            dimension = expression.find_dimension(self.units)
        except InputError as error:
            raise error.replace(key=key) from None
        if dimension != parse_unit(unit):
            raise InputError(
                f"its unit is {format_dimension(dimension) or 'a pure number'}",
                key=key, value=expression.text, allowed=format_dimension(parse_unit(unit)),
                remedy="correct the expression or the units of its parameters",
            )  # fmt: skip

    def _check_values(self) -> None:
        """Raise InputError where the law is not finite, jumps, does not vanish, or feeds energy."""
        ranges = {name: (-size, size) for name, size in DEFAULT_RANGE.items()}
        ranges |= {"t": (0.0, DEFAULT_DURATION_S), **self.range}
        names = [*list_variables(self.place)]
        grids = [
            [0.5 * (low + high) + 0.5 * (high - low) * share for share in PROBE_SHARES]
            for low, high in (ranges[name] for name in names)
        ]
        points: Points = dict(zip(names, map(np.ravel, np.meshgrid(*grids)), strict=True))
        typical = {name: parameter.typical for name, parameter in self.parameters.items()}
        given: Points = {**points, **typical, **dict.fromkeys(self.states, 0.0)}
        for key, expression in (
            ("force", self.parsed_force),
            *((f"states.{name}.rate", rate) for name, rate in self.parsed_rates.items()),
        ):
            finite = np.isfinite(expression.evaluate(given))
            if not finite.all():
                index = int(np.argmin(finite))
                where = ", ".join(f"{name} = {points[name][index]:g}" for name in names)
                raise InputError(
                    f"not finite at {where}", key=key, value=expression.text,
                    remedy="divide by no variable, and give sqrt and log positive arguments",
                )  # fmt: skip
        self._check_vanishing(given)
        if "v" in points:
            self._check_rates(given)

    def _check_vanishing(self, given: Points) -> None:
        """Raise InputError unless the law vanishes with its amplitudes."""
        absent = given | {
            name: parameter.vanishing
            for name, parameter in self.parameters.items()
            if parameter.vanishing is not None
        }
        force, rates = self.parsed_force, self.parsed_rates.values()
        remains = bool(np.any(force.evaluate(absent)))
        if not remains and np.any(force.evaluate(absent | dict.fromkeys(self.states, 1.0))):
            # the states still have an effect, but they may never leave zero
            remains = any(np.any(rate.evaluate(absent)) for rate in rates)
        if remains:
            raise InputError(
                "does not vanish with its parameters", key="force", value=self.force,
                remedy="multiply all of it by parameters with a vanishing value",
            )  # fmt: skip

    def _check_rates(self, given: Points) -> None:
        """Raise InputError if the force jumps at a reversal, or feeds energy though it dissipates.

        No law of a file sticks: it would switch for ever.
        """
        forward, back, still, moving = (
            self.parsed_force.evaluate(given | {"v": v})
            for v in (LEAST_SPEED_M_S, -LEAST_SPEED_M_S, 0.0, given["v"])
        )
        if np.any(np.abs(forward - back) > MAX_JUMP_SHARE * np.abs(moving).max()):
            raise InputError(
                "jumps where the velocity changes its sign", key="force", value=self.force,
                remedy="write tanh(v / s) with a small speed s, or add coulomb_friction",
            )  # fmt: skip
        power = (moving - still) * given["v"]
        if self.dissipates and np.any(power < -MAX_JUMP_SHARE * np.abs(moving * given["v"])):
            raise InputError(
                "feeds energy in, though it dissipates", key="dissipates", value=True,
                remedy="change the sign, or set dissipates = false",
            )  # fmt: skip

    def format_text(self) -> str:
        """Return the text of the file."""
        return format_toml(self.model_dump(exclude_defaults=True, exclude_none=True))

    def build_effect(self) -> WrittenEffect:
        """Return the effect; the same object for the same law."""
        return build_written_effect(self.format_text())


@lru_cache(maxsize=256)
def _read_law(source: str) -> EffectFile:
    return parse_toml(source, EffectFile, "effect file")


@lru_cache(maxsize=256)
def _read_force(source: str) -> Expression:
    return _read_law(source).parsed_force


@lru_cache(maxsize=256)
def build_written_effect(source: str) -> WrittenEffect:
    """Return the effect of an effect file's text; InputError says what is wrong with it.

    Cached: a compiled law is known by its effect, and a fit looks its effects up again and again.
    """
    law = _read_law(source)
    parameters = tuple(
        EffectParameter(
            name, parameter.unit, parameter.low, parameter.high, parameter.vanishing,
            parameter.typical, parameter.meaning,
        )
        for name, parameter in law.parameters.items()
    )  # fmt: skip
    functions: dict[str, Any] = {}
    if law.place == "input":
        acceleration = law.parsed_force

        def input_acceleration(table_disp: Any, values: Mapping[str, float]) -> Any:
            return acceleration.evaluate({**values, "y": table_disp})

        functions["input_acceleration"] = input_acceleration
    else:
        functions |= _build_law_functions(law)
    effect = WrittenEffect(
        id=law.id, term=law.force, parameters=parameters,
        acts="input" if law.place == "input" else "force",
        residual=law.residual, confused_with=(law.nearest,) if law.nearest else (),
        place=law.place, states=tuple(law.states), source=source,
        valid_range=tuple((name, low, high) for name, (low, high) in law.range.items()),
        **functions,
    )  # fmt: skip
    if law.place != "input" and (problem := find_law_problem(effect)):
        raise InputError(problem, where=f"effect {law.id!r}", key="force", value=law.force)
    return effect


def _build_law_functions(law: EffectFile) -> dict[str, Any]:
    """Return force and rates of a law as functions of plain Python, as `Effect` has them."""
    names = {"u": "q", "d": "q", "v": "w", "a": "a", "t": "t"}
    places = {name: ("c", index) for index, name in enumerate(law.parameters)}
    places |= {name: ("s", index) for index, name in enumerate(law.states)}

    def build(name: str, *expressions: Expression) -> Any:
        used = frozenset.union(*(expression.names for expression in expressions))
        arguments = {"q", *(names[variable] for variable in used & names.keys())}
        arguments |= {"s"} if law.states else set()
        ordered = [argument for argument in LAW_ARGUMENTS if argument in arguments | {"c"}]
        result = expressions if name == "rates" else expressions[0]
        return build_function(name, ordered, result, places, names)

    functions = {"force": build("force", law.parsed_force)}
    if law.states:
        functions["rates"] = build("rates", *law.parsed_rates.values())
    return functions
