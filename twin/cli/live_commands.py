"""Commands that take part in a running test; each imports its implementation when called."""

import enum
from pathlib import Path
from typing import Annotated

import typer

from twin.cli.credential_commands import KeysOption, read_keys_option

LIVE_PANEL = "Drive and compute"
live_app = typer.Typer()


class RunCommand(enum.StrEnum):
    """Command to a running test."""

    hold = "hold"
    resume = "resume"
    stop = "stop"
    abort = "abort"


class RemoteRole(enum.StrEnum):
    """Role of this machine in a test that runs on another."""

    recorder = "recorder"
    twin = "twin"


@live_app.command("join", rich_help_panel=LIVE_PANEL)
@live_app.command("attend", hidden=True)  # the former name
def join_command(
    part: Annotated[RemoteRole, typer.Argument(help="Role of this machine.")],
    connect: Annotated[
        str, typer.Option("--connect", help="Endpoint of the running test.")
    ] = "tcp/127.0.0.1:7447",
    rig: Annotated[str, typer.Option("--rig", help="Name of the running rig.")] = "simulated",
    out: Annotated[Path | None, typer.Option("--out", help="New folder for the recording.")] = None,
    keys: KeysOption = None,
) -> None:
    """Record, or run the twin for, a test on another machine (`run --remote-twin`)."""
    from twin.live import join

    credentials = read_keys_option(keys)
    if part is RemoteRole.twin:
        raise typer.Exit(join.join_as_twin(connect, rig, credentials))
    raise typer.Exit(join.join_as_recorder(connect, rig, out, credentials))


@live_app.command("control", rich_help_panel=LIVE_PANEL)
@live_app.command("tell", hidden=True)  # the former name
def control_command(
    order: Annotated[RunCommand, typer.Argument(help="Command to the running test.")],
    why: Annotated[str, typer.Option("--why", help="Reason, recorded with the command.")] = "",
    connect: Annotated[
        str, typer.Option("--connect", help="Endpoint of the running test.")
    ] = "tcp/127.0.0.1:7447",
    rig: Annotated[str, typer.Option("--rig", help="Name of the running rig.")] = "simulated",
    keys: KeysOption = None,
) -> None:
    """Hold, resume, stop or abort a running test; the table always comes to rest smoothly."""
    from twin.live.control import send_command as command

    command(order.value, why, connect, rig, read_keys_option(keys))
