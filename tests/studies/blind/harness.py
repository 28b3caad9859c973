"""The harness of every blind study: cases drawn, run on several processes, scored, written.

A study is a task that returns the row of a case number, and how its rows are shown. Rows are kept
as they come, one JSON object a line, so that a study that was stopped goes on where it was.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from table_io.clock import RealClock
from table_io.errors import InputError
from tests.studies.blind.cases import LaboratoryLevel, draw_case, list_case_numbers
from twin.setup.folders import claim_folder, find_sharing_problem, make_output_folder
from twin.system.exit_codes import EXIT_INTERRUPTED
from twin.system.process_pool import Task, Workers, run_tasks
from twin.system.progress import make_task_bar
from twin.system.terminal import catch_interrupts, print_line

Json = dict[str, Any]
RESULTS_FILE = "results.jsonl"
STOPPING_MESSAGE = "stopping after the cases in progress"


@dataclass(frozen=True, slots=True)
class StudyOptions:
    """What every study is asked: its folder, the cases, and the processes."""

    out: Path | None
    seeds: int
    patterns: Sequence[str]
    workers: int | None
    resume: bool
    scheduler: str = ""

    def prepare(
        self,
        default_folder: str,
        default_cells: Sequence[str] = (),
        laboratory: LaboratoryLevel = "none",
    ) -> tuple[Path, list[int], Workers]:
        """Return the folder of the study, the numbers of its cases, and where they run."""
        workers = Workers.from_options(self.workers, self.scheduler)
        numbers = self._list_numbers(default_cells, laboratory)
        workers.require()
        return self._open_folder(default_folder), numbers, workers

    def _list_numbers(self, default_cells: Sequence[str], laboratory: LaboratoryLevel) -> list[int]:
        """Return case numbers from cell patterns and numbers, separated by commas."""
        patterns = self.patterns or default_cells
        words = [word for pattern in patterns for word in pattern.split(",") if word]
        own = [int(word) for word in words if word.isdecimal()]
        for number in own:
            draw_case(number)
        cells = [word for word in words if not word.isdecimal()]
        listed = list_case_numbers(self.seeds, cells, laboratory) if cells or not own else []
        return own + listed

    def _open_folder(self, default: str) -> Path:
        """Return the folder of the study: a new one, or with `resume` an existing one."""
        folder = self.out or Path("runs") / default
        if not self.resume:
            return make_output_folder(folder, folder.name).resolve()
        if not (folder / RESULTS_FILE).is_file():
            raise InputError(
                "no study to resume",
                where=f"--out {folder}",
                key="--resume",
                remedy="omit --resume to start one",
            )
        claim_folder(folder)
        return folder.resolve()  # where workers find it


@dataclass(frozen=True, slots=True)
class Study:
    """Task that returns the row of a case number, one line about a row, and the page of all."""

    task: Task
    format_row: Callable[[Json], str]
    write_page: Callable[[Path], Path]
    results: str = RESULTS_FILE


def run_study(study: Study, folder: Path, numbers: Sequence[int], workers: Workers) -> int:
    """Evaluate the cases without a row, then write the page; return the exit code."""
    path = folder / study.results
    rows = {row["number"]: row for row in read_rows(path)}
    pending = [number for number in numbers if number not in rows or rows[number].get("failed")]
    print_line(f"{len(pending)} of {len(numbers)} cases to evaluate on {workers} -> {folder}")
    clock, done, right = RealClock(), 0, 0
    start_s = clock.now()
    with (
        catch_interrupts(STOPPING_MESSAGE) as stop,
        make_task_bar() as bar,
        path.open("a", encoding="utf-8") as file,
    ):
        written = path.read_text(encoding="utf-8")
        file.write("\n" if written and not written.endswith("\n") else "")  # a line that was cut
        file.flush()
        find_problem = partial(find_sharing_problem, path, path.read_text(encoding="utf-8"))
        bar_task = bar.add_task("cases", total=len(pending))
        for result in run_tasks(study.task, pending, workers, stop, find_problem=find_problem):
            row = result.value or {"number": result.number, "failed": result.failure}
            row.setdefault("cell", draw_case(row["number"]).cell.name)
            file.write(json.dumps(row) + "\n")
            file.flush()
            done += 1
            right += bool(row.get("right"))
            text = f"{row['cell']}: {_format_failure(row) or study.format_row(row)}"
            print_line(f"{done:>5}/{len(pending):<5} {row['number']:>6}  {text}")
            bar.update(bar_task, advance=1, description=f"cases, {right} right")
        reason = stop()
    page = study.write_page(folder)
    print_line(
        f"{done} cases in {clock.now() - start_s:.0f} s -> {page}"
        + (f"; {reason}" if reason else "")
    )
    return 0 if done == len(pending) else EXIT_INTERRUPTED


def _format_failure(row: Json) -> str:
    """Return why a case was not evaluated, "" if it was."""
    if row.get("failed"):
        return f"FAILED: {row['failed']}"
    return "" if row.get("sized", True) else f"excluded: {row['ended']}"


def read_rows(path: Path) -> list[Json]:
    """Read the rows of a file of JSON lines; skip an incomplete line."""
    rows = []
    for line in path.read_text(encoding="utf-8").splitlines() if path.is_file() else ():
        try:
            rows.append(json.loads(line))
        except json.JSONDecodeError:
            continue
    return rows


def format_error(error: Exception) -> str:
    """Return the type and the message of an error."""
    return f"{type(error).__name__}: {error}"
