"""Wire protocol between controller and machine: header and bounded payload, little-endian.

    offset  bytes  header
    0       4      b"STM1"
    4       1      kind, see `MessageKind`
    5       3      zero
    8       4      bytes of payload, at most 8 MiB
    12      8      index, signed: a sample, a count, or a reason
    20             payload: float64 values, or UTF-8 text (JSON for some kinds)

The file of the machine's flight recorder consists of the same messages.
"""

import json
import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np

from table_io.block import Float1D

HEADER = struct.Struct("<4sB3xIq")
MAGIC_BYTES = b"STM1"
MAX_PAYLOAD_BYTES = 8 << 20
REPLACE_AFTER_S = 0.03  # 20 ms for the plant and 10 ms for a message to arrive


class MessageKind(IntEnum):
    """Kind of a message: sender, meaning of index and payload."""

    CLAIM = 1  # controller: JSON {rate_hz, specimen, output, sensors}
    TARE = 2  # controller: requests `index` samples at rest
    QUEUE = 3  # controller: volts from sample index on; recorder: as accepted
    START = 4  # controller
    BEAT = 5  # controller: heartbeat
    RELEASE = 6  # controller: end of the connection
    GRANTED = 16  # machine: index is its replace_after
    TARED = 17  # machine: volts (sample, channel)
    QUEUED = 18  # machine: the command from sample index on is accepted
    STARTED = 19  # machine, recorder: time of sample 0 on the monotonic clock in s, one value
    TAKEN = 20  # machine: volts (sample, channel) from sample index on
    REFUSED = 21  # machine: index is a Refusal, text is the reason
    LOST = 22  # machine: the controller is dropped, text is the reason
    PLAYED = 32  # recorder: true values (sample, field) from sample index on, RECORDED_FIELDS
    NOTE = 33  # recorder: text, at sample index
    SESSION = 34  # recorder: JSON {rate_hz, volts_per_m}, a controller has claimed


class Refusal(IntEnum):
    """Reason of a refusal, as the exception that the controller raises."""

    INPUT = 0  # InputError
    VALUE = 1  # ValueError
    ORDER = 2  # RuntimeError
    RESTING = 3  # the table is still coming to rest; retry


class ProtocolError(ValueError):
    """Bytes that are not a valid message."""


@dataclass(frozen=True, slots=True)
class MachineMessage:
    """One message: kind, index, payload."""

    kind: MessageKind
    index: int = 0
    payload: bytes = b""

    @property
    def text(self) -> str:
        """Payload as text; ProtocolError if it is not UTF-8."""
        try:
            return self.payload.decode()
        except UnicodeDecodeError:
            raise ProtocolError(f"payload of {self.kind.name} is not text") from None

    @property
    def json(self) -> Any:
        """Payload as JSON; ProtocolError if it is not JSON."""
        try:
            return json.loads(self.text)
        except (ValueError, RecursionError):
            raise ProtocolError(f"payload of {self.kind.name} is not JSON") from None

    @property
    def values(self) -> Float1D:
        """Payload as float64, (value,), read-only; ProtocolError if its length does not fit."""
        if len(self.payload) % 8:
            raise ProtocolError(f"payload of {self.kind.name} is not a whole number of values")
        return np.frombuffer(self.payload, dtype="<f8")


def text_message(kind: MessageKind, text: str, index: int = 0) -> MachineMessage:
    """Return a message with text as payload."""
    return MachineMessage(kind, index, text.encode())


def values_message(kind: MessageKind, values: Float1D, index: int = 0) -> MachineMessage:
    """Return a message with float64 values as payload, in C order."""
    return MachineMessage(kind, index, np.ascontiguousarray(values, dtype="<f8").tobytes())


def encode_message(message: MachineMessage) -> bytes:
    """Encode a message; ValueError if the payload is too large."""
    size = len(message.payload)
    if size > MAX_PAYLOAD_BYTES:
        raise ValueError(f"{message.kind.name} has {size} bytes; at most {MAX_PAYLOAD_BYTES}")
    return HEADER.pack(MAGIC_BYTES, message.kind, size, message.index) + message.payload


class MessageParser:
    """Incremental parser of a byte stream, independent of how it is split."""

    def __init__(self) -> None:
        self._bytes = bytearray()

    def feed(self, data: bytes) -> list[MachineMessage]:
        """Return the messages that `data` completes; ProtocolError as early as possible."""
        self._bytes += data
        messages = []
        while (message := self._next_message()) is not None:
            messages.append(message)
        return messages

    def _next_message(self) -> MachineMessage | None:
        if len(self._bytes) < HEADER.size:
            return None
        magic, kind, size, index = HEADER.unpack_from(self._bytes)
        if magic != MAGIC_BYTES or size > MAX_PAYLOAD_BYTES or kind not in _KINDS:
            raise ProtocolError("invalid message header")
        if len(self._bytes) < HEADER.size + size:
            return None
        payload = bytes(self._bytes[HEADER.size : HEADER.size + size])
        del self._bytes[: HEADER.size + size]
        return MachineMessage(MessageKind(kind), index, payload)


_KINDS = frozenset(MessageKind)
