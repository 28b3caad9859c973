"""File of a table's twin, as `shaketwin table-twin` writes it."""

from collections.abc import Sequence
from pathlib import Path

from pydantic import Field, field_validator

from table_io.config.base import ConfigModel, NonNegative, Positive, load_config
from table_io.config.toml_text import format_toml
from table_io.errors import InputError, suggest
from twin.earthquakes.table_effects import EFFECT_BY_ID
from twin.earthquakes.table_identification import TableIdentification
from twin.earthquakes.table_model import TableModel, TableParameters


class TableTwinConfig(ConfigModel):
    """Twin of a table: its moving mass, the parameters of `TableParameters` and intervals."""

    title: str = Field(description="Table and recordings that it was identified from.")
    mass_kg: Positive = Field(description="Moving mass without payload that forces refer to.")
    residual: NonNegative = Field(description="Share of the measured motion that it leaves, rms.")
    parameters: dict[str, float] = Field(description="Parameters of the table's twin, SI.")
    half_widths: dict[str, float] = Field({}, description="Half widths of their 95 % intervals.")
    effects: tuple[str, ...] = Field((), description="Effects that the rehearsal showed.")

    @field_validator("parameters")
    @classmethod
    def _check_names(cls, parameters: dict[str, float]) -> dict[str, float]:
        unknown = sorted(set(parameters) - set(TableParameters._fields))
        if unknown:
            raise InputError(
                f"{', '.join(unknown)} unknown", remedy=suggest(unknown[0], TableParameters._fields)
            )
        return parameters

    @field_validator("effects")
    @classmethod
    def _check_effects(cls, effects: tuple[str, ...]) -> tuple[str, ...]:
        unknown = sorted(set(effects) - set(EFFECT_BY_ID))
        if unknown:
            raise InputError(
                f"effect {', '.join(unknown)} unknown", remedy=suggest(unknown[0], EFFECT_BY_ID)
            )
        return effects

    def build_model(self) -> TableModel:
        """Return the twin of the table."""
        return TableModel(self.mass_kg, TableParameters(**self.parameters))


def load_table_twin(path: Path) -> TableTwinConfig:
    """Load the twin of a table from its file; InputError if it is none."""
    return load_config(path, TableTwinConfig, "table twin")[0]


def format_table_twin(
    title: str, identification: TableIdentification, effects: Sequence[str] = ()
) -> str:
    """Return the TOML text of an identified table, with the names of the effects found in it."""
    values = identification.model.parameters._asdict()
    widths = identification.half_widths
    return format_toml(
        {
            "title": title,
            "mass_kg": identification.model.mass_kg,
            "residual": float(f"{identification.residual:.4g}"),
            "effects": effects,
            "parameters": {name: float(f"{value:.9g}") for name, value in values.items()},
            "half_widths": {name: float(f"{width:.3g}") for name, width in widths.items()},
        }
    )
