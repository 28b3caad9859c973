"""`shaketwin study discovery`: every case on a few processes, a line each, resumable."""

import json
import os
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TextIO

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from table_io.card import BadInput
from table_io.clock import RealClock
from twin.service.folders import new_folder
from twin.service.outcome import EXIT_INTERRUPTED
from twin.service.study.beside import WAYS
from twin.service.study.cells import case_of, cases
from twin.service.study.controls import CELLS, control
from twin.service.study.crew import Work, by_crew
from twin.service.study.judging import judge
from twin.service.study.pages import CONTROLS, RESULTS, read_rows, said, write_pages
from twin.service.study.rivals import missing
from twin.service.terminal import console, interruptible, say

Json = dict[str, Any]
FOLDER = Path("runs") / "study-discovery"
STOPPING = "stopping: the cases under way are finished first"


def discovery(
    out: Path | None,
    seeds: int,
    patterns: Sequence[str],
    workers: int | None,
    resume: bool,
    controls: bool = False,
) -> int:
    """Every case that was asked for and is not done, then the controls; the exit code."""
    if workers is not None and workers < 1:
        raise BadInput(f"--workers {workers}: allowed: 1 or more; without it all cores")
    asked = _asked(seeds, patterns)
    folder = _folder(out, resume)
    if missing():
        say(missing())
    hands = workers or len(os.sched_getaffinity(0))
    code = run(folder, asked, hands, partial(judge, folder))
    if controls and code == 0:
        say(f"controls that must fail, on {CELLS}")
        return run(folder, cases(seeds, [CELLS]), hands, partial(control, folder), CONTROLS)
    return code


def run(
    folder: Path, asked: Sequence[int], workers: int, work: Work, results: str = RESULTS
) -> int:
    """The cases that have no row in `results` yet, on so many processes; then the pages."""
    rows = {row["number"]: row for row in read_rows(folder / results)}
    todo = [number for number in asked if number not in rows or rows[number].get("failed")]
    say(f"{len(todo)} of {len(asked)} cases to do on {workers} processes -> {folder}")
    clock = RealClock()
    began = clock.now()
    with interruptible(STOPPING) as stop, (folder / results).open("a", encoding="utf-8") as file:
        _mend(folder / results, file)
        done = sum(1 for _ in _judged(todo, workers, work, stop, file))
        why = stop()
    page = write_pages(folder)
    say(f"{done} cases in {clock.now() - began:.0f} s -> {page}" + (f"; {why}" if why else ""))
    return 0 if done == len(todo) else EXIT_INTERRUPTED


def _judged(
    todo: Sequence[int], workers: int, work: Work, stop: Callable[[], object], file: TextIO
) -> Iterator[Json]:
    """Each row, when it is in the file."""
    right = 0
    with _bar() as bar:
        task = bar.add_task("cases", total=len(todo))
        for place, row in enumerate(by_crew(todo, workers, work, stop), 1):
            row.setdefault("cell", case_of(row["number"]).cell.name)
            file.write(json.dumps(row) + "\n")
            file.flush()
            right += bool(row.get("right"))
            say(f"{place:>5}/{len(todo):<5} {row['number']:>6}  {_sentence(row)}")
            bar.update(task, advance=1, description=f"cases, {right} right")
            yield row


def _sentence(row: Json) -> str:
    """A case in one line."""
    if row.get("failed"):
        return f"{row['cell']}: FAILED: {row['failed']}"
    if not row["sized"]:
        return f"{row['cell']}: left out: {row['ended']}"
    mark = "right" if row["right"] else "MISSED"
    if "said" not in row:
        told = (f"{way}: {row[way]['said']} {' + '.join(row[way]['named'])}" for way in WAYS)
        return f"{row['cell']}: {'; '.join(told)}: {mark}"
    sure = "" if row["confidence"] is None else f" ({row['confidence']:.2f})"
    seconds = "" if row.get("seconds") is None else f", {row['seconds']:.1f} s"
    return f"{row['cell']}: {said(row)}{sure}: {mark}{seconds}"


def _asked(seeds: int, patterns: Sequence[str]) -> list[int]:
    """Numbers: of the cells that patterns name, and those that stand there themselves."""
    words = [word for pattern in patterns for word in pattern.split(",") if word]
    own = [int(word) for word in words if word.isdecimal()]
    for number in own:
        case_of(number)
    cells = [word for word in words if not word.isdecimal()]
    return own + (cases(seeds, cells) if cells or not own else [])


def _folder(out: Path | None, resume: bool) -> Path:
    """The folder of the study; with `resume` one that has a study in it."""
    folder = out or FOLDER
    if resume:
        if not (folder / RESULTS).is_file():
            raise BadInput(f"--out {folder}: no study there to resume; leave --resume away")
        return folder
    return new_folder(folder, folder.name)


def _mend(path: Path, file: TextIO) -> None:
    """A last line that was cut off is ended, so that it does not spoil the next."""
    text = path.read_bytes()
    if text and not text.endswith(b"\n"):
        file.write("\n")
        file.flush()


def _bar() -> Progress:
    return Progress(
        TextColumn("[bold]{task.description}"), BarColumn(bar_width=40), MofNCompleteColumn(),
        TimeRemainingColumn(), console=console, disable=not console.is_terminal, transient=True,
    )  # fmt: skip
