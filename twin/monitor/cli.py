"""Commands `run` and `monitor`: a test, and its state on a terminal or a page."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from table_io.errors import InputError
from twin.options import (
    ConnectOption,
    KeysOption,
    ListenOption,
    ModelOption,
    OutOption,
    ProfileArgument,
    RunningTableOption,
    Speed,
    TableOption,
    WebListenOption,
    WebOption,
    read_keys_option,
    require_view_extra,
)
from twin.transport.endpoint import DEFAULT_ENDPOINT


def run_command(
    profile: ProfileArgument,
    out: OutOption = None,
    speed: Annotated[
        Speed,
        typer.Option("--speed", help="In real time, or as fast as possible (simulated tables)."),
    ] = Speed.realtime,
    model: ModelOption = None,
    table: TableOption = None,
    view: Annotated[
        bool,
        typer.Option(
            "--view", callback=require_view_extra, help="Serve a Rerun view and write view.rrd."
        ),
    ] = False,
    listen: ListenOption = DEFAULT_ENDPOINT,
    keys: KeysOption = None,
    router: Annotated[
        str, typer.Option("--router", help="Also connect to this zenoh router.")
    ] = "",
    remote_twin: Annotated[
        bool,
        typer.Option(
            "--remote-twin", help="Start no twin here; another machine runs it: `join twin`."
        ),
    ] = False,
    web: WebOption = False,
    web_listen: WebListenOption = "",
) -> None:
    """Run a test: drive the table, acquire, run the twin, publish, record, report."""
    from twin.live.run_command import run_test
    from twin.monitor.web import start_page_process

    credentials = read_keys_option(keys, rig=True)
    start_page = partial(start_page_process, web_listen, listen, credentials)
    code = run_test(
        profile,
        out,
        speed is Speed.max,
        model,
        table,
        view,
        listen,
        credentials,
        router,
        remote_twin,
        start_page if web or web_listen else None,
    )
    raise typer.Exit(code)


def monitor_command(
    connect: ConnectOption = DEFAULT_ENDPOINT,
    table: RunningTableOption = "simulated",
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
        from twin.monitor.web import serve_monitor_page

        if once or picture is not None:
            raise InputError(
                "does not go with --once and --picture", key="--web", remedy="give one of them"
            )

        serve_monitor_page(web_listen, connect, table, read_keys_option(keys))
        return
    from twin.monitor.app import run_monitor as command

    command(connect, table, wait, once, picture, read_keys_option(keys))
