"""Blocks from many payloads at once: what `wire.decode` makes of each, some ten times as fast.

The blocks of a run differ in their numbers only, so their payloads have one layout: it is parsed
once, and the numbers of all are cut out together. Where a payload has another layout, `wire.decode`
takes it alone; every first payload of a layout passes through it too.
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from table_io.block import Block, Int1D
from twin.stream.wire import LAST_INDEX, Item, WireError, decode

Bytes2D = npt.NDArray[np.uint8]  # (payload, byte)
BATCH = 256  # payloads at once: what has to be thrown away where one differs stays small
VARINT, DOUBLE, TEXT = 0, 1, 2  # wire types of protobuf; TEXT is anything with a length
INDEX, CHANNEL, STEP, LABEL, CYCLE = 3, 5, 6, 7, 8  # fields of a Block in shaketwin.proto
LONGEST_VARINT = 8  # bytes, of those that are read here


class _Layout(NamedTuple):
    """(first, end) of the bytes that hold numbers."""

    start: tuple[int, int]  # the index
    values: list[tuple[int, int]]  # of each channel
    labels: list[tuple[int, int]]  # step, label, cycle


def decode_blocks(topic: str, payloads: Sequence[bytes]) -> Iterator[tuple[str, Item] | WireError]:
    """(run, block) of each payload, or why it is none."""
    at = 0
    while at < len(payloads):
        first = payloads[at]
        try:
            run, item = decode(topic, first)
        except WireError as error:
            yield error
            at += 1
            continue
        batch = payloads[at : at + BATCH]
        sizes = np.array([len(one) for one in batch]) == len(first)
        alike = batch if sizes.all() else batch[: int(sizes.argmin())]
        together = _together(item, alike) if isinstance(item, Block) else []
        yield from ((run, block) for block in together)
        if not together:
            yield run, item
        at += len(together) or 1


def _together(like: Block, payloads: Sequence[bytes]) -> list[Block]:
    """The blocks of as many payloads as have the layout of the first; none where that is odd."""
    layout = _layout(payloads[0])
    if layout is None or len(payloads) == 1:
        return []
    rows = np.frombuffer(b"".join(payloads), np.uint8).reshape(len(payloads), -1)
    fixed = np.ones(rows.shape[1], dtype=bool)
    for first, end in (layout.start, *layout.values, *layout.labels):
        fixed[first:end] = False
    same = (rows[:, fixed] == rows[0, fixed]).all(axis=1)
    rows = rows[: len(same) if same.all() else int(same.argmin())]
    index = _varints(rows[:, slice(*layout.start)], 1)
    labels = [_varints(rows[:, slice(*span)], len(like)) for span in layout.labels]
    if index is None or index.max() > LAST_INDEX - len(like):
        return []
    signed = [(one >> 1) ^ -(one & 1) for one in labels if one is not None]  # zigzag
    if len(signed) < 3:
        return []
    values = np.empty((len(layout.values), len(rows) * len(like)))
    for channel, span in zip(values, layout.values, strict=True):
        channel[:] = rows[:, slice(*span)].copy().view("<f8").ravel()
    blocks = []
    for number, begin in enumerate(index.tolist()):
        cut = slice(number * len(like), (number + 1) * len(like))
        step, label, cycle = (one[cut] for one in signed)
        blocks.append(
            Block(
                like.stream, begin, like.rate_hz, like.channels, values[:, cut], step, label, cycle
            )
        )
    return blocks


def _layout(payload: bytes) -> _Layout | None:
    """Where the numbers stand in a payload that `wire.encode` made; None in another's."""
    fields = _fields(payload, 0, len(payload))
    numbers = [number for number, _, _, _ in fields]
    if numbers != [n for n in range(1, 9) for _ in range(numbers.count(n) if n == CHANNEL else 1)]:
        return None
    spans: dict[int, list[tuple[int, int]]] = {}
    for number, kind, first, end in fields:
        if number == CHANNEL:
            inner = _fields(payload, first, end)
            if [(one[0], one[1]) for one in inner] != [(1, TEXT), (2, TEXT)]:
                return None
            first, end = inner[1][2:]  # noqa: PLW2901
        elif kind != {INDEX: VARINT, 4: DOUBLE}.get(number, TEXT):
            return None
        spans.setdefault(number, []).append((first, end))
    if CHANNEL not in spans:
        return None
    return _Layout(spans[INDEX][0], spans[CHANNEL], [spans[n][0] for n in (STEP, LABEL, CYCLE)])


def _fields(payload: bytes, at: int, end: int) -> list[tuple[int, int, int, int]]:
    """(field, wire type, first byte, end) of a message; nothing of one that is odd."""
    found = []
    while at < end:
        tag, at = payload[at], at + 1
        kind, first = tag & 7, at
        if tag > 127 or kind > TEXT:
            return []
        if kind == DOUBLE:
            at += 8
        else:
            number = shift = 0
            while at < end and payload[at] > 127:
                number, shift, at = number | (payload[at] & 127) << shift, shift + 7, at + 1
            if at == end or shift > 56:
                return []
            number, at = number | payload[at] << shift, at + 1
            if kind == TEXT:
                first, at = at, at + number
        if at > end:
            return []
        found.append((tag >> 3, kind, first, at))
    return found


def _varints(rows: Bytes2D, count: int) -> Int1D | None:
    """The `count` numbers in each row, one after another; None where there are not as many."""
    ends = rows < 128
    if rows.shape[1] == 0 or not ends[:, -1].all() or (ends.sum(axis=1) != count).any():
        return None
    if rows.shape[1] == count:
        return rows.astype(np.int64).ravel()
    flat: npt.NDArray[Any] = rows.ravel()
    starts = np.concatenate([[0], np.flatnonzero(ends)[:-1] + 1])
    lengths = np.diff(starts, append=flat.size)
    if lengths.max() > LONGEST_VARINT:
        return None
    place = np.arange(flat.size) - np.repeat(starts, lengths)
    return np.add.reduceat((flat & 127).astype(np.int64) << (7 * place), starts)
