"""Command that monitors a running test; it imports its implementation when called."""

from pathlib import Path
from typing import Annotated

import typer

from twin.cli.credential_commands import KeysOption, read_keys_option

LIVE_PANEL = "Drive and compute"
monitor_app = typer.Typer()


@monitor_app.command("monitor", rich_help_panel=LIVE_PANEL)
def monitor_command(
    connect: Annotated[
        str, typer.Option("--connect", help="Endpoint of the running test.")
    ] = "tcp/127.0.0.1:7447",
    rig: Annotated[str, typer.Option("--rig", help="Name of the running rig.")] = "simulated",
    wait: Annotated[bool, typer.Option("--wait", help="Wait for a test to begin.")] = False,
    once: Annotated[
        bool, typer.Option("--once", help="Print one screen as text and exit.")
    ] = False,
    picture: Annotated[
        Path | None,
        typer.Option(
            "--picture", metavar="FILE.svg", help="Write one screen to a new file and exit."
        ),
    ] = None,
    keys: KeysOption = None,
) -> None:
    """Monitor a running test, or a published replay, on this terminal.

    Keys: q quits; h, r, s, a hold, resume, stop, abort the test, each once confirmed with y.
    """
    from twin.monitor.app import run_monitor as command

    command(connect, rig, wait, once, picture, read_keys_option(keys))
