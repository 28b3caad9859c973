"""The two UDP packets, and the socket of a rig that numbers and validates them.

`PACKETS.md` specifies each field.
Little-endian, of fixed length in each direction, with a CRC-32 over all preceding bytes.
"""

import contextlib
import secrets
import select
import socket
import struct
import zlib
from dataclasses import dataclass, field, replace
from enum import IntEnum

import numpy as np
import numpy.typing as npt
from pydantic import Field, field_validator

from table_io.block import Float1D
from table_io.clock import Clock, RealClock
from table_io.config.base import Positive
from table_io.config.rig import BackendConfig, RigConfig
from table_io.errors import InputError

Bool1D = npt.NDArray[np.bool_]

PACKET_VERSION = 1
VALUES_PER_PACKET = 128  # float64 in a packet, either way
RING_SAMPLES = 1 << 16  # samples of one queue, at most
MAX_PIECES = RING_SAMPLES // VALUES_PER_PACKET
RIG_HEADER = struct.Struct("<4sHHQIIqIIIIqq")  # rig -> target, before the values
TARGET_HEADER = struct.Struct("<4sHBBQIIqqqIIIIIId64s")  # target -> rig, before the values
RIG_PACKET_BYTES = RIG_HEADER.size + 8 * VALUES_PER_PACKET + 4
TARGET_PACKET_BYTES = TARGET_HEADER.size + 8 * VALUES_PER_PACKET + 4
RIG_MAGIC, TARGET_MAGIC = b"STUR", b"STUT"


class PacketKind(IntEnum):
    """Kind of a packet from the rig."""

    BEAT = 1
    CLAIM = 2
    QUEUE = 3
    START = 4
    RELEASE = 5


class Phase(IntEnum):
    """State of the target's state machine."""

    FREE = 0
    CLAIMED = 1
    RUNNING = 2
    ENDING = 3


class Reason(IntEnum):
    """Reason for which the target refuses a rig or continues alone."""

    NONE = 0
    BUSY = 1
    RATE = 2
    CHANNELS = 3
    SILENCE = 4
    RELEASED = 5
    SWITCHED_OFF = 6
    CARD = 7


class QueueVerdict(IntEnum):
    """Status of the newest queue of which a piece has arrived."""

    ARRIVING = 0
    PLAYS = 1
    LATE = 2
    NONSENSE = 3


@dataclass(frozen=True, slots=True)
class RigPacket:
    """Packet from the rig; `values` in V, or the parameters of CLAIM."""

    kind: PacketKind
    session: int = 0
    sequence: int = 0
    index: int = 0  # QUEUE: first sample that it replaces
    queue: int = 0  # QUEUE: its number, 1, 2, 3 ...
    piece: int = 0  # QUEUE: `values` are the samples from index + VALUES_PER_PACKET * piece on
    samples: int = 0  # QUEUE: length of the complete command
    want_from: int = 0  # request to resend samples want_from .. want_to - 1
    want_to: int = 0
    values: Float1D = field(default_factory=lambda: np.empty(0))


@dataclass(frozen=True, slots=True)
class TargetState:
    """Packet from the target; `values` in V, (sample * channel,), all channels of each sample."""

    phase: Phase
    reason: Reason = Reason.NONE
    session: int = 0
    sequence: int = 0
    index: int = 0  # of the first sample in `values`
    taken: int = 0  # samples taken since the claim, or since the start
    oldest: int = 0  # oldest sample that can be resent
    queue: int = 0  # number of the newest queue
    verdict: QueueVerdict = QueueVerdict.ARRIVING
    channels: int = 0
    least_ahead: int = 0  # samples after the newest taken one that can no longer be replaced
    ignored: int = 0  # invalid packets, and packets from other senders
    missed: int = 0  # packets of the rig that were lost or arrived out of order
    rate_hz: float = 0.0
    # Bit k % 8 of byte k // 8: piece k of that queue has arrived.
    arrived: bytes = bytes(MAX_PIECES // 8)
    values: Float1D = field(default_factory=lambda: np.empty(0))

    @property
    def pieces(self) -> Bool1D:
        """Flag for each piece of `queue`, (MAX_PIECES,): True if it has arrived."""
        bits = np.unpackbits(np.frombuffer(self.arrived, np.uint8), bitorder="little")
        arrived: Bool1D = bits.astype(np.bool_)
        return arrived


def sequence_difference(sequence: int, other: int) -> int:
    """Return by how much `sequence` is newer than `other`, modulo 2^32, in -2^31 .. 2^31 - 1."""
    return (sequence - other + (1 << 31)) % (1 << 32) - (1 << 31)


def _seal_packet(header: bytes, values: Float1D) -> bytes:
    """Return a packet: header, values padded with zeros, CRC-32."""
    body = header + np.asarray(values, dtype="<f8").tobytes()
    body += bytes(len(header) + 8 * VALUES_PER_PACKET - len(body))
    return body + struct.pack("<I", zlib.crc32(body))


def _is_valid_packet(data: bytes, size: int, magic: bytes) -> bool:
    """Return True if length, magic, version and CRC-32 are valid."""
    if len(data) != size or data[:4] != magic or data[4:6] != struct.pack("<H", PACKET_VERSION):
        return False
    return struct.unpack_from("<I", data, size - 4)[0] == zlib.crc32(data[:-4])


def encode_rig_packet(packet: RigPacket) -> bytes:
    """Encode a packet of the rig, RIG_PACKET_BYTES long; at most VALUES_PER_PACKET values."""
    header = RIG_HEADER.pack(
        RIG_MAGIC, PACKET_VERSION, packet.kind, packet.session, packet.sequence,
        packet.values.size, packet.index,
        packet.queue, packet.piece, packet.samples, 0, packet.want_from, packet.want_to,
    )  # fmt: skip
    return _seal_packet(header, packet.values)


def decode_rig_packet(data: bytes) -> RigPacket | None:
    """Decode a packet of the rig; None if it is invalid."""
    if not _is_valid_packet(data, RIG_PACKET_BYTES, RIG_MAGIC):
        return None
    _, _, kind, session, sequence, count, index, queue, piece, samples, _, first, last = (
        RIG_HEADER.unpack_from(data)
    )
    if kind not in _KINDS or count > VALUES_PER_PACKET:
        return None
    values = np.frombuffer(data, "<f8", count, RIG_HEADER.size)
    return RigPacket(
        PacketKind(kind), session, sequence, index, queue, piece, samples, first, last, values
    )


def encode_target_state(state: TargetState) -> bytes:
    """Encode a state, TARGET_PACKET_BYTES long; at most VALUES_PER_PACKET values."""
    header = TARGET_HEADER.pack(
        TARGET_MAGIC, PACKET_VERSION, state.phase, state.reason, state.session, state.sequence,
        state.values.size, state.index, state.taken, state.oldest, state.queue, state.verdict,
        state.channels, state.least_ahead, state.ignored, state.missed, state.rate_hz,
        state.arrived,
    )  # fmt: skip
    return _seal_packet(header, state.values)


def decode_target_state(data: bytes) -> TargetState | None:
    """Decode a packet of the target; None if it is invalid."""
    if not _is_valid_packet(data, TARGET_PACKET_BYTES, TARGET_MAGIC):
        return None
    _, _, phase, reason, session, sequence, count, index, taken, oldest, queue, verdict, *rest = (
        TARGET_HEADER.unpack_from(data)
    )
    if phase not in _PHASES or reason not in _REASONS or verdict not in _VERDICTS:
        return None
    if count > VALUES_PER_PACKET:
        return None
    channels, least_ahead, ignored, missed, rate_hz, arrived = rest
    return TargetState(
        Phase(phase), Reason(reason), session, sequence, index, taken, oldest, queue,
        QueueVerdict(verdict), channels, least_ahead, ignored, missed, rate_hz, arrived,
        np.frombuffer(data, "<f8", count, TARGET_HEADER.size),
    )  # fmt: skip


_KINDS, _PHASES = frozenset(PacketKind), frozenset(Phase)
_REASONS, _VERDICTS = frozenset(Reason), frozenset(QueueVerdict)


class UdpWiring(BackendConfig):
    """Address and timing of the target; the wiring of its converters is configured there."""

    target: str = Field(description="HOST:PORT of the target.")
    rig_port: int = Field(0, ge=0, le=65535, strict=True, description="Port of the rig; 0: any.")
    replace_after_ms: Positive = Field(
        30.0, le=1000.0, description="From a decision to the first sample it can change."
    )

    @field_validator("target")
    @classmethod
    def _check_target(cls, target: str) -> str:
        host, _, port = target.rpartition(":")
        if not host or not port.isdecimal() or not 0 < int(port) <= 65535:
            raise InputError(
                f"{target!r} is not an address",
                remedy="give HOST:PORT with a port of 1 to 65535, e.g. 192.168.7.5:7460",
            )
        return target

    def find_address(self, rig: RigConfig) -> str:
        return self.target

    @property
    def address(self) -> tuple[str, int]:
        """(host, port) of the target."""
        host, _, port = self.target.rpartition(":")
        return host, int(port)


ANSWER_TIMEOUT_S = 1.0  # of a request
BUFFER_BYTES = 1 << 20

REASON_TEXTS = {
    Reason.NONE: "no reason given",
    Reason.BUSY: "it has a rig already; end that one first",
    Reason.RATE: "it does not support this sample rate; change acquisition.rate_hz",
    Reason.CHANNELS: "its number of channels is not that of the [[sensors]] in the rig file; make "
    "them equal",
    Reason.SILENCE: "it received no packet from this rig for too long and continues alone",
    Reason.RELEASED: "its rig released it",
    Reason.SWITCHED_OFF: "it is being switched off",
    Reason.CARD: "it was started with another rig file; start it with the rig file of this run",
}


def rig_checksum(rig: RigConfig) -> int:
    """Return a CRC-32 over [output] and [[sensors]] of the rig config; never 0."""
    canonical = rig.model_dump_json(include={"output", "sensors"})
    return zlib.crc32(canonical.encode()) or 1


class UdpLink:
    """Packets of one connection to the target; InputError if the address cannot be used."""

    def __init__(self, wiring: UdpWiring, clock: Clock, port: int | None = None) -> None:
        self.session = secrets.randbits(63) + 1
        self.last_sent_s = clock.now()
        self._clock = clock
        self._sequence = 0
        port = wiring.rig_port if port is None else port
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
            self._socket.setblocking(False)
            self._socket.bind(("", port))
            self._socket.connect(wiring.address)  # packets from other senders are dropped
        except OSError as error:
            self._socket.close()
            raise InputError(
                f"{error.strerror or error} (udp.rig_port = {wiring.rig_port})",
                key="udp.target",
                value=wiring.target,
                remedy="give an address that this computer can reach, and a free port (0: any)",
            ) from None

    def send(self, packet: RigPacket) -> None:
        """Send a packet; only the state of the target confirms that it arrived."""
        self._sequence = (self._sequence + 1) & 0xFFFFFFFF
        self.last_sent_s = self._clock.now()
        data = encode_rig_packet(replace(packet, session=self.session, sequence=self._sequence))
        with contextlib.suppress(OSError):
            self._socket.send(data)

    def receive(self, timeout_s: float) -> list[TargetState]:
        """Return the waiting states, or the first within `timeout_s`; discard invalid packets."""
        states: list[TargetState] = []
        if not select.select([self._socket], [], [], timeout_s)[0]:
            return states
        with contextlib.suppress(OSError):  # no more packets, or nothing listens there
            while True:
                state = decode_target_state(self._socket.recv(TARGET_PACKET_BYTES + 1))
                if state is not None:
                    states.append(state)
        return states

    def close(self) -> None:
        self._socket.close()


def query_target(
    wiring: UdpWiring, clock: Clock, timeout_s: float = ANSWER_TIMEOUT_S
) -> TargetState:
    """Return the state of a target without claiming it; InputError if it does not answer.

    The query is sent from any free port first, as another rig may use rig_port, then from rig_port,
    as some targets answer only that one.
    """
    for port in dict.fromkeys((0, wiring.rig_port)):
        state = _poll_target(UdpLink(wiring, clock, port), clock, timeout_s)
        if state is not None:
            return state
    raise InputError(
        f"no UDP target answers at {wiring.target}",
        remedy="start it, and check that it uses the address and port of the rig file (for the "
        "simulated target: shaketwin table --table udp_simulated)",
    )


def _poll_target(link: UdpLink, clock: Clock, timeout_s: float) -> TargetState | None:
    """Return the state of a target, None if it does not answer."""
    try:
        deadline_s = clock.now() + timeout_s
        while clock.now() < deadline_s:
            link.send(RigPacket(PacketKind.BEAT))
            states = link.receive(timeout_s / 20)
            if states:
                return states[-1]
            clock.wait_until(min(clock.now() + timeout_s / 100, deadline_s))
    finally:
        link.close()
    return None


def check_reachable(rig: RigConfig) -> None:
    """Raise InputError if the target of the rig file does not answer; claim nothing."""
    wiring = rig.get_section(UdpWiring)
    if wiring is not None:
        query_target(wiring, RealClock())
