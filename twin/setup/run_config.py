"""Configuration of a run: profile, rig, model and drive, validated together beforehand.

Warnings of a test are listed for it too: `run` and `check` show the same ones.
"""

import platform
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from table_io.acquisition.session import SessionSetup
from table_io.backends import open_backend
from table_io.channels import CONTROL_CHANNELS
from table_io.clock import ManualClock, local_datetime
from table_io.config.base import PROFILES_DIR, parse_toml
from table_io.config.calibration import check_tare, find_overdue_calibrations
from table_io.config.folders import find_config, resolve_config
from table_io.config.profile import Profile, Specimen, load_profile
from table_io.config.rig import RigConfig
from table_io.config.rig_file import load_rig
from table_io.errors import InputError
from table_io.excitation.drive import Drive
from table_io.excitation.trajectory import plan_excitation
from table_io.records import RunStart, Step
from table_io.safety.loop_check_data import PreloadLimits
from table_io.safety.preflight import (
    StepDemand,
    check_drive_rig,
    check_limits,
    compute_demands,
    list_drive_warnings,
    list_setup_warnings,
)
from table_io.sensor_errors import highpass
from table_io.sequencer.procedure import make_test_plan, nominal_drive
from twin.model.config import ModelConfig, load_model_config
from twin.model.contact_regime import U_L, U_R
from twin.model.model import Model
from twin.model.parameters import Parameters
from twin.recording.log_metadata import RECORDED_EVERY
from twin.setup.law_limits import check_laws
from twin.system.versions import read_installed_versions

if TYPE_CHECKING:
    from twin.compare.pipeline import PipelineSetup

MAX_PRELOAD_ERROR = 0.5  # of K_j times the precompression: of a model that is not identified yet
GAP_SETTING_M = 1e-4  # accuracy with which screws set a gap
WARM_UP_ITEMS = 100  # of a session (1 s); every kernel is called within the first blocks


@dataclass(frozen=True)
class RunConfig:
    """Configuration of a run, as TOML texts and as validated objects.

    `drive` is the nominal drive: it is played if the loop check passes and no level is corrected.
    """

    name: str
    profile: Profile
    rig: RigConfig
    model: Model
    drive: Drive
    margins: tuple[StepDemand, ...]
    profile_toml: str
    rig_toml: str
    model_toml: str
    rig_file: Path | None = None  # of the rig, where the config was read from files

    @property
    def session_setup(self) -> SessionSetup:
        return SessionSetup(self.profile, self.rig, self.preload_n)

    @property
    def preload_n(self) -> PreloadLimits | None:
        """Force (low, high) on the bumpers (right, left) that the model allows at rest; N.

        The model need not be identified yet and a gap is set to 0.1 mm: a tare that has swallowed
        a preload of 0.5 mm is far outside. None if no bumper is to press on the mass.
        """
        if min(self.profile.specimen.gaps_m) >= 0.0:
            return None
        from twin.model.closed_form import rest_state

        p, state = self.parameters, rest_state(self.parameters)
        right, left = (
            (k * ((1.0 - MAX_PRELOAD_ERROR) * x - GAP_SETTING_M),
             k * ((1.0 + MAX_PRELOAD_ERROR) * x + GAP_SETTING_M))
            for k, x in (
                (p.bumper_stiffness_r, float(state[U_R])),
                (p.bumper_stiffness_l, -float(state[U_L])),
            )
        )  # fmt: skip
        return right, left

    def prepare_twin(self, from_rest: bool = False) -> "PipelineSetup":
        """Return the twin's setup; the import compiles kernels that are not cached."""
        from twin.compare import pipeline

        extra = [channel.channel for channel in self.rig.extra_channels]
        setup = pipeline.prepare_pipeline(self.profile, self.model, self.steps, from_rest, extra)
        setup.twin.solver  # noqa: B018  compiles now, not at the first sample
        return setup

    @property
    def ideal_drive(self) -> Drive:
        """Drive of an ideal table: the excitation without loop check and tuning."""
        return plan_excitation(self.profile)

    @property
    def parameters(self) -> Parameters:
        """Linear parameters of the model."""
        return self.model.parameters

    @property
    def steps(self) -> tuple[Step, ...]:
        return self.drive.steps

    @property
    def expected_s(self) -> float:
        """Expected duration in s; of an adaptive test the part that is known before."""
        planned_s = self.drive.planned_end / self.drive.rate_hz
        continuation = self.profile.continuation
        return planned_s + (continuation.expected_s if continuation is not None else 0.0)

    @property
    def predictions_every(self) -> int:
        """Of the twin's blocks every n-th is recorded; 0: all."""
        return 0 if self.profile.recording.predictions == "all" else RECORDED_EVERY

    @property
    def extent(self) -> str:
        """Number of steps, or of windows of a displacement history, as text."""
        return f"{len(self.steps)} steps" if self.steps else f"{self.profile.plan.windows} windows"

    def make_start_factory(
        self, run: str, source: str
    ) -> Callable[[dict[str, float], float], RunStart]:
        """Return a function that makes the RunStart from tare and epoch."""

        def make_start(tare: dict[str, float], epoch_s: float) -> RunStart:
            return RunStart(
                index=0,
                run=run,
                name=self.name,
                source=source,
                profile_toml=self.profile_toml,
                rig_toml=self.rig_toml,
                model_toml=self.model_toml,
                rate_hz=self.profile.acquisition.rate_hz,
                block_samples=self.profile.acquisition.block_samples,
                channels=self.rig.channels if source == "table" else CONTROL_CHANNELS,
                steps=self.steps,
                planned_samples=self.drive.planned_end,
                tare=tare,
                versions=dict(read_installed_versions()),
                host=platform.node(),
                started_at=local_datetime().isoformat(timespec="seconds"),
                epoch_s=epoch_s,
                predictions_every=0 if source == "model" else self.predictions_every,
            )

        return make_start


def from_texts(
    name: str, profile_toml: str, rig_toml: str, model_toml: str, source: str
) -> RunConfig:
    """Build a `RunConfig` from TOML texts; InputError lists all faults of a text."""
    profile = parse_toml(profile_toml, Profile, source)
    rig = parse_toml(rig_toml, RigConfig, f"rig file of {source}")
    model_config = parse_toml(model_toml, ModelConfig, f"model file of {source}")
    try:
        drive = nominal_drive(make_test_plan(profile, rig))
    except ArithmeticError as error:
        raise InputError(
            f"no drive can be computed from these numbers ({error})",
            where=source,
            remedy="look for a wrong power of ten",
        ) from None
    except InputError as error:
        raise (error if source in str(error) else error.add_place(source)) from None
    model = model_config.build_model(profile.specimen)
    try:
        model.check_rate(profile.acquisition.rate_hz)
    except InputError as error:
        raise error.add_place(source) from None
    return RunConfig(
        name,
        profile,
        rig,
        model,
        drive,
        compute_demands(drive, profile, rig),
        profile_toml,
        rig_toml,
        model_toml,
    )


def read_run_config(path: Path, table: str | None = None, model: str | None = None) -> RunConfig:
    """Read the `RunConfig` of a test profile; InputError if the test exceeds the table's limits."""
    path = resolve_config(path, "tests")
    profile, profile_toml = load_profile(path)
    return build_run_config(path.stem, profile, profile_toml, path, str(path), table, model)


def build_run_config(
    name: str,
    profile: Profile,
    profile_toml: str,
    relative_to: Path,
    source: str,
    table: str | None = None,
    model: str | None = None,
) -> RunConfig:
    """Return the `RunConfig` of a profile, whose rig and model are found from `relative_to`.

    InputError if the test exceeds the limits of the table; `source` names the test in it.
    """
    rig_path = find_config(
        table or profile.rig, "rigs", relative_to, option="--table" if table else ""
    )
    rig, rig_toml = load_rig(rig_path)
    model_path = find_config(
        model or profile.model, "models", relative_to, option="--model" if model else ""
    )
    model_config, model_toml = load_model_config(model_path)
    if profile.continuation is not None:
        from twin.setup.orbit_plan import attach_orbit_plan, check_orbit_plan

        if profile.continuation.file is None:
            own_model = model_config.build_model(profile.specimen)
            profile_toml = attach_orbit_plan(profile_toml, profile, rig, own_model, source)
        else:
            check_orbit_plan(profile, rig)
    try:
        config = from_texts(name, profile_toml, rig_toml, model_toml, source)
    except InputError as error:
        if error.key != "rate_hz":
            raise
        raise error.replace(remedy=f"{error.remedy}, or correct {model_path}") from None
    if config.profile.swept_sine is not None:
        from twin.setup.swept_prediction import attach_prediction

        if (predicted_toml := attach_prediction(config)) != profile_toml:
            config = from_texts(name, predicted_toml, rig_toml, model_toml, source)
    check_drive_rig(config.profile, config.rig, source)
    check_tare(config.rig, config.profile.specimen.gaps_m, source, local_datetime())
    try:
        check_laws(config.model, config.profile)
    except InputError as error:
        raise error.add_place(str(model_path)) from None
    try:
        check_limits(config.margins, config.profile, config.rig, source)
    except InputError as error:
        raise error.replace(remedy=f"its limits are those of {rig_path}") from None
    return replace(config, rig_file=rig_path)


def read_model(
    name: str, relative_to: Path | None = None, option: str = ""
) -> tuple[ModelConfig, str]:
    """Read a model file by its name in models/ or its path; return (config, text).

    InputError names the option that gave the name, as in `find_config`.
    """
    path = find_config(name, "models", relative_to, option)
    return load_model_config(path)


def make_run_id(name: str) -> str:
    """Return <date>-<time>-<profile>: the run's id and the name of its folder."""
    return f"{local_datetime():%Y%m%d-%H%M%S}-{name}"


def compile_twin_kernels() -> None:
    """Compile or load the kernels of the twin by running them once on a few samples."""
    import numpy as np

    from twin.model.closed_form import advance_state, discretized_params, rest_state

    parameters = Parameters(550.0, 36e3, 1.1e3, 510e3, 900.0, 510e3, 900.0, 0.002, 0.002)
    highpass(np.zeros(4), 1.0, 2000.0)
    state = rest_state(parameters)
    advance_state(state, discretized_params(parameters, 2000.0), np.zeros(4), np.empty((7, 4)))


def compile_rig_kernels(config: RunConfig) -> None:
    """Compile or load the kernels of the rig, its protection and its simulated table.

    The start of a real session is run, so that every kernel is called. The quickstart profile
    replaces a rig that runs in real time only.
    """
    from contextlib import closing
    from itertools import islice

    import numpy as np

    from table_io.acquisition.session import run_session

    highpass(np.zeros(4), 1.0, 2000.0)  # first called when a cycle is complete
    if not config.rig.runs_at_any_speed:
        config = read_run_config(PROFILES_DIR / "tests" / "quickstart.toml")
    clock = ManualClock()
    session = run_session(
        config.session_setup,
        open_backend(config.rig, config.profile, clock),
        clock,
        config.make_start_factory("warm", "table"),
        lambda: None,
    )
    with closing(session):  # which closes the backend too
        for _ in islice(session, WARM_UP_ITEMS):
            pass


def read_model_template(name: str) -> tuple[Model, ModelConfig]:
    """Return (model, config) of a model file, with a mass of 1 kg and infinite gaps.

    Mass and gaps are set from each log.
    """
    config, _ = read_model(name, option="--model")
    return config.build_model(Specimen(mass_kg=1.0, gap_mm=float("inf"))), config


def list_test_warnings(config: RunConfig) -> list[str]:
    """List what is doubtful of a test: its drive, set-up, model, and sensors out of calibration."""
    return [
        *list_drive_warnings(config.margins, config.rig),
        *list_setup_warnings(config.profile, config.rig),
        *list_model_warnings(config.model_toml),
        *list_specimen_changes(config.model_toml, config.profile.specimen),
        *find_overdue_calibrations(config.rig, local_datetime().date()),
    ]


def list_model_warnings(model_toml: str) -> list[str]:
    """Return a warning for a model that its fit marked as provisional."""
    model = parse_toml(model_toml, ModelConfig, "model")
    return [f"the model is provisional: {model.provisional}"] if model.provisional else []


def list_specimen_changes(model_toml: str, specimen: Specimen) -> list[str]:
    """List how a specimen differs from those that a model was identified from."""
    model = parse_toml(model_toml, ModelConfig, "model")
    if model.provenance is None:
        return []
    what, gap_mm = f"the model {model.title!r}", 1e3 * sum(specimen.gaps_m)
    return [
        *model.provenance.list_mass_changes(specimen.mass_kg, what),
        *model.provenance.list_bumper_changes(gap_mm, what),
    ]
