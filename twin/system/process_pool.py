"""Independent numbered tasks in local processes or threads, or on the workers of a Dask cluster.

Results are yielded as they are completed. A task is a module-level function of its number, or a
`functools.partial` of one: it is pickled. What it computes may depend on the number only, so that
any number of workers gives the same results; what is large it writes to a file itself. Threads are
for short tasks in kernels that release the GIL: they start at once and share what is compiled.
"""

import logging
import multiprocessing
import os
import signal
from collections import Counter, deque
from collections.abc import Callable, Container, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from itertools import islice
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any, TypeVar

from table_io.clock import RealClock
from table_io.errors import InputError, require_package
from twin.system.files import count_cores
from twin.system.versions import find_version_problem, read_installed_versions

TERMINAL_SIGNALS = ("SIGINT", "SIGHUP", "SIGQUIT")
MAX_TASK_S = 900.0  # time limit of a task in a local process, which is then terminated
# Of a cluster.
CONNECT_TIMEOUT_S = 10.0
POLL_S = 0.2  # period of polling `stop` and the connection
MAX_IDLE_S = 60.0  # without any worker, which may come back
ENGINE_LOGGERS = ("distributed", "distributed.client")
TASKS_PER_THREAD = 2  # sent ahead, so that no thread waits for the next
LOST_MESSAGE = "the Dask scheduler no longer answers; what is completed is kept"
RESUME_REMEDY = "start scheduler and workers again, and resume"
Task = Callable[[int], Any]
StopFunction = Callable[[], object]
Value = TypeVar("Value")
Result = TypeVar("Result")


def find_no_problem() -> str:
    """Accept every worker."""
    return ""


def find_no_fault(_: Any) -> str:
    """Accept every result."""
    return ""


def tell_nobody(_: str) -> None:
    """Take a line that nobody asked for."""


@dataclass(frozen=True, slots=True)
class TaskResult:
    """What the task of a number returned, or why it returned nothing."""

    number: int
    value: Any = None
    failure: str = ""


@dataclass(frozen=True, slots=True)
class Workers:
    """Where tasks run: `count` local processes or threads, or the cluster of a Dask scheduler."""

    count: int
    scheduler: str = ""
    in_threads: bool = False

    def require(self) -> None:
        """Raise InputError if a cluster does not answer, or its workers have other versions."""
        if self.scheduler:
            require_cluster(self.scheduler)

    @classmethod
    def from_options(
        cls, workers: int | None, scheduler: str = "", in_threads: bool = False
    ) -> "Workers":
        """Return the workers of `--workers` and `--scheduler`; by default one per core."""
        if workers is not None and workers < 1:
            raise InputError(
                "invalid number of workers",
                key="--workers",
                value=workers,
                allowed="1 or more",
                remedy="omit --workers to use all cores",
            )
        if workers is not None and scheduler:
            raise InputError(
                "a cluster has its own number of workers",
                key="--workers",
                value=workers,
                remedy="omit --workers, or --scheduler to compute on this machine",
            )
        return cls(workers or count_cores(), scheduler, in_threads)

    def __str__(self) -> str:
        if self.scheduler:
            return f"the cluster of {self.scheduler}"
        unit, plural = ("thread", "s") if self.in_threads else ("process", "es")
        return f"{self.count} {unit}{plural if self.count > 1 else ''}"


def run_tasks(
    task: Task,
    numbers: Iterable[int],
    workers: Workers,
    stop: StopFunction = lambda: False,
    *,
    max_task_s: float = MAX_TASK_S,
    attempts: int = 1,
    find_problem: Callable[[], str] = find_no_problem,
    find_fault: Callable[[Any], str] = find_no_fault,
    tell: Callable[[str], None] = tell_nobody,
) -> Iterator[TaskResult]:
    """Yield the result of the task of every number, in the order of completion.

    After `stop()` is true no task is started; those in progress are completed and yielded. A task
    whose process dies is started again until it has had `attempts`. Only a process has a
    `max_task_s`: a task that does not end on a cluster must be stopped by its operator, and what a
    task raises in a thread is raised here. `find_problem` runs on every worker of a cluster before
    anything starts and returns why it cannot be used, "" if it can. `find_fault` returns why a
    result is none: a worker of a cluster that gave it gets no more tasks, which `tell` is told, and
    its task goes to another; without another the task has failed.
    InputError if the cluster cannot be used, or is lost.
    """
    if workers.scheduler:
        return run_on_cluster(
            workers.scheduler, task, numbers, stop, attempts, find_problem, find_fault, tell
        )
    if workers.in_threads:
        results = _run_in_threads(task, numbers, workers.count, stop)
    else:
        results = _run_in_processes(task, numbers, workers.count, stop, max_task_s, attempts)
    return (
        result if result.failure else replace(result, failure=find_fault(result.value))
        for result in results
    )


def order_results(results: Iterable[TaskResult]) -> Iterator[TaskResult]:
    """Yield the results of the tasks 0, 1, ... in this order, each as soon as it is next."""
    completed: dict[int, TaskResult] = {}
    following = 0
    for result in results:
        completed[result.number] = result
        while following in completed:
            yield completed.pop(following)
            following += 1


def map_in_threads(
    compute: Callable[[Value], Result],
    values: Iterable[Value],
    on_done: Callable[[], object] = lambda: None,
) -> list[Result]:
    """Return what `compute` returns for each value, in order, on one thread per core.

    For kernels that release the GIL. `on_done` is called after each value.
    """
    arguments = list(values)
    results: dict[int, Result] = {}
    workers = Workers(count_cores(), in_threads=True)
    for result in run_tasks(lambda n: compute(arguments[n]), range(len(arguments)), workers):
        results[result.number] = result.value
        on_done()
    return [results[number] for number in range(len(arguments))]


def _run_in_threads(
    task: Task, numbers: Iterable[int], count: int, stop: StopFunction
) -> Iterator[TaskResult]:
    pending = iter(numbers)
    running: dict[Future[Any], int] = {}
    with ThreadPoolExecutor(count) as threads:
        while True:
            for number in () if stop() else islice(pending, count - len(running)):
                running[threads.submit(task, number)] = number
            if not running:
                return
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                yield TaskResult(running.pop(future), future.result())


def _run_in_processes(
    task: Task,
    numbers: Iterable[int],
    count: int,
    stop: StopFunction,
    max_task_s: float,
    attempts: int,
) -> Iterator[TaskResult]:
    os.environ |= {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    pending = iter(numbers)
    repeated: deque[int] = deque()
    failures = Counter[int]()  # of each number
    running: dict[Future[TaskResult], _WorkerProcess] = {}

    def start_next(worker: _WorkerProcess | None) -> bool:
        number = None if stop() else repeated.popleft() if repeated else next(pending, None)
        if number is None:
            return False
        if worker is None or not worker.process.is_alive():
            worker = _start_worker(task)
        running[threads.submit(worker.run, number, max_task_s)] = worker
        return True

    # One thread waits for each process. A ProcessPoolExecutor loses the tasks of all processes with
    # one, cannot end a task that takes too long, and outlives this process if that is killed.
    with ThreadPoolExecutor(count) as threads:
        try:
            while len(running) < count and start_next(None):
                pass
            while running:
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    worker, result = running.pop(future), future.result()
                    failures[result.number] += bool(result.failure)
                    is_final = not result.failure or failures[result.number] >= attempts
                    if not is_final:
                        repeated.append(result.number)
                    if not start_next(worker):
                        worker.pipe.close()
                        worker.process.join()
                    if is_final:
                        yield result
        finally:
            for worker in running.values():
                worker.process.terminate()


@dataclass(frozen=True, slots=True)
class _WorkerProcess:
    """A process that runs one task after another, until its pipe is closed."""

    process: BaseProcess
    pipe: Connection

    def run(self, number: int, max_task_s: float) -> TaskResult:
        """Return the result of a task, or the reason why there is none."""
        try:
            self.pipe.send(number)
            if self.pipe.poll(max_task_s):
                return TaskResult(number, self.pipe.recv())
            self.process.terminate()
            reason = f"took longer than {max_task_s:g} s"
            self.process.join()
        except (EOFError, OSError):
            self.process.join()
            reason = f"its process died (exit code {self.process.exitcode})"
        return TaskResult(number, failure=reason)


def _start_worker(task: Task) -> _WorkerProcess:
    """Start a process without a task."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_serve_tasks, args=(theirs, task), daemon=True)
    process.start()
    theirs.close()  # so that the death of the process closes the pipe
    return _WorkerProcess(process, ours)


def _serve_tasks(pipe: Connection, task: Task) -> None:
    """Run tasks by the numbers from a pipe until it is closed; main function of a worker process.

    Ctrl-C and the end of a terminal reach all its processes; only the parent process handles them.
    """
    for name in TERMINAL_SIGNALS:
        if hasattr(signal, name):  # Windows has the first alone
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    try:
        while True:
            pipe.send(task(pipe.recv()))
    except (EOFError, OSError):
        return


def run_on_cluster(
    address: str,
    task: Task,
    numbers: Iterable[int],
    stop: StopFunction,
    attempts: int,
    find_problem: Callable[[], str],
    find_fault: Callable[[Any], str],
    tell: Callable[[str], None],
) -> Iterator[TaskResult]:
    """Yield results as `tasks.run_tasks` does, from the workers of a scheduler."""
    from distributed import wait

    with _connect(address) as client:
        _require_equal_workers(client, address, find_problem)
        pending, repeated = iter(numbers), deque[int]()
        window = TASKS_PER_THREAD * max(sum(client.nthreads().values()), 1)
        running: dict[Any, int] = {}
        faulty: set[str] = set()  # workers
        watch = _WorkerWatch(client, address)
        while True:
            following = _take_first(repeated, pending)
            for number in () if stop() else islice(following, window - len(running)):
                future = client.submit(
                    _run_named, task, number, pure=False, retries=attempts - 1,
                    workers=_list_others(client, faulty) if faulty else None,
                )  # fmt: skip
                running[future] = number
            if not running:
                return
            with suppress(TimeoutError, CancelledError), client.as_current():
                wait([*running], POLL_S, "FIRST_COMPLETED")
            watch.require_workers()
            for future in [future for future in running if future.done()]:
                result = _read_result(future, running.pop(future), address)
                if result.failure:
                    yield result
                    continue
                worker, value = result.value
                fault = find_fault(value)
                if fault and worker not in faulty:
                    faulty.add(worker)
                    tell(f"worker {worker} gets no more tasks: {fault}")
                if fault and _list_others(client, faulty):
                    repeated.append(result.number)
                else:
                    reason = f"{fault} (worker {worker})" if fault else ""
                    yield TaskResult(result.number, value, reason)


def _take_first(repeated: deque[int], pending: Iterator[int]) -> Iterator[int]:
    """Yield the repeated numbers, which leave their queue, then the pending ones."""
    while repeated:
        yield repeated.popleft()
    yield from pending


def _list_others(client: Any, faulty: Container[str]) -> list[str]:
    """Return the addresses of the workers that are not faulty."""
    return [worker for worker in client.nthreads() if worker not in faulty]


def _run_named(task: Task, number: int) -> tuple[str, Any]:
    """Return the address of this worker of a cluster, and what the task returned."""
    from distributed import get_worker

    return get_worker().address, task(number)


def require_cluster(address: str) -> None:
    """Raise InputError unless a scheduler answers and has workers of these versions."""
    with _connect(address) as client:
        _require_equal_workers(client, address, find_no_problem)


def _read_result(future: Any, number: int, address: str) -> TaskResult:
    if future.status == "finished":
        return TaskResult(number, future.result())
    if future.status in ("cancelled", "lost"):
        raise InputError(LOST_MESSAGE, key="--scheduler", value=address, remedy=RESUME_REMEDY)
    return TaskResult(number, failure=str(future.exception()) or repr(future.exception()))


@contextmanager
def _connect(address: str) -> Iterator[Any]:
    """Yield a client of the scheduler; InputError if it does not answer."""
    require_package("distributed", "cluster", f"--scheduler {address}")
    from distributed import Client

    for name in ENGINE_LOGGERS:  # what they report is said by an error, without their tracebacks
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        client = Client(address, timeout=CONNECT_TIMEOUT_S, set_as_default=False)
    except (OSError, TimeoutError, ValueError, TypeError) as error:
        raise InputError(
            f"no Dask scheduler answers: {error}",
            key="--scheduler",
            value=address,
            allowed="an address such as tcp://host:8786",
            remedy="start one by `dask scheduler`, or omit --scheduler",
        ) from None
    try:
        yield client
    finally:
        client.close(timeout=CONNECT_TIMEOUT_S)


class _WorkerWatch:
    """Notices that the scheduler is lost, or has had no workers for too long."""

    def __init__(self, client: Any, address: str) -> None:
        self._client, self._address, self._clock = client, address, RealClock()
        self._last_worker_s = self._last_look_s = self._clock.now()

    def require_workers(self) -> None:
        """Raise InputError if the scheduler is lost, or has no workers for `MAX_IDLE_S`."""
        message = LOST_MESSAGE
        is_lost = self._client.status != "running"
        now_s = self._clock.now()
        if not is_lost and now_s - self._last_look_s > MAX_IDLE_S / 20:
            self._last_look_s = now_s
            if self._client.nthreads():
                self._last_worker_s = now_s
            message = f"the cluster has had no workers for {MAX_IDLE_S:g} s"
            is_lost = now_s - self._last_worker_s > MAX_IDLE_S
        if is_lost:
            raise InputError(message, key="--scheduler", value=self._address, remedy=RESUME_REMEDY)


def _require_equal_workers(client: Any, address: str, find_problem: Callable[[], str]) -> None:
    """Raise InputError unless there are workers, all with these versions and able to work."""
    try:
        problems = client.run(find_worker_problem, read_installed_versions(), find_problem)
    except Exception as error:  # of a worker that lacks our modules, or has others
        problems = {"": f"it cannot run this version: {type(error).__name__}: {error}"}
    if not problems:
        raise InputError(
            "this scheduler has no workers",
            key="--scheduler",
            value=address,
            remedy=f"start some by `dask worker {address}`",
        )
    for worker, problem in sorted(problems.items()):
        if problem:
            raise InputError(
                f"its worker {worker} cannot be used: {problem}; nothing was computed",
                key="--scheduler",
                value=address,
                remedy="install the same versions on every worker, and share the folder of --out",
            )


def find_worker_problem(versions: dict[str, str], find_problem: Callable[[], str]) -> str:
    """Return why this process cannot work for a client with these versions; "" if it can."""
    changes = find_version_problem(versions, read_installed_versions())
    return f"other versions: {changes}" if changes else find_problem()
