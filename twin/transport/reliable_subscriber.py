"""Reliable subscriber: in-order, duplicate-free delivery by sequence numbers and retransmission.

Every publisher numbers its fragments and caches the newest of each topic in a `HistoryCache`. A
`ReliableSubscriber` that detects a gap queries for the missing fragments, chunk by chunk, and
delivers nothing newer before them. A relay keeps publisher id and sequence numbers and caches the
fragments too, so a fragment may come from either and is delivered once.
"""

import secrets
import threading
from collections import deque
from dataclasses import dataclass
from typing import Any, Protocol

from table_io.clock import RealClock
from twin.transport.history_cache import (
    FIRST_FLAG,
    FRAGMENT_BYTES,
    FRAGMENT_HEADER,
    LAST_FLAG,
    MAX_PAYLOAD_BYTES,
    PUBLISHER_TIMEOUT_S,
    Fragment,
    HistoryQuery,
    parse_request,
)

QUERY_PERIOD_S = 0.5  # without a known gap, in case the last message of a topic was lost
QUERY_RETRY_S = 0.1  # with a gap, in case query or reply was lost
QUERY_CONTINUE_S = 0.003  # with a gap, after a reply
MAX_SEQUENCE = 2**63
MAX_OFFERING_PUBLISHERS = 16  # per topic, tracked of those outside the run
SERVE_PERIOD_S = 0.02  # while waiting, history queries are answered at this period
CLOCK = RealClock()


class QueryLink(Protocol):
    """Link on which a subscriber sends and answers history queries."""

    def serve(self) -> bool:
        """Answer one pending history query; return whether there was one."""

    def query_history(self, query: HistoryQuery, inbox: "ReliableSubscriber") -> None:
        """Send a history query to all publishers; replies arrive in `inbox`."""


@dataclass(slots=True)
class PublisherPosition:
    """Position of a subscriber in one topic of one publisher.

    `next_sequence` is None before the first fragment; `behind_since` is the time in s since when a
    gap is known.
    """

    next_sequence: int | None
    last_seen: int = 0
    behind_since: float | None = None

    def advance(self, sequence: int) -> int:
        """Move the position forward to `sequence`; return the number of fragments skipped."""
        skipped = 0 if self.next_sequence is None else max(0, sequence - self.next_sequence)
        self.next_sequence = (
            sequence if self.next_sequence is None else max(sequence, self.next_sequence)
        )
        return skipped


@dataclass(slots=True)
class PayloadAssembly:
    """Reassembly of a fragmented payload of one topic and publisher."""

    next_sequence: int = 0
    bodies: list[bytes] | None = None

    def add(self, fragment: Fragment) -> bytes | None:
        """Add a fragment; return the payload if it is complete. A gap discards the payload."""
        if fragment.flags & FIRST_FLAG:
            self.bodies = []
        elif fragment.sequence != self.next_sequence:
            self.bodies = None
        self.next_sequence = fragment.sequence + 1
        if self.bodies is None or len(self.bodies) * FRAGMENT_BYTES > MAX_PAYLOAD_BYTES:
            return None
        self.bodies.append(fragment.body)
        return b"".join(self.bodies) if fragment.flags & LAST_FLAG else None


class ReliableSubscriber:
    """Payloads in order per topic and publisher; made by `subscribe`, read by one thread.

    Counters: `missed` fragments left all caches before they could be retransmitted, `dropped` ones
    overflowed the queue, `ignored` ones were malformed. With `offered`, only
    `MAX_OFFERING_PUBLISHERS` per topic are tracked, so that changing publisher ids costs no memory.
    Fragments of `excluded_publishers` are discarded: a relay does not want its own back.
    """

    def __init__(
        self,
        link: QueryLink,
        topics: tuple[str, ...],
        history: bool,
        capacity: int,
        offered: bool = False,
    ) -> None:
        self.offered = offered
        self.excluded_publishers: set[str] = set()
        self.missed = 0
        self.dropped = 0
        self.ignored = 0
        self._link = link
        self._topics = topics
        self._history = history
        self._capacity = capacity
        self._queue: deque[tuple[str, bytes, bytes]] = deque()  # topic "" = a reply
        self._queue_changed = threading.Condition()
        self._skipped: dict[tuple[str, str], int] = {}
        self._ready: deque[Fragment] = deque()
        self._positions: dict[tuple[str, str], PublisherPosition] = {}
        self._assemblies: dict[tuple[str, str], PayloadAssembly] = {}
        self._subscriber_id = secrets.token_hex(8)
        self._queried_at = float("-inf")
        self._got_reply = False

    def get(self, timeout_s: float) -> tuple[str, bytes] | None:
        """Return the next (topic, payload), or None after `timeout_s`."""
        deadline = CLOCK.now() + timeout_s
        while (fragment := self.get_fragment(deadline - CLOCK.now())) is not None:
            payload = self.reassemble(fragment)
            if payload is not None:
                return fragment.topic, payload
        return None

    def reassemble(self, fragment: Fragment) -> bytes | None:
        """Add a fragment to the payload of its topic and publisher; return it when complete."""
        return self._assemblies.setdefault(fragment[:2], PayloadAssembly()).add(fragment)

    def get_fragment(self, timeout_s: float) -> Fragment | None:
        """Return the next fragment, or None after `timeout_s`; for relays, instead of `get`."""
        deadline = CLOCK.now() + timeout_s
        while not self._ready:
            self._link.serve()
            time_s = CLOCK.now()
            self._query_if_due(time_s)
            with self._queue_changed:
                if not self._queue and time_s < deadline:
                    self._queue_changed.wait(min(SERVE_PERIOD_S, deadline - time_s))
                message = self._queue.popleft() if self._queue else None
            if message is not None:
                self._handle_fragment(*message)
            elif time_s >= deadline:
                return None
        return self._ready.popleft()

    @property
    def is_behind(self) -> bool:
        """True while a known gap may still be filled."""
        return any(position.behind_since is not None for position in self._positions.values())

    def handle_sample(self, topic: str, header: Any, body: Any) -> None:
        """Queue a copy of a sample; called on zenoh's thread, which serves all subscriptions."""
        if (
            header is None
            or len(body) > FRAGMENT_BYTES
            or (topic and len(header) != FRAGMENT_HEADER.size)
        ):
            self.ignored += 1
            return
        entry = (topic, header.to_bytes(), body.to_bytes())
        with self._queue_changed:
            if len(self._queue) >= self._capacity:
                self._drop(*self._queue.popleft())
            self._queue.append(entry)
            self._queue_changed.notify()

    def _drop(self, topic: str, header: bytes, _: bytes) -> None:
        # With history the fragment is not lost: its gap is filled by retransmission.
        if topic and not self._history:
            publisher, sequence, _place = FRAGMENT_HEADER.unpack(header)
            self._skipped[topic, publisher.hex()] = sequence + 1
            self.dropped += 1

    def _handle_fragment(self, topic: str, header: bytes, body: bytes) -> None:
        """Append the fragment to `_ready` if it is next in sequence, else record the gap."""
        if not topic:
            self._handle_reply(header, body)
            return
        publisher, sequence, flags = FRAGMENT_HEADER.unpack(header)
        if sequence >= MAX_SEQUENCE:  # its successor could not be requested
            self.ignored += 1
            return
        stream = (topic, publisher.hex())
        if stream[1] in self.excluded_publishers:
            return
        position = self._get_position(stream, 0 if sequence == 0 else None)
        if position.next_sequence is None and not self._history:
            position.advance(sequence)
        if stream in self._skipped:
            position.advance(self._skipped.pop(stream))
        position.last_seen = max(position.last_seen, sequence)
        if sequence == position.next_sequence:
            self._accept(position, Fragment(topic, publisher.hex(), sequence, flags, body))
        elif (
            position.next_sequence is None or sequence > position.next_sequence
        ) and position.behind_since is None:
            position.behind_since = CLOCK.now()

    def _handle_reply(self, header: bytes, chunk: bytes) -> None:
        """Append the fragments of a reply to `_ready`; count those no longer cached as missed."""
        self._got_reply = True
        entries = parse_request(
            header, FRAGMENT_BYTES, lambda reply: [_check_entry(*entry) for entry in reply]
        )
        if entries is None:
            self.ignored += 1
            return
        offset = 0
        for topic, publisher, first, end, sizes in entries:
            begin, offset = offset, offset + sum(size for _, size in sizes)
            if topic not in self._topics:
                continue
            position = self._get_position((topic, publisher), None)
            self.missed += position.advance(first)
            for sequence, (flags, size) in enumerate(sizes, first):
                body, begin = chunk[begin : begin + size], begin + size
                if sequence == position.next_sequence:
                    self._accept(position, Fragment(topic, publisher, sequence, flags, body))
            position.behind_since = CLOCK.now() if (position.next_sequence or 0) < end else None

    def _get_position(self, stream: tuple[str, str], first: int | None) -> PublisherPosition:
        """Return the position in a topic and publisher, new ones with `first` as next sequence."""
        position = (
            self._positions.pop(stream, None) if self.offered else self._positions.get(stream)
        )
        if position is None:
            position = PublisherPosition(first)
        self._positions[stream] = position  # for offers: most recently seen last
        if self.offered:
            self._forget(
                [key for key in self._positions if key[0] == stream[0]][:-MAX_OFFERING_PUBLISHERS]
            )
        return position

    def _forget(self, streams: list[tuple[str, str]]) -> None:
        """Discard the state of these streams; a publisher that returns starts from its cache."""
        for stream in streams:
            del self._positions[stream]
            self._assemblies.pop(stream, None)
            self._ready = deque(fragment for fragment in self._ready if fragment[:2] != stream)

    def _accept(self, position: PublisherPosition, fragment: Fragment) -> None:
        position.next_sequence = fragment.sequence + 1
        self._ready.append(fragment)

    def _query_if_due(self, time_s: float) -> None:
        """Send a history query if one is due, and give up gaps of dead publishers."""
        missing = [
            position for position in self._positions.values() if position.behind_since is not None
        ]
        for late in missing:
            if time_s - (late.behind_since or time_s) > PUBLISHER_TIMEOUT_S:
                self.missed += late.advance(late.last_seen + 1)
                late.behind_since = None
        pause = (
            QUERY_PERIOD_S
            if not missing
            else QUERY_CONTINUE_S
            if self._got_reply
            else QUERY_RETRY_S
        )
        if time_s - self._queried_at >= pause:
            self._queried_at, self._got_reply = time_s, False
            next_sequences: dict[str, dict[str, int]] = {topic: {} for topic in self._topics}
            for (topic, publisher), state in self._positions.items():
                if state.next_sequence is not None:
                    next_sequences[topic][publisher] = state.next_sequence
            query = HistoryQuery(self._subscriber_id, self._history, next_sequences)
            self._link.query_history(query, self)


def _check_entry(
    topic: str, publisher: str, first: int, end: int, sizes: list[tuple[int, int]]
) -> tuple[str, str, int, int, list[tuple[int, int]]]:
    """Validate one entry of a history reply; raise ValueError or TypeError if malformed."""
    if not 0 <= int(first) <= int(end) < MAX_SEQUENCE:
        raise ValueError(f"sequence numbers from {first} to {end}")
    checked_sizes = [(int(flags) & (FIRST_FLAG | LAST_FLAG), int(size)) for flags, size in sizes]
    return str(topic), bytes.fromhex(publisher).hex(), int(first), int(end), checked_sizes
