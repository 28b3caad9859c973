"""The commands about the hardware itself; heavy imports stand inside them."""

from pathlib import Path
from typing import Annotated

import typer

PLAN = "Before a test"
hardware = typer.Typer()


@hardware.command(rich_help_panel=PLAN)
def check(
    profile: Annotated[
        Path | None, typer.Argument(metavar="[PROFILE]", help="Test profile, a .toml file.")
    ] = None,
    table: Annotated[str | None, typer.Option("--table", help="Machine card instead.")] = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for the drawing of the drive.")
    ] = None,
    unattended: Annotated[
        bool, typer.Option("--unattended", help="Without PROFILE: leave out what needs a hand.")
    ] = False,
    json: Annotated[bool, typer.Option("--json", help="Without PROFILE: as JSON.")] = False,
) -> None:
    """Pre-flight only: the plan, the margins against the machine card, a drawing of the drive.

    Without PROFILE: the wiring of --table NAME at rest, and by a tap; nothing is moved.
    """
    if profile is not None and not (unattended or json):
        from twin.service.driving import check as preflight

        preflight(profile, table, out)
    elif profile is None and table is not None and out is None:
        from twin.service.wiring_check import check_wiring

        raise typer.Exit(check_wiring(table, unattended, json))
    else:
        from table_io.card import BadInput

        raise BadInput(
            "check: give a PROFILE, with --out, for the pre-flight of a test; or only --table "
            "NAME, with --unattended or --json, for the wiring of a table"
        )


@hardware.command(rich_help_panel=PLAN)
def calibrate(
    channel: Annotated[str, typer.Argument(metavar="CHANNEL", help="As on its sensor card.")],
    table: Annotated[str, typer.Option("--table", help="Machine card.")],
    points: Annotated[
        str, typer.Option("--points", metavar="A,B,...", help="What is applied, in its unit.")
    ] = "",
    shunt: Annotated[bool, typer.Option("--shunt", help="Its shunt off, then on.")] = False,
    tolerance: Annotated[
        float | None,
        typer.Option("--tolerance", help="Per cent that the sensitivity may depart: 1."),
    ] = None,
    applied_sd: Annotated[
        float, typer.Option("--applied-sd", help="Standard uncertainty of what is applied.")
    ] = 0.0,
    unattended: Annotated[
        bool, typer.Option("--unattended", help="Five seconds for each point, no Enter.")
    ] = False,
    out: Annotated[
        Path | None, typer.Option("--out", help="New file for the record, not the usual one.")
    ] = None,
) -> None:
    """A sensor's sensitivity and offset by what is applied to it, against its card.

    Leaves a dated record, which goes into every recording from then on; edits no card.
    """
    from twin.service.calibrating import Asked
    from twin.service.calibrating import calibrate as command

    asked = Asked(channel, table, points, shunt, tolerance, applied_sd, unattended, out)
    raise typer.Exit(command(asked))


@hardware.command(rich_help_panel=PLAN)
def devices(
    ni: Annotated[
        str | None, typer.Option("--ni", metavar="HOST:PORT", help="NI's gRPC device server too.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="As JSON on standard output.")] = False,
) -> None:
    """What is reachable: machine cards, NI and openDAQ devices, and what they have."""
    from twin.service.devices import devices as command

    command(ni, json)
