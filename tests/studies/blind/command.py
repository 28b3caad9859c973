"""`shaketwin study discovery`: evaluate blind cases on several processes; resumable."""

import json
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TextIO

from table_io.clock import RealClock
from table_io.errors import InputError, suggest
from tests.studies.blind.baselines import describe_missing
from tests.studies.blind.comparison_tables import CONTROL_TITLES
from tests.studies.blind.controls import CONTROL_CELLS, run_controls
from tests.studies.blind.evaluation import evaluate_case
from tests.studies.blind.report import (
    CONTROLS_FILE,
    RESULTS_FILE,
    read_rows,
    verdict_label,
    write_study_pages,
)
from tests.studies.blind.strata import (
    LABORATORY_LEVELS,
    LaboratoryLevel,
    draw_case,
    list_case_numbers,
)
from twin.report.finalize import EXIT_INTERRUPTED
from twin.setup.folders import claim_folder, find_sharing_problem, make_output_folder
from twin.system.process_pool import Task, Workers, run_tasks
from twin.system.progress import make_task_bar
from twin.system.terminal import catch_interrupts, print_line

Json = dict[str, Any]
DEFAULT_DIR = Path("runs") / "study-discovery"
STOPPING_MESSAGE = "stopping after the cases in progress"


def run_discovery_study(
    out: Path | None,
    seeds: int,
    patterns: Sequence[str],
    workers: int | None,
    resume: bool,
    controls: bool = False,
    laboratory: str = "none",
    scheduler: str = "",
) -> int:
    """Evaluate the requested cases that have no result, then the controls; return the exit code."""
    processes = Workers.from_options(workers, scheduler)
    numbers = parse_cases(seeds, patterns, _parse_laboratory(laboratory))
    processes.require()
    folder = open_study_folder(out or DEFAULT_DIR, resume).resolve()  # where workers find it
    if describe_missing():
        print_line(describe_missing())
    exit_code = run_cases(folder, numbers, processes, partial(evaluate_case, folder))
    if controls and exit_code == 0:
        print_line(f"negative controls on {CONTROL_CELLS}")
        return run_cases(
            folder,
            list_case_numbers(seeds, [CONTROL_CELLS]),
            processes,
            partial(run_controls, folder),
            CONTROLS_FILE,
        )
    return exit_code


def run_cases(
    folder: Path,
    numbers: Sequence[int],
    workers: Workers,
    work: Task,
    results: str = RESULTS_FILE,
    format_row: Callable[[Json], str] | None = None,
    write_pages: Callable[[Path], Path] = write_study_pages,
) -> int:
    """Evaluate the cases without a row in `results`, then write the pages; return the exit code."""
    rows = {row["number"]: row for row in read_rows(folder / results)}
    pending = [number for number in numbers if number not in rows or rows[number].get("failed")]
    print_line(f"{len(pending)} of {len(numbers)} cases to evaluate on {workers} -> {folder}")
    clock = RealClock()
    start_s = clock.now()
    with (
        catch_interrupts(STOPPING_MESSAGE) as stop,
        (folder / results).open("a", encoding="utf-8") as file,
    ):
        _terminate_last_line(folder / results, file)
        done = sum(
            1
            for _ in _evaluate_cases(
                pending, workers, work, stop, file, format_row or _format_discovery
            )
        )
        reason = stop()
    page = write_pages(folder)
    print_line(
        f"{done} cases in {clock.now() - start_s:.0f} s -> {page}"
        + (f"; {reason}" if reason else "")
    )
    return 0 if done == len(pending) else EXIT_INTERRUPTED


def _evaluate_cases(
    pending: Sequence[int],
    workers: Workers,
    work: Task,
    stop: Callable[[], object],
    file: TextIO,
    format_row: Callable[[Json], str],
) -> Iterator[Json]:
    """Evaluate the pending cases; yield each row after it is written to the file."""
    path, right_count = Path(file.name), 0
    find_problem = partial(find_sharing_problem, path, path.read_text(encoding="utf-8"))
    results = run_tasks(work, pending, workers, stop, find_problem=find_problem)
    with make_task_bar() as bar:
        task = bar.add_task("cases", total=len(pending))
        for index, result in enumerate(results, 1):
            row = result.value or {"number": result.number, "failed": result.failure}
            row.setdefault("cell", draw_case(row["number"]).cell.name)
            file.write(json.dumps(row) + "\n")
            file.flush()
            right_count += bool(row.get("right"))
            text = _format_failure(row) or format_row(row)
            print_line(f"{index:>5}/{len(pending):<5} {row['number']:>6}  {text}")
            bar.update(task, advance=1, description=f"cases, {right_count} right")
            yield row


def _format_failure(row: Json) -> str:
    """Return why a case was not evaluated, "" if it was."""
    if row.get("failed"):
        return f"{row['cell']}: FAILED: {row['failed']}"
    return "" if row["sized"] else f"{row['cell']}: excluded: {row['ended']}"


def _format_discovery(row: Json) -> str:
    """Return one line about a case."""
    mark = "right" if row["right"] else "MISSED"
    if "said" not in row:
        results = (
            f"{control}: {row[control]['said']} {' + '.join(row[control]['named'])}"
            for control in CONTROL_TITLES
        )
        return f"{row['cell']}: {'; '.join(results)}: {mark}"
    confidence = "" if row["confidence"] is None else f" ({row['confidence']:.2f})"
    seconds = "" if row.get("seconds") is None else f", {row['seconds']:.1f} s"
    return f"{row['cell']}: {verdict_label(row)}{confidence}: {mark}{seconds}"


def _parse_laboratory(text: str) -> LaboratoryLevel:
    for level in LABORATORY_LEVELS:
        if text == level:
            return level
    raise InputError(
        "unknown laboratory",
        key="--laboratory",
        value=text,
        allowed=", ".join(LABORATORY_LEVELS),
        remedy=suggest(text, LABORATORY_LEVELS),
    )


def parse_cases(
    seeds: int, patterns: Sequence[str], laboratory: LaboratoryLevel = "none"
) -> list[int]:
    """Return case numbers from cell patterns and numbers, separated by commas."""
    words = [word for pattern in patterns for word in pattern.split(",") if word]
    own = [int(word) for word in words if word.isdecimal()]
    for number in own:
        draw_case(number)
    cells = [word for word in words if not word.isdecimal()]
    return own + (list_case_numbers(seeds, cells, laboratory) if cells or not own else [])


def open_study_folder(folder: Path, resume: bool) -> Path:
    """Return the folder of the study: a new one, or with `resume` an existing one."""
    if resume:
        if not (folder / RESULTS_FILE).is_file():
            raise InputError(
                "no study to resume",
                where=f"--out {folder}",
                key="--resume",
                remedy="omit --resume to start one",
            )
        claim_folder(folder)
        return folder
    return make_output_folder(folder, folder.name)


def _terminate_last_line(path: Path, file: TextIO) -> None:
    """Terminate an incomplete last line, so that the next row starts on a new line."""
    text = path.read_bytes()
    if text and not text.endswith(b"\n"):
        file.write("\n")
        file.flush()
