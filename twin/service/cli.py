"""The command line. Heavy imports stand inside the commands, so that --help is quick."""

import contextlib
import enum
import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from twin.service.cli_attend import attending
from twin.service.cli_files import Steps, files
from twin.service.cli_hardware import hardware
from twin.service.cli_keys import WithKeys, keys_app, read_given
from twin.service.cli_learning import learning
from twin.service.cli_monitor import watching

# Matrices are small here; on a busy machine the threads of a BLAS stall what they should speed up,
# a run's own processes included. Set before numpy is imported, and inherited.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    help="Drive a shaking table through a stepped sine test, with a digital twin of the specimen "
    "beside it; record, compare, replay, report.",
)

PLAN, DRIVE, LOOK = "Before a test", "Drive and compute", "Look at what was recorded"

TestProfile = Annotated[Path, typer.Argument(metavar="PROFILE", help="Test profile, a .toml file.")]
Log = Annotated[Path, typer.Argument(metavar="LOG", help="A run.mcap, or the folder of a run.")]
Out = Annotated[Path | None, typer.Option("--out", help="Folder for the results; must be new.")]
Model = Annotated[str | None, typer.Option("--model", help="Model: a name or a .toml file.")]
Listen = Annotated[str, typer.Option("--listen", help="Endpoint at which others find the test.")]
HERE = "tcp/127.0.0.1:7447"


class Speed(enum.StrEnum):
    """How a run is paced."""

    realtime = "realtime"
    max = "max"


@app.command(rich_help_panel=DRIVE)
def run(
    profile: TestProfile,
    out: Out = None,
    speed: Annotated[
        Speed, typer.Option("--speed", help="max needs a simulated table.")
    ] = Speed.realtime,
    model: Model = None,
    table: Annotated[str | None, typer.Option("--table", help="Machine card instead.")] = None,
    view: Annotated[
        bool, typer.Option("--view", help="Serve a Rerun view and leave view.rrd.")
    ] = False,
    listen: Listen = HERE,
    keys: WithKeys = None,
    router: Annotated[
        str, typer.Option("--router", help="Endpoint of a zenoh router to be reached through too.")
    ] = "",
    remote_twin: Annotated[
        bool, typer.Option("--remote-twin", help="No twin here: `attend twin` elsewhere is it.")
    ] = False,
) -> None:
    """Drive the table, acquire, run the twin beside it, publish, record, report."""
    from twin.service.driving import run as command

    unpaced, given = speed is Speed.max, read_given(keys, rig=True)
    code = command(profile, out, unpaced, model, table, view, listen, given, router, remote_twin)
    raise typer.Exit(code)


@app.command(rich_help_panel=DRIVE)
def campaign(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Campaign, a .toml file.")],
    out: Out = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with the campaign in --out DIR.")
    ] = False,
    speed: Annotated[
        Speed, typer.Option("--speed", help="max, unattended, needs a simulated table.")
    ] = Speed.realtime,
    model: Model = None,
    table: Annotated[str | None, typer.Option("--table", help="Machine card instead.")] = None,
    yes: Annotated[
        bool, typer.Option("--yes", help="Unattended: nobody is asked between the runs.")
    ] = False,
    listen: Listen = HERE,
    keys: WithKeys = None,
) -> None:
    """A list of runs with set-up changes between them; one report; resumes where it stopped."""
    from twin.service.campaign.flow import Asked
    from twin.service.campaign.flow import campaign as command

    unpaced, given = speed is Speed.max, read_given(keys, rig=True)
    asked = Asked(file, out, resume, unpaced, model, table, yes, listen, given)
    raise typer.Exit(command(asked))


@app.command(rich_help_panel=DRIVE)
def table(
    rig: Annotated[str, typer.Option("--rig", help="Machine card.")] = "machine",
    listen: Annotated[
        str | None,
        typer.Option("--listen", help="tcp/127.0.0.1:PORT or unix/PATH, not the card's endpoint."),
    ] = None,
    log: Annotated[
        Path | None, typer.Option("--log", help="New file for the black box: every sample.")
    ] = None,
    time_scale: Annotated[
        float, typer.Option("--time-scale", help="Times as fast as the clock, for tests.")
    ] = 1.0,
    profile: Annotated[
        str,
        typer.Option("--profile", help="Its specimen stands there, where a rig cannot say which."),
    ] = "quickstart",
    play: Annotated[
        Path | None,
        typer.Option("--play", metavar="FILE", help="Of a follow card: its controller plays this."),
    ] = None,
    ppm: Annotated[float, typer.Option("--ppm", help="By which that controller is fast.")] = 0.0,
    after: Annotated[
        float, typer.Option("--after", metavar="S", help="It plays so long after we acquire.")
    ] = 5.0,
) -> None:
    """The simulated table as a machine of its own, for `run PROFILE --table machine`."""
    from twin.service.table import Vendor
    from twin.service.table import table as command

    command(rig, listen, log, time_scale, sys.stdout, profile, Vendor(play, ppm, after))


@app.command(rich_help_panel=PLAN)
def drive(
    profile: TestProfile,
    out: Annotated[Path, typer.Option("-o", "--out", metavar="FILE", help="New file.")],
    table: Annotated[str | None, typer.Option("--table", help="Machine card instead.")] = None,
    format: Annotated[
        str, typer.Option("--format", help="csv, txt, rpc, uff, mat or wav; else by FILE's ending.")
    ] = "",
) -> None:
    """The planned drive as a file for another controller, which `run --table` then follows."""
    from twin.service.drive_file import drive as command

    command(profile, table, out, format)


@app.command(rich_help_panel=DRIVE)
def simulate(
    profile: TestProfile,
    model: Annotated[
        list[str] | None,
        typer.Option("--model", help="Model: a name or a .toml file; may be repeated."),
    ] = None,
    gap: Annotated[
        list[str] | None,
        typer.Option(
            "--gap", metavar="MM", help="Total gap: mm, inf or FROM:TO:STEP; may be repeated."
        ),
    ] = None,
    workers: Annotated[
        int | None, typer.Option("--workers", help="Cores for many models or gaps; else all.")
    ] = None,
    out: Out = None,
    view: Annotated[bool, typer.Option("--view", help="Also write view.rrd.")] = False,
) -> None:
    """The model alone on the ideal drive: no table, no noise; or many models and gaps at once."""
    from twin.service.computing import simulate as command

    raise typer.Exit(command(profile, model or [], gap or [], workers, out, view))


@app.command(rich_help_panel=LOOK)
def replay(
    logs: Annotated[list[Path], typer.Argument(metavar="LOG...", help="Logs, folders of runs.")],
    model: Annotated[
        list[str] | None,
        typer.Option(
            "--model", help="What if: a name, a .toml file, or `recorded`; may be repeated."
        ),
    ] = None,
    out: Out = None,
    speed: Annotated[str, typer.Option("--speed", help="Times real time, or max.")] = "max",
    steps: Steps = None,
    publish: Annotated[
        bool, typer.Option("--publish", help="On the bus too: whoever listens takes it for live.")
    ] = False,
    listen: Listen = HERE,
    keys: WithKeys = None,
    view: Annotated[bool, typer.Option("--view", help="Also write view.rrd.")] = False,
) -> None:
    """The same pipeline on recordings; with the recorded model equal to the bit.

    Several logs or models give one table of how far each model is from each recording.
    """
    from twin.service.replay import Asked, replay_command

    given = read_given(keys, rig=True)
    asked = Asked(logs, model or [], out, speed, view, listen if publish else None, steps, given)
    raise typer.Exit(replay_command(asked))


@app.command(rich_help_panel=LOOK)
def prc(
    log: Log,
    json: Annotated[bool, typer.Option("--json", help="As JSON on standard output.")] = False,
) -> None:
    """Pseudo-resonance curves, jumps, hysteresis, impacts per cycle."""
    from twin.service.reading import prc as command

    command(log, json)


@app.command(rich_help_panel=LOOK)
def paper(
    model: Model = None,
    out: Out = None,
    campaign: Annotated[
        list[Path] | None,
        typer.Option("--campaign", help="A recording, or a folder of them; may be repeated."),
    ] = None,
) -> None:
    """Every figure of the paper by its model or another, and where the two agree or depart."""
    from twin.service.paper.command import paper as command

    command(out, campaign or [], model)


@app.command(rich_help_panel=LOOK)
def report(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a run or campaign.")],
) -> None:
    """One self-contained HTML file of a run or of a campaign."""
    from twin.service.reading import report as command

    command(folder)


@app.command(rich_help_panel=LOOK)
def view(
    log: Annotated[
        Path | None, typer.Argument(metavar="[LOG]", help="A run.mcap or a run's folder.")
    ] = None,
    save: Annotated[Path | None, typer.Option("--save", help="Only write this .rrd file.")] = None,
    picture: Annotated[
        Path | None, typer.Option("--picture", help="Render the view to this .png file.")
    ] = None,
    connect: Annotated[
        str, typer.Option("--connect", help="Bus of a running test, without LOG.")
    ] = "tcp/127.0.0.1:7447",
    rig: Annotated[str, typer.Option("--rig", help="Name of the running rig.")] = "simulated",
    keys: WithKeys = None,
) -> None:
    """Rerun with the project's layout, on a recording or on a running test."""
    from twin.service.viewing import show as command

    command(log, save, picture, connect, rig, read_given(keys))


app.add_typer(hardware)
app.add_typer(watching)
app.add_typer(attending)
app.add_typer(learning)
app.add_typer(files)
app.add_typer(keys_app, name="keys", rich_help_panel=PLAN)


def main() -> None:
    """Entry point: every fault of the input is one message on standard error and exit code 2."""
    with contextlib.suppress(BrokenPipeError):
        try:
            app()
        except ValueError as error:
            from table_io.card import BadInput

            if not isinstance(error, BadInput):
                raise
            print(f"shaketwin: {error}", file=sys.stderr)
            raise SystemExit(2) from None
        except OSError as error:
            if isinstance(error, BrokenPipeError):
                raise
            kept = ""
            if sys.argv[1:2] in (["run"], ["campaign"]):  # the others record nothing
                kept = "; what was recorded is kept: `shaketwin report DIR` once this is mended"
            print(f"shaketwin: {error}{kept}", file=sys.stderr)
            raise SystemExit(2) from None
