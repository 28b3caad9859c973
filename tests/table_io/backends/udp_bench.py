"""Far sides of the UDP packets to be tested, and a relay that loses packets between them."""

import random
import select
import shutil
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from table_io.backends import udp
from table_io.backends.udp.backend import UdpBackend
from table_io.clock import Clock
from table_io.config.base import parse_toml
from table_io.config.rig import RigConfig
from tests.builders.profiles import SPECIMEN
from tests.builders.rigs import read_rig_text
from tests.table_io.backends.conformance import LOSS, LOST, Bench

Address = tuple[str, int]
TEXT = read_rig_text("udp_simulated")
SHIPPED = "127.0.0.1:7460"
SOURCES = Path(udp.__file__).parent
FLAGS = ["-std=c99", "-O1", "-g", "-Wall", "-Wextra", "-Werror", "-Wconversion", "-pedantic"]
EVILS = ("lost", "doubled", "reordered", "spoilt")
SANITIZERS = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]


def free_port() -> int:
    """A UDP port that nobody has now."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def card(address: Address, loss: str = LOSS) -> str:
    """The shipped machine card, of a target at this address that loses LOST."""
    return TEXT.replace(SHIPPED, f"{address[0]}:{address[1]}") + loss


def bench_of(address: Address, clock: Clock, repeatable: bool = False) -> Bench:
    rig = parse_toml(card(address), RigConfig, "udp")
    return Bench(rig, clock, lambda rate: UdpBackend(rig, SPECIMEN, rate, clock), repeatable)


@contextmanager
def python_target(folder: Path, loss: str = LOSS, *more: str) -> Iterator[Address]:
    """`shaketwin table` as a process of its own."""
    address = ("127.0.0.1", free_port())
    path = folder / "card.toml"
    path.write_text(card(address, loss))
    command = [str(Path(sys.executable).parent / "shaketwin"), "table", "--rig", str(path), *more]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            assert "waiting at" in process.stdout.readline()
            yield address
        finally:
            process.terminate()


def compile_target(folder: Path, *flags: str) -> Path:
    """The C target, compiled with these flags; skips where there is no compiler."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler (cc) on this computer")
    program = folder / "target"
    sources = [str(SOURCES / name) for name in ("target.c", "target_demo.c")]
    subprocess.run([compiler, *FLAGS, *flags, *sources, "-lm", "-o", str(program)], check=True)
    return program


def compile_sanitized(folder: Path) -> Path:
    """The C target, watched by the compiler's sanitizers where it has them."""
    try:
        return compile_target(folder, *SANITIZERS)
    except subprocess.CalledProcessError:
        return compile_target(folder)


@contextmanager
def c_target(folder: Path) -> Iterator[Address]:
    """The C target with its demonstration plant; it ends without a fault."""
    program = compile_sanitized(folder)
    address = ("127.0.0.1", free_port())
    command = [str(program), address[0], str(address[1]), str(LOST[0]), str(len(LOST))]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            assert "waiting" in process.stdout.readline()
            yield address
        finally:
            process.terminate()
            assert process.wait(5) == 0, "the sanitizers found something"


@dataclass
class Relay:
    """Between a rig and a target: loses, doubles, reorders and spoils packets, both ways."""

    target: Address
    seed: int
    share: float = 0.01  # of the packets, of each evil
    counts: dict[str, int] = field(default_factory=lambda: dict.fromkeys(EVILS, 0))
    passed: int = 0

    def __post_init__(self) -> None:
        self.front = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.front.bind(("127.0.0.1", 0))
        self.back = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.back.connect(self.target)
        self.address: Address = self.front.getsockname()
        self._rig: Address | None = None
        self._chance = random.Random(self.seed)
        self._held: dict[bool, bytes] = {}
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._over.set()
        self._thread.join()
        self.front.close()
        self.back.close()

    def _run(self) -> None:
        while not self._over.is_set():
            for source in select.select([self.front, self.back], [], [], 0.05)[0]:
                try:
                    data, address = source.recvfrom(4096)
                except OSError:
                    continue  # nobody listens there now
                if source is self.front:
                    self._rig = address
                for packet in self._mistreat(data, source is self.front):
                    self._send(packet, source is self.front)

    def _send(self, packet: bytes, to_target: bool) -> None:
        self.passed += 1
        try:
            if to_target:
                self.back.send(packet)
            elif self._rig is not None:
                self.front.sendto(packet, self._rig)
        except OSError:
            pass

    def _mistreat(self, data: bytes, forth: bool) -> list[bytes]:
        """What becomes of a packet; one that is held back comes after the next."""
        draw = self._chance.random()
        evil = next((e for k, e in enumerate(EVILS) if draw < (k + 1) * self.share), "")
        if evil:
            self.counts[evil] += 1
        held = self._held.pop(forth, None)
        after = [] if held is None else [held]
        match evil:
            case "lost":
                return after
            case "doubled":
                return [data, data, *after]
            case "spoilt":
                at = self._chance.randrange(len(data))
                return [data[:at] + bytes([data[at] ^ 0x10]) + data[at + 1 :], *after]
            case "reordered":
                self._held[forth] = data
                return after
            case _:
                return [data, *after]


@contextmanager
def relay_packets(target: Address, seed: int, share: float = 0.01) -> Iterator[Relay]:
    with closing(Relay(target, seed, share)) as relay:
        yield relay
