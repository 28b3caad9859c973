"""Commands `table-drive` and `table-twin`."""

from pathlib import Path
from typing import Annotated

import typer

from twin.options import (
    JsonOption,
    MeasuredLogArguments,
    OutOption,
    ProfileArgument,
    Speed,
    TableOption,
    parse_measured_path,
    parse_run_path,
)


def table_drive_command(
    profile: ProfileArgument,
    twin: Annotated[
        Path, typer.Option("--table-twin", metavar="FILE", help="File of `shaketwin table-twin`.")
    ],
    band_hz: Annotated[
        tuple[float, float] | None,
        typer.Option(
            "--band",
            metavar="LOW HIGH",
            help="Frequencies to be right, in Hz; omitted: tracking.band_hz of the profile.",
        ),
    ] = None,
    out: OutOption = None,
    table: TableOption = None,
    after: Annotated[
        Path | None,
        typer.Option(
            "--after",
            metavar="LOG",
            parser=parse_run_path,
            help="Correct the drive of this run by what its table lacked.",
        ),
    ] = None,
    iterate: Annotated[
        int | None,
        typer.Option("--iterate", min=0, max=20, help="Run it, and so often a corrected drive."),
    ] = None,
    speed: Annotated[
        Speed, typer.Option("--speed", help="Of the runs: in real time, or as fast as possible.")
    ] = Speed.realtime,
) -> None:
    """Compute the command by which the table follows a record, on the table's twin."""
    from twin.earthquakes.command import compute_drive_command
    from twin.earthquakes.task import TableDriveOptions

    options = TableDriveOptions(profile, twin, band_hz, table, after)
    raise typer.Exit(compute_drive_command(options, out, iterate, speed is Speed.max))


def table_twin_command(
    logs: MeasuredLogArguments,
    out: Annotated[
        Path, typer.Option("--out", metavar="FILE", help="New .toml file for the table's twin.")
    ] = Path("table.toml"),
    with_effects: Annotated[
        bool,
        typer.Option(
            "--effects/--no-effects", help="Name the effects that the table's twin lacks."
        ),
    ] = True,
    judge: Annotated[
        list[Path] | None,
        typer.Option(
            "--judge",
            metavar="LOG...",
            parser=parse_measured_path,
            help="Logs that are not fitted and judge the twin; omitted: parts of the fitted ones.",
        ),
    ] = None,
    band_hz: Annotated[
        tuple[float, float] | None,
        typer.Option(
            "--band",
            metavar="LOW HIGH",
            help="Frequencies of fit and judgement, in Hz; omitted: where the table follows.",
        ),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Identify the table itself from its logs: response, friction, oil, valve, loop, effects."""
    from twin.earthquakes.command import identify_table_command
    from twin.earthquakes.task import TableTwinOptions

    options = TableTwinOptions(tuple(logs), with_effects, tuple(judge or ()), band_hz)
    raise typer.Exit(identify_table_command(options, out, json))


def record_command(
    spectrum: Annotated[
        Path, typer.Argument(metavar="SPECTRUM", help="CSV file with `frequency_hz` and `sa_g`.")
    ],
    like: Annotated[
        Path,
        typer.Option(
            "--like", metavar="PROFILE", help="Test that gives rig, model, specimen and sampling."
        ),
    ],
    out: OutOption = None,
    table: TableOption = None,
    duration_s: Annotated[
        float, typer.Option("--duration", min=1.0, max=600.0, help="In s.")
    ] = 30.0,
    strong_s: Annotated[float, typer.Option("--strong", help="Strong part in s.")] = 20.0,
    rise_s: Annotated[float, typer.Option("--rise", help="Before the strong part, in s.")] = 4.0,
    damping: Annotated[float, typer.Option(min=0.001, max=0.5, help="Ratio.")] = 0.05,
    aim: Annotated[
        float, typer.Option(min=0.5, max=2.0, help="Ordinates over the required ones, about.")
    ] = 1.08,
    seed: Annotated[int, typer.Option(min=0, help="Of the random phases.")] = 1,
    count: Annotated[int, typer.Option(min=1, max=20, help="Records.")] = 1,
) -> None:
    """Make records compatible with a required response spectrum, and a test of each."""
    from twin.earthquakes.command import make_records_command
    from twin.earthquakes.spectrum_record import RecordShape, SpectrumRecordOptions

    shape = RecordShape(duration_s, strong_s, rise_s, damping, aim, seed, count)
    options = SpectrumRecordOptions(spectrum, like, shape, table)
    raise typer.Exit(make_records_command(options, out))
