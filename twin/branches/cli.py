"""Command `branches`."""

from typing import Annotated

import typer

from twin.options import ModelOption, OutOption, ProfileArgument


def branches_command(
    profile: ProfileArgument,
    model: ModelOption = None,
    gap: Annotated[
        float | None, typer.Option("--gap", metavar="MM", help="Total gap, instead of the test's.")
    ] = None,
    level: Annotated[
        float | None,
        typer.Option(
            "--level", metavar="G", help="Peak table acceleration, instead of the test's."
        ),
    ] = None,
    over: Annotated[
        str,
        typer.Option(
            "--over", metavar="NAME", help="frequency, gap, level, or a parameter of the model."
        ),
    ] = "frequency",
    low: Annotated[
        float | None,
        typer.Option(
            "--from", help="Start of its range: Hz, mm, g or SI; default: the test's frequencies."
        ),
    ] = None,
    high: Annotated[float | None, typer.Option("--to", help="End of its range.")] = None,
    at: Annotated[
        float | None,
        typer.Option(
            "--at",
            metavar="HZ",
            help="Drive frequency where --over is another one; default: a map of the resonance.",
        ),
    ] = None,
    complete: Annotated[
        bool,
        typer.Option(
            "--complete", help="Search for every motion: longer periods, isolas, chaos (minutes)."
        ),
    ] = False,
    attractors: Annotated[
        bool,
        typer.Option(
            "--attractors", help="Also simulate: diagram of what settles, chaos, sizes of basins."
        ),
    ] = False,
    basins: Annotated[
        float | None,
        typer.Option(
            "--basins", metavar="HZ", help="As --attractors, and draw the basins at this frequency."
        ),
    ] = None,
    out: OutOption = None,
) -> None:
    """Follow the periodic motions of the model, stable and unstable; locate bifurcations."""
    from twin.branches.command import show_branches
    from twin.branches.task import BranchOptions

    show_branches(
        BranchOptions(
            profile, model, gap, level, over, low, high, at, complete, attractors, basins, out
        )
    )
