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
from tests.live.test_gateway import (
    BUNDLE,
    PATIENCE_S,
    QUEUE_CAPACITY,
    RIG,
    RUN,
    Door,
    Rig,
    connect,
    took,
    until,
)
from tests.live.test_gateway import spec as spec_of_a_run
from twin.live import gateway as gates
from twin.live import twin_process
from twin.live.join import join_as_twin
from twin.live.process_config import ProcessConfig
from twin.live.remote_twin import (
    MAX_LEAD_SAMPLES,
    MAX_PARTIAL_PAYLOADS,
    MAX_PAYLOAD_FRAGMENTS,
    OfferFilter,
    is_valid_offer,
)
from twin.transport.codec import Item, decode_item, encode_item, topic_for
from twin.transport.endpoint import CMP_TOPIC, MEAS_TOPIC, key_expression
from twin.transport.history_cache import (
    FRAGMENT_BYTES,
    FRAGMENT_HEADER,
    Fragment,
    HistoryCache,
    split_payload,
)
from twin.transport.zenoh_link import BusLink, open_spoke

KINDS = frozenset(("drift", "no jump"))
RATE_HZ = BUNDLE.drive.rate_hz
SIZE = BUNDLE.profile.acquisition.block_samples
END_SAMPLE = 5000
PARAMS = Params(0, {"stiffness": 1.0}, "x")
TIMING = Timing(0, "twin", 0, 0, 0, 0, 0, 0, "")
COMPARED = Comparison(END_SAMPLE + MAX_LEAD_SAMPLES - 1, 2, (), (), (), ())

spec = spec_of_a_run


def make_block_at_rest(number: int) -> Block:
    """At rest."""
    rest = np.zeros(SIZE, dtype=np.int64)
    values = np.zeros((len(BUNDLE.rig.channels), SIZE))
    return Block("meas", number * SIZE, RATE_HZ, BUNDLE.rig.channels, values, rest, rest, rest)


@pytest.mark.parametrize(
    ("item", "taken"),
    [
        (PARAMS, True),
        (replace(PARAMS, index=END_SAMPLE + MAX_LEAD_SAMPLES), True),
        (replace(PARAMS, index=END_SAMPLE + MAX_LEAD_SAMPLES + 1), False),
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
def test_is_valid_offer_takes_only_output_of_a_twin(item: Item, taken: bool) -> None:
    name = topic_for(item)
    assert is_valid_offer(name, encode_item(item, RUN), RUN, END_SAMPLE, KINDS) == taken
    assert not is_valid_offer(name, encode_item(item, "another"), RUN, END_SAMPLE, KINDS)
    assert not is_valid_offer(name, b"garbage", RUN, END_SAMPLE, KINDS)


class Lying:
    """An inbox in which these pieces lie."""

    def __init__(self, *fragments: Fragment) -> None:
        self.fragments = list(fragments)

    def get_fragment(self, _: float) -> Fragment | None:
        return self.fragments.pop(0) if self.fragments else None


def offers(*fragments: Fragment) -> OfferFilter:
    inbox: Any = Lying(*fragments)
    return OfferFilter(inbox, RUN, KINDS)


def parts(source: str, reason: str = "x", number: int = 0) -> list[Fragment]:
    return list(
        split_payload(
            "/twin/params", source, number, encode_item(replace(PARAMS, reason=reason), RUN)
        )
    )


def test_offers_under_a_name_of_the_run_are_refused() -> None:
    mine, theirs = parts("aa"), parts("bb")
    some = offers(*theirs, *mine, *theirs)
    some.run_publishers.add("bb")
    assert [some.take(END_SAMPLE) for _ in range(4)] == [[], mine, [], None]


def test_accepted_twin_stays_accepted() -> None:
    first, second = parts("aa"), parts("aa", number=1)
    some = offers(*first, *second)
    assert some.take(END_SAMPLE) == first
    some.run_publishers.add("aa")
    assert some.take(END_SAMPLE) == second


def test_fragmented_offer_is_taken_whole_or_not_at_all() -> None:
    whole = parts("aa", "x" * 2 * FRAGMENT_BYTES)
    after = parts("aa", "y" * FRAGMENT_BYTES, number=7)
    some = offers(*whole, whole[0], whole[2], *whole[1:], *after)
    assert [some.take(END_SAMPLE) for _ in range(9)] == [[], [], whole, [], [], [], [], [], after]


def test_incomplete_offers_are_bounded() -> None:
    long = parts("aa", "x" * MAX_PAYLOAD_FRAGMENTS * FRAGMENT_BYTES)
    begun = [parts(f"{n:04x}", "x" * FRAGMENT_BYTES)[0] for n in range(2 * MAX_PARTIAL_PAYLOADS)]
    some = offers(*long, *begun)
    while some.take(END_SAMPLE) is not None:
        assert len(some._partial_payloads) <= MAX_PARTIAL_PAYLOADS
    assert "aa" not in some._twin_publishers


@pytest.fixture(scope="module")
def rig(spec: ProcessConfig) -> Iterator[Rig]:
    """A rig, and a gate that takes offers; the first blocks are played."""
    played = Rig(replace(spec, remote_twin=True))
    thread = threading.Thread(target=played.play)
    thread.start()
    assert played.ready.wait(PATIENCE_S)
    start = BUNDLE.make_start_factory(RUN, "table")({}, 0.0)
    played.waiting += [
        (topic_for(item), encode_item(item, RUN)) for item in (start, make_block_at_rest(0))
    ]
    with pytest.MonkeyPatch.context() as patch:
        doors: list[Door] = []
        patch.setattr(os, "nice", lambda _: 0)
        patch.setattr(gates, "is_orphaned", lambda: bool(doors) and doors[-1].shut.is_set())
        patch.setattr(gates, "MAX_QUIET_S", 0.2)
        doors.append(Door(played.spec))
        yield played
        doors[-1].close()
    played.over.set()
    thread.join()


@contextmanager
def serving(*links: BusLink) -> Iterator[None]:
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


def test_remote_twin_is_relayed_once_to_both_buses(rig: Rig) -> None:
    twin, listener = connect(rig.spec), connect(rig.spec)
    inside = open_spoke(RIG, rig.spec.endpoint, PATIENCE_S)
    topics = ("/twin/params", "/run/timing", "/run/event")
    inboxes = [
        link.subscribe(topics, history=True, capacity=QUEUE_CAPACITY) for link in (inside, listener)
    ]
    twin.declare(topics, offered=True)
    latest: list[Item] = [replace(PARAMS, index=n, reason="x" * 60_000) for n in range(5)]
    latest += [TIMING, Event(0, "drift", "of the stiffness")]
    twin.publish("/twin/params", b"garbage")
    far: list[Item] = [
        replace(PARAMS, index=2**50),
        replace(TIMING, component="rig"),
        Event(0, "order", ""),
    ]
    for item in (*far, *latest):
        twin.publish(topic_for(item), encode_item(item, RUN))
    with serving(twin):
        received = [took(inbox, len(latest)) for inbox in inboxes]
        rest = [inbox.get(0.3) for inbox in inboxes]
    for messages in received:
        assert sorted(messages) == sorted(
            (topic_for(item), encode_item(item, RUN)) for item in latest
        )
    assert rest == [None, None]
    inside.close()
    listener.close()


def test_forged_sequence_numbers_do_not_silence_the_rig(rig: Rig) -> None:
    """Its name stands beside every sample that it publishes."""
    inside, observer, forger = (
        open_spoke(RIG, where, PATIENCE_S)
        for where in (rig.spec.endpoint, rig.spec.listen, rig.spec.listen)
    )
    name = "/run/timing"
    supervisor = inside.subscribe((name,), history=True, capacity=QUEUE_CAPACITY)
    stamps: list[bytes] = []
    observer._session.declare_subscriber(
        key_expression(RIG, name), lambda sample: stamps.append(sample.attachment.to_bytes())
    )
    own = [encode_item(replace(TIMING, component="rig", index=n), RUN) for n in range(4)]
    while not stamps:
        rig.waiting.append((name, own[0]))
        time.sleep(0.05)
    source, _, _ = FRAGMENT_HEADER.unpack(stamps[-1])
    forger.declare((name,), offered=True)
    shelf = HistoryCache()
    shelf.add(10**9, 3, encode_item(TIMING, RUN))
    forger._caches[name, source.hex()] = shelf
    put = forger._session.put
    with serving(forger):
        for where in (key_expression(RIG, name), key_expression(RIG, name, offered=True)):
            put(where, encode_item(TIMING, RUN), attachment=FRAGMENT_HEADER.pack(source, 10**9, 3))
        time.sleep(0.7)  # in which the gate asks what is on offer
        rig.waiting += [(name, payload) for payload in own[1:]]
        until(lambda: not rig.waiting)
        payloads = [message[1] for message in iter(lambda: supervisor.get(0.2), None)]
    assert [payload for payload in payloads if payload in own[1:]] == own[1:]
    assert supervisor.missed == 0
    for link in (inside, observer):
        link.close()


def test_remote_twin_answers_only_the_gateway(rig: Rig) -> None:
    victim, twin = connect(rig.spec), connect(rig.spec)
    inbox = victim.subscribe((MEAS_TOPIC,), history=True, capacity=QUEUE_CAPACITY)
    sent_count = len([message for message in rig.sent if message[0] == MEAS_TOPIC])
    assert len(took(inbox, sent_count)) == sent_count
    ((_, source), _), *_ = inbox._positions.items()
    for offering in (True, False):
        liar = connect(rig.spec) if not offering else twin
        liar.declare(("/twin/params",), offered=offering)
        shelf = HistoryCache()
        shelf.add(sent_count, 3, b"forged")
        liar._caches[MEAS_TOPIC, source] = shelf
        with serving(liar):
            assert inbox.get(0.7) is None
    victim.close()


def test_second_remote_twin_publishes_a_fault(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """`attend twin` from its start to the end of the run; it reads no standard input."""
    monkeypatch.setattr(twin_process, "LINGER_S", 0.3)
    monkeypatch.setattr(twin_process, "request_realtime", lambda _: "")
    inside = open_spoke(RIG, rig.spec.endpoint, PATIENCE_S)
    topics = (CMP_TOPIC, "/run/fault", "/twin/params")
    inbox = inside.subscribe(topics, history=True, capacity=QUEUE_CAPACITY)
    inside.declare((CMP_TOPIC,))
    inside.publish(CMP_TOPIC, encode_item(Comparison(0, 3 * SIZE, (), (), (), ()), RUN))
    observer = connect(rig.spec)
    until(lambda: b'"compared": %d' % (3 * SIZE) in (observer.query("state/status") or b""))
    codes: list[int] = []
    thread = threading.Thread(
        target=lambda: codes.append(join_as_twin(rig.spec.listen, RIG, None)), daemon=True
    )
    thread.start()
    items: list[Item] = []
    for number in itertools.count(1):
        rig.waiting.append((MEAS_TOPIC, encode_item(make_block_at_rest(number), RUN)))
        if (message := inbox.get(0.01)) is not None:
            items.append(decode_item(*message)[1])
        faults = [item for item in items if isinstance(item, Fault)]
        if faults or number == 2000:
            break
    rig.waiting.append(
        ("/run/stop", encode_item(RunStop(faults[0].index + SIZE, "complete", "", ()), RUN))
    )
    rig.waiting.append((MEAS_TOPIC, encode_item(make_block_at_rest(number + 1), RUN)))
    thread.join(PATIENCE_S)
    assert codes == [0]
    (fault,) = faults
    assert (fault.component, fault.from_index, fault.to_index) == ("twin", 3 * SIZE, fault.index)
    assert fault.index % SIZE == 0
    observer.close()
    inside.close()
