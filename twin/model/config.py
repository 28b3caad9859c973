"""Model files: validated base parameters and effects from TOML."""

from typing import Any

from pydantic import Field, field_validator, model_validator

from table_io.config.base import ConfigModel, Finite, NonNegative, Positive, list_duplicates
from table_io.config.profile import Specimen
from table_io.errors import InputError
from twin.model.effects import find_effect
from twin.model.effects.effect import Effect
from twin.model.model import EffectInstance, Model
from twin.model.parameters import Parameters


class BaseModelConfig(ConfigModel):
    """Linear springs and dashpots, both bumpers alike; without bumper damping, no bumper memory."""

    stiffness_n_m: Positive = Field(description="Stiffness K of the damper.")
    damping_n_s_m: NonNegative = Field(description="Damping C of the damper.")
    bumper_stiffness_n_m: Positive = Field(description="Stiffness of each bumper.")
    bumper_damping_n_s_m: NonNegative = Field(description="Damping of each bumper.")


class EffectConfig(ConfigModel):
    """One [[effects]] table of a model file: an effect id and a value in SI for each parameter.

    Sensor effects name their channel among the parameters: `channel = "mass_acc_m_s2"`.
    """

    id: str = Field(description="Name of the effect, built in or of a plug-in.")
    parameters: dict[str, float | str] = Field(
        default_factory=dict, description="A value in SI for each parameter of the effect."
    )

    @field_validator("parameters", mode="before")
    @classmethod
    def _validate_values(cls, values: Any) -> Any:
        if isinstance(values, dict):
            for name, value in values.items():
                valid = isinstance(value, str) if name == "channel" else _is_number(value)
                if not valid:
                    allowed = "the name of a channel" if name == "channel" else "a finite number"
                    raise InputError("invalid value", key=name, value=value, allowed=allowed)
        return values

    @model_validator(mode="after")
    def _validate_effect(self) -> "EffectConfig":
        self.instance  # noqa: B018
        return self

    @property
    def effect(self) -> Effect:
        return find_effect(self.id)

    @property
    def instance(self) -> EffectInstance:
        """Effect with its values."""
        values = {
            name: float(value) for name, value in self.parameters.items() if name != "channel"
        }
        return EffectInstance.create(self.effect, values, str(self.parameters.get("channel", "")))


def _is_number(value: Any) -> bool:
    return (
        isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < float("inf")
    )


class ModelConfig(ConfigModel):
    """A model from models/*.toml: base parameters and the effects added to them."""

    title: str = Field(description="Title of the model in every report.")
    citation: str = Field("", description="Source of the values.")
    fitted_on: str = Field("", description="Recordings or tests from which the values come.")
    provisional: str = Field(
        "", description="Why the model is not to be trusted yet; a run with it warns."
    )
    intervals: dict[str, tuple[Finite, Finite]] = Field(
        default={}, description="95 % intervals of fitted parameters; no calculation uses them."
    )
    base: BaseModelConfig
    effects: tuple[EffectConfig, ...] = ()

    @model_validator(mode="after")
    def _validate_unique(self) -> "ModelConfig":
        repeated = list_duplicates([entry.instance.name for entry in self.effects])
        if repeated:
            raise InputError(
                f"{', '.join(repeated)} given more than once",
                key="effects",
                remedy="keep one of each",
            )
        return self

    def build_model(self, specimen: Specimen) -> Model:
        """Return the model of a specimen: its mass and gaps, this file's base and effects."""
        base = self.base
        stiffness, damping = base.bumper_stiffness_n_m, base.bumper_damping_n_s_m
        bumpers = (stiffness, damping, stiffness, damping)
        parameters = Parameters(
            specimen.mass_kg, base.stiffness_n_m, base.damping_n_s_m, *bumpers, *specimen.gaps_m
        )
        return Model(parameters, tuple(entry.instance for entry in self.effects))

    def build_parameters(self, specimen: Specimen) -> Parameters:
        """Return the model as plain `Parameters`; InputError if it has any other effects."""
        model = self.build_model(specimen)
        unsupported = [
            instance.name
            for instance in model.present_effects
            if instance.effect.acts != "parameters"
        ]
        if unsupported:
            raise InputError(
                f"model {self.title!r} has {', '.join(unsupported)}",
                allowed="effects that only change parameters",
                remedy="use a model without the others",
            )
        return model.parameters
