"""Commands `replay` and `verify`."""

from pathlib import Path
from typing import Annotated

import typer

from twin.options import (
    JsonOption,
    KeysOption,
    ListenOption,
    LogArguments,
    OutOption,
    SaveViewOption,
    StepsOption,
    parse_run_path,
    read_keys_option,
)
from twin.transport.endpoint import DEFAULT_ENDPOINT


def replay_command(
    logs: LogArguments,
    model: Annotated[
        list[str] | None,
        typer.Option(
            "--model", help="Another model: a .toml file, a name or `recorded`; repeatable."
        ),
    ] = None,
    out: OutOption = None,
    speed: Annotated[str, typer.Option("--speed", help="Multiple of real time, or max.")] = "max",
    steps: StepsOption = None,
    publish: Annotated[
        bool, typer.Option("--publish", help="Also publish on the bus, like a live run.")
    ] = False,
    listen: ListenOption = DEFAULT_ENDPOINT,
    keys: KeysOption = None,
    view: SaveViewOption = False,
) -> None:
    """Replay recordings; with the recorded model the comparisons are bit-identical.

    Several logs or models give one table of the error of each model on each recording.
    """
    from twin.replay.command import ReplayRequest, replay_logs

    credentials = read_keys_option(keys, rig=True)
    request = ReplayRequest(
        logs, model or [], out, speed, view, listen if publish else None, steps, credentials
    )
    raise typer.Exit(replay_logs(request))


def verify_command(
    log: Annotated[
        list[Path],
        typer.Argument(
            metavar="LOG...",
            parser=parse_run_path,
            help="A log, the folder of a run, the parts of one log, or `last`.",
        ),
    ],
    json: JsonOption = False,
    repair: Annotated[
        Path | None,
        typer.Option("--repair", metavar="NEW", help="Write the recoverable data to this new log."),
    ] = None,
) -> None:
    """Verify that a recording is complete and can be replayed; list what is missing.

    Exit code 0: whole; 4: it has gaps, or the file is damaged or was altered; 2: no log.
    """
    from twin.replay.verify import verify_logs

    raise typer.Exit(verify_logs(log, json, repair))
