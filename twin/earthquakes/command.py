"""`table-twin` and `table-drive`: identify the table, compute the command by which it follows."""

import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.table import Table

from table_io.block import Block, Float1D, join_blocks
from table_io.config.base import parse_toml
from table_io.config.excitation import (
    History,
    add_drive_margin,
    history_acceleration,
)
from table_io.config.excitation.drive_file import format_drive
from table_io.config.folders import resolve_config
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig
from table_io.errors import InputError
from twin.earthquakes.drive_computation import PlayedDrive, compute_drive, correct_played_drive
from twin.earthquakes.rehearsal import read_played_drive, read_table_motion
from twin.earthquakes.table_effects import LIBRARY, describe_discovery, identify_table_and_effects
from twin.earthquakes.table_file import TableTwinConfig, format_table_twin, load_table_twin
from twin.earthquakes.table_identification import identify_table
from twin.earthquakes.table_model import TableModel, TableParameters
from twin.results.recordings import open_recording
from twin.results.table_motion import summarise_tracking
from twin.results.tracking import find_band
from twin.setup.folders import make_output_folder
from twin.setup.run_config import RunConfig, make_run_id, read_run_config
from twin.system.terminal import console, print_line, print_table, show_status

STOP_RATIO = 1.2  # of the smallest error so far: beyond it an iteration diverges
DRIVE_FILE, PROFILE_FILE = "drive.csv", "profile.toml"
UNITS = {
    "gain_1_s": "1/s", "delay_s": "s", "pressure_feedback_s": "s", "presliding_m": "m",
    "stribeck_speed_m_s": "m/s", "friction_n": "N", "static_excess_n": "N", "stall_force_n": "N",
    "stick_damping_n_s_m": "N s/m", "viscous_n_s_m": "N s/m",
    "valve_hz": "Hz", "oil_hz": "Hz", "frame_hz": "Hz",
}  # fmt: skip
UNITS |= {parameter.name: parameter.unit for effect in LIBRARY for parameter in effect.parameters}


def identify_table_command(logs: Sequence[Path], out: Path, with_effects: bool = True) -> int:
    """Identify the twin of the table and its missing effects from a rehearsal; write a new file."""
    from twin.earthquakes.table_twin_figure import draw_table_twin

    if out.suffix != ".toml":
        raise InputError("is no name for a table's twin", where=out, allowed="a file NAME.toml")
    drawing = out.with_suffix(".png")
    for path in (out, drawing):
        if path.exists():
            raise InputError("exists already", where=path, remedy="name a new file with --out")
    if len(logs) != 1:
        raise InputError(f"{len(logs)} recordings", allowed="one rehearsal of at most 60 s")
    recording = open_recording(logs[0])
    rig = parse_toml(recording.start.rig_toml, RigConfig, str(logs[0]))
    stall_kn = rig.table_response.stall_force_kn
    rehearsal, mass_kg = read_table_motion(recording), rig.moving_mass_kg
    stall_n = math.inf if stall_kn is None else 1e3 * stall_kn
    discovery, effects = None, []
    with show_status("identifying the table") as show_part:
        if with_effects:
            identification, discovery = identify_table_and_effects(
                rehearsal, mass_kg, stall_n, report=show_part
            )
            effects = [finding.id for finding in discovery.findings]
        else:
            identification = identify_table(rehearsal, mass_kg, stall_n)
    title = f"{rig.title}, from {recording.run}"
    out.write_text(format_table_twin(title, identification, effects), encoding="utf-8")
    table = Table("parameter", "value", "95 %", "unit", title=title)
    absent = TableParameters()._asdict()
    for name, value in identification.model.parameters._asdict().items():
        width = identification.half_widths.get(name)
        if width is None and value == absent[name]:
            continue  # of an effect that the table does not show
        table.add_row(
            name.removesuffix("_1_s"),
            f"{value:.4g}",
            "stated" if width is None else f"+- {width:.2g}",
            UNITS.get(name, ""),
        )
    print_table(console, table)
    for line in describe_discovery(discovery) if discovery is not None else ():
        print_line(line)
    draw_table_twin(identification.model, rehearsal, title, drawing)
    print_line(f"it leaves {100 * identification.residual:.2g} % of the measured motion -> {out}")
    print_line(f"frequency response and steps -> {drawing}")
    return 0


@dataclass(frozen=True, eq=False)
class DriveTask:
    """Target of a test, the specimen's force on the table during it, and the table's twin."""

    config: RunConfig
    profile_path: Path
    target_m: Float1D
    reaction_n: Float1D
    model: TableModel
    twin: TableTwinConfig
    band_hz: tuple[float, float]
    table: str | None

    @property
    def rate_hz(self) -> float:
        return self.config.profile.acquisition.rate_hz


def compute_drive_command(
    profile: Path,
    twin_file: Path,
    band_hz: tuple[float, float] | None,
    out: Path | None,
    table: str | None,
    after: Path | None,
    iterations: int | None,
    unpaced: bool,
) -> int:
    """Write a profile with the drive for its target; with iterations, run it and correct it."""
    task = _prepare_task(profile, twin_file, band_hz, table)
    if after is None:
        with show_status("computing the drive on the twin of the table"):
            drive = compute_drive(
                task.model, task.target_m, task.rate_hz, task.band_hz, task.reaction_n
            )
        command = drive.command_m
        print_line(f"error that the twin expects in the band: {100 * drive.expected_error:.2g} %")
    else:
        command = _correct_after(task, after)
    folder = make_output_folder(out, make_run_id(f"{task.config.name}-drive"))
    if iterations is None:
        written = write_driven_profile(task, command, folder)
        print_line(f"{written}; next: shaketwin run {written}")
        return 0
    return _iterate(task, command, folder, table, iterations, unpaced)


def write_driven_profile(task: DriveTask, command_m: Float1D, folder: Path) -> Path:
    """Write the profile with its files and the drive to a folder; return the profile's path.

    InputError if the drive exceeds a limit of the rig, or a file cannot be copied.
    """
    folder.mkdir(parents=True, exist_ok=True)
    profile, source = task.config.profile, task.profile_path.parent
    text = re.sub(r"(?m)^drive\s*=.*\n", "", task.profile_path.read_text(encoding="utf-8"))
    text, count = re.subn(
        r"(?m)^\[excitation\][^\n]*$",
        lambda header: f'{header[0]}\ndrive = "{DRIVE_FILE}"',
        text,
        count=1,
    )
    if count == 0:
        raise InputError(
            "no line [excitation] to which the drive can be added",
            where=task.profile_path,
            remedy="write the excitation as a table of its own",
        )
    for key, name in (("rig", task.table or profile.rig), ("model", profile.model)):
        # A path is relative to the profile, which is written elsewhere.
        paths = [path for path in (source / name, Path(name)) if path.is_file()]
        value = str(paths[0].resolve()) if name.endswith(".toml") and paths else name
        # First, since what follows a table would belong to it.
        text = re.sub(rf"(?m)^{key}\s*=.*\n", "", text)
        text = f"{key} = {json.dumps(value)}\n{text}"
    for name in _list_files(profile):
        if Path(name).is_absolute():
            continue
        copy = folder / name
        if not copy.resolve().is_relative_to(folder.resolve()):
            raise InputError(
                f"{name} lies outside the folder of the profile",
                where=task.profile_path,
                remedy="put it next to the profile",
            )
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_bytes((source / name).read_bytes())
    comment = f"drive of {task.config.name} on {task.twin.title}"
    drive = format_drive(command_m, task.target_m, comment)
    (folder / DRIVE_FILE).write_text(drive, encoding="utf-8")
    path = folder / PROFILE_FILE
    path.write_text(text, encoding="utf-8")
    read_run_config(path, task.table)  # InputError beyond the limits of the rig
    return path


def _list_files(profile: Profile) -> list[str]:
    """Return the names of the files that a profile needs, without its drive."""
    tables = (profile.excitation, profile.tracking)
    names = [getattr(table, key) for table in tables for key in table.FILE_KEYS if key != "drive"]
    return [name for name in names if name is not None]


def _prepare_task(
    profile: Path, twin_file: Path, band_hz: tuple[float, float] | None, table: str | None
) -> DriveTask:
    path = resolve_config(profile, "tests")
    config = read_run_config(path, table)
    excitation = config.profile.excitation
    if not isinstance(excitation, History):
        raise InputError(
            "a drive is computed for a displacement history",
            where=path,
            key="excitation.kind",
            value=excitation.kind,
            remedy="the level of a stepped sine is tuned while it runs",
        )
    twin = load_table_twin(twin_file)
    rate_hz = config.profile.acquisition.rate_hz
    target = add_drive_margin(excitation.displacement(rate_hz), rate_hz)
    band_hz = band_hz or config.profile.tracking.band_hz
    if band_hz is None:
        band_hz = find_band(history_acceleration(target, rate_hz), rate_hz)
    with show_status("simulating the specimen"):
        reaction = _simulate_reaction(config, target.size)
    return DriveTask(config, path, target, reaction, twin.build_model(), twin, band_hz, table)


def _simulate_reaction(config: RunConfig, count: int) -> Float1D:
    """Return the force of the specimen on a table that follows the target, N, (sample,)."""
    from twin.setup.unpaced import generate_ideal_twin

    blocks = (item for item in generate_ideal_twin(config) if isinstance(item, Block))
    predicted = join_blocks([block for block in blocks if block.stream == "pred"])
    acceleration = predicted.channel("free/mass_acc_m_s2")
    first = int(np.flatnonzero(predicted.is_history)[0])
    margin = (count - config.profile.plan.target_m.size) // 2  # 0 if it has a drive already
    reaction = np.zeros(count)
    played = -config.profile.specimen.mass_kg * acceleration[first : first + count - margin]
    reaction[margin : margin + played.size] = played
    return reaction


def _correct_after(task: DriveTask, log: Path) -> Float1D:
    """Return the drive of a recording, corrected by what its table lacked."""
    target, run = read_played_drive(open_recording(log))
    if target.size != task.target_m.size or not np.allclose(target, task.target_m, atol=1e-7):
        raise InputError(
            "the recording is that of another target",
            where=log,
            remedy="give a run of a drive for this profile, at the same level",
        )
    return _correct(task, run)


def _correct(task: DriveTask, run: PlayedDrive) -> Float1D:
    return correct_played_drive(
        run, task.model, task.target_m, task.reaction_n, task.rate_hz, task.band_hz
    )


def _iterate(
    task: DriveTask,
    command_m: Float1D,
    folder: Path,
    table: str | None,
    iterations: int,
    unpaced: bool,
) -> int:
    """Run the drive and correct it, until the error grows; return the exit code."""
    from twin.live.run_command import run_test
    from twin.transport.endpoint import DEFAULT_ENDPOINT

    rows = Table("run", "rms error", "peak ratio", "SA within 10 %", title="iteration, in the band")
    errors: list[float] = []
    for number in range(iterations + 1):
        profile_path = write_driven_profile(task, command_m, folder / f"drive-{number}")
        run_folder = folder / f"run-{number}"
        code = run_test(profile_path, run_folder, unpaced, None, table, False, DEFAULT_ENDPOINT)
        if code:
            return code
        recording = open_recording(run_folder)
        profile = parse_toml(recording.start.profile_toml, Profile, str(profile_path))
        tracking = summarise_tracking(recording, profile)
        if tracking is None:
            raise InputError("the run has no motion of the table to judge", where=run_folder)
        errors.append(tracking["acc_rms_error_band"])
        rows.add_row(
            str(number),
            f"{100 * errors[-1]:.2f} %",
            f"{100 * tracking['pga_ratio_band']:.1f} %",
            f"{100 * tracking['sa_share']:.0f} %",
        )
        if number and errors[-1] > STOP_RATIO * min(errors):
            console.print("the error grows: no further iteration")
            break
        command_m = _correct(task, read_played_drive(recording)[1])
    print_table(console, rows)
    best = int(np.argmin(errors))
    print_line(f"best drive: {folder / f'drive-{best}' / PROFILE_FILE}")
    return 0
