"""Encoding and decoding of the two UDP packets; `PACKETS.md` specifies each field.

Little-endian, of fixed length in each direction, with a CRC-32 over all preceding bytes.
"""

import struct
import zlib
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
import numpy.typing as npt

from table_io.block import Float1D

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
    )  # fmt: skip


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
