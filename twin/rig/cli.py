"""Commands `table`, `check`, `tare`, `calibrate` and `devices`: the machine and its sensors."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from table_io.errors import InputError
from twin.options import JsonOption, complete_names, describe_names


def table_command(
    table: Annotated[str, typer.Option("--table", help="Rig file or name.")] = "machine",
    listen: Annotated[
        str | None,
        typer.Option(
            "--listen", help="tcp/127.0.0.1:PORT or unix/PATH, instead of the rig file's."
        ),
    ] = None,
    log: Annotated[
        Path | None, typer.Option("--log", help="New file for the flight recorder: every sample.")
    ] = None,
    time_scale: Annotated[
        float, typer.Option("--time-scale", help="Speed relative to real time, for tests.")
    ] = 1.0,
    profile: Annotated[
        str,
        typer.Option("--profile", help="Test profile whose specimen is on the table."),
    ] = "quickstart",
    play: Annotated[
        Path | None,
        typer.Option(
            "--play",
            metavar="FILE",
            help="Drive file that the simulated external controller plays.",
        ),
    ] = None,
    ppm: Annotated[
        float, typer.Option("--ppm", help="Clock error of that controller in parts per million.")
    ] = 0.0,
    after: Annotated[
        float,
        typer.Option(
            "--after",
            metavar="S",
            help="Delay in s between the start of acquisition and its drive.",
        ),
    ] = 5.0,
) -> None:
    """Start the simulated table as a separate machine, for `run PROFILE --table machine`."""
    from twin.rig.table import ExternalController, serve_table

    controller = ExternalController(play, ppm, after)
    serve_table(table, listen, log, time_scale, sys.stdout, profile, controller)


def check_command(
    profile: Annotated[
        Path | None,
        typer.Argument(
            metavar="[PROFILE]",
            help=describe_names("Test profile", "tests"),
            autocompletion=complete_names("tests"),
        ),
    ] = None,
    table: Annotated[
        str | None, typer.Option("--table", help="Rig file or name, instead of the profile's.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for a plot of the drive.")
    ] = None,
    unattended: Annotated[
        bool,
        typer.Option(
            "--unattended", help="Without PROFILE: skip the checks that need an operator."
        ),
    ] = False,
    json: Annotated[bool, typer.Option("--json", help="Without PROFILE: print JSON.")] = False,
) -> None:
    """Check a test before anything moves: print plan and margins, plot the drive.

    Without PROFILE: check the wiring of --table NAME at rest and, with an operator, by tapping the
    table and the mass; the table is not driven.
    """
    if profile is not None and not (unattended or json):
        from twin.rig.check import print_check

        print_check(profile, table, out)
    elif profile is None and table is not None and out is None:
        from twin.rig.wiring_table import print_wiring_check

        raise typer.Exit(print_wiring_check(table, unattended, json))
    else:
        raise InputError(
            "these arguments do not go together",
            where="check",
            allowed="PROFILE [--table NAME] [--out DIR] to check a test, or "
            "--table NAME [--unattended] [--json] to check the wiring of a table",
        )


def calibrate_command(
    channel: Annotated[str, typer.Argument(metavar="CHANNEL", help="Channel of the sensor.")],
    table: Annotated[str, typer.Option("--table", help="Rig file or name.")],
    points: Annotated[
        str,
        typer.Option(
            "--points", metavar="A,B,...", help="Applied values in the unit of the channel."
        ),
    ] = "",
    shunt: Annotated[
        bool, typer.Option("--shunt", help="Calibrate by the shunt of the sensor: off, then on.")
    ] = False,
    tolerance: Annotated[
        float | None,
        typer.Option(
            "--tolerance", help="Allowed deviation of the sensitivity in per cent; default: 1."
        ),
    ] = None,
    applied_sd: Annotated[
        float, typer.Option("--applied-sd", help="Standard uncertainty of the applied values.")
    ] = 0.0,
    unattended: Annotated[
        bool, typer.Option("--unattended", help="Five seconds per point, without prompts.")
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option("--out", help="New file for the record; default: next to the rig file."),
    ] = None,
) -> None:
    """Calibrate a sensor: measure sensitivity and offset, compare with the rig file.

    Leaves a dated record, which goes into every recording from then on; the rig file is not edited.
    """
    from twin.rig.calibrate import CalibrationOptions, print_calibration

    options = CalibrationOptions(channel, table, points, shunt, tolerance, applied_sd, out)
    raise typer.Exit(print_calibration(options, unattended))


def tare_command(
    table: Annotated[str, typer.Option("--table", help="Rig file or name.")],
    yes: Annotated[
        bool, typer.Option("--yes", help="The bumpers are clear of the mass: do not ask.")
    ] = False,
    temperature: Annotated[
        float | None,
        typer.Option("--temperature", metavar="C", help="Of the laboratory, into the record."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", help="New file for the record; default: next to the rig file."),
    ] = None,
) -> None:
    """Tare all sensors with the bumpers clear of the mass; runs with G <= 0 need it.

    Leaves a dated record next to the rig file; nothing is driven. A run with precompressed bumpers
    takes the offsets of its load cells and displacements from the newest record.
    """
    from twin.rig.tare import TareOptions, print_tare

    raise typer.Exit(print_tare(TareOptions(table, temperature, out), yes))


def devices_command(
    ni: Annotated[
        str | None,
        typer.Option("--ni", metavar="HOST:PORT", help="Also query this NI gRPC device server."),
    ] = None,
    json: JsonOption = False,
) -> None:
    """List rig files, NI and openDAQ devices that respond, with their channels."""
    from twin.rig.devices import print_devices

    print_devices(ni, json)
