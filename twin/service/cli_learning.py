"""The commands that learn from data; heavy imports stand inside them."""

from pathlib import Path
from typing import Annotated

import typer

from twin.service.study.cli import study

LEARN = "Learn from what was recorded"
Logs = Annotated[list[Path], typer.Argument(metavar="LOG...", help="Logs, or folders of runs.")]


learning = typer.Typer()


@learning.command(rich_help_panel=LEARN)
def discover(
    logs: Logs,
    model: Annotated[str, typer.Option("--model", help="Model: a name or a .toml file.")] = "snm",
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for the results; must be new.")
    ] = None,
    without: Annotated[
        list[str] | None,
        typer.Option("--without", help="Leave this effect out of the library; may be repeated."),
    ] = None,
    held_out: Annotated[
        list[Path] | None,
        typer.Option("--held-out", help="A log to judge by, not to fit on; may be repeated."),
    ] = None,
) -> None:
    """Where model and measurement disagree, the effect that is missing, the gap with it added."""
    from twin.service.learning.command import discover_command as command

    raise typer.Exit(command(logs, model, out, without or [], held_out or []))


@learning.command(rich_help_panel=LEARN)
def identify(
    logs: Logs,
    model: Annotated[str, typer.Option("--model", help="Start: a name or a .toml file.")] = "snm",
    out: Annotated[
        Path | None, typer.Option("--out", metavar="MODEL", help="The new model, a .toml file.")
    ] = None,
) -> None:
    """Parameters, gaps and their uncertainty from recordings, as a model with figures."""
    from twin.service.learning.identify import identify_command as command

    raise typer.Exit(command(logs, model, out))


learning.add_typer(study, name="study", rich_help_panel=LEARN)
