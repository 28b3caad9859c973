"""Commands `catalog`, `runs`, `note` and `fleet`: the archive of a laboratory."""

import enum
from pathlib import Path
from typing import Annotated

import typer

from twin.options import (
    JsonOption,
    LogArgument,
    ModelOption,
    OutOption,
    SchedulerOption,
    WorkersOption,
)


class FleetTask(enum.StrEnum):
    """Command that a fleet runs on every log."""

    verify = "verify"
    prc = "prc"
    replay = "replay"
    identify = "identify"
    discover = "discover"


WhereOption = Annotated[
    str | None,
    typer.Option(
        "--where",
        metavar="EXPRESSION",
        help='Only runs that meet it, as of SQL: "gap_mm = 4 and twin_misfit > 3".',
    ),
]


def catalog_command(
    folders: Annotated[
        list[Path], typer.Argument(metavar="FOLDER...", help="Folders with runs, at any depth.")
    ],
    out: Annotated[
        Path | None,
        typer.Option("--out", help="Folder of the catalogue; default: catalog in FOLDER."),
    ] = None,
) -> None:
    """Write a catalogue of runs as Parquet: a row a run, a row a step; reads only what changed."""
    from twin.archive.command import print_catalog

    print_catalog(folders, out)


def runs_command(
    folder: Annotated[
        Path, typer.Argument(metavar="[FOLDER]", help="Folder that holds runs or a folder runs.")
    ] = Path(),
    json: JsonOption = False,
    page: Annotated[
        Path | None, typer.Option("--page", help="Also write an index page to this .html file.")
    ] = None,
    where: WhereOption = None,
    columns: Annotated[
        bool, typer.Option("--columns", help="Only list the columns that --where knows.")
    ] = False,
    serve: Annotated[
        bool,
        typer.Option("--serve", help="Show the page at an address of this machine; notes on it."),
    ] = False,
) -> None:
    """List the runs in a folder: date, test, gap, verdicts, misfit, warnings."""
    from twin.archive.command import print_runs, show_runs

    if serve:
        show_runs(folder, where)
        return
    print_runs(folder, json, page, where, columns)


def note_command(
    run: LogArgument,
    text: Annotated[
        str | None, typer.Argument(metavar="[TEXT]", help="New note; an empty text removes it.")
    ] = None,
    tag: Annotated[list[str] | None, typer.Option("--tag", help="Add a tag; repeatable.")] = None,
    untag: Annotated[
        list[str] | None, typer.Option("--untag", help="Remove a tag; repeatable.")
    ] = None,
) -> None:
    """Note on a run and tag it, in notes.toml next to its recording; without TEXT show both."""
    from twin.archive.command import print_note

    print_note(run, text, tag or [], untag or [])


def fleet_command(
    task: Annotated[
        FleetTask,
        typer.Argument(metavar="COMMAND", help="verify, prc, replay, identify, discover."),
    ],
    places: Annotated[
        list[Path], typer.Argument(metavar="FOLDER|LOG...", help="Logs, runs and folders of runs.")
    ],
    where: WhereOption = None,
    model: ModelOption = None,
    out: OutOption = None,
    resume: Annotated[
        bool,
        typer.Option("--resume", help="Go on with the fleet in --out, failures again."),
    ] = False,
    since: Annotated[
        Path | None,
        typer.Option("--since", metavar="FLEET", help="List what changed since this fleet."),
    ] = None,
    workers: WorkersOption = None,
    scheduler: SchedulerOption = "",
) -> None:
    """Run a command on many recordings, on all cores or a cluster, into one table; resumable."""
    from twin.archive.command import print_fleet
    from twin.archive.fleet import FleetOptions

    options = FleetOptions(
        task.value, tuple(places), where, model, out, workers, scheduler, resume, since
    )
    raise typer.Exit(print_fleet(options))
