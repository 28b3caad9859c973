"""The commands about keys; heavy imports stand inside them."""

import enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from twin.stream.keys import Keys

keys_app = typer.Typer(
    no_args_is_help=True,
    help="Keys and roles, for who watches or commands over a network: twin/stream/KEYS.md.",
)

Folder = Annotated[Path, typer.Argument(metavar="FOLDER", help="The laboratory's keys.")]
Name = Annotated[str, typer.Argument(metavar="NAME", help="Of a person: a-z 0-9 _ -.")]
WithKeys = Annotated[
    Path | None,
    typer.Option(
        "--keys", metavar="FOLDER", help="Keys, as `shaketwin keys` makes them, for tls/."
    ),
]


def read_given(folder: Path | None, *, rig: bool = False) -> "Keys | None":
    """The keys in the folder of --keys, looked at; None without it. Says when they expire soon."""
    if folder is None:
        return None
    from twin.service.terminal import say
    from twin.stream.keys import SOON_DAYS, read_keys, read_rig_keys

    keys = (read_rig_keys if rig else read_keys)(folder)
    if keys.days_left < SOON_DAYS:
        say(f"warning: {folder}: good for {keys.days_left} more days; then every link with it ends")
    return keys


class Role(enum.StrEnum):
    """What a person may do at the rig."""

    observe = "observe"
    record = "record"
    twin = "twin"
    command = "command"
    router = "router"


@keys_app.command()
def new(
    folder: Folder,
    host: Annotated[
        list[str] | None,
        typer.Option("--host", help="Name or address of the rig's machine; may be repeated."),
    ] = None,
) -> None:
    """A new authority, the rig's keys, an empty list of people; once for a laboratory."""
    from twin.service.keys_folder import new_keys

    new_keys(folder, host or [])


@keys_app.command()
def add(
    folder: Folder,
    name: Name,
    role: Annotated[Role, typer.Option("--role", help="What the person may do.")],
    host: Annotated[
        list[str] | None, typer.Option("--host", help="For a router: its name or address.")
    ] = None,
) -> None:
    """Keys for a person, in FOLDER/people/NAME to be handed over, and a line in access.toml."""
    from twin.service.keys_folder import add_person

    add_person(folder, name, role.value, host or [])


@keys_app.command("list")
def show(folder: Folder) -> None:
    """Names, roles, and until when the certificates are good."""
    from twin.service.keys_folder import list_keys

    list_keys(folder)


@keys_app.command()
def renew(
    folder: Folder,
    name: Annotated[
        str | None, typer.Argument(metavar="[NAME]", help="Of a person; without it, the rig's.")
    ] = None,
    host: Annotated[
        list[str] | None, typer.Option("--host", help="Instead of the hosts it had.")
    ] = None,
) -> None:
    """New keys where the old ones expire; the old ones are kept."""
    from twin.service.keys_folder import renew as command

    command(folder, name, host or [])


@keys_app.command()
def router(
    folder: Folder,
    name: Annotated[str, typer.Argument(metavar="NAME", help="Of the router, of that role.")],
    listen: Annotated[
        str, typer.Option("--listen", help="Where the router listens.")
    ] = "tls/0.0.0.0:7447",
    rig: Annotated[str, typer.Option("--rig", help="Name of the rig.")] = "simulated",
) -> None:
    """Prints the settings of a zenoh router (zenohd) that checks people as the rig does."""
    from twin.service.keys_router import print_router

    print_router(folder, name, listen, rig)


@keys_app.command()
def remove(folder: Folder, name: Name) -> None:
    """Take a person's role away: the certificate is refused from then on."""
    from twin.service.keys_folder import remove_person

    remove_person(folder, name)
