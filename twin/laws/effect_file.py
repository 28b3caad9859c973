"""Effect files: an effect that is not in the library, as TOML, without code.

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

from typing import Literal

from pydantic import Field, model_validator

from table_io.config.base import ConfigModel, Finite, format_toml
from twin.laws.checks import ID_PATTERN
from twin.laws.effect import Effect, EffectParameter, State
from twin.laws.library import check_new_effect
from twin.laws.properties import MAX_CONSTANTS, MAX_STATES

LawPlace = Literal["damper", "bumpers", "right_bumper", "left_bumper", "input"]


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


class LawState(ConfigModel):
    """An internal state of a law, zero when relaxed."""

    unit: str = Field(description="Unit of the state.")
    rate: str = Field(description="Expression of its rate of change per second.")


class EffectFile(ConfigModel):
    """A force law of an effect file. Variables: u, v of the damper; d, v of a bumper; a, t; y."""

    id: str = Field(description="Name of the effect.", pattern=ID_PATTERN)
    title: str = Field("", description="The effect in words.")
    place: LawPlace = Field("damper", description="Where the force acts; input: on the table.")
    force: str = Field(
        description="Force in N; in a bumper the push. With place input: an acceleration in m/s2, "
        "added to that of the table."
    )
    parameters: dict[str, LawParameter] = Field(
        description="Parameters by name.", max_length=MAX_CONSTANTS
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

    @model_validator(mode="after")
    def _check_law(self) -> "EffectFile":
        check_new_effect(self.build_effect())
        return self

    def build_effect(self) -> Effect:
        """Return the effect."""
        return Effect(
            id=self.id,
            title=self.title,
            place=self.place,
            term=self.force,
            force=self.force,
            parameters=tuple(
                EffectParameter(name, **dict(parameter))
                for name, parameter in self.parameters.items()
            ),
            states={name: State(**dict(state)) for name, state in self.states.items()},
            valid_range=tuple((name, low, high) for name, (low, high) in self.range.items()),
            residual=self.residual,
            confused_with=(self.nearest,) if self.nearest else (),
            dissipates=self.dissipates,
            citation=self.citation,
            is_of_file=True,
        )


def format_effect_file(effect: Effect) -> str:
    """Return the text of an effect file."""
    table = {
        "id": effect.id,
        "title": effect.title,
        "place": effect.place,
        "force": effect.force,
        "parameters": {
            own.name: {key: getattr(own, key) for key in LawParameter.model_fields}
            for own in effect.parameters
        },
        "states": {
            name: {"unit": state.unit, "rate": state.rate} for name, state in effect.states.items()
        },
        "range": {name: (low, high) for name, low, high in effect.valid_range},
        "residual": effect.residual,
        "nearest": effect.confused_with[0] if effect.confused_with else "",
        "dissipates": effect.dissipates,
        "citation": effect.citation,
    }
    file = EffectFile.model_validate(table)
    return format_toml(file.model_dump(exclude_defaults=True, exclude_none=True))
