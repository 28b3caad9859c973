"""What a twin outside offers to a run: let in where it is what its topic promises, and no more."""

from dataclasses import dataclass, field

from table_io.block import Block
from table_io.records import Comparison, Event, Fault, Timing
from twin.stream.resend import Inbox
from twin.stream.shelf import BEGINS, ENDS, Piece
from twin.stream.wire import TOPIC_TYPES, Item, WireError, decode

TWIN_TOPICS = (
    *(name for name in TOPIC_TYPES if name.startswith("/twin/")),
    "/run/fault",
    "/run/timing",
    "/run/event",
)
OFFERS = 8  # pieces taken in a turn of the gate
AHEAD = 10_000  # samples that a twin may be beyond those we know of: some seconds
LONGEST_TEXT = 1000
MOST_TWINS, MOST_BEGUN = 256, 64  # publishers; payloads whose end has not come yet
MOST_PIECES = 8  # of a payload: the largest that a twin computes has one


def offered(name: str, payload: bytes, run: str, end: int, kinds: frozenset[str]) -> bool:
    """Whether these bytes are what the topic promises, of this run and its twin.

    `end` is the sample up to which the rig has come, `kinds` the events that a twin may tell.
    """
    try:
        of, item = decode(name, payload)
    except WireError:
        return False
    return of == run and _reach(item) <= end + AHEAD and _a_twins(item, kinds)


def _reach(item: Item) -> int:
    """The sample up to which an item holds."""
    match item:
        case Block(end=end):
            return end
        case Comparison(index=index, count=count):
            return index + count
        case Fault(index=index, to_index=to_index):
            return max(index, to_index)
    return item.index


def _a_twins(item: Item, kinds: frozenset[str]) -> bool:
    """Whether a twin says this; what a person reads is a line, and what another says is not its."""
    match item:
        case Event(kind=kind, text=text):
            return kind in kinds and readable(text)
        case Fault(component=component, reason=reason):
            return component == "twin" and readable(reason)
        case Timing(component=component):
            return component == "twin"
    return True


def readable(text: str) -> bool:
    """Whether a person can be shown this as one line."""
    return len(text) <= LONGEST_TEXT and text.isprintable()


@dataclass(slots=True)
class Offers:
    """What lies in an inbox of offers, looked at before it is let in.

    Publishers outside are known by their names, which nobody proves, and everybody reads those of
    the run: what comes under a name that was heard inside first is thrown away.
    """

    inbox: Inbox
    run: str
    kinds: frozenset[str]
    inside: set[str] = field(default_factory=set)  # publishers of the run
    _outside: set[str] = field(default_factory=set)
    _begun: dict[tuple[str, str], list[Piece]] = field(default_factory=dict)

    def take(self, end: int) -> list[Piece] | None:
        """The pieces of a payload that is let in, once it is whole; None where nothing lies there.

        `end` is the sample up to which the rig has come.
        """
        piece = self.inbox.piece(0.0)
        if piece is None:
            return None
        parts = [] if self._refused(piece.source) else self._joined(piece)
        whole = b"".join(part.body for part in parts)
        if not parts or not offered(piece.topic, whole, self.run, end, self.kinds):
            return []
        self._outside.add(piece.source)
        return parts

    def _refused(self, source: str) -> bool:
        if source in self._outside:
            return False
        return source in self.inside or len(self._outside) >= MOST_TWINS

    def _joined(self, piece: Piece) -> list[Piece]:
        """The pieces of the payload that this one ends; none where it does not, or one lacks."""
        where = (piece.topic, piece.source)
        parts = self._begun.pop(where, [])
        if piece.place & BEGINS:
            parts = []
        elif not parts or piece.number != parts[-1].number + 1 or len(parts) == MOST_PIECES:
            return []
        parts.append(piece)
        if piece.place & ENDS:
            return parts
        while len(self._begun) >= MOST_BEGUN:
            del self._begun[next(iter(self._begun))]  # begun longest ago
        self._begun[where] = parts
        return []
