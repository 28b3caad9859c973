"""The one encoder: Blocks and records <-> bytes. The bytes on the wire are the bytes in the log.

The only file that knows protobuf. The schema is `shaketwin.proto`, beside this file, for people who
read the stream in another language.
"""

import subprocess
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import fields, is_dataclass
from functools import cache, partial
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np
from google.protobuf.descriptor_pb2 import (
    DescriptorProto,
    FieldDescriptorProto,
    FileDescriptorProto,
    FileDescriptorSet,
)
from google.protobuf.message import DecodeError
from google.protobuf.timestamp_pb2 import Timestamp

from table_io.block import Block
from table_io.records import (
    RECORDS,
    Agreement,
    Ahead,
    Check,
    Comparison,
    Cycle,
    Decided,
    Estimate,
    Event,
    Fault,
    Gap,
    Level,
    Params,
    Point,
    Record,
    Response,
    RunStart,
    RunStop,
    Timing,
    Trip,
)
from twin.stream import shaketwin_pb2 as pb
from twin.stream.packed import encode_block

Item = Block | Record

# The table of topics is the diagram of the stream.
MEAS_TOPIC = "/rig/meas"
PRED_TOPIC = "/twin/pred"
CMP_TOPIC = "/twin/cmp"
BLOCK_TOPICS = {"meas": MEAS_TOPIC, "pred": PRED_TOPIC}
RECORD_TOPICS: dict[type, str] = {
    RunStart: "/run/start",
    RunStop: "/run/stop",
    Event: "/run/event",
    Fault: "/run/fault",
    Gap: "/rig/gap",
    Check: "/rig/check",
    Response: "/rig/response",
    Level: "/rig/level",
    Decided: "/rig/decided",
    Trip: "/rig/trip",
    Params: "/twin/params",
    Comparison: CMP_TOPIC,
    Cycle: "/twin/cycle",
    Point: "/twin/point",
    Agreement: "/twin/agreement",
    Estimate: "/twin/estimate",
    Ahead: "/twin/ahead",
    Timing: "/run/timing",
}
TOPIC_TYPES: dict[str, type] = {
    **dict.fromkeys(BLOCK_TOPICS.values(), Block),
    **{topic: kind for kind, topic in RECORD_TOPICS.items()},
}

LAST_INDEX = 2**53  # of a sample: beyond, a float64 does not tell one from the next


class WireError(ValueError):
    """Bytes that are not what their topic promises."""


def topic(item: Item) -> str:
    """Topic on which an item travels."""
    return BLOCK_TOPICS[item.stream] if isinstance(item, Block) else RECORD_TOPICS[type(item)]


def encode(item: Item, run: str) -> bytes:
    """Bytes of an item; the same item gives the same bytes, always."""
    if isinstance(item, Block):
        return encode_block(item, run)
    message = _message(item)
    if not isinstance(item, RunStart):
        message.run = run
    return bytes(message.SerializeToString(deterministic=True))


def unsigned(payload: bytes, kind: type, run: str) -> bytes:
    """The bytes of a record without its run, which stands last: equal for equal records."""
    return payload.removesuffix(_signature(kind, run))


@cache
def _signature(kind: type, run: str) -> bytes:
    return bytes(getattr(pb, kind.__name__)(run=run).SerializeToString())


def decode(topic_name: str, payload: bytes) -> tuple[str, Item]:
    """(run id, item) from the bytes of a topic; WireError where they are something else."""
    kind = TOPIC_TYPES.get(topic_name)
    if kind is None:
        raise WireError(f"{topic_name}: unknown topic; known: {', '.join(TOPIC_TYPES)}")
    message: Any = getattr(pb, kind.__name__)()
    try:
        message.ParseFromString(payload)
        if kind is Block and BLOCK_TOPICS.get(message.stream) != topic_name:
            raise ValueError(f"it holds the stream {message.stream!r}")
        return message.run, _block(message) if kind is Block else _record(kind, message)
    except (DecodeError, ValueError, TypeError, OverflowError) as error:
        raise WireError(f"{topic_name}: not a {kind.__name__}: {error}") from None


def schema(kind: type) -> tuple[str, bytes]:
    """(full name, FileDescriptorSet) of the message that carries `kind`, for logs and peers."""
    return f"shaketwin.{kind.__name__}", FileDescriptorSet(
        file=[_file_descriptor()]
    ).SerializeToString()


def flat_schema(name: str, fields: Sequence[tuple[str, str]]) -> bytes:
    """FileDescriptorSet of a message `name`, for exports: (field, its type) numbered from 1.

    A type is one of protobuf's own, or "time" for its Timestamp.
    """
    package, _, short = name.rpartition(".")
    message = DescriptorProto(name=short)
    for number, (field, kind) in enumerate(fields, start=1):
        one = message.field.add(name=field, number=number)
        one.label = FieldDescriptorProto.LABEL_OPTIONAL
        one.type = FieldDescriptorProto.Type.Value(
            f"TYPE_{'message' if kind == 'time' else kind}".upper()
        )
        if kind == "time":
            one.type_name = f".{Timestamp.DESCRIPTOR.full_name}"
    known = FileDescriptorProto()
    Timestamp.DESCRIPTOR.file.CopyToProto(known)
    file = FileDescriptorProto(name=f"{name}.proto", package=package, syntax="proto3")
    file.dependency.append(known.name)
    file.message_type.append(message)
    return FileDescriptorSet(file=[known, file]).SerializeToString()


def _file_descriptor() -> Any:
    proto = FileDescriptorProto()
    pb.DESCRIPTOR.CopyToProto(proto)
    return proto


def _block(message: Any) -> Block:
    if not 0 < message.rate_hz < float("inf"):
        raise ValueError(f"rate_hz = {message.rate_hz}")
    if message.index + len(message.step) > LAST_INDEX:
        raise ValueError(f"index = {message.index}")
    return Block(
        message.stream,
        message.index,
        message.rate_hz,
        tuple(channel.name for channel in message.channels),
        np.array([channel.values for channel in message.channels], dtype=np.float64).reshape(
            len(message.channels), len(message.step)
        ),
        np.array(message.step, dtype=np.int64),
        np.array(message.label, dtype=np.int64),
        np.array(message.cycle, dtype=np.int64),
    )


def _message(record: Any) -> Any:
    """Protobuf message with the fields of a dataclass, nested ones included; None is left out."""
    kind = type(record)
    if kind not in _FIELDS:
        _FIELDS[kind] = tuple(one.name for one in fields(kind))
    values = {}
    for name in _FIELDS[kind]:
        value = getattr(record, name)
        if value is not None:
            values[name] = value if type(value) in _FLAT else _plain(value)
    return getattr(pb, kind.__name__)(**values)


def _plain(value: Any) -> Any:
    if isinstance(value, tuple):  # of one type: a look at the first tells all
        return value if not value or type(value[0]) in _FLAT else [_plain(one) for one in value]
    return _message(value) if is_dataclass(value) else value


def _plan(kind: Any) -> list[tuple[str, bool, Callable[[Any], Any]]]:
    """(field, optional, what makes its value from that of protobuf) of a dataclass."""
    hints = get_type_hints(kind)
    plan = []
    for one in fields(kind):
        hint = hints[one.name]
        optional = get_origin(hint) is UnionType
        if optional:
            (hint,) = (arg for arg in get_args(hint) if arg is not NoneType)
        plan.append((one.name, optional, _maker(hint)))
    return plan


def _maker(hint: Any) -> Callable[[Any], Any]:
    inner = next(iter(get_args(hint)), None)
    if get_origin(hint) is tuple and is_dataclass(inner):
        return lambda value: tuple(_record(inner, one) for one in value)
    if is_dataclass(hint):
        return partial(_record, hint)
    return get_origin(hint) or (_whole if hint is int else hint)


def _whole(value: int) -> int:
    if value > LAST_INDEX:
        raise ValueError(f"{value} where at most {LAST_INDEX} can be")
    return value


_FIELDS: dict[type, tuple[str, ...]] = {}
_FLAT = frozenset((int, float, str, bool, dict))
_PLANS: dict[type, list[tuple[str, bool, Callable[[Any], Any]]]] = {}


def _record(kind: Any, message: Any) -> Any:
    """The dataclass that `_message` was made from."""
    if kind not in _PLANS:
        _PLANS[kind] = _plan(kind)
    return kind(
        **{
            name: None if optional and not message.HasField(name) else make(getattr(message, name))
            for name, optional, make in _PLANS[kind]
        }
    )


def kinds() -> Iterable[type]:
    """Every type that has a topic."""
    return (Block, *RECORDS)


def regenerate() -> None:
    """Write shaketwin_pb2.py and .pyi anew from the .proto (needs the extra "proto")."""
    here = Path(__file__).parent
    command = [sys.executable, "-m", "grpc_tools.protoc", f"-I{here}"]
    command += [f"--python_out={here}", f"--pyi_out={here}", str(here / "shaketwin.proto")]
    subprocess.run(command, check=True)


if __name__ == "__main__":
    regenerate()
