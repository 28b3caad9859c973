"""Command `demo`."""

from pathlib import Path
from typing import Annotated

import typer

from twin.options import OutOption


def demo_command(
    out: OutOption = None,
    seed: Annotated[
        int | None, typer.Option("--seed", help="Seed of the hidden effect; default: random.")
    ] = None,
    keep: Annotated[
        Path | None,
        typer.Option(
            "--keep", metavar="FOLDER", help="Leave a rig file with the effect here, to edit."
        ),
    ] = None,
    show_page: Annotated[
        bool, typer.Option("--open/--no-open", help="Open the page in a browser at the end.")
    ] = True,
) -> None:
    """Demonstrate it in two minutes: an effect hidden at random, found, added, and unsealed."""
    from twin.demo.command import run_demo

    raise typer.Exit(run_demo(out, seed, keep, show_page))
