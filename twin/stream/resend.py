"""What makes the link lossless: numbered pieces, held by whoever sent them, asked for again.

Every publisher numbers its pieces and holds the newest of each topic on a `Shelf`. An `Inbox` that
finds one missing asks for the rest, a chunk at a time, and takes nothing newer until it has it.
Who passes pieces on keeps name and numbers of their publisher, and holds them as well: so whoever
listens may get a piece from either, and takes it once.
"""

import secrets
import threading
from collections import deque
from dataclasses import dataclass
from typing import Any, Protocol

from table_io.clock import RealClock
from twin.stream.questions import understood
from twin.stream.shelf import BEGINS, ENDS, GIVE_UP_S, LARGEST_BYTES, PIECE_BYTES, STAMP, Piece

ASK_EVERY_S = 0.5  # in case the last message of a topic was lost
ASK_AGAIN_S = 0.1  # in case question or answer was lost
ASK_MORE_S = 0.003
LAST_NUMBER = 2**63  # of a piece
MOST_OFFERING = 16  # publishers of a topic, of whom nobody says how many there are
TURN_S = 0.02  # while waiting, others are answered this often
CLOCK = RealClock()


class Asker(Protocol):
    """What an inbox needs of its link."""

    def serve(self) -> bool:
        """Answer somebody else's question, if there is one."""

    def ask(self, question: dict[str, Any], inbox: "Inbox") -> None:
        """Put a question to all publishers; answers arrive in the inbox."""


@dataclass(slots=True)
class Source:
    """How far an inbox has come with one topic of one publisher; `next` is None before it began."""

    next: int | None
    seen: int = 0
    behind_since: float | None = None

    def advance(self, number: int) -> int:
        """Go on at `number`; the count of pieces left out."""
        left_out = 0 if self.next is None else max(0, number - self.next)
        self.next = number if self.next is None else max(number, self.next)
        return left_out


@dataclass(slots=True)
class Parcel:
    """A payload of a topic and publisher whose end has not come yet."""

    number: int = 0  # of the next piece
    bodies: list[bytes] | None = None

    def add(self, piece: Piece) -> bytes | None:
        """The whole payload if this piece ends it; without one between, nothing of it is left."""
        if piece.place & BEGINS:
            self.bodies = []
        elif piece.number != self.number:
            self.bodies = None
        self.number = piece.number + 1
        if self.bodies is None or len(self.bodies) * PIECE_BYTES > LARGEST_BYTES:
            return None
        self.bodies.append(piece.body)
        return b"".join(self.bodies) if piece.place & ENDS else None


class Inbox:
    """Payloads in order per topic and publisher; `subscribe` makes it, one thread reads it.

    `missed` pieces were gone before they could be asked for again, `dropped` ones were pushed out
    by newer ones because nobody fetched them, `ignored` ones not ours. Of what is `offered` only so
    many publishers are kept in mind: who comes under ever new names costs no memory. Pieces of a
    publisher in `without` are left out: who passes them on does not want them back.
    """

    def __init__(
        self,
        link: Asker,
        topics: tuple[str, ...],
        history: bool,
        capacity: int,
        offered: bool = False,
    ) -> None:
        self.offered = offered
        self.without: set[str] = set()
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
        self._ready: deque[Piece] = deque()
        self._sources: dict[tuple[str, str], Source] = {}
        self._parcels: dict[tuple[str, str], Parcel] = {}
        self._who = secrets.token_hex(8)
        self._asked_at = float("-inf")
        self._answered = False

    def get(self, timeout_s: float) -> tuple[str, bytes] | None:
        """The next (topic, payload); None when there is none within `timeout_s`."""
        deadline = CLOCK.now() + timeout_s
        while (piece := self.piece(deadline - CLOCK.now())) is not None:
            whole = self.whole(piece)
            if whole is not None:
                return piece.topic, whole
        return None

    def whole(self, piece: Piece) -> bytes | None:
        """The payload that this piece ends."""
        return self._parcels.setdefault(piece[:2], Parcel()).add(piece)

    def piece(self, timeout_s: float) -> Piece | None:
        """The next piece, for one who passes it on; use this, or `get`."""
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

    @property
    def behind(self) -> bool:
        """Whether something is known to be missing that was not given up."""
        return any(one.behind_since is not None for one in self._sources.values())

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
        if number >= LAST_NUMBER:  # what is held of it could not be told to anybody
            self.ignored += 1
            return
        where = (topic, name.hex())
        if where[1] in self.without:
            return
        source = self._source(where, 0 if number == 0 else None)
        if source.next is None and not self._history:
            source.advance(number)
        if where in self._skipped:
            source.advance(self._skipped.pop(where))
        source.seen = max(source.seen, number)
        if number == source.next:
            self._accept(source, Piece(topic, name.hex(), number, place, body))
        elif (source.next is None or number > source.next) and source.behind_since is None:
            source.behind_since = CLOCK.now()

    def _take(self, stamp: bytes, chunk: bytes) -> None:
        """Move the pieces of an answer to `_ready`; count those that their publisher lacks."""
        self._answered = True
        said = understood(stamp, PIECE_BYTES, lambda said: [_checked(*one) for one in said])
        if said is None:
            self.ignored += 1
            return
        at = 0
        for topic, name, first, end, sizes in said:
            begun, at = at, at + sum(size for _, size in sizes)
            if topic not in self._topics:
                continue
            source = self._source((topic, name), None)
            self.missed += source.advance(first)
            for number, (place, size) in enumerate(sizes, first):
                body, begun = chunk[begun : begun + size], begun + size
                if number == source.next:
                    self._accept(source, Piece(topic, name, number, place, body))
            source.behind_since = CLOCK.now() if (source.next or 0) < end else None

    def _source(self, where: tuple[str, str], begin: int | None) -> Source:
        """How far we are with a topic and publisher; `begin` where it is a new one."""
        source = self._sources.pop(where, None) if self.offered else self._sources.get(where)
        if source is None:
            source = Source(begin)
        self._sources[where] = source  # of offers, after those who were heard before
        if self.offered:
            self._forget([one for one in self._sources if one[0] == where[0]][:-MOST_OFFERING])
        return source

    def _forget(self, forgotten: list[tuple[str, str]]) -> None:
        """Let go of what is known of these; one that speaks again is asked for all it holds."""
        for where in forgotten:
            del self._sources[where]
            self._parcels.pop(where, None)
            self._ready = deque(one for one in self._ready if one[:2] != where)

    def _accept(self, source: Source, piece: Piece) -> None:
        source.next = piece.number + 1
        self._ready.append(piece)

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


def _checked(
    topic: str, name: str, first: int, end: int, sizes: list[tuple[int, int]]
) -> tuple[str, str, int, int, list[tuple[int, int]]]:
    """What an answer says of a topic; ValueError or TypeError where it cannot be."""
    if not 0 <= int(first) <= int(end) < LAST_NUMBER:
        raise ValueError(f"numbers from {first} to {end}")
    held = [(int(place) & (BEGINS | ENDS), int(size)) for place, size in sizes]
    return str(topic), bytes.fromhex(name).hex(), int(first), int(end), held
