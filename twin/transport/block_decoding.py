"""Batch decoder of Block payloads: same results as `decode_item`, about ten times faster.

The blocks of a run differ only in their numbers, so their payloads share one byte layout. The
layout is parsed once and the numbers of all payloads are sliced out together. The first payload of
each layout, and any payload with another layout, is decoded by `decode_item`.
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from table_io.block import Block, Int1D
from twin.transport.codec import MAX_SAMPLE_INDEX, Item, WireError, decode_item

Bytes2D = npt.NDArray[np.uint8]  # (payload, byte)
BATCH_PAYLOADS = 256  # small, so that little work is lost when one payload of a batch differs
WIRE_VARINT, WIRE_I64, WIRE_LEN = 0, 1, 2  # protobuf wire types
INDEX_FIELD, CHANNELS_FIELD, STEP_FIELD, LABEL_FIELD, CYCLE_FIELD = (
    3,
    5,
    6,
    7,
    8,
)  # fields of a Block in shaketwin.proto
MAX_VARINT_BYTES = 8  # longest varint decoded here


class _Layout(NamedTuple):
    """Byte spans (first, end) of the numeric fields in a payload."""

    start: tuple[int, int]  # the sample index
    values: list[tuple[int, int]]  # one span per channel
    labels: list[tuple[int, int]]  # step, label, cycle


def decode_blocks(topic: str, payloads: Sequence[bytes]) -> Iterator[tuple[str, Item] | WireError]:
    """Yield (run id, item) of each payload in order, or a WireError where it does not decode."""
    position = 0
    while position < len(payloads):
        first = payloads[position]
        try:
            run, item = decode_item(topic, first)
        except WireError as error:
            yield error
            position += 1
            continue
        batch = payloads[position : position + BATCH_PAYLOADS]
        is_same_size = np.array([len(payload) for payload in batch]) == len(first)
        same_size = batch if is_same_size.all() else batch[: int(is_same_size.argmin())]
        blocks = _decode_same_layout(item, same_size) if isinstance(item, Block) else []
        yield from ((run, block) for block in blocks)
        if not blocks:
            yield run, item
        position += len(blocks) or 1


def _decode_same_layout(template: Block, payloads: Sequence[bytes]) -> list[Block]:
    """Return the blocks of the leading payloads that share the layout of the first.

    The list is empty where the layout is not that of `encode_item`.
    """
    layout = _parse_layout(payloads[0])
    if layout is None or len(payloads) == 1:
        return []
    rows = np.frombuffer(b"".join(payloads), np.uint8).reshape(len(payloads), -1)
    fixed = np.ones(rows.shape[1], dtype=bool)
    for first, end in (layout.start, *layout.values, *layout.labels):
        fixed[first:end] = False
    is_same = (rows[:, fixed] == rows[0, fixed]).all(axis=1)
    rows = rows[: len(is_same) if is_same.all() else int(is_same.argmin())]
    index = _decode_varints(rows[:, slice(*layout.start)], 1)
    labels = [_decode_varints(rows[:, slice(*span)], len(template)) for span in layout.labels]
    if index is None or index.max() > MAX_SAMPLE_INDEX - len(template):
        return []
    label_columns = [
        (labels_zigzag >> 1) ^ -(labels_zigzag & 1)
        for labels_zigzag in labels
        if labels_zigzag is not None
    ]  # zigzag
    if len(label_columns) < 3:
        return []
    values = np.empty((len(layout.values), len(rows) * len(template)))
    for channel, span in zip(values, layout.values, strict=True):
        channel[:] = rows[:, slice(*span)].copy().view("<f8").ravel()
    blocks = []
    for row, begin in enumerate(index.tolist()):
        samples = slice(row * len(template), (row + 1) * len(template))
        step, label, cycle = (column[samples] for column in label_columns)
        blocks.append(
            Block(
                template.stream,
                begin,
                template.rate_hz,
                template.channels,
                values[:, samples],
                step,
                label,
                cycle,
            )
        )
    return blocks


def _parse_layout(payload: bytes) -> _Layout | None:
    """Return the spans of the numbers in a payload of `encode_item`, None for other encoders."""
    fields = _parse_fields(payload, 0, len(payload))
    numbers = [number for number, _, _, _ in fields]
    if numbers != [
        n for n in range(1, 9) for _ in range(numbers.count(n) if n == CHANNELS_FIELD else 1)
    ]:
        return None
    spans: dict[int, list[tuple[int, int]]] = {}
    for number, wire_type, first, end in fields:
        if number == CHANNELS_FIELD:
            inner = _parse_fields(payload, first, end)
            if [(field[0], field[1]) for field in inner] != [(1, WIRE_LEN), (2, WIRE_LEN)]:
                return None
            first, end = inner[1][2:]  # noqa: PLW2901
        elif wire_type != {INDEX_FIELD: WIRE_VARINT, 4: WIRE_I64}.get(number, WIRE_LEN):
            return None
        spans.setdefault(number, []).append((first, end))
    if CHANNELS_FIELD not in spans:
        return None
    return _Layout(
        spans[INDEX_FIELD][0],
        spans[CHANNELS_FIELD],
        [spans[n][0] for n in (STEP_FIELD, LABEL_FIELD, CYCLE_FIELD)],
    )


def _parse_fields(payload: bytes, offset: int, end: int) -> list[tuple[int, int, int, int]]:
    """Return (field number, wire type, first byte, end) of each field; empty if malformed."""
    fields = []
    while offset < end:
        tag, offset = payload[offset], offset + 1
        wire_type, first = tag & 7, offset
        if tag > 127 or wire_type > WIRE_LEN:
            return []
        if wire_type == WIRE_I64:
            offset += 8
        else:
            value = shift = 0
            while offset < end and payload[offset] > 127:
                value, shift, offset = (
                    value | (payload[offset] & 127) << shift,
                    shift + 7,
                    offset + 1,
                )
            if offset == end or shift > 56:
                return []
            value, offset = value | payload[offset] << shift, offset + 1
            if wire_type == WIRE_LEN:
                first, offset = offset, offset + value
        if offset > end:
            return []
        fields.append((tag >> 3, wire_type, first, offset))
    return fields


def _decode_varints(rows: Bytes2D, count: int) -> Int1D | None:
    """Return the varints of all rows, (row * count,); None unless each row has `count` of them."""
    ends = rows < 128
    if rows.shape[1] == 0 or not ends[:, -1].all() or (ends.sum(axis=1) != count).any():
        return None
    if rows.shape[1] == count:
        return rows.astype(np.int64).ravel()
    flat: npt.NDArray[Any] = rows.ravel()
    starts = np.concatenate([[0], np.flatnonzero(ends)[:-1] + 1])
    lengths = np.diff(starts, append=flat.size)
    if lengths.max() > MAX_VARINT_BYTES:
        return None
    byte_position = np.arange(flat.size) - np.repeat(starts, lengths)
    return np.add.reduceat((flat & 127).astype(np.int64) << (7 * byte_position), starts)
