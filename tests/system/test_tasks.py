"""Tasks in processes and on a cluster: deaths, retries, stops, and workers that cannot be used."""

import multiprocessing
import os
import re
import subprocess
import sys
from collections.abc import Generator, Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import distributed
import pytest

from table_io.clock import RealClock
from tests.input_errors import raises_input_error
from tests.system import task_functions
from tests.system.clusters import start_cluster
from twin.setup.folders import find_sharing_problem
from twin.system.process_pool import TaskResult, Workers, order_results, run_tasks
from twin.system.versions import read_installed_versions


@pytest.fixture(scope="module")
def scheduler() -> Iterator[str]:
    """Address of a scheduler with two workers, in processes of their own."""
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address="127.0.0.1:0"
    ) as cluster:
        yield cluster.scheduler_address


@pytest.mark.parametrize("count", [1, 2])
def test_a_process_that_dies_loses_only_its_task(count: int) -> None:
    results = {r.number: r for r in run_tasks(task_functions.die_of_odd, range(4), Workers(count))}
    assert sorted(results) == [0, 1, 2, 3]
    for number, result in results.items():
        assert bool(result.failure) == bool(number % 2)
    assert results[1].failure == "its process died (exit code -9)"


def test_a_task_whose_process_dies_is_tried_again(tmp_path: Path) -> None:
    task = partial(task_functions.die_at_first, tmp_path)
    results = list(run_tasks(task, range(5), Workers(2), attempts=2))
    assert sorted(result.value for result in results) == [0, 1, 2, 3, 4]
    results = list(run_tasks(task_functions.die_of_odd, [1], Workers(1), attempts=3))
    assert results == [TaskResult(1, failure="its process died (exit code -9)")]


def test_a_task_that_does_not_end_is_ended() -> None:
    results = list(
        run_tasks(task_functions.hang_at_odd, [1, 3], Workers(1), max_task_s=0.3, attempts=1)
    )
    assert [result.number for result in results] == [1, 3]
    assert all(result.failure == "took longer than 0.3 s" for result in results)


def test_leaving_early_ends_the_processes_at_once() -> None:
    max_task_s, clock = 20.0, RealClock()  # of the task that is left behind
    results = run_tasks(task_functions.hang_at_odd, [0, 1], Workers(2), max_task_s=max_task_s)
    assert next(results).number == 0
    left_s = clock.now()
    assert isinstance(results, Generator)
    results.close()
    assert clock.now() - left_s < max_task_s / 2
    assert not multiprocessing.active_children()


def test_a_killed_parent_leaves_no_processes() -> None:
    """A worker that has nothing to do ends by itself."""
    with subprocess.Popen(
        [sys.executable, task_functions.__file__], stdout=subprocess.PIPE, text=True
    ) as parent:
        assert parent.stdout is not None
        worker = Path("/proc", parent.stdout.readline().strip())
        assert worker.is_dir()
        parent.kill()
    deadline_s = RealClock().now() + 20.0
    while worker.is_dir() and RealClock().now() < deadline_s:
        RealClock().wait_until(RealClock().now() + 0.05)
    assert not worker.is_dir()


def test_stop_returns_running_tasks() -> None:
    numbers: list[int] = []
    for result in run_tasks(
        task_functions.return_process, range(100), Workers(1), lambda: bool(numbers)
    ):
        numbers.append(result.number)
    assert numbers == [0, 1]


THREADS = Workers(2, in_threads=True)


def test_threads_give_the_results_of_processes_without_starting_any() -> None:
    results = {r.number: r for r in run_tasks(task_functions.square, range(50), THREADS)}
    assert results == {number: TaskResult(number, number**2) for number in range(50)}
    processes = {r.value for r in run_tasks(task_functions.return_process, range(8), THREADS)}
    assert processes == {os.getpid()}


def test_a_stop_ends_threads_after_what_is_under_way() -> None:
    numbers: list[int] = []
    for result in run_tasks(task_functions.square, range(100), THREADS, lambda: numbers):
        numbers.append(result.number)
    assert sorted(numbers) == list(range(len(numbers)))
    assert 1 <= len(numbers) <= 3


def test_exception_of_a_task_in_a_thread_is_raised() -> None:
    with pytest.raises(ValueError, match="three"):
        list(run_tasks(task_functions.raise_at_three, range(9), THREADS))


def test_results_are_put_in_order_without_waiting_for_later_ones() -> None:
    taken: list[int] = []

    def complete() -> Iterator[TaskResult]:
        for number in (0, 2, 1, 3, 5):
            taken.append(number)
            yield TaskResult(number)

    in_order = order_results(complete())
    assert [next(in_order).number, *taken] == [0, 0]
    assert [result.number for result in in_order] == [1, 2, 3]


def test_a_cluster_gives_the_results_of_local_processes(scheduler: str) -> None:
    numbers = range(50)
    local = {r.number: r for r in run_tasks(task_functions.square, numbers, Workers(2))}
    remote = {r.number: r for r in run_tasks(task_functions.square, numbers, Workers(0, scheduler))}
    assert remote == local


def test_a_cluster_runs_the_tasks_elsewhere(scheduler: str) -> None:
    results = run_tasks(task_functions.return_process, range(8), Workers(0, scheduler))
    processes = {result.value for result in results}
    assert os.getpid() not in processes
    assert len(processes) == 2


def test_a_task_that_fails_on_a_cluster_is_a_failure_with_its_reason(scheduler: str) -> None:
    results = run_tasks(task_functions.raise_at_three, range(5), Workers(0, scheduler))
    by_number = {result.number: result for result in results}
    assert by_number.pop(3).failure == "three is refused"
    assert all(result.value == number for number, result in by_number.items())


def test_worker_of_a_cluster_that_gives_no_results_is_named_and_left_out(scheduler: str) -> None:
    faulty: list[int] = []
    lines: list[str] = []

    def find_fault(process: int) -> str:
        faulty[:] = faulty or [process]
        return "it cannot write" if process in faulty else ""

    results = run_tasks(
        task_functions.return_process, range(8), Workers(0, scheduler),
        find_fault=find_fault, tell=lines.append,
    )  # fmt: skip
    by_number = {result.number: result for result in results}
    assert sorted(by_number) == [*range(8)]
    assert all(not result.failure and result.value not in faulty for result in by_number.values())
    (line,) = lines
    assert re.fullmatch(r"worker tcp://\S+ gets no more tasks: it cannot write", line)


def test_cluster_without_a_worker_that_gives_results_has_failed(scheduler: str) -> None:
    results = run_tasks(
        task_functions.square, [1], Workers(0, scheduler), find_fault=lambda _: "it cannot write"
    )
    (result,) = results
    assert re.fullmatch(r"it cannot write \(worker tcp://\S+\)", result.failure)


def test_a_stop_ends_a_cluster_run(scheduler: str) -> None:
    numbers: list[int] = []
    for result in run_tasks(
        task_functions.square, range(10_000), Workers(0, scheduler), lambda: len(numbers) > 3
    ):
        numbers.append(result.number)
    assert 4 <= len(numbers) < 100


def test_a_scheduler_that_does_not_answer_is_refused(unused_port: int) -> None:
    with raises_input_error(key="--scheduler"):
        list(run_tasks(task_functions.square, [1], Workers(0, f"tcp://127.0.0.1:{unused_port}")))


@pytest.fixture
def unused_port(monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setattr("twin.system.process_pool.CONNECT_TIMEOUT_S", 0.5)
    return 9


def test_a_cluster_whose_workers_all_die_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("twin.system.process_pool.MAX_IDLE_S", 2.0)
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, dashboard_address="127.0.0.1:0"
    ) as cluster:
        results = run_tasks(
            task_functions.hang_at_odd, [0, 1], Workers(0, cluster.scheduler_address)
        )
        assert next(results).number == 0
        cluster.scale(0)
        with raises_input_error(key="--scheduler", problem="no workers"):
            list(results)


def test_a_cluster_whose_scheduler_dies_is_given_up(capfd: pytest.CaptureFixture[str]) -> None:
    with ExitStack() as stack:
        helpers, address = start_cluster(stack)
        for helper in helpers:
            stack.callback(helper.kill)
        results = run_tasks(task_functions.hang_at_odd, [0, 1, 3], Workers(0, address))
        assert next(results).number == 0
        helpers[0].kill()
        with raises_input_error(key="--scheduler", problem="no longer answers"):
            list(results)
    assert "Traceback" not in capfd.readouterr().err


def test_a_worker_of_another_version_is_refused(
    scheduler: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    versions = read_installed_versions() | {"numpy": "0.1"}
    monkeypatch.setattr("twin.system.process_pool.read_installed_versions", lambda: versions)
    with raises_input_error(problem="numpy 0.1", key="--scheduler"):
        list(run_tasks(task_functions.square, [1], Workers(0, scheduler)))


def test_a_worker_that_cannot_do_the_work_is_refused(scheduler: str) -> None:
    results = run_tasks(
        task_functions.square, [1], Workers(0, scheduler),
        find_problem=task_functions.find_missing_folder,
    )  # fmt: skip
    with raises_input_error(problem="it has no folder", key="--scheduler"):
        list(results)


def test_processes_and_a_cluster_are_not_asked_for_at_once() -> None:
    with raises_input_error(key="--workers"):
        Workers.from_options(2, "tcp://host:8786")


def test_a_folder_that_is_not_shared_is_found_by_a_file_in_it(tmp_path: Path) -> None:
    path = tmp_path / "definition"
    assert "does not see" in find_sharing_problem(path, "text")
    path.write_text("text")
    assert find_sharing_problem(path, "text") == ""
    assert "another" in find_sharing_problem(path, "other")
