"""What makes the link lossless: numbered pieces, held by whoever sent them, asked for again.

Every publisher numbers its pieces and holds the newest of each topic on a `Shelf`. An `Inbox` that
finds one missing asks for the rest, a chunk at a time, and takes nothing newer until it has it.
"""

import json
import secrets
import struct
import threading
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import islice
from typing import Any, Protocol

from table_io.clock import RealClock

LARGEST_BYTES = 4 * 2**20  # of one payload
HELD_PIECES = 5000  # per topic and publisher: 50 s of blocks
HELD_BYTES = 64 * 2**20
PIECE_BYTES = 48 * 2**10  # of one message on the bus: less than a batch of zenoh, 64 kB
ASK_EVERY_S = 0.5  # in case the last message of a topic was lost
ASK_AGAIN_S = 0.2  # in case question or answer was lost
ASK_MORE_S = 0.002
GIVE_UP_S = 10.0  # zenoh's lease: then a silent publisher counts as dead
TURN_S = 0.02  # while waiting, others are answered this often
STAMP = struct.Struct("<8sQB")  # publisher, number of the piece within its topic, its place
BEGINS, ENDS = 1, 2  # the place of a piece in its payload
CLOCK = RealClock()


class Asker(Protocol):
    """What an inbox needs of its link."""

    def serve(self) -> None:
        """Answer somebody else's question, if there is one."""

    def ask(self, question: dict[str, Any], inbox: "Inbox") -> None:
        """Put a question to all publishers; answers arrive in the inbox."""


class Shelf:
    """The newest pieces published on a topic; they are numbered `first` to `end` - 1."""

    def __init__(self, publisher: Any) -> None:
        self.publisher = publisher
        self.end = 0
        self._held: deque[tuple[int, bytes]] = deque()
        self._bytes = 0

    @property
    def first(self) -> int:
        return self.end - len(self._held)

    def add(self, place: int, piece: bytes) -> None:
        """Hold one more; the oldest give way."""
        self._held.append((place, piece))
        self._bytes += len(piece)
        self.end += 1
        while len(self._held) > HELD_PIECES or self._bytes > HELD_BYTES:
            self._bytes -= len(self._held.popleft()[1])

    def take(self, first: int, room: int) -> list[tuple[int, bytes]]:
        """(place, piece) from number `first` on, as many as fit into `room` bytes."""
        taken = []
        for place, piece in islice(self._held, first - self.first, None):
            room -= len(piece)
            if room < 0:
                break
            taken.append((place, piece))
        return taken


@dataclass(slots=True)
class Listeners:
    """How far those who listen to a publisher have come, by their questions; for one who can wait.

    Of each: when it asked last, and the number of the next piece that it needs by topic.
    """

    name: str  # the publisher's
    heard: dict[str, tuple[float, dict[str, int]]] = field(default_factory=dict)

    def note(self, question: dict[str, Any], shelves: Mapping[str, Shelf]) -> None:
        """Take in a question; who does not want history begins where the shelf ends."""
        begin = {topic: 0 if question["history"] else shelves[topic].end for topic in shelves}
        before = self.heard.get(str(question.get("who")), (0.0, begin))[1]
        asked = {
            topic: int(known.get(self.name, before.get(topic, 0)))
            for topic, known in question["next"].items()
            if topic in shelves
        }
        now = CLOCK.now()
        self.heard = {who: one for who, one in self.heard.items() if now - one[0] < GIVE_UP_S}
        self.heard[str(question.get("who"))] = now, asked

    def behind(self, shelves: Mapping[str, Shelf]) -> int:
        """The most pieces that anybody lacks who asked within `GIVE_UP_S`; 0 where nobody did."""
        since = CLOCK.now() - GIVE_UP_S
        return max(
            (
                shelves[topic].end - next_one
                for when, asked in self.heard.values()
                if when > since
                for topic, next_one in asked.items()
            ),
            default=0,
        )


@dataclass(slots=True)
class Source:
    """How far an inbox has come with one topic of one publisher; `next` is None before it began."""

    next: int | None
    seen: int = 0
    behind_since: float | None = None
    pieces: list[bytes] | None = None  # of a payload whose end has not come yet

    def advance(self, number: int) -> int:
        """Go on at `number`; the count of pieces left out."""
        left_out = 0 if self.next is None else max(0, number - self.next)
        if left_out:
            self.pieces = None
        self.next = number if self.next is None else max(number, self.next)
        return left_out

    def accept(self, place: int, piece: bytes) -> bytes | None:
        """Take the piece numbered `next`; the whole payload if this ends it."""
        assert self.next is not None
        self.next += 1
        if place & BEGINS:
            self.pieces = []
        if self.pieces is None or len(self.pieces) * PIECE_BYTES > LARGEST_BYTES:
            return None
        self.pieces.append(piece)
        return b"".join(self.pieces) if place & ENDS else None


class Inbox:
    """Payloads in order per topic and publisher; `subscribe` makes it, one thread reads it.

    `missed` pieces were gone before they could be asked for again, `dropped` ones were pushed out
    by newer ones because nobody fetched them, `ignored` ones not ours.
    """

    def __init__(self, link: Asker, topics: tuple[str, ...], history: bool, capacity: int) -> None:
        self.missed = 0
        self.dropped = 0
        self.ignored = 0
        self._link = link
        self._topics = topics
        self._history = history
        self._capacity = capacity
        self._arrived: deque[tuple[str, bytes, bytes]] = deque()  # topic "" = an answer
        self._filled = threading.Condition()
        self._skipped: dict[tuple[str, str], int] = {}
        self._ready: deque[tuple[str, bytes]] = deque()
        self._sources: dict[tuple[str, str], Source] = {}
        self._who = secrets.token_hex(8)
        self._asked_at = float("-inf")
        self._answered = False

    def get(self, timeout_s: float) -> tuple[str, bytes] | None:
        """The next (topic, payload); None when there is none within `timeout_s`."""
        deadline = CLOCK.now() + timeout_s
        while not self._ready:
            self._link.serve()
            now = CLOCK.now()
            self._ask_if_due(now)
            with self._filled:
                if not self._arrived and now < deadline:
                    self._filled.wait(min(TURN_S, deadline - now))
                entry = self._arrived.popleft() if self._arrived else None
            if entry is not None:
                self._sort(*entry)
            elif now >= deadline:
                return None
        return self._ready.popleft()

    def arrive(self, topic: str, stamp: Any, body: Any) -> None:
        """Take what zenoh's thread brings; a copy and no more, since that thread feeds the rest."""
        if stamp is None or len(body) > PIECE_BYTES or (topic and len(stamp) != STAMP.size):
            self.ignored += 1
            return
        entry = (topic, stamp.to_bytes(), body.to_bytes())
        with self._filled:
            if len(self._arrived) >= self._capacity:
                self._drop(*self._arrived.popleft())
            self._arrived.append(entry)
            self._filled.notify()

    def _drop(self, topic: str, stamp: bytes, _: bytes) -> None:
        # With history it is only put off: the gap it leaves is asked for when there is time.
        if topic and not self._history:
            name, number, _place = STAMP.unpack(stamp)
            self._skipped[topic, name.hex()] = number + 1
            self.dropped += 1

    def _sort(self, topic: str, stamp: bytes, body: bytes) -> None:
        """Move what arrived to `_ready` if it is next in order; else note that we are behind."""
        if not topic:
            self._take(stamp, body)
            return
        name, number, place = STAMP.unpack(stamp)
        where = (topic, name.hex())
        source = self._sources.setdefault(where, Source(0 if number == 0 else None))
        if source.next is None and not self._history:
            source.advance(number)
        if where in self._skipped:
            source.advance(self._skipped.pop(where))
        source.seen = max(source.seen, number)
        if number == source.next:
            self._accept(topic, source, place, body)
        elif (source.next is None or number > source.next) and source.behind_since is None:
            source.behind_since = CLOCK.now()

    def _take(self, stamp: bytes, body: bytes) -> None:
        """Move the pieces of an answer to `_ready`; count those that their publisher lacks."""
        self._answered = True
        header = json.loads(stamp)
        at = 0
        for topic, (first, end, sizes) in header["topics"].items():
            source = self._sources.setdefault((topic, header["source"]), Source(None))
            self.missed += source.advance(first)
            for number, (place, size) in enumerate(sizes, first):
                if number == source.next:
                    self._accept(topic, source, place, body[at : at + size])
                at += size
            source.behind_since = CLOCK.now() if (source.next or 0) < end else None

    def _accept(self, topic: str, source: Source, place: int, piece: bytes) -> None:
        whole = source.accept(place, piece)
        if whole is not None:
            self._ready.append((topic, whole))

    def _ask_if_due(self, now: float) -> None:
        """Ask for what is missing, and now and then for what may be."""
        behind = [one for one in self._sources.values() if one.behind_since is not None]
        for source in behind:
            if now - (source.behind_since or now) > GIVE_UP_S:
                self.missed += source.advance(source.seen + 1)
                source.behind_since = None
        pause = ASK_EVERY_S if not behind else ASK_MORE_S if self._answered else ASK_AGAIN_S
        if now - self._asked_at >= pause:
            self._asked_at, self._answered = now, False
            known: dict[str, dict[str, int]] = {topic: {} for topic in self._topics}
            for (topic, name), one in self._sources.items():
                if one.next is not None:
                    known[topic][name] = one.next
            self._link.ask({"who": self._who, "history": self._history, "next": known}, self)
