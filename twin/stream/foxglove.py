"""A log for Foxglove: a message a sample in MCAP, and the layout that shows it.

Foxglove plots what has one time a message, so blocks are taken apart: `/measured` and `/twin` hold
a sample each, `/prc` a point of the pseudo-resonance curves, `/events` Foxglove's own Log. All is
protobuf with its schema inside; the time of a message is that of its sample, from 0.
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import fields
from heapq import merge
from operator import itemgetter
from typing import Any, BinaryIO

import numpy as np

from table_io.block import Int1D
from table_io.records import Event, Point, Quantities, Record
from table_io.words import sentence
from twin.stream.mcap_log import foreign_log
from twin.stream.rows import LABELS, TIME, TWIN, WAYS, WINDOW, Columns, Rows
from twin.stream.wire import flat_schema

MEASURED, PREDICTED, CURVES, EVENTS = "/measured", "/twin", "/prc", "/events"
Fields = list[tuple[str, str]]  # name, protobuf type; the timestamp before them is number 1
LOG: Fields = [("level", "int32"), ("message", "string"), ("name", "string")]
WARNING, INFO = 3, 2  # levels of foxglove.Log
RATIOS = [one.name for one in fields(Quantities) if one.type in (float, "float")]
MOST_PLOTS = 5
FOLLOWING_S = 10.0
POINT = ["step", "direction", "frequency_hz", *RATIOS, *(TWIN + name for name in RATIOS)]
WIRE_8, WIRE_BYTES, WIRE_4 = 1, 2, 5  # protobuf's wire types
COLOURS = ("#e8e8e8", "#f5a623", "#4a90e2")  # measured, the twin in its window, running free
Message = tuple[str, int, bytes]  # topic, sample index, payload


def write(rows: Rows, file: BinaryIO) -> None:
    """The rows, curves and events as an MCAP file in Foxglove's terms."""
    kinds = {name: column.dtype.kind for name, column in rows.window(slice(0, 1)).items()}
    typed: dict[str, Fields] = {MEASURED: [], PREDICTED: []}
    for name, kind in kinds.items():
        if name != TIME:
            topic = PREDICTED if name.startswith(TWIN) else MEASURED
            typed[topic].append((name, "sfixed32" if kind == "i" else "double"))
    typed = {topic: plan for topic, plan in typed.items() if plan}
    curves = [(name, "double") for name in POINT]
    rate = rows.start.rate_hz
    with foreign_log(file) as writer:
        ids = {}
        for topic, plan in {**typed, CURVES: curves, EVENTS: LOG}.items():
            name = "foxglove.Log" if topic == EVENTS else f"shaketwin.export.{topic[1:].title()}"
            schema = flat_schema(name, [("timestamp", "time"), *plan])
            of = writer.register_schema(name, "protobuf", schema)
            ids[topic] = writer.register_channel(topic, "protobuf", of)
        told = (_told(one, rate) for one in rows.records)
        for topic, index, payload in merge(told, _samples(rows, typed), key=itemgetter(1)):
            at = round(index * 1e9 / rate)
            writer.add_message(ids[topic], log_time=at, data=payload, publish_time=at)


def _samples(rows: Rows, typed: dict[str, Fields]) -> Iterator[Message]:
    """A message a sample and topic."""
    at = 0
    for window in rows.windows():
        index = rows.index(slice(at, at + WINDOW))
        at += index.size
        packed = {
            topic: _packed(index, rows.start.rate_hz, window, plan) for topic, plan in typed.items()
        }
        for k, sample in enumerate(index.tolist()):
            for topic, payloads in packed.items():
                yield topic, sample, payloads[k]


def _packed(index: Int1D, rate_hz: float, columns: Columns, plan: Fields) -> list[bytes]:
    """The bytes of a message a row.

    Every field has a fixed width, its tag before it, so that all rows are one array.
    """
    tags, parts = {}, [("timestamp", f"S{len(_time(0, 1.0))}")]
    for number, (name, kind) in enumerate(plan, start=2):
        tags[name] = _varint(number << 3 | (WIRE_8 if kind == "double" else WIRE_4))
        value = "<f8" if kind == "double" else "<i4"
        parts += [(f"tag {name}", f"S{len(tags[name])}"), (name, value)]
    table = np.zeros(index.size, parts)
    table["timestamp"] = [_time(one, rate_hz) for one in index.tolist()]
    for name, tag in tags.items():
        table[f"tag {name}"], table[name] = tag, columns[name]
    data, width = table.tobytes(), table.itemsize
    return [data[k : k + width] for k in range(0, len(data), width)]


def _told(record: Record, rate_hz: float) -> Message:
    """An event as Foxglove's Log, or a point of the curves."""
    stamp = _time(record.index, rate_hz)
    if isinstance(record, Event):
        told = sentence(record, rate_hz)
        level = WARNING if told and told[0] != "INFO" else INFO
        payload = stamp + _varint(2 << 3) + _varint(level)
        return EVENTS, record.index, payload + _text(3, record.text) + _text(4, record.kind)
    assert isinstance(record, Point)
    values = [float(record.step), float(WAYS.get(record.direction, 0)), record.frequency_hz]
    for side in (record.measured, record.twin):
        values += [getattr(side, name, float("nan")) for name in RATIOS]
    columns = {name: np.array([value]) for name, value in zip(POINT, values, strict=True)}
    plan = [(name, "double") for name in POINT]
    return CURVES, record.index, _packed(np.array([record.index]), rate_hz, columns, plan)[0]


def _time(index: int, rate_hz: float) -> bytes:
    """Field 1, a Timestamp of a fixed width, of sample `index`."""
    seconds, nanos = divmod(round(index * 1e9 / rate_hz), 10**9)
    inner = b"\x08" + _varint(seconds, 5) + b"\x10" + _varint(nanos, 5)
    return _varint(1 << 3 | WIRE_BYTES) + _varint(len(inner)) + inner


def _text(number: int, text: str) -> bytes:
    data = text.encode()
    return _varint(number << 3 | WIRE_BYTES) + _varint(len(data)) + data


def _varint(value: int, width: int = 1) -> bytes:
    """Protobuf's varint in `width` bytes or more: zeros above it are allowed, and keep a width."""
    out = bytearray()
    while value > 0x7F or len(out) < width - 1:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def layout(rows: Rows) -> str:
    """A Foxglove layout, JSON: measured against twin for each channel, the curves, the events."""
    panels: dict[str, Any] = {}
    for name in rows.units:
        twins = [f"{TWIN}{track}_{name}" for track in ("window", "free")]
        twins = [twin for twin in twins if twin in rows.units]
        if twins and len(panels) < MOST_PLOTS:
            values = [(f"{MEASURED}.{name}", "measured")]
            values += [(f"{PREDICTED}.{twin}", twin.split("_")[1]) for twin in twins]
            panels[f"Plot!{name}"] = _plot(f"{name} [{rows.units[name]}]", values)
    if not panels:
        first = next(name for name in rows.units if name not in (TIME, *LABELS))
        panels[f"Plot!{first}"] = _plot(first, [(f"{MEASURED}.{first}", "measured")])
    curves = [(f"{CURVES}.eta_d", "measured"), (f"{CURVES}.{TWIN}eta_d", "twin")]
    axis = {"xAxisVal": "custom", "xAxisPath": {"value": f"{CURVES}.frequency_hz", "enabled": True}}
    panels["Plot!curves"] = _plot("eta_d over frequency_hz", curves) | axis
    panels["RosOut!events"] = {"topicToRender": EVENTS, "minLogLevel": 1, "searchTerms": []}
    *plots, below, events = panels
    right = {"direction": "column", "first": below, "second": events, "splitPercentage": 60}
    whole = {"direction": "row", "first": _stack(plots), "second": right, "splitPercentage": 65}
    about = {"globalVariables": {}, "userNodes": {}, "playbackConfig": {"speed": 1}}
    return json.dumps({"configById": panels, **about, "layout": whole}, indent=1) + "\n"


def _plot(title: str, values: Sequence[tuple[str, str]]) -> dict[str, Any]:
    """A panel with lines (path, label)."""
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
            for (value, label), colour in zip(values, COLOURS, strict=False)
        ],
        "xAxisVal": "timestamp",
        "isSynced": True,
        "followingViewWidth": FOLLOWING_S,
        "showXAxisLabels": True,
        "showYAxisLabels": True,
        "showLegend": True,
        "legendDisplay": "floating",
        "showPlotValuesInLegend": False,
        "sidebarDimension": 240,
    }


def _stack(panels: Sequence[str]) -> Any:
    """Panels one above the other, equally high."""
    if len(panels) == 1:
        return panels[0]
    share = 100 / len(panels)
    rest = _stack(panels[1:])
    return {"direction": "column", "first": panels[0], "second": rest, "splitPercentage": share}
