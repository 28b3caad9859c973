"""The command that watches a running test; heavy imports stand inside it."""

from pathlib import Path
from typing import Annotated

import typer

from twin.service.cli_keys import WithKeys, read_given

LIVE = "Drive and compute"
watching = typer.Typer()


@watching.command(rich_help_panel=LIVE)
def monitor(
    connect: Annotated[
        str, typer.Option("--connect", help="Bus of the running test, here or elsewhere.")
    ] = "tcp/127.0.0.1:7447",
    rig: Annotated[str, typer.Option("--rig", help="Name of the running rig.")] = "simulated",
    wait: Annotated[bool, typer.Option("--wait", help="For a test to begin there.")] = False,
    once: Annotated[
        bool, typer.Option("--once", help="One picture of now as text, and end.")
    ] = False,
    picture: Annotated[
        Path | None,
        typer.Option("--picture", metavar="FILE.svg", help="One picture of now as a new file."),
    ] = None,
    keys: WithKeys = None,
) -> None:
    """A running test on this terminal, live, here or on another machine; or a replay on the bus.

    Keys: q quits; h, r, s, a hold, resume, stop, abort the test, each once confirmed with y.
    """
    from twin.service.monitor.watching import monitor as command

    command(connect, rig, wait, once, picture, read_given(keys))
