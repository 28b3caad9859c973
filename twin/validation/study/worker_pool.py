"""Process pool for cases; yields results as completed. A process that dies loses only its case."""

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from itertools import islice
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any

MAX_CASE_S = 900.0  # time limit per case; then the process is terminated
Row = dict[str, Any]
Work = Callable[[int], Row]  # defined at module level, since it is pickled


def map_in_processes(
    numbers: Iterable[int],
    workers: int,
    work: Work,
    stop: Callable[[], object],
    max_case_s: float = MAX_CASE_S,
) -> Iterator[Row]:
    """Yield `work(number)` of every number, in the order of completion.

    The process of a case that takes longer than `max_case_s` is terminated.
    After `stop()` is true no case is started; those in progress are completed and yielded.
    """
    os.environ |= {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    pending = iter(numbers)
    running: dict[Future[Row], _CaseWorker] = {}

    def submit(worker: _CaseWorker, number: int) -> None:
        running[threads.submit(worker.evaluate, number, max_case_s)] = worker

    # One thread waits for each process. A ProcessPoolExecutor loses the cases of all processes with
    # one, cannot end a case that takes too long, and outlives this process if that is killed.
    with ThreadPoolExecutor(workers) as threads:
        try:
            for number in islice(pending, 0 if stop() else workers):
                submit(_start_worker(work), number)
            while running:
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    worker = running.pop(future)
                    next_number = None if stop() else next(pending, None)
                    if next_number is None:
                        worker.pipe.close()
                        worker.process.join()
                    else:
                        is_alive = worker.process.is_alive()
                        submit(worker if is_alive else _start_worker(work), next_number)
                    yield future.result()
        finally:
            for worker in running.values():
                worker.process.terminate()


@dataclass(frozen=True, slots=True)
class _CaseWorker:
    """A process that evaluates one case after another, until its pipe is closed."""

    process: BaseProcess
    pipe: Connection

    def evaluate(self, number: int, max_case_s: float) -> Row:
        """Return the row of a case, or a row with the reason why there is none."""
        try:
            self.pipe.send(number)
            if self.pipe.poll(max_case_s):
                return dict(self.pipe.recv())
            self.process.terminate()
            reason = f"took longer than {max_case_s:g} s"
            self.process.join()
        except (EOFError, OSError):
            self.process.join()
            reason = f"its process died (exit code {self.process.exitcode})"
        return {"number": number, "failed": reason}


def _start_worker(work: Work) -> _CaseWorker:
    """Start a process without a case."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_serve_cases, args=(theirs, work), daemon=True)
    process.start()
    theirs.close()  # so that the death of the process closes the pipe
    return _CaseWorker(process, ours)


def _serve_cases(pipe: Connection, work: Work) -> None:
    """Evaluate case numbers from a pipe until it is closed; main function of a worker process.

    Ctrl-C reaches every process of a terminal; only the parent process handles it.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        while True:
            pipe.send(work(pipe.recv()))
    except (EOFError, OSError):
        return
