"""Model files: validated base parameters and effects from TOML."""

import tomllib
from pathlib import Path
from typing import Any

from pydantic import Field, field_validator, model_validator

from table_io.config.base import (
    ConfigModel,
    Finite,
    NonNegative,
    Positive,
    format_toml,
    list_duplicates,
    parse_toml,
    read_text,
)
from table_io.config.profile import Specimen
from table_io.config.provenance import Provenance
from table_io.errors import InputError
from twin.laws.effect import Effect
from twin.laws.effect_file import EffectFile
from twin.laws.library import find_effect
from twin.model.model import EffectInstance, Model
from twin.model.parameters import Parameters

MAX_EFFECT_FILE_BYTES = 100_000


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

    id: str = Field("", description="Name of the effect, built in or of a plug-in.")
    file: str | None = Field(
        None, description="Effect file with a law of its own, next to the model file."
    )
    law: EffectFile | None = Field(
        None, description="The same law in the model file; loading attaches that of `file`."
    )
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
        if self.law is not None and self.id not in ("", self.law.id):
            raise InputError(
                "two names for one effect", key="id", value=self.id, allowed=self.law.id,
                remedy="omit id",
            )  # fmt: skip
        if not (self.id or self.law or self.file):
            raise InputError("missing", key="id", remedy="give id, file or law")
        self.instance  # noqa: B018
        return self

    @property
    def effect(self) -> Effect:
        if self.law is not None:
            return self.law.build_effect()
        if self.file is not None:
            raise InputError(
                f"{self.file!r} is not attached", key="file", remedy="load the model from its file"
            )
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
    provenance: Provenance | None = Field(
        None, description="Specimens and recordings that it was identified from; a run compares."
    )
    base: BaseModelConfig
    effects: tuple[EffectConfig, ...] = ()
    files: dict[str, str] = Field({}, description="Texts of files by name; loading attaches them.")

    @model_validator(mode="before")
    @classmethod
    def _attach_laws(cls, raw: Any) -> Any:
        """Return the table with the law of each attached effect file in its entry."""
        if not isinstance(raw, dict) or not isinstance(raw.get("files"), dict):
            return raw
        effects = raw.get("effects")
        if not isinstance(effects, list):
            return raw
        attached = []
        for entry in effects:
            name = entry.get("file") if isinstance(entry, dict) else None
            if isinstance(name, str) and "law" not in entry and name in raw["files"]:
                law = parse_toml(str(raw["files"][name]), EffectFile, name)
                attached.append({**entry, "law": law})
            else:
                attached.append(entry)
        return {**raw, "effects": attached}

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


def load_model_config(path: Path) -> tuple[ModelConfig, str]:
    """Load a model file and the effect files that it names: return (config, text with them).

    The text holds all that the model needs, so a recording that keeps it needs no other file.
    """
    text = read_text(path, "model file")
    try:
        table = tomllib.loads(text)
        entries = [] if "files" in table else table.get("effects", [])
        names = {entry["file"]: None for entry in entries if isinstance(entry.get("file"), str)}
    except (tomllib.TOMLDecodeError, AttributeError, TypeError, RecursionError):
        names = {}  # reported when the text is parsed
    if names:
        texts = {name: _read_effect_file(name, path) for name in names}
        for name, law in texts.items():
            parse_toml(law, EffectFile, str(path.parent / name))
        text = f"{text}\n{format_toml({'files': texts})}"
    return parse_toml(text, ModelConfig, str(path)), text


def _read_effect_file(name: str, model_path: Path) -> str:
    """Return the text of an effect file next to a model file; InputError if it cannot be read."""
    path = model_path.parent / name
    problem, allowed = "", f"a regular file of at most {MAX_EFFECT_FILE_BYTES} bytes"
    if "\0" in name or Path(name).name != name:
        problem, allowed = "not the name of a file", "a name without folders"
    elif not path.is_file():
        problem = "no such effect file"
    elif path.stat().st_size > MAX_EFFECT_FILE_BYTES:
        problem = "too large for an effect file"
    else:
        try:
            return path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            problem = f"cannot read this effect file: {error}"
    raise InputError(
        problem, where=model_path, key="file", value=name, allowed=allowed,
        remedy="put the effect file next to the model file",
    )  # fmt: skip
