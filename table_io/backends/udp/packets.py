"""The two packets of a UDP target, as bytes: `PACKETS.md` says what each field is for.

Little-endian, of one fixed length each way, CRC-32 over all that stands before it.
"""

import struct
import zlib
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
import numpy.typing as npt

from table_io.block import Float1D

Bool1D = npt.NDArray[np.bool_]

VERSION = 1
VALUES = 128  # float64 in a packet, either way
RING = 1 << 16  # samples of one queue, at most
PIECES = RING // VALUES
WORD = struct.Struct("<4sHHQIIqIIIIqq")  # rig -> target, before the values
STATE = struct.Struct("<4sHBBQIIqqqIIIIIId64s")  # target -> rig, before the values
WORD_BYTES = WORD.size + 8 * VALUES + 4
STATE_BYTES = STATE.size + 8 * VALUES + 4
WORD_MAGIC, STATE_MAGIC = b"STUR", b"STUT"


class Kind(IntEnum):
    """What a rig says."""

    BEAT = 1
    CLAIM = 2
    QUEUE = 3
    START = 4
    RELEASE = 5


class Phase(IntEnum):
    """What a target does."""

    FREE = 0
    CLAIMED = 1
    RUNNING = 2
    ENDING = 3


class Reason(IntEnum):
    """Why a target says no, or goes on alone."""

    NONE = 0
    BUSY = 1
    RATE = 2
    CHANNELS = 3
    SILENCE = 4
    RELEASED = 5
    SWITCHED_OFF = 6
    CARD = 7


class Verdict(IntEnum):
    """What became of the newest queue that a target has heard of."""

    ARRIVING = 0
    PLAYS = 1
    LATE = 2
    NONSENSE = 3


@dataclass(frozen=True, slots=True)
class Word:
    """What a rig says; `values` in V, or what CLAIM says."""

    kind: Kind
    session: int = 0
    sequence: int = 0
    index: int = 0  # QUEUE: the sample from which on it replaces
    queue: int = 0  # QUEUE: its number, 1, 2, 3 ...
    piece: int = 0  # QUEUE: `values` are the samples from index + VALUES * piece on
    samples: int = 0  # QUEUE: of the whole
    want_from: int = 0  # samples want_from .. want_to - 1 again, please
    want_to: int = 0
    values: Float1D = field(default_factory=lambda: np.empty(0))


@dataclass(frozen=True, slots=True)
class State:
    """What a target says; `values` in V, sample after sample, the channels of each together."""

    phase: Phase
    reason: Reason = Reason.NONE
    session: int = 0
    sequence: int = 0
    index: int = 0  # of the first sample in `values`
    taken: int = 0  # samples that were taken since the claim, or since the start
    oldest: int = 0  # sample that can still be sent again
    queue: int = 0  # the newest queue that was heard of
    verdict: Verdict = Verdict.ARRIVING
    channels: int = 0
    least_ahead: int = 0  # samples after the newest taken one that cannot be replaced any more
    ignored: int = 0  # packets that were none, or a stranger's
    missed: int = 0  # packets of the rig that did not come, or came after later ones
    rate_hz: float = 0.0
    arrived: bytes = bytes(PIECES // 8)  # bit k % 8 of byte k // 8: piece k of that queue is there
    values: Float1D = field(default_factory=lambda: np.empty(0))

    @property
    def pieces(self) -> Bool1D:
        """True for each piece of `queue` that has arrived, (PIECES,)."""
        bits = np.unpackbits(np.frombuffer(self.arrived, np.uint8), bitorder="little")
        there: Bool1D = bits.astype(np.bool_)
        return there


def ahead(sequence: int, other: int) -> int:
    """How much newer one sequence number is than another, of the same sender: they wrap at 2^32."""
    return (sequence - other + (1 << 31)) % (1 << 32) - (1 << 31)


def _sealed(header: bytes, values: Float1D) -> bytes:
    """The bytes of a packet: header, values and zeros behind them, checksum."""
    body = header + np.asarray(values, dtype="<f8").tobytes()
    body += bytes(len(header) + 8 * VALUES - len(body))
    return body + struct.pack("<I", zlib.crc32(body))


def _opened(data: bytes, size: int, magic: bytes) -> bool:
    """True where these bytes are a whole packet of this kind and version."""
    if len(data) != size or data[:4] != magic or data[4:6] != struct.pack("<H", VERSION):
        return False
    return struct.unpack_from("<I", data, size - 4)[0] == zlib.crc32(data[:-4])


def encode_word(word: Word) -> bytes:
    """The packet of a rig, WORD_BYTES long; at most VALUES values."""
    header = WORD.pack(
        WORD_MAGIC, VERSION, word.kind, word.session, word.sequence, word.values.size, word.index,
        word.queue, word.piece, word.samples, 0, word.want_from, word.want_to,
    )  # fmt: skip
    return _sealed(header, word.values)


def decode_word(data: bytes) -> Word | None:
    """What a rig says; None where the bytes are no packet of a rig."""
    if not _opened(data, WORD_BYTES, WORD_MAGIC):
        return None
    _, _, kind, session, sequence, count, index, queue, piece, samples, _, first, last = (
        WORD.unpack_from(data)
    )
    if kind not in _KINDS or count > VALUES:
        return None
    values = np.frombuffer(data, "<f8", count, WORD.size)
    return Word(
        Kind(kind), session, sequence, index, queue, piece, samples, first, last, values
    )  # fmt: skip


def encode_state(state: State) -> bytes:
    """The packet of a target, STATE_BYTES long; at most VALUES values."""
    header = STATE.pack(
        STATE_MAGIC, VERSION, state.phase, state.reason, state.session, state.sequence,
        state.values.size, state.index, state.taken, state.oldest, state.queue, state.verdict,
        state.channels, state.least_ahead, state.ignored, state.missed, state.rate_hz,
        state.arrived,
    )  # fmt: skip
    return _sealed(header, state.values)


def decode_state(data: bytes) -> State | None:
    """What a target says; None where the bytes are no packet of a target."""
    if not _opened(data, STATE_BYTES, STATE_MAGIC):
        return None
    _, _, phase, reason, session, sequence, count, index, taken, oldest, queue, verdict, *rest = (
        STATE.unpack_from(data)
    )
    if phase not in _PHASES or reason not in _REASONS or verdict not in _VERDICTS:
        return None
    if count > VALUES:
        return None
    channels, least_ahead, ignored, missed, rate_hz, arrived = rest
    return State(
        Phase(phase), Reason(reason), session, sequence, index, taken, oldest, queue,
        Verdict(verdict), channels, least_ahead, ignored, missed, rate_hz, arrived,
        np.frombuffer(data, "<f8", count, STATE.size),
    )  # fmt: skip


_KINDS, _PHASES = frozenset(Kind), frozenset(Phase)
_REASONS, _VERDICTS = frozenset(Reason), frozenset(Verdict)
