"""What a publisher holds of what it has sent, in numbered pieces, for those who ask again."""

import struct
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import islice
from typing import Any, NamedTuple

from table_io.clock import RealClock

LARGEST_BYTES = 4 * 2**20  # of one payload
HELD_PIECES = 5000  # per topic and publisher: 50 s of blocks, 100 of them a second
HELD_BYTES = 64 * 2**20
PIECE_BYTES = 48 * 2**10  # of one message on the bus: less than a batch of zenoh, 64 kB
ANSWERED_PIECES = 1000  # at most, at a time: what tells their sizes has to fit beside them
ASKERS = 256  # of whom a publisher keeps in mind how far they have come
GIVE_UP_S = 10.0  # zenoh's lease: then a silent publisher counts as dead
STAMP = struct.Struct("<8sQB")  # publisher, number of the piece within its topic, its place
BEGINS, ENDS = 1, 2  # the place of a piece in its payload
CLOCK = RealClock()


class Piece(NamedTuple):
    """A part of a payload, numbered by its publisher within the topic."""

    topic: str
    source: str  # the publisher's name, hexadecimal
    number: int
    place: int
    body: bytes

    @property
    def stamp(self) -> bytes:
        """What travels with it."""
        return STAMP.pack(bytes.fromhex(self.source), self.number, self.place)


def pieces(topic: str, source: str, number: int, payload: bytes) -> Iterator[Piece]:
    """A payload in pieces of at most `PIECE_BYTES`, numbered from `number` on."""
    for at in range(0, max(len(payload), 1), PIECE_BYTES):
        place = BEGINS * (at == 0) | ENDS * (at + PIECE_BYTES >= len(payload))
        yield Piece(topic, source, number, place, payload[at : at + PIECE_BYTES])
        number += 1


class Shelf:
    """The newest pieces of a topic and publisher; they are numbered `first` to `end` - 1."""

    def __init__(self) -> None:
        self.end = 0
        self._held: deque[tuple[int, bytes]] = deque()
        self._bytes = 0

    @property
    def first(self) -> int:
        return self.end - len(self._held)

    def add(self, number: int, place: int, piece: bytes) -> None:
        """Hold one more; the oldest give way, and all of them where one between is missing."""
        while self._held and (
            number != self.end or len(self._held) >= HELD_PIECES or self._bytes > HELD_BYTES
        ):
            self._bytes -= len(self._held.popleft()[1])
        self._held.append((place, piece))
        self._bytes += len(piece)
        self.end = number + 1

    def take(self, first: int, room: int) -> list[tuple[int, bytes]]:
        """(place, piece) from number `first` on, as many as fit into `room` bytes."""
        taken = []
        for place, piece in islice(
            self._held, first - self.first, first - self.first + ANSWERED_PIECES
        ):
            room -= len(piece)
            if room < 0:
                break
            taken.append((place, piece))
        return taken


Shelves = dict[tuple[str, str], Shelf]  # by topic and publisher
Asked = dict[str, dict[str, int]]  # number of the next piece, by topic and publisher


def answer(shelves: Shelves, asked: Asked, history: bool) -> tuple[list[Any], bytes]:
    """([topic, publisher, first, end, [(place, size)]] of each, pieces in a row): a chunk of it."""
    said: list[Any] = []
    chunk: list[bytes] = []
    room = PIECE_BYTES
    # Rare topics first, so that the start of a run comes before its blocks.
    for (topic, source), shelf in sorted(shelves.items(), key=lambda one: one[1].end):
        if topic not in asked:
            continue
        known = asked[topic].get(source)
        first = (shelf.first if history else shelf.end) if known is None else known
        first = min(max(first, shelf.first), shelf.end)
        taken = shelf.take(first, room)
        room -= sum(len(piece) for _, piece in taken)
        chunk += [piece for _, piece in taken]
        if known is None or first < shelf.end:
            said.append([topic, source, first, shelf.end, [(place, len(x)) for place, x in taken]])
    return said, b"".join(chunk)


@dataclass(slots=True)
class Listeners:
    """How far those who listen to a publisher have come, by their questions; for one who can wait.

    Of each: when it asked last, and the number of the next piece that it needs by topic and
    publisher.
    """

    heard: dict[str, tuple[float, dict[tuple[str, str], int]]] = field(default_factory=dict)

    def note(self, question: dict[str, Any], shelves: Shelves) -> None:
        """Take in a question; who does not want history begins where the shelf ends."""
        history, who = question["history"], question["who"]
        before = self.heard.pop(who, (0.0, {}))[1]
        asked = {}
        for (topic, source), shelf in shelves.items():
            if topic in question["next"]:
                begin = before.get((topic, source), 0 if history else shelf.end)
                said = question["next"][topic].get(source, begin)
                asked[topic, source] = min(max(said, shelf.first), shelf.end)  # it may lie
        while len(self.heard) >= ASKERS:
            del self.heard[next(iter(self.heard))]  # who asked longest ago
        self.heard[who] = CLOCK.now(), asked

    def behind(self, shelves: Shelves, within_s: float = GIVE_UP_S) -> int:
        """The most pieces that anybody lacks who asked within this time; 0 where nobody did."""
        since = CLOCK.now() - within_s
        return max(
            (
                shelves[where].end - next_one
                for when, asked in self.heard.values()
                if when > since
                for where, next_one in asked.items()
            ),
            default=0,
        )
