"""Command line. Each command imports its implementation when called, which keeps --help fast."""

import contextlib
import enum
import os
import sys
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from twin.cli.credential_commands import KeysOption, keys_app, read_keys_option
from twin.cli.examples import add_examples, complete_names, describe_names
from twin.cli.file_commands import StepsOption, files_app, require_view_extra
from twin.cli.hardware_commands import hardware_app
from twin.cli.identification_commands import identification_app
from twin.cli.live_commands import WebListenOption, WebOption, live_app, start_page
from twin.cli.reference_commands import reference_app
from twin.cli.run_path import LOG_HELP, parse_run_path
from twin.system.diagnostics import configure_logging
from twin.transport.endpoint import DEFAULT_ENDPOINT

# The matrices are small: BLAS threads cost more than they gain and delay the processes of a run.
# Set before numpy is imported; child processes inherit it.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    help="Drive a shaking table through a test, with a digital twin of the specimen running "
    "alongside; record, compare, replay, report.",
)

COMPUTING_COMMANDS = frozenset({
    "branches", "campaign", "check", "compare", "demo", "discover", "explain", "identify", "import",
    "map", "paper", "prc", "replay", "report", "run", "schema", "simulate", "table-drive",
    "table-twin", "verify", "view",
})  # fmt: skip
PLAN_PANEL, DRIVE_PANEL, LOOK_PANEL = (
    "Before a test",
    "Run a test",
    "Inspect recordings",
)

ProfileArgument = Annotated[
    Path,
    typer.Argument(
        metavar="PROFILE",
        help=describe_names("Test profile", "tests"),
        autocompletion=complete_names("tests"),
    ),
]
LogArgument = Annotated[
    Path,
    typer.Argument(metavar="LOG", parser=parse_run_path, help=LOG_HELP),
]
LogArguments = Annotated[
    list[Path],
    typer.Argument(metavar="LOG...", parser=parse_run_path, help=f"{LOG_HELP} Repeatable."),
]
OutOption = Annotated[Path | None, typer.Option("--out", help="New folder for the results.")]
ModelOption = Annotated[
    str | None,
    typer.Option(
        "--model",
        help=describe_names("Model", "models"),
        autocompletion=complete_names("models"),
    ),
]
TableOption = Annotated[
    str | None,
    typer.Option(
        "--table",
        help=describe_names("Rig, instead of the profile's", "rigs"),
        autocompletion=complete_names("rigs"),
    ),
]
SaveViewOption = Annotated[
    bool, typer.Option("--view", callback=require_view_extra, help="Also write view.rrd.")
]
ListenOption = Annotated[
    str, typer.Option("--listen", help="Endpoint at which observers reach the test.")
]


class ReportFormat(enum.StrEnum):
    """File format of a report."""

    html = "html"
    pdf = "pdf"


class Speed(enum.StrEnum):
    """Pace of a run."""

    realtime = "realtime"
    max = "max"


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        print(f"shaketwin {version('shaketwin')}")
        raise typer.Exit


@app.callback()
def _main_callback(
    _: Annotated[
        bool,
        typer.Option(
            "--version", is_eager=True, callback=_print_version, help="Print the version and exit."
        ),
    ] = False,
) -> None:
    """Take the options of the program itself; its help is that of `app`."""


@app.command("run", rich_help_panel=DRIVE_PANEL)
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
    from twin.live.run_command import run_test as command

    unpaced, credentials = speed is Speed.max, read_keys_option(keys, rig=True)
    page = web_listen if web or web_listen else None
    code = command(
        profile, out, unpaced, model, table, view, listen, credentials, router, remote_twin, page
    )
    raise typer.Exit(code)


@app.command("table-drive", rich_help_panel=PLAN_PANEL)
def table_drive_command(
    profile: ProfileArgument,
    twin: Annotated[
        Path, typer.Option("--table-twin", metavar="FILE", help="File of `shaketwin table-twin`.")
    ],
    band_hz: Annotated[
        tuple[float, float] | None,
        typer.Option(
            "--band",
            metavar="LOW HIGH",
            help="Frequencies to be right, in Hz; omitted: tracking.band_hz of the profile.",
        ),
    ] = None,
    out: OutOption = None,
    table: TableOption = None,
    after: Annotated[
        Path | None,
        typer.Option(
            "--after",
            metavar="LOG",
            parser=parse_run_path,
            help="Correct the drive of this run by what its table lacked.",
        ),
    ] = None,
    iterate: Annotated[
        int | None,
        typer.Option("--iterate", min=0, max=20, help="Run it, and so often a corrected drive."),
    ] = None,
    speed: Annotated[
        Speed, typer.Option("--speed", help="Of the runs: in real time, or as fast as possible.")
    ] = Speed.realtime,
) -> None:
    """Compute the command by which the table follows a record, on the table's twin."""
    from twin.earthquakes.command import compute_drive_command as command
    from twin.earthquakes.task import TableDriveOptions

    options = TableDriveOptions(profile, twin, band_hz, table, after)
    raise typer.Exit(command(options, out, iterate, speed is Speed.max))


@app.command("demo", rich_help_panel=DRIVE_PANEL)
def demo_command(
    out: OutOption = None,
    seed: Annotated[
        int | None, typer.Option("--seed", help="Seed of the hidden effect; default: random.")
    ] = None,
    keep: Annotated[
        Path | None,
        typer.Option(
            "--keep", metavar="FOLDER", help="Leave a rig file with the effect here, to edit."
        ),
    ] = None,
    show_page: Annotated[
        bool, typer.Option("--open/--no-open", help="Open the page in a browser at the end.")
    ] = True,
) -> None:
    """Demonstrate it in two minutes: an effect hidden at random, found, added, and unsealed."""
    from twin.demo.command import run_demo as command

    raise typer.Exit(command(out, seed, keep, show_page))


@app.command("campaign", rich_help_panel=DRIVE_PANEL)
def campaign_command(
    file: Annotated[
        Path,
        typer.Argument(metavar="FILE", help=describe_names("Campaign", "campaigns")),
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
    from twin.campaign.command import CampaignOptions
    from twin.campaign.command import run_campaign as command

    unpaced, credentials = speed is Speed.max, read_keys_option(keys, rig=True)
    page = partial(start_page, web_listen, listen, credentials) if web or web_listen else None
    access = ["--listen", listen] if listen != DEFAULT_ENDPOINT else []
    access += ["--keys", str(keys)] if keys is not None else []
    access += ["--web-listen", web_listen] if web_listen else ["--web"] if web else []
    request = CampaignOptions(
        file, out, resume, unpaced, model, table, yes, listen, credentials, page, tuple(access)
    )
    raise typer.Exit(command(request))


@app.command("table", rich_help_panel=DRIVE_PANEL)
def table_command(
    rig: Annotated[str, typer.Option("--rig", help="Rig file or name.")] = "machine",
    listen: Annotated[
        str | None,
        typer.Option(
            "--listen", help="tcp/127.0.0.1:PORT or unix/PATH, instead of the rig file's."
        ),
    ] = None,
    log: Annotated[
        Path | None, typer.Option("--log", help="New file for the flight recorder: every sample.")
    ] = None,
    time_scale: Annotated[
        float, typer.Option("--time-scale", help="Speed relative to real time, for tests.")
    ] = 1.0,
    profile: Annotated[
        str,
        typer.Option("--profile", help="Test profile whose specimen is on the table."),
    ] = "quickstart",
    play: Annotated[
        Path | None,
        typer.Option(
            "--play",
            metavar="FILE",
            help="Drive file that the simulated external controller plays.",
        ),
    ] = None,
    ppm: Annotated[
        float, typer.Option("--ppm", help="Clock error of that controller in parts per million.")
    ] = 0.0,
    after: Annotated[
        float,
        typer.Option(
            "--after",
            metavar="S",
            help="Delay in s between the start of acquisition and its drive.",
        ),
    ] = 5.0,
) -> None:
    """Start the simulated table as a separate machine, for `run PROFILE --table machine`."""
    from twin.rig.table import ExternalController
    from twin.rig.table import serve_table as command

    command(rig, listen, log, time_scale, sys.stdout, profile, ExternalController(play, ppm, after))


@app.command("drive", rich_help_panel=PLAN_PANEL)
def drive_command(
    profile: ProfileArgument,
    out: Annotated[Path, typer.Option("-o", "--out", metavar="FILE", help="New file.")],
    table: TableOption = None,
    format: Annotated[
        str,
        typer.Option(
            "--format", help="csv, txt, rpc, uff, mat or wav; default: the ending of FILE."
        ),
    ] = "",
) -> None:
    """Export the planned drive for an external controller, which `run --table` then follows."""
    from twin.exchange.command import run_drive
    from twin.exchange.drive_file import DriveOptions

    run_drive(DriveOptions(profile, out, table, format))


@app.command("simulate", rich_help_panel=DRIVE_PANEL)
def simulate_command(
    profile: ProfileArgument,
    model: Annotated[
        list[str] | None,
        typer.Option("--model", help="Model: a .toml file or a name; repeatable."),
    ] = None,
    gap: Annotated[
        list[str] | None,
        typer.Option("--gap", metavar="MM", help="Total gap: mm, inf or FROM:TO:STEP; repeatable."),
    ] = None,
    workers: Annotated[
        int | None, typer.Option("--workers", help="Cores for many models or gaps; default: all.")
    ] = None,
    scheduler: Annotated[
        str,
        typer.Option(
            "--scheduler",
            metavar="ADDRESS",
            help="Simulate many models or gaps on the workers of this Dask scheduler.",
        ),
    ] = "",
    out: OutOption = None,
    view: Annotated[
        bool, typer.Option("--view", callback=require_view_extra, help="Also write view.rrd.")
    ] = False,
) -> None:
    """Run the model alone on the ideal drive; compare models and gaps, or gaps over records."""
    from twin.cli.simulate import simulate_profile as command

    raise typer.Exit(command(profile, model or [], gap or [], workers, out, view, scheduler))


@app.command("branches", rich_help_panel=PLAN_PANEL)
def branches_command(
    profile: ProfileArgument,
    model: ModelOption = None,
    gap: Annotated[
        float | None, typer.Option("--gap", metavar="MM", help="Total gap, instead of the test's.")
    ] = None,
    level: Annotated[
        float | None,
        typer.Option(
            "--level", metavar="G", help="Peak table acceleration, instead of the test's."
        ),
    ] = None,
    over: Annotated[
        str,
        typer.Option(
            "--over", metavar="NAME", help="frequency, gap, level, or a parameter of the model."
        ),
    ] = "frequency",
    low: Annotated[
        float | None,
        typer.Option(
            "--from", help="Start of its range: Hz, mm, g or SI; default: the test's frequencies."
        ),
    ] = None,
    high: Annotated[float | None, typer.Option("--to", help="End of its range.")] = None,
    at: Annotated[
        float | None,
        typer.Option(
            "--at",
            metavar="HZ",
            help="Drive frequency where --over is another one; default: a map of the resonance.",
        ),
    ] = None,
    complete: Annotated[
        bool,
        typer.Option(
            "--complete", help="Search for every motion: longer periods, isolas, chaos (minutes)."
        ),
    ] = False,
    attractors: Annotated[
        bool,
        typer.Option(
            "--attractors", help="Also simulate: diagram of what settles, chaos, sizes of basins."
        ),
    ] = False,
    basins: Annotated[
        float | None,
        typer.Option(
            "--basins", metavar="HZ", help="As --attractors, and draw the basins at this frequency."
        ),
    ] = None,
    out: OutOption = None,
) -> None:
    """Follow the periodic motions of the model, stable and unstable; locate bifurcations."""
    from twin.branches.command import BranchRequest
    from twin.branches.command import show_branches as command

    request = BranchRequest(
        profile, model, gap, level, over, low, high, at, complete, attractors, basins, out
    )
    raise typer.Exit(command(request))


@app.command("map", rich_help_panel=PLAN_PANEL)
def map_command(
    study: Annotated[
        Path,
        typer.Argument(
            metavar="STUDY",
            help=f"{describe_names('Study', 'studies')} Or the folder of one, to show it.",
            autocompletion=complete_names("studies"),
        ),
    ],
    out: OutOption = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue the study in --out.")] = False,
    workers: Annotated[
        int | None, typer.Option("--workers", help="Processes; default: one per core.")
    ] = None,
    scheduler: Annotated[
        str,
        typer.Option(
            "--scheduler",
            metavar="ADDRESS",
            help="Compute on the workers of this Dask scheduler, which share the folder.",
        ),
    ] = "",
    show: Annotated[
        bool, typer.Option("--show", help="Compute nothing; write the page of what is stored.")
    ] = False,
) -> None:
    """Map outcomes of the model over any of its parameters, on all cores or a cluster."""
    from twin.studies.maps.command import run_study as command

    raise typer.Exit(command(study, out, workers, scheduler, resume, show))


@app.command("replay", rich_help_panel=LOOK_PANEL)
def replay_command(
    logs: LogArguments,
    model: Annotated[
        list[str] | None,
        typer.Option(
            "--model", help="Another model: a .toml file, a name or `recorded`; repeatable."
        ),
    ] = None,
    out: OutOption = None,
    speed: Annotated[str, typer.Option("--speed", help="Multiple of real time, or max.")] = "max",
    steps: StepsOption = None,
    publish: Annotated[
        bool, typer.Option("--publish", help="Also publish on the bus, like a live run.")
    ] = False,
    listen: ListenOption = DEFAULT_ENDPOINT,
    keys: KeysOption = None,
    view: Annotated[
        bool, typer.Option("--view", callback=require_view_extra, help="Also write view.rrd.")
    ] = False,
) -> None:
    """Replay recordings; with the recorded model the comparisons are bit-identical.

    Several logs or models give one table of the error of each model on each recording.
    """
    from twin.replay.command import ReplayRequest, replay_logs

    credentials = read_keys_option(keys, rig=True)
    request = ReplayRequest(
        logs, model or [], out, speed, view, listen if publish else None, steps, credentials
    )
    raise typer.Exit(replay_logs(request))


@app.command("prc", rich_help_panel=LOOK_PANEL)
def prc_command(
    log: LogArgument,
    json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Print pseudo-resonance curves, jumps, hysteresis, impacts per cycle."""
    from twin.cli.report import print_recording_prc as command

    command(log, json)


@app.command("paper", rich_help_panel=LOOK_PANEL)
def paper_command(
    model: ModelOption = None,
    out: OutOption = None,
    campaign: Annotated[
        list[Path] | None,
        typer.Option("--campaign", help="A recording or a folder of recordings; repeatable."),
    ] = None,
) -> None:
    """Reproduce the paper's figures and list where the model agrees or departs."""
    from twin.paper.command import compare_with_paper as command

    command(out, campaign or [], model)


@app.command("report", rich_help_panel=LOOK_PANEL)
def report_command(
    folder: Annotated[
        Path,
        typer.Argument(
            metavar="DIR", parser=parse_run_path, help="Folder of a run or campaign, or `last`."
        ),
    ],
    output: Annotated[
        ReportFormat, typer.Option("--format", help="Of a run, pdf writes report.pdf too.")
    ] = ReportFormat.html,
    figures: Annotated[
        bool, typer.Option("--figures", help="Also write each figure as SVG, PDF and CSV.")
    ] = False,
) -> None:
    """Write the report of a run or campaign again: one self-contained HTML file."""
    from twin.cli.report import write_folder_report as command

    command(folder, output is ReportFormat.pdf, figures)


@app.command("view", rich_help_panel=LOOK_PANEL)
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
    rig: Annotated[str, typer.Option("--rig", help="Name of the running rig.")] = "simulated",
    keys: KeysOption = None,
    web: Annotated[
        bool,
        typer.Option("--web", help="Serve Rerun's web viewer on this computer; print its address."),
    ] = False,
) -> None:
    """Open Rerun with the project's layout, on a recording or a running test."""
    require_view_extra(True)
    from twin.viewer.command import show_view as command

    command(log, save, picture, connect, rig, read_keys_option(keys), web)


@app.command("runs", rich_help_panel=LOOK_PANEL)
def runs_command(
    folder: Annotated[
        Path, typer.Argument(metavar="[FOLDER]", help="Folder that holds runs or a folder runs.")
    ] = Path(),
    json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
    page: Annotated[
        Path | None, typer.Option("--page", help="Also write an index page to this .html file.")
    ] = None,
) -> None:
    """List the runs in a folder: date, test, gap, verdicts, misfit, warnings."""
    from twin.report.runs_command import print_runs as command

    command(folder, json, page)


@app.command("compare", rich_help_panel=LOOK_PANEL)
def compare_command(
    first: Annotated[Path, typer.Argument(metavar="RUN", parser=parse_run_path, help=LOG_HELP)],
    second: Annotated[Path, typer.Argument(metavar="RUN", parser=parse_run_path, help=LOG_HELP)],
    json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
    out: OutOption = None,
) -> None:
    """Compare two runs, or one with two models: curves, jumps, parameters, misfit."""
    from twin.report.compare_command import compare_runs as command

    command(first, second, json, out)


@app.command("guide", rich_help_panel=PLAN_PANEL)
def guide_command(
    out: Annotated[
        Path | None, typer.Option("--out", help="Write the pages to this folder; open nothing.")
    ] = None,
) -> None:
    """Open the user guide in the browser; it needs no network."""
    from twin.guide.command import open_guide as command

    command(out, app)


app.add_typer(hardware_app)
app.add_typer(live_app)
app.add_typer(identification_app)
app.add_typer(files_app)
app.add_typer(reference_app)
app.add_typer(keys_app, name="keys", rich_help_panel=PLAN_PANEL)
add_examples(app)


def announce_first_start() -> None:
    """Print a notice if no kernel was ever compiled here: importing them then takes a minute."""
    folder = Path(os.environ["NUMBA_CACHE_DIR"])  # set by `table_io`
    if set(sys.argv[1:2]) & COMPUTING_COMMANDS and not folder.exists():
        print("first start: compiling the kernels, which takes up to a minute", file=sys.stderr)


def main() -> None:
    """Run the command line; an input error is one message on standard error and exit code 2."""
    with contextlib.suppress(BrokenPipeError):
        try:
            configure_logging(" ".join(["shaketwin", *sys.argv[1:2]]))
            announce_first_start()
            app()
        except ValueError as error:
            from table_io.errors import InputError

            if not isinstance(error, InputError):
                raise
            from twin.setup.folders import remove_empty_folders

            remove_empty_folders()
            print(f"shaketwin: {error}", file=sys.stderr)
            raise SystemExit(2) from None
        except OSError as error:
            if isinstance(error, BrokenPipeError):
                raise
            advice = ""
            if sys.argv[1:2] in (["run"], ["campaign"]):  # the others record nothing
                advice = "; the recording is kept: run `shaketwin report DIR` after correcting this"
            print(f"shaketwin: {error}{advice}", file=sys.stderr)
            raise SystemExit(2) from None
