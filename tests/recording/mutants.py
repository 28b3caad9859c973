"""Files that nobody should ever be given: recordings and tables, damaged by chance or on purpose.

Every mutant follows from a whole log, a table and a number, so that any of them can be made again.
"""

import random
import struct
from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from types import UnionType
from typing import Any, get_origin, get_type_hints

import numpy as np
import zstandard

from table_io.block import Block
from table_io.records import RunStart
from twin.recording.mcap_log import LogWriter
from twin.recording.recovery import CHUNK, MAGIC, RECORD_HEADER
from twin.transport.codec import Item, encode_item, topic_for

LOG_SAMPLES = 3000  # of the log that is damaged: enough for chunks, few enough for thousands
FLUSH_MESSAGES = 20  # messages
NUMBERS = (0.0, -0.0, 1e-320, -1e308, 1e308, float("nan"), float("inf"), float("-inf"), 0.1)
WHOLES = (0, 1, 2, 63, 64, 127, 128, 2**31 - 1, 2**31, 2**53, 2**63 - 1)
TEXTS = (
    "",
    "\0",
    "[",
    "title = 1",
    "nan",
    "-1",
    "\u202e",
    "x" * 10_000,
    "[a]\n" * 500,
    "a = " + "[" * 5000,
)
Log = list[tuple[str, bytes, int]]  # topic, payload, sample index


def whole(path: Path, items: list[Item], start: RunStart) -> Path:
    """A log of many small chunks."""
    messages = [(topic_for(item), encode_item(item, start.run), item.index) for item in items]
    return write_messages(path, messages, start)


def write_messages(path: Path, messages: Log, start: RunStart) -> Path:
    """A log with these messages, whatever they are, and every checksum right."""
    writer = LogWriter(path, 2000.0)
    writer.write_run_description(start)
    for number, (name, payload, index) in enumerate(messages, 1):
        writer.write(name, payload, index)
        if number % FLUSH_MESSAGES == 0:
            writer.flush()
    writer.close()
    return path


def spans(content: bytes) -> list[tuple[int, int, int]]:
    """(opcode, first byte, the byte after it) of each record of a whole file."""
    records, at = [], len(MAGIC)
    while at + RECORD_HEADER.size <= len(content) - len(MAGIC):
        opcode, length = RECORD_HEADER.unpack_from(content, at)
        records.append((opcode, at, at + RECORD_HEADER.size + length))
        at += RECORD_HEADER.size + length
    return records


def damage(content: bytes, chance: random.Random) -> bytes:
    """The bytes of a file after an accident or two."""
    for _ in range(chance.choice((1, 1, 1, 2, 5))):
        content = chance.choice(ACCIDENTS)(content, chance)
    return content


def _place(content: bytes, chance: random.Random) -> tuple[int, int]:
    first = chance.randrange(len(content) + 1)
    return first, min(len(content), first + int(2 ** chance.uniform(0, 17)))


def _flip(content: bytes, chance: random.Random) -> bytes:
    changed = bytearray(content)
    for _ in range(chance.choice((1, 1, 8, 200)) if content else 0):
        changed[chance.randrange(len(changed))] ^= 1 << chance.randrange(8)
    return bytes(changed)


def _fill(content: bytes, chance: random.Random) -> bytes:
    first, end = _place(content, chance)
    filled = {0: bytes(end - first), 1: b"\xff" * (end - first)}
    return (
        content[:first]
        + filled.get(chance.randrange(3), chance.randbytes(end - first))
        + content[end:]
    )


def _insert(content: bytes, chance: random.Random) -> bytes:
    first, end = _place(content, chance)
    inner = chance.choice((chance.randbytes(end - first), content[first:end], MAGIC, b"\x06" * 99))
    return content[:first] + inner + content[first:]


def _cut(content: bytes, chance: random.Random) -> bytes:
    first, end = _place(content, chance)
    return chance.choice((content[:first], content[first:], content[:first] + content[end:]))


def _reorder(content: bytes, chance: random.Random) -> bytes:
    """Records swapped, twice there, or gone."""
    records = (
        [content[first:end] for _, first, end in spans(content)] if content[:8] == MAGIC else []
    )
    if len(records) < 3 or len(records) > 10_000:
        return content
    for _ in range(chance.choice((1, 1, 3, 50))):
        a, b = chance.randrange(len(records)), chance.randrange(len(records))
        kind = chance.randrange(4)
        if kind == 0:
            records[a], records[b] = records[b], records[a]
        elif kind == 1:
            records.insert(a, records[b])
        elif kind == 2 and len(records) > 2:
            del records[a]
        elif kind == 3:
            chance.shuffle(records)
    return MAGIC + b"".join(records) + chance.choice((MAGIC, b""))


def _reframe(content: bytes, chance: random.Random) -> bytes:
    """A record that says it is longer, shorter, or another."""
    places = spans(content) if content[:8] == MAGIC else []
    if not places:
        return content
    changed = bytearray(content)
    for _ in range(chance.choice((1, 1, 5))):
        opcode, first, end = chance.choice(places)
        sizes = (0, 1, 2**16, 2**31, 2**40, 2**63, 2**64 - 1, len(content), end - first, 8)
        if chance.random() < 0.3:
            changed[first] = chance.randrange(256)
        elif chance.random() < 0.5:
            struct.pack_into("<Q", changed, first + 1, chance.choice(sizes))
        elif opcode == CHUNK:
            struct.pack_into("<Q", changed, first + 9 + 16, chance.choice(sizes))
        elif end - first > 24:
            struct.pack_into(
                "<I", changed, first + 9 + chance.randrange(8), chance.randrange(2**32)
            )
    return bytes(changed)


ACCIDENTS: tuple[Callable[[bytes, random.Random], bytes], ...] = (
    _flip, _fill, _insert, _cut, _cut, _reorder, _reorder, _reframe, _reframe,
)  # fmt: skip


def lied(messages: Log, items: list[Item], run: str, chance: random.Random) -> Log:
    """Messages of which some say what cannot be; the file around them is sound."""
    messages = list(messages)
    for _ in range(chance.choice((1, 1, 3, 30))):
        at = 0 if chance.random() < 0.3 else chance.randrange(len(messages))
        name, payload, index = messages[at]
        kind = chance.randrange(6)
        if kind == 0:
            messages[at] = name, damage(payload, chance), index
        elif kind == 1:
            messages[at] = chance.choice(messages)[0], payload, index
        elif kind == 2:
            messages[at] = name, payload + chance.choice(messages)[1][:200], index
        else:
            try:
                messages[at] = name, encode_item(strange(items[at], chance), run), index
            except (ValueError, TypeError, OverflowError):
                continue  # a lie that protobuf cannot hold
    return messages


def strange(item: Any, chance: random.Random) -> Any:
    """A record with one field that it cannot have; a block with samples, labels or places so."""
    if isinstance(item, Block):
        return _strange_block(item, chance)
    field = chance.choice(fields(item))
    hint = get_type_hints(type(item))[field.name]
    value = getattr(item, field.name)
    return replace(item, **{field.name: _strange(value, hint, chance)})


def _strange(value: Any, hint: Any, chance: random.Random) -> Any:
    if isinstance(value, bool):
        return not value
    if isinstance(value, int):
        return chance.choice(WHOLES)
    if isinstance(value, float):
        return chance.choice(NUMBERS)
    if isinstance(value, str):
        return _misspelt(value, chance)
    if isinstance(value, tuple):
        many = chance.choice((value[:1], value[1:], value * 2, value[::-1], ()))
        inner = value[0] if value else None
        if inner is None or chance.random() < 0.5:
            return many
        changed = strange(inner, chance) if is_dataclass(inner) else _strange(inner, None, chance)
        return (changed, *value[1:])
    if isinstance(value, dict):
        return {_misspelt(key, chance): chance.choice(list(value.values())) for key in value}
    if is_dataclass(value):
        return None if get_origin(hint) is UnionType else strange(value, chance)
    return value


def _misspelt(text: str, chance: random.Random) -> str:
    """A text with a line gone or twice, a number or a letter that is another."""
    lines = text.splitlines()
    kind = chance.randrange(5)
    if not lines or kind == 0:
        return chance.choice(TEXTS)
    at = chance.randrange(len(lines))
    if kind == 1:
        del lines[at]
    elif kind == 2:
        lines.insert(at, chance.choice(lines))
    elif kind == 3 and "=" in lines[at]:
        values = ("-1", "0", "1e308", "nan", "inf", "1e-300", "[]", '"x"', "9" * 30, "true", "1e9")
        lines[at] = f"{lines[at].split('=')[0]}= {chance.choice(values)}"
    else:
        place = chance.randrange(len(lines[at]) + 1)
        lines[at] = lines[at][:place] + chr(chance.randrange(1, 0x300)) + lines[at][place + 1 :]
    return "\n".join(lines)


def _strange_block(block: Block, chance: random.Random) -> Block:
    values, labels = block.values.copy(), np.array([block.step, block.label, block.cycle])
    index, rate, channels = block.index, block.rate_hz, block.channels
    kind = chance.randrange(6)
    if kind == 0:
        values[chance.randrange(len(values))] = chance.choice(NUMBERS)
    elif kind == 1:
        labels[chance.randrange(3)] = chance.choice((-1, 0, 5, 6, 99, 2**31, -(2**62), 2**62))
    elif kind == 2:
        index = chance.choice((*WHOLES[:-1], index + 1, index + 10**6, 10**9, 10**12))
    elif kind == 3:
        rate = chance.choice(NUMBERS)
    elif kind == 4:
        channels = (channels[0], *channels[:-1])
    else:
        keep = chance.choice((0, 1, len(block) - 1))
        values, labels = values[:, :keep], labels[:, :keep]
    return Block(block.stream, index, rate, channels, values, *labels)


def bomb(kind: int) -> bytes:
    """A small file that says it is a big one, or unpacks to it."""
    return MAGIC + RECORD_HEADER.pack(1, 8) + bytes(8) + BOMBS[kind % len(BOMBS)]()


def _zeros(mega: int) -> bytes:
    return zstandard.compress(bytes(mega * 2**20))


def _empty_messages(count: int) -> bytes:
    empty = struct.pack("<HIQQ", 1, 0, 0, 0)
    return zstandard.compress((RECORD_HEADER.pack(5, len(empty)) + empty) * count)


BOMBS: tuple[Callable[[], bytes], ...] = (
    lambda: _chunk(_zeros(60), 60 * 2**20) * 300,
    lambda: _chunk(_zeros(300), 2**20) * 10,
    lambda: _chunk(_empty_messages(1_500_000), 31 * 1_500_000) * 60,
    lambda: RECORD_HEADER.pack(6, 2**62) * 20_000,
    lambda: RECORD_HEADER.pack(CHUNK, 2**17) * 20_000,
    lambda: RECORD_HEADER.pack(12, 8) * 20_000,
    lambda: _chunk(_zeros(60)[:-100], 60 * 2**20) * 200,
    lambda: _chunk(b"", 2**64 - 1) * 1000,
    lambda: _chunk(_zeros(256), 256 * 2**20),
)


def _chunk(packed: bytes, size: int) -> bytes:
    content = struct.pack("<QQQI", 0, 0, size, 0) + struct.pack("<I", 4) + b"zstd"
    content += struct.pack("<Q", len(packed)) + packed
    return RECORD_HEADER.pack(CHUNK, len(content)) + content


def scrawl(table: bytes, chance: random.Random) -> bytes:
    """A table as a tired hand leaves it."""
    lines = table.split(b"\n")
    words = (b"inf", b"1e999", b"-", b"1,5", b'"', b"0x10", b"\xff\xfe", b"9" * 99)
    harsh = chance.random() < 0.4
    for _ in range(chance.choice((1, 1, 4, 40))):
        at = chance.choice((0, 1, chance.randrange(len(lines))))
        at = at if harsh else chance.randrange(1, len(lines))
        cells = lines[at].split(b",")
        mild = (b"", b"nan", b"0", b"-1e300", cells[0], cells[-1] + b"0", b" 1e-300 ")
        cells[chance.randrange(len(cells))] = chance.choice(words if harsh else mild)
        if not harsh:
            lines[at] = b",".join(cells)
            continue
        lines[at] = chance.choice((b",", b",", b";", b"\t", b",,")).join(cells)
        if chance.random() < 0.2:
            lines.insert(chance.randrange(len(lines)), chance.choice((lines[at], b"", b"\0", b"x")))
        if chance.random() < 0.1:
            del lines[chance.randrange(1, len(lines))]
    torn = chance.random() < 0.1
    return damage(b"\n".join(lines), chance) if torn else b"\n".join(lines)
