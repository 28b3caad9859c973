"""The `study` commands. Heavy imports stand inside the commands, so that --help is quick."""

from pathlib import Path
from typing import Annotated

import typer

study = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode="rich",
    help="How good a part of this is, on blind cases whose truth is sealed.",
)


@study.callback()
def _commands() -> None:
    """With one command only, its name is still asked for."""


@study.command()
def discovery(
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for the study; must be new, or --resume.")
    ] = None,
    seeds: Annotated[
        int, typer.Option("--seeds", help="Cases a cell; five times as many clean ones and pairs.")
    ] = 10,
    cells: Annotated[
        list[str] | None,
        typer.Option(
            "--cells", help="Only these, as 'single/*/3/1%', or a case's number; repeatable."
        ),
    ] = None,
    workers: Annotated[int | None, typer.Option("--workers", help="Processes; else all.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with what is in --out.")] = False,
    controls: Annotated[
        bool,
        typer.Option(
            "--controls",
            help="Also what must fail, on single/*/3/1%: time reversed, truth not in the library.",
        ),
    ] = False,
) -> None:
    """Blind cases with a sealed truth, judged and scored: how good discovery is."""
    from twin.service.study.command import discovery as command

    raise typer.Exit(command(out, seeds, cells or [], workers, resume, controls))
