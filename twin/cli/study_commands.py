"""The `study` commands; each imports its implementation when called."""

from pathlib import Path
from typing import Annotated

import typer

study_app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode="rich",
    help="Score a method on blind cases with sealed ground truth.",
)


@study_app.callback()
def _study_callback() -> None:
    """Require the name of the command even though there is one only."""


@study_app.command("discovery")
def discovery_command(
    out: Annotated[
        Path | None,
        typer.Option("--out", help="New folder for the study, or an existing one with --resume."),
    ] = None,
    seeds: Annotated[
        int,
        typer.Option(
            "--seeds", help="Cases per cell; five times as many without effect and with pairs."
        ),
    ] = 10,
    cells: Annotated[
        list[str] | None,
        typer.Option(
            "--cells",
            help="Only these cells, such as 'single/*/3/1%', or a case number; repeatable.",
        ),
    ] = None,
    workers: Annotated[
        int | None, typer.Option("--workers", help="Processes; default: all cores.")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue the study in --out.")] = False,
    controls: Annotated[
        bool,
        typer.Option(
            "--controls",
            help="Also run negative controls: reversed time, effect removed from the library.",
        ),
    ] = False,
) -> None:
    """Score discovery on blind cases with sealed ground truth."""
    from twin.validation.study.command import run_discovery_study as command

    raise typer.Exit(command(out, seeds, cells or [], workers, resume, controls))
