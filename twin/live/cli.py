"""Commands `join` and `control`: part in a test that runs, here or on another machine."""

import enum
from pathlib import Path
from typing import Annotated

import typer

from twin.live.control import send_command
from twin.options import ConnectOption, KeysOption, RunningTableOption, read_keys_option
from twin.system.terminal import print_line
from twin.transport.endpoint import DEFAULT_ENDPOINT


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


def join_command(
    part: Annotated[
        RemoteRole, typer.Argument(metavar="recorder|twin", help="Role of this machine.")
    ],
    connect: ConnectOption = DEFAULT_ENDPOINT,
    table: RunningTableOption = "simulated",
    out: Annotated[Path | None, typer.Option("--out", help="New folder for the recording.")] = None,
    keys: KeysOption = None,
) -> None:
    """Take part in a test on another machine: record it, or run its twin (`run --remote-twin`)."""
    from twin.live import join

    credentials = read_keys_option(keys)
    if part is RemoteRole.twin:
        raise typer.Exit(join.join_as_twin(connect, table, credentials))
    raise typer.Exit(join.join_as_recorder(connect, table, out, credentials))


def control_command(
    order: Annotated[
        RunCommand,
        typer.Argument(metavar="hold|resume|stop|abort", help="Command to the running test."),
    ],
    why: Annotated[str, typer.Option("--why", help="Reason, recorded with the command.")] = "",
    connect: ConnectOption = DEFAULT_ENDPOINT,
    table: RunningTableOption = "simulated",
    keys: KeysOption = None,
) -> None:
    """Hold, resume, stop or abort a running test; the table always comes to rest smoothly."""
    print_line(send_command(order.value, why, connect, table, read_keys_option(keys)))
