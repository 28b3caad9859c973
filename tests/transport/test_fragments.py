"""How payloads are cut into numbered pieces, held, asked for and put together again."""

import itertools
import json
import random
from dataclasses import dataclass, field
from typing import Any

import pytest

from table_io.clock import ManualClock
from twin.transport import history_cache, reliable_subscriber
from twin.transport.codec import TOPIC_TYPES
from twin.transport.history_cache import (
    FRAGMENT_BYTES,
    FRAGMENT_HEADER,
    MAX_HISTORY_QUERY_BYTES,
    MAX_REPLY_FRAGMENTS,
    MAX_SUBSCRIBERS,
    Fragment,
    HistoryCache,
    HistoryQuery,
    SubscriberProgress,
    build_history_reply,
    parse_history_query,
    split_payload,
)
from twin.transport.reliable_subscriber import (
    MAX_OFFERING_PUBLISHERS,
    PayloadAssembly,
    ReliableSubscriber,
)
from twin.transport.zenoh_link import MAX_REQUEST_BYTES, RequestQueue

TOPIC, SOURCE = "/rig/meas", "00112233445566ff"


class Bytes(bytes):
    """As zenoh hands them over."""

    def to_bytes(self) -> bytes:
        return bytes(self)


class Asked:
    """Stands for a link: notes the questions."""

    def __init__(self) -> None:
        self.questions: list[HistoryQuery] = []

    def serve(self) -> bool:
        return False

    def query_history(self, question: HistoryQuery, _: ReliableSubscriber) -> None:
        self.questions.append(question)


def test_incomplete_payload_is_discarded_and_the_next_is_whole() -> None:
    parcel = PayloadAssembly()
    first, _, third = split_payload(TOPIC, SOURCE, 0, bytes(3 * FRAGMENT_BYTES))
    assert [parcel.add(first), parcel.add(third)] == [None, None]
    (after,) = split_payload(TOPIC, SOURCE, 3, b"next")
    assert parcel.add(after) == b"next"


def test_reply_fits_with_the_list_of_its_sizes() -> None:
    shelf = HistoryCache()
    for number in range(3000):
        shelf.add(number, 3, b"x")
    header, chunk = build_history_reply({(TOPIC, SOURCE): shelf}, {TOPIC: {SOURCE: 100}}, True)
    ((topic, source, first, end, sizes),) = header
    assert (topic, source, first, end) == (TOPIC, SOURCE, 100, 3000)
    assert len(sizes) == len(chunk) == MAX_REPLY_FRAGMENTS
    assert len(json.dumps(header)) + FRAGMENT_BYTES < 2**16


@pytest.mark.parametrize(
    "stamp",
    [
        b"",
        b"\xff",
        b"3",
        b"[3]",
        b'[["/rig/meas", "x"]]',
        b'[["/rig/meas", "x", "a", 3, []]]',
        b'[["/rig/meas", "x", 0, 3, [[1]]]]',
        b'[["/rig/meas", "x", 0, 3, 5]]',
        b'[["/rig/meas", [], 0, 3, []]]',
        b'[["/rig/meas", "no hex", 0, 3, []]]',
        b'[["/rig/meas", "00ff", 5, 3, []]]',
        b'[["/rig/meas", "00ff", -1, 3, []]]',
        b'[["/rig/meas", "00ff", 0, 1e30, []]]',
        b'[["/rig/meas", "00ff", 0, 1e999, []]]',
        b'[["/rig/meas", "00ff", 0, 3, [[1, 1e999]]]]',
        b'[["/rig/meas", "00ff", 0, 3, [[-1e999, 1]]]]',
        b"[" * 40_000,
        b'{"a":' * 9_000,
        b" " * 60_000 + b"[]",
    ],
)
def test_malformed_reply_is_ignored(stamp: bytes) -> None:
    inbox = ReliableSubscriber(Asked(), (TOPIC,), True, 10)
    inbox.handle_sample("", Bytes(stamp), Bytes(b"abc"))
    assert inbox.get(0.0) is None
    assert inbox.ignored == 1


@pytest.mark.parametrize(
    "question",
    [
        b"",
        b"\xff",
        b"3",
        b"[]",
        b"{}",
        b"[" * 60_000,
        b"[" * MAX_HISTORY_QUERY_BYTES,
        b'{"a":' * 3_000,
        b'{"history": true, "next": 3}',
        b'{"history": true, "next": {"/rig/meas": 3}}',
        b'{"history": true, "next": {"/rig/meas": {"00ff": 1e999}}}',
        b'{"history": true, "next": {"/rig/meas": {"00ff": -1e999}}}',
        b'{"history": true, "next": {"/rig/meas": {"00ff": NaN}}}',
        b'{"history": true, "next": {"/rig/meas": {"00ff": [1]}}}',
        b'{"history": true, "next": {"/rig/meas": {"00ff": ' + b"9" * 5000 + b"}}}",
        b'{"history": true, "next": {}}' + b" " * MAX_HISTORY_QUERY_BYTES,
    ],
)
def test_malformed_history_query_is_rejected(question: bytes) -> None:
    assert parse_history_query(question) is None


def test_history_query_of_many_publishers_is_parsed() -> None:
    link = Asked()
    inbox = ReliableSubscriber(link, tuple(TOPIC_TYPES), True, 10_000)
    for publisher in range(14):
        for topic in TOPIC_TYPES:
            piece = Fragment(topic, f"{publisher:016x}", 0, 3, b"")
            inbox.handle_sample(topic, Bytes(piece.header), Bytes(piece.body))
    while inbox.get(0.0) is not None:
        pass
    inbox._queried_at = float("-inf")
    inbox.get(0.0)
    question = link.questions[-1]
    assert parse_history_query(question.encode().encode()) == question
    assert all(len(known) == 14 for known in question.next.values())


@pytest.mark.parametrize("lie", [0, -1e30, -1, 2**63 - 1, 2**64, 10**400])
def test_false_position_of_a_subscriber_is_clamped_to_the_cache(lie: float) -> None:
    listeners = SubscriberProgress()
    shelf = HistoryCache()
    for number in range(5, 15):
        shelf.add(number, 3, b"x")
    shelves = {(TOPIC, SOURCE): shelf}
    text = json.dumps({"who": "x", "history": True, "next": {TOPIC: {SOURCE: lie}}})
    question = parse_history_query(text.encode())
    assert question is not None
    listeners.record_query(question, shelves)
    lacks = 0 if lie > 0 else 10
    assert listeners.max_lag(shelves) == lacks
    assert len(build_history_reply(shelves, question.next, True)[1]) == lacks


def test_reply_about_another_topic_is_ignored() -> None:
    link = Asked()
    inbox = ReliableSubscriber(link, (TOPIC,), True, 10)
    header = [["/run/stop", SOURCE, 0, 1, [[3, 3]]], [TOPIC, SOURCE, 0, 1, [[3, 2]]]]
    inbox.handle_sample("", Bytes(json.dumps(header).encode()), Bytes(b"abcde"))
    assert inbox.get(0.0) == (TOPIC, b"de")
    assert inbox.get(0.0) is None


def test_sequence_number_beyond_the_limit_is_ignored() -> None:
    inbox = ReliableSubscriber(Asked(), (TOPIC,), True, 10)
    for number in (0, 2**64 - 1, 2**63):
        piece = Fragment(TOPIC, SOURCE, number, 3, b"x")
        inbox.handle_sample(TOPIC, Bytes(piece.header), Bytes(piece.body))
    assert inbox.get(0.0) == (TOPIC, b"x")
    assert inbox.get(0.0) is None
    assert (inbox.ignored, inbox.missed) == (2, 0)


def test_new_publishers_of_offers_cost_no_memory() -> None:
    link = Asked()
    inbox = ReliableSubscriber(link, (TOPIC, "/run/stop"), True, 10, offered=True)
    honest = Fragment("/run/stop", SOURCE, 0, 3, b"heard")
    inbox.handle_sample("/run/stop", Bytes(honest.header), Bytes(honest.body))
    assert inbox.get(0.0) == ("/run/stop", b"heard")
    for number in range(500):
        piece = Fragment(TOPIC, f"{number:016x}", 0, 1, b"begun")
        inbox.handle_sample(TOPIC, Bytes(piece.header), Bytes(piece.body))
        assert inbox.get(0.0) is None
    header = [[TOPIC, f"{number:016x}", 0, 1, [[1, 1]]] for number in range(500, 900)]
    inbox.handle_sample("", Bytes(json.dumps(header).encode()), Bytes(bytes(400)))
    assert inbox.get(0.0) is None
    assert len(inbox._assemblies) <= MAX_OFFERING_PUBLISHERS + 1
    inbox._queried_at = float("-inf")
    assert inbox.get(0.0) is None
    assert len(link.questions[-1].next[TOPIC]) == MAX_OFFERING_PUBLISHERS
    assert link.questions[-1].next["/run/stop"] == {SOURCE: 1}


@pytest.mark.parametrize("size", [0, 1, FRAGMENT_BYTES, FRAGMENT_BYTES + 1, 3 * FRAGMENT_BYTES])
def test_the_first_and_the_last_piece_are_marked(size: int) -> None:
    pieces = list(split_payload(TOPIC, SOURCE, 40, bytes(size)))
    count = max(-(-size // FRAGMENT_BYTES), 1)
    assert [piece.sequence for piece in pieces] == list(range(40, 40 + count))
    assert [piece.flags & 1 for piece in pieces] == [1] + [0] * (count - 1)
    assert [piece.flags & 2 for piece in pieces] == [0] * (count - 1) + [2]
    assert FRAGMENT_HEADER.unpack(pieces[-1].header) == (
        bytes.fromhex(SOURCE), 39 + count, pieces[-1].flags,
    )  # fmt: skip


@pytest.mark.parametrize("count", [1, 85, 86, 87, 200])
def test_a_payload_beyond_the_largest_is_discarded(count: int) -> None:
    """4 MiB are 85.3 pieces; the piece that begins below the limit still counts."""
    assembly = PayloadAssembly()
    payloads = []
    for number in range(count):
        flags = (number == 0) | 2 * (number == count - 1)
        payloads.append(assembly.add(Fragment(TOPIC, SOURCE, number, flags, bytes([number]))))
    assert payloads[:-1] == [None] * (count - 1)
    assert payloads[-1] == (bytes(range(count)) if count <= 86 else None)


@pytest.mark.parametrize("seed", range(8))
def test_a_cache_holds_the_newest_of_an_unbroken_sequence(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(history_cache, "MAX_CACHED_FRAGMENTS", 6)
    monkeypatch.setattr(history_cache, "MAX_CACHED_BYTES", 40)
    monkeypatch.setattr(history_cache, "MAX_REPLY_FRAGMENTS", 4)
    chance, cache, sequence = random.Random(seed), HistoryCache(), 0
    kept: list[tuple[int, int, bytes]] = []
    for _ in range(120):
        sequence += chance.choice([0, 0, 0, 0, 0, 0, 3, -2 * (sequence > 2)])
        flags, body = chance.randrange(4), bytes(chance.choice([0, 5, 12, 20]))
        if kept and kept[-1][0] + 1 != sequence:
            kept = []
        while len(kept) >= 6 or sum(len(body) for _, _, body in kept) > 40:
            kept = kept[1:]
        kept.append((sequence, flags, body))
        cache.add(sequence, flags, body)
        assert (cache.first, cache.end) == (kept[0][0], sequence + 1)
        for room in (0, 5, 17, 1000):
            first = chance.randint(cache.first, cache.end)
            sizes = itertools.accumulate(len(body) for at, _, body in kept if at >= first)
            fitting = [entry[1:] for entry in kept if entry[0] >= first]
            count = sum(total <= room for total in sizes)
            assert cache.collect(first, room) == fitting[: min(count, 4)]
        sequence += 1


@pytest.mark.parametrize(("size", "kept"), [(0, 5000), (FRAGMENT_BYTES, 2**26 // (48 * 2**10) + 1)])
def test_a_cache_is_bounded_in_number_and_bytes(size: int, kept: int) -> None:
    cache, body = HistoryCache(), bytes(size)
    for number in range(kept + 7):
        cache.add(number, 3, body)
    assert (cache.first, cache.end) == (7, kept + 7)


def make_caches() -> dict[tuple[str, str], HistoryCache]:
    """Caches of three topics, of which the one with the most comes first."""
    caches = {}
    for topic, publisher, first, count in (
        ("/rig/meas", SOURCE, 50, 9), ("/rig/meas", "aa", 0, 4), ("/run/start", SOURCE, 0, 1),
        ("/run/stop", "bb", 3, 3),
    ):  # fmt: skip
        cache = caches[topic, publisher] = HistoryCache()
        for number in range(first, first + count):
            cache.add(number, number % 4, bytes([number]) * (number % 5))
    return caches


@pytest.mark.parametrize("history", [True, False])
@pytest.mark.parametrize("room", [FRAGMENT_BYTES, 15, 0])
def test_reply_holds_the_next_fragments_rare_topics_first(
    room: int, history: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(history_cache, "FRAGMENT_BYTES", room)
    caches = make_caches()
    for requested in (None, -5, 0, 2, 52, 59, 70):
        known: dict[str, int] = {} if requested is None else {SOURCE: requested}
        next_sequences = {"/rig/meas": known, "/run/start": known, "/other": {}}
        left, expected, bodies = room, [], b""
        for stream in (("/run/start", SOURCE), ("/rig/meas", "aa"), ("/rig/meas", SOURCE)):
            cache, is_known = caches[stream], stream[1] in known
            begin = cache.first if history else cache.end
            if is_known and requested is not None:
                begin = min(max(requested, cache.first), cache.end)
            fragments = cache.collect(begin, left)
            left -= sum(len(body) for _, body in fragments)
            bodies += b"".join(body for _, body in fragments)
            if not is_known or begin < cache.end:
                sizes = [(flags, len(body)) for flags, body in fragments]
                expected.append([*stream, begin, cache.end, sizes])
        assert build_history_reply(caches, next_sequences, history) == (expected, bodies)


def test_max_lag_counts_recent_subscribers_only(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, caches, progress = ManualClock(100.0), make_caches(), SubscriberProgress()
    monkeypatch.setattr(history_cache, "CLOCK", clock)
    assert progress.max_lag(caches) == 0
    meas = {"/rig/meas": {SOURCE: 51}}
    unknown: dict[str, dict[str, int]] = {"/rig/meas": {}}
    for who, history, asked in (
        ("a", False, unknown), ("b", False, meas), ("c", True, unknown),
    ):  # fmt: skip
        clock.time_s += 4.0
        progress.record_query(HistoryQuery(who, history, asked), caches)
    # "a" starts at the end, "b" lacks 8 of 9, "c" all of them
    for time_s, lag in ((112.0, 9), (121.999, 9), (122.0, 0), (130.0, 0)):
        clock.time_s = time_s
        assert progress.max_lag(caches) == lag
    clock.time_s = 117.999
    assert progress.max_lag(caches, within_s=5.0) == 0
    assert progress.max_lag(caches, within_s=6.0) == 9
    # what is not stated again is as before, for a subscriber without history too
    progress.record_query(HistoryQuery("b", False, {"/rig/meas": {}}), caches)
    assert progress.positions["b"] == (
        117.999, {("/rig/meas", SOURCE): 51, ("/rig/meas", "aa"): 4},
    )  # fmt: skip
    assert progress.max_lag(caches, within_s=1.0) == 8


def test_the_subscriber_that_asked_first_is_forgotten_first() -> None:
    progress = SubscriberProgress()
    for number in [*range(MAX_SUBSCRIBERS), 0, MAX_SUBSCRIBERS]:
        progress.record_query(HistoryQuery(f"{number}", True, {}), {})
    assert list(progress.positions) == [
        *(f"{number}" for number in range(2, MAX_SUBSCRIBERS)), "0", f"{MAX_SUBSCRIBERS}",
    ]  # fmt: skip


def send(inbox: ReliableSubscriber, *numbers: int, publisher: str = SOURCE) -> None:
    for number in numbers:
        piece = Fragment(TOPIC, publisher, number, 3, b"%d" % number)
        inbox.handle_sample(TOPIC, Bytes(piece.header), Bytes(piece.body))


def receive(inbox: ReliableSubscriber) -> list[int]:
    """Return the numbers of all that can be delivered now."""
    payloads = iter(lambda: inbox.get(0.0), None)
    return [int(payload) for _, payload in payloads]


def answer(
    inbox: ReliableSubscriber, first: int, end: int, count: int, publisher: str = SOURCE
) -> None:
    """Give a reply with `count` pieces from `first` on of a cache that ends at `end`."""
    bodies = [b"%d" % number for number in range(first, first + count)]
    header = [[TOPIC, publisher, first, end, [[3, len(body)] for body in bodies]]]
    inbox.handle_sample("", Bytes(json.dumps(header).encode()), Bytes(b"".join(bodies)))


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> ManualClock:
    stepped = ManualClock(100.0)
    monkeypatch.setattr(reliable_subscriber, "CLOCK", stepped)
    return stepped


def test_history_queries_have_the_period_of_their_need(clock: ManualClock) -> None:
    """Each half second without a gap, each tenth with one, 3 ms after a reply that left one."""
    link = Asked()
    inbox = ReliableSubscriber(link, (TOPIC,), True, 10)

    def count_after(pause_s: float) -> int:
        clock.time_s += pause_s
        before = len(link.questions)
        assert receive(inbox) == []
        return len(link.questions) - before

    assert [count_after(pause_s) for pause_s in (0.0, 0.25, 0.25)] == [1, 0, 1]
    send(inbox, 0, 2)
    assert receive(inbox) == [0]
    assert inbox.is_behind
    assert [count_after(pause_s) for pause_s in (0.099, 0.002, 0.099, 0.002)] == [0, 1, 0, 1]
    send(inbox, 5)
    answer(inbox, 1, 6, 0)
    assert [count_after(pause_s) for pause_s in (0.002, 0.002, 0.002)] == [0, 1, 0]
    assert link.questions[-1].next == {TOPIC: {SOURCE: 1}}
    assert link.questions[-1].history is True
    answer(inbox, 1, 6, 5)
    assert receive(inbox) == [1, 2, 3, 4, 5]
    assert not inbox.is_behind
    assert count_after(0.4) == 0
    assert (inbox.missed, inbox.dropped, inbox.ignored) == (0, 0, 0)


@pytest.mark.parametrize("later_s", [0.0, 3.0])
def test_the_gap_of_a_dead_publisher_is_given_up_after_ten_seconds(
    later_s: float, clock: ManualClock
) -> None:
    inbox = ReliableSubscriber(Asked(), (TOPIC,), True, 10)
    send(inbox, 0, 4)
    assert receive(inbox) == [0]
    clock.time_s += later_s
    send(inbox, 7, 6)
    assert receive(inbox) == []
    clock.time_s += 10.0 - later_s  # counted from when the gap was first known
    assert receive(inbox) == []
    assert inbox.is_behind
    clock.time_s += 0.002
    assert receive(inbox) == []
    assert not inbox.is_behind
    assert inbox.missed == 7  # 1 to 7, which came too early to be kept
    send(inbox, 8)
    assert receive(inbox) == [8]


@pytest.mark.parametrize("history", [True, False])
@pytest.mark.parametrize("begin", [0, 3])
def test_new_subscriber_starts_at_the_cache_or_at_the_next_fragment(
    begin: int, history: bool, clock: ManualClock
) -> None:
    inbox = ReliableSubscriber(Asked(), (TOPIC,), history, 10)
    send(inbox, begin)
    assert receive(inbox) == ([] if history and begin else [begin])
    assert inbox.is_behind == (history and begin > 0)
    answer(inbox, 1, 6, 5)
    assert receive(inbox) == ([4, 5] if begin and not history else [1, 2, 3, 4, 5])
    assert inbox.missed == 0


def test_fragments_that_left_the_cache_are_counted_as_missed(clock: ManualClock) -> None:
    inbox = ReliableSubscriber(Asked(), (TOPIC,), True, 10)
    send(inbox, 0, 1, 9)
    assert receive(inbox) == [0, 1]
    answer(inbox, 6, 10, 2)
    assert receive(inbox) == [6, 7]
    assert inbox.missed == 4
    assert inbox.is_behind
    answer(inbox, 4, 10, 6)  # an older reply again: what was delivered is not repeated
    assert receive(inbox) == [8, 9]
    assert (inbox.missed, inbox.is_behind) == (4, False)


@pytest.mark.parametrize("history", [True, False])
def test_a_full_queue_drops_the_oldest(history: bool, clock: ManualClock) -> None:
    """With history the gap is filled again; without, it is skipped and counted."""
    inbox = ReliableSubscriber(Asked(), (TOPIC,), history, 4)
    send(inbox, 0)
    assert receive(inbox) == [0]
    send(inbox, *range(1, 8))
    assert receive(inbox) == ([] if history else [4, 5, 6, 7])
    assert inbox.dropped == (0 if history else 3)
    assert inbox.is_behind == history
    answer(inbox, 1, 8, 7)
    assert receive(inbox) == (list(range(1, 8)) if history else [])
    assert inbox.missed == 0


@pytest.mark.parametrize(
    ("topic", "header", "size", "ignored"),
    [
        (TOPIC, bytes(17), FRAGMENT_BYTES, 0), (TOPIC, bytes(17), FRAGMENT_BYTES + 1, 1),
        (TOPIC, bytes(16), 1, 1), (TOPIC, bytes(18), 1, 1), (TOPIC, None, 1, 1),
        ("", b"[]", FRAGMENT_BYTES, 0), ("", b"[]", FRAGMENT_BYTES + 1, 1),
    ],
)  # fmt: skip
def test_malformed_messages_are_ignored_before_they_are_queued(
    topic: str, header: bytes | None, size: int, ignored: int, clock: ManualClock
) -> None:
    inbox = ReliableSubscriber(Asked(), (TOPIC,), True, 10)
    inbox.handle_sample(topic, None if header is None else Bytes(header), Bytes(size))
    assert (inbox.ignored, len(inbox._queue)) == (ignored, 1 - ignored)


def test_a_relay_does_not_get_its_own_back(clock: ManualClock) -> None:
    inbox = ReliableSubscriber(Asked(), (TOPIC,), True, 10)
    inbox.excluded_publishers.add("00" * 8)
    send(inbox, 0, 1, publisher="00" * 8)
    send(inbox, 0)
    fragment = inbox.get_fragment(0.0)
    assert fragment == Fragment(TOPIC, SOURCE, 0, 3, b"0")
    assert inbox.get_fragment(0.0) is None


@pytest.mark.parametrize("seed", range(6))
def test_every_payload_is_delivered_once_and_in_order_whatever_is_lost(
    seed: int, clock: ManualClock
) -> None:
    """Pieces are lost, doubled and reordered; questions are answered from the cache, or lost."""
    chance, caches = random.Random(seed), {(TOPIC, SOURCE): HistoryCache()}

    class Publisher(Asked):
        def query_history(self, question: HistoryQuery, inbox: ReliableSubscriber) -> None:
            if chance.random() < 0.7:
                entries, bodies = build_history_reply(caches, question.next, True)
                inbox.handle_sample("", Bytes(json.dumps(entries).encode()), Bytes(bodies))

    inbox = ReliableSubscriber(Publisher(), (TOPIC,), True, 1000)
    payloads = [chance.randbytes(chance.choice([0, 3, 60_000])) for _ in range(40)]
    waiting: list[Fragment] = []
    sequence, delivered = 0, []
    for payload in payloads:
        for piece in split_payload(TOPIC, SOURCE, sequence, payload):
            caches[TOPIC, SOURCE].add(piece.sequence, piece.flags, piece.body)
            waiting += [piece] * chance.choice([0, 1, 1, 2])
            sequence = piece.sequence + 1
        chance.shuffle(waiting)
        for _ in range(min(len(waiting), chance.randrange(4))):
            piece = waiting.pop()
            inbox.handle_sample(TOPIC, Bytes(piece.header), Bytes(piece.body))
        clock.time_s += 0.05
        delivered += list(iter(lambda: inbox.get(0.0), None))
    for _ in range(200):
        clock.time_s += 0.6
        delivered += list(iter(lambda: inbox.get(0.0), None))
    assert delivered == [(TOPIC, payload) for payload in payloads]
    assert (inbox.missed, inbox.dropped, inbox.ignored) == (0, 0, 0)
    assert not inbox.is_behind


def test_history_query_keeps_64_letters_of_its_sender() -> None:
    query = {"who": "x" * 100, "history": 1, "next": {TOPIC: {"00ff": 3.0}}}
    parsed = parse_history_query(json.dumps(query).encode())
    assert parsed == HistoryQuery("x" * 64, True, {TOPIC: {"00ff": 3}})


@dataclass
class PendingQuery:
    """A question in zenoh's ring buffer."""

    text: bytes | None
    key_expr: str = ""
    drops: int = 0
    replies: list[tuple[str, str | bytes]] = field(default_factory=list)

    @property
    def payload(self) -> Bytes | None:
        return None if self.text is None else Bytes(self.text)

    def drop(self) -> None:
        self.drops += 1

    def __enter__(self) -> "PendingQuery":
        return self

    def __exit__(self, *_: object) -> None:
        self.drop()

    def reply(self, key: str, body: str | bytes) -> None:
        self.replies.append((key, body))


@dataclass
class Ring:
    """Ring buffer of one key."""

    queries: list[PendingQuery]

    def try_recv(self) -> PendingQuery | None:
        return self.queries.pop(0) if self.queries else None


def test_keys_take_turns_and_malformed_requests_are_dropped() -> None:
    root, long = "shaketwin/rig/", b"x" * MAX_REQUEST_BYTES
    flood = [PendingQuery(b"%d" % number) for number in range(3)]
    bad = [PendingQuery(long + b"x"), PendingQuery(b"\xff"), PendingQuery(long)]
    wild = [PendingQuery(b"w", f"{root}get/*"), PendingQuery(None, f"{root}get/log")]
    malformed = [bad[0], bad[1], wild[0]]
    rings = {"cmd/stop": Ring(flood[:]), "cmd/hold": Ring(bad[:]), "get/*": Ring(wild[:])}
    link: Any = Asked()
    queue = RequestQueue(link, root, rings)
    requests = [queue.poll() for _ in range(6)]
    assert [request and (request.path, request.text, request.name) for request in requests] == [
        ("get/log", "", "log"), ("cmd/hold", long.decode(), "hold"), ("cmd/stop", "0", "stop"),
        ("cmd/stop", "1", "stop"), ("cmd/stop", "2", "stop"), None,
    ]  # fmt: skip
    assert queue.ignored == 3
    assert [query.drops for query in malformed] == [1, 1, 1]
    for request, query in zip(requests, (wild[1], bad[2], flood[0]), strict=False):
        assert request is not None
        assert query.drops == 0
        request.reply("done")
        assert (query.replies, query.drops) == ([(root + request.path, "done")], 1)


@pytest.mark.parametrize("arrives_at", [0, 3, 100])
@pytest.mark.parametrize("call", ["get", "get_fragment"])
def test_waiting_ends_with_a_message_or_the_timeout_and_serves_meanwhile(
    call: str, arrives_at: int, clock: ManualClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Publisher(Asked):
        served = 0

        def serve(self) -> bool:
            if self.served == arrives_at:
                send(inbox, 0)
            self.served += 1
            return True

    link, waits = Publisher(), []

    def wait(timeout_s: float) -> None:
        waits.append(timeout_s)
        clock.time_s += timeout_s

    inbox = ReliableSubscriber(link, (TOPIC,), True, 10)
    monkeypatch.setattr(inbox._queue_changed, "wait", wait)
    item = getattr(inbox, call)(0.09)
    count = min(arrives_at, 5)
    assert waits == pytest.approx([0.02, 0.02, 0.02, 0.02, 0.01][:count])
    assert clock.time_s == pytest.approx(100.0 + min(0.02 * arrives_at, 0.09))
    assert link.served == count + 1
    if arrives_at > 5:
        assert item is None
    else:
        assert item == ((TOPIC, b"0") if call == "get" else Fragment(TOPIC, SOURCE, 0, 3, b"0"))
