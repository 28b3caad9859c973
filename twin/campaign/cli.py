"""Command `campaign`."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from twin.options import (
    KeysOption,
    ListenOption,
    ModelOption,
    OutOption,
    Speed,
    TableOption,
    WebListenOption,
    WebOption,
    describe_names,
    read_keys_option,
)
from twin.transport.endpoint import DEFAULT_ENDPOINT


def campaign_command(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help=describe_names("Campaign", "campaigns"))
    ],
    out: OutOption = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue the campaign in --out DIR.")
    ] = False,
    speed: Annotated[
        Speed,
        typer.Option(
            "--speed", help="In real time, or unattended as fast as possible (simulated tables)."
        ),
    ] = Speed.realtime,
    model: ModelOption = None,
    table: TableOption = None,
    yes: Annotated[
        bool, typer.Option("--yes", help="Unattended: do not prompt between runs.")
    ] = False,
    listen: ListenOption = DEFAULT_ENDPOINT,
    keys: KeysOption = None,
    web: WebOption = False,
    web_listen: WebListenOption = "",
) -> None:
    """Run a list of tests with set-up changes between them; resume where it stopped."""
    from twin.campaign.command import CampaignOptions, run_campaign
    from twin.monitor.web import start_page_process

    credentials = read_keys_option(keys, rig=True)
    start_page = partial(start_page_process, web_listen, listen, credentials)
    access = ["--listen", listen] if listen != DEFAULT_ENDPOINT else []
    access += ["--keys", str(keys)] if keys is not None else []
    access += ["--web-listen", web_listen] if web_listen else ["--web"] if web else []
    options = CampaignOptions(
        file,
        out,
        resume,
        speed is Speed.max,
        model,
        table,
        yes,
        listen,
        credentials,
        start_page if web or web_listen else None,
        tuple(access),
    )
    raise typer.Exit(run_campaign(options))
