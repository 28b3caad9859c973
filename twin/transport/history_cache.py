"""Publisher-side history cache: sequence-numbered fragments for retransmission."""

import json
import struct
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import islice
from typing import Any, NamedTuple, TypeVar

from table_io.clock import RealClock

MAX_PAYLOAD_BYTES = 4 * 2**20
MAX_CACHED_FRAGMENTS = 5000  # per topic and publisher: 50 s at 100 blocks a second
MAX_CACHED_BYTES = 64 * 2**20  # per topic and publisher
FRAGMENT_BYTES = 48 * 2**10  # maximum body of a bus message: below a zenoh batch, 64 kB
MAX_REPLY_FRAGMENTS = 1000  # per reply: the list of their sizes must fit into its attachment
MAX_SUBSCRIBERS = 256  # whose progress a publisher tracks
PUBLISHER_TIMEOUT_S = 10.0  # zenoh's lease: after it a silent publisher counts as dead
FRAGMENT_HEADER = struct.Struct("<8sQB")  # publisher id, sequence number, flags
FIRST_FLAG, LAST_FLAG = 1, 2  # fragment begins, ends its payload
MAX_HISTORY_QUERY_BYTES = 16 * 2**10  # it names the publishers of every topic
CLOCK = RealClock()
T = TypeVar("T")


class Fragment(NamedTuple):
    """Fragment of a payload with its publisher's sequence number within the topic."""

    topic: str
    publisher: str  # id, hexadecimal
    sequence: int
    flags: int
    body: bytes

    @property
    def header(self) -> bytes:
        """Attachment of the bus message, 17 bytes."""
        return FRAGMENT_HEADER.pack(bytes.fromhex(self.publisher), self.sequence, self.flags)


def split_payload(topic: str, publisher: str, sequence: int, payload: bytes) -> Iterator[Fragment]:
    """Split a payload into fragments of at most `FRAGMENT_BYTES`, numbered from `sequence`."""
    for offset in range(0, max(len(payload), 1), FRAGMENT_BYTES):
        flags = FIRST_FLAG * (offset == 0) | LAST_FLAG * (offset + FRAGMENT_BYTES >= len(payload))
        yield Fragment(topic, publisher, sequence, flags, payload[offset : offset + FRAGMENT_BYTES])
        sequence += 1


class HistoryCache:
    """Newest fragments of one topic and publisher, with sequence numbers `first` to `end` - 1."""

    def __init__(self) -> None:
        self.end = 0
        self._fragments: deque[tuple[int, bytes]] = deque()
        self._bytes = 0

    @property
    def first(self) -> int:
        return self.end - len(self._fragments)

    def add(self, sequence: int, flags: int, body: bytes) -> None:
        """Cache a fragment; evict the oldest, or all where `sequence` leaves a gap."""
        while self._fragments and (
            sequence != self.end
            or len(self._fragments) >= MAX_CACHED_FRAGMENTS
            or self._bytes > MAX_CACHED_BYTES
        ):
            self._bytes -= len(self._fragments.popleft()[1])
        self._fragments.append((flags, body))
        self._bytes += len(body)
        self.end = sequence + 1

    def collect(self, first: int, room_bytes: int) -> list[tuple[int, bytes]]:
        """Return (flags, body) of the fragments from `first` that fit into `room_bytes`."""
        fragments = []
        for flags, body in islice(
            self._fragments, first - self.first, first - self.first + MAX_REPLY_FRAGMENTS
        ):
            room_bytes -= len(body)
            if room_bytes < 0:
                break
            fragments.append((flags, body))
        return fragments


HistoryCaches = dict[tuple[str, str], HistoryCache]  # by topic and publisher
NextSequences = dict[str, dict[str, int]]  # next sequence number needed, by topic and publisher


class HistoryQuery(NamedTuple):
    """Question of a subscriber for the fragments that it needs next, with or without history."""

    who: str  # id of the subscriber
    history: bool
    next: NextSequences

    def encode(self) -> str:
        """Return the query as JSON, as `parse_history_query` takes it."""
        return json.dumps(self._asdict())


def parse_request(text: bytes, max_bytes: int, convert: Callable[[Any], T]) -> T | None:
    """Parse and convert untrusted JSON; return None where it is invalid.

    Invalid is: longer than `max_bytes`, not JSON, nested too deeply, or rejected by `convert`.
    """
    if len(text) > max_bytes:
        return None
    try:
        return convert(json.loads(text))
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError):
        return None


def parse_history_query(text: bytes) -> HistoryQuery | None:
    """Return a history query as `ReliableSubscriber` sends it, None if it is invalid."""

    def convert(data: Any) -> HistoryQuery:
        next_sequences = {
            topic: {str(publisher): int(sequence) for publisher, sequence in sequences.items()}
            for topic, sequences in data["next"].items()
        }
        return HistoryQuery(str(data.get("who"))[:64], bool(data["history"]), next_sequences)

    return parse_request(text, MAX_HISTORY_QUERY_BYTES, convert)


def build_history_reply(
    caches: HistoryCaches, next_sequences: NextSequences, history: bool
) -> tuple[list[Any], bytes]:
    """Return (entries, concatenated bodies): one retransmission reply of at most 48 KiB.

    An entry is [topic, publisher, first, end, [(flags, size) of each fragment]].
    """
    entries: list[Any] = []
    bodies: list[bytes] = []
    room_bytes = FRAGMENT_BYTES
    # Rare topics first, so that the start of a run comes before its blocks.
    for (topic, publisher), cache in sorted(caches.items(), key=lambda entry: entry[1].end):
        if topic not in next_sequences:
            continue
        requested = next_sequences[topic].get(publisher)
        first = (cache.first if history else cache.end) if requested is None else requested
        first = min(max(first, cache.first), cache.end)
        fragments = cache.collect(first, room_bytes)
        room_bytes -= sum(len(body) for _, body in fragments)
        bodies += [piece for _, piece in fragments]
        if requested is None or first < cache.end:
            entries.append(
                [
                    topic,
                    publisher,
                    first,
                    cache.end,
                    [(flags, len(body)) for flags, body in fragments],
                ]
            )
    return entries, b"".join(bodies)


@dataclass(slots=True)
class SubscriberProgress:
    """Acknowledged position of each subscriber, from its history queries.

    `positions` holds, by subscriber id, the time in s of its last query and the next sequence
    number that it needs by topic and publisher.
    """

    positions: dict[str, tuple[float, dict[tuple[str, str], int]]] = field(default_factory=dict)

    def record_query(self, query: HistoryQuery, caches: HistoryCaches) -> None:
        """Record a history query; a subscriber without history starts at the end of the cache."""
        previous = self.positions.pop(query.who, (0.0, {}))[1]
        positions = {}
        for (topic, publisher), cache in caches.items():
            if topic in query.next:
                start = 0 if query.history else cache.end
                default_sequence = previous.get((topic, publisher), start)
                sequence = query.next[topic].get(publisher, default_sequence)
                # clamped: the number comes from outside
                positions[topic, publisher] = min(max(sequence, cache.first), cache.end)
        while len(self.positions) >= MAX_SUBSCRIBERS:
            del self.positions[next(iter(self.positions))]  # least recent query
        self.positions[query.who] = CLOCK.now(), positions

    def max_lag(self, caches: HistoryCaches, within_s: float = PUBLISHER_TIMEOUT_S) -> int:
        """Return the largest lag in fragments of the subscribers seen within `within_s`, or 0."""
        since = CLOCK.now() - within_s
        return max(
            (
                caches[stream].end - next_sequence
                for queried_at, positions in self.positions.values()
                if queried_at > since
                for stream, next_sequence in positions.items()
            ),
            default=0,
        )
