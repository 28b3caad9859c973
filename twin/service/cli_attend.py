"""The commands that take part in a running test; heavy imports stand inside them."""

import enum
from pathlib import Path
from typing import Annotated

import typer

from twin.service.cli_keys import WithKeys, read_given

LIVE = "Drive and compute"
attending = typer.Typer()


class Told(enum.StrEnum):
    """What can be asked of a running test."""

    hold = "hold"
    resume = "resume"
    stop = "stop"
    abort = "abort"


class Part(enum.StrEnum):
    """What a machine can do for a test that runs on another."""

    recorder = "recorder"
    twin = "twin"


@attending.command(rich_help_panel=LIVE)
def attend(
    part: Annotated[Part, typer.Argument(help="What this machine does for the running test.")],
    connect: Annotated[
        str, typer.Option("--connect", help="Bus of the running test.")
    ] = "tcp/127.0.0.1:7447",
    rig: Annotated[str, typer.Option("--rig", help="Name of the running rig.")] = "simulated",
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for the recording; must be new.")
    ] = None,
    keys: WithKeys = None,
) -> None:
    """Record a test that runs on another machine, or be its twin (`run --remote-twin`)."""
    from twin.service import attending

    given = read_given(keys)
    if part is Part.twin:
        raise typer.Exit(attending.attend_as_twin(connect, rig, given))
    raise typer.Exit(attending.attend_as_recorder(connect, rig, out, given))


@attending.command(rich_help_panel=LIVE)
def tell(
    order: Annotated[Told, typer.Argument(help="What the running test should do.")],
    why: Annotated[str, typer.Option("--why", help="Recorded with the order.")] = "",
    connect: Annotated[
        str, typer.Option("--connect", help="Bus of the running test.")
    ] = "tcp/127.0.0.1:7447",
    rig: Annotated[str, typer.Option("--rig", help="Name of the running rig.")] = "simulated",
    keys: WithKeys = None,
) -> None:
    """Hold a running test at its step, resume it, stop or abort it; always smoothly."""
    from twin.service.tell import tell as command

    command(order.value, why, connect, rig, read_given(keys))
