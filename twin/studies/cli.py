"""Command `map`."""

from pathlib import Path
from typing import Annotated

import typer

from twin.options import OutOption, SchedulerOption, WorkersOption, complete_names, describe_names


def map_command(
    study: Annotated[
        Path,
        typer.Argument(
            metavar="STUDY",
            help=f"{describe_names('Study', 'studies')} Or the folder of one, to show it.",
            autocompletion=complete_names("studies"),
        ),
    ],
    out: OutOption = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue the study in --out.")] = False,
    workers: WorkersOption = None,
    scheduler: SchedulerOption = "",
    show: Annotated[
        bool, typer.Option("--show", help="Compute nothing; write the page of what is stored.")
    ] = False,
) -> None:
    """Map outcomes of the model over any of its parameters, on all cores or a cluster."""
    from twin.studies.command import run_study
    from twin.studies.maps.task import MapOptions

    raise typer.Exit(run_study(MapOptions(study, out, workers, scheduler, resume), show))
