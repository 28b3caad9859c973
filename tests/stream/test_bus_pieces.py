"""How payloads are cut into numbered pieces, held, asked for and put together again."""

import json
import random
from typing import Any

import pytest

from twin.stream.resend import Inbox, Parcel
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
    ],
)
def test_an_answer_that_is_none_is_ignored(stamp: bytes) -> None:
    inbox = Inbox(Asked(), (TOPIC,), True, 10)
    inbox.arrive("", Bytes(stamp), Bytes(b"abc"))
    assert inbox.get(0.0) is None
    assert inbox.ignored == 1


def test_an_answer_about_another_topic_is_nobodys() -> None:
    link = Asked()
    inbox = Inbox(link, (TOPIC,), True, 10)
    said = [["/run/stop", SOURCE, 0, 1, [[3, 3]]], [TOPIC, SOURCE, 0, 1, [[3, 2]]]]
    inbox.arrive("", Bytes(json.dumps(said).encode()), Bytes(b"abcde"))
    assert inbox.get(0.0) == (TOPIC, b"de")
    assert inbox.get(0.0) is None


def test_a_piece_that_comes_twice_is_taken_once() -> None:
    inbox = Inbox(Asked(), (TOPIC,), True, 10)
    for number in (0, 1, 0, 1, 2):
        piece = Piece(TOPIC, SOURCE, number, 3, bytes([number]))
        inbox.arrive(TOPIC, Bytes(piece.stamp), Bytes(piece.body))
    got = [inbox.get(0.0) for _ in range(4)]
    assert got == [(TOPIC, b"\0"), (TOPIC, b"\1"), (TOPIC, b"\2"), None]
