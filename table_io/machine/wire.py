"""What controller and machine say to each other: a header and a bounded payload, little-endian.

    offset  bytes  header
    0       4      b"STM1"
    4       1      kind, see Kind
    5       3      zero
    8       4      bytes of payload, at most 8 MiB
    12      8      index, signed: a sample, a count, or a reason
    20             payload: float64 values, or UTF-8 text (JSON where it says so)

The black box of the machine is a file of the same messages.
"""

import json
import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np

from table_io.block import Float1D

HEADER = struct.Struct("<4sB3xIq")
MAGIC = b"STM1"
MOST_BYTES = 8 << 20
REPLACE_AFTER_S = 0.03  # what the plant needs, and 10 ms for a message to arrive


class Kind(IntEnum):
    """Every message: who says it, what index and payload are."""

    CLAIM = 1  # controller: JSON {rate_hz, specimen, output, sensors}
    TARE = 2  # controller: index samples at rest, please
    QUEUE = 3  # controller: volts from sample index on; also in the black box, as accepted
    START = 4  # controller
    BEAT = 5  # controller: alive
    RELEASE = 6  # controller: done
    GRANTED = 16  # machine: index is its replace_after
    TARED = 17  # machine: volts (sample, channel)
    QUEUED = 18  # machine: what was queued from index on is accepted
    STARTED = 19  # machine, black box: one value, time of sample 0 on the monotonic clock in s
    TAKEN = 20  # machine: volts (sample, channel) from sample index on
    REFUSED = 21  # machine: index is a Refusal, text says why
    LOST = 22  # machine: text says why it goes on without this controller
    PLAYED = 32  # black box: true values (sample, field) from sample index on, fields of a Life
    NOTE = 33  # black box: text, at sample index
    LIFE = 34  # black box: JSON {rate_hz, volts_per_m}, a controller claims the machine


class Refusal(IntEnum):
    """Why a request was refused: what the controller raises."""

    INPUT = 0  # BadInput
    VALUE = 1  # ValueError
    ORDER = 2  # RuntimeError
    RESTING = 3  # the table comes to rest; ask again


class Garbage(ValueError):
    """Bytes that are no message."""


@dataclass(frozen=True, slots=True)
class Message:
    """One thing said."""

    kind: Kind
    index: int = 0
    payload: bytes = b""

    @property
    def text(self) -> str:
        """The payload as text; Garbage where it is none."""
        try:
            return self.payload.decode()
        except UnicodeDecodeError:
            raise Garbage(f"{self.kind.name} carries no text") from None

    @property
    def json(self) -> Any:
        """The payload as JSON; Garbage where it is none."""
        try:
            return json.loads(self.text)
        except (ValueError, RecursionError):
            raise Garbage(f"{self.kind.name} carries no JSON") from None

    @property
    def values(self) -> Float1D:
        """The payload as float64, (value,), read-only; Garbage where it is none."""
        if len(self.payload) % 8:
            raise Garbage(f"{self.kind.name} carries no whole number of values")
        return np.frombuffer(self.payload, dtype="<f8")


def say(kind: Kind, text: str, index: int = 0) -> Message:
    """A message that carries text."""
    return Message(kind, index, text.encode())


def carry(kind: Kind, values: Float1D, index: int = 0) -> Message:
    """A message that carries values, in C order."""
    return Message(kind, index, np.ascontiguousarray(values, dtype="<f8").tobytes())


def encode(message: Message) -> bytes:
    """The bytes of a message; ValueError where the payload is too large."""
    size = len(message.payload)
    if size > MOST_BYTES:
        raise ValueError(f"{message.kind.name} of {size} bytes; at most {MOST_BYTES}")
    return HEADER.pack(MAGIC, message.kind, size, message.index) + message.payload


class Parser:
    """Messages out of a stream of bytes, however it is cut."""

    def __init__(self) -> None:
        self._bytes = bytearray()

    def feed(self, data: bytes) -> list[Message]:
        """The messages that `data` completes; Garbage as soon as it cannot become one."""
        self._bytes += data
        messages = []
        while (one := self._first()) is not None:
            messages.append(one)
        return messages

    def _first(self) -> Message | None:
        if len(self._bytes) < HEADER.size:
            return None
        magic, kind, size, index = HEADER.unpack_from(self._bytes)
        if magic != MAGIC or size > MOST_BYTES or kind not in _KINDS:
            raise Garbage("bytes that are no message")
        if len(self._bytes) < HEADER.size + size:
            return None
        payload = bytes(self._bytes[HEADER.size : HEADER.size + size])
        del self._bytes[: HEADER.size + size]
        return Message(Kind(kind), index, payload)


_KINDS = frozenset(Kind)
