"""A twin outside the gate: what is let in of what it offers, and what others may not."""

import itertools
import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from table_io.block import Block
from table_io.records import Comparison, Event, Fault, Params, RunStop, Timing
from twin.service import gate as gates
from twin.service import twinning
from twin.service.attending import attend_as_twin
from twin.service.offers import AHEAD, MOST_BEGUN, MOST_PIECES, Offers, offered
from twin.service.spec import Spec
from twin.stream.endpoint import key
from twin.stream.shelf import PIECE_BYTES, STAMP, Piece, Shelf, pieces
from twin.stream.wire import CMP_TOPIC, MEAS_TOPIC, Item, decode, encode, topic
from twin.stream.zenoh_link import Link, open_spoke

from .test_gate import BUNDLE, CAPACITY, PATIENCE_S, RIG, RUN, Door, Rig, joined, took, until
from .test_gate import spec as spec_of_a_run

KINDS = frozenset(("drift", "no jump"))
RATE_HZ = BUNDLE.drive.rate_hz
SIZE = BUNDLE.profile.acquisition.block_samples
END = 5000
PARAMS = Params(0, {"stiffness": 1.0}, "x")
TIMING = Timing(0, "twin", 0, 0, 0, 0, 0, 0, "")
COMPARED = Comparison(END + AHEAD - 1, 2, (), (), (), ())

spec = spec_of_a_run


def measured(number: int) -> Block:
    """At rest."""
    rest = np.zeros(SIZE, dtype=np.int64)
    values = np.zeros((len(BUNDLE.rig.channels), SIZE))
    return Block("meas", number * SIZE, RATE_HZ, BUNDLE.rig.channels, values, rest, rest, rest)


@pytest.mark.parametrize(
    ("item", "taken"),
    [
        (PARAMS, True),
        (replace(PARAMS, index=END + AHEAD), True),
        (replace(PARAMS, index=END + AHEAD + 1), False),
        (replace(PARAMS, index=2**50), False),
        (COMPARED, False),
        (replace(COMPARED, count=1), True),
        (Fault(0, "twin", 0, 2**50, "x"), False),
        (Fault(10, "twin", 0, 10, "it joined late"), True),
        (Fault(10, "recorder", 0, 10, "x"), False),
        (TIMING, True),
        (replace(TIMING, component="rig"), False),
        (Event(0, "drift", "of the stiffness, 5 % ± 1 %"), True),
        (Event(0, "drift", "\x1b[2J"), False),
        (Event(0, "drift", "x" * 1001), False),
        (Event(0, "state", "running"), False),
        (Event(0, "order", "stop: by anna"), False),
    ],
)
def test_of_a_twin_outside_only_what_a_twin_says_is_taken(item: Item, taken: bool) -> None:
    name = topic(item)
    assert offered(name, encode(item, RUN), RUN, END, KINDS) == taken
    assert not offered(name, encode(item, "another"), RUN, END, KINDS)
    assert not offered(name, b"garbage", RUN, END, KINDS)


class Lying:
    """An inbox in which these pieces lie."""

    def __init__(self, *there: Piece) -> None:
        self.there = list(there)

    def piece(self, _: float) -> Piece | None:
        return self.there.pop(0) if self.there else None


def offers(*there: Piece) -> Offers:
    inbox: Any = Lying(*there)
    return Offers(inbox, RUN, KINDS)


def parts(source: str, reason: str = "x", number: int = 0) -> list[Piece]:
    return list(pieces("/twin/params", source, number, encode(replace(PARAMS, reason=reason), RUN)))


def test_nobody_outside_speaks_under_a_name_of_the_run() -> None:
    mine, theirs = parts("aa"), parts("bb")
    some = offers(*theirs, *mine, *theirs)
    some.inside.add("bb")
    assert [some.take(END) for _ in range(4)] == [[], mine, [], None]


def test_who_was_let_in_is_let_in_further() -> None:
    first, second = parts("aa"), parts("aa", number=1)
    some = offers(*first, *second)
    assert some.take(END) == first
    some.inside.add("aa")
    assert some.take(END) == second


def test_a_payload_in_pieces_is_let_in_whole_or_not_at_all() -> None:
    whole = parts("aa", "x" * 2 * PIECE_BYTES)
    after = parts("aa", "y" * PIECE_BYTES, number=7)
    some = offers(*whole, whole[0], whole[2], *whole[1:], *after)
    assert [some.take(END) for _ in range(9)] == [[], [], whole, [], [], [], [], [], after]


def test_beginnings_without_an_end_are_forgotten() -> None:
    long = parts("aa", "x" * MOST_PIECES * PIECE_BYTES)
    begun = [parts(f"{n:04x}", "x" * PIECE_BYTES)[0] for n in range(2 * MOST_BEGUN)]
    some = offers(*long, *begun)
    while some.take(END) is not None:
        assert len(some._begun) <= MOST_BEGUN
    assert "aa" not in some._outside


@pytest.fixture(scope="module")
def rig(spec: Spec) -> Iterator[Rig]:
    """A rig, and a gate that takes offers; the first blocks are played."""
    one = Rig(replace(spec, remote_twin=True))
    thread = threading.Thread(target=one.play)
    thread.start()
    assert one.ready.wait(PATIENCE_S)
    start = BUNDLE.describe(RUN, "table")({}, 0.0)
    one.waiting += [(topic(item), encode(item, RUN)) for item in (start, measured(0))]
    with pytest.MonkeyPatch.context() as patch:
        doors: list[Door] = []
        patch.setattr(os, "nice", lambda _: 0)
        patch.setattr(gates, "orphaned", lambda: bool(doors) and doors[-1].shut.is_set())
        patch.setattr(gates, "QUIET_S", 0.2)
        doors.append(Door(one.spec))
        yield one
        doors[-1].close()
    one.over.set()
    thread.join()


@contextmanager
def serving(*links: Link) -> Iterator[None]:
    """Publishers that have nothing more to say answer those who ask; closed in the end."""
    over = threading.Event()

    def serve() -> None:
        while not over.wait(0.002):
            for link in links:
                link.serve()

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
        for link in links:
            link.close()


def test_a_twin_outside_is_heard_inside_and_by_everybody_once(rig: Rig) -> None:
    twin, listener = joined(rig.spec), joined(rig.spec)
    inside = open_spoke(RIG, rig.spec.endpoint, PATIENCE_S)
    topics = ("/twin/params", "/run/timing", "/run/event")
    inboxes = [
        link.subscribe(topics, history=True, capacity=CAPACITY) for link in (inside, listener)
    ]
    twin.declare(topics, offered=True)
    said: list[Item] = [replace(PARAMS, index=n, reason="x" * 60_000) for n in range(5)]
    said += [TIMING, Event(0, "drift", "of the stiffness")]
    twin.publish("/twin/params", b"garbage")
    far = [replace(PARAMS, index=2**50), replace(TIMING, component="rig"), Event(0, "order", "")]
    for item in (*far, *said):
        twin.publish(topic(item), encode(item, RUN))
    with serving(twin):
        heard = [took(inbox, len(said)) for inbox in inboxes]
        rest = [inbox.get(0.3) for inbox in inboxes]
    for one in heard:
        assert sorted(one) == sorted((topic(item), encode(item, RUN)) for item in said)
    assert rest == [None, None]
    inside.close()
    listener.close()


def test_under_the_rigs_name_nobody_silences_it(rig: Rig) -> None:
    """Its name stands beside every sample that it publishes."""
    inside, observer, forger = (
        open_spoke(RIG, where, PATIENCE_S)
        for where in (rig.spec.endpoint, rig.spec.listen, rig.spec.listen)
    )
    name = "/run/timing"
    supervisor = inside.subscribe((name,), history=True, capacity=CAPACITY)
    stamps: list[bytes] = []
    observer._session.declare_subscriber(
        key(RIG, name), lambda one: stamps.append(one.attachment.to_bytes())
    )
    own = [encode(replace(TIMING, component="rig", index=n), RUN) for n in range(4)]
    while not stamps:
        rig.waiting.append((name, own[0]))
        time.sleep(0.05)
    source, _, _ = STAMP.unpack(stamps[-1])
    forger.declare((name,), offered=True)
    shelf = Shelf()
    shelf.add(10**9, 3, encode(TIMING, RUN))
    forger._shelves[name, source.hex()] = shelf
    put = forger._session.put
    with serving(forger):
        for where in (key(RIG, name), key(RIG, name, offered=True)):
            put(where, encode(TIMING, RUN), attachment=STAMP.pack(source, 10**9, 3))
        time.sleep(0.7)  # in which the gate asks what is on offer
        rig.waiting += [(name, one) for one in own[1:]]
        until(lambda: not rig.waiting)
        heard = [one[1] for one in iter(lambda: supervisor.get(0.2), None)]
    assert [one for one in heard if one in own[1:]] == own[1:]
    assert supervisor.missed == 0
    for link in (inside, observer):
        link.close()


def test_a_twin_answers_nobody_but_the_gate(rig: Rig) -> None:
    victim, twin = joined(rig.spec), joined(rig.spec)
    inbox = victim.subscribe((MEAS_TOPIC,), history=True, capacity=CAPACITY)
    there = len([one for one in rig.sent if one[0] == MEAS_TOPIC])
    assert len(took(inbox, there)) == there
    ((_, source), _), *_ = inbox._sources.items()
    for offering in (True, False):
        liar = joined(rig.spec) if not offering else twin
        liar.declare(("/twin/params",), offered=offering)
        shelf = Shelf()
        shelf.add(there, 3, b"forged")
        liar._shelves[MEAS_TOPIC, source] = shelf
        with serving(liar):
            assert inbox.get(0.7) is None
    victim.close()


def test_a_twin_that_comes_after_another_says_what_is_missing(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`attend twin` from its start to the end of the run; it reads no standard input."""
    monkeypatch.setattr(twinning, "LINGER_S", 0.3)
    monkeypatch.setattr(twinning, "urgent", lambda _: "")
    inside = open_spoke(RIG, rig.spec.endpoint, PATIENCE_S)
    topics = (CMP_TOPIC, "/run/fault", "/twin/params")
    inbox = inside.subscribe(topics, history=True, capacity=CAPACITY)
    inside.declare((CMP_TOPIC,))
    inside.publish(CMP_TOPIC, encode(Comparison(0, 3 * SIZE, (), (), (), ()), RUN))
    observer = joined(rig.spec)
    until(lambda: b'"compared": %d' % (3 * SIZE) in (observer.inquire("state/status") or b""))
    codes: list[int] = []
    thread = threading.Thread(
        target=lambda: codes.append(attend_as_twin(rig.spec.listen, RIG, None)), daemon=True
    )
    thread.start()
    heard: list[Item] = []
    for number in itertools.count(1):
        rig.waiting.append((MEAS_TOPIC, encode(measured(number), RUN)))
        if (one := inbox.get(0.01)) is not None:
            heard.append(decode(*one)[1])
        faults = [item for item in heard if isinstance(item, Fault)]
        if faults or number == 2000:
            break
    rig.waiting.append(
        ("/run/stop", encode(RunStop(faults[0].index + SIZE, "complete", "", ()), RUN))
    )
    rig.waiting.append((MEAS_TOPIC, encode(measured(number + 1), RUN)))
    thread.join(PATIENCE_S)
    assert codes == [0]
    (said,) = faults
    assert (said.component, said.from_index, said.to_index) == ("twin", 3 * SIZE, said.index)
    assert said.index % SIZE == 0
    observer.close()
    inside.close()
