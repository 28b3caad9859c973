"""Wire protocol between controller and machine: header and bounded payload, little-endian.

    offset  bytes  header
    0       4      b"STM1"
    4       1      kind, see `MessageKind`
    5       3      zero
    8       4      bytes of payload, at most 8 MiB
    12      8      index, signed: a sample, a count, or a reason
    20             payload: float64 values, or UTF-8 text (JSON for some kinds)

The file of the machine's flight recorder consists of the same messages. The
endpoint of a machine is on this computer: "tcp/127.0.0.1:PORT" or "unix/PATH".
"""

import contextlib
import json
import os
import socket
import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from pydantic import Field

from table_io.block import Float1D
from table_io.config.rig import BackendConfig, RigConfig
from table_io.errors import InputError


class MachineConfig(BackendConfig):
    """Machine in a separate process: `shaketwin table` simulates its [simulated] table."""

    endpoint: str = Field(description="tcp/127.0.0.1:PORT or unix/PATH, on this computer only.")

    def find_address(self, rig: RigConfig) -> str:
        return self.endpoint


LOOPBACK_HOSTS = ("127.0.0.1", "localhost", "::1")
ALLOWED_ENDPOINTS = "tcp/127.0.0.1:PORT, or unix/PATH"


@dataclass(frozen=True, slots=True)
class Endpoint:
    """Socket family and address; `text` as the user wrote it."""

    text: str
    family: socket.AddressFamily
    address: tuple[str, int] | str


def parse_endpoint(text: str) -> Endpoint:
    """Parse an endpoint; InputError if it is invalid or reachable from other computers."""
    kind, _, location = text.partition("/")
    if kind == "unix" and location:
        return Endpoint(text, socket.AF_UNIX, location)
    host, _, port = location.rpartition(":")
    if kind != "tcp" or not port.isdecimal() or not 0 <= int(port) <= 65535:
        raise InputError("invalid endpoint", key="endpoint", value=text, allowed=ALLOWED_ENDPOINTS)
    if host not in LOOPBACK_HOSTS:
        raise InputError(
            f"{host or 'an empty host'} can be reached from other computers, and the table has no "
            "access control",
            key="endpoint",
            value=text,
            allowed=ALLOWED_ENDPOINTS,
        )
    family = socket.AF_INET6 if host == "::1" else socket.AF_INET
    return Endpoint(text, family, (host, int(port)))


def connect(endpoint: Endpoint, timeout_s: float) -> socket.socket:
    """Return a connection; OSError if nothing answers."""
    connection = socket.socket(endpoint.family, socket.SOCK_STREAM)
    try:
        connection.settimeout(timeout_s)
        connection.connect(endpoint.address)
        if endpoint.family != socket.AF_UNIX:
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    except BaseException:
        connection.close()
        raise
    return connection


def open_listener(endpoint: Endpoint) -> socket.socket:
    """Return a listening socket; InputError if the endpoint is in use or cannot be used."""
    listener = socket.socket(endpoint.family, socket.SOCK_STREAM)
    try:
        if isinstance(endpoint.address, str):
            _remove_stale_socket(endpoint, endpoint.address)
        else:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(endpoint.address)
        listener.listen()
        listener.setblocking(False)
    except OSError as error:
        listener.close()
        raise InputError(
            f"cannot listen there: {error.strerror or error}",
            where=f"--listen {endpoint.text}",
            remedy="end another table that listens there, or give another endpoint",
        ) from None
    except InputError:
        listener.close()
        raise
    return listener


def _remove_stale_socket(endpoint: Endpoint, path: str) -> None:
    """Remove the socket file of a machine that died; InputError if one is running."""
    with contextlib.suppress(FileNotFoundError, ConnectionRefusedError):
        connect(endpoint, 1.0).close()
        raise InputError(
            "another table listens there", where=f"--listen {endpoint.text}", remedy="end it first"
        )
    with contextlib.suppress(FileNotFoundError):
        os.unlink(path)


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
