"""`table-twin` and `table-drive`: identify the table, compute the command by which it follows."""

from pathlib import Path

import numpy as np
from rich.table import Table

from table_io.config.base import parse_toml
from table_io.config.profile import Profile
from table_io.errors import InputError
from table_io.units import GRAVITY_M_S2
from twin.earthquakes.figures import draw_table_twin
from twin.earthquakes.result import (
    PROFILE_FILE,
    DriveResult,
    JudgedErrors,
    TableTwinReport,
    TableTwinResult,
)
from twin.earthquakes.spectrum_record import (
    SpectrumRecord,
    SpectrumRecordOptions,
    compute_spectrum_records,
)
from twin.earthquakes.table_effects import LIBRARY
from twin.earthquakes.table_evidence import describe_discovery
from twin.earthquakes.table_identification import TableIdentification
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
from twin.setup.run_config import make_run_id, read_run_config
from twin.system.terminal import console, error_console, print_line, print_table, show_status
from twin.transport.endpoint import DEFAULT_ENDPOINT

REFUSED_CODE = 2  # as of any bad input
STOP_RATIO = 1.2  # of the smallest error so far: beyond it an iteration diverges
UNITS = {
    "gain_1_s": "1/s", "delay_s": "s", "pressure_feedback_s": "s", "presliding_m": "m",
    "stribeck_speed_m_s": "m/s", "friction_n": "N", "static_excess_n": "N", "stall_force_n": "N",
    "stick_damping_n_s_m": "N s/m", "viscous_n_s_m": "N s/m",
    "valve_hz": "Hz", "oil_hz": "Hz", "frame_hz": "Hz",
}  # fmt: skip
UNITS |= {parameter.name: parameter.unit for effect in LIBRARY for parameter in effect.parameters}


def identify_table_command(options: TableTwinOptions, out: Path, as_json: bool = False) -> int:
    """Identify the twin of the table, judge it and write a new file; return the exit code.

    A twin that loses to a baseline is not written: 2.
    """
    try:
        result = _identify_and_write(options, out, quiet=as_json)
    except InputError as error:
        if not as_json:
            raise
        print(TableTwinReport(written=False, reason=str(error), runs=()).model_dump_json(indent=1))
        return REFUSED_CODE
    judgement = result.judgement
    reason = judgement.explain_refusal()
    if as_json:
        report = TableTwinReport(written=not reason, reason=reason, runs=judgement.runs)
        print(report.model_dump_json(indent=1))
    elif reason:
        error_console.print(f"nothing is written: {reason}", highlight=False, soft_wrap=True)
    return REFUSED_CODE if reason else 0


def _identify_and_write(options: TableTwinOptions, out: Path, quiet: bool) -> TableTwinResult:
    """Return the twin of the table, written and drawn unless it is refused."""
    if out.suffix != ".toml":
        raise InputError("is no name for a table's twin", where=out, allowed="a file NAME.toml")
    drawing = out.with_suffix(".png")
    for path in (out, drawing):
        if path.exists():
            raise InputError("exists already", where=path, remedy="name a new file with --out")
    with show_status("identifying the table") as show_part:
        result = identify_table(options, show_part)
    if not quiet:
        _print_twin(result)
    if not result.judgement.explain_refusal():
        result.save(out)
        draw_table_twin(result.model, result.rehearsal, result.title, drawing)
        if not quiet:
            print_line(f"it leaves {100 * result.residual:.2g} % of the measured motion -> {out}")
            print_line(f"frequency response and steps -> {drawing}")
    return result


def _print_twin(result: TableTwinResult) -> None:
    """Print parameters and effects of a hydraulic twin, and the judgement of any."""
    if result.identification is not None:
        print_table(console, _make_parameter_table(result.identification, result.title))
    for line in describe_discovery(result.discovery) if result.discovery is not None else ():
        print_line(line)
    judgement = result.judgement
    structures = Table("structure", "error, held out", title="structures of the twin")
    for name, error in judgement.held_out.items():
        used = " (used)" if name == judgement.structure else ""
        structures.add_row(f"{name.replace('_', ' ')}{used}", f"{100 * error:.3g} %")
    print_table(console, structures)
    names = list(JudgedErrors.model_fields)
    columns = ("log", "band in Hz", *(name.replace("_", " ") for name in names))
    runs = Table(*columns, title=f"error of the acceleration on {judgement.on}")
    for run in judgement.runs:
        errors = (f"{100 * getattr(run.error, name):.3g} %" for name in names)
        runs.add_row(run.log, f"{run.band_hz[0]:g} to {run.band_hz[1]:g}", *errors)
    print_table(console, runs)
    if estimate := judgement.estimate:
        figures = ", ".join(f"{100 * error:.3g} %" for error in estimate.errors)
        print_line(
            f"with the measured {', '.join(estimate.channels)} the error would be {figures}: an "
            "estimate of the motion, no prediction"
        )


def _make_parameter_table(identification: TableIdentification, title: str) -> Table:
    """Return the table of the parameters of a twin with their intervals."""
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


def make_records_command(options: SpectrumRecordOptions, out: Path | None) -> int:
    """Write records of a required spectrum with their tests; 2 if the rig cannot play one."""
    folder = make_output_folder(out, make_run_id(f"records-{options.spectrum.stem}"))
    with show_status("matching the required spectrum") as show_part:
        result = compute_spectrum_records(options, show_part)
    paths = result.save(folder)
    refused = 0
    for record, path in zip(result.records, paths, strict=True):
        print_line(
            f"{path.name}: {record.ratios.min():.3f} to {record.ratios.max():.3f} of the required "
            f"spectrum at {record.ratios.size} ordinates, PGA "
            f"{record.pga_m_s2 / GRAVITY_M_S2:.3g} g, {record.significant_s:.3g} s from 5 to 95 % "
            "of its energy"
        )
        try:
            _check_record(record, path)
        except InputError as error:
            refused += 1
            error_console.print(str(error), highlight=False, soft_wrap=True)
    if len(paths) > 1:
        print_line(f"largest correlation of two records: {result.largest_correlation:.2g}")
    print_line(f"next: shaketwin table-drive {paths[0]} --table-twin FILE")
    return REFUSED_CODE if refused else 0


def _check_record(record: SpectrumRecord, profile: Path) -> None:
    """Raise InputError if a record misses its spectrum, or its test is beyond the rig."""
    config = read_run_config(profile).profile.tracking
    low, high = float(record.ratios.min()), float(record.ratios.max())
    if low < config.required_lower or high > config.required_upper:
        raise InputError(
            f"no record found: the ordinates lie from {low:.3f} to {high:.3f} of the required ones",
            where=profile,
            allowed=f"{config.required_lower:g} to {config.required_upper:g}",
            remedy="a spectrum this steep belongs to no motion of this damping: make it flatter",
        )
