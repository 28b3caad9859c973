"""How payloads are cut into numbered pieces, held, asked for and put together again."""

import json
import random
from typing import Any

import pytest

from twin.transport.codec import TOPIC_TYPES
from twin.transport.history_cache import (
    FRAGMENT_BYTES,
    MAX_REPLY_FRAGMENTS,
    MAX_SUBSCRIBERS,
    Fragment,
    HistoryCache,
    SubscriberProgress,
    build_history_reply,
    split_payload,
)
from twin.transport.reliable_subscriber import (
    MAX_OFFERING_PUBLISHERS,
    PayloadAssembly,
    ReliableSubscriber,
)
from twin.transport.requests import MAX_HISTORY_QUERY_BYTES, parse_history_query, parse_request

TOPIC, SOURCE = "/rig/meas", "00112233445566ff"


class Bytes(bytes):
    """As zenoh hands them over."""

    def to_bytes(self) -> bytes:
        return bytes(self)


class Asked:
    """Stands for a link: notes the questions."""

    def __init__(self) -> None:
        self.questions: list[dict[str, Any]] = []

    def serve(self) -> bool:
        return False

    def query_history(self, question: dict[str, Any], _: ReliableSubscriber) -> None:
        self.questions.append(question)


@pytest.mark.parametrize("size", [0, 1, FRAGMENT_BYTES, FRAGMENT_BYTES + 1, 5 * FRAGMENT_BYTES])
def test_a_payload_in_pieces_is_whole_with_the_last_one(size: int) -> None:
    payload = random.Random(size).randbytes(size)
    parcel = PayloadAssembly()
    *before, last = split_payload(TOPIC, SOURCE, 7, payload)
    assert [parcel.add(fragment) for fragment in before] == [None] * len(before)
    assert parcel.add(last) == payload
    assert last.sequence == 7 + len(before)
    assert len(last.header) == 17


def test_a_payload_that_lacks_a_piece_is_none_and_the_next_one_is_whole() -> None:
    parcel = PayloadAssembly()
    first, _, third = split_payload(TOPIC, SOURCE, 0, bytes(3 * FRAGMENT_BYTES))
    assert [parcel.add(first), parcel.add(third)] == [None, None]
    (after,) = split_payload(TOPIC, SOURCE, 3, b"next")
    assert parcel.add(after) == b"next"


def test_an_answer_holds_no_more_than_fits_beside_what_tells_its_sizes() -> None:
    shelf = HistoryCache()
    for number in range(3000):
        shelf.add(number, 3, b"x")
    header, chunk = build_history_reply({(TOPIC, SOURCE): shelf}, {TOPIC: {SOURCE: 100}}, True)
    ((topic, source, first, end, sizes),) = header
    assert (topic, source, first, end) == (TOPIC, SOURCE, 100, 3000)
    assert len(sizes) == len(chunk) == MAX_REPLY_FRAGMENTS
    assert len(json.dumps(header)) + FRAGMENT_BYTES < 2**16


def test_only_so_many_askers_are_kept_in_mind() -> None:
    listeners = SubscriberProgress()
    shelf = HistoryCache()
    shelf.add(0, 3, b"x")
    for number in range(MAX_SUBSCRIBERS + 50):
        question = {"who": f"{number}", "history": True, "next": {TOPIC: {}}}
        listeners.record_query(question, {(TOPIC, SOURCE): shelf})
    assert len(listeners.positions) == MAX_SUBSCRIBERS
    assert f"{MAX_SUBSCRIBERS + 49}" in listeners.positions
    assert listeners.max_lag({(TOPIC, SOURCE): shelf}) == 1


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
def test_an_answer_that_is_none_is_ignored(stamp: bytes) -> None:
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
def test_a_question_that_is_none_is_not_understood(question: bytes) -> None:
    assert parse_request(question, MAX_HISTORY_QUERY_BYTES, parse_history_query) is None


def test_the_question_of_an_inbox_is_understood_after_many_deaths() -> None:
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
    text = json.dumps(question).encode()
    assert parse_request(text, MAX_HISTORY_QUERY_BYTES, parse_history_query) == question
    assert all(len(known) == 14 for known in question["next"].values())


@pytest.mark.parametrize("lie", [0, -1e30, -1, 2**63 - 1, 2**64, 10**400])
def test_who_lies_about_how_far_it_has_come_lacks_no_more_than_is_held(lie: float) -> None:
    listeners = SubscriberProgress()
    shelf = HistoryCache()
    for number in range(5, 15):
        shelf.add(number, 3, b"x")
    shelves = {(TOPIC, SOURCE): shelf}
    text = json.dumps({"who": "x", "history": True, "next": {TOPIC: {SOURCE: lie}}})
    question = parse_request(text.encode(), MAX_HISTORY_QUERY_BYTES, parse_history_query)
    assert question is not None
    listeners.record_query(question, shelves)
    lacks = 0 if lie > 0 else 10
    assert listeners.max_lag(shelves) == lacks
    assert len(build_history_reply(shelves, question["next"], True)[1]) == lacks


def test_an_answer_about_another_topic_is_nobodys() -> None:
    link = Asked()
    inbox = ReliableSubscriber(link, (TOPIC,), True, 10)
    header = [["/run/stop", SOURCE, 0, 1, [[3, 3]]], [TOPIC, SOURCE, 0, 1, [[3, 2]]]]
    inbox.handle_sample("", Bytes(json.dumps(header).encode()), Bytes(b"abcde"))
    assert inbox.get(0.0) == (TOPIC, b"de")
    assert inbox.get(0.0) is None


def test_a_number_that_no_answer_can_tell_is_ignored() -> None:
    inbox = ReliableSubscriber(Asked(), (TOPIC,), True, 10)
    for number in (0, 2**64 - 1, 2**63):
        piece = Fragment(TOPIC, SOURCE, number, 3, b"x")
        inbox.handle_sample(TOPIC, Bytes(piece.header), Bytes(piece.body))
    assert inbox.get(0.0) == (TOPIC, b"x")
    assert inbox.get(0.0) is None
    assert (inbox.ignored, inbox.missed) == (2, 0)


def test_a_piece_that_comes_twice_is_taken_once() -> None:
    inbox = ReliableSubscriber(Asked(), (TOPIC,), True, 10)
    for number in (0, 1, 0, 1, 2):
        piece = Fragment(TOPIC, SOURCE, number, 3, bytes([number]))
        inbox.handle_sample(TOPIC, Bytes(piece.header), Bytes(piece.body))
    got = [inbox.get(0.0) for _ in range(4)]
    assert got == [(TOPIC, b"\0"), (TOPIC, b"\1"), (TOPIC, b"\2"), None]


def test_of_what_is_offered_ever_new_publishers_cost_nothing() -> None:
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
    assert len(link.questions[-1]["next"][TOPIC]) == MAX_OFFERING_PUBLISHERS
    assert link.questions[-1]["next"]["/run/stop"] == {SOURCE: 1}
