"""The runner of every grid of cases: each result is kept as it comes, and a watch is told."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from rich.progress import Progress, TaskID, TextColumn

from table_io.clock import RealClock
from table_io.errors import InputError
from twin.system.process_pool import (
    MAX_TASK_S,
    Task,
    Workers,
    find_no_fault,
    find_no_problem,
    order_results,
    run_tasks,
)
from twin.system.progress import make_task_bar
from twin.system.terminal import catch_interrupts, console, print_line

MAX_ATTEMPTS = 3  # of a case whose worker dies
PROGRESS_LINE_S = 30.0  # between lines where there is no terminal


class Watch:
    """What a long task tells, and what it asks; this one hears nothing and lets it go on."""

    def tell(self, text: str) -> None:
        """Take a line of text."""

    def advance(self, unit: str, done: int, total: int) -> None:
        """Take how many of the cases are done; `unit` is what they are called."""

    def find_stop(self) -> str | None:
        """Return why the task shall stop after what is in progress; None to go on."""
        return None


def run_grid(
    task: Task,
    numbers: Sequence[int],
    workers: Workers,
    keep: Callable[[int, Any], int],
    watch: Watch,
    *,
    unit: str,
    total: int,
    done: int = 0,
    describe_failure: Callable[[int, str], InputError],
    is_ordered: bool = False,
    max_task_s: float = MAX_TASK_S,
    find_problem: Callable[[], str] = find_no_problem,
    find_fault: Callable[[Any], str] = find_no_fault,
) -> None:
    """Compute the tasks of `numbers` until the watch says stop, and keep each result as it comes.

    `keep` stores what the task of a number returned, and returns how many of the `total` cases are
    in it; `done` of them are stored from an earlier start. `is_ordered`: the results are kept in
    the order of 0, 1, ... `find_fault` returns why a result cannot be kept, "" if it can. Raises
    what `describe_failure` makes of a task without a result and why.
    """
    watch.advance(unit, done, total)
    results = run_tasks(
        task, numbers, workers, watch.find_stop,
        max_task_s=max_task_s, attempts=MAX_ATTEMPTS, find_problem=find_problem,
        find_fault=find_fault, tell=watch.tell,
    )  # fmt: skip
    for result in order_results(results) if is_ordered else results:
        if result.failure:
            raise describe_failure(result.number, result.failure)
        done += keep(result.number, result.value)
        watch.advance(unit, done, total)


@contextmanager
def watch_on_terminal(stopping: str) -> Iterator[Watch]:
    """Yield a watch that prints lines and a bar; a signal prints `stopping` and ends the task."""
    bar = make_task_bar(TextColumn("{task.fields[rate]}"))
    with catch_interrupts(stopping) as find_stop, bar:
        yield _TerminalWatch(bar, find_stop)


class _TerminalWatch(Watch):
    def __init__(self, bar: Progress, find_stop: Callable[[], str | None]) -> None:
        self._bar, self._find_stop, self._clock = bar, find_stop, RealClock()
        self._task: TaskID | None = None
        self._first = 0
        self._started_s = self._last_line_s = 0.0

    def tell(self, text: str) -> None:
        print_line(text)
        self._last_line_s = self._clock.now()

    def advance(self, unit: str, done: int, total: int) -> None:
        now_s = self._clock.now()
        if self._task is None:
            self._task = self._bar.add_task(unit, total=total, completed=done, rate="")
            self._first, self._started_s, self._last_line_s = done, now_s, now_s
            return
        rate = (done - self._first) / (now_s - self._started_s)
        self._bar.update(self._task, completed=done, rate=f"{rate:.3g}/s")
        if not console.is_terminal and now_s - self._last_line_s > PROGRESS_LINE_S:
            left = format_time_span((total - done) / rate)
            self.tell(f"{done} of {total} {unit}, {rate:.3g}/s, {left} left")

    def find_stop(self) -> str | None:
        return self._find_stop()


def format_time_span(seconds: float) -> str:
    """Format a duration for display, with two digits."""
    for unit, length in (("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * length:
            return f"{seconds / length:.3g} {unit}"
    return f"{seconds:.2g} s"
