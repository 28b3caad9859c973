"""The model card: the base and the effects of a TOML file, validated."""

from typing import Any

from pydantic import Field, field_validator, model_validator

from table_io.card import BadInput, Card, Finite, NonNegative, Positive
from table_io.profile import Specimen
from twin.model.effects import find_effect
from twin.model.effects.effect import Effect
from twin.model.model import Active, Model
from twin.model.parameters import Parameters


class Base(Card):
    """The linear springs and dashpots; both bumpers alike. No bumper damping: no bumper memory."""

    stiffness_n_m: Positive
    damping_n_s_m: NonNegative
    bumper_stiffness_n_m: Positive
    bumper_damping_n_s_m: NonNegative


class EffectEntry(Card):
    """One [[effects]] of a model card: an id, a value for each parameter in SI, and the channel.

    The effects of sensors name the channel beside their numbers: `channel = "mass_acc_m_s2"`.
    """

    id: str
    parameters: dict[str, float | str] = Field(default_factory=dict)

    @field_validator("parameters", mode="before")
    @classmethod
    def _numbers(cls, given: Any) -> Any:
        if isinstance(given, dict):
            for name, value in given.items():
                fine = isinstance(value, str) if name == "channel" else _is_number(value)
                if not fine:
                    allowed = "the name of a channel" if name == "channel" else "a finite number"
                    raise BadInput(f"{name} = {value!r}; allowed: {allowed}")
        return given

    @model_validator(mode="after")
    def _known(self) -> "EffectEntry":
        self.active  # noqa: B018
        return self

    @property
    def effect(self) -> Effect:
        return find_effect(self.id)

    @property
    def active(self) -> Active:
        """The effect with its values."""
        values = {name: float(one) for name, one in self.parameters.items() if name != "channel"}
        return Active.of(self.effect, values, str(self.parameters.get("channel", "")))


def _is_number(value: Any) -> bool:
    return (
        isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < float("inf")
    )


class ModelCard(Card):
    """A model from models/*.toml: the base and the effects that stand on it."""

    title: str
    citation: str = ""
    fitted_on: str = ""
    intervals: dict[str, tuple[Finite, Finite]] = Field(
        default={}, description="95 %, of what was fitted; no calculation reads them."
    )
    base: Base
    effects: tuple[EffectEntry, ...] = ()

    @model_validator(mode="after")
    def _once(self) -> "ModelCard":
        names = [entry.active.name for entry in self.effects]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise BadInput(f"effects name {', '.join(twice)} more than once; keep one of each")
        return self

    def model(self, specimen: Specimen) -> Model:
        """The model of this specimen: its mass and gaps, this card's base and effects."""
        base = self.base
        stiffness, damping = base.bumper_stiffness_n_m, base.bumper_damping_n_s_m
        bumpers = (stiffness, damping, stiffness, damping)
        parameters = Parameters(
            specimen.mass_kg, base.stiffness_n_m, base.damping_n_s_m, *bumpers, *specimen.gaps_m
        )
        return Model(parameters, tuple(entry.active for entry in self.effects))

    def parameters(self, specimen: Specimen) -> Parameters:
        """The model as plain `Parameters`; BadInput where it is more than that."""
        model = self.model(specimen)
        others = [one.name for one in model.present if one.effect.acts != "parameters"]
        if others:
            raise BadInput(
                f"model {self.title!r} has {', '.join(others)}; allowed here: effects that only "
                "change parameters; use a model without them"
            )
        return model.parameters
