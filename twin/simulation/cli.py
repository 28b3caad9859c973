"""Command `simulate`."""

from typing import Annotated

import typer

from twin.options import OutOption, ProfileArgument, SaveViewOption


def simulate_command(
    profile: ProfileArgument,
    model: Annotated[
        list[str] | None,
        typer.Option("--model", help="Model: a .toml file or a name; repeatable."),
    ] = None,
    gap: Annotated[
        list[str] | None,
        typer.Option("--gap", metavar="MM", help="Total gap: mm, inf or FROM:TO:STEP; repeatable."),
    ] = None,
    workers: Annotated[
        int | None, typer.Option("--workers", help="Cores for many models or gaps; default: all.")
    ] = None,
    scheduler: Annotated[
        str,
        typer.Option(
            "--scheduler",
            metavar="ADDRESS",
            help="Simulate many models or gaps on the workers of this Dask scheduler.",
        ),
    ] = "",
    out: OutOption = None,
    view: SaveViewOption = False,
) -> None:
    """Run the model alone on the ideal drive; compare models and gaps, or gaps over records."""
    from twin.simulation.command import simulate_profile

    raise typer.Exit(
        simulate_profile(profile, model or [], gap or [], workers, out, view, scheduler)
    )
