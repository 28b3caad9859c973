"""Test profile: specimen, excitation, acquisition, comparison, control and protection.

Keys carry their unit in the name (`gap_mm`, `start_hz`); properties return SI.
"""

import json
import math
import tomllib
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

from pydantic import (
    AliasChoices,
    Field,
    SerializeAsAny,
    ValidationInfo,
    ValidatorFunctionWrapHandler,
    field_validator,
    model_validator,
)

from table_io.channels import Channel
from table_io.config.adaptive import DwellConfig, RefineConfig, SweepGrid, TrackConfig
from table_io.config.base import (
    ConfigModel,
    Count,
    Finite,
    Number,
    Positive,
    parse_toml,
    read_text,
    require_both,
)
from table_io.config.excitation import (  # those without a use here register their kinds
    Excitation,
    ExcitationPlan,
    History,
    record,  # noqa: F401
    synthetic,  # noqa: F401
)
from table_io.config.excitation.continuation import Continuation
from table_io.config.excitation.stepped_sine import Sweep
from table_io.config.excitation.swept_sine import SweptSine
from table_io.config.rig import RigConfig
from table_io.config.tracking import TrackingConfig
from table_io.errors import InputError
from table_io.records import Step
from table_io.units import UNITS

NOTCH = "notch"


class LimitConfig(ConfigModel):
    """Limit on the magnitude of a channel, and what happens there."""

    channel: str = Field(description="A channel of the rig.")
    limit: Positive = Field(description="Largest magnitude allowed.")
    unit: str | None = Field(None, description="Of `limit`; omitted: that of the recording.")
    action: Literal["notch", "warn", "stop"] = Field(
        "stop",
        description="Any sample beyond it warns, or stops the table; a notch reduces the level of "
        "a swept sine before its fundamental gets there.",
    )

    @field_validator("unit")
    @classmethod
    def _check_unit(cls, unit: str | None, info: ValidationInfo) -> str | None:
        channel = info.data.get("channel", "")
        if unit is None:
            return None
        if unit not in UNITS:
            raise InputError(f"unit {unit!r} is unknown", allowed=", ".join(UNITS))
        ending = "_" + UNITS[unit][0].replace("/", "_").lower()
        if not channel.lower().endswith(ending):
            raise InputError(
                f"unit {unit!r} is none of {channel}", allowed="a unit of the channel's quantity"
            )
        return unit

    @property
    def limit_si(self) -> float:
        """Largest magnitude allowed, in the unit of the recording."""
        return self.limit * (UNITS[self.unit][1] if self.unit is not None else 1.0)


def check_limited_channels(limits: tuple[LimitConfig, ...], rig: RigConfig) -> tuple[Channel, ...]:
    """Return the channel of each limit; InputError if the rig does not measure one."""
    for number, entry in enumerate(limits, 1):
        if entry.channel not in rig.channels:
            raise InputError(
                f"rig {rig.name!r} does not measure this channel",
                where=f"limit {number}",
                key="limits.channel",
                value=entry.channel,
                allowed=", ".join(rig.channels),
            )
    return tuple(rig.channel_by_name[entry.channel] for entry in limits)


MAX_SOURCE_BYTES = 32 * 2**20  # of a file of the excitation, before its conversion to text
# Of its text, and of that of [tracking]: they travel with the profile in one message of the bus,
# 4 MiB at most.
MAX_FILE_BYTES, MAX_SPECTRUM_BYTES = 2 * 2**20, 2**18


class Specimen(ConfigModel):
    """Specimen on the table. `gap_mm` is the total, right plus left; negative = precompressed."""

    mass_kg: Positive = Field(description="Moving mass, with everything fixed to it.")
    gap_mm: Number = Field(description="Nominal total gap; inf = no bumpers.")
    gap_right_mm: Number | None = Field(None, description="Measured gap on the right.")
    gap_left_mm: Number | None = Field(
        None, validate_default=True, description="Measured gap on the left."
    )
    temperature_c: Finite | None = Field(
        None, description="Of the specimen during the test; information only."
    )

    @field_validator("gap_mm", "gap_right_mm", "gap_left_mm")
    @classmethod
    def _check_gap(cls, gap: float | None, info: ValidationInfo) -> float | None:
        if gap is not None and (math.isnan(gap) or gap == -math.inf):
            raise InputError(
                f"{info.field_name} is {gap}", allowed="a number in mm, or inf for no bumpers"
            )
        return gap

    @field_validator("gap_left_mm")
    @classmethod
    def _check_gap_pair(cls, left: float | None, info: ValidationInfo) -> float | None:
        require_both("gap_left_mm", left, "gap_right_mm", info)
        return left

    @property
    def gaps_m(self) -> tuple[float, float]:
        """Initial gaps (right, left) in m: the measured ones if given, else half the nominal."""
        if self.gap_right_mm is None or self.gap_left_mm is None:
            return self.gap_mm / 2e3, self.gap_mm / 2e3
        return self.gap_right_mm / 1e3, self.gap_left_mm / 1e3


class AcquisitionConfig(ConfigModel):
    """Sampling rate, block length and recorded rest."""

    rate_hz: Positive = Field(2000.0, description="Sampling rate; one of `rates_hz` of the rig.")
    block_samples: Count = Field(
        20, ge=1, le=10000, description="Samples in a block; the twin answers once a block."
    )
    rest_s: Number = Field(0.5, ge=0.2, le=60, description="Recorded rest before and after.")


class ComparisonConfig(ConfigModel):
    """Settings of the comparison of model and measurement."""

    window_s: Number = Field(0.25, ge=0.05, le=60, description="Time between restarts.")
    contact_n: Positive = Field(10.0, description="Bumper force above which it is in contact.")


class RecordingConfig(ConfigModel):
    """Content of the recording."""

    predictions: Literal["hash", "all"] = Field(
        "hash",
        description='What is recorded of the twin\'s output: "hash" is every 10th block and a hash '
        'of all, from which a replay proves what it recomputes; "all" is every block.',
    )


class OnDeathConfig(ConfigModel):
    """Reaction of the test to the death of a helper process, which is restarted either way."""

    twin: Literal["continue", "stop"] = Field("continue", description="Twin process.")
    recorder: Literal["continue", "stop"] = Field("continue", description="Recorder process.")
    viewer: Literal["continue", "stop"] = Field("continue", description="Viewer process.")
    supervisor: Literal["continue", "stop"] = Field(
        "stop", description="Supervisor of all of them."
    )


class LoopCheckConfig(ConfigModel):
    """Loop check at low level before every run, and the rest after it."""

    enabled: bool = Field(True, description="False skips the check.")
    level: Number = Field(0.1, gt=0, le=0.1, description="Share of the test's acceleration.")
    cycles: Count = Field(5, ge=3, le=50, description="Held cycles at each frequency.")
    frequencies_hz: tuple[Positive, ...] = Field(
        (), max_length=10, description="Empty: three between the ends of the sweep."
    )
    rest_s: Number = Field(5.0, ge=5.0, le=60, description="Rest after the check.")


class ControlConfig(ConfigModel):
    """Amplitude control: correction of the command before the measured cycles of a step."""

    enabled: bool = Field(True, description="False plays the nominal command without correction.")
    tolerance: Number = Field(0.02, ge=0.002, le=0.1, description="Share of the demanded level.")
    updates: Count = Field(3, ge=1, le=10, description="Largest number per step.")
    gain: Number = Field(0.8, ge=0.1, le=1.0, description="Share of an error corrected at once.")
    clamp_db: Number = Field(2.0, gt=0, le=6.0, description="Largest change per update.")
    harmonics: bool = Field(False, description="Cancel the table's harmonics 2 to 5.")
    harmonic_updates: Count = Field(
        5, ge=1, le=10, description="Largest number per step, with `harmonics`."
    )


class ProtectionConfig(ConfigModel):
    """Protection bands and reaction to sensor faults; the rig file holds the machine limits."""

    alarm: Number = Field(0.1, gt=0, le=1.0, description="Deviation from the level for an alarm.")
    abort_db: Number = Field(6.0, gt=0, le=12.0, description="Deviation from the level for a stop.")
    sensor: Literal["stop", "warn"] = Field(
        "stop", description="Reaction to a fault of a sensor that the control does not need."
    )


class CustomerConfig(ConfigModel):
    """Texts of the customer's report of a test."""

    laboratory: str = Field("", description="Name and address of the laboratory.")
    customer: str = Field("", description="Name of the customer.")
    order: str = Field("", description="Number of the order.")
    specimen: str = Field("", description="Specimen: type, serial number, mounting.")
    specification: str = Field("", description="What the test is to meet, in the customer's words.")
    signatures: tuple[str, ...] = Field(
        ("Test engineer", "Head of the laboratory"), max_length=6, description="Who signs."
    )


class SetUpConfirmation(ConfigModel):
    """Setup that the operator was asked for before a run, and the operator's confirmation."""

    campaign: str = Field(description="Name of the campaign.")
    label: str = Field(description="Label of the run in it.")
    asked: str = Field(description="Set-up change that was asked for.")
    answer: str = Field(description="Answer of the operator.")
    who: str = Field(description="Name of the operator.")
    at: str = Field(description="Time of the answer, ISO 8601.")
    notes: str = Field("", description="Notes of the operator.")


class ResumeConfig(ConfigModel):
    """Continuation of an interrupted test in a separate recording."""

    first_step: Count = Field(ge=0, description="First driven step; steps keep their index.")
    of: str = Field(description="Name of the interrupted run.")


class Profile(ConfigModel):
    """Test profile: everything that defines one test."""

    title: str = Field(description="Title of the test in every report.")
    citation: str = Field("", description="Source of the test, such as a paper.")
    notes: str = Field("", description="Notes of the operator; they go into the recording.")
    rig: str = Field("simulated", description="Rig file: a name or a path; `--table` replaces it.")
    model: str = Field("snm", description="Model file: a name or a path; `--model` replaces it.")
    specimen: Specimen
    excitation: SerializeAsAny[Excitation] = Field(
        validation_alias=AliasChoices("excitation", "sweep"),
        description="What the table plays; [sweep] is the older name of kind stepped_sine.",
    )
    acquisition: AcquisitionConfig = Field(AcquisitionConfig(), validate_default=True)
    comparison: ComparisonConfig = ComparisonConfig()
    recording: RecordingConfig = RecordingConfig()
    loop_check: LoopCheckConfig = LoopCheckConfig()
    control: ControlConfig = ControlConfig()
    protection: ProtectionConfig = ProtectionConfig()
    limits: tuple[LimitConfig, ...] = Field((), max_length=32, description="On channels.")
    tracking: TrackingConfig = TrackingConfig()
    on_death: OnDeathConfig = OnDeathConfig()
    dwell: DwellConfig | None = None
    track: TrackConfig | None = None
    refine: RefineConfig | None = None
    customer: CustomerConfig = CustomerConfig()
    set_up: SetUpConfirmation | None = None
    resume: ResumeConfig | None = None

    @property
    def first_step(self) -> int:
        """Index of the first driven step."""
        return self.resume.first_step if self.resume is not None else 0

    @property
    def sweep(self) -> Sweep:
        """Stepped sine of the test; InputError if its excitation is of another kind."""
        if isinstance(self.excitation, Sweep):
            return self.excitation
        raise InputError(
            "this needs a stepped sine, with steps of one frequency each",
            where=self.title,
            key="excitation.kind",
            value=self.excitation.kind,
            allowed="stepped_sine",
        )

    @property
    def continuation(self) -> Continuation | None:
        """Continuation of the test; None if its excitation is of another kind."""
        return self.excitation if isinstance(self.excitation, Continuation) else None

    @property
    def swept_sine(self) -> SweptSine | None:
        """Swept sine of the test; None if its excitation is of another kind."""
        return self.excitation if isinstance(self.excitation, SweptSine) else None

    @cached_property
    def plan(self) -> ExcitationPlan:
        """What the excitation plays at the sampling rate of the test."""
        return self.excitation.plan(self.acquisition.rate_hz)

    @property
    def steps(self) -> tuple[Step, ...]:
        """Planned steps in driving order; none if a displacement history is played."""
        return () if isinstance(self.excitation, History) else self.plan.steps

    @model_validator(mode="before")
    @classmethod
    def _check_one_excitation(cls, tables: Any) -> Any:
        if isinstance(tables, Mapping) and {"sweep", "excitation"} <= tables.keys():
            raise InputError("[sweep] and [excitation] are given", allowed="one of them")
        return tables

    @field_validator("excitation", mode="wrap")
    @classmethod
    def _read_kind(cls, table: Any, handler: ValidatorFunctionWrapHandler) -> Excitation:
        if not isinstance(table, Mapping):
            return handler(table)
        return Excitation.select_class(table).model_validate(table)

    @field_validator("control")
    @classmethod
    def _check_control(cls, control: ControlConfig, info: ValidationInfo) -> ControlConfig:
        excitation = info.data.get("excitation")
        is_changed = control.enabled and control != ControlConfig()
        if excitation is not None and not isinstance(excitation, Sweep) and is_changed:
            raise InputError(
                f"the amplitude of kind {excitation.kind!r} is not tuned: it is played open loop",
                remedy="remove [control]",
            )
        return control

    @field_validator("limits")
    @classmethod
    def _check_notches(
        cls, limits: tuple[LimitConfig, ...], info: ValidationInfo
    ) -> tuple[LimitConfig, ...]:
        excitation = info.data.get("excitation")
        has_notch = any(entry.action == NOTCH for entry in limits)
        if has_notch and excitation is not None and not isinstance(excitation, SweptSine):
            raise InputError(
                f"the level of kind {excitation.kind!r} is not reduced while it is played",
                allowed='action = "warn" or "stop"; "notch" with a swept_sine',
            )
        return limits

    @field_validator("tracking")
    @classmethod
    def _check_tracking(cls, tracking: TrackingConfig, info: ValidationInfo) -> TrackingConfig:
        excitation, acquisition = info.data.get("excitation"), info.data.get("acquisition")
        if excitation is not None and not isinstance(excitation, History):
            if tracking != TrackingConfig():
                raise InputError(
                    f"kind {excitation.kind!r} plays no displacement history to be tracked",
                    remedy="remove [tracking]",
                )
        elif acquisition is not None and tracking.band_hz is not None:
            limit_hz = acquisition.rate_hz / 2
            if tracking.band_hz[1] > limit_hz:
                raise InputError(
                    f"band_hz ends at {tracking.band_hz[1]:g} Hz",
                    allowed=f"up to {limit_hz:g} Hz, half of acquisition.rate_hz",
                )
        return tracking

    @field_validator("dwell", "track", "refine")
    @classmethod
    def _check_adaptive(
        cls, tool: DwellConfig | TrackConfig | RefineConfig | None, info: ValidationInfo
    ) -> DwellConfig | TrackConfig | RefineConfig | None:
        tables = [name for name in ("dwell", "track") if info.data.get(name) is not None]
        if tool is not None and tables:
            raise InputError(f"[{tables[0]}] is given too", allowed="one of dwell, track, refine")
        sweep = info.data.get("excitation")
        if tool is not None and isinstance(sweep, Sweep) and not sweep.has_one_level:
            raise InputError(
                "the level of the sweep varies",
                remedy=f"remove [{info.field_name}], or state acceleration_g alone",
            )
        if tool is not None and isinstance(sweep, Sweep):
            tool.check_sweep(SweepGrid(sweep.start_hz, sweep.stop_hz, sweep.step_hz))
        elif tool is not None and sweep is not None:
            raise InputError(
                f"kind {sweep.kind!r} has no steps", remedy=f"remove [{info.field_name}]"
            )
        return tool

    @field_validator("resume")
    @classmethod
    def _check_resume(
        cls, resume: ResumeConfig | None, info: ValidationInfo
    ) -> ResumeConfig | None:
        sweep = info.data.get("excitation")
        if resume is not None and sweep is not None and not isinstance(sweep, Sweep):
            raise InputError(
                f"kind {sweep.kind!r} has no steps", remedy="run the test from its beginning"
            )
        if resume is not None and sweep is not None and resume.first_step >= len(sweep.steps):
            raise InputError(
                f"first_step {resume.first_step} is beyond the last step",
                allowed=f"0 to {len(sweep.steps) - 1}",
            )
        return resume


def load_profile(path: Path) -> tuple[Profile, str]:
    """Load a test profile and the files that it names: return (profile, text with the files).

    The text holds all that the test needs, so a recording that keeps it needs no other file.
    """
    return parse_profile(read_text(path, "test profile"), path)


def parse_profile(text: str, path: Path) -> tuple[Profile, str]:
    """Parse the text of a test profile, next to whose path its files lie, as `load_profile`."""
    for table in ("excitation", "tracking"):
        text = attach_files(text, path, table)
    return parse_toml(text, Profile, str(path)), text


def attach_files(text: str, path: Path, table_name: str) -> str:
    """Return the text of a profile with a table of the files of its table appended.

    The files lie next to `path`. InputError if one cannot be read.
    """
    try:
        table = tomllib.loads(text)[table_name]
        is_tracking = table_name == "tracking"
        model = TrackingConfig if is_tracking else Excitation.select_class(table)
        names = {key: table[key] for key in model.FILE_KEYS if key in table}
    except (KeyError, TypeError, AttributeError, ValueError, RecursionError):
        return text  # which is reported when it is parsed
    if "files" in table or not names:
        return text
    lines = [
        f"{json.dumps(entry)} = '''\n{content}'''"
        for key, name in names.items()
        for entry, content in _read_file(
            str(name), path, f"{table_name}.{key}", model, table
        ).items()
    ]
    attached = "\n".join([text, f"[{table_name}.files]", *lines, ""])
    try:
        tomllib.loads(attached)
    except tomllib.TOMLDecodeError as error:
        raise InputError(
            f"its file cannot be attached ({error})",
            where=path,
            key=table_name,
            remedy=f"write it as a table, [{table_name}], and the file as plain text",
        ) from None
    return attached


def _read_file(
    name: str, profile_path: Path, key: str, model: type[ConfigModel], table: Mapping[str, Any]
) -> dict[str, str]:
    """Read a file named at a key of a profile, next to which it lies: return its texts by name."""
    path = profile_path.parent / name
    limit = MAX_FILE_BYTES if issubclass(model, Excitation) else MAX_SPECTRUM_BYTES
    try:
        size = path.stat().st_size
        data = path.read_bytes() if size <= MAX_SOURCE_BYTES else b""
        kind = model if issubclass(model, Excitation) else Excitation
        files = kind.convert_file(data, name, table) if data else {name: ""}
    except InputError as error:
        raise error.replace(key=error.key or key).add_place(profile_path) from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"cannot read this file: {getattr(error, 'strerror', None) or error}",
            where=profile_path,
            key=key,
            value=name,
            remedy="give its path relative to the profile",
        ) from None
    text_size = sum(len(content.encode()) for content in files.values())
    _check_size(text_size if data else size, path, limit)
    return files


def _check_size(size: int, path: Path, limit: int) -> None:
    """Raise InputError if a file is too large to travel with the profile."""
    if size > limit:
        raise InputError(
            f"{size / 2**20:.1f} MB are too large",
            where=path,
            allowed=f"at most {limit / 2**20:g} MB as text",
            remedy="resample it, or write fewer digits, or the needed column alone",
        )
