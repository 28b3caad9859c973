"""`table-twin` and `table-drive`: identify the table, compute the command by which it follows."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.table import Table

from table_io.config.base import parse_toml
from table_io.config.profile import Profile
from table_io.errors import InputError
from twin.earthquakes.figures import draw_table_twin
from twin.earthquakes.result import PROFILE_FILE, DriveResult, TableTwinResult
from twin.earthquakes.table_effects import LIBRARY, describe_discovery
from twin.earthquakes.table_model import TableParameters
from twin.earthquakes.task import (
    TableDriveOptions,
    TableTwinOptions,
    compute_drive,
    identify_table,
    prepare_drive_computation,
)
from twin.live.run_command import run_test
from twin.results.recordings import open_recording
from twin.results.table_motion import summarise_tracking
from twin.setup.folders import make_output_folder
from twin.setup.run_config import make_run_id
from twin.system.terminal import console, print_line, print_table, show_status
from twin.transport.endpoint import DEFAULT_ENDPOINT

STOP_RATIO = 1.2  # of the smallest error so far: beyond it an iteration diverges
UNITS = {
    "gain_1_s": "1/s", "delay_s": "s", "pressure_feedback_s": "s", "presliding_m": "m",
    "stribeck_speed_m_s": "m/s", "friction_n": "N", "static_excess_n": "N", "stall_force_n": "N",
    "stick_damping_n_s_m": "N s/m", "viscous_n_s_m": "N s/m",
    "valve_hz": "Hz", "oil_hz": "Hz", "frame_hz": "Hz",
}  # fmt: skip
UNITS |= {parameter.name: parameter.unit for effect in LIBRARY for parameter in effect.parameters}


def identify_table_command(logs: Sequence[Path], out: Path, with_effects: bool = True) -> int:
    """Identify the twin of the table and its missing effects from a rehearsal; write a new file."""
    if out.suffix != ".toml":
        raise InputError("is no name for a table's twin", where=out, allowed="a file NAME.toml")
    drawing = out.with_suffix(".png")
    for path in (out, drawing):
        if path.exists():
            raise InputError("exists already", where=path, remedy="name a new file with --out")
    if len(logs) != 1:
        raise InputError(f"{len(logs)} recordings", allowed="one rehearsal of at most 60 s")
    with show_status("identifying the table") as show_part:
        result = identify_table(TableTwinOptions(logs[0], with_effects), show_part)
    result.save(out)
    print_table(console, _make_parameter_table(result))
    for line in describe_discovery(result.discovery) if result.discovery is not None else ():
        print_line(line)
    identification = result.identification
    draw_table_twin(identification.model, result.rehearsal, result.title, drawing)
    print_line(f"it leaves {100 * identification.residual:.2g} % of the measured motion -> {out}")
    print_line(f"frequency response and steps -> {drawing}")
    return 0


def _make_parameter_table(result: TableTwinResult) -> Table:
    """Return the table of the parameters of a twin with their intervals."""
    identification = result.identification
    table = Table("parameter", "value", "95 %", "unit", title=result.title)
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
    return table


def compute_drive_command(
    options: TableDriveOptions, out: Path | None, iterations: int | None, unpaced: bool
) -> int:
    """Write a profile with the drive for its target; with iterations, run it and correct it."""
    with show_status("computing the drive on the twin of the table") as show_part:
        drive = compute_drive(options, show_part)
    for note in drive.notes:
        print_line(f"warning: {note}")
    if drive.expected_error is not None:
        print_line(f"error that the twin expects in the band: {100 * drive.expected_error:.2g} %")
    folder = make_output_folder(out, make_run_id(f"{drive.config.name}-drive"))
    if iterations is None:
        written = drive.save(folder)
        print_line(f"{written}; next: shaketwin run {written}")
        return 0
    return _iterate(options, drive, folder, iterations, unpaced)


def _iterate(
    options: TableDriveOptions, drive: DriveResult, folder: Path, iterations: int, unpaced: bool
) -> int:
    """Run the drive and correct it, until the error grows; return the exit code."""
    computation = prepare_drive_computation(options)
    rows = Table("run", "rms error", "peak ratio", "SA within 10 %", title="iteration, in the band")
    errors: list[float] = []
    for number in range(iterations + 1):
        profile_path = drive.save(folder / f"drive-{number}")
        run_folder = folder / f"run-{number}"
        code = run_test(profile_path, run_folder, unpaced, None, None, False, DEFAULT_ENDPOINT)
        if code:
            return code
        recording = open_recording(run_folder)
        profile = parse_toml(recording.start.profile_toml, Profile, str(profile_path))
        tracking = summarise_tracking(recording, profile)
        if tracking is None:
            raise InputError("the run has no motion of the table to judge", where=run_folder)
        errors.append(tracking.acc_rms_error_band)
        rows.add_row(
            str(number),
            f"{100 * errors[-1]:.2f} %",
            f"{100 * tracking.pga_ratio_band:.1f} %",
            f"{100 * tracking.sa_share:.0f} %",
        )
        if number and errors[-1] > STOP_RATIO * min(errors):
            console.print("the error grows: no further iteration")
            break
        drive = computation.compute(run_folder)
    print_table(console, rows)
    best = int(np.argmin(errors))
    print_line(f"best drive: {folder / f'drive-{best}' / PROFILE_FILE}")
    return 0
