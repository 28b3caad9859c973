"""Results: the twin of a table with its file, and the drive with the profile that plays it."""

import json
import re
from dataclasses import dataclass
from pathlib import Path

from pydantic import Field, ValidationInfo, field_validator

from table_io.block import Float1D
from table_io.config.base import (
    ConfigModel,
    Finite,
    NonNegative,
    Positive,
    format_toml,
    load_config,
)
from table_io.config.excitation.drive_file import DriveHeader, ExpectedResponse, format_drive
from table_io.config.profile import Profile
from table_io.config.provenance import Provenance, require_seal, seal_text
from table_io.errors import InputError, suggest
from twin.earthquakes.table_effects import EFFECT_BY_ID
from twin.earthquakes.table_evidence import EffectDiscovery
from twin.earthquakes.table_identification import TableIdentification, TableRehearsal
from twin.earthquakes.table_model import TableModel, TableParameters
from twin.earthquakes.table_response import (
    STRUCTURE_BY_ID,
    PredictiveModel,
    Resonance,
    ResponseModel,
)
from twin.setup.run_config import RunConfig, read_run_config

DRIVE_FILE, PROFILE_FILE = "drive.csv", "profile.toml"
# Beyond this ratio and this error in addition a twin loses to a baseline: lag and gain of the
# baselines are those of the judged log, so that a table that is but late would lose by a hair.
MAX_LOSS_RATIO, MAX_LOSS = 1.005, 0.001
HYDRAULIC = "hydraulic"  # structure of a twin by `TableParameters`
DRIVE_LINE = re.compile(r"(?m)^drive\s*=.*\n")


class JudgedErrors(ConfigModel):
    """RMS error of the table's acceleration in the band over the RMS of the measured one."""

    twin: NonNegative = Field(description="By the twin.")
    pure_delay: NonNegative = Field(description="By the command with its lag in this log.")
    delay_gain: NonNegative = Field(description="By the command with its lag and gain in it.")
    frf: NonNegative = Field(description="By a smooth frequency response of the fitted logs.")


class JudgedRun(ConfigModel):
    """Judgement of a twin by one log."""

    log: str = Field(description="Log, as it was given.")
    band_hz: tuple[float, float] = Field(description="Band of the errors in Hz.")
    error: JudgedErrors = Field(description="Errors of the twin and of its baselines.")

    def name_better_baseline(self) -> str:
        """Return the best baseline to which the twin loses; empty if it loses to none."""
        baselines = self.error.model_dump(exclude={"twin"})
        best = min(baselines, key=lambda name: float(baselines[name]))
        limit = MAX_LOSS_RATIO * float(baselines[best]) + MAX_LOSS
        return best if self.error.twin > limit else ""


class ChannelEstimate(ConfigModel):
    """Errors of an estimate of the table's acceleration from command and further channels."""

    channels: tuple[str, ...] = Field(description="Measured channels that it uses.")
    errors: tuple[NonNegative, ...] = Field(description="Errors on the runs of the judgement.")


class Judgement(ConfigModel):
    """Judgement of a table's twin on data that was not fitted."""

    structure: str = Field(description="Structure of the twin.")
    on: str = Field(description="What was left out of the fit.")
    held_out: dict[str, float] = Field(description="Held-out error of each structure.")
    runs: tuple[JudgedRun, ...] = Field(description="Errors by log.")
    estimate: ChannelEstimate | None = Field(
        None, description="With measured channels of the table and specimen: no prediction."
    )

    def explain_refusal(self) -> str:
        """Return why the twin is refused, in words; empty if it loses to no baseline."""
        lost = [(run, name) for run in self.runs if (name := run.name_better_baseline())]
        parts = [
            f"{run.log}: error {run.error.twin:.3g}, {name.replace('_', ' ')} "
            f"{getattr(run.error, name):.3g}"
            for run, name in lost
        ]
        return f"the twin loses to a baseline ({'; '.join(parts)})" if parts else ""


class EffectVerdict(ConfigModel):
    """Verdict on the effects of a table's library: by the evidence that judges a specimen."""

    outcome: str = Field(description="none, named, ambiguous or unexplained.")
    probability: NonNegative = Field(description="Probability of the outcome.")
    place: str = Field("", description="Place of what no effect explains.")
    effects: tuple[str, ...] = Field(
        (), description="Effects of the verdict, also those that the twin predicts better without."
    )
    alternatives: tuple[tuple[str, ...], ...] = Field(
        (), description="Sets of effects that cannot be told apart from these."
    )


class TableTwinReport(ConfigModel):
    """What `table-twin --json` prints."""

    written: bool
    reason: str
    runs: tuple[JudgedRun, ...]


class ResponseConfig(ConfigModel):
    """Response of a table to its command, `ResponseModel`."""

    delay_s: Finite = Field(description="Delay of the whole command.")
    band_hz: tuple[float, float] = Field(description="Band in Hz in which it corrects the command.")
    lags_s: tuple[float, ...] = Field((), description="Lags of the smooth responses.")
    coefficients: dict[str, tuple[float, ...]] = Field(
        {}, description="By input: one for each lag, then two of the resonance."
    )
    resonance_hz: Positive | None = Field(None, description="Frequency of the resonance.")
    resonance_damping: Positive | None = Field(None, description="Its damping ratio.")


class TableTwinConfig(ConfigModel):
    """Twin of a table: the parameters of `TableParameters` or its response, and its judgement."""

    title: str = Field(description="Table and recordings that it was identified from.")
    mass_kg: Positive = Field(description="Moving mass without payload that forces refer to.")
    residual: NonNegative = Field(description="Share of the measured motion that it leaves, rms.")
    structure: str = Field(HYDRAULIC, description="Structure: hydraulic, or one of a response.")
    response: ResponseConfig | None = Field(None, description="Response, if it is not hydraulic.")
    judgement: Judgement | None = Field(
        None, description="Errors on data that was not fitted; `table-drive` uses no twin without."
    )
    parameters: dict[str, float] = Field({}, description="Parameters of the hydraulic twin, SI.")
    half_widths: dict[str, float] = Field({}, description="Half widths of their 95 % intervals.")
    effects: tuple[str, ...] = Field((), description="Effects that the rehearsal showed.")
    effect_verdict: EffectVerdict | None = Field(None, description="What is known of them.")
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

    @field_validator("response")
    @classmethod
    def _check_response(
        cls, response: ResponseConfig | None, info: ValidationInfo
    ) -> ResponseConfig | None:
        structure = info.data.get("structure", HYDRAULIC)
        if structure not in (HYDRAULIC, *STRUCTURE_BY_ID) or (
            (structure == HYDRAULIC) != (response is None)
        ):
            raise InputError(
                f"does not fit structure {structure!r}",
                allowed=f"none of {HYDRAULIC}, one of {', '.join(STRUCTURE_BY_ID)}",
            )
        return response

    def build_model(self) -> PredictiveModel:
        """Return the twin of the table."""
        response = self.response
        if response is None:
            return TableModel(self.mass_kg, TableParameters(**self.parameters))
        resonance = None
        if response.resonance_hz is not None and response.resonance_damping is not None:
            resonance = Resonance(response.resonance_hz, response.resonance_damping)
        return ResponseModel(
            self.structure,
            response.delay_s,
            response.band_hz,
            response.lags_s,
            response.coefficients,
            resonance,
        )


def load_table_twin(path: Path) -> TableTwinConfig:
    """Load the twin of a table from its file; InputError if it is none."""
    config, text = load_config(path, TableTwinConfig, "table twin")
    try:
        require_seal(text, "the twin of the table", "identify it again by `shaketwin table-twin`")
    except InputError as error:
        raise error.add_place(path) from None
    return config


@dataclass(frozen=True, eq=False)
class TableTwinResult:
    """Identified twin of a table, its judgement, and the motion behind it.

    `identification` and the effects that were searched are those of the hydraulic structure, if it
    was chosen. `rehearsal` is the motion of the first log, `motions` the number of the logs.
    """

    title: str
    mass_kg: float
    model: PredictiveModel
    residual: float
    judgement: Judgement
    identification: TableIdentification | None
    discovery: EffectDiscovery | None
    rehearsal: TableRehearsal
    provenance: Provenance

    def format_toml(self) -> str:
        """Return the text of the twin's file."""
        model, discovery = self.model, self.discovery
        text: dict[str, object] = {
            "title": self.title,
            "mass_kg": self.mass_kg,
            "residual": float(f"{self.residual:.4g}"),
            "structure": self.judgement.structure,
        }
        if self.identification is not None and isinstance(model, TableModel):
            values, widths = model.parameters._asdict(), self.identification.half_widths
            text |= {
                "effects": [*discovery.fitted.names] if discovery else [],
                "parameters": {name: float(f"{value:.9g}") for name, value in values.items()},
                "half_widths": {name: float(f"{width:.3g}") for name, width in widths.items()},
            }
        elif isinstance(model, ResponseModel):
            text["response"] = _describe_response(model).model_dump(exclude_none=True)
        if discovery is not None:
            verdict = discovery.verdict
            text["effect_verdict"] = EffectVerdict(
                outcome=verdict.outcome,
                probability=float(f"{verdict.confidence:.4g}"),
                place=verdict.place,
                effects=verdict.best.names,
                alternatives=tuple(other.names for other in verdict.alternatives),
            ).model_dump()
        text["judgement"] = self.judgement.model_dump(exclude_none=True)
        text["provenance"] = self.provenance.model_dump()
        return seal_text(format_toml(text))

    def save(self, path: Path) -> Path:
        """Write the twin's file and return its path.

        InputError if it exists, or if the twin loses to a baseline.
        """
        if reason := self.judgement.explain_refusal():
            raise InputError(reason, where=path)
        if path.exists():
            raise InputError("exists already", where=path, remedy="give a new name")
        path.write_text(self.format_toml(), encoding="utf-8")
        return path


def _describe_response(model: ResponseModel) -> ResponseConfig:
    """Return a response as it stands in the file of a twin."""
    resonance = model.resonance
    return ResponseConfig(
        delay_s=model.delay_s,
        band_hz=model.band_hz,
        lags_s=tuple(float(f"{lag:.9g}") for lag in model.lags_s),
        coefficients={
            name: tuple(float(f"{value:.9g}") for value in values)
            for name, values in (model.coefficients or {}).items()
        },
        resonance_hz=None if resonance is None else resonance.hz,
        resonance_damping=None if resonance is None else resonance.damping,
    )


@dataclass(frozen=True, eq=False)
class DriveResult:
    """Drive of a test on a rig: command and target in m, (sample,) each, at `rate_hz`.

    `expected_error` is the rms error of the acceleration in the band that the twin expects, over
    the rms of the target; None of a drive that was corrected after a run. `rig` is the name or path
    of the rig file, `response` what its loop check is to measure, `notes` are warnings.
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
    response: ExpectedResponse | None
    notes: tuple[str, ...]

    @property
    def rate_hz(self) -> float:
        return self.config.profile.acquisition.rate_hz

    def format_drive(self) -> str:
        """Return the text of the drive's file."""
        comment = f"drive of {self.config.name} on {self.twin_title}"
        header = DriveHeader(provenance=self.provenance, response=self.response)
        return format_drive(self.command_m, self.target_m, comment, header)

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
