"""Every backend keeps the contract; and each clause fails where it is broken.

A new backend is held to the clauses by one more entry of BENCHES.
"""

import inspect
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from pathlib import Path

import numpy as np
import pytest

from table_io.backends.machine.client import MachineBackend
from table_io.backends.ni.backend import NiBackend
from table_io.block import Float1D
from table_io.clock import Clock, ManualClock, RealClock
from table_io.config.base import parse_toml
from table_io.config.rig import RigConfig
from table_io.sim.opendaq import DrivePlayback
from table_io.sim.simulated_table import SimulatedBackend
from tests.builders.profiles import SPECIMEN
from tests.table_io.acquisition.external_controller import Bystander
from tests.table_io.backends.conformance import ACQUIRING, CLAUSES, RATE_HZ, Bench, read_lossy_rig
from tests.table_io.backends.ni_wire import Bed
from tests.table_io.backends.udp_bench import bench_of, c_target, python_target, relay_packets

OpenBench = Callable[[Path], AbstractContextManager[Bench]]


def make_simulated_bench(clock: Clock, kind: type[SimulatedBackend] = SimulatedBackend) -> Bench:
    rig, _ = read_lossy_rig("simulated")
    return Bench(rig, clock, lambda rate: kind(rig, SPECIMEN, rate, clock), repeatable=True)


def make_following_bench(clock: Clock, kind: type[Bystander] = Bystander) -> Bench:
    """The Source of a session that follows: no queue, and somebody else plays."""
    rig, _ = read_lossy_rig("follow_simulated")

    def play(source: Bystander, volts: Float1D) -> None:
        source.file = DrivePlayback(volts / rig.output.volts_per_m, RATE_HZ, RATE_HZ, 0.0)
        source.start()

    def make(rate: float) -> Bystander:
        return kind(rig, SPECIMEN, rate, clock, np.zeros(2), begins=0.0)

    return Bench(rig, clock, make, repeatable=True, play=play)


def make_ni_bench() -> Bench:
    """Client and device in one process, on one clock."""
    bed = Bed(read_lossy_rig("ni_simulated")[1])
    return Bench(bed.rig, bed.clock, bed.backend, repeatable=True)


@contextmanager
def serve(
    name: str, shipped: str, address: str, folder: Path, pace: float = 1.0
) -> Iterator[Bench]:
    """A simulated machine as a process of its own."""
    text = read_lossy_rig(name)[1].replace(shipped, address)
    path = folder / "card.toml"
    path.write_text(text)
    rig, clock = parse_toml(text, RigConfig, str(path)), RealClock(pace)
    kind = {"machine": MachineBackend, "ni_simulated": NiBackend}[name]
    program = Path(sys.executable).parent / "shaketwin"
    command = [str(program), "table", "--rig", str(path), "--time-scale", f"{pace:g}"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert "waiting at" in process.stdout.readline()
        try:
            yield Bench(rig, clock, lambda rate: kind(rig, SPECIMEN, rate, clock), repeatable=True)
        finally:
            process.terminate()


def serve_machine(folder: Path) -> AbstractContextManager[Bench]:
    return serve("machine", "tcp/127.0.0.1:7450", f"unix/{folder / 'table'}", folder)


def serve_ni(folder: Path) -> AbstractContextManager[Bench]:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    return serve("ni_simulated", "127.0.0.1:7470", address, folder, 2.0)


def serve_udp(side: str, is_lossy: bool) -> OpenBench:
    """A UDP target in Python or in C, also where packets are lost on the way."""

    @contextmanager
    def open_target(folder: Path) -> Iterator[Bench]:
        with ExitStack() as stack:
            target = {"python": python_target, "c": c_target}[side]
            address = stack.enter_context(target(folder))
            if is_lossy:
                address = stack.enter_context(relay_packets(address, seed=1)).address
            yield bench_of(address, RealClock(), repeatable=side == "python")

    return open_target


BENCHES: dict[str, OpenBench] = {
    "simulated, manual clock": lambda _: nullcontext(make_simulated_bench(ManualClock())),
    "simulated, real clock": lambda _: nullcontext(make_simulated_bench(RealClock(2.0))),
    "machine process": serve_machine,
    "ni, one process": lambda _: nullcontext(make_ni_bench()),
    "ni server": serve_ni,
    "udp c, lossy": serve_udp("c", is_lossy=True),
    "udp python, lossy": serve_udp("python", is_lossy=True),
    "udp c": serve_udp("c", is_lossy=False),
    "udp python": serve_udp("python", is_lossy=False),
    "follow, manual clock": lambda _: nullcontext(make_following_bench(ManualClock())),
    "follow, real clock": lambda _: nullcontext(make_following_bench(RealClock(2.0))),
}
# What holds where packets are lost holds where none are; that is tried less often.
SLOW_BENCHES = {"udp python, lossy", "udp c", "udp python"}


@pytest.fixture(scope="module")
def open_bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[str], Bench]]:
    """Opens a bench by its name and keeps it until another one is asked for."""
    with ExitStack() as stack:
        opened: dict[str, Bench] = {}

        def find(name: str) -> Bench:
            if name not in opened:
                opened.clear()
                stack.close()
                opened[name] = stack.enter_context(BENCHES[name](tmp_path_factory.mktemp("bench")))
            return opened[name]

        yield find


@pytest.fixture
def bench(request: pytest.FixtureRequest, open_bench: Callable[[str], Bench]) -> Bench:
    return open_bench(request.param)


@pytest.mark.parametrize(
    ("bench", "clause"),
    [
        pytest.param(name, clause, marks=[pytest.mark.slow] if name in SLOW_BENCHES else [])
        for name in BENCHES
        for clause in (ACQUIRING if name.startswith("follow") else CLAUSES)
    ],
    indirect=["bench"],
)
def test_backend_keeps_the_contract(clause: str, bench: Bench) -> None:
    CLAUSES[clause](bench)


def test_omitted_clauses_of_a_source_queue_a_command() -> None:
    for name in CLAUSES.keys() - ACQUIRING.keys():
        assert "backend.queue(" in inspect.getsource(CLAUSES[name])
