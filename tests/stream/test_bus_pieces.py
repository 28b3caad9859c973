"""How payloads are cut into numbered pieces, held, asked for and put together again."""

import json
import random
from typing import Any

import pytest

from twin.stream.questions import ASKED_HELD_BYTES, asked_for, understood
from twin.stream.resend import MOST_OFFERING, Inbox, Parcel
from twin.stream.shelf import (
    ANSWERED_PIECES,
    ASKERS,
    PIECE_BYTES,
    Listeners,
    Piece,
    Shelf,
    answer,
    pieces,
)
from twin.stream.wire import TOPIC_TYPES

TOPIC, SOURCE = "/rig/meas", "00112233445566ff"


class Bytes(bytes):
    """As zenoh hands them over."""

    def to_bytes(self) -> bytes:  # type: ignore[override]
        return bytes(self)


class Asked:
    """Stands for a link: notes the questions."""

    def __init__(self) -> None:
        self.questions: list[dict[str, Any]] = []

    def serve(self) -> bool:
        return False

    def ask(self, question: dict[str, Any], _: Inbox) -> None:
        self.questions.append(question)


@pytest.mark.parametrize("size", [0, 1, PIECE_BYTES, PIECE_BYTES + 1, 5 * PIECE_BYTES])
def test_a_payload_in_pieces_is_whole_with_the_last_one(size: int) -> None:
    payload = random.Random(size).randbytes(size)
    parcel = Parcel()
    *before, last = pieces(TOPIC, SOURCE, 7, payload)
    assert [parcel.add(one) for one in before] == [None] * len(before)
    assert parcel.add(last) == payload
    assert last.number == 7 + len(before)
    assert len(last.stamp) == 17


def test_a_payload_that_lacks_a_piece_is_none_and_the_next_one_is_whole() -> None:
    parcel = Parcel()
    first, _, third = pieces(TOPIC, SOURCE, 0, bytes(3 * PIECE_BYTES))
    assert [parcel.add(first), parcel.add(third)] == [None, None]
    (after,) = pieces(TOPIC, SOURCE, 3, b"next")
    assert parcel.add(after) == b"next"


def test_an_answer_holds_no_more_than_fits_beside_what_tells_its_sizes() -> None:
    shelf = Shelf()
    for number in range(3000):
        shelf.add(number, 3, b"x")
    said, chunk = answer({(TOPIC, SOURCE): shelf}, {TOPIC: {SOURCE: 100}}, True)
    ((topic, source, first, end, sizes),) = said
    assert (topic, source, first, end) == (TOPIC, SOURCE, 100, 3000)
    assert len(sizes) == len(chunk) == ANSWERED_PIECES
    assert len(json.dumps(said)) + PIECE_BYTES < 2**16


def test_only_so_many_askers_are_kept_in_mind() -> None:
    listeners = Listeners()
    shelf = Shelf()
    shelf.add(0, 3, b"x")
    for number in range(ASKERS + 50):
        question = {"who": f"{number}", "history": True, "next": {TOPIC: {}}}
        listeners.note(question, {(TOPIC, SOURCE): shelf})
    assert len(listeners.heard) == ASKERS
    assert f"{ASKERS + 49}" in listeners.heard
    assert listeners.behind({(TOPIC, SOURCE): shelf}) == 1


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
    inbox = Inbox(Asked(), (TOPIC,), True, 10)
    inbox.arrive("", Bytes(stamp), Bytes(b"abc"))
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
        b"[" * ASKED_HELD_BYTES,
        b'{"a":' * 3_000,
        b'{"history": true, "next": 3}',
        b'{"history": true, "next": {"/rig/meas": 3}}',
        b'{"history": true, "next": {"/rig/meas": {"00ff": 1e999}}}',
        b'{"history": true, "next": {"/rig/meas": {"00ff": -1e999}}}',
        b'{"history": true, "next": {"/rig/meas": {"00ff": NaN}}}',
        b'{"history": true, "next": {"/rig/meas": {"00ff": [1]}}}',
        b'{"history": true, "next": {"/rig/meas": {"00ff": ' + b"9" * 5000 + b"}}}",
        b'{"history": true, "next": {}}' + b" " * ASKED_HELD_BYTES,
    ],
)
def test_a_question_that_is_none_is_not_understood(question: bytes) -> None:
    assert understood(question, ASKED_HELD_BYTES, asked_for) is None


def test_the_question_of_an_inbox_is_understood_after_many_deaths() -> None:
    link = Asked()
    inbox = Inbox(link, tuple(TOPIC_TYPES), True, 10_000)
    for publisher in range(14):
        for topic in TOPIC_TYPES:
            piece = Piece(topic, f"{publisher:016x}", 0, 3, b"")
            inbox.arrive(topic, Bytes(piece.stamp), Bytes(piece.body))
    while inbox.get(0.0) is not None:
        pass
    inbox._asked_at = float("-inf")
    inbox.get(0.0)
    question = link.questions[-1]
    text = json.dumps(question).encode()
    assert understood(text, ASKED_HELD_BYTES, asked_for) == question
    assert all(len(known) == 14 for known in question["next"].values())


@pytest.mark.parametrize("lie", [0, -1e30, -1, 2**63 - 1, 2**64, 10**400])
def test_who_lies_about_how_far_it_has_come_lacks_no_more_than_is_held(lie: float) -> None:
    listeners = Listeners()
    shelf = Shelf()
    for number in range(5, 15):
        shelf.add(number, 3, b"x")
    shelves = {(TOPIC, SOURCE): shelf}
    text = json.dumps({"who": "x", "history": True, "next": {TOPIC: {SOURCE: lie}}})
    question = understood(text.encode(), ASKED_HELD_BYTES, asked_for)
    assert question is not None
    listeners.note(question, shelves)
    lacks = 0 if lie > 0 else 10
    assert listeners.behind(shelves) == lacks
    assert len(answer(shelves, question["next"], True)[1]) == lacks


def test_an_answer_about_another_topic_is_nobodys() -> None:
    link = Asked()
    inbox = Inbox(link, (TOPIC,), True, 10)
    said = [["/run/stop", SOURCE, 0, 1, [[3, 3]]], [TOPIC, SOURCE, 0, 1, [[3, 2]]]]
    inbox.arrive("", Bytes(json.dumps(said).encode()), Bytes(b"abcde"))
    assert inbox.get(0.0) == (TOPIC, b"de")
    assert inbox.get(0.0) is None


def test_a_number_that_no_answer_can_tell_is_ignored() -> None:
    inbox = Inbox(Asked(), (TOPIC,), True, 10)
    for number in (0, 2**64 - 1, 2**63):
        piece = Piece(TOPIC, SOURCE, number, 3, b"x")
        inbox.arrive(TOPIC, Bytes(piece.stamp), Bytes(piece.body))
    assert inbox.get(0.0) == (TOPIC, b"x")
    assert inbox.get(0.0) is None
    assert (inbox.ignored, inbox.missed) == (2, 0)


def test_a_piece_that_comes_twice_is_taken_once() -> None:
    inbox = Inbox(Asked(), (TOPIC,), True, 10)
    for number in (0, 1, 0, 1, 2):
        piece = Piece(TOPIC, SOURCE, number, 3, bytes([number]))
        inbox.arrive(TOPIC, Bytes(piece.stamp), Bytes(piece.body))
    got = [inbox.get(0.0) for _ in range(4)]
    assert got == [(TOPIC, b"\0"), (TOPIC, b"\1"), (TOPIC, b"\2"), None]


def test_of_what_is_offered_ever_new_publishers_cost_nothing() -> None:
    link = Asked()
    inbox = Inbox(link, (TOPIC, "/run/stop"), True, 10, offered=True)
    honest = Piece("/run/stop", SOURCE, 0, 3, b"heard")
    inbox.arrive("/run/stop", Bytes(honest.stamp), Bytes(honest.body))
    assert inbox.get(0.0) == ("/run/stop", b"heard")
    for number in range(500):
        piece = Piece(TOPIC, f"{number:016x}", 0, 1, b"begun")
        inbox.arrive(TOPIC, Bytes(piece.stamp), Bytes(piece.body))
        assert inbox.get(0.0) is None
    said = [[TOPIC, f"{number:016x}", 0, 1, [[1, 1]]] for number in range(500, 900)]
    inbox.arrive("", Bytes(json.dumps(said).encode()), Bytes(bytes(400)))
    assert inbox.get(0.0) is None
    assert len(inbox._parcels) <= MOST_OFFERING + 1
    inbox._asked_at = float("-inf")
    assert inbox.get(0.0) is None
    assert len(link.questions[-1]["next"][TOPIC]) == MOST_OFFERING
    assert link.questions[-1]["next"]["/run/stop"] == {SOURCE: 1}
