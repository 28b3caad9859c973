"""A Dask cluster whose scheduler and workers are processes that can be killed."""

import subprocess
import sys
from contextlib import ExitStack

import distributed

from tests.builders.ports import free_port


def start_cluster(stack: ExitStack) -> tuple[list[subprocess.Popen[bytes]], str]:
    """Start a scheduler and two workers with nannies; return them and the address."""
    address = f"tcp://127.0.0.1:{free_port()}"
    dask = [sys.executable, "-m", "dask"]
    scheduler = [*dask, "scheduler", "--no-dashboard", "--host", address]
    worker = [*dask, "worker", address, "--nthreads", "1", "--no-dashboard"]
    helpers = [stack.enter_context(start_quietly(each)) for each in (scheduler, worker, worker)]
    with distributed.Client(address, timeout="60s", set_as_default=False) as client:
        client.wait_for_workers(2)
    return helpers, address


def start_quietly(words: list[str]) -> "subprocess.Popen[bytes]":
    return subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
