"""Commands for the hardware; each imports its implementation when called."""

from pathlib import Path
from typing import Annotated

import typer

from twin.cli.examples import complete_names, describe_names

PLAN_PANEL = "Before a test"
hardware_app = typer.Typer()


@hardware_app.command("check", rich_help_panel=PLAN_PANEL)
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
        from twin.rig.check import check_profile as preflight

        preflight(profile, table, out)
    elif profile is None and table is not None and out is None:
        from twin.rig.check_table import check_wiring

        raise typer.Exit(check_wiring(table, unattended, json))
    else:
        from table_io.errors import InputError

        raise InputError(
            "these arguments do not go together",
            where="check",
            allowed="PROFILE [--table NAME] [--out DIR] to check a test, or "
            "--table NAME [--unattended] [--json] to check the wiring of a table",
        )


@hardware_app.command("calibrate", rich_help_panel=PLAN_PANEL)
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
    from twin.rig.calibrate import CalibrationRequest
    from twin.rig.calibrate import calibrate_sensor as command

    request = CalibrationRequest(
        channel, table, points, shunt, tolerance, applied_sd, unattended, out
    )
    raise typer.Exit(command(request))


@hardware_app.command("devices", rich_help_panel=PLAN_PANEL)
def devices_command(
    ni: Annotated[
        str | None,
        typer.Option("--ni", metavar="HOST:PORT", help="Also query this NI gRPC device server."),
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """List rig files, NI and openDAQ devices that respond, with their channels."""
    from twin.rig.devices import print_devices as command

    command(ni, json)
