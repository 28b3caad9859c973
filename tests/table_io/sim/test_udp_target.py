"""Both far sides, in Python and in C, in time that passes when it is told to: the same deeds."""

import atexit
import ctypes
import itertools
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Protocol

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from table_io.backends import HEARTBEAT_TIMEOUT_S
from table_io.backends.command_buffer import plan_stop
from table_io.backends.udp.packets import (
    RING_SAMPLES,
    TARGET_PACKET_BYTES,
    VALUES_PER_PACKET,
    PacketKind,
    Phase,
    QueueVerdict,
    Reason,
    RigPacket,
    TargetState,
    decode_target_state,
    encode_rig_packet,
    rig_checksum,
)
from table_io.block import Float1D
from table_io.config.base import parse_toml
from table_io.config.rig import RigConfig
from table_io.sim.machine.flight_recorder import FlightRecorder
from table_io.sim.machine.table import SimulatedMachine
from table_io.sim.udp.server import UdpTarget
from tests.builders.flight_records import read_flight_record
from tests.table_io.backends.udp_bench import FLAGS, SOURCES, TEXT

RATE_HZ = 2000.0
RIG = parse_toml(TEXT, RigConfig, "udp")
SCALE = RIG.output.volts_per_m
TICK_S = 0.002
PORT, OTHER = 5001, 5002
Sent = list[tuple[TargetState, int]]
HOOKS = """
#include "target.h"
double played[1 << 18]; int plays, beats, lose;
static double now;
void write_output(double volts) { now = volts; if (plays < 1 << 18) played[plays++] = volts; }
int read_inputs(double volts[CHANNELS]) {
    for (int k = 0; k < CHANNELS; k++) volts[k] = now;
    return !lose;
}
void write_heartbeat(int level) { static int was; beats += level != was; was = level; }
int hear(const uint8_t *packet, int bytes, int port) {
    struct peer from = {1, (uint16_t)port};
    int starts = target_hear(packet, (size_t)bytes, from);
    if (starts) plays = 0;
    return starts;
}
int packet(uint8_t *out) { struct peer to; return target_packet(out, &to) ? to.port : -1; }
"""


class Far(Protocol):
    """A far side: what it hears, what it sends as time passes, what it played in V."""

    def hear(self, data: bytes, port: int) -> None: ...
    def tick(self) -> Sent: ...
    def read_command(self) -> Float1D: ...


class PythonFar:
    """`target.py`, with the simulated table."""

    def __init__(self, folder: Path) -> None:
        self._now = 100.0
        self._path = folder / "box"
        self._path.unlink(missing_ok=True)
        self._target = UdpTarget(
            SimulatedMachine(RIG, lambda _: None, FlightRecorder(self._path, print))
        )

    def hear(self, data: bytes, port: int) -> None:
        self._target.handle_packet(data, ("127.0.0.1", port), self._now)

    def tick(self) -> Sent:
        self._now += TICK_S
        sent = self._target.tick(self._now)
        return [(state_in(data), address[1]) for data, address in sent]

    def read_command(self) -> Float1D:
        life = read_flight_record(self._path)[-1]
        return life.command_m * life.volts_per_m


class CFar:
    """`target.c`, whose inputs are all its output."""

    def __init__(self, folder: Path) -> None:
        library = folder / f"target{next(COUNT)}.so"  # its memory is static: one library a life
        shutil.copy(build_target(), library)
        self.library = ctypes.CDLL(str(library))
        self.library.target_rate_hz.restype = ctypes.c_double
        self.library.target_init()
        self._packet = (ctypes.c_uint8 * TARGET_PACKET_BYTES)()

    def hear(self, data: bytes, port: int) -> None:
        if self.library.hear(data, len(data), port):
            self.library.target_sample()  # sample 0 is that of the start

    def tick(self) -> Sent:
        for _ in range(round(TICK_S * self.library.target_rate_hz())):
            self.library.target_sample()
        sent: Sent = []
        while (port := self.library.packet(self._packet)) >= 0:
            sent.append((state_in(bytes(self._packet)), port))
        return sent

    def read_command(self) -> Float1D:
        plays = ctypes.c_int.in_dll(self.library, "plays").value
        return np.array((ctypes.c_double * (1 << 18)).in_dll(self.library, "played")[:plays])


COUNT = itertools.count()


@cache
def build_target() -> Path:
    """`target.c` with the hooks, as a library; skips where there is no compiler."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler (cc) on this computer")
    folder = Path(tempfile.mkdtemp())
    source, library = folder / "hooks.c", folder / "target.so"
    source.write_text(HOOKS)
    command = [compiler, *FLAGS, "-fPIC", "-shared", f"-I{SOURCES}", str(source)]
    subprocess.run([*command, str(SOURCES / "target.c"), "-lm", "-o", str(library)], check=True)
    atexit.register(shutil.rmtree, folder)
    return library


def state_in(data: bytes) -> TargetState:
    state = decode_target_state(data)
    assert state is not None
    return state


@dataclass
class Desk:
    """A far side, and a rig that says what it is told to."""

    far: Far
    session: int = 7
    sequence: int = 0
    queues: int = 0
    sent_states: Sent = field(default_factory=list)

    def say(self, word: RigPacket, port: int = PORT) -> None:
        self.sequence = (self.sequence + 1) & 0xFFFFFFFF
        word = replace(word, session=word.session or self.session, sequence=self.sequence)
        self.far.hear(encode_rig_packet(word), port)

    def wait(self, seconds: float, beats: bool = True) -> TargetState:
        """Time passes; the last state that the rig was told."""
        for _ in range(round(seconds / TICK_S)):
            if beats:
                self.say(RigPacket(PacketKind.BEAT))
            self.sent_states += self.far.tick()
        return next(state for state, port in reversed(self.sent_states) if port == PORT)

    def queue(self, index: int, volts: Float1D, leave_out: int = -1) -> TargetState:
        """Every piece of a command but one, in a mixed order; the state after it."""
        self.queues += 1
        pieces = list(range(-(-volts.size // VALUES_PER_PACKET)))
        for piece in pieces[1::2] + pieces[::2]:
            if piece != leave_out:
                self.say(self.piece(index, volts, piece))
        return self.wait(TICK_S)

    def piece(self, index: int, volts: Float1D, piece: int) -> RigPacket:
        values = volts[VALUES_PER_PACKET * piece : VALUES_PER_PACKET * (piece + 1)]
        return RigPacket(
            PacketKind.QUEUE, index=index, queue=self.queues, piece=piece, samples=volts.size,
            values=values,
        )  # fmt: skip

    def claim(
        self, rate: float = RATE_HZ, channels: int = 9, card: int = 0, port: int = PORT
    ) -> None:
        numbers = [rate, channels, card, 550.0, 4.0, np.nan, np.nan]
        self.say(RigPacket(PacketKind.CLAIM, values=np.array(numbers)), port)

    def drive(self, volts: Float1D) -> None:
        """Claim, queue, start."""
        self.claim()
        assert self.queue(0, volts).verdict is QueueVerdict.PLAYS
        self.say(RigPacket(PacketKind.START))
        assert self.wait(TICK_S).phase is Phase.RUNNING

    def samples(self) -> dict[int, Float1D]:
        """Samples of the run that were sent, by index; the same where it was sent again."""
        rows: dict[int, Float1D] = {}
        for state, port in self.sent_states:
            if state.phase is Phase.RUNNING and port == PORT and state.session == self.session:
                for k, row in enumerate(state.values.reshape(-1, 9)):
                    assert np.array_equal(rows.setdefault(state.index + k, row), row, True)
        return rows

    def rest(self) -> None:
        """Time passes without a rig until the target is free; it has ten seconds."""
        for _ in range(5000):
            self.far.hear(encode_rig_packet(RigPacket(PacketKind.BEAT)), OTHER)
            self.sent_states += self.far.tick()
            if (
                next(s for s, port in reversed(self.sent_states) if port == OTHER).phase
                is Phase.FREE
            ):
                return
        raise AssertionError("it did not come to rest")


def sine(seconds: float, volts: float = 1.0, f: float = 2.0) -> Float1D:
    """A motion that grows smoothly and goes on: its end is in motion."""
    t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    x = np.clip(t / 0.5, 0.0, 1.0)
    motion: Float1D = volts * x**3 * (10 + x * (-15 + 6 * x)) * np.sin(2 * np.pi * f * t)
    return motion


def acceleration(volts: Float1D) -> float:
    """Largest acceleration of a command in m/s2, rest before it included."""
    return float(
        np.abs(np.diff(np.concatenate([np.zeros(2), volts]), 2)).max() * RATE_HZ**2 / SCALE
    )


def check_played(desk: Desk, volts: Float1D) -> None:
    """The first of what was played are these; the black box keeps metres, so to a rounding."""
    np.testing.assert_allclose(desk.far.read_command()[: volts.size], volts, rtol=1e-14, atol=1e-15)


@pytest.fixture(params=[PythonFar, CFar])
def desk(request: pytest.FixtureRequest, tmp_path: Path) -> Desk:
    return Desk(request.param(tmp_path))


def test_command_is_replaced_at_once_and_whole(desk: Desk) -> None:
    volts, other = sine(1.0), np.linspace(0.0, 0.0, 700)
    desk.drive(volts)
    desk.wait(0.1)
    other = volts[600] * np.linspace(1.0, 0.0, 700) ** 3
    assert desk.queue(600, other, leave_out=2).verdict is QueueVerdict.ARRIVING
    assert desk.sent_states[-1][0].pieces[:7].tolist() == [
        True,
        True,
        False,
        True,
        True,
        True,
        False,
    ]
    assert desk.wait(0.1).verdict is QueueVerdict.ARRIVING
    desk.say(desk.piece(600, other, 2))
    assert desk.wait(TICK_S).verdict is QueueVerdict.PLAYS
    desk.wait(0.5)
    whole = np.concatenate([volts[:600], other])
    check_played(desk, whole[:1300])


def test_command_that_never_arrives_whole_changes_nothing(desk: Desk) -> None:
    volts = sine(1.0)
    desk.drive(volts)
    desk.queue(400, np.full(700, 0.5), leave_out=3)
    short = desk.piece(400, np.full(700, 0.5), 3)
    desk.say(replace(short, values=short.values[:50]))
    assert desk.wait(0.4).verdict is QueueVerdict.ARRIVING
    desk.queue(1200, np.full(10, 9.0), leave_out=0)  # a newer one makes it void
    desk.queues -= 1
    desk.say(desk.piece(400, np.full(700, 0.5), 3))
    desk.wait(0.4)
    check_played(desk, volts[:1600])


@pytest.mark.parametrize("bad", ["late", "nan", "long", "far", "negative"])
def test_command_that_cannot_be_played_is_refused_whole(desk: Desk, bad: str) -> None:
    volts = sine(1.0)
    desk.drive(volts)
    index, command, verdict = 300, np.full(200, 0.5), QueueVerdict.NONSENSE
    desk.wait(0.1)
    if bad == "late":
        index, verdict = 200, QueueVerdict.LATE
    elif bad == "far":
        index = RING_SAMPLES + 300
    elif bad == "nan":
        command[150] = np.nan
    elif bad == "long":
        command = np.zeros(RING_SAMPLES + 1)
        desk.queue(index, command)
        assert desk.wait(TICK_S).queue == 1, "what no ring holds is not even begun"
        verdict = QueueVerdict.PLAYS
    else:
        index = -(2**63)
    assert bad == "long" or desk.queue(index, command).verdict is verdict
    desk.wait(0.3)
    check_played(desk, volts[:800])


@pytest.mark.parametrize("volts", [10.1, -25.0, 1e308])
def test_more_than_the_output_has_is_refused_whole(desk: Desk, volts: float) -> None:
    desk.drive(sine(1.0))
    desk.wait(0.1)
    command = np.full(200, 0.5)
    command[100] = volts
    assert desk.queue(300, command).verdict is QueueVerdict.NONSENSE
    command[100] = np.copysign(10.0, volts)
    assert desk.queue(300, command).verdict is QueueVerdict.PLAYS


@pytest.mark.parametrize(
    ("mm", "f", "turn"),
    [
        *itertools.product([50.0], [0.8, 1.0, 1.5], np.arange(0.0, 1.0, 0.25)),
        *itertools.product([12.0], [4.0], np.arange(0.0, 1.0, 0.25)),
        (59.99, 1.5, 0.2), (59.99, 1.5, 0.23),
    ],
)  # fmt: skip
def test_large_motion_is_landed_within_the_span(
    desk: Desk, mm: float, f: float, turn: float
) -> None:
    """The same in both: the landing of `command_buffer.py`."""
    volts = sine((2.0 + turn) / f, mm / 6.0, f)
    desk.drive(volts)
    desk.wait(0.02, beats=False)
    desk.rest()
    played = desk.far.read_command()
    assert np.abs(played).max() <= 10.0 * (1.0 + 1e-12)
    assert played[-1] == 0.0
    landed = plan_stop(volts[-3:] / SCALE, RATE_HZ, 0.06) * SCALE
    after = played[volts.size : volts.size + landed.size]
    np.testing.assert_allclose(after, landed[: after.size], atol=1e-5)
    assert not played[volts.size + landed.size :].any()


def test_gap_between_two_queues_holds_the_last_value_whatever_was_played_before(desk: Desk) -> None:
    desk.drive(np.append(sine(2.2, 3.0), np.zeros(4000)))
    desk.wait(1.5)
    desk.say(RigPacket(PacketKind.RELEASE))
    desk.rest()
    desk.session, desk.queues, desk.sequence = 9, 0, 0
    desk.sent_states.clear()
    desk.claim()
    desk.wait(1.0)  # samples at rest play nothing, and are none of the command
    assert desk.queue(0, np.zeros(2)).verdict is QueueVerdict.PLAYS
    assert desk.queue(4000, np.zeros(10)).verdict is QueueVerdict.PLAYS
    desk.say(RigPacket(PacketKind.START))
    desk.wait(2.2)
    assert not desk.far.read_command().any()


def test_sequence_numbers_wrap(desk: Desk) -> None:
    desk.sequence = 2**32 - 20
    desk.drive(sine(3.0))
    state = desk.wait(2.0 * HEARTBEAT_TIMEOUT_S)
    assert desk.sequence < 2**31
    assert (state.phase, state.missed) == (Phase.RUNNING, 0)


AGED = """
#include <stdlib.h>
#include "target.c"
static int changes;
void write_output(double volts) { (void)volts; }
int read_inputs(double volts[CHANNELS]) { volts[0] = 0.0; return 0; }
void write_heartbeat(int level) { static int was; changes += level != was; was = level; }
int main(void) {
    target_init();
    t.beats = (int64_t)1 << 42;
    target_sample();
    changes = 0;
    for (int k = 0; k < 2000; k++) target_sample();
    return abs(changes - 20) > 1;
}
"""


def test_heartbeat_beats_on_after_years(tmp_path: Path) -> None:
    build_target()  # or skip
    source, program = tmp_path / "aged.c", tmp_path / "aged"
    source.write_text(AGED)
    command = ["cc", "-O1", f"-I{SOURCES}", str(source), "-lm", "-o", str(program)]
    subprocess.run(command, check=True)
    assert subprocess.run([str(program)], check=False).returncode == 0


def test_before_the_start_a_whole_ring_can_be_filled_and_no_more(desk: Desk) -> None:
    desk.claim()
    desk.wait(1.0)  # samples at rest are no room
    assert desk.queue(RING_SAMPLES - 100, np.zeros(101)).verdict is QueueVerdict.NONSENSE
    assert desk.queue(0, np.linspace(0.0, 1e-3, RING_SAMPLES)).verdict is QueueVerdict.PLAYS


def test_silent_rig_is_lost_in_time_and_the_table_comes_to_rest(desk: Desk) -> None:
    volts = sine(0.8)
    desk.drive(volts)
    desk.wait(0.2)
    assert desk.wait(HEARTBEAT_TIMEOUT_S - 3 * TICK_S, beats=False).phase is Phase.RUNNING
    state = desk.wait(6 * TICK_S, beats=False)
    assert (state.phase, state.reason) == (Phase.ENDING, Reason.SILENCE)
    desk.rest()
    played = desk.far.read_command()
    check_played(desk, volts)
    assert played[-1] == 0.0
    assert acceleration(played) <= 1.05 * max(acceleration(volts), 0.5)
    assert played.size < volts.size + 8 * RATE_HZ


def test_table_off_its_mean_returns_after_release(desk: Desk) -> None:
    x = np.linspace(0.0, 1.0, 1000)
    desk.drive(np.append(x**3 * (10 + x * (-15 + 6 * x)), 1.0))
    desk.wait(1.0)
    desk.say(RigPacket(PacketKind.RELEASE))
    assert desk.wait(TICK_S).reason is Reason.RELEASED
    desk.rest()
    played = desk.far.read_command()
    assert played[2000] == pytest.approx(1.0)
    assert played[-1] == 0.0
    assert acceleration(played) < 0.55


def test_old_word_come_again_is_no_sign_of_life(desk: Desk) -> None:
    desk.drive(sine(1.0))
    old = encode_rig_packet(
        RigPacket(PacketKind.BEAT, session=desk.session, sequence=desk.sequence)
    )
    for _ in range(round((HEARTBEAT_TIMEOUT_S + 4 * TICK_S) / TICK_S)):
        desk.far.hear(old, PORT)
        desk.sent_states += desk.far.tick()
    assert desk.sent_states[-1][0].phase is Phase.ENDING


def test_strangers_are_answered_counted_and_change_nothing(desk: Desk) -> None:
    volts = sine(1.0)
    desk.drive(volts)
    stranger = Desk(desk.far, session=8)
    for number, word in enumerate(
        (
            RigPacket(PacketKind.RELEASE),
            RigPacket(PacketKind.QUEUE, index=300),
            RigPacket(PacketKind.START),
        )
    ):
        stranger.say(word, OTHER)
        desk.say(word, OTHER)  # the right session from the wrong place
        stranger.say(word, PORT)  # the right place, another session
        spoilt = bytearray(encode_rig_packet(replace(word, session=desk.session, sequence=2**20)))
        spoilt[70] ^= 1
        desk.far.hear(bytes(spoilt), PORT)
        stranger.claim(port=OTHER)
        replies = [s for s, port in desk.far.tick() if port == OTHER]
        assert replies
        assert {(s.session, s.reason) for s in replies} == {(0, Reason.BUSY)}
        assert desk.wait(TICK_S).ignored == 5 * (number + 1)
    desk.wait(0.1)
    desk.wait(HEARTBEAT_TIMEOUT_S - 4 * TICK_S, beats=False)
    for _ in range(8):
        stranger.say(RigPacket(PacketKind.BEAT), OTHER)
        stranger.say(RigPacket(PacketKind.BEAT), PORT)
        desk.sent_states += desk.far.tick()
    ours = [s for s, port in desk.sent_states if port == PORT and s.session]
    assert ours[-1].phase is Phase.ENDING, "a stranger is no sign of life"
    check_played(desk, volts[:600])


def test_samples_are_sent_again_where_they_are_asked_for(desk: Desk) -> None:
    desk.drive(sine(1.0))
    desk.wait(0.4)
    before = desk.samples()
    desk.sent_states.clear()
    desk.say(RigPacket(PacketKind.BEAT, want_from=100, want_to=150))
    desk.sent_states += desk.far.tick()
    again = desk.samples()
    assert set(range(100, 150)) <= set(again)
    for index in range(100, 150):
        np.testing.assert_array_equal(again[index], before[index])
    desk.sent_states.clear()
    desk.say(RigPacket(PacketKind.BEAT, want_from=0, want_to=2**62))
    desk.sent_states += desk.far.tick()
    assert len(desk.samples()) <= 16 * 14 + 20, "one word asks for so many packets at most"


@pytest.mark.parametrize(
    ("claim", "reason"),
    [
        (lambda desk: desk.claim(rate=1234.5), Reason.RATE),
        (lambda desk: desk.claim(channels=8), Reason.CHANNELS),
    ],
)
def test_claim_that_does_not_fit_is_refused(
    desk: Desk, claim: Callable[[Desk], None], reason: Reason
) -> None:
    claim(desk)
    ((state, port),) = desk.far.tick()
    assert (port, state.phase, state.session, state.reason) == (PORT, Phase.FREE, 0, reason)
    desk.claim()
    assert desk.wait(TICK_S).session == desk.session


def test_another_machine_card_is_refused(tmp_path: Path) -> None:
    desk = Desk(PythonFar(tmp_path))
    desk.claim(card=rig_checksum(RIG) ^ 1)
    assert desk.far.tick()[0][0].reason is Reason.CARD
    desk.claim(card=rig_checksum(RIG))
    assert desk.wait(TICK_S).session == desk.session


def test_session_that_has_ended_claims_no_more(desk: Desk) -> None:
    desk.drive(sine(0.3, 0.1))
    desk.say(RigPacket(PacketKind.RELEASE))
    desk.rest()
    desk.claim()  # a packet that was long on its way
    desk.wait(TICK_S, beats=False)
    assert desk.sent_states[-1][0].phase is Phase.FREE
    again = Desk(desk.far, session=9)
    again.drive(sine(0.3, 0.2))
    again.wait(0.1)
    check_played(desk, sine(0.3, 0.2)[:200])


def test_silent_claim_is_given_up(desk: Desk) -> None:
    desk.claim()
    desk.wait(TICK_S)
    assert desk.wait(29.9, beats=False).phase is Phase.CLAIMED
    desk.wait(0.2, beats=False)
    desk.rest()


def test_lost_inputs_are_nan_and_the_heartbeat_line_beats_ten_times_a_second(
    tmp_path: Path,
) -> None:
    far = CFar(tmp_path)
    desk = Desk(far)
    desk.drive(sine(1.0))
    ctypes.c_int.in_dll(far.library, "lose").value = 1
    beats = ctypes.c_int.in_dll(far.library, "beats")
    desk.sent_states.clear()
    before = beats.value
    desk.wait(1.0)
    assert beats.value - before == pytest.approx(20, abs=1), "edges"
    assert all(np.isnan(row).all() for index, row in desk.samples().items() if index > 20)


NUMBER = st.integers(-(2**62), 2**62) | st.integers(-5, 70000)
COUNTED = st.integers(0, 2**32 - 1) | st.integers(0, 600)
MAD = st.builds(
    RigPacket, st.sampled_from([PacketKind.BEAT, PacketKind.QUEUE, PacketKind.CLAIM]),
    st.integers(1, 9), COUNTED, NUMBER,
    COUNTED, COUNTED, COUNTED, NUMBER, NUMBER,
    st.lists(st.floats(width=64), max_size=VALUES_PER_PACKET).map(np.array),
)  # fmt: skip


FUZZ = settings(max_examples=6, suppress_health_check=[HealthCheck.function_scoped_fixture])


@FUZZ
@given(st.lists(MAD, max_size=8), st.binary(max_size=1200))
def test_packets_of_strangers_change_nothing(
    desk: Desk, words: list[RigPacket], data: bytes
) -> None:
    desk.session, desk.sequence, desk.queues = desk.session + 10, 0, 0
    volts = sine(0.2)
    desk.drive(volts)
    for word in words:
        desk.far.hear(encode_rig_packet(word), PORT)
        desk.far.hear(encode_rig_packet(replace(word, session=desk.session)), OTHER)
        desk.far.hear(data, PORT)
        desk.wait(TICK_S)
    desk.wait(0.1)
    check_played(desk, volts[:200])
    desk.say(RigPacket(PacketKind.RELEASE))
    desk.rest()


@FUZZ
@given(words=st.lists(MAD, max_size=8))
@pytest.mark.parametrize("kind", [PythonFar, CFar])
def test_invalid_packets_of_the_rig_do_no_harm(
    kind: Callable[[Path], Far], tmp_path: Path, words: list[RigPacket]
) -> None:
    """Its commands are taken or refused, and it is still heard."""
    desk = Desk(kind(tmp_path))
    desk.drive(sine(0.2))
    for word in words:
        desk.far.hear(encode_rig_packet(replace(word, session=desk.session)), PORT)
        desk.sent_states += desk.far.tick()
    assert desk.wait(2 * TICK_S).phase is Phase.RUNNING
    desk.say(replace(RigPacket(PacketKind.RELEASE), sequence=2**32 - 1))
    assert desk.wait(2 * TICK_S).phase is Phase.ENDING
    assert np.isfinite(desk.far.read_command()).all()
