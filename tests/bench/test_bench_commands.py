"""Processor time of commands over that of importing the libraries, each in a process of its own.

pytest tests/bench/test_bench_commands.py --benchmark-only -s
"""

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest
from pytest_benchmark.fixture import BenchmarkFixture

LIBRARIES = "import numba, numpy, scipy.linalg"
PROGRAM = "from twin.cli.entry import main; main()"
COMMANDS = {
    "help": ["--help"],
    "check": ["check", "quickstart"],
    "report": ["report", "run"],
}


def measure_processor_s(code: str, arguments: Sequence[str], folder: Path) -> float:
    """Return user and system time in s of a Python process in `folder`."""
    begin = os.times()
    command = [sys.executable, "-c", code, *arguments]
    subprocess.run(command, cwd=folder, check=True, stdout=subprocess.DEVNULL)
    end = os.times()
    return end.children_user + end.children_system - begin.children_user - begin.children_system


@pytest.mark.benchmark(group="commands")
@pytest.mark.parametrize("name", COMMANDS)
def test_command(benchmark: BenchmarkFixture, name: str, tmp_path: Path) -> None:
    if name == "report":
        if not benchmark.enabled:
            pytest.skip("it takes long, and tests/reports run it too")
        arguments = ["run", "quickstart", "--speed", "max", "--out", "run"]
        measure_processor_s(PROGRAM, arguments, tmp_path)
    seconds: list[float] = []

    def run_command() -> None:
        seconds.append(measure_processor_s(PROGRAM, COMMANDS[name], tmp_path))

    benchmark.pedantic(run_command, rounds=5)
    assert seconds
    if benchmark.stats is not None:
        peer_s = min(measure_processor_s(LIBRARIES, (), tmp_path) for _ in range(5))
        benchmark.extra_info["processor_s"] = round(min(seconds), 3)
        benchmark.extra_info["over_imports"] = round(min(seconds) / peer_s, 3)
        print(f"\n{name}: {min(seconds):.2f} s, {min(seconds) / peer_s:.2f} times the libraries")
