"""Commands that answer what there is and what a key means; imports as in `main`."""

import enum
from pathlib import Path
from typing import Annotated

import typer

REFERENCE_PANEL = "Reference"
reference_app = typer.Typer()


class FileKind(enum.StrEnum):
    """Kind of a TOML file."""

    test = "test"
    rig = "rig"
    model = "model"
    campaign = "campaign"
    map = "map"
    study = "study"
    features = "features"


class ListKind(enum.StrEnum):
    """Kind of names to list."""

    tests = "tests"
    rigs = "rigs"
    models = "models"
    campaigns = "campaigns"
    studies = "studies"
    features = "features"
    effects = "effects"
    channels = "channels"


KindArgument = Annotated[
    FileKind,
    typer.Argument(metavar="test|rig|model|campaign|map|study|features", help="Kind of file."),
]


@reference_app.command("list", rich_help_panel=REFERENCE_PANEL)
def list_names_command(
    kind: Annotated[ListKind, typer.Argument(metavar="|".join(ListKind), help="What to list.")],
) -> None:
    """List the names that commands take: yours first, then the shipped ones."""
    from twin.guide.reference_command import print_names as command

    command(kind)


@reference_app.command("new", rich_help_panel=REFERENCE_PANEL)
def new_file_command(
    kind: Annotated[
        FileKind,
        typer.Argument(metavar="test|rig|model|campaign|study|features", help="Kind of file."),
    ],
    file: Annotated[Path, typer.Argument(metavar="FILE", help="New .toml file.")],
) -> None:
    """Write a commented file to edit; `check` accepts a new test as it is."""
    from twin.guide.reference_command import write_template as command

    command(kind, file)


@reference_app.command("explain", rich_help_panel=REFERENCE_PANEL)
def explain_command(
    key: Annotated[
        str, typer.Argument(metavar="KEY", help="Key of a file, with or without its table.")
    ],
) -> None:
    """Explain a key of a file: its meaning, unit, default and limits."""
    from twin.guide.reference_command import explain_key as command

    command(key)


@reference_app.command("schema", rich_help_panel=REFERENCE_PANEL)
def schema_command(
    kind: KindArgument,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", metavar="FILE", help="New file; default: print.")
    ] = None,
) -> None:
    """Print the JSON schema of a kind of file, by which editors complete and check its keys."""
    from twin.guide.reference_command import write_schema as command

    command(kind, out)
