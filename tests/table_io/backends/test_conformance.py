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
from table_io.block import Float1D, Float2D
from table_io.clock import Clock, ManualClock, RealClock
from table_io.config.base import parse_toml
from table_io.config.profile import Specimen
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


class EarlyByOne(SimulatedBackend):
    """Input begins one sample after output."""

    def start(self) -> None:
        super().start()
        super().read(1)


class Hasty(SimulatedBackend):
    """Does not wait."""

    def _wait_for_samples(self, first: int, last: int) -> None:
        pass


class Smoothing(SimulatedBackend):
    """Fills what is lost."""

    def read(self, samples: int) -> Float2D:
        return np.nan_to_num(super().read(samples))


class Shifting(SimulatedBackend):
    """Leaves out what was lost, so that nothing keeps its place."""

    def read(self, samples: int) -> Float2D:
        volts = super().read(samples)
        kept = volts[:, ~np.isnan(volts[0])]
        return np.pad(kept, ((0, 0), (0, samples - kept.shape[1])), constant_values=np.nan)


class Coarse(SimulatedBackend):
    """Cuts reads into whole pieces of 8, and loses the rest."""

    def read(self, samples: int) -> Float2D:
        volts = super().read(samples)
        super().read(-samples % 8)
        return volts


class Sloppy(SimulatedBackend):
    """Replaces a sample late."""

    def queue(self, index: int, volts: Float1D) -> None:
        super().queue(index + (index > 0), volts)


class Appending(SimulatedBackend):
    """Replaces no more than what comes: what was queued behind it plays on."""

    def queue(self, index: int, volts: Float1D) -> None:
        behind = self._command[index + volts.size - self._origin :] * self._rig.output.volts_per_m
        super().queue(index, np.concatenate([volts, behind]))


class Slow(SimulatedBackend):
    """Needs longer than it says."""

    def queue(self, index: int, volts: Float1D) -> None:
        if self._epoch is not None and index < self._newest_sample() + 2 * self.replace_after:
            raise ValueError(f"sample {index} is in the device")
        super().queue(index, volts)


class Obliging(SimulatedBackend):
    """Takes what comes too late, for as much of it as is still to come."""

    def queue(self, index: int, volts: Float1D) -> None:
        try:
            super().queue(index, volts)
        except ValueError:
            if np.isfinite(volts).all():
                late = self._newest_sample() + self.replace_after - index
                super().queue(index + late, volts[late:])
            raise


class Silent(SimulatedBackend):
    """Takes what comes too late without a word."""

    def queue(self, index: int, volts: Float1D) -> None:
        try:
            super().queue(index, volts)
        except ValueError:
            if not np.isfinite(volts).all():
                raise


class ByWhatWasRead(SimulatedBackend):
    """Forgets that time passes while nobody reads."""

    def _newest_sample(self) -> int:
        return self._next - 1


class Trusting(SimulatedBackend):
    """Plays what is no voltage as 0 V."""

    def queue(self, index: int, volts: Float1D) -> None:
        super().queue(index, np.nan_to_num(volts, posinf=0.0))


class Zeroing(SimulatedBackend):
    """Writes zeros to stop."""

    def queue(self, index: int, volts: Float1D) -> None:
        super().queue(index, np.append(volts, 0.0))


class Unpunctual(SimulatedBackend):
    """Schedules by another rate than it samples at."""

    def scheduled_time_s(self, index: int) -> float:
        return super().scheduled_time_s(round(1.001 * index))


class Elsewhen(SimulatedBackend):
    """Starts before it is told to."""

    def start(self) -> None:
        super().start()
        assert self._epoch is not None
        self._epoch -= 0.5


class Touchy(SimulatedBackend):
    """Closes once."""

    def close(self) -> None:
        if not self._is_open:
            raise OSError("it is closed")
        super().close()


class Eager(SimulatedBackend):
    """Cares for no order."""

    def _require(self, condition: bool, remedy: str) -> None:
        pass


class Anything(SimulatedBackend):
    """Samples at whatever rate."""

    def open(self) -> None:
        self._is_open = True


class Nervous(SimulatedBackend):
    """Moves while it is tared."""

    def tare(self, samples: int) -> Float2D:
        return super().tare(samples) + np.linspace(0.0, 0.1, samples)


class Short(SimulatedBackend):
    """Tares less than asked for."""

    def tare(self, samples: int) -> Float2D:
        return super().tare(samples // 2)


class Displaced(SimulatedBackend):
    """Begins its life off its mean."""

    def open(self) -> None:
        super().open()
        self._state[2] = 1e-3


class Anonymous(SimulatedBackend):
    """Does not say how far ahead it can be changed."""

    def __init__(self, rig: RigConfig, specimen: Specimen, rate_hz: float, clock: Clock) -> None:
        super().__init__(rig, specimen, rate_hz, clock)
        self.replace_after = 0


BROKEN: dict[str, list[type[SimulatedBackend]]] = {
    "it_says_what_it_is": [Anonymous],
    "open_refuses_a_rate_that_the_machine_has_not": [Anything],
    "calls_out_of_order_are_refused": [Eager],
    "tare_is_the_inputs_at_rest_and_moves_nothing": [Nervous, Short],
    "sample_0_leaves_when_sample_0_is_taken": [EarlyByOne, Elsewhen],
    "samples_are_scheduled_at_the_rate": [Unpunctual],
    "read_waits_for_its_last_sample": [Hasty],
    "how_reads_are_cut_changes_no_sample": [Coarse],
    "what_is_queued_later_is_replaced_exactly": [Sloppy, Appending],
    "the_first_sample_that_may_be_replaced_is": [Slow],
    "what_is_in_the_device_plays_as_it_was_queued": [Obliging, Silent],
    "a_late_rig_cannot_rewrite_the_past": [ByWhatWasRead],
    "what_is_no_voltage_is_refused": [Trusting],
    "the_last_value_is_held": [Zeroing],
    "a_lost_sample_is_nan_and_keeps_its_place": [Smoothing, Shifting],
    "close_is_safe_at_any_time": [Touchy],
    "the_next_life_begins_at_rest_at_sample_0": [Displaced],
}


def test_every_clause_has_its_violation() -> None:
    assert BROKEN.keys() == CLAUSES.keys()


def test_omitted_clauses_of_a_source_queue_a_command() -> None:
    for name in CLAUSES.keys() - ACQUIRING.keys():
        assert "backend.queue(" in inspect.getsource(CLAUSES[name])


@pytest.mark.parametrize(
    ("clause", "kind"),
    [(clause, kind) for clause, kinds in BROKEN.items() for kind in kinds],
    ids=lambda value: value if isinstance(value, str) else value.__name__,
)
def test_clause_fails_for_a_broken_backend(clause: str, kind: type[SimulatedBackend]) -> None:
    with pytest.raises((AssertionError, OSError)):
        CLAUSES[clause](make_simulated_bench(ManualClock(), kind))
    if clause in ACQUIRING and kind is not Anonymous:
        source = type(kind.__name__, (kind, Bystander), {"__init__": Bystander.__init__})
        with pytest.raises((AssertionError, OSError)):
            ACQUIRING[clause](make_following_bench(ManualClock(), source))
