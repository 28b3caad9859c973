"""Export to Foxglove: an MCAP file with one message per sample, and a layout.

Foxglove plots one value per message time, so blocks are split: messages on `/measured` and `/twin`
hold one sample, on `/prc` a point of the pseudo-resonance curves, on `/events` a foxglove.Log. All
are protobuf with embedded schemas; the time of a message is that of its sample, absolute by the
start of the run.
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from heapq import merge
from operator import itemgetter
from typing import Any, BinaryIO

import numpy as np

from table_io.block import Int1D
from table_io.channels import TIME_COLUMN
from table_io.records import RESPONSE_RATIOS, Event, PrcPoint, Record, format_record
from twin.recording.mcap_log import open_foreign_log
from twin.recording.reader import find_start_ns
from twin.recording.tabular import (
    DIRECTION_SIGNS,
    LABEL_UNITS,
    TWIN_PREFIX,
    WINDOW_ROWS,
    Columns,
    LogTable,
)
from twin.transport.codec import build_flat_schema

MEASURED_TOPIC = "/measured"
PREDICTED_TOPIC = "/twin"
CURVES_TOPIC = "/prc"
EVENTS_TOPIC = "/events"
Fields = list[tuple[str, str]]  # name, protobuf type; numbered from 2, after the timestamp
LOG_FIELDS: Fields = [("level", "int32"), ("message", "string"), ("name", "string")]
LEVEL_WARNING, LEVEL_INFO = 3, 2  # levels of foxglove.Log
PRC_QUANTITIES = [*RESPONSE_RATIOS, "drift", "spread"]
MAX_PLOTS = 5
FOLLOW_WINDOW_S = 10.0
PRC_COLUMNS = [
    "step",
    "direction",
    "frequency_hz",
    *PRC_QUANTITIES,
    *(TWIN_PREFIX + name for name in PRC_QUANTITIES),
]
WIRE_8, WIRE_BYTES, WIRE_4 = 1, 2, 5  # protobuf wire types
LINE_COLOURS = ("#e8e8e8", "#f5a623", "#4a90e2")  # measured, restarted twin, free-running twin


@dataclass(frozen=True, slots=True)
class SampleClock:
    """Time of each sample, by the start of the run in ns since 1970 and the sampling rate."""

    started_ns: int
    rate_hz: float

    def find_ns(self, index: int) -> int:
        return self.started_ns + round(index * 1e9 / self.rate_hz)


FoxgloveMessage = tuple[str, int, bytes]  # topic, sample index, payload


def write_foxglove(rows: LogTable, file: BinaryIO) -> None:
    """Write rows, PRC points and events as an MCAP file for Foxglove."""
    kinds = {name: column.dtype.kind for name, column in rows.read_columns(slice(0, 1)).items()}
    fields_by_topic: dict[str, Fields] = {MEASURED_TOPIC: [], PREDICTED_TOPIC: []}
    for name, kind in kinds.items():
        if name != TIME_COLUMN:
            topic = PREDICTED_TOPIC if name.startswith(TWIN_PREFIX) else MEASURED_TOPIC
            fields_by_topic[topic].append((name, "sfixed32" if kind == "i" else "double"))
    fields_by_topic = {
        topic: topic_fields for topic, topic_fields in fields_by_topic.items() if topic_fields
    }
    curves = [(name, "double") for name in PRC_COLUMNS]
    clock = SampleClock(find_start_ns(rows.start), rows.start.rate_hz)
    with open_foreign_log(file) as writer:
        ids = {}
        for topic, message_fields in {
            **fields_by_topic,
            CURVES_TOPIC: curves,
            EVENTS_TOPIC: LOG_FIELDS,
        }.items():
            name = (
                "foxglove.Log" if topic == EVENTS_TOPIC else f"shaketwin.export.{topic[1:].title()}"
            )
            schema = build_flat_schema(name, [("timestamp", "time"), *message_fields])
            schema_id = writer.register_schema(name, "protobuf", schema)
            ids[topic] = writer.register_channel(topic, "protobuf", schema_id)
        messages = (_to_message(record, clock) for record in rows.records)
        for topic, index, payload in merge(
            messages, _iter_samples(rows, clock, fields_by_topic), key=itemgetter(1)
        ):
            time_ns = clock.find_ns(index)
            writer.add_message(ids[topic], log_time=time_ns, data=payload, publish_time=time_ns)


def _iter_samples(
    rows: LogTable, clock: SampleClock, fields_by_topic: dict[str, Fields]
) -> Iterator[FoxgloveMessage]:
    """Yield one message per sample and topic."""
    first = 0
    for window in rows.iter_windows():
        index = rows.index[first : first + WINDOW_ROWS]
        first += index.size
        payloads_by_topic = {
            topic: _pack_rows(index, clock, window, topic_fields)
            for topic, topic_fields in fields_by_topic.items()
        }
        for k, sample in enumerate(index.tolist()):
            for topic, payloads in payloads_by_topic.items():
                yield topic, sample, payloads[k]


def _pack_rows(
    index: Int1D, clock: SampleClock, columns: Columns, topic_fields: Fields
) -> list[bytes]:
    """Encode one message per row, vectorized.

    Every field has a fixed width after its tag, so that all rows form one structured array.
    """
    tags, parts = {}, [("timestamp", f"S{len(_encode_timestamp(0))}")]
    for number, (name, kind) in enumerate(topic_fields, start=2):
        tags[name] = _encode_varint(number << 3 | (WIRE_8 if kind == "double" else WIRE_4))
        value = "<f8" if kind == "double" else "<i4"
        parts += [(f"tag {name}", f"S{len(tags[name])}"), (name, value)]
    table = np.zeros(index.size, parts)
    table["timestamp"] = [_encode_timestamp(clock.find_ns(sample)) for sample in index.tolist()]
    for name, tag in tags.items():
        table[f"tag {name}"], table[name] = tag, columns[name]
    data, width = table.tobytes(), table.itemsize
    return [data[k : k + width] for k in range(0, len(data), width)]


def _to_message(record: Record, clock: SampleClock) -> FoxgloveMessage:
    """Encode an event as foxglove.Log, or a PRC point."""
    timestamp = _encode_timestamp(clock.find_ns(record.index))
    if isinstance(record, Event):
        text = format_record(record, clock.rate_hz)
        level = LEVEL_WARNING if text and text[0] != "INFO" else LEVEL_INFO
        payload = timestamp + _encode_varint(2 << 3) + _encode_varint(level)
        return (
            EVENTS_TOPIC,
            record.index,
            payload + _encode_text(3, record.text) + _encode_text(4, record.kind),
        )
    assert isinstance(record, PrcPoint)
    values = [
        float(record.step),
        float(DIRECTION_SIGNS.get(record.direction, 0)),
        record.frequency_hz,
    ]
    for side in (record.measured, record.twin):
        values += [getattr(side, name, float("nan")) for name in PRC_QUANTITIES]
    columns = {name: np.array([value]) for name, value in zip(PRC_COLUMNS, values, strict=True)}
    topic_fields = [(name, "double") for name in PRC_COLUMNS]
    return (
        CURVES_TOPIC,
        record.index,
        _pack_rows(np.array([record.index]), clock, columns, topic_fields)[0],
    )


def _encode_timestamp(time_ns: int) -> bytes:
    """Encode a time as field 1, a Timestamp of fixed width."""
    seconds, nanos = divmod(time_ns, 10**9)
    inner = b"\x08" + _encode_varint(seconds, 5) + b"\x10" + _encode_varint(nanos, 5)
    return _encode_varint(1 << 3 | WIRE_BYTES) + _encode_varint(len(inner)) + inner


def _encode_text(number: int, text: str) -> bytes:
    data = text.encode()
    return _encode_varint(number << 3 | WIRE_BYTES) + _encode_varint(len(data)) + data


def _encode_varint(value: int, width: int = 1) -> bytes:
    """Encode a protobuf varint in at least `width` bytes, padded with redundant zero groups."""
    out = bytearray()
    while value > 0x7F or len(out) < width - 1:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def build_layout(rows: LogTable) -> str:
    """Build a Foxglove layout (JSON): measured and twin per channel, PRC curves, events."""
    panels: dict[str, Any] = {}
    for name in rows.units:
        twins = [f"{TWIN_PREFIX}{track}_{name}" for track in ("window", "free")]
        twins = [twin for twin in twins if twin in rows.units]
        if twins and len(panels) < MAX_PLOTS:
            values = [(f"{MEASURED_TOPIC}.{name}", "measured")]
            values += [(f"{PREDICTED_TOPIC}.{twin}", twin.split("_")[1]) for twin in twins]
            panels[f"Plot!{name}"] = _build_plot(f"{name} [{rows.units[name]}]", values)
    if not panels:
        first = next(name for name in rows.units if name not in (TIME_COLUMN, *LABEL_UNITS))
        panels[f"Plot!{first}"] = _build_plot(first, [(f"{MEASURED_TOPIC}.{first}", "measured")])
    curves = [(f"{CURVES_TOPIC}.eta_d", "measured"), (f"{CURVES_TOPIC}.{TWIN_PREFIX}eta_d", "twin")]
    axis = {
        "xAxisVal": "custom",
        "xAxisPath": {"value": f"{CURVES_TOPIC}.frequency_hz", "enabled": True},
    }
    panels["Plot!curves"] = _build_plot("eta_d over frequency_hz", curves) | axis
    panels["RosOut!events"] = {"topicToRender": EVENTS_TOPIC, "minLogLevel": 1, "searchTerms": []}
    *plots, curves_panel, events = panels
    right_side = {
        "direction": "column",
        "first": curves_panel,
        "second": events,
        "splitPercentage": 60,
    }
    root = {
        "direction": "row",
        "first": _stack_panels(plots),
        "second": right_side,
        "splitPercentage": 65,
    }
    settings = {"globalVariables": {}, "userNodes": {}, "playbackConfig": {"speed": 1}}
    return json.dumps({"configById": panels, **settings, "layout": root}, indent=1) + "\n"


def _build_plot(title: str, values: Sequence[tuple[str, str]]) -> dict[str, Any]:
    """Build a plot panel with lines (message path, label)."""
    return {
        "title": title,
        "paths": [
            {
                "value": value,
                "label": label,
                "color": colour,
                "enabled": True,
                "timestampMethod": "receiveTime",
            }
            for (value, label), colour in zip(values, LINE_COLOURS, strict=False)
        ],
        "xAxisVal": "timestamp",
        "isSynced": True,
        "followingViewWidth": FOLLOW_WINDOW_S,
        "showXAxisLabels": True,
        "showYAxisLabels": True,
        "showLegend": True,
        "legendDisplay": "floating",
        "showPlotValuesInLegend": False,
        "sidebarDimension": 240,
    }


def _stack_panels(panels: Sequence[str]) -> Any:
    """Stack panels vertically with equal height."""
    if len(panels) == 1:
        return panels[0]
    share = 100 / len(panels)
    rest = _stack_panels(panels[1:])
    return {"direction": "column", "first": panels[0], "second": rest, "splitPercentage": share}
