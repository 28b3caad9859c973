"""Commands `discover` and `identify`; they import slow modules only when run."""

from pathlib import Path
from typing import Annotated

import typer

from twin.cli.study_commands import study_app

LEARN_PANEL = "Identification from recordings"
LogPaths = Annotated[list[Path], typer.Argument(metavar="LOG...", help="Give logs or run folders.")]


identification_app = typer.Typer()


@identification_app.command(rich_help_panel=LEARN_PANEL)
def discover(
    logs: LogPaths,
    model: Annotated[
        str, typer.Option("--model", help="Test this model: a name or a .toml file.")
    ] = "snm",
    out: Annotated[
        Path | None, typer.Option("--out", help="Write the results to this new folder.")
    ] = None,
    without: Annotated[
        list[str] | None,
        typer.Option("--without", help="Exclude this effect from the search; repeatable."),
    ] = None,
    held_out: Annotated[
        list[Path] | None,
        typer.Option("--held-out", help="Evaluate on this log without fitting to it; repeatable."),
    ] = None,
) -> None:
    """Find the physical effect the model is missing and refit with it."""
    from twin.cli.discover import discover_command as command

    raise typer.Exit(command(logs, model, out, without or [], held_out or []))


@identification_app.command(rich_help_panel=LEARN_PANEL)
def identify(
    logs: LogPaths,
    model: Annotated[
        str, typer.Option("--model", help="Start from this model: a name or a .toml file.")
    ] = "snm",
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="MODEL", help="Write the new model to this .toml file."),
    ] = None,
) -> None:
    """Identify parameters and gaps, with uncertainty, from recordings; write a model file."""
    from twin.cli.identify import identify_command as command

    raise typer.Exit(command(logs, model, out))


identification_app.add_typer(study_app, name="study", rich_help_panel=LEARN_PANEL)
