"""Tasks: identify the twin of a table from a rehearsal, and compute a drive on it."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from table_io.block import Block, Float1D, Label, join_blocks
from table_io.channels import CONTROL_CHANNELS
from table_io.config.base import parse_toml, read_text
from table_io.config.channel import is_table_channel
from table_io.config.excitation import History, add_drive_margin, history_acceleration
from table_io.config.folders import find_config, list_configs, resolve_config
from table_io.config.profile import Profile, parse_profile
from table_io.config.provenance import HashedFile, Provenance
from table_io.config.rig import RigConfig
from table_io.config.rig_file import load_rig
from table_io.errors import InputError
from twin.earthquakes.drive_computation import (
    BAND_EDGE_RATIO,
    PlayedDrive,
    compute_command,
    correct_played_drive,
    predict_loop_check,
)
from twin.earthquakes.result import (
    DRIVE_LINE,
    HYDRAULIC,
    DriveResult,
    TableTwinConfig,
    TableTwinResult,
    load_table_twin,
)
from twin.earthquakes.table_evidence import discover_table_effects
from twin.earthquakes.table_identification import (
    HIGHEST_HZ,
    RehearsalProblem,
    TableRehearsal,
    fit_basic_twin,
)
from twin.earthquakes.table_judgement import (
    MAX_RATE_SHARE,
    NamedMotion,
    check_motion,
    choose_structure,
    estimate_with_channels,
    find_predictable_band,
    fit_responses,
    join_motions,
    judge_fitted_logs,
    judge_other_logs,
    prepare_data,
    try_hydraulic_fit,
)
from twin.earthquakes.table_response import CROSSOVER_HZ, BandProjection, PredictiveModel
from twin.recording.reader import Recording
from twin.results.best_linear import COMMAND, estimate_best_linear
from twin.results.recordings import build_provenance, open_recording
from twin.results.tracking import BAND_WIDENING, find_band
from twin.setup.run_config import RunConfig, build_run_config
from twin.setup.unpaced import generate_ideal_twin
from twin.system.files import hash_file
from twin.system.versions import read_installed_versions

MASS_CHANNEL = "mass_acc_m_s2"
NOISE_S = 0.4  # at the start, where the table rests
REST_S = 0.5  # kept before and after the motion
BLEND_HZ = 0.5  # half width of the change from displacement to acceleration
Report = Callable[[str], None]  # gets the stage of a task in words


@dataclass(frozen=True)
class TableTwinOptions:
    """Logs from which the twin of a table is identified: a rehearsal, or runs of any kind.

    The twin is judged by the logs `judge`, or without them by parts of its own that are left out in
    turn, in the band `band_hz`, which is found from the logs unless given.
    """

    logs: Path | tuple[Path, ...]
    with_effects: bool = True
    judge: tuple[Path, ...] = ()
    band_hz: tuple[float, float] | None = None


def identify_table(
    options: TableTwinOptions, report: Report = lambda stage: None
) -> TableTwinResult:
    """Identify the twin of a table from logs, in the simplest structure that is not worse.

    The judgement of the result says how it predicts what was not fitted; a twin that loses to a
    baseline cannot be saved. InputError, with the cause, if a recording lacks channels or samples,
    or its motion is none from which a table can be known.
    """
    paths = (options.logs,) if isinstance(options.logs, Path) else options.logs
    recordings = [open_recording(path) for path in paths]
    judging = [open_recording(path) for path in options.judge]
    fitted = {recording.path.resolve() for recording in recordings}
    for recording in judging:
        if recording.path.resolve() in fitted:
            raise InputError("is fitted, and cannot judge", where=recording.path)
    logs = [_read_named_motion(*pair) for pair in zip(paths, recordings, strict=True)]
    judges = [_read_named_motion(*pair) for pair in zip(options.judge, judging, strict=True)]
    band_hz = options.band_hz or _find_band(recordings, logs)
    highest_hz = MAX_RATE_SHARE * min(log.motion.rate_hz for log in (*logs, *judges))
    if not 0.0 < band_hz[0] < band_hz[1] <= highest_hz:
        raise InputError(
            "is no band of these logs", key="band_hz", value=band_hz,
            allowed=f"low < high, in Hz, up to {highest_hz:.4g}",
        )  # fmt: skip
    data = prepare_data(logs, band_hz)
    report("fitting responses of the table")
    trials = fit_responses(data)
    rig = parse_toml(recordings[0].start.rig_toml, RigConfig, str(paths[0]))
    discovery = hydraulic = None
    motion = join_motions(logs)
    if motion is not None:
        stall_kn = rig.table_response.stall_force_kn
        stall_n = math.inf if stall_kn is None else 1e3 * stall_kn
        report("fitting the twin of the table")
        problem = RehearsalProblem.from_rehearsal(motion, rig.moving_mass_kg, stall_n)
        hydraulic = fit_basic_twin(problem)
        if options.with_effects:
            discovery = discover_table_effects(hydraulic, report)
            hydraulic = discovery.fitted.fit
        # Before the frequency response: of equal errors, physical parameters are worth more.
        trials.insert(2, try_hydraulic_fit(hydraulic, logs, data))
    chosen = choose_structure(trials, data)
    fitted_table = hydraulic if chosen.id == HYDRAULIC else None
    judged_data = prepare_data(judges, band_hz)
    judgement = (
        judge_other_logs(chosen, trials, judges, judged_data)
        if judges
        else judge_fitted_logs(chosen, trials, logs, data)
    )
    estimate = estimate_with_channels(data, judged_data)
    others = f" and {len(logs) - 1} more" if len(logs) > 1 else ""
    return TableTwinResult(
        f"{rig.title}, from {recordings[0].run}{others}",
        rig.moving_mass_kg,
        chosen.model,
        chosen.error if fitted_table is None else math.sqrt(fitted_table.cost),
        judgement.model_copy(update={"estimate": estimate}),
        None if fitted_table is None else fitted_table.to_identification(),
        None if fitted_table is None else discovery,
        logs[0].motion,
        build_provenance({recording.path: recording.start for recording in recordings}),
    )


def _find_band(recordings: Sequence[Recording], logs: Sequence[NamedMotion]) -> tuple[float, float]:
    """Return the band in Hz in which a twin can promise anything, and refuse what says nothing.

    Without a multisine it is that of the coherence, to which distortion is noise.
    """
    band_hz = find_predictable_band(logs)
    bands = [
        result.band_hz
        for recording in recordings
        for result in estimate_best_linear(recording, _read_profile(recording))
        if result.input == COMMAND and result.band_hz is not None
    ]
    return min(bands, default=band_hz, key=lambda band: band[0] - band[1])


def _read_named_motion(path: Path, recording: Recording) -> NamedMotion:
    """Return the motion of a recording; InputError if it says nothing of its table."""
    block, motion = _read_moving_block(recording)
    channels = {
        name: block.channel(name)
        for name in block.channels
        if is_table_channel(name) and np.isfinite(block.channel(name)).all()
    }
    named = NamedMotion(str(path), motion, channels)
    check_motion(named)
    return named


@dataclass(frozen=True)
class TableDriveOptions:
    """Test whose target the table shall follow, and the twin of the table.

    `band_hz` is that of the test unless given, `table` the rig of the twin: a name or the path of a
    rig file. The drive of the run `after` is corrected by what its table lacked.
    """

    profile: Path
    table_twin: Path
    band_hz: tuple[float, float] | None = None
    table: str | None = None
    after: Path | None = None


def compute_drive(options: TableDriveOptions, report: Report = lambda stage: None) -> DriveResult:
    """Compute the command by which a table follows the target of a test, on the table's twin.

    InputError if the test plays no displacement history, the rig is not that of the twin, or the
    run `after` is that of another target.
    """
    return prepare_drive_computation(options, report).compute(options.after, report)


@dataclass(frozen=True, eq=False)
class DriveComputation:
    """Target of a test, the specimen's force on the table during it, and the table's twin."""

    config: RunConfig
    profile_path: Path
    rig: str
    target_m: Float1D
    reaction_n: Float1D
    model: PredictiveModel
    twin: TableTwinConfig
    twin_path: Path
    band_hz: tuple[float, float]
    notes: tuple[str, ...]

    def compute(
        self, after: Path | None = None, report: Report = lambda stage: None
    ) -> DriveResult:
        """Return the drive by the twin, or that of the run `after`, corrected."""
        rate_hz = self.config.profile.acquisition.rate_hz
        sources = [HashedFile(name=self.twin_path.name, sha256=hash_file(self.twin_path))]
        expected_error = None
        if after is None:
            report("computing the drive on the twin of the table")
            judged = self.twin.judgement.runs if self.twin.judgement else ()
            ends_hz = (run.band_hz[1] / BAND_EDGE_RATIO for run in judged)
            highest_hz = min([BAND_WIDENING * self.band_hz[1], *ends_hz])
            computed = compute_command(
                self.model, self.target_m, rate_hz, self.band_hz, self.reaction_n, highest_hz
            )
            command, expected_error = computed.command_m, computed.expected_error
        else:
            recording = open_recording(after)
            command = self._correct(recording, after)
            sources.append(HashedFile(name=recording.run, sha256=hash_file(recording.path)))
        specimen = self.config.profile.specimen
        provenance = Provenance(
            rigs=(HashedFile.of_rig(self.config.rig),),
            masses_kg=(specimen.mass_kg,),
            gaps_mm=(1e3 * sum(specimen.gaps_m),),
            levels_m_s2=(float(np.abs(history_acceleration(self.target_m, rate_hz)).max()),),
            sources=tuple(sources),
            code=read_installed_versions()["shaketwin"],
        )
        return DriveResult(
            self.config,
            self.profile_path,
            self.rig,
            self.twin.title,
            command,
            self.target_m,
            self.band_hz,
            expected_error,
            provenance,
            predict_loop_check(self.model, self.config.profile, self.config.rig),
            self.notes,
        )

    def _correct(self, recording: Recording, log: Path) -> Float1D:
        """Return the drive of a recording in m, (sample,), corrected by what its table lacked."""
        target, run = read_played_drive(recording)
        if target.size != self.target_m.size or not np.allclose(target, self.target_m, atol=1e-7):
            raise InputError(
                "the recording is that of another target",
                where=log,
                remedy="give a run of a drive for this profile, at the same level",
            )
        rate_hz = self.config.profile.acquisition.rate_hz
        return correct_played_drive(
            run, self.model, self.target_m, self.reaction_n, rate_hz, self.band_hz
        )


def prepare_drive_computation(
    options: TableDriveOptions, report: Report = lambda stage: None
) -> DriveComputation:
    """Read the test and the twin of the table, and simulate the specimen on the target."""
    path = resolve_config(options.profile, "tests")
    # Without the drive that it may have, which may be of another rig or level.
    text = DRIVE_LINE.sub("", read_text(path, "test profile"))
    profile, profile_toml = parse_profile(text, path)
    excitation, rate_hz = profile.excitation, profile.acquisition.rate_hz
    if not isinstance(excitation, History):
        raise InputError(
            "a drive is computed for a displacement history",
            where=path,
            key="excitation.kind",
            value=excitation.kind,
            remedy="the level of a stepped sine is tuned while it runs",
        )
    twin = load_table_twin(options.table_twin)
    if twin.judgement is None or (lost := twin.judgement.explain_refusal()):
        raise InputError(
            "not judged on data that was not fitted" if twin.judgement is None else lost,
            where=options.table_twin,
            key="judgement",
            remedy="identify it again with `shaketwin table-twin`",
        )
    rig, notes = choose_rig(options, twin, profile, path)
    config = build_run_config(path.stem, profile, profile_toml, path, str(path), rig)
    if twin.provenance is not None:
        notes += twin.provenance.list_rig_changes(config.rig, f"the twin {options.table_twin}")
    target = add_drive_margin(excitation.displacement(rate_hz), rate_hz)
    band_hz = options.band_hz or profile.tracking.band_hz
    if band_hz is None:
        band_hz = find_band(history_acceleration(target, rate_hz), rate_hz)
    report("simulating the specimen")
    reaction = _simulate_reaction(config, target.size)
    return DriveComputation(
        config,
        path,
        rig,
        target,
        reaction,
        twin.build_model(),
        twin,
        options.table_twin,
        band_hz,
        tuple(notes),
    )


def choose_rig(
    options: TableDriveOptions, twin: TableTwinConfig, profile: Profile, path: Path
) -> tuple[str, list[str]]:
    """Return (name or path of the rig file of a drive, notes): the rig of the twin.

    InputError if `options.table` is another rig, or the rig of the twin is not found.
    """
    asked = options.table or profile.rig
    if twin.provenance is None or not twin.provenance.rigs:
        return asked, [
            f"the twin {options.table_twin} does not say which rig it was identified on, so the "
            f"drive is taken to be for rig {asked}; identify it again with `shaketwin table-twin`"
        ]
    names = [rig.name for rig in twin.provenance.rigs]
    if options.table is not None:
        rig = load_rig(find_config(options.table, "rigs", path, option="--table"))[0]
        if rig.name not in names:
            raise InputError(
                f"the twin {options.table_twin} is that of rig {names[0]!r}, not of {rig.name!r}",
                where=f"--table {options.table}",
                remedy=f"omit --table, or give the twin of {rig.name!r}, which `shaketwin "
                "table-twin` identifies from a rehearsal on it",
            )
        return options.table, []
    # The rig of the profile first, then a file of that name, then any other.
    candidates = list_configs("rigs", path)
    for name in dict.fromkeys([profile.rig, *names, *candidates]):
        try:
            rig_path = find_config(name, "rigs", path)
            rig = load_rig(rig_path)[0]
        except InputError:
            continue  # no rig file, or not of this rig
        if rig.name in names:
            notes = []
            if name != profile.rig:
                notes.append(
                    f"the drive is for rig {rig.name}, that of the twin; {path.name} names rig "
                    f"{profile.rig}"
                )
            is_found_anywhere = list_configs("rigs").get(name) == rig_path
            return name if is_found_anywhere else str(rig_path.resolve()), notes
    raise InputError(
        f"no rig file is named {names[0]!r}, the rig of this twin",
        where=options.table_twin,
        key="provenance.rigs",
        allowed=", ".join(candidates),
        remedy="give its path with --table",
    )


def _simulate_reaction(config: RunConfig, count: int) -> Float1D:
    """Return the force of the specimen on a table that follows the target, N, (sample,)."""
    blocks = (item for item in generate_ideal_twin(config) if isinstance(item, Block))
    predicted = join_blocks([block for block in blocks if block.stream == "pred"])
    acceleration = predicted.channel("free/mass_acc_m_s2")
    first = int(np.flatnonzero(predicted.is_history)[0])
    margin = (count - config.profile.plan.target_m.size) // 2
    reaction = np.zeros(count)
    played = -config.profile.specimen.mass_kg * acceleration[first : first + count - margin]
    reaction[margin : margin + played.size] = played
    return reaction


def _read_moving_block(recording: Recording) -> tuple[Block, TableRehearsal]:
    """Return the samples of a recording from rest to rest, and the motion of the table in them."""
    block = _find_whole_block(recording, CONTROL_CHANNELS[:2])
    profile = _read_profile(recording)
    moving = np.flatnonzero(block.label != Label.REST)
    if moving.size == 0:
        raise InputError("the table does not move in it", where=recording.path)
    margin = math.ceil(REST_S * block.rate_hz)
    first = max(int(moving[0]) - margin, 0)
    last = min(int(moving[-1]) + margin, len(block))
    block = block.cut(block.index + first, block.index + last)
    reaction = _measure_reaction(block, profile)
    command, displacement = (block.channel(name) for name in CONTROL_CHANNELS[:2])
    has_accelerometer = CONTROL_CHANNELS[2] in block.channels
    if has_accelerometer:
        acceleration = block.channel(CONTROL_CHANNELS[2])
    else:
        band_hz = 0.0, min(HIGHEST_HZ, MAX_RATE_SHARE * block.rate_hz)
        projection = BandProjection(len(block), block.rate_hz, band_hz)
        acceleration = projection.to_samples(projection.differentiate(displacement))
    motion = TableRehearsal(
        block.rate_hz, command, displacement, acceleration, reaction, has_accelerometer
    )
    return block, motion


def read_played_drive(recording: Recording) -> tuple[Float1D, PlayedDrive]:
    """Return the target displacement of a history in m, (sample,), and its run.

    InputError if the recording is not that of a history that was played to its end.
    """
    profile = _read_profile(recording)
    if not isinstance(profile.excitation, History):
        raise InputError(
            "the recording is not that of a displacement history", where=recording.path
        )
    whole = _find_whole_block(recording)
    played = np.flatnonzero(whole.is_history)
    plan, rate_hz = profile.plan, whole.rate_hz
    if played.size == 0 or int(played[0]) + plan.target_m.size > len(whole):
        raise InputError("its history was not played to the end", where=recording.path)
    first = whole.index + int(played[0])
    block = whole.cut(first, first + plan.target_m.size)
    displacement, acceleration = (block.channel(name) for name in CONTROL_CHANNELS[1:])
    resting = whole.cut(whole.index, whole.index + round(NOISE_S * rate_hz))
    noise_m, noise_m_s2 = (float(resting.channel(name).std()) for name in CONTROL_CHANNELS[1:])
    return plan.target_m, PlayedDrive(
        plan.history_m,
        fuse_displacement(displacement, acceleration, rate_hz),
        _measure_reaction(block, profile),
        noise_m,
        noise_m_s2,
    )


def fuse_displacement(displacement: Float1D, acceleration: Float1D, rate_hz: float) -> Float1D:
    """Return the displacement in m from a laser below CROSSOVER_HZ, an accelerometer above."""
    count = displacement.size
    frequency_hz = np.fft.rfftfreq(count, 1.0 / rate_hz)
    share = np.clip(0.5 + (frequency_hz - CROSSOVER_HZ) / (2.0 * BLEND_HZ), 0.0, 1.0)
    square = np.where(frequency_hz > 0.0, (math.tau * frequency_hz) ** 2, 1.0)
    fast = -np.fft.rfft(acceleration - acceleration.mean()) / square
    spectrum = (1.0 - share) * np.fft.rfft(displacement) + share * fast
    fused: Float1D = np.fft.irfft(spectrum, count)
    return fused


def _measure_reaction(block: Block, profile: Profile) -> Float1D:
    """Return the specimen's force on the table by its acceleration, N, (sample,); 0 without one."""
    if MASS_CHANNEL not in block.channels:
        return np.zeros(len(block))
    reaction: Float1D = -profile.specimen.mass_kg * block.channel(MASS_CHANNEL)
    return reaction


def _read_profile(recording: Recording) -> Profile:
    return parse_toml(recording.start.profile_toml, Profile, str(recording.path))


def _find_whole_block(recording: Recording, needed: Sequence[str] = CONTROL_CHANNELS) -> Block:
    """Return the measured samples; InputError if some are missing, or a needed channel."""
    blocks = recording.contiguous_blocks("meas")
    if len(blocks) != 1:
        raise InputError(
            f"its measured samples are in {len(blocks)} parts",
            where=recording.path,
            remedy="record the motion again without losses",
        )
    missing = [name for name in needed if name not in blocks[0].channels]
    if missing:
        raise InputError(f"it has no {', '.join(missing)}", where=recording.path)
    used = [name for name in (*CONTROL_CHANNELS, MASS_CHANNEL) if name in blocks[0].channels]
    for name in used:
        lost = np.flatnonzero(~np.isfinite(blocks[0].channel(name)))
        if lost.size:
            raise InputError(
                f"{lost.size} samples were lost or clipped, the first at "
                f"{lost[0] / blocks[0].rate_hz:.1f} s",
                where=recording.path,
                key=name,
                remedy="leave that part out at the import, or record the motion again in the range "
                "of the sensor",
            )
    return blocks[0]
