"""The table of commands. A room is imported when its command is called or asked for help.

A command is declared in its room: parse the words, call the task, print the result. To add one,
write it there and add its row to `COMMANDS`.
"""

import ast
import contextlib
import os
import re
import sys
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import typer
from typer.core import TyperArgument, TyperCommand, TyperGroup, TyperOption
from typer.main import get_command_from_info, get_group
from typer.models import CommandInfo

from table_io.errors import InputError, suggest
from twin.system.diagnostics import configure_logging
from twin.system.exit_codes import EXIT_FAILED
from twin.system.resource_limits import limit_matrix_threads

limit_matrix_threads()  # before a command imports numpy

PLAN = "Before a test"
DRIVE = "Run a test"
LOOK = "Inspect recordings"
LEARN = "Identification from recordings"
FILES = "Recording files"
REFERENCE = "Reference"
MARKUP: Literal["rich"] = "rich"
FORMER_OPTIONS = {"--rig": "--table"}  # still accepted, not shown
LIST_OPTIONS = ("--judge",)  # take all words up to the next option


# What stands for a value in a help; a switch takes none.
METAVARS = {"bool": "", "str": "TEXT", "int": "N", "float": "NUMBER", "Path": "PATH"}


class WordCommand(TyperCommand):
    """Command whose help names values for people, and that suggests a word for a wrong one."""

    def get_params(self, ctx: Any) -> list[Any]:
        return [_name_value(parameter) for parameter in super().get_params(ctx)]

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        try:
            return super().parse_args(ctx, args)
        except typer.BadParameter as error:
            error.message = error.message.removeprefix("Value error, ")
            if " is not one of " in error.message:
                word, *choices = re.findall(r"'(.*?)'", error.message)
                error.message = f"{word!r}: {suggest(word, choices)}"
            raise


def _name_value(parameter: Any) -> Any:
    """Return a parameter of which the help names the value as METAVARS do, once."""
    if isinstance(parameter, TyperArgument):
        parameter.display_type_rich = lambda **_: ""  # type: ignore[method-assign]
    elif isinstance(parameter, TyperOption) and parameter.metavar is None:
        parameter.metavar = METAVARS.get(parameter.bare_type())
    return parameter


@dataclass(frozen=True, slots=True)
class Command:
    """Row of the table: `target` is the module of the room and the function that it declares.

    `computes`: it imports kernels, which are compiled at the first start.
    """

    name: str
    panel: str
    target: str
    computes: bool = False
    hidden: bool = False

    @property
    def summary(self) -> str:
        """First line of its help; the room is read, not imported."""
        module, _, name = self.target.partition(":")
        return _read_summaries(module)[name]

    def load(self) -> TyperCommand | TyperGroup:
        """Import the room and return the command."""
        module, _, name = self.target.partition(":")
        declared = getattr(import_module(module), name)
        if isinstance(declared, typer.Typer):
            group = get_group(declared)
            group.name = self.name
            return group
        lines = ["Examples:", *(f"shaketwin {words}" for words in EXAMPLES.get(self.name, ()))]
        info = CommandInfo(
            self.name,
            cls=WordCommand,
            callback=declared,
            epilog="\n\n".join(lines) if self.name in EXAMPLES else None,
            hidden=self.hidden,
            rich_help_panel=self.panel,
        )
        command = get_command_from_info(info, pretty_exceptions_short=True, rich_markup_mode=MARKUP)
        return cast("TyperCommand", command)


COMMANDS = (
    Command("run", DRIVE, "twin.monitor.cli:run_command", computes=True),
    Command("table-drive", PLAN, "twin.earthquakes.cli:table_drive_command", computes=True),
    Command("record", PLAN, "twin.earthquakes.cli:record_command", computes=True),
    Command("demo", DRIVE, "twin.demo.cli:demo_command", computes=True),
    Command("campaign", DRIVE, "twin.campaign.cli:campaign_command", computes=True),
    Command("table", DRIVE, "twin.rig.cli:table_command"),
    Command("drive", PLAN, "twin.exchange.cli:drive_command"),
    Command("simulate", DRIVE, "twin.simulation.cli:simulate_command", computes=True),
    Command("branches", PLAN, "twin.branches.cli:branches_command", computes=True),
    Command("map", PLAN, "twin.studies.cli:map_command", computes=True),
    Command("replay", LOOK, "twin.replay.cli:replay_command", computes=True),
    Command("prc", LOOK, "twin.inspection.cli:prc_command", computes=True),
    Command("paper", LOOK, "twin.paper.cli:paper_command", computes=True),
    Command("report", LOOK, "twin.inspection.cli:report_command", computes=True),
    Command("view", LOOK, "twin.inspection.cli:view_command", computes=True),
    Command("runs", LOOK, "twin.archive.cli:runs_command"),
    Command("catalog", LOOK, "twin.archive.cli:catalog_command"),
    Command("note", LOOK, "twin.archive.cli:note_command"),
    Command("fleet", LOOK, "twin.archive.cli:fleet_command", computes=True),
    Command("compare", LOOK, "twin.inspection.cli:compare_command", computes=True),
    Command("guide", PLAN, "twin.guide.command:open_guide"),
    Command("check", PLAN, "twin.rig.cli:check_command", computes=True),
    Command("tare", PLAN, "twin.rig.cli:tare_command"),
    Command("calibrate", PLAN, "twin.rig.cli:calibrate_command"),
    Command("devices", PLAN, "twin.rig.cli:devices_command"),
    Command("monitor", DRIVE, "twin.monitor.cli:monitor_command"),
    Command("join", DRIVE, "twin.live.cli:join_command"),
    Command("attend", DRIVE, "twin.live.cli:join_command", hidden=True),
    Command("control", DRIVE, "twin.live.cli:control_command"),
    Command("tell", DRIVE, "twin.live.cli:control_command", hidden=True),
    Command("discover", LEARN, "twin.discovery.cli:discover_command", computes=True),
    Command("identify", LEARN, "twin.discovery.cli:identify_command", computes=True),
    Command("table-twin", LEARN, "twin.earthquakes.cli:table_twin_command", computes=True),
    Command("verify", FILES, "twin.replay.cli:verify_command", computes=True),
    Command("import", FILES, "twin.exchange.cli:import_command", computes=True),
    Command("export", FILES, "twin.exchange.cli:export_command"),
    Command("list", REFERENCE, "twin.guide.reference_command:print_names"),
    Command("new", REFERENCE, "twin.guide.reference_command:write_template"),
    Command("explain", REFERENCE, "twin.guide.reference_command:explain_key", computes=True),
    Command("schema", REFERENCE, "twin.guide.reference_command:write_schema", computes=True),
    Command("keys", PLAN, "twin.rig.keys:keys_app"),
)
# Under the help of a command, after `shaketwin`.
EXAMPLES: dict[str, tuple[str, ...]] = {
    "run": ("run quickstart --speed max", "run quickstart --model runs/found/model.toml --view"),
    "table-drive": (
        "table-drive el_centro --table-twin table.toml --iterate 3",
        "table-drive el_centro --table-twin table.toml --after runs/first --out next"),
    "record": (
        "record rrs.csv --like swept_sine --out rrs",
        "record rrs.csv --like my_test.toml --strong 15 --count 3"),
    "demo": ("demo", "demo --seed 3 --keep my_rig --no-open"),
    "campaign": (
        "campaign records --speed max --yes --out records_runs",
        "campaign paper --out paper_runs --resume"),
    "table": ("table", "table --table ni_simulated"),
    "drive": ("drive quickstart -o drive.csv", "drive g4_ss3 -o drive.rpc --table machine"),
    "simulate": ("simulate quickstart", "simulate quickstart --gap 0:16:4"),
    "branches": ("branches quickstart", "branches quickstart --over gap --from 0 --to 10"),
    "map": ("map bumper_design --out bumpers", "map bumper_design --out bumpers --resume"),
    "replay": ("replay last", "replay runs/first --model snm --steps 0:5"),
    "prc": ("prc last", "prc runs/first --json"),
    "paper": ("paper", "paper --campaign paper_runs --out comparison"),
    "report": ("report last", "report runs/first"),
    "view": ("view last", "view runs/first --save view.rrd"),
    "runs": ("runs", "runs archive --where 'gap_mm = 4 and twin_misfit > 3'"),
    "catalog": ("catalog archive", "catalog campaign_a campaign_b --out both"),
    "fleet": (
        "fleet identify archive --where 'gap_mm = 4' --out stiffness",
        "fleet replay archive --model new.toml --out new --since old"),
    "note": ("note last 'bumper B2 replaced' --tag repaired", "note runs/first --untag repaired"),
    "compare": ("compare runs/first runs/second", "compare runs/first last"),
    "guide": ("guide", "guide --out guide_pages"),
    "check": ("check quickstart", "check --table machine --unattended"),
    "tare": ("tare --table my_table.toml", "tare --table my_table.toml --yes --temperature 21"),
    "calibrate": (
        "calibrate mass_acc_m_s2 --table my_table.toml --points 0,1",
        "calibrate force_r1_n --table my_table.toml --shunt"),
    "devices": ("devices", "devices --ni localhost:31763 --json"),
    "monitor": ("monitor", "monitor --connect tls/rig:7447 --keys my_keys --wait"),
    "join": (
        "join recorder --connect tls/rig:7447 --keys my_keys",
        "join twin --connect tls/rig:7447 --keys my_keys"),
    "control": ("control stop", "control hold --why 'look at the bumper'"),
    "discover": (
        "discover runs/first --held-out runs/second --decide next.toml",
        "discover --features paper --out features"),
    "identify": ("identify last", "identify runs/first runs/second --out specimen.toml"),
    "table-twin": (
        "table-twin runs/rehearsal --out table.toml",
        "table-twin runs/first runs/second --judge runs/third"),
    "verify": ("verify last", "verify runs/first --repair whole.mcap"),
    "import": ("import data.csv", "import data.csv -o data.mcap --accept --profile quickstart"),
    "export": ("export last --csv", "export runs/first --parquet --steps 0:5"),
    "list": ("list tests", "list effects"),
    "new": ("new test mine.toml", "new rig my_table.toml"),
    "explain": ("explain gap_mm", "explain control.tolerance"),
    "schema": ("schema test -o test.schema.json", "schema rig"),
}  # fmt: skip


@cache
def _read_summaries(module: str) -> dict[str, str]:
    """Return the first line of the help of each command that a module declares."""
    spec = find_spec(module)
    assert spec is not None
    assert spec.origin is not None
    summaries = {}
    for node in ast.parse(Path(spec.origin).read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef):
            summaries[node.name] = (ast.get_docstring(node) or "").partition("\n")[0]
        elif isinstance(node, ast.Assign) and isinstance(node.value, ast.Call):
            texts = {word.arg: word.value for word in node.value.keywords}
            if isinstance(text := texts.get("help"), ast.Constant):
                summaries[ast.unparse(node.targets[0])] = str(text.value)
    return summaries


class CommandTable(TyperGroup):
    """Group of the commands of the table, which lists them without importing their rooms."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        for row in COMMANDS:
            self.commands[row.name] = TyperCommand(
                row.name, help=row.summary, hidden=row.hidden, rich_help_panel=row.panel
            )

    def get_params(self, ctx: Any) -> list[Any]:
        return [_name_value(parameter) for parameter in super().get_params(ctx)]

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[Any, Any, list[str]]:
        """Return name and command that the first word names, and the words that it takes."""
        name, _, words = super().resolve_command(ctx, args)
        (row,) = (row for row in COMMANDS if row.name == name)
        return name, row.load(), _repeat_list_options([_replace_former(word) for word in words])


def _repeat_list_options(words: list[str]) -> list[str]:
    """Return words in which an option of LIST_OPTIONS stands before each of its values."""
    repeated: list[str] = []
    option = ""
    for word in words:
        if word.startswith("-"):
            option = word if word in LIST_OPTIONS else ""
        elif option and repeated[-1] != option:
            repeated.append(option)
        repeated.append(word)
    return repeated


def _replace_former(word: str) -> str:
    option, equals, value = word.partition("=")
    return FORMER_OPTIONS.get(option, option) + equals + value


app = typer.Typer(
    cls=CommandTable,
    no_args_is_help=True,
    rich_markup_mode=MARKUP,
    pretty_exceptions_enable=False,
    help="Drive a shaking table through a test, with a digital twin of the specimen running "
    "alongside; record, compare, replay, report.",
)


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


def announce_first_start() -> None:
    """Print a notice if no kernel was ever compiled here: importing them then takes a minute."""
    folder = Path(os.environ["NUMBA_CACHE_DIR"])  # set by `table_io`
    computing = {row.name for row in COMMANDS if row.computes}
    if set(sys.argv[1:2]) & computing and not folder.exists():
        print("first start: compiling the kernels, which takes up to a minute", file=sys.stderr)


def main() -> None:
    """Run the command line; an input error is one message on standard error and exit code 2."""
    with contextlib.suppress(BrokenPipeError):
        try:
            configure_logging(" ".join(["shaketwin", *sys.argv[1:2]]))
            announce_first_start()
            app()
        except InputError as error:
            from twin.setup.folders import remove_empty_folders

            remove_empty_folders()
            print(f"shaketwin: {error}", file=sys.stderr)
            raise SystemExit(EXIT_FAILED) from None
        except OSError as error:
            if isinstance(error, BrokenPipeError):
                raise
            advice = ""
            if sys.argv[1:2] in (["run"], ["campaign"]):  # the others record nothing
                advice = "; the recording is kept: run `shaketwin report DIR` after correcting this"
            print(f"shaketwin: {error}{advice}", file=sys.stderr)
            raise SystemExit(EXIT_FAILED) from None
