"""Commands `discover`, `identify` and `study`; they import slow modules only when run."""

import enum
from pathlib import Path
from typing import Annotated

import typer

from twin.cli.run_path import MEASURED_LOG_HELP, parse_measured_path

LEARN_PANEL = "Identification from recordings"
LogPaths = Annotated[
    list[Path],
    typer.Argument(
        metavar="LOG...", parser=parse_measured_path, help=f"{MEASURED_LOG_HELP} Repeatable."
    ),
]


class LawStudyRig(enum.StrEnum):
    """Rigs of the study of laws."""

    simulated = "simulated"
    hydraulic = "hydraulic"


identification_app = typer.Typer()
study_app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode="rich",
    help="Score a method on blind cases with sealed ground truth.",
)


@identification_app.command("discover", rich_help_panel=LEARN_PANEL)
def discover_missing_effect(
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
    rig: Annotated[
        str,
        typer.Option("--rig", help="Rig of these tests; omitted: that of the last recording."),
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

    options = parse_options(decide, run, rig, budget_min, yes, speed)
    if run and options is not None:
        raise typer.Exit(run_decision(logs, model, out, without or [], held_out or [], options))
    _, code = run_discovery(logs, model, out, without or [], held_out or [], options)
    raise typer.Exit(code)


@identification_app.command("identify", rich_help_panel=LEARN_PANEL)
def identify_from_logs(
    logs: LogPaths,
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


@identification_app.command("table-twin", rich_help_panel=LEARN_PANEL)
def identify_table_from_log(
    logs: LogPaths,
    out: Annotated[
        Path, typer.Option("--out", metavar="FILE", help="New .toml file for the table's twin.")
    ] = Path("table.toml"),
    with_effects: Annotated[
        bool,
        typer.Option(
            "--effects/--no-effects", help="Name the effects that the table's twin lacks."
        ),
    ] = True,
) -> None:
    """Identify the table itself from a rehearsal: oil, valve, friction, loop, frame, effects."""
    from twin.earthquakes.command import identify_table_command as command

    raise typer.Exit(command(logs, out, with_effects))


identification_app.add_typer(study_app, name="study", rich_help_panel=LEARN_PANEL)


StudyFolder = Annotated[
    Path | None,
    typer.Option("--out", help="New folder for the study, or an existing one with --resume."),
]
StudyWorkers = Annotated[
    int | None, typer.Option("--workers", help="Processes; default: all cores.")
]
StudyResume = Annotated[bool, typer.Option("--resume", help="Continue the study in --out.")]


@study_app.callback()
def _study_callback() -> None:
    """Require the name of the command even though there is one only."""


@study_app.command("discovery")
def discovery_command(
    out: StudyFolder = None,
    seeds: Annotated[
        int,
        typer.Option(
            "--seeds", help="Cases per cell; five times as many without effect and with pairs."
        ),
    ] = 10,
    cells: Annotated[
        list[str] | None,
        typer.Option(
            "--cells",
            help="Only these cells, such as 'single/*/3/1%', or a case number; repeatable.",
        ),
    ] = None,
    workers: StudyWorkers = None,
    scheduler: Annotated[
        str, typer.Option("--scheduler", help="Address of a Dask scheduler whose workers compute.")
    ] = "",
    resume: StudyResume = False,
    laboratory: Annotated[
        str,
        typer.Option(
            "--laboratory",
            help="Imperfections of instruments and set-up: none, typical, or one bad at a time.",
        ),
    ] = "none",
    controls: Annotated[
        bool,
        typer.Option(
            "--controls",
            help="Also run negative controls: reversed time, effect removed from the library.",
        ),
    ] = False,
) -> None:
    """Score discovery on blind cases with sealed ground truth."""
    from twin.validation.study.command import run_discovery_study as command

    raise typer.Exit(
        command(out, seeds, cells or [], workers, resume, controls, laboratory, scheduler)
    )


@study_app.command("decide")
def decide_command(
    out: StudyFolder = None,
    seeds: Annotated[
        int, typer.Option("--seeds", help="Cases per cell; five times as many of pairs.")
    ] = 2,
    cells: Annotated[
        list[str] | None,
        typer.Option("--cells", help="Only these cells, such as 'pair/*/1%'; repeatable."),
    ] = None,
    workers: StudyWorkers = None,
    resume: StudyResume = False,
    first: Annotated[
        str,
        typer.Option(
            "--first", help="First test: sweep, or at one level: one-frequency, or flight."
        ),
    ] = "sweep",
) -> None:
    """Score the tests that `discover --decide` proposes, and random ones, on hidden plants."""
    from twin.validation.study.decisive_runs import run_decide_study as command

    raise typer.Exit(command(out, seeds, cells or [], workers, resume, first))


@study_app.command("laws")
def laws_command(
    out: StudyFolder = None,
    seeds: Annotated[
        int, typer.Option("--seeds", help="Cases per cell; five times as many without effect.")
    ] = 1,
    cells: Annotated[
        list[str] | None,
        typer.Option("--cells", help="Only these cells, such as 'unknown/*/3/1%'; repeatable."),
    ] = None,
    workers: StudyWorkers = None,
    resume: StudyResume = False,
    rig: Annotated[
        LawStudyRig, typer.Option("--rig", help="Rig that records the hidden laws.")
    ] = LawStudyRig.simulated,
    rivals: Annotated[
        bool, typer.Option("--rivals", help="Fit the installed baselines to the same recordings.")
    ] = False,
) -> None:
    """Score the laws that a search proposes for hidden forces that no library holds."""
    from twin.validation.study.law_study import run_law_study as command

    raise typer.Exit(command(out, seeds, cells or [], workers, resume, rig.value, rivals))
