"""Campaign file: configuration models, and checks of every run before anything moves."""

import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, ValidationError, ValidationInfo, field_validator

from table_io.config.base import ConfigModel, Count, list_duplicates, parse_toml, read_text
from table_io.config.excitation.stepped_sine import Sweep
from table_io.config.folders import find_config, list_configs, resolve_config
from table_io.errors import InputError, suggest
from table_io.safety.preflight import list_drive_warnings as coarse
from twin.campaign.record_grid import LABEL_PATTERN, GridCell, RecordGrid, read_base, read_cell
from twin.setup.run_config import RunConfig, read_run_config

ResumeMode = Literal["direction", "step", "run"]
CheckRun = Callable[[RunConfig, Path], None]  # raises InputError if a run cannot be played


class CampaignRun(ConfigModel):
    """One entry of the list: a test, and the set-up change before it."""

    profile: str = Field(
        description="Name of a test, or path of a .toml file relative to this file."
    )
    label: str = Field(
        "", pattern=LABEL_PATTERN, description="Name of the run; empty: name of the profile."
    )
    prompt: str = Field("", description="Set-up change to confirm before the run; empty: none.")
    notes: str = Field("", description="Notes of the operator; they go into the recording.")
    repeat: Count = Field(1, ge=1, le=50, description="Number of repetitions.")

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of the repetitions: label, label-rep2, ...; the default is the profile's name."""
        label = self.label or Path(self.profile).stem
        return (label, *(f"{label}-rep{k}" for k in range(2, self.repeat + 1)))


class CampaignConfig(ConfigModel):
    """A campaign: its runs, then those of its grid, and where an interrupted run continues."""

    title: str = Field(description="Title of the campaign in every report.")
    citation: str = Field("", description="Source of the programme.")
    notes: str = Field("", description="Notes of the operator.")
    resume: ResumeMode = Field(
        "direction", description="Part of an interrupted run to repeat: direction, step or run."
    )
    records: RecordGrid | None = None
    runs: tuple[CampaignRun, ...] = Field((), validate_default=True)

    @field_validator("runs")
    @classmethod
    def _require_runs(
        cls, runs: tuple[CampaignRun, ...], info: ValidationInfo
    ) -> tuple[CampaignRun, ...]:
        if not runs and "records" in info.data and info.data["records"] is None:
            raise ValueError(
                'no runs; add at least one [[runs]] with profile = "...", or [records] with gaps_mm'
            )
        return runs

    @property
    def tests(self) -> tuple[str, ...]:
        """Names of the tests of all runs in order; a run of the grid has its own test."""
        listed = [Path(run.profile).stem for run in self.runs for _ in run.labels]
        return (*listed, *(cell.label for cell in self.cells))

    @property
    def record_names(self) -> dict[str, str]:
        """Names of the records of the grid in every report, by the labels of their runs."""
        return {cell.label: cell.record.reported_name for cell in self.cells}

    @property
    def cells(self) -> tuple[GridCell, ...]:
        """Runs of the grid of records and gaps, in order; none without a grid."""
        return () if self.records is None else tuple(self.records.list_cells())


@dataclass(frozen=True)
class PlannedRun:
    """A checked run of a campaign; `prompt` is empty where the set-up does not change."""

    number: int
    label: str
    prompt: str
    notes: str
    bundle: RunConfig

    @property
    def name(self) -> str:
        """Name of its folder, NN-label."""
        return f"{self.number:02d}-{self.label}"


@dataclass(frozen=True)
class CampaignPlan:
    """All runs of a campaign, checked."""

    path: Path
    config: CampaignConfig
    text: str
    runs: tuple[PlannedRun, ...]

    @property
    def seconds(self) -> float:
        """Total duration of all drives in s."""
        return sum(run.bundle.drive.planned_end / run.bundle.drive.rate_hz for run in self.runs)


def read_plan(
    path: Path, table: str | None, model: str | None, check_run: CheckRun
) -> CampaignPlan:
    """Return the plan of a campaign file; one InputError lists every fault in it and its tests."""
    path = resolve_config(path, "campaigns")
    text = read_text(path, "campaign")
    faults = FaultList()
    bundles: dict[str, RunConfig] = {}
    entries, grid = _list_runs(text), _parse_grid(text)
    for name in dict.fromkeys(run.profile for run in entries):
        place = path
        try:
            place = _find_profile(name, path)
            bundles[name] = read_run_config(place, table, model)
            _refuse_own_sections(bundles[name])
            check_run(bundles[name], place)
        except InputError as error:
            faults.add(_drop_place(error, place), name)
    grid_bundles = {} if grid is None else _read_grid(grid, path, table, model, check_run, faults)
    cells = () if grid is None else tuple(grid.list_cells())
    labels = [label for run in entries for label in run.labels] + [cell.label for cell in cells]
    for label in list_duplicates(labels):
        fault = InputError("used twice", key="label", value=label, remedy="give each run its own")
        faults.add(fault, "runs")
    listed = faults.list_by_place()
    try:
        config = parse_toml(text, CampaignConfig, str(path))
    except InputError as error:
        if not error.faults:
            raise
        raise InputError("", where=path, faults=[*error.faults, *listed]) from None
    if listed:
        raise InputError("nothing was started", where=path, faults=listed)
    runs = [
        (label, run.prompt if k == 0 else "", run.notes, bundles[run.profile])
        for run in config.runs
        for k, label in enumerate(run.labels)
    ]
    runs += [
        (cell.label, cell.prompt, cell.record.notes, grid_bundles[cell.label])
        for cell in config.cells
    ]
    return CampaignPlan(
        path, config, text, tuple(PlannedRun(n, *fields) for n, fields in enumerate(runs, 1))
    )


class FaultList:
    """Faults of the tests of a campaign; what several of them share is listed once."""

    def __init__(self) -> None:
        self._faults: dict[str, tuple[InputError, list[str]]] = {}

    def add(self, fault: InputError, place: str) -> None:
        """Add a fault of the test or table at `place`."""
        places = self._faults.setdefault(str(fault), (fault, []))[1]
        if place not in places:
            places.append(place)

    def list_by_place(self) -> list[InputError]:
        """Return one error per different fault, with the places that share it."""
        return [
            InputError("", where=", ".join(places), faults=[fault])
            for fault, places in self._faults.values()
        ]


def _read_grid(
    grid: RecordGrid,
    path: Path,
    table: str | None,
    model: str | None,
    check_run: CheckRun,
    faults: FaultList,
) -> dict[str, RunConfig]:
    """Return the configurations of the runs of a grid by label; add what is wrong to `faults`."""
    place = path
    try:
        place = _find_profile(grid.profile, path)
        base = read_base(place)
    except InputError as error:
        faults.add(_drop_place(error, place), f"records, profile {grid.profile}")
        return {}
    bundles: dict[str, RunConfig] = {}
    by_record: dict[str, RunConfig] = {}
    for cell in grid.list_cells():
        name = cell.record.name
        try:
            bundle = read_cell(grid, base, cell, path, table, model, by_record.get(name))
            if name not in by_record:
                _refuse_own_sections(bundle)
                check_run(bundle, path)
            bundles[cell.label] = by_record[name] = bundle
        except InputError as error:
            fault = _drop_place(_drop_place(error, path), Path(cell.label))
            faults.add(fault, f"records, {name}")
    return bundles


def _parse_grid(text: str) -> RecordGrid | None:
    """Return the grid of a campaign file; None without one, or if it cannot be parsed."""
    try:
        table = tomllib.loads(text).get("records")
        return None if table is None else RecordGrid.model_validate(table)
    except (tomllib.TOMLDecodeError, ValidationError, TypeError):
        return None  # reported when the whole file is parsed


def find_campaign(name: Path) -> Path | None:
    """Return the path of a campaign file given by its path or bare name; None if it is a test."""
    if name.suffix.lower() != ".toml":
        is_test = name.is_file() or str(name) in list_configs("tests")
        is_campaign = not is_test and str(name) in list_configs("campaigns")
        return resolve_config(name, "campaigns") if is_campaign else None
    try:
        tables = tomllib.loads(name.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None  # reported as a test that cannot be read
    return name if {"records", "runs"} & tables.keys() else None


def _list_runs(text: str) -> list[CampaignRun]:
    """Return the runs listed in a campaign file, except those that cannot be parsed."""
    try:
        runs: Any = tomllib.loads(text).get("runs")
    except tomllib.TOMLDecodeError:
        return []
    runs_listed = []
    for entry in runs if isinstance(runs, list) else []:
        try:
            known = {name: entry[name] for name in ("profile", "label", "repeat") if name in entry}
            runs_listed.append(CampaignRun.model_validate(known))
        except (ValidationError, TypeError):
            continue  # reported when the whole file is parsed
    return runs_listed


def _find_profile(name: str, path: Path) -> Path:
    """Return the path of a run's profile; InputError with the nearest name if it is missing."""
    place = find_config(name, "tests", path)
    if place.is_file():
        return place
    candidate = path.parent / name
    known = [profile_path.name for profile_path in sorted(candidate.parent.glob("*.toml"))]
    known += list_configs("tests", path)
    raise InputError(
        f"no such test profile in {candidate.parent}",
        where=name,
        remedy=suggest(candidate.name, known),
    )


def _refuse_own_sections(bundle: RunConfig) -> None:
    for name in ("resume", "set_up"):
        if getattr(bundle.profile, name) is not None:
            raise InputError(
                "this section is written by the campaign",
                key=f"[{name}]",
                remedy="remove it from the profile",
            )


def _drop_place(error: InputError, place: Path) -> InputError:
    """Return an error without the path of a profile, so that equal faults of several compare."""
    return error.replace(where="") if error.where == str(place) and error.problem else error


def is_free_flight(bundle: RunConfig) -> bool:
    """Return whether a stepped sine is played without bumpers, which gives u* and a*."""
    return bundle.profile.specimen.gap_mm == float("inf") and bool(bundle.steps)


def list_campaign_warnings(plan: CampaignPlan) -> list[str]:
    """Return warnings about plans that are allowed but unusual."""
    warnings = [
        f"{run.label}: {sentence}"
        for run in plan.runs
        for sentence in coarse(run.bundle.margins, run.bundle.rig)
    ]
    swept = [run for run in plan.runs if isinstance(run.bundle.profile.excitation, Sweep)]
    if not swept:
        return warnings  # no curve is divided by u* and a*
    free = [run for run in swept if is_free_flight(run.bundle)]
    if not free:
        return [*warnings, "no free flight in this campaign: its curves are divided by u* and a* "
                "of the model, not by measured ones"]  # fmt: skip
    if free[0] is not swept[0]:
        warnings.append(
            f"free flight ({free[0].label}) is not the first run: u* and a*, by which every curve "
            "is divided, are unknown until then"
        )
    level = free[0].bundle.profile.sweep.one_level_g
    other_levels = [run for run in swept if run.bundle.profile.sweep.one_level_g != level]
    if other_levels:
        warnings.append(
            f"{', '.join(run.label for run in other_levels)}: another level than the free flight's "
            f"{level:g} g, by whose u* and a* the curves are divided"
        )
    return warnings
