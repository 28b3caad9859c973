"""Arguments and options that several commands share; each means the same everywhere."""

import enum
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from table_io.errors import replace_escapes, require_package

if TYPE_CHECKING:
    from twin.security.credentials import Credentials

LAST = "last"
LOG_HELP = "A run.mcap, the folder of a run, or `last`, the newest run here or in runs."
MEASURED_LOG_HELP = LOG_HELP.replace("newest run", "newest run that is no simulation,")


class Speed(enum.StrEnum):
    """Pace of a run."""

    realtime = "realtime"
    max = "max"


def describe_names(text: str, kind: str) -> str:
    """Return the help of an argument that takes a file or a name of a kind."""
    return f"{text}: a .toml file, or a name of `shaketwin list {kind}`."


def complete_names(kind: str) -> Callable[[str], list[str]]:
    """Return the completion of the names of a kind for the shell, the user's own included."""

    def complete(incomplete: str) -> list[str]:
        from table_io.config.folders import list_configs

        return [name for name in list_configs(kind) if name.startswith(incomplete)]

    return complete


def parse_run_path(text: str) -> Path:
    """Parse a log or folder; `last` is the newest run here or in the folder runs.

    A file or folder of this name comes first.
    """
    return _find_run(text, measured=False)


def parse_measured_path(text: str) -> Path:
    """Parse a log or folder as `parse_run_path` does; `last` is no simulation."""
    return _find_run(text, measured=True)


def _find_run(text: str, *, measured: bool) -> Path:
    path = Path(text)
    if text != LAST or path.exists():
        return path
    from twin.report.run_index import find_last_run

    folder = find_last_run(Path(), measured=measured)
    print(replace_escapes(f"last: {folder}"), file=sys.stderr)  # standard output may be JSON
    return folder


def require_view_extra(wanted: bool) -> bool:
    """Return the value of an option that needs Rerun; InputError if that is not installed."""
    if wanted:
        require_package("rerun", "view", "a Rerun view")
    return wanted


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
MeasuredLogArguments = Annotated[
    list[Path],
    typer.Argument(
        metavar="LOG...", parser=parse_measured_path, help=f"{MEASURED_LOG_HELP} Repeatable."
    ),
]
OutOption = Annotated[Path | None, typer.Option("--out", help="New folder for the results.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON.")]
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
StepsOption = Annotated[
    str | None,
    typer.Option(
        "--steps",
        metavar="FIRST:LAST",
        help="Step indices FIRST:LAST, from 0, both included; or one index.",
    ),
]
SaveViewOption = Annotated[
    bool, typer.Option("--view", callback=require_view_extra, help="Also write view.rrd.")
]
WorkersOption = Annotated[
    int | None, typer.Option("--workers", help="Processes; default: one per core.")
]
SchedulerOption = Annotated[
    str,
    typer.Option(
        "--scheduler",
        metavar="ADDRESS",
        help="Compute on the workers of this Dask scheduler, which share the folder.",
    ),
]
ListenOption = Annotated[
    str, typer.Option("--listen", help="Endpoint at which observers reach the test.")
]
ConnectOption = Annotated[str, typer.Option("--connect", help="Endpoint of the running test.")]
RunningTableOption = Annotated[str, typer.Option("--table", help="Name of the running rig.")]
KeysOption = Annotated[
    Path | None,
    typer.Option(
        "--keys", metavar="FOLDER", help="Credentials made by `shaketwin keys`, for tls/ endpoints."
    ),
]
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
