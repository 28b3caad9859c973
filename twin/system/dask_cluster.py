"""Tasks on a Dask cluster: every worker must have this version and be able to do the work."""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from itertools import islice
from typing import Any

from table_io.clock import RealClock
from table_io.errors import InputError, require_package
from twin.system.process_pool import StopFunction, Task, TaskResult, find_no_problem
from twin.system.versions import find_version_problem, read_installed_versions

CONNECT_TIMEOUT_S = 10.0
POLL_S = 0.2  # period of polling `stop` and the connection
MAX_IDLE_S = 60.0  # without any worker, which may come back
TASKS_PER_THREAD = 2  # sent ahead, so that no thread waits for the next
LOST_MESSAGE = "the Dask scheduler no longer answers; what is completed is kept"
RESUME_REMEDY = "start scheduler and workers again, and resume"


def run_on_cluster(
    address: str,
    task: Task,
    numbers: Iterable[int],
    stop: StopFunction,
    attempts: int,
    find_problem: Callable[[], str],
) -> Iterator[TaskResult]:
    """Yield results as `tasks.run_tasks` does, from the workers of a scheduler."""
    from distributed import wait

    with _connect(address) as client:
        _require_equal_workers(client, address, find_problem)
        pending = iter(numbers)
        window = TASKS_PER_THREAD * max(sum(client.nthreads().values()), 1)
        running: dict[Any, int] = {}
        watch = _WorkerWatch(client, address)
        while True:
            for number in () if stop() else islice(pending, window - len(running)):
                future = client.submit(task, number, pure=False, retries=attempts - 1)
                running[future] = number
            if not running:
                return
            with suppress(TimeoutError, CancelledError), client.as_current():
                wait([*running], POLL_S, "FIRST_COMPLETED")
            watch.require_workers()
            for future in [future for future in running if future.done()]:
                yield _read_result(future, running.pop(future), address)


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
