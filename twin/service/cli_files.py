"""The commands about files of recordings; heavy imports stand inside them."""

from pathlib import Path
from typing import Annotated

import typer

FILES = "Keep and pass on what was recorded"
files = typer.Typer()


@files.command(rich_help_panel=FILES)
def verify(
    log: Annotated[
        list[Path],
        typer.Argument(metavar="LOG...", help="A log, a run's folder, or the parts of one log."),
    ],
    json: Annotated[bool, typer.Option("--json", help="As JSON on standard output.")] = False,
    repair: Annotated[
        Path | None, typer.Option("--repair", metavar="NEW", help="Write what is left, whole.")
    ] = None,
) -> None:
    """Whether a recording is whole, what is missing and where, whether it can be replayed.

    Exit code 0: whole; 4: it has gaps, or the file is damaged or was altered; 2: no log.
    """
    from twin.service.verifying import verify as command

    raise typer.Exit(command(log, json, repair))
