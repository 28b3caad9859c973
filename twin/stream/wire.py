"""The one encoder: Blocks and records <-> bytes. The bytes on the wire are the bytes in the log.

The only file that knows protobuf. The schema is `shaketwin.proto`, beside this file, for people who
read the stream in another language.
"""

import subprocess
import sys
from collections.abc import Iterable
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message import DecodeError

from table_io.block import Block
from table_io.records import (
    RECORDS,
    Check,
    Comparison,
    Cycle,
    Decided,
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

Item = Block | Record

# The table of topics is the diagram of the stream.
MEASURED = "/rig/meas"
PREDICTED = "/twin/pred"
COMPARED = "/twin/cmp"
BLOCK_TOPICS = {"meas": MEASURED, "pred": PREDICTED}
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
    Comparison: COMPARED,
    Cycle: "/twin/cycle",
    Point: "/twin/point",
    Timing: "/run/timing",
}
TOPIC_TYPES: dict[str, type] = {
    **dict.fromkeys(BLOCK_TOPICS.values(), Block),
    **{topic: kind for kind, topic in RECORD_TOPICS.items()},
}


class WireError(ValueError):
    """Bytes that are not what their topic promises."""


def topic(item: Item) -> str:
    """Topic on which an item travels."""
    return BLOCK_TOPICS[item.stream] if isinstance(item, Block) else RECORD_TOPICS[type(item)]


def encode(item: Item, run: str) -> bytes:
    """Bytes of an item; the same item gives the same bytes, always."""
    if isinstance(item, Block):
        message: Any = pb.Block(
            run=run,
            stream=item.stream,
            index=item.index,
            rate_hz=item.rate_hz,
            channels=[
                pb.Channel(name=name, values=values)
                for name, values in zip(item.channels, item.values.tolist(), strict=True)
            ],
            step=item.step.tolist(),
            label=item.label.tolist(),
            cycle=item.cycle.tolist(),
        )
    else:
        message = _message(item)
        if not isinstance(item, RunStart):
            message.run = run
    return bytes(message.SerializeToString(deterministic=True))


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
    except (DecodeError, ValueError, TypeError) as error:
        raise WireError(f"{topic_name}: not a {kind.__name__}: {error}") from None


def schema(kind: type) -> tuple[str, bytes]:
    """(full name, FileDescriptorSet) of the message that carries `kind`, for logs and peers."""
    return f"shaketwin.{kind.__name__}", FileDescriptorSet(
        file=[_file_descriptor()]
    ).SerializeToString()


def _file_descriptor() -> Any:
    from google.protobuf.descriptor_pb2 import FileDescriptorProto

    proto = FileDescriptorProto()
    pb.DESCRIPTOR.CopyToProto(proto)
    return proto


def _block(message: Any) -> Block:
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
    return getattr(pb, type(record).__name__)(
        **{
            one.name: _plain(value)
            for one in fields(record)
            if (value := getattr(record, one.name)) is not None
        }
    )


def _plain(value: Any) -> Any:
    if is_dataclass(value):
        return _message(value)
    if isinstance(value, tuple):  # of one type: a look at the first tells all
        return [_plain(one) for one in value] if value and is_dataclass(value[0]) else value
    return value


def _plan(kind: Any) -> tuple[Any, list[tuple[str, Any, bool]]]:
    """(class, [(field, its type or the type inside its tuple, optional)]) of a dataclass."""
    hints = get_type_hints(kind)
    plan = []
    for one in fields(kind):
        hint = hints[one.name]
        optional = get_origin(hint) is UnionType
        if optional:
            (hint,) = (arg for arg in get_args(hint) if arg is not NoneType)
        plan.append((one.name, hint, optional))
    return kind, plan


_PLANS: dict[type, list[tuple[str, Any, bool]]] = {}


def _record(kind: Any, message: Any) -> Any:
    """The dataclass that `_message` was made from."""
    if kind not in _PLANS:
        _PLANS[kind] = _plan(kind)[1]
    values: dict[str, Any] = {}
    for name, hint, optional in _PLANS[kind]:
        if optional and not message.HasField(name):
            values[name] = None
            continue
        value = getattr(message, name)
        if get_origin(hint) is tuple:
            inner = get_args(hint)[0]
            value = (
                tuple(_record(inner, one) for one in value) if is_dataclass(inner) else tuple(value)
            )
        elif get_origin(hint) is dict:
            value = dict(value)
        elif is_dataclass(hint):
            value = _record(hint, value)
        values[name] = value
    return kind(**values)


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
