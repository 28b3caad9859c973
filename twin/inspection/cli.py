"""Commands `prc`, `report`, `view` and `compare`: what recordings hold."""

import enum
from pathlib import Path
from typing import Annotated

import typer

from twin.options import (
    LOG_HELP,
    JsonOption,
    KeysOption,
    LogArgument,
    OutOption,
    RunningTableOption,
    parse_run_path,
    read_keys_option,
    require_view_extra,
)
from twin.transport.endpoint import DEFAULT_ENDPOINT


class ReportFormat(enum.StrEnum):
    """File format of a report."""

    html = "html"
    pdf = "pdf"
    customer = "customer"


def prc_command(
    log: LogArgument,
    json: JsonOption = False,
) -> None:
    """Print pseudo-resonance curves, jumps, hysteresis, impacts per cycle."""
    from twin.inspection.curves import print_curves

    print_curves(log, json)


def report_command(
    folder: Annotated[
        Path,
        typer.Argument(
            metavar="DIR", parser=parse_run_path, help="Folder of a run or campaign, or `last`."
        ),
    ],
    output: Annotated[
        ReportFormat,
        typer.Option(
            "--format", help="Of a run: pdf writes report.pdf too, customer a test report as well."
        ),
    ] = ReportFormat.html,
    figures: Annotated[
        bool, typer.Option("--figures", help="Also write each figure as SVG, PDF and CSV.")
    ] = False,
) -> None:
    """Write the report of a run or campaign again: one self-contained HTML file."""
    from twin.inspection.folder_report import print_report

    print_report(folder, output.value, figures)


def view_command(
    log: Annotated[
        Path | None, typer.Argument(metavar="[LOG]", parser=parse_run_path, help=LOG_HELP)
    ] = None,
    save: Annotated[
        Path | None, typer.Option("--save", help="Write this .rrd file and open no viewer.")
    ] = None,
    picture: Annotated[
        Path | None, typer.Option("--picture", help="Render the view to this .png file.")
    ] = None,
    connect: Annotated[
        str, typer.Option("--connect", help="Endpoint of a running test, without LOG.")
    ] = DEFAULT_ENDPOINT,
    table: RunningTableOption = "simulated",
    keys: KeysOption = None,
    web: Annotated[
        bool,
        typer.Option("--web", help="Serve Rerun's web viewer on this computer; print its address."),
    ] = False,
) -> None:
    """Open Rerun with the project's layout, on a recording or a running test."""
    require_view_extra(True)
    from twin.viewer.command import show_view

    show_view(log, save, picture, connect, table, read_keys_option(keys), web)


def compare_command(
    first: Annotated[Path, typer.Argument(metavar="RUN", parser=parse_run_path, help=LOG_HELP)],
    second: Annotated[Path, typer.Argument(metavar="RUN", parser=parse_run_path, help=LOG_HELP)],
    json: JsonOption = False,
    out: OutOption = None,
) -> None:
    """Compare two runs, or one with two models: curves, jumps, parameters, misfit."""
    from twin.report.compare_command import print_compared_runs

    print_compared_runs(first, second, json, out)
