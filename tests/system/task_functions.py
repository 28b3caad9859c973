"""Tasks of the tests: they are pickled by name, so they stand in a module of their own."""

import os
import signal
from pathlib import Path

from twin.system.process_pool import Workers, run_tasks


def return_process(number: int) -> int:
    return os.getpid()


def die_of_odd(number: int) -> int:
    if number % 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return os.getpid()


def die_at_first(folder: Path, number: int) -> int:
    """Die unless this number has been tried before."""
    try:
        (folder / str(number)).touch(exist_ok=False)
    except FileExistsError:
        return number
    os.kill(os.getpid(), signal.SIGKILL)
    return -1


def hang_at_odd(number: int) -> int:
    if number % 2:
        signal.pause()
    return os.getpid()


def find_missing_folder() -> str:
    return "it has no folder"


def square(number: int) -> int:
    return number**2


def raise_at_three(number: int) -> int:
    if number == 3:
        raise ValueError("three is refused")
    return number


if __name__ == "__main__":  # a study to be killed: it prints the process of its first task
    for result in run_tasks(return_process, [0, 1], Workers(1)):
        print(result.value, flush=True)
        signal.pause()
