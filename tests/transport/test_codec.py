"""The one encoder: every item comes back to the bit, and bytes that are no item are refused."""

import struct
import subprocess
import sys
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, cast, get_args, get_origin, get_type_hints

import numpy as np
import pytest
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorProto, FileDescriptorSet
from hypothesis import given, settings
from hypothesis import strategies as st

from table_io.block import Block
from table_io.records import (
    Comparison,
    CycleExtremes,
    Extremes,
    PrcPoint,
    Record,
    RunStart,
    SampleGap,
)
from twin.transport import codec, endpoint
from twin.transport import shaketwin_pb2 as pb
from twin.transport.codec import (
    Item,
    WireError,
    decode_item,
    decode_series,
    encode_comparisons,
    encode_item,
    topic_for,
)
from twin.transport.series import SeriesItem, join_item, split_item

STREAM = Path(codec.__file__).parent
ODD = (float("nan"), float("inf"), float("-inf"), -0.0, 5e-324, 1.7976931348623157e308)
RECORD_TYPES: tuple[type, ...] = get_args(Record)


@cache
def anything_like(hint: Any) -> st.SearchStrategy[Any]:
    """Values of a type as it stands in the records."""
    if get_origin(hint) is UnionType:
        return st.one_of(*(anything_like(arg) for arg in get_args(hint)))
    if get_origin(hint) is tuple:
        return st.lists(anything_like(get_args(hint)[0]), max_size=4).map(tuple)
    if get_origin(hint) is dict:
        return st.dictionaries(*(anything_like(arg) for arg in get_args(hint)), max_size=4)
    if isinstance(hint, type) and is_dataclass(hint):
        hints = get_type_hints(hint)
        return st.builds(
            hint, **{field.name: anything_like(hints[field.name]) for field in fields(hint)}
        )
    return {
        NoneType: st.none(),
        int: st.integers(0, codec.MAX_SAMPLE_INDEX),
        bool: st.booleans(),
        float: st.one_of(st.sampled_from(ODD), st.floats()),
        str: st.text(max_size=20),
        bytes: st.binary(max_size=20),
    }[hint]


@st.composite
def any_block(draw: st.DrawFn) -> Block:
    channels = tuple(draw(st.lists(st.text(max_size=8), max_size=4)))
    samples = draw(st.integers(0, 30))
    size = len(channels) * samples
    numbers = st.one_of(st.sampled_from(ODD), st.floats())
    values = draw(st.lists(numbers, min_size=size, max_size=size))
    whole = st.lists(st.integers(-1, codec.MAX_LABEL), min_size=samples, max_size=samples)
    labels = [np.array(draw(whole), dtype=np.int64) for _ in range(3)]
    return Block(
        draw(st.sampled_from(sorted(endpoint.BLOCK_TOPICS))),
        draw(st.integers(0, codec.MAX_SAMPLE_INDEX - samples)),
        draw(st.floats(1.0, 1e6)),
        channels,
        np.array(values, dtype=np.float64).reshape(len(channels), samples),
        *labels,
    )


def bits(value: Any) -> Any:
    """The value with every float replaced by its eight bytes, so that equal means to the bit."""
    if isinstance(value, float):
        return struct.pack("<d", value)
    if isinstance(value, tuple):
        return tuple(bits(element) for element in value)
    if isinstance(value, dict):
        return {key: bits(element) for key, element in value.items()}
    if is_dataclass(value):
        return type(value), tuple(bits(getattr(value, field.name)) for field in fields(value))
    return value


def return_through_bytes(item: Item) -> Item:
    """The item after a way through bytes."""
    name, back = decode_item(topic_for(item), encode_item(item, "run-7"))
    assert name == (item.run if isinstance(item, RunStart) else "run-7")
    return back


@pytest.mark.parametrize("kind", RECORD_TYPES, ids=lambda kind: kind.__name__)
def test_every_record_comes_back_to_the_bit(kind: type) -> None:
    @given(anything_like(kind))
    @settings(max_examples=40)
    def law(record: Record) -> None:
        back = return_through_bytes(record)
        assert bits(back) == bits(record)
        assert encode_item(back, "run-7") == encode_item(record, "run-7")

    law()


def test_missing_and_empty_fields_differ() -> None:
    none = CycleExtremes(20, 1, 0, 3, 100, None, None)
    zeros = Extremes(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, (), ())
    empty = CycleExtremes(20, 1, 0, 3, 100, zeros, None)
    assert return_through_bytes(none) == none
    assert return_through_bytes(empty) == empty
    assert encode_item(none, "") != encode_item(empty, "")
    point = PrcPoint(20, 1, "forward", 2.0, None, None, -0.0, float("nan"), 0.0)
    assert bits(return_through_bytes(point)) == bits(point)


def test_the_order_in_a_dictionary_changes_no_byte() -> None:
    def start(names: str) -> RunStart:
        tare = {name: float(ord(name)) for name in names}
        return RunStart(
            0, "run", "n", "table", "", "", "", 2e3, 20, (), (), 0, tare, {}, "", "", 0.0
        )

    letters = "abcdefghijklmnop"
    assert encode_item(start(letters), "") == encode_item(start(letters[::-1]), "")


def test_every_kind_has_a_topic_of_its_own() -> None:
    assert set(codec.RECORD_TOPICS) == set(RECORD_TYPES)
    topics = [*endpoint.BLOCK_TOPICS.values(), *codec.RECORD_TOPICS.values()]
    assert len(set(topics)) == len(topics)
    assert set(codec.TOPIC_TYPES) == set(topics)
    for stream, name in endpoint.BLOCK_TOPICS.items():
        empty = np.zeros(0, dtype=np.int64)
        block = Block(stream, 0, 2e3, ("a",), np.zeros((1, 0)), empty, empty, empty)
        assert topic_for(block) == name


def cards() -> list[type]:
    """Every dataclass that travels, the nested ones included."""
    return [kind for kind in codec.MESSAGE_NAMES if kind is not Block]


def describe_hint(hint: Any) -> tuple[str, str]:
    """(kind, "one" | "optional" | "many" | "map") that a proto field must have for a type hint."""
    if get_origin(hint) is UnionType:
        return describe_hint(next(arg for arg in get_args(hint) if arg is not NoneType))[
            0
        ], "optional"
    if get_origin(hint) is tuple:
        return describe_hint(get_args(hint)[0])[0], "many"
    if get_origin(hint) is dict:
        return " to ".join(describe_hint(arg)[0] for arg in get_args(hint)), "map"
    return codec.MESSAGE_NAMES.get(hint, hint.__name__), "one"


def describe_field(field: FieldDescriptor) -> tuple[str, str]:
    """The same of a proto field."""
    kinds = {
        FieldDescriptor.CPPTYPE_INT64: "int",
        FieldDescriptor.CPPTYPE_UINT64: "int",
        FieldDescriptor.CPPTYPE_DOUBLE: "float",
        FieldDescriptor.CPPTYPE_BOOL: "bool",
        FieldDescriptor.CPPTYPE_STRING: "str",
    }
    if field.type == FieldDescriptor.TYPE_BYTES:
        return "bytes", "one"
    if field.message_type is None:
        optional = "optional" if field.containing_oneof is not None else "one"
        return kinds[field.cpp_type], "many" if field.is_repeated else optional
    if field.message_type.GetOptions().map_entry:
        parts = field.message_type.fields_by_name
        return f"{describe_field(parts['key'])[0]} to {describe_field(parts['value'])[0]}", "map"
    return field.message_type.name, "many" if field.is_repeated else "optional"


@pytest.mark.parametrize("kind", cards(), ids=lambda kind: kind.__name__)
def test_the_schema_has_the_fields_of_the_record_and_no_other(kind: type) -> None:
    hints = get_type_hints(kind)
    record = {field.name: describe_hint(hints[field.name]) for field in fields(kind)}
    if kind in RECORD_TYPES:
        record["run"] = ("str", "one")  # the wire adds the run to what does not name it itself
    message = pb.DESCRIPTOR.message_types_by_name[codec.MESSAGE_NAMES[kind]]
    assert {field.name: describe_field(field) for field in message.fields} == record


def test_the_schema_has_the_fields_of_a_block_and_no_other() -> None:
    message = pb.DESCRIPTOR.message_types_by_name["Block"]
    names = {field.name for field in fields(Block)}  # the lists of schema 1 and 2
    assert {field.name for field in message.fields} == {*names, "run", "names", "labels"}
    channel = message.fields_by_name["channels"].message_type
    assert channel is not None
    assert {field.name for field in channel.fields} == {"name", "values"}
    messages = {codec.MESSAGE_NAMES[kind] for kind in cards()} | {"Block", "Channel"}
    assert set(pb.DESCRIPTOR.message_types_by_name) == messages


def refused_or_an_item(name: str, payload: bytes) -> bool:
    """True if the bytes are refused in the words of the codec, or are an item of that topic."""
    try:
        _, item = decode_item(name, payload)
    except WireError as error:
        return str(error).startswith(f"{name}: not a ")
    return topic_for(item) == name


@given(name=st.sampled_from(sorted(codec.TOPIC_TYPES)), payload=st.binary(max_size=200))
@settings(max_examples=300)
def test_garbage_is_refused_or_is_an_item(name: str, payload: bytes) -> None:
    assert refused_or_an_item(name, payload)


@given(st.data())
@settings(max_examples=150)
def test_damaged_bytes_are_refused_or_are_an_item(data: st.DataObject) -> None:
    item = data.draw(any_block() if data.draw(st.booleans()) else anything_like(PrcPoint))
    payload = bytearray(encode_item(item, "run"))
    for _ in range(data.draw(st.integers(1, 3))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(0, len(payload)))
    assert refused_or_an_item(topic_for(item), bytes(payload[:cut]))


def test_bytes_on_the_wrong_topic_are_refused() -> None:
    labels = np.zeros(2, dtype=np.int64)
    block = Block("meas", 0, 2e3, ("a",), np.ones((1, 2)), labels, labels, labels)
    with pytest.raises(WireError, match=r"/twin/pred: not a Block: .*'meas'"):
        decode_item(endpoint.PRED_TOPIC, encode_item(block, "run"))
    with pytest.raises(WireError, match=r"/rig/nothing: unknown topic; known: /rig/meas"):
        decode_item("/rig/nothing", encode_item(SampleGap(0, 1, "", "lost"), "run"))


@pytest.mark.parametrize("cut", ["values", "step"])
def test_a_block_with_unequal_lengths_is_refused(cut: str) -> None:
    message = pb.Block(
        run="r",
        stream="meas",
        rate_hz=2e3,
        channels=[pb.Channel(name=name, values=[1.0, 2.0]) for name in "ab"],
        step=[0, 0],
        label=[0, 0],
        cycle=[0, 0],
    )
    assert len(decode_item(endpoint.MEAS_TOPIC, message.SerializeToString())[1]) == 2  # type: ignore[arg-type]
    del (message.channels[1].values if cut == "values" else message.step)[-1:]
    with pytest.raises(WireError, match="not a Block"):
        decode_item(endpoint.MEAS_TOPIC, message.SerializeToString())


def test_a_record_that_the_schema_does_not_know_cannot_slip_through(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    @dataclass(frozen=True)
    class Gap:  # as if a field had been added to the record and not to the schema
        index: int
        colour: str

    monkeypatch.setitem(codec.MESSAGE_NAMES, Gap, "Gap")
    with pytest.raises(ValueError, match="colour"):
        encode_item(Gap(1, "red"), "run")  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", [Block, *RECORD_TYPES], ids=lambda kind: kind.__name__)
def test_the_schema_in_a_log_is_that_of_its_messages(kind: type) -> None:
    name, data = codec.message_schema(kind)
    (file,) = FileDescriptorSet.FromString(data).file
    assert name == f"{file.package}.{codec.MESSAGE_NAMES[kind]}"
    assert codec.MESSAGE_NAMES[kind] in {message.name for message in file.message_type}


def test_generated_module_matches_the_proto_file(tmp_path: Path) -> None:
    pytest.importorskip("grpc_tools", reason='needs the extra "proto" to read shaketwin.proto')
    out = tmp_path / "descriptors"
    command = [sys.executable, "-m", "grpc_tools.protoc", f"-I{STREAM}"]
    command += [f"--descriptor_set_out={out}", str(STREAM / "shaketwin.proto")]
    subprocess.run(command, check=True)
    (written,) = FileDescriptorSet.FromString(out.read_bytes()).file
    generated = FileDescriptorProto()
    pb.DESCRIPTOR.CopyToProto(generated)
    assert plain(generated) == plain(written)


def plain(file: FileDescriptorProto) -> FileDescriptorProto:
    """The descriptor without its JSON names, which only some tools write."""
    waiting = list(file.message_type)
    while waiting:
        message = waiting.pop()
        waiting.extend(message.nested_type)
        for field in message.field:
            field.ClearField("json_name")
    return file


def ends_with_run(kind: type) -> bool:
    """True if the run is the last field of the message: later ones were added to some kinds."""
    fields_by_number = getattr(pb, codec.MESSAGE_NAMES[kind]).DESCRIPTOR.fields_by_number
    return bool(fields_by_number[max(fields_by_number)].name == "run")


def test_the_run_is_the_last_field_of_a_comparison() -> None:
    assert ends_with_run(Comparison)


@pytest.mark.parametrize("kind", [kind for kind in RECORD_TYPES if ends_with_run(kind)])
@given(data=st.data())
@settings(max_examples=4)
def test_a_record_without_its_run_is_that_of_any_run(kind: type, data: st.DataObject) -> None:
    record = data.draw(anything_like(kind))
    stripped = [codec.strip_run(encode_item(record, run), kind, run) for run in ("a", "run 7")]
    assert stripped[0] == stripped[1] == encode_item(record, "")
    other = encode_item(record, "b")
    assert codec.strip_run(other, kind, "a") == other


@pytest.mark.parametrize("run", ["", "a", "r" * 200])
def test_comparisons_at_once_have_the_bytes_of_each(run: str) -> None:
    numbers = iter(np.random.default_rng(1).standard_normal(400).tolist())
    series = [
        Comparison(index, count, names, *(tuple(next(numbers) for _ in names) for _ in range(3)))
        for names in (("u", "a"), (), tuple("abcdefghijklmnopqrst"))
        for index, count in ((0, 7), (7, 20), (127, 20), (2**40, 20))
    ]
    series.append(Comparison(5, 1, ("u", "a"), ODD[:2], ODD[2:4], ODD[4:]))
    assert encode_comparisons(series, run) == [encode_item(each, run) for each in series]
    assert encode_comparisons([], run) == []


def decode_alone(topic: str, payload: bytes) -> tuple[str, Item] | None:
    """Return run and item; None of what has no columns of equal lengths."""
    try:
        run, item = decode_item(topic, payload)
        split_item(cast(SeriesItem, item))
    except ValueError:
        return None
    return run, item


def decode_at_once(topic: str, payloads: list[bytes]) -> tuple[dict[int, tuple[str, Item]], int]:
    """Return run and item by place, and the number of series."""
    decoded: dict[int, tuple[str, Item]] = {}
    errors: list[str] = []
    all_series = list(decode_series(topic, payloads, errors))
    for series in all_series:
        size = series.values.shape[1] // series.places.size
        for k, (place, index) in enumerate(zip(series.places, series.indices, strict=True)):
            part = slice(k * size, (k + 1) * size)
            columns = series.values[:, part], series.integers[:, part]
            assert int(place) not in decoded
            decoded[int(place)] = series.run, join_item(series.head, int(index), *columns)
    assert len(decoded) + len(errors) == len(payloads)
    return decoded, len(all_series)


def make_series(names: tuple[str, ...], indices: list[int]) -> list[list[SeriesItem]]:
    """Return comparisons and blocks at these samples."""
    rng = np.random.default_rng(2)
    sums = [map(tuple, rng.random((3, len(names))).tolist()) for _ in indices]
    labels = rng.integers(-1, 9, (len(indices), 3, 5))
    values = rng.standard_normal((len(indices), len(names), 5))
    return [
        [Comparison(index, 20, names, *own) for index, own in zip(indices, sums, strict=True)],
        [
            Block("meas", index, 2000.0, names, *own)
            for index, *own in zip(indices, values, *labels.transpose(1, 0, 2), strict=True)
        ],
    ]


@pytest.mark.parametrize("run", ["", "a", "r" * 200])
@pytest.mark.parametrize("kind", [0, 1])
def test_a_series_decoded_at_once_is_that_decoded_one_by_one(run: str, kind: int) -> None:
    """Also of damaged ones, whose damage may lie in any byte."""
    rng = np.random.default_rng(2)
    indices = [0, 3, 4, 127, 128, 300, 301, 2**40, 2**40 + 1]
    topic = (endpoint.CMP_TOPIC, endpoint.MEAS_TOPIC)[kind]
    whole = []
    for names in (("u", "a"), (), ("u", "b")):
        payloads = [encode_item(each, run) for each in make_series(names, indices)[kind]]
        decoded, count = decode_at_once(topic, payloads)
        assert count == 4  # one for each number of digits
        for place, payload in enumerate(payloads):
            assert decoded[place][0] == run
            assert encode_item(decoded[place][1], run) == payload
        whole += payloads
    assert decode_at_once(topic, []) == ({}, 0)
    mixed = []
    for payload in whole * 40:
        values = bytearray(payload)
        values[int(rng.integers(len(values)))] ^= 1 << int(rng.integers(8))
        mixed += [payload, bytes(values)]
    decoded, _ = decode_at_once(topic, mixed)
    for place, payload in enumerate(mixed):
        alone = decode_alone(topic, payload)
        assert (alone is None) == (place not in decoded)
        if alone is not None:
            assert decoded[place][0] == alone[0]
            both = [cast(SeriesItem, item) for item in (decoded[place][1], alone[1])]
            assert both[0].channels == both[1].channels
            first, second = ([part.tobytes() for part in split_item(item)] for item in both)
            assert first == second


def test_a_flat_schema_has_its_columns_in_order() -> None:
    columns = [("t", "time"), ("x", "double"), ("label", "string"), ("n", "int64"), ("u", "time")]
    schema = codec.build_flat_schema("lab.rig.Row", columns)
    times, file = FileDescriptorSet.FromString(schema).file
    assert (file.name, file.package, file.syntax) == ("lab.rig.Row.proto", "lab.rig", "proto3")
    assert list(file.dependency) == [times.name]
    (message,) = file.message_type
    assert message.name == "Row"
    assert [(column.name, column.number) for column in message.field] == [
        (name, number) for number, (name, _) in enumerate(columns, 1)
    ]
    time_type = f".{times.package}.{times.message_type[0].name}"
    kinds = {"double": 1, "int64": 3, "string": 9, "time": 11}  # numbers of protobuf
    assert [(column.type, column.type_name) for column in message.field] == [
        (kinds[kind], time_type if kind == "time" else "") for _, kind in columns
    ]
    assert {column.label for column in message.field} == {FieldDescriptor.LABEL_OPTIONAL}
