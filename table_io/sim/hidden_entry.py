"""Entries of a ground-truth file, effects and imperfections, and their parameters."""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple, Protocol

from pydantic import Field, ValidationInfo, field_validator

from table_io.config.base import ConfigModel
from table_io.errors import InputError, suggest


class HiddenParameter(NamedTuple):
    """Parameter of an effect or imperfection in SI; at `vanishing` it is absent.

    `vanishing` None: the parameter only shapes it. `default` None: it must be given. `typical` and
    `bad` are sizes that occur in practice; only imperfections have a `bad` one.
    """

    name: str
    unit: str
    low: float
    high: float
    vanishing: float | None
    typical: float
    default: float | None = None
    bad: float | None = None
    is_integer: bool = False


def find_parameter_faults(
    parameters: Sequence[HiddenParameter], given: Mapping[str, float]
) -> list[str]:
    """List a message for each unknown, missing, fractional or out-of-range parameter."""
    known_names = [parameter.name for parameter in parameters]
    faults = [
        f"no parameter {name!r}; {suggest(name, known_names)}"
        for name in given
        if name not in known_names
    ]
    for parameter in parameters:
        value = given.get(parameter.name, parameter.default)
        allowed = f"allowed: {parameter.low:g} to {parameter.high:g} {parameter.unit}".rstrip()
        if value is None:
            faults.append(f"lacks {parameter.name!r}; add it, {allowed}")
        elif not parameter.low <= value <= parameter.high:
            faults.append(f"{parameter.name} = {value:g}; {allowed}")
        elif parameter.is_integer and value != round(value):
            faults.append(f"{parameter.name} = {value:g}; {allowed}, a whole number")
    return faults


class HiddenDefinition(Protocol):
    """What an entry can state: the parameters of an id in one form."""

    @property
    def parameters(self) -> tuple[HiddenParameter, ...]: ...


class HiddenEntry(ConfigModel):
    """Entry of a ground-truth file.

    A subclass declares `parameters` as its last field, because their validation needs the others;
    they are completed with defaults. `definitions` are by (id, form); the first form of an id is
    its default.
    """

    noun: ClassVar[str]
    definitions: ClassVar[Mapping[tuple[str, str], HiddenDefinition]]

    id: str = Field(description="Name of the effect or imperfection.")
    form: str = Field("", validate_default=True, description="Empty: first form of the id.")
    channel: str | None = Field(
        None, description="Channel on which it acts, for those of one channel."
    )

    @classmethod
    def find_faults(
        cls, definition: Any, given: Mapping[str, float], place: Mapping[str, Any]
    ) -> list[str]:
        """List a message for each other fault of the parameters and the place of an entry."""
        raise NotImplementedError

    def check_channel(self, allowed: Sequence[str], problem: str) -> None:
        """Raise InputError if the entry states a channel that is not among these."""
        if self.channel is not None and self.channel not in allowed:
            raise InputError(
                problem,
                where=f"ground truth, {self.noun} {self.id}",
                key="channel",
                value=self.channel,
                allowed=", ".join(allowed),
            )

    @field_validator("id")
    @classmethod
    def _check_id(cls, name: str) -> str:
        ids = list(dict.fromkeys(known for known, _ in cls.definitions))
        if name not in ids:
            raise InputError(f"{cls.noun} {name!r} is unknown", remedy=suggest(name, ids))
        return name

    @field_validator("form")
    @classmethod
    def _check_form(cls, form: str, info: ValidationInfo) -> str:
        forms = [known for name, known in cls.definitions if name == info.data.get("id")]
        if not forms:
            return form
        if form and form not in forms:
            raise InputError(f"{info.data['id']} has no form {form!r}", remedy=suggest(form, forms))
        return form or forms[0]

    @field_validator("parameters", check_fields=False)
    @classmethod
    def _complete_parameters(
        cls, given: dict[str, float], info: ValidationInfo
    ) -> dict[str, float]:
        definition = cls.definitions.get((info.data.get("id", ""), info.data.get("form", "")))
        if definition is None:
            return given
        faults = find_parameter_faults(definition.parameters, given)
        faults += cls.find_faults(definition, given, info.data)
        if faults:
            raise ValueError(f"{info.data['id']}: " + "; ".join(faults))
        return {
            parameter.name: given.get(parameter.name, parameter.default or 0.0)
            for parameter in definition.parameters
        }
