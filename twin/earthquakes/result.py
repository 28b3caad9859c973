"""Results: the twin of a table with its file, and the drive with the profile that plays it."""

import json
import re
from dataclasses import dataclass
from pathlib import Path

from pydantic import Field, field_validator

from table_io.block import Float1D
from table_io.config.base import ConfigModel, NonNegative, Positive, load_config
from table_io.config.excitation.drive_file import format_drive
from table_io.config.profile import Profile
from table_io.config.provenance import Provenance
from table_io.config.toml_text import format_toml
from table_io.errors import InputError, suggest
from twin.earthquakes.table_effects import EFFECT_BY_ID, EffectDiscovery
from twin.earthquakes.table_identification import TableIdentification, TableRehearsal
from twin.earthquakes.table_model import TableModel, TableParameters
from twin.setup.run_config import RunConfig, read_run_config

DRIVE_FILE, PROFILE_FILE = "drive.csv", "profile.toml"
DRIVE_LINE = re.compile(r"(?m)^drive\s*=.*\n")


class TableTwinConfig(ConfigModel):
    """Twin of a table: its moving mass, the parameters of `TableParameters` and intervals."""

    title: str = Field(description="Table and recordings that it was identified from.")
    mass_kg: Positive = Field(description="Moving mass without payload that forces refer to.")
    residual: NonNegative = Field(description="Share of the measured motion that it leaves, rms.")
    parameters: dict[str, float] = Field(description="Parameters of the table's twin, SI.")
    half_widths: dict[str, float] = Field({}, description="Half widths of their 95 % intervals.")
    effects: tuple[str, ...] = Field((), description="Effects that the rehearsal showed.")
    provenance: Provenance | None = Field(
        None, description="Rig, specimen, level and recording that it was identified from."
    )

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


@dataclass(frozen=True, eq=False)
class TableTwinResult:
    """Identified twin of a table, the effects that were searched, and the rehearsal behind it."""

    title: str
    identification: TableIdentification
    discovery: EffectDiscovery | None
    rehearsal: TableRehearsal
    provenance: Provenance

    def format_toml(self) -> str:
        """Return the text of the twin's file."""
        identification, discovery = self.identification, self.discovery
        values = identification.model.parameters._asdict()
        widths = identification.half_widths
        effects = [] if discovery is None else [finding.id for finding in discovery.findings]
        return format_toml(
            {
                "title": self.title,
                "mass_kg": identification.model.mass_kg,
                "residual": float(f"{identification.residual:.4g}"),
                "effects": effects,
                "parameters": {name: float(f"{value:.9g}") for name, value in values.items()},
                "half_widths": {name: float(f"{width:.3g}") for name, width in widths.items()},
                "provenance": self.provenance.model_dump(),
            }
        )

    def save(self, path: Path) -> Path:
        """Write the twin's file and return its path; InputError if it exists."""
        if path.exists():
            raise InputError("exists already", where=path, remedy="give a new name")
        path.write_text(self.format_toml(), encoding="utf-8")
        return path


@dataclass(frozen=True, eq=False)
class DriveResult:
    """Drive of a test on a rig: command and target in m, (sample,) each, at `rate_hz`.

    `expected_error` is the rms error of the acceleration in the band that the twin expects, over
    the rms of the target; None of a drive that was corrected after a run. `rig` is the name or path
    of the rig file, `notes` are warnings.
    """

    config: RunConfig
    profile_path: Path
    rig: str
    twin_title: str
    command_m: Float1D
    target_m: Float1D
    band_hz: tuple[float, float]
    expected_error: float | None
    provenance: Provenance
    notes: tuple[str, ...]

    @property
    def rate_hz(self) -> float:
        return self.config.profile.acquisition.rate_hz

    def format_drive(self) -> str:
        """Return the text of the drive's file."""
        comment = f"drive of {self.config.name} on {self.twin_title}"
        return format_drive(self.command_m, self.target_m, comment, self.provenance)

    def save(self, folder: Path) -> Path:
        """Write the profile with its files and the drive to a folder; return the profile's path.

        InputError if the drive exceeds a limit of the rig, or a file cannot be copied.
        """
        folder.mkdir(parents=True, exist_ok=True)
        profile, source = self.config.profile, self.profile_path.parent
        text = DRIVE_LINE.sub("", self.profile_path.read_text(encoding="utf-8"))
        text, count = re.subn(
            r"(?m)^\[excitation\][^\n]*$",
            lambda header: f'{header[0]}\ndrive = "{DRIVE_FILE}"',
            text,
            count=1,
        )
        if count == 0:
            raise InputError(
                "no line [excitation] to which the drive can be added",
                where=self.profile_path,
                remedy="write the excitation as a table of its own",
            )
        for key, name in (("rig", self.rig), ("model", profile.model)):
            # A path is relative to the profile, which is written elsewhere.
            paths = [path for path in (source / name, Path(name)) if path.is_file()]
            value = str(paths[0].resolve()) if name.endswith(".toml") and paths else name
            # First, since what follows a table would belong to it.
            text = re.sub(rf"(?m)^{key}\s*=.*\n", "", text)
            text = f"{key} = {json.dumps(value)}\n{text}"
        for name in _list_files(profile):
            self._copy_file(name, folder)
        (folder / DRIVE_FILE).write_text(self.format_drive(), encoding="utf-8")
        path = folder / PROFILE_FILE
        path.write_text(text, encoding="utf-8")
        read_run_config(path)  # InputError beyond the limits of the rig
        return path

    def _copy_file(self, name: str, folder: Path) -> None:
        """Copy a file of the profile that is named by a relative path."""
        if Path(name).is_absolute():
            return
        copy = folder / name
        if not copy.resolve().is_relative_to(folder.resolve()):
            raise InputError(
                f"{name} lies outside the folder of the profile",
                where=self.profile_path,
                remedy="put it next to the profile",
            )
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_bytes((self.profile_path.parent / name).read_bytes())


def _list_files(profile: Profile) -> list[str]:
    """Return the names of the files that a profile needs, without its drive."""
    tables = (profile.excitation, profile.tracking)
    names = [getattr(table, key) for table in tables for key in table.FILE_KEYS if key != "drive"]
    return [name for name in names if name is not None]
