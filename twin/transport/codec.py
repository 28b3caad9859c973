"""Codec (serialization): Blocks and records to protobuf bytes and back.

The bus and the log carry the same bytes. The schema is `shaketwin.proto` in this folder; other
languages generate their classes from it. Only this package imports protobuf.
"""

import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields, is_dataclass, replace
from functools import cache, lru_cache, partial
from itertools import groupby
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, NamedTuple, cast, get_args, get_origin, get_type_hints

import numpy as np
import numpy.typing as npt
from google.protobuf.descriptor_pb2 import (
    DescriptorProto,
    FieldDescriptorProto,
    FileDescriptorProto,
    FileDescriptorSet,
)
from google.protobuf.message import DecodeError
from google.protobuf.timestamp_pb2 import Timestamp

from table_io.block import Block, Float2D, Int1D, Int2D
from table_io.records import (
    Agreement,
    Check,
    Comparison,
    CycleExtremes,
    Estimate,
    Event,
    Extremes,
    Fault,
    FrequencyResponse,
    JumpForecast,
    Level,
    NormalizedResponse,
    OrbitPoint,
    Params,
    PrcPoint,
    PredictionHash,
    Record,
    RunStart,
    RunStop,
    SampleGap,
    Step,
    StepAdded,
    SweepLevel,
    Timing,
    Trip,
)
from twin.transport import shaketwin_pb2 as pb
from twin.transport.endpoint import BLOCK_TOPICS, CMP_TOPIC, HASH_TOPIC
from twin.transport.series import SeriesItem, split_item

Item = Block | Record

# Topic of each record type and its message in `shaketwin.proto`, which outlive names of classes.
RECORD_MESSAGES: dict[type, tuple[str, str]] = {
    RunStart: ("/run/start", "RunStart"),
    RunStop: ("/run/stop", "RunStop"),
    Event: ("/run/event", "Event"),
    Fault: ("/run/fault", "Fault"),
    SampleGap: ("/rig/gap", "Gap"),
    Check: ("/rig/check", "Check"),
    FrequencyResponse: ("/rig/response", "Response"),
    Level: ("/rig/level", "Level"),
    SweepLevel: ("/rig/sweep", "SweepLevel"),
    StepAdded: ("/rig/decided", "Decided"),
    OrbitPoint: ("/rig/orbit", "Orbit"),
    Trip: ("/rig/trip", "Trip"),
    Params: ("/twin/params", "Params"),
    Comparison: (CMP_TOPIC, "Comparison"),
    PredictionHash: (HASH_TOPIC, "PredictionHash"),
    CycleExtremes: ("/twin/cycle", "Cycle"),
    PrcPoint: ("/twin/point", "Point"),
    Agreement: ("/twin/agreement", "Agreement"),
    Estimate: ("/twin/estimate", "Estimate"),
    JumpForecast: ("/twin/ahead", "Ahead"),
    Timing: ("/run/timing", "Timing"),
}
RECORD_TOPICS = {kind: topic for kind, (topic, _) in RECORD_MESSAGES.items()}
MESSAGE_NAMES: dict[type, str] = {
    Block: "Block",
    Step: "Step",
    Extremes: "Extremes",
    NormalizedResponse: "Quantities",
    **{kind: name for kind, (_, name) in RECORD_MESSAGES.items()},
}
TOPIC_TYPES: dict[str, type] = {
    **dict.fromkeys(BLOCK_TOPICS.values(), Block),
    **{topic: kind for kind, topic in RECORD_TOPICS.items()},
}

MAX_SAMPLE_INDEX = 2**53  # above, float64 cannot represent every integer
MAX_LABEL = 2**31 - 1  # of a step, label or cycle


class WireError(ValueError):
    """Payload that does not decode as the message type of its topic."""


def topic_for(item: Item) -> str:
    """Return the topic on which an item is published and logged."""
    return BLOCK_TOPICS[item.stream] if isinstance(item, Block) else RECORD_TOPICS[type(item)]


def encode_item(item: Item, run: str) -> bytes:
    """Encode an item deterministically: equal items give equal bytes."""
    if isinstance(item, Block):
        return encode_block(item, run)
    message = _to_message(item)
    if not isinstance(item, RunStart):
        message.run = run
    return bytes(message.SerializeToString(deterministic=True))


def encode_comparisons(comparisons: Sequence[Comparison], run: str) -> list[bytes]:
    """Encode comparisons as `encode_item` does, at once: only their index varies in size."""
    payloads: list[bytes] = []
    for _, series in groupby(comparisons, lambda item: (item.count, item.channels)):
        group = list(series)
        body = encode_item(replace(group[0], index=0), run)
        sums = [(each.measured_ss, each.free_error_ss, each.window_error_ss) for each in group]
        columns = np.array(sums, "<f8")  # (comparison, 3, channel)
        rows = np.tile(np.frombuffer(body, np.uint8), (len(group), 1))
        for column, place in enumerate(_locate_sums(group[0], run, len(body))):
            rows[:, place] = np.ascontiguousarray(columns[:, column]).view(np.uint8)
        payloads += [
            pb.Comparison(index=each.index).SerializeToString() + row.tobytes()
            for each, row in zip(group, rows, strict=True)
        ]
    return payloads


def _locate_sums(comparison: Comparison, run: str, length: int) -> list[slice]:
    """Return the places of measured, free and window sums in a payload of so many bytes."""
    end, size = length - len(encode_run(Comparison, run)), 8 * len(comparison.channels)
    step = len(pb.Comparison(measured_ss=comparison.measured_ss).SerializeToString())
    return [slice(end - size - k * step, end - k * step) for k in (2, 1, 0)]


class DecodedSeries(NamedTuple):
    """Items like `head`, at other samples and with other numbers, by the places of their payloads.

    `values` and `integers` are the columns of one item after the other, see `split_item`.
    """

    places: Int1D
    run: str
    head: SeriesItem
    indices: Int1D
    values: Float2D
    integers: Int2D


def decode_series(
    topic_name: str, payloads: Sequence[bytes], errors: list[str]
) -> Iterator[DecodedSeries]:
    """Yield blocks or comparisons decoded; why one is not decoded is appended to `errors`.

    Those of a run differ in index and numbers, which lie at the same places in payloads of one
    length: as many as follow each other are decoded at once, and any other one by one.
    """
    for _, group in groupby(range(len(payloads)), lambda place: len(payloads[place])):
        places = list(group)
        series = _decode_alike(topic_name, payloads, places) if len(places) > 1 else None
        if series is not None:
            yield series
        done = () if series is None else series.places.tolist()
        for place in sorted({*places}.difference(done)):
            try:
                run, item = decode_item(topic_name, payloads[place])
                columns = split_item(cast(SeriesItem, item))
            except WireError as error:
                errors.append(str(error))
            except ValueError as error:
                errors.append(f"{topic_name}: {error}")
            else:
                head = cast(SeriesItem, item)
                yield DecodedSeries(np.array([place]), run, head, np.array([item.index]), *columns)


def _decode_alike(
    topic_name: str, payloads: Sequence[bytes], places: list[int]
) -> DecodedSeries | None:
    """Decode those of the payloads, of one length, that are like the first; None if it is unusual.

    It is if it does not decode, or is not encoded as `encode_item` does.
    """
    example = payloads[places[0]]
    try:
        run, item = decode_item(topic_name, example)
        head = cast(SeriesItem, item)
        shape = split_item(head)[0].shape
    except ValueError:
        return None
    if encode_item(head, run) != example:
        return None
    rows = np.frombuffer(b"".join(payloads[place] for place in places), np.uint8)
    rows = rows.reshape(len(places), -1)
    digits, *spans = _locate_numbers(head, run, len(example))
    is_free = np.zeros(len(example), dtype=bool)
    for span in (digits, *spans):
        is_free[span] = True
    varint = rows[:, digits]
    is_alike = (rows[:, ~is_free] == rows[0, ~is_free]).all(axis=1)
    is_alike &= ((varint & 0x80) == (varint[0] & 0x80)).all(axis=1)
    index = ((varint & 0x7F) * (1 << 7 * np.arange(varint.shape[1]))).sum(axis=1, dtype=np.int64)
    is_alike &= index + shape[1] <= MAX_SAMPLE_INDEX
    if not is_alike.all():
        rows, index = rows[is_alike], index[is_alike]
    numbers = [np.ascontiguousarray(rows[:, span]) for span in spans]
    if isinstance(head, Block):
        columns = [
            part.view(kind)
            .reshape(len(rows), height, shape[1])
            .transpose(1, 0, 2)
            .reshape(height, len(rows) * shape[1])
            for part, kind, height in zip(numbers, ("<f8", "<i4"), (shape[0], 3), strict=True)
        ]
        values, integers = columns[0], columns[1].astype(np.int64)
    else:
        values = np.hstack([part.view("<f8") for part in numbers]).T
        integers = np.zeros((3, len(rows)), np.int64)
        integers[0] = head.count
    return DecodedSeries(np.array(places)[is_alike], run, head, index, values, integers)


def _locate_numbers(head: SeriesItem, run: str, length: int) -> list[slice]:
    """Return the places of the digits of the index, and of the numbers, in a payload."""
    kind = type(head)
    message = getattr(pb, MESSAGE_NAMES[kind])
    digits = len(message(index=head.index).SerializeToString())
    if isinstance(head, Comparison):
        return [slice(1, digits), *_locate_sums(head, run, length)]
    begin = len(message(run=run, stream=head.stream).SerializeToString())
    labels = length - 12 * len(head)
    end = length - len(message(labels=bytes(12 * len(head))).SerializeToString())
    values = slice(end - head.values.nbytes, end)
    return [slice(begin + 1, begin + digits), values, slice(labels, length)]


def strip_run(payload: bytes, kind: type, run: str) -> bytes:
    """Return the payload of an item without its run id, for comparing runs.

    Of a kind whose first or last field is the run, as of a block; others stay as they are.
    """
    field = encode_run(kind, run)
    return payload.removeprefix(field) if kind is Block else payload.removesuffix(field)


@cache
def encode_run(kind: type, run: str) -> bytes:
    """Return the field with the run id in the payloads of a kind; the last one but of blocks."""
    return bytes(getattr(pb, MESSAGE_NAMES[kind])(run=run).SerializeToString())


def decode_item(topic_name: str, payload: bytes) -> tuple[str, Item]:
    """Decode a payload of a topic to (run id, item); raise WireError if it is not valid."""
    kind = TOPIC_TYPES.get(topic_name)
    if kind is None:
        raise WireError(f"{topic_name}: unknown topic; known: {', '.join(TOPIC_TYPES)}")
    message: Any = getattr(pb, MESSAGE_NAMES[kind])()
    try:
        message.ParseFromString(payload)
        if kind is Block and BLOCK_TOPICS.get(message.stream) != topic_name:
            raise ValueError(f"its stream is {message.stream!r}")
        return message.run, _to_block(message) if kind is Block else _to_record(kind, message)
    except (DecodeError, ValueError, TypeError, OverflowError) as error:
        raise WireError(f"{topic_name}: not a {MESSAGE_NAMES[kind]}: {error}") from None


def message_schema(kind: type) -> tuple[str, bytes]:
    """Return (full message name, serialized FileDescriptorSet) of an item type."""
    return f"shaketwin.{MESSAGE_NAMES[kind]}", FileDescriptorSet(
        file=[_file_descriptor()]
    ).SerializeToString()


def build_flat_schema(name: str, columns: Sequence[tuple[str, str]]) -> bytes:
    """Return the serialized FileDescriptorSet of a flat message with (field, type) columns.

    Fields are numbered from 1. A type is a protobuf scalar type, or "time" for a Timestamp.
    """
    package, _, message_name = name.rpartition(".")
    message = DescriptorProto(name=message_name)
    for number, (field, kind) in enumerate(columns, start=1):
        descriptor = message.field.add(name=field, number=number)
        descriptor.label = FieldDescriptorProto.LABEL_OPTIONAL
        descriptor.type = FieldDescriptorProto.Type.Value(
            f"TYPE_{'message' if kind == 'time' else kind}".upper()
        )
        if kind == "time":
            descriptor.type_name = f".{Timestamp.DESCRIPTOR.full_name}"
    timestamp_file = FileDescriptorProto()
    Timestamp.DESCRIPTOR.file.CopyToProto(timestamp_file)
    file = FileDescriptorProto(name=f"{name}.proto", package=package, syntax="proto3")
    file.dependency.append(timestamp_file.name)
    file.message_type.append(message)
    return FileDescriptorSet(file=[timestamp_file, file]).SerializeToString()


def _file_descriptor() -> Any:
    proto = FileDescriptorProto()
    pb.DESCRIPTOR.CopyToProto(proto)
    return proto


def encode_block(block: Block, run: str) -> bytes:
    """Encode a block of run `run`; equal blocks give equal bytes."""
    labels = np.stack([block.step, block.label, block.cycle])
    if labels.size and max(labels.max(), -labels.min()) > MAX_LABEL:
        raise ValueError(f"step, label or cycle is beyond {MAX_LABEL}")
    message = pb.Block(
        run=run,
        stream=block.stream,
        index=block.index,
        rate_hz=block.rate_hz,
        names=block.channels,
        values=block.values.astype("<f8", copy=False).tobytes(),
        labels=labels.astype("<i4").tobytes(),
    )
    return bytes(message.SerializeToString())


def _to_block(message: Any) -> Block:
    if not 0 < message.rate_hz < float("inf"):
        raise ValueError(f"rate_hz = {message.rate_hz}")
    if message.channels or message.step:
        names, values, labels = _read_number_lists(message)
    else:
        names = _share_names(tuple(message.names))
        labels = np.frombuffer(message.labels, "<i4").reshape(3, -1).astype(np.int64)
        values = np.frombuffer(message.values, "<f8").reshape(len(names), labels.shape[1])
    if message.index + labels.shape[1] > MAX_SAMPLE_INDEX:
        raise ValueError(f"index = {message.index}")
    return Block(message.stream, message.index, message.rate_hz, names, values, *labels)


def _read_number_lists(message: Any) -> tuple[tuple[str, ...], Float2D, npt.NDArray[np.int64]]:
    """Return (channels, values, labels) of a block in schema 1 or 2, number by number."""
    labels = np.array([message.step, message.label, message.cycle], dtype=np.int64)
    rows = [channel.values for channel in message.channels]
    values = np.array(rows, dtype=np.float64).reshape(len(rows), labels.shape[1])
    return tuple(channel.name for channel in message.channels), values, labels


def _to_message(record: Any) -> Any:
    """Convert a dataclass, nested ones included, to its protobuf message; None is left unset."""
    kind = type(record)
    if kind not in _FIELD_NAMES:
        _FIELD_NAMES[kind] = tuple(field.name for field in fields(kind))
    values = {}
    for name in _FIELD_NAMES[kind]:
        value = getattr(record, name)
        if value is not None:
            values[name] = value if type(value) in _SCALAR_TYPES else _to_plain(value)
    return getattr(pb, MESSAGE_NAMES[kind])(**values)


def _to_plain(value: Any) -> Any:
    if isinstance(value, tuple):  # elements share one type, so the first decides
        return (
            value
            if not value or type(value[0]) in _SCALAR_TYPES
            else [_to_plain(element) for element in value]
        )
    return _to_message(value) if is_dataclass(value) else value


def _conversion_plan(kind: Any) -> list[tuple[str, bool, Callable[[Any], Any]]]:
    """Return (field name, whether optional, converter from the protobuf value) of each field."""
    hints = get_type_hints(kind)
    plan = []
    for field in fields(kind):
        hint = hints[field.name]
        optional = get_origin(hint) is UnionType
        if optional:
            (hint,) = (arg for arg in get_args(hint) if arg is not NoneType)
        plan.append((field.name, optional, _field_converter(hint)))
    return plan


def _field_converter(hint: Any) -> Callable[[Any], Any]:
    inner = next(iter(get_args(hint)), None)
    if get_origin(hint) is tuple and is_dataclass(inner):
        return lambda value: tuple(_to_record(inner, element) for element in value)
    if is_dataclass(hint):
        return partial(_to_record, hint)
    if get_origin(hint) is tuple and inner is str:
        return lambda value: _share_names(tuple(value))
    return get_origin(hint) or (_check_integer if hint is int else hint)


@lru_cache(maxsize=256)
def _share_names(names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the same tuple for equal names: almost every item of a recording repeats its own."""
    return names


def _check_integer(value: int) -> int:
    if value > MAX_SAMPLE_INDEX:
        raise ValueError(f"{value} is above the maximum, {MAX_SAMPLE_INDEX}")
    return value


_FIELD_NAMES: dict[type, tuple[str, ...]] = {}
_SCALAR_TYPES = frozenset((int, float, str, bool, dict))
_CONVERSION_PLANS: dict[type, list[tuple[str, bool, Callable[[Any], Any]]]] = {}


def _to_record(kind: Any, message: Any) -> Any:
    """Convert a protobuf message to its dataclass; inverse of `_to_message`."""
    if kind not in _CONVERSION_PLANS:
        _CONVERSION_PLANS[kind] = _conversion_plan(kind)
    return kind(
        **{
            name: None if optional and not message.HasField(name) else make(getattr(message, name))
            for name, optional, make in _CONVERSION_PLANS[kind]
        }
    )


def regenerate_protobuf() -> None:
    """Regenerate shaketwin_pb2.py and .pyi from the .proto (needs the extra "proto")."""
    folder = Path(__file__).parent
    command = [sys.executable, "-P", "-m", "grpc_tools.protoc", f"-I{folder}"]
    command += [f"--python_out={folder}", f"--pyi_out={folder}", str(folder / "shaketwin.proto")]
    subprocess.run(command, check=True)


if __name__ == "__main__":
    regenerate_protobuf()
