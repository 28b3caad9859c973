"""Commands to watch or join a running test; each imports its implementation when called."""

import enum
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from twin.cli.credential_commands import KeysOption, read_keys_option
from twin.transport.endpoint import DEFAULT_ENDPOINT

if TYPE_CHECKING:
    from twin.security.credentials import Credentials

LIVE_PANEL = "Run a test"
live_app = typer.Typer()

WebOption = Annotated[
    bool, typer.Option("--web", help="Serve a page for browsers and print its address.")
]
WebListenOption = Annotated[
    str,
    typer.Option(
        "--web-listen",
        metavar="HOST:PORT",
        help="Address of the page, implies --web; beyond this computer with the rig's --keys.",
    ),
]


def start_page(
    web_listen: str, listen: str, keys: "Credentials | None", rig: str
) -> AbstractContextManager[None]:
    """Serve the page of the tests of a rig while the returned context lasts."""
    from twin.monitor.web import start_page_process  # slow import

    return start_page_process(web_listen, listen, rig, keys)


class RunCommand(enum.StrEnum):
    """Command to a running test."""

    hold = "hold"
    resume = "resume"
    stop = "stop"
    abort = "abort"


class RemoteRole(enum.StrEnum):
    """Role of this machine in a test that runs on another."""

    recorder = "recorder"
    twin = "twin"


@live_app.command("monitor", rich_help_panel=LIVE_PANEL)
def monitor_command(
    connect: Annotated[
        str, typer.Option("--connect", help="Endpoint of the running test.")
    ] = DEFAULT_ENDPOINT,
    rig: Annotated[str, typer.Option("--rig", help="Name of the running rig.")] = "simulated",
    wait: Annotated[bool, typer.Option("--wait", help="Wait for a test to begin.")] = False,
    once: Annotated[
        bool, typer.Option("--once", help="Print one screen as text and exit.")
    ] = False,
    picture: Annotated[
        Path | None,
        typer.Option(
            "--picture", metavar="FILE.svg", help="Write one screen to a new file and exit."
        ),
    ] = None,
    keys: KeysOption = None,
    web: WebOption = False,
    web_listen: WebListenOption = "",
) -> None:
    """Monitor a running test, or a published replay, on this terminal or in a browser.

    Keys: q quits; h, r, s, a hold, resume, stop, abort the test, each once confirmed with y.
    """
    if web or web_listen:
        from table_io.errors import InputError
        from twin.monitor.web import serve_monitor_page

        if once or picture is not None:
            raise InputError(
                "does not go with --once and --picture", key="--web", remedy="give one of them"
            )

        serve_monitor_page(web_listen, connect, rig, read_keys_option(keys))
        return
    from twin.monitor.app import run_monitor as command

    command(connect, rig, wait, once, picture, read_keys_option(keys))


@live_app.command("join", rich_help_panel=LIVE_PANEL)
@live_app.command("attend", hidden=True)  # the former name
def join_command(
    part: Annotated[
        RemoteRole, typer.Argument(metavar="recorder|twin", help="Role of this machine.")
    ],
    connect: Annotated[
        str, typer.Option("--connect", help="Endpoint of the running test.")
    ] = DEFAULT_ENDPOINT,
    rig: Annotated[str, typer.Option("--rig", help="Name of the running rig.")] = "simulated",
    out: Annotated[Path | None, typer.Option("--out", help="New folder for the recording.")] = None,
    keys: KeysOption = None,
) -> None:
    """Take part in a test on another machine: record it, or run its twin (`run --remote-twin`)."""
    from twin.live import join

    credentials = read_keys_option(keys)
    if part is RemoteRole.twin:
        raise typer.Exit(join.join_as_twin(connect, rig, credentials))
    raise typer.Exit(join.join_as_recorder(connect, rig, out, credentials))


@live_app.command("control", rich_help_panel=LIVE_PANEL)
@live_app.command("tell", hidden=True)  # the former name
def control_command(
    order: Annotated[
        RunCommand,
        typer.Argument(metavar="hold|resume|stop|abort", help="Command to the running test."),
    ],
    why: Annotated[str, typer.Option("--why", help="Reason, recorded with the command.")] = "",
    connect: Annotated[
        str, typer.Option("--connect", help="Endpoint of the running test.")
    ] = DEFAULT_ENDPOINT,
    rig: Annotated[str, typer.Option("--rig", help="Name of the running rig.")] = "simulated",
    keys: KeysOption = None,
) -> None:
    """Hold, resume, stop or abort a running test; the table always comes to rest smoothly."""
    from twin.live.control import send_command
    from twin.system.terminal import print_line

    print_line(send_command(order.value, why, connect, rig, read_keys_option(keys)))
