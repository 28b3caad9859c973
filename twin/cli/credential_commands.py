"""Commands for credentials; each imports its implementation when called."""

import enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from twin.security.credentials import Credentials

keys_app = typer.Typer(
    no_args_is_help=True,
    help="Manage credentials and roles for access over a network (twin/security/KEYS.md).",
)

FolderArgument = Annotated[
    Path, typer.Argument(metavar="FOLDER", help="The laboratory's credentials folder.")
]
NameArgument = Annotated[str, typer.Argument(metavar="NAME", help="Name of a user: a-z 0-9 _ -.")]
KeysOption = Annotated[
    Path | None,
    typer.Option(
        "--keys", metavar="FOLDER", help="Credentials made by `shaketwin keys`, for tls/ endpoints."
    ),
]


def read_keys_option(folder: Path | None, *, rig: bool = False) -> "Credentials | None":
    """Read and verify the credentials of --keys, None without it; warn if they expire soon."""
    if folder is None:
        return None
    from twin.security.credentials import (
        EXPIRY_WARNING_DAYS,
        read_credentials,
        read_rig_credentials,
    )
    from twin.system.terminal import print_line

    keys = (read_rig_credentials if rig else read_credentials)(folder)
    if keys.days_left < EXPIRY_WARNING_DAYS:
        print_line(
            f"warning: {folder}: the certificate expires in {keys.days_left} days and then ends "
            "every connection; renew it with `shaketwin keys renew`"
        )
    return keys


class Role(enum.StrEnum):
    """Role of a user at the rig."""

    observe = "observe"
    record = "record"
    twin = "twin"
    command = "command"
    router = "router"


@keys_app.command("new")
def new_command(
    folder: FolderArgument,
    host: Annotated[
        list[str] | None,
        typer.Option("--host", help="Name or address of the rig's machine; repeatable."),
    ] = None,
) -> None:
    """Create an authority, the rig's credentials and an empty list of users."""
    from twin.cli.credentials import create_keys

    create_keys(folder, host or [])


@keys_app.command("add")
def add_command(
    folder: FolderArgument,
    name: NameArgument,
    role: Annotated[Role, typer.Option("--role", help="Role of the user.")],
    host: Annotated[
        list[str] | None, typer.Option("--host", help="Name or address of a router.")
    ] = None,
) -> None:
    """Create credentials for a user in FOLDER/people/NAME and add the user to access.toml."""
    from twin.cli.credentials import add_person

    add_person(folder, name, role.value, host or [])


@keys_app.command("list")
def list_command(folder: FolderArgument) -> None:
    """List users, roles and the expiry of their certificates."""
    from twin.cli.credentials import list_keys

    list_keys(folder)


@keys_app.command("renew")
def renew_command(
    folder: FolderArgument,
    name: Annotated[
        str | None, typer.Argument(metavar="[NAME]", help="User; default: the rig.")
    ] = None,
    host: Annotated[list[str] | None, typer.Option("--host", help="Replace its hosts.")] = None,
) -> None:
    """Renew credentials before they expire; the old ones are kept."""
    from twin.cli.credentials import renew_keys as command

    command(folder, name, host or [])


@keys_app.command("router")
def router_command(
    folder: FolderArgument,
    name: Annotated[str, typer.Argument(metavar="NAME", help="User with the role router.")],
    listen: Annotated[
        str, typer.Option("--listen", help="Endpoint at which the router listens.")
    ] = "tls/0.0.0.0:7447",
    rig: Annotated[str, typer.Option("--rig", help="Name of the rig.")] = "simulated",
) -> None:
    """Print the configuration of a zenoh router (zenohd) with the same access control."""
    from twin.cli.credentials import print_router_settings

    print_router_settings(folder, name, listen, rig)


@keys_app.command("code")
def code_command(
    folder: FolderArgument,
    name: Annotated[str, typer.Argument(metavar="NAME", help="User on the access list.")],
    page: Annotated[
        str,
        typer.Option(
            "--page", metavar="URL", help="Address of the page: prints a QR code that logs in."
        ),
    ] = "",
) -> None:
    """Issue a code with which a user logs in to the web page; it replaces an earlier one."""
    from twin.cli.credentials import issue_code

    issue_code(folder, name, page)


@keys_app.command("remove")
def remove_command(folder: FolderArgument, name: NameArgument) -> None:
    """Revoke a user's role: the certificate is refused from then on."""
    from twin.cli.credentials import remove_person

    remove_person(folder, name)
