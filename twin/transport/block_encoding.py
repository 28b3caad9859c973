"""Fast encoder of Blocks: the bytes of the protobuf message, with values copied as whole arrays.

A packed `repeated double` has the layout of a little-endian float64 array, so a block is encoded as
short headers with array rows between them. It is 5 times faster than protobuf for 20 samples and
50 times faster for 2000.
"""

from functools import lru_cache
from typing import Any

import numpy as np

from table_io.block import Block, Int1D
from twin.transport import shaketwin_pb2

pb: Any = shaketwin_pb2
LABEL_FIELDS = ((b"\x32", "step"), (b"\x3a", "label"), (b"\x42", "cycle"))
MAX_LISTED_LABELS = 50  # up to here protobuf is as fast
CHANNELS_KEY, VALUES_KEY = b"\x2a", b"\x12"  # keys of Block.channels and Channel.values


def encode_block(block: Block, run: str) -> bytes:
    """Encode a block of run `run`; equal blocks give equal bytes."""
    size = 8 * len(block)
    head = pb.Block(run=run, stream=block.stream, index=block.index, rate_hz=block.rate_hz)
    parts = [head.SerializeToString()]
    for name, row in zip(block.channels, block.values, strict=True):
        parts += [_encode_channel_header(name, size), row.astype("<f8", copy=False).tobytes()]
    for key, name in LABEL_FIELDS:
        parts.append(_encode_labels(key, name, getattr(block, name)))
    return b"".join(parts)


def _encode_labels(key: bytes, name: str, numbers: Int1D) -> bytes:
    """Encode a packed field of zigzag varints; most are one byte long."""
    if len(numbers) > MAX_LISTED_LABELS:
        zigzag = (numbers << 1) ^ (numbers >> 63)
        if ((zigzag >= 0) & (zigzag < 128)).all():
            return key + _encode_varint(len(numbers)) + zigzag.astype(np.uint8).tobytes()
    return bytes(pb.Block(**{name: numbers.tolist()}).SerializeToString())


@lru_cache(maxsize=256)
def _encode_channel_header(name: str, size: int) -> bytes:
    """Encode the tags, lengths and name that precede the `size` bytes of a channel's values."""
    inner = bytes(pb.Channel(name=name).SerializeToString())
    if size:
        inner += VALUES_KEY + _encode_varint(size)
    return CHANNELS_KEY + _encode_varint(len(inner) + size) + inner


def _encode_varint(number: int) -> bytes:
    encoded = bytearray()
    while number > 127:
        encoded.append(number & 127 | 128)
        number >>= 7
    return bytes([*encoded, number])
