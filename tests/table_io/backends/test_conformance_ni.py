"""The NI backend keeps the contract: in one process on one clock, and through a server."""

import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from table_io.backends.ni.backend import NiBackend
from table_io.clock import RealClock
from table_io.config.base import parse_toml
from table_io.config.rig import RigConfig
from tests.table_io.backends.conformance import CLAUSES, LOST, RATE_HZ, Bench
from tests.table_io.backends.ni_wire import CARD, SPECIMEN, Bed

CLOCK_PACE = 2.0  # times as fast as the clock
LOSS = f"""
[[simulated.faults]]
kind = "dropped"
at_s = {LOST[0] / RATE_HZ}
for_s = {len(LOST) / RATE_HZ}
"""


@contextmanager
def one_process() -> Iterator[Bench]:
    """Client and device in one process, on one clock."""
    bed = Bed(CARD + LOSS)
    yield Bench(bed.rig, bed.clock, bed.backend, repeatable=True)


@contextmanager
def server(folder: Path) -> Iterator[Bench]:
    """The device as a process of its own, behind gRPC."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    text = (CARD + LOSS).replace("127.0.0.1:7470", address)
    path = folder / "card.toml"
    path.write_text(text)
    rig, clock = parse_toml(text, RigConfig, str(path)), RealClock(CLOCK_PACE)
    program = Path(sys.executable).parent / "shaketwin"
    command: list[str | Path] = [program, "table", "--rig", path, "--time-scale", f"{CLOCK_PACE:g}"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert "waiting at" in process.stdout.readline()
        try:
            make = lambda rate: NiBackend(rig, SPECIMEN, rate, clock)  # noqa: E731
            yield Bench(rig, clock, make, repeatable=True)
        finally:
            process.terminate()


@pytest.fixture(scope="module", params=["one process", "server"])
def bench(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Bench]:
    """Both ways to a device."""
    if request.param == "server":
        with server(tmp_path_factory.mktemp("ni")) as ni_bench:
            yield ni_bench
    else:
        with one_process() as ni_bench:
            yield ni_bench


@pytest.mark.parametrize("clause", CLAUSES)
def test_ni_backend_keeps_the_contract(clause: str, bench: Bench) -> None:
    CLAUSES[clause](bench)
