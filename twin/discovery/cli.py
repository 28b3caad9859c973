"""Commands `discover` and `identify`."""

from pathlib import Path
from typing import Annotated

import typer

from twin.options import MEASURED_LOG_HELP, MeasuredLogArguments, parse_measured_path


def discover_command(
    logs: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="[LOG...]", parser=parse_measured_path, help=f"{MEASURED_LOG_HELP} Repeatable."
        ),
    ] = None,
    features: Annotated[
        str | None,
        typer.Option(
            "--features",
            help="Instead of recordings, explain the features of a file: a name or a .toml file.",
        ),
    ] = None,
    model: Annotated[
        str, typer.Option("--model", help="Test this model: a name or a .toml file.")
    ] = "snm",
    out: Annotated[
        Path | None, typer.Option("--out", help="Write the results to this new folder.")
    ] = None,
    without: Annotated[
        list[str] | None,
        typer.Option("--without", help="Exclude this effect from the search; repeatable."),
    ] = None,
    held_out: Annotated[
        list[Path] | None,
        typer.Option("--held-out", help="Evaluate on this log without fitting to it; repeatable."),
    ] = None,
    decide: Annotated[
        Path | None,
        typer.Option(
            "--decide",
            metavar="PROFILE",
            help="Write the test that would decide best to this new .toml file.",
        ),
    ] = None,
    run: Annotated[
        bool,
        typer.Option("--run", help="Play that test and judge again, until it is decided."),
    ] = False,
    table: Annotated[
        str,
        typer.Option("--table", help="Rig of these tests; omitted: that of the last recording."),
    ] = "",
    budget_min: Annotated[
        float, typer.Option("--budget-min", help="Rig time of these tests in minutes.")
    ] = 10.0,
    yes: Annotated[
        bool, typer.Option("--yes", help="Ask no operator: --run plays, with the set-up as it is.")
    ] = False,
    speed: Annotated[
        str, typer.Option("--speed", help="Of --run: realtime, or max on a simulated table.")
    ] = "realtime",
) -> None:
    """Find the physical effect the model is missing and refit with it."""
    if features is not None:
        from twin.discovery.command import require_no_logs, run_feature_search

        require_no_logs(logs or [], held_out or [])
        raise typer.Exit(run_feature_search(features, model, out, without or []))
    if not logs:
        raise typer.BadParameter("give one LOG or more, or --features FILE", param_hint="LOG...")
    from twin.discovery.command import parse_options, run_decision, run_discovery

    options = parse_options(decide, run, table, budget_min, yes, speed)
    if run and options is not None:
        raise typer.Exit(run_decision(logs, model, out, without or [], held_out or [], options))
    _, code = run_discovery(logs, model, out, without or [], held_out or [], options)
    raise typer.Exit(code)


def identify_command(
    logs: MeasuredLogArguments,
    model: Annotated[
        str, typer.Option("--model", help="Start from this model: a name or a .toml file.")
    ] = "snm",
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="MODEL", help="Write the new model to this .toml file."),
    ] = None,
) -> None:
    """Identify parameters and gaps, with uncertainty, from recordings; write a model file."""
    from twin.discovery.command import run_identification

    raise typer.Exit(run_identification(logs, model, out))
