"""Task: one command over many logs, on all cores or a cluster; resumable, into one table.

The folder of a fleet holds `fleet.json` (task, model, logs), `results.jsonl` with a sealed line for
each log that is done, `table.csv`, with --since `changes.csv`, both in `report.html`, and a folder
for what a log left.
"""

import csv
import io
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

from pydantic import Field

from table_io.errors import InputError
from twin.archive.query import index_runs
from twin.archive.run_row import Cell, Row, replace_nonfinite
from twin.drawing.page import render_page
from twin.recording.run_paths import resolve_log_path
from twin.report.run_index import iter_runs
from twin.results.contract import Contract
from twin.results.sealed_lines import SealedLine, SealedLines
from twin.setup.folders import claim_folder, find_sharing_problem, make_run_folder
from twin.setup.run_config import read_model_template
from twin.system.files import replace_text
from twin.system.grid import MAX_ATTEMPTS, Watch
from twin.system.process_pool import Workers, run_tasks
from twin.system.versions import find_version_problem, read_installed_versions

DEFINITION_FILE, LINES_FILE = "fleet.json", "results.jsonl"
TABLE_FILE, CHANGES_FILE, PAGE_FILE = "table.csv", "changes.csv", "report.html"
RECORDED = "recorded"  # name of the model that a log holds
MAX_CASE_S = 24 * 3600.0
MIN_RELATIVE_CHANGE = 1e-6  # of a number, below which it is the same
REMEDY = "give the folder of a fleet"
TaskName = Literal["verify", "prc", "replay", "identify", "discover"]


@dataclass(frozen=True, slots=True)
class FleetOptions:
    """A command, and the logs, runs or folders of runs over which it goes.

    Of folders only the runs that meet `where`. With `resume`, `out` is a fleet that goes on: with
    the logs that have no result yet, those that failed, and new ones. `since`: an earlier fleet of
    the same command, against which changes are listed.
    """

    task: TaskName
    places: Sequence[Path]
    where: str | None = None
    model: str | None = None
    out: Path | None = None
    workers: int | None = None
    scheduler: str = ""
    resume: bool = False
    since: Path | None = None


class FleetDefinition(Contract):
    """fleet.json: what is computed of which logs; the number of a log is its place."""

    task: TaskName
    model: str | None
    logs: list[str]
    versions: dict[str, str]


class FleetLine(SealedLine):
    """Line of results.jsonl: the values of a log by column, or why there are none."""

    number: int
    log: str
    failure: str = ""
    values: dict[str, bool | int | float | str | None] = Field({})


@dataclass(frozen=True, slots=True)
class Change:
    """Value of a log that is another one than in an earlier fleet."""

    log: str
    column: str
    before: Cell
    after: Cell

    @property
    def difference(self) -> float | None:
        """Return how much a number grew; None for other values."""
        if isinstance(self.after, float) and isinstance(self.before, float):
            return self.after - self.before
        return None


@dataclass(frozen=True, slots=True)
class Fleet:
    """What is in the folder of a fleet."""

    folder: Path
    total: int
    results: tuple[FleetLine, ...]
    changes: tuple[Change, ...]
    stop_reason: str | None

    @property
    def failures(self) -> tuple[FleetLine, ...]:
        return tuple(line for line in self.results if line.failure)

    @property
    def is_complete(self) -> bool:
        return len(self.results) == self.total


def run_fleet(options: FleetOptions, watch: Watch | None = None) -> Fleet:
    """Compute the logs that have no result yet, and write the tables of the fleet.

    A log that cannot be used is a failure in the table and stops nothing. InputError for a faulty
    place, expression or model, or a fleet that cannot go on.
    """
    watch = watch or Watch()
    workers = Workers.from_options(options.workers, options.scheduler)
    before = None if options.since is None else read_fleet(options.since)
    folder, definition = _open_fleet(options)
    if before is not None and before[0].task != definition.task:
        raise InputError(
            f"its command is {before[0].task}, not {definition.task}",
            key="--since",
            value=str(options.since),
            remedy="give a fleet of the same command",
        )
    workers.require()
    lines = SealedLines(folder / LINES_FILE, FleetLine)
    done = {line.number: line for line in lines.read() if not line.failure}
    lines.rewrite(done.values())  # without those that failed, and one that was cut
    missing = [number for number in range(len(definition.logs)) if number not in done]
    watch.tell(f"{definition.task}: {len(missing)} of {len(definition.logs)} logs on {workers}")
    shared = folder.resolve()
    text = (shared / DEFINITION_FILE).read_text(encoding="utf-8")
    watch.advance("logs", len(done), len(definition.logs))
    for result in run_tasks(
        partial(compute_case, shared), missing, workers, watch.find_stop,
        max_task_s=MAX_CASE_S, attempts=MAX_ATTEMPTS, tell=watch.tell,
        find_problem=partial(find_sharing_problem, shared / DEFINITION_FILE, text),
    ):  # fmt: skip
        log = definition.logs[result.number]
        line = result.value or FleetLine(number=result.number, log=log, failure=result.failure)
        done[result.number] = lines.add(line)
        if line.failure:
            watch.tell(f"{log}: {line.failure}")
        watch.advance("logs", len(done), len(definition.logs))
    results = tuple(done[number] for number in sorted(done))
    lines.rewrite(results)
    changes = _list_changes(before[1], results) if before else []
    _write_table(folder / TABLE_FILE, _list_rows(results))
    if options.since is not None:
        _write_table(folder / CHANGES_FILE, _list_change_rows(changes))
    _write_page(folder / PAGE_FILE, definition, results, changes, options.since)
    return Fleet(folder, len(definition.logs), results, tuple(changes), watch.find_stop())


def read_fleet(folder: Path) -> tuple[FleetDefinition, list[FleetLine]]:
    """Return the definition of a fleet and its results; InputError if the folder holds none."""
    definition = FleetDefinition.read(folder / DEFINITION_FILE, REMEDY)
    return definition, [*SealedLines(folder / LINES_FILE, FleetLine).read()]


def compute_case(folder: Path, number: int) -> FleetLine:
    """Compute one log of the fleet in a folder: the task of every worker."""
    from twin.archive.fleet_tasks import FLEET_TASKS  # with the kernels, which the workers need

    definition = FleetDefinition.read(folder / DEFINITION_FILE, REMEDY)
    log = definition.logs[number]
    own = folder / f"{number:04d}-{Path(log).parent.name}"
    shutil.rmtree(own, ignore_errors=True)  # of a worker that was killed
    try:
        row = FLEET_TASKS[definition.task](Path(log), definition.model, own)
    except (InputError, OSError, ArithmeticError, ValueError, LookupError, TypeError) as error:
        reason = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
        return FleetLine(number=number, log=log, failure=reason or type(error).__name__)
    return FleetLine.model_validate(
        {"number": number, "log": log, "values": replace_nonfinite(row)}
    )


def _open_fleet(options: FleetOptions) -> tuple[Path, FleetDefinition]:
    """Return folder and definition of a fleet: a new one, or with `resume` one that goes on."""
    if options.resume and options.out is None:
        raise InputError("missing", key="--out", remedy="give the folder of the fleet to resume")
    model = options.model
    if options.task in ("verify", "prc") and model is not None:
        raise InputError(f"{options.task} takes no model", key="--model", remedy="omit it")
    if model not in (None, RECORDED):
        read_model_template(str(model))
        model = str(Path(str(model)).resolve()) if Path(str(model)).is_file() else model
    logs = _find_logs(options.places, options.where)
    versions = read_installed_versions()
    if options.resume and options.out is not None:
        folder = options.out
        definition = FleetDefinition.read(folder / DEFINITION_FILE, REMEDY)
        problem = find_version_problem(definition.versions, versions)
        if (definition.task, definition.model) != (options.task, model):
            problem = f"it is {definition.task} with model {definition.model or 'of the command'}"
        if problem:
            raise InputError(
                f"the fleet was started otherwise: {problem}",
                where=folder,
                key="--resume",
                remedy="start a new one, with --since for what changed",
            )
        claim_folder(folder)
        logs = [*dict.fromkeys([*definition.logs, *logs])]
    else:
        folder, _ = make_run_folder(options.out, f"{options.task}-fleet")
    definition = FleetDefinition(task=options.task, model=model, logs=logs, versions=versions)
    replace_text(folder / DEFINITION_FILE, definition.to_json() + "\n")
    return folder, definition


def _find_logs(places: Iterable[Path], where: str | None) -> list[str]:
    """Return the paths of the logs of runs and of the runs in folders, each once."""
    logs: dict[str, None] = {}
    for place in places:
        if place.is_file() or (place / "run.mcap").is_file():
            logs_there = [place]
        elif where is not None:
            logs_there = [place / row.folder for row in index_runs(place, where)]
        elif place.is_dir():
            logs_there = [*iter_runs(place)]
        else:
            raise InputError("no such log or folder", where=place)
        logs |= dict.fromkeys(str(_resolve_log(path)) for path in logs_there)
    if not logs:
        raise InputError(
            "no logs there" if where is None else "no run there meets --where",
            where=", ".join(map(str, places)),
            remedy="`shaketwin runs` lists the runs of a folder",
        )
    return [*logs]


def _resolve_log(path: Path) -> Path:
    """Return the log of a run, or the folder of one without: its row then states why."""
    try:
        return resolve_log_path(path).resolve()
    except InputError:
        return path.resolve()


def _list_rows(results: Iterable[FleetLine]) -> list[Row]:
    return [{"log": line.log, "failure": line.failure, **line.values} for line in results]


def _list_changes(before: Iterable[FleetLine], after: Iterable[FleetLine]) -> list[Change]:
    """Return the values that differ of logs in both fleets, a failure among them."""
    rows = {str(row["log"]): row for row in _list_rows(before)}
    return [
        Change(str(row["log"]), column, earlier.get(column), row.get(column))
        for row in _list_rows(after)
        if (earlier := rows.get(str(row["log"]))) is not None
        for column in dict.fromkeys([*earlier, *row])
        if not _is_same(earlier.get(column), row.get(column))
    ]


def _is_same(before: Cell, after: Cell) -> bool:
    if isinstance(before, float) and isinstance(after, float):
        return abs(after - before) <= MIN_RELATIVE_CHANGE * max(abs(before), abs(after))
    return before == after


def _list_change_rows(changes: Iterable[Change]) -> list[Row]:
    return [
        {
            "log": change.log,
            "column": change.column,
            "before": change.before,
            "after": change.after,
            "change": change.difference,
        }
        for change in changes
    ]


def _write_page(
    path: Path,
    definition: FleetDefinition,
    lines: Sequence[FleetLine],
    changes: Sequence[Change],
    since: Path | None,
) -> None:
    """Write the page of a fleet: its results, what failed, and what changed since another one."""
    text = render_page(
        Path(__file__).with_name("fleet.html"),
        definition=definition,
        lines=lines,
        failures=[line for line in lines if line.failure],
        missing=len(definition.logs) - len(lines),
        columns=[*dict.fromkeys(name for line in lines for name in line.values)],
        changes=changes,
        since=since,
    )
    replace_text(path, text)


def _write_table(path: Path, rows: Sequence[Row]) -> None:
    """Write rows as CSV with a column for every key; the file is replaced as a whole."""
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, [*dict.fromkeys(name for row in rows for name in row)])
    writer.writeheader()
    writer.writerows(rows)
    replace_text(path, text.getvalue())
