"""A rig and a UDP target over real sockets: what each is told where the other is not in order."""

import socket
import subprocess
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from table_io.backends import (
    HEARTBEAT_TIMEOUT_S,
    SAMPLE_TIMEOUT_S,
    MachineLost,
    check_reachable,
    open_backend,
)
from table_io.backends.udp.backend import UdpBackend
from table_io.backends.udp.packets import (
    REASON_TEXTS,
    PacketKind,
    Phase,
    Reason,
    RigPacket,
    TargetState,
    UdpWiring,
    decode_target_state,
    encode_rig_packet,
    encode_target_state,
    query_target,
    sequence_difference,
)
from table_io.clock import RealClock
from table_io.config.base import PROFILES_DIR, load_config, parse_toml
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig
from table_io.errors import InputError
from table_io.sim.machine.table import SimulatedMachine
from table_io.sim.udp.server import UdpTarget, bind_socket, serve_udp_target
from tests.builders.drives import make_bump
from tests.input_errors import raises_input_error
from tests.table_io.backends.udp_bench import (
    SPECIMEN,
    Address,
    Relay,
    card,
    compile_sanitized,
    free_port,
    relay_packets,
)

RATE_HZ = 2000.0
CLOCK = RealClock()


def rig_at(address: Address) -> RigConfig:
    return parse_toml(card(address, ""), RigConfig, "udp")


def rig_side(address: Address) -> UdpBackend:
    return UdpBackend(rig_at(address), SPECIMEN, RATE_HZ, CLOCK)


@dataclass
class Served:
    """A target that runs beside the test."""

    address: Address
    notices: list[str]


@contextmanager
def serve_target() -> Iterator[Served]:
    notices: list[str] = []
    with bind_socket(("127.0.0.1", 0)) as server_socket:
        address = server_socket.getsockname()
        table, going = SimulatedMachine(rig_at(address), notices.append), [True]
        table.warm_up()
        asked = (server_socket, table, CLOCK, lambda: bool(going))
        thread = threading.Thread(target=serve_udp_target, args=asked, daemon=True)
        thread.start()
        try:
            yield Served(address, notices)
        finally:
            going.clear()
            thread.join()


@pytest.fixture
def target() -> Iterator[Served]:
    with serve_target() as server:
        yield server


def start_motion(address: Address, samples: int = 600) -> UdpBackend:
    """A rig whose table moves for a little, to rest."""
    backend = rig_side(address)
    backend.open()
    backend.queue(0, make_bump(0.1, samples))
    backend.start()
    backend.read(20)
    return backend


def test_absent_target_is_refused_with_a_remedy() -> None:
    rig = rig_at(("127.0.0.1", free_port()))
    with pytest.raises(InputError, match=r"127\.0\.0\.1") as error:
        UdpBackend(rig, SPECIMEN, RATE_HZ, CLOCK).open()
    assert "shaketwin table --table udp_simulated" in error.value.remedy


def test_check_reachable_of_a_target_claims_nothing(target: Served) -> None:
    profile = load_config(PROFILES_DIR / "tests" / "quickstart.toml", Profile, "test profile")[0]
    assert isinstance(open_backend(rig_at(target.address), profile, CLOCK), UdpBackend)
    check_reachable(rig_at(target.address))
    backend = rig_side(target.address)
    backend.open()
    check_reachable(rig_at(target.address))
    assert np.isfinite(backend.tare(10)).all()
    backend.close()


def test_rig_that_only_asks_needs_no_port_that_another_has(target: Served) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("", 0))
        held = f"rig_port = {other.getsockname()[1]}\nreplace_after"
        text = card(target.address, "").replace("replace_after", held)
        check_reachable(parse_toml(text, RigConfig, "udp"))


def test_target_that_answers_one_port_only_is_asked_from_that_one() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as far:
        far.bind(("127.0.0.1", 0))
        own = free_port()
        text = card(far.getsockname(), "").replace(
            "replace_after", f"rig_port = {own}\nreplace_after"
        )
        rig, over = parse_toml(text, RigConfig, "udp"), threading.Event()
        wiring = rig.get_section(UdpWiring)
        assert wiring is not None

        def answer() -> None:
            far.settimeout(0.1)
            while not over.is_set():
                with suppress(TimeoutError):
                    _, (host, port) = far.recvfrom(4096)
                    if port == own:
                        far.sendto(encode_target_state(TargetState(Phase.FREE)), (host, port))

        thread = threading.Thread(target=answer)
        thread.start()
        try:
            assert query_target(wiring, CLOCK, 0.3).phase is Phase.FREE
        finally:
            over.set()
            thread.join()


@pytest.mark.parametrize("sequence", [2**31 + 10, 2**32 - 40])
def test_sequence_numbers_of_an_old_target_wrap(
    sequence: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Old(UdpTarget):
        def __init__(self, table: SimulatedMachine) -> None:
            super().__init__(table)
            self._sequence = sequence

    monkeypatch.setattr("table_io.sim.udp.server.UdpTarget", Old)
    with serve_target() as server, closing(start_motion(server.address)) as backend:
        volts = np.concatenate([backend.read(100) for _ in range(5)], axis=1)
        backend.queue(1200, np.zeros(10))
    assert np.isfinite(volts).all()


def test_of_two_numbers_the_newer_is_less_than_half_way_round_ahead() -> None:
    pairs = ((5, 3), (3, 5), (1, 2**32 - 1), (2**32 - 1, 1))
    assert [sequence_difference(*pair) for pair in pairs] == [2, -2, 2, -2]


@pytest.mark.parametrize(
    ("old", "new", "key"),
    [
        ('target = "', 'target = "nowhere', "udp.target"),
        ('"\nreplace', '0000"\nreplace', "udp.target"),
        ("replace_after_ms = 30.0", "replace_after_ms = 0", "udp.replace_after_ms"),
        ("replace_after_ms = 30.0", "rig_port = 70000", "udp.rig_port"),
        ("replace_after_ms = 30.0", "replace_after_ms = 20.0", "udp.replace_after_ms"),
        ("[udp]", "[udpp]", "udp"),
        ("bits = 18", "bits = 16", ""),
    ],
)
def test_wiring_that_does_not_fit_is_refused(target: Served, old: str, new: str, key: str) -> None:
    def claim() -> None:
        rig = parse_toml(card(target.address, "").replace(old, new), RigConfig, "card")
        UdpBackend(rig, SPECIMEN, RATE_HZ, CLOCK).open()

    with pytest.raises(InputError) as error:
        claim()
    assert key in [error.value.key, *(fault.key for fault in error.value.faults)]
    assert bool(key) == (REASON_TEXTS[Reason.CARD] not in error.value.problem)
    again = rig_side(target.address)
    again.open()
    again.close()


def test_rig_at_a_time(target: Served) -> None:
    first = start_motion(target.address)
    with pytest.raises(InputError, match=REASON_TEXTS[Reason.BUSY]):
        rig_side(target.address).open()
    assert np.isfinite(first.read(1200)).all(), "one that waits is alive"
    first.close()


def test_port_that_is_taken_is_named(target: Served) -> None:
    with raises_input_error(key="udp.target", value=f"{target.address[0]}:{target.address[1]}"):
        bind_socket(target.address)


def test_absent_rig_loses_the_target(target: Served) -> None:
    backend = start_motion(target.address)
    CLOCK.wait_until(CLOCK.now() + HEARTBEAT_TIMEOUT_S + 0.15)
    with pytest.raises(MachineLost, match=REASON_TEXTS[Reason.SILENCE]):
        backend.read(2000)
    with pytest.raises(MachineLost, match=REASON_TEXTS[Reason.SILENCE]):
        backend.queue(5000, np.zeros(2))
    backend.close()
    again = rig_side(target.address)
    again.open()  # waits for the rest
    assert "at rest" in target.notices[-1]
    again.close()


def test_target_that_is_switched_off_ends_at_rest() -> None:
    with serve_target() as server:
        backend = start_motion(server.address)
    with pytest.raises(MachineLost, match=REASON_TEXTS[Reason.SWITCHED_OFF]):
        backend.read(20000)
    assert "at rest" in server.notices[-1]


class Mute(Relay):
    """Falls silent."""

    mute = False

    def _mistreat(self, data: bytes, forth: bool) -> list[bytes]:
        return [] if self.mute else [data]


def test_dead_target_is_a_lost_machine(target: Served) -> None:
    with closing(Mute(target.address, 1)) as relay, closing(start_motion(relay.address)) as backend:
        backend.read(80)
        relay.mute = True
        with pytest.raises(MachineLost, match=f"{SAMPLE_TIMEOUT_S:g} s after"):
            backend.read(400)
        assert CLOCK.now() >= backend.scheduled_time_s(499) + SAMPLE_TIMEOUT_S


class Dropping(Relay):
    """Loses every packet that has sample 300, however often it comes."""

    def _mistreat(self, data: bytes, forth: bool) -> list[bytes]:
        state = None if forth else decode_target_state(data)
        if state is None or state.phase is not Phase.RUNNING:
            return [data]
        return [] if state.index <= 300 < state.index + state.values.size // 9 else [data]


def test_samples_that_never_come_are_nan_in_their_place(target: Served) -> None:
    with (
        closing(Dropping(target.address, 1)) as relay,
        closing(start_motion(relay.address, 1600)) as backend,
    ):
        volts = np.concatenate([backend.read(100), backend.read(300), backend.read(100)], axis=1)
        assert CLOCK.now() >= backend.scheduled_time_s(419) + SAMPLE_TIMEOUT_S
    lost = np.flatnonzero(np.isnan(volts).any(axis=0))
    assert 280 in lost
    assert lost.size <= 14
    assert np.isnan(volts[:, lost]).all()


def test_all_samples_come_at_five_percent_of_every_loss(target: Served) -> None:
    with (
        relay_packets(target.address, seed=3, share=0.05) as relay,
        closing(rig_side(relay.address)) as backend,
    ):
        backend.open()
        for _ in range(20):
            backend.queue(0, np.zeros(2000))
        backend.start()
        volts = np.concatenate([backend.read(20) for _ in range(60)], axis=1)
        counts = dict(relay.counts)
    assert np.isfinite(volts).all()
    assert min(counts.values()) > 3, counts


def test_c_target_survives_invalid_packets(tmp_path: Path) -> None:
    """Watched by the compiler's sanitizers: noise, spoilt words, and whole ones without sense."""
    program, port, chance = compile_sanitized(tmp_path), free_port(), np.random.default_rng(1)
    odd = [0, 1, 127, 128, 129, 511, 512, 65535, 65536, 65537, 2**31, 2**32 - 1]
    far = [*odd, -1, -(2**63), 2**63 - 1]
    with subprocess.Popen(
        [str(program), "127.0.0.1", str(port)], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert "waiting" in process.stdout.readline()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as rig_socket:
            rig_socket.connect(("127.0.0.1", port))
            for sequence in range(1, 4000):
                kind = (PacketKind.QUEUE, PacketKind.BEAT, PacketKind.START)[
                    int(chance.integers(3))
                ]
                piece, samples = (odd[i] for i in chance.integers(0, len(odd), 2))
                large = [far[i] for i in chance.integers(0, len(far), 3)]
                values = chance.choice([0.0, 1e300, np.nan, np.inf], chance.integers(0, 129))
                if sequence % 100 == 1:
                    kind = PacketKind.CLAIM
                    values = np.array([RATE_HZ, 9.0, 0.0, 1.0, 1.0, 1.0, 1.0])
                queue = sequence - int(chance.integers(2))
                index, want_from, want_to = large
                word = RigPacket(
                    kind, 1, sequence, index, queue, piece, samples, want_from, want_to, values
                )
                packet = bytearray(encode_rig_packet(word))
                if sequence % 5 == 0:
                    packet[int(chance.integers(len(packet)))] ^= 1
                rig_socket.send(packet[: int(chance.integers(1200)) if sequence % 7 == 0 else None])
                rig_socket.send(chance.bytes(int(chance.integers(1200))))
                if sequence % 50 == 0:
                    CLOCK.wait_until(CLOCK.now() + 0.005)
        wiring = rig_at(("127.0.0.1", port)).get_section(UdpWiring)
        assert wiring is not None
        state = query_target(wiring, CLOCK)
        assert process.poll() is None
        assert state.ignored > 1000
        process.kill()
