"""Process pool for cases; yields results as completed. A process that dies loses only its case."""

import multiprocessing
import os
import signal
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any

from table_io.clock import RealClock

POLL_INTERVAL_S = 0.2  # between checks of the stop condition
MAX_CASE_S = 900.0  # time limit per case; then the process is terminated
Work = Callable[[int], dict[str, Any]]  # defined at module level, since it is pickled


@dataclass(slots=True)
class _CaseWorker:
    """A process and the case number that it evaluates."""

    process: BaseProcess
    pipe: Connection
    number: int
    start_s: float


def map_in_processes(
    numbers: Iterable[int], workers: int, work: Work, stop: Callable[[], object]
) -> Iterator[dict[str, Any]]:
    """Yield `work(number)` of every number, in the order of completion.

    After `stop()` is true no case is started; those in progress are completed and yielded.
    """
    os.environ |= {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    pending, clock = deque(numbers), RealClock()
    running: list[_CaseWorker] = []
    try:
        while pending and len(running) < workers and not stop():
            running.append(_start_worker(work, pending.popleft(), clock.now()))
        while running:
            ready = wait([worker.pipe for worker in running], timeout=POLL_INTERVAL_S)
            for worker in list(running):
                is_late = clock.now() - worker.start_s > MAX_CASE_S
                if worker.pipe not in ready and not is_late:
                    continue
                row = _receive_row(worker, is_late)
                running.remove(worker)
                if pending and not stop():
                    running.append(_assign_next(worker, work, pending.popleft(), clock.now()))
                else:
                    _stop_worker(worker)
                yield row
    finally:
        for worker in running:
            worker.process.terminate()


def _receive_row(worker: _CaseWorker, is_late: bool) -> dict[str, Any]:
    """Return the row of a worker, or a row with the reason why there is none."""
    if is_late:
        worker.process.terminate()
        worker.process.join()
        reason = f"took longer than {MAX_CASE_S:g} s"
    else:
        try:
            return dict(worker.pipe.recv())
        except (EOFError, OSError):
            worker.process.join()
            reason = f"its process died (exit code {worker.process.exitcode})"
    return {"number": worker.number, "failed": reason}


def _start_worker(work: Work, number: int, start_s: float) -> _CaseWorker:
    """Start a process and send it its first case number."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_serve_cases, args=(theirs, work), daemon=True)
    process.start()
    theirs.close()  # so that the death of the process closes the pipe
    ours.send(number)
    return _CaseWorker(process, ours, number, start_s)


def _assign_next(worker: _CaseWorker, work: Work, number: int, start_s: float) -> _CaseWorker:
    """Send a worker its next case number; start a new worker if its process has died."""
    if worker.process.is_alive():
        try:
            worker.pipe.send(number)
            return _CaseWorker(worker.process, worker.pipe, number, start_s)
        except OSError:
            pass
    worker.pipe.close()
    return _start_worker(work, number, start_s)


def _stop_worker(worker: _CaseWorker) -> None:
    """Close the pipe and wait until the process has ended."""
    worker.pipe.close()
    worker.process.join()


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
