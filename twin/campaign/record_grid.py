"""Grid of a campaign: every record at every gap, each as an ordinary run with a profile of its own.

The profile of a run is generated: the base profile with the record, its scale and the gap replaced,
and with the text of the record attached. So a recording holds all that it needs, as of any run.
"""

import math
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pydantic import Field, field_validator

from table_io.config.base import (
    Finite,
    Number,
    Positive,
    format_toml,
    list_duplicates,
    parse_toml,
    read_text,
)
from table_io.config.excitation.record import RecordedHistory, SeriesKeys
from table_io.config.excitation.waveform import Baseline
from table_io.config.profile import Profile, attach_files, load_profile
from table_io.errors import InputError, suggest
from twin.model.config import ModelConfig
from twin.setup.run_config import RunConfig, build_run_config

LABEL_PATTERN = r"^([A-Za-z0-9][A-Za-z0-9_.-]*)?$"
KEYS_OF_BASE_RECORD = (
    "file", "sha256", "quantity", "unit", "step_s", "variable", "column", "scale",
)  # fmt: skip


class RecordKeys(SeriesKeys):
    """Keys of [excitation] that a grid states for all its records, or for a single one."""

    length_ratio: Positive | None = Field(
        None, description="Similitude: length of model over prototype; omitted: of the base."
    )
    acceleration_ratio: Positive | None = Field(
        None, description="Similitude: acceleration of model over prototype; omitted: of the base."
    )
    baseline: Baseline | None = Field(
        None, description="Removed from an acceleration; omitted: that of the base."
    )
    band_hz: tuple[Positive, Positive] | None = Field(
        None, description="Lower and upper corner of the filter; omitted: those of the base."
    )
    blend_s: Positive | None = Field(
        None, description="From rest to the record, and back; omitted: that of the base."
    )

    def list_excitation_keys(self) -> dict[str, Any]:
        """Return the keys of [excitation] that are stated here, with their values."""
        return self.model_dump(include=set(RecordKeys.model_fields), exclude_none=True)


class GridRecord(RecordKeys):
    """A record of the grid."""

    file: str = Field(description="File with the history, next to this file or to the base.")
    label: str = Field(
        "", pattern=LABEL_PATTERN, description="Name of the record; empty: name of the file."
    )
    title: str = Field("", description="Name of the record in every report; empty: its label.")
    notes: str = Field("", description="Notes of the operator; they go into the recordings.")
    scale: Finite = Field(description="Factor on the motion; negative turns it around.")
    sha256: str | None = Field(
        None, pattern="^[0-9a-fA-F]{64}$", description="Checksum that the file must have."
    )

    @property
    def name(self) -> str:
        """Label of the record, by default the name of its file without its suffix."""
        return self.label or Path(self.file).stem

    @property
    def reported_name(self) -> str:
        """Name of the record in every report."""
        return self.title or self.name


@dataclass(frozen=True, slots=True)
class GridCell:
    """One run of a grid; `prompt` is empty where the gap is that of the run before."""

    label: str
    record: GridRecord
    gap_mm: float
    prompt: str


class RecordGrid(RecordKeys):
    """Records times gaps: each record is played at each gap. Gap by gap, in the order given."""

    profile: str = Field(
        description="Base of every run, a test of kind record: a name, or the path of a .toml file "
        "relative to this file. Its record, level and gap are replaced."
    )
    gaps_mm: tuple[Number, ...] = Field(
        min_length=1, description="Total gaps; inf = no bumpers, negative = precompressed."
    )
    files: tuple[GridRecord, ...] = Field(min_length=1, description="The records.")

    @field_validator("gaps_mm")
    @classmethod
    def _check_gaps(cls, gaps_mm: tuple[float, ...]) -> tuple[float, ...]:
        for gap_mm in gaps_mm:
            if math.isnan(gap_mm) or gap_mm == -math.inf:
                raise InputError(f"a gap is {gap_mm}", allowed="numbers in mm, or inf")
        twice = list_duplicates(gaps_mm)
        if twice:
            raise InputError(f"the gap {twice[0]:g} is listed twice", remedy="list each gap once")
        return gaps_mm

    @field_validator("files")
    @classmethod
    def _check_labels(cls, files: tuple[GridRecord, ...]) -> tuple[GridRecord, ...]:
        twice = list_duplicates([record.name for record in files])
        if twice:
            raise InputError(
                f"two records have the label {twice[0]!r}", remedy="give each its own label"
            )
        equal = list_duplicates([(record.reported_name, record.scale) for record in files])
        if equal:
            title, scale = equal[0]
            raise InputError(
                f"two records have the title {title!r} and the scale {scale:g}",
                remedy="give each its own title, by which the reports name it",
            )
        return files

    def list_cells(self) -> Iterator[GridCell]:
        """Yield the runs, gap by gap, so that the bumpers are set once for each gap."""
        for gap_mm in self.gaps_mm:
            for record in self.files:
                prompt = describe_set_up(gap_mm) if record is self.files[0] else ""
                yield GridCell(f"{label_gap(gap_mm)}-{record.name}", record, gap_mm, prompt)


def label_gap(gap_mm: float) -> str:
    """Return the name of a gap as in the names of the tests: ginf, g16, g0, gm1."""
    return f"g{gap_mm:g}".replace("-", "m")


def describe_set_up(gap_mm: float) -> str:
    """Return the prompt to the operator for a total gap in mm."""
    if math.isinf(gap_mm):
        return "Free flight: take both bumpers away, or turn them back out of reach."
    if gap_mm > 0:
        return f"Set the gap to {gap_mm:g} mm a total, {gap_mm / 2:g} mm a side."
    if gap_mm == 0:
        return "Close the gap: both bumpers just touch the mass, without force on the load cells."
    return (
        "With the bumpers clear: shaketwin tare --table RIG. Then precompress to "
        f"{gap_mm:g} mm a total, {-gap_mm / 2:g} mm a side."
    )


@dataclass(frozen=True, slots=True)
class GridBase:
    """Base profile of a grid: its path and its tables, without the texts of its files."""

    path: Path
    tables: Mapping[str, Any]


def read_base(path: Path) -> GridBase:
    """Read the base profile; InputError if it is faulty or cannot be the base of a grid."""
    profile, _ = load_profile(path)
    excitation, specimen = profile.excitation, profile.specimen
    if not isinstance(excitation, RecordedHistory):
        raise InputError(
            "the base of [records] plays no record",
            where=path,
            key="excitation.kind",
            value=excitation.kind,
            allowed="record",
        )
    if excitation.drive is not None:
        raise InputError(
            "a drive is computed for one record, level and gap",
            where=path,
            key="excitation.drive",
            value=excitation.drive,
            remedy="name a base without it; list driven profiles as [[runs]]",
        )
    if specimen.gap_right_mm is not None:
        raise InputError(
            "measured gaps of one set-up cannot hold for every gap of [records]",
            where=path,
            key="specimen.gap_right_mm",
            value=specimen.gap_right_mm,
            remedy="name a base that states gap_mm alone",
        )
    return GridBase(path, tomllib.loads(read_text(path, "test profile")))


def write_profile(grid: RecordGrid, base: GridBase, cell: GridCell, campaign: Path) -> str:
    """Return the text of the profile of a run, with its files attached.

    InputError if the file of the record is missing or cannot be read.
    """
    record, tables = cell.record, dict(base.tables)
    source = find_record(record, [campaign.parent, base.path.parent])
    processing = {
        key: value for key, value in tables["excitation"].items() if key not in KEYS_OF_BASE_RECORD
    }
    own = {"file": source.name, "scale": record.scale} | (
        {"sha256": record.sha256} if record.sha256 else {}
    )
    tables["excitation"] = (
        processing | grid.list_excitation_keys() | record.list_excitation_keys() | own
    )
    tables["specimen"] = {**tables["specimen"], "gap_mm": cell.gap_mm}
    tables["title"] = describe_run(record, cell.gap_mm)
    for key in ("citation", "notes"):  # of the record of the base
        tables.pop(key, None)
    if record.notes:
        tables["notes"] = record.notes
    origin = f"# Generated by {campaign.name} from {base.path.name}: {cell.label}.\n"
    text = attach_files(origin + format_toml(tables), source, "excitation")
    return attach_files(text, base.path, "tracking")


def find_record(record: GridRecord, folders: list[Path]) -> Path:
    """Return the path of a record's file in the first folder that has it; else InputError."""
    places = [folder / record.file for folder in folders]
    for place in places:
        if place.is_file():
            return place
    names = [
        path.name
        for place in places
        for path in sorted(place.parent.glob("*"))
        if path.suffix != ".toml"
    ]
    raise InputError(
        f"no such record in {' or '.join(str(place.parent) for place in places)}",
        key="file",
        value=record.file,
        remedy=suggest(Path(record.file).name, names),
    )


def describe_run(record: GridRecord, gap_mm: float) -> str:
    """Return the title of a run: record, scale and gap."""
    if math.isinf(gap_mm):
        set_up = "without bumpers"
    elif gap_mm < 0:
        set_up = f"bumpers precompressed by {-gap_mm:g} mm"
    else:
        set_up = f"with bumpers at {gap_mm:g} mm"
    return f"{record.reported_name} at {record.scale:g} of its level, {set_up}"


def read_cell(
    grid: RecordGrid,
    base: GridBase,
    cell: GridCell,
    campaign: Path,
    table: str | None,
    model: str | None,
    at_other_gap: RunConfig | None,
) -> RunConfig:
    """Return the checked configuration of a run of a grid; InputError as of any test.

    `at_other_gap` is that of the same record at another gap: the drive, which does not depend on
    the gap, is taken from it.
    """
    text = write_profile(grid, base, cell, campaign)
    profile = parse_toml(text, Profile, cell.label)
    if at_other_gap is None:
        return build_run_config(cell.label, profile, text, base.path, cell.label, table, model)
    model_config = parse_toml(at_other_gap.model_toml, ModelConfig, "model file")
    own_model = model_config.build_model(profile.specimen)
    own_model.check_rate(profile.acquisition.rate_hz)  # a contact needs a higher rate than none
    return replace(
        at_other_gap, name=cell.label, profile=profile, profile_toml=text, model=own_model
    )
