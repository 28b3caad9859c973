"""The gate between a run and whoever watches it: what comes out, what is let in."""

import json
import os
import random
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet

from table_io.config.base import PROFILES_DIR
from table_io.records import Event, RunStop
from tests.builders.ports import free_endpoint
from twin.live import gateway as gates
from twin.live.control import send_command
from twin.live.gateway import (
    MAX_REFUSAL_BURST,
    REFUSAL_INTERVAL_S,
    RefusalLimiter,
    validate_command,
)
from twin.live.process_config import ProcessConfig, process_token
from twin.setup.run_config import read_run_config
from twin.system.files import SOCKET_PREFIX, make_private_folder
from twin.transport.codec import TOPIC_TYPES, decode_item, encode_item
from twin.transport.endpoint import LOCAL_SOCKET_PREFIX, MEAS_TOPIC, key_expression, list_runs
from twin.transport.reliable_subscriber import ReliableSubscriber
from twin.transport.zenoh_link import MAX_OBSERVERS, BusLink, open_hub, open_spoke

RUN = "20260101-120000-quickstart"
PATIENCE_S = 20.0
BUNDLE = read_run_config(PROFILES_DIR / "tests" / "quickstart.toml")
RIG = BUNDLE.rig.name
QUEUE_CAPACITY = 100_000


@dataclass
class Rig:
    """Stands for the rig, in a thread: publishes numbered payloads, answers, notes its orders."""

    spec: ProcessConfig
    sent: list[tuple[str, bytes]] = field(default_factory=list)
    orders: list[tuple[str, str]] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    waiting: list[tuple[str, bytes]] = field(default_factory=list)
    over: threading.Event = field(default_factory=threading.Event)
    ready: threading.Event = field(default_factory=threading.Event)

    def play(self) -> None:
        link = open_hub(RIG, self.spec.endpoint)
        link.declare(tuple(TOPIC_TYPES))
        commands = link.declare_commands()
        events = link.subscribe(("/run/event",), history=True, capacity=QUEUE_CAPACITY)
        link.declare_alive(process_token(self.spec, "rig"))
        self.ready.set()
        while not self.over.is_set():
            if self.waiting:
                item = self.waiting.pop(0)
                self.sent.append(item)
                link.publish(*item)
            if (order := commands.poll()) is not None:
                self.orders.append((order.name, order.text))
                order.reply("yes")
            if (message := events.get(0.001)) is not None:
                event = decode_item(*message)[1]
                assert isinstance(event, Event)
                self.events.append(event)
        link.close()


def until(true: Callable[[], object]) -> None:
    """Return once it is so."""
    end = time.monotonic() + PATIENCE_S
    while not true():
        assert time.monotonic() < end, "it never came"
        time.sleep(0.005)


@pytest.fixture(scope="module")
def spec() -> Iterator[ProcessConfig]:
    room = make_private_folder(SOCKET_PREFIX)
    listen = free_endpoint()
    texts = (BUNDLE.profile_toml, BUNDLE.rig_toml, BUNDLE.model_toml)
    yield ProcessConfig(
        RUN, "quickstart", "", listen, *texts, endpoint=f"{LOCAL_SOCKET_PREFIX}{room / 'bus'}"
    )
    room.rmdir()


@pytest.fixture(scope="module")
def rig(spec: ProcessConfig) -> Iterator[Rig]:
    played = Rig(spec)
    thread = threading.Thread(target=played.play)
    thread.start()
    assert played.ready.wait(PATIENCE_S)
    start = BUNDLE.make_start_factory(RUN, "table")({}, 0.0)
    played.waiting += [("/run/start", encode_item(start, RUN))]
    yield played
    played.over.set()
    thread.join()


class Door:
    """A gate in a thread, which can be shut."""

    def __init__(self, spec: ProcessConfig) -> None:
        self.shut = threading.Event()
        self.thread = threading.Thread(target=gates.run_gateway, args=(spec, ""))
        self.thread.start()

    def close(self) -> None:
        self.shut.set()
        self.thread.join()


@pytest.fixture(scope="module")
def doors() -> Iterator[list[Door]]:
    doors: list[Door] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "nice", lambda _: 0)
        patch.setattr(gates, "is_orphaned", lambda: bool(doors) and doors[-1].shut.is_set())
        patch.setattr(gates, "MAX_QUIET_S", 0.2)
        yield doors


@pytest.fixture(scope="module")
def door(spec: ProcessConfig, rig: Rig, doors: list[Door]) -> Iterator[list[Door]]:
    doors.append(Door(spec))
    yield doors
    doors[-1].close()


@pytest.fixture
def observer(spec: ProcessConfig, door: list[Door]) -> Iterator[BusLink]:
    link = connect(spec)
    yield link
    link.close()


def connect(spec: ProcessConfig) -> BusLink:
    """Connected, once the gate is there and shows the rig."""
    link = open_spoke(RIG, spec.listen, PATIENCE_S)
    until(lambda: process_token(spec, "rig") in link.list_components())
    return link


def took(inbox: ReliableSubscriber, count: int) -> list[tuple[str, bytes]]:
    got: list[tuple[str, bytes]] = []
    end = time.monotonic() + PATIENCE_S
    while len(got) < count and time.monotonic() < end:
        if (message := inbox.get(0.05)) is not None:
            got.append(message)
    return got


def wait_until_delivered(rig: Rig, inbox: ReliableSubscriber) -> None:
    """Return once events reach `inbox`: without history, what a new subscriber misses is lost."""

    def is_delivered() -> bool:
        rig.waiting += [("/run/event", encode_item(Event(0, "state", "start"), RUN))]
        return inbox.get(0.05) is not None

    until(is_delivered)
    until(lambda: not rig.waiting)
    while inbox.get(0.5) is not None:
        pass


def test_gateway_relays_bytes_unchanged(observer: BusLink, rig: Rig, spec: ProcessConfig) -> None:
    random.seed(1)
    sizes = [10, 2500, 48 * 2**10, 200_000, 0]
    rig.waiting += [(MEAS_TOPIC, random.randbytes(size)) for size in sizes]
    until(lambda: not rig.waiting)
    sent = [sent for sent in rig.sent if sent[0] in (MEAS_TOPIC, "/run/start")]
    inbox = observer.subscribe((MEAS_TOPIC, "/run/start"), history=True, capacity=QUEUE_CAPACITY)
    got = took(inbox, len(sent))
    assert sorted(got) == sorted(sent)
    assert [message for message in got if message[0] == MEAS_TOPIC] == [
        message for message in sent if message[0] == MEAS_TOPIC
    ]


def test_restarted_gateway_leaves_no_gap_and_no_duplicate(
    observer: BusLink, rig: Rig, spec: ProcessConfig, door: list[Door]
) -> None:
    before = len([sent for sent in rig.sent if sent[0] == "/twin/cmp"])
    inbox = observer.subscribe(("/twin/cmp",), history=True, capacity=QUEUE_CAPACITY)
    numbered = [("/twin/cmp", number.to_bytes(4, "big")) for number in range(60)]
    rig.waiting += numbered[:20]
    got = took(inbox, before + 20)
    door[-1].close()
    rig.waiting += numbered[20:40]
    until(lambda: not rig.waiting)
    door.append(Door(spec))
    rig.waiting += numbered[40:]
    got += took(inbox, 40)
    assert got[before:] == numbered
    assert inbox.get(1.0) is None
    assert inbox.missed == 0


def test_status_and_configuration_answer(observer: BusLink, rig: Rig) -> None:
    def request(path: str) -> bytes:
        answer = observer.query(path, timeout_s=PATIENCE_S)
        assert answer is not None
        return answer

    until(lambda: "steps" in json.loads(request("config/run")))
    run = json.loads(request("config/run"))
    assert run["run"] == RUN
    assert len(run["steps"]) == len(BUNDLE.steps)
    assert "profile_toml" not in run
    assert request("config/profile").decode() == BUNDLE.profile_toml
    assert request("config/rig").decode() == BUNDLE.rig_toml
    assert request("config/model").decode() == BUNDLE.model_toml
    names = [file.name for file in FileDescriptorSet.FromString(request("config/schema")).file]
    assert names == ["shaketwin.proto"]
    assert request("state/role/anna") == b"command"
    rig.waiting += [("/run/event", encode_item(Event(0, "state", "running"), RUN))]
    until(lambda: json.loads(request("state/status"))["state"] == "running")
    status = json.loads(request("state/status"))
    assert status["run"] == RUN
    assert process_token(rig.spec, "rig") in status["components"]
    assert status["verdict"] is None


def test_observer_is_listed_while_connected(observer: BusLink, spec: ProcessConfig) -> None:
    other = connect(spec)
    other.declare_alive("observer.anna.monitor")
    other.declare_alive("observer.\x1b[2J")
    until(lambda: "observer.??2J" in observer.list_components())
    until(lambda: "observer.anna.monitor" in observer.list_components())
    answer = observer.query("state/status", timeout_s=PATIENCE_S)
    assert answer is not None
    assert json.loads(answer)["observers"] == ["observer.??2J", "observer.anna.monitor"]
    other.close()
    until(lambda: "observer.anna.monitor" not in observer.list_components())


def test_component_is_listed_outside_until_it_dies(observer: BusLink, spec: ProcessConfig) -> None:
    inside = open_spoke(RIG, spec.endpoint, PATIENCE_S)
    inside.declare_alive(process_token(spec, "viewer"))
    until(lambda: process_token(spec, "viewer") in observer.list_components())
    inside.close()
    until(lambda: process_token(spec, "viewer") not in observer.list_components())


def test_a_command_reaches_the_rig_signed_and_is_recorded(observer: BusLink, rig: Rig) -> None:
    assert observer.send_command("hold/anna", f"{RUN}\nlook at it", PATIENCE_S) == "yes"
    assert rig.orders[-1] == ("hold", f"{RUN}\nlook at it by anna")
    until(lambda: Event(rig.events[-1].index, "order", "hold: look at it by anna") in rig.events)


def test_refused_commands_are_dropped_and_their_events_limited(observer: BusLink, rig: Rig) -> None:
    before, begun = list(rig.orders), time.monotonic()
    assert observer.send_command("stop/\x1b[2J", f"{RUN}\n", PATIENCE_S) is not None
    answers = set()
    for number in range(MAX_REFUSAL_BURST + 5):
        time.sleep(0.1)  # what comes faster is dropped
        answers.add(observer.send_command(f"stop/mallory{number}", "another run\nboo", PATIENCE_S))
    assert answers == {f"refused: this is run {RUN}"}
    assert observer.send_command("start/anna", f"{RUN}\n", PATIENCE_S) is not None
    assert rig.orders == before
    until(lambda: sum(event.kind == "refused" for event in rig.events) >= MAX_REFUSAL_BURST)
    refusals = [event for event in rig.events if event.kind == "refused"]
    assert all(event.text.isprintable() for event in refusals)
    assert len(refusals) <= MAX_REFUSAL_BURST + 2 + (time.monotonic() - begun) / REFUSAL_INTERVAL_S
    assert refusals[1].text == f"stop by mallory0: this is run {RUN}"


def test_observers_hide_no_component_and_are_no_rig(
    observer: BusLink, rig: Rig, spec: ProcessConfig
) -> None:
    def status() -> dict[str, list[str]]:
        answer = observer.query("state/status", timeout_s=PATIENCE_S)
        assert answer is not None
        listing: dict[str, list[str]] = json.loads(answer)
        return listing

    other = connect(spec)
    for number in range(MAX_OBSERVERS + 10):
        other.declare_alive(f"observer.0.{number}.rig")
    until(lambda: len(status()["observers"]) == MAX_OBSERVERS)
    inside = open_spoke(RIG, spec.endpoint, PATIENCE_S)
    inside.declare_alive(process_token(spec, "viewer"))
    until(lambda: process_token(spec, "viewer") in status()["components"])
    assert list_runs(observer.list_components()) == [RUN]
    send_command("resume", "", spec.listen, RIG)
    assert rig.orders[-1][0] == "resume"
    inside.close()
    other.close()


def test_publications_and_replies_of_observers_are_dropped(
    observer: BusLink, rig: Rig, spec: ProcessConfig
) -> None:
    other = connect(spec)
    inbox = other.subscribe((MEAS_TOPIC, "/run/event"), history=False, capacity=QUEUE_CAPACITY)
    wait_until_delivered(rig, inbox)
    session, before = observer._session, list(rig.orders)
    forged = encode_item(Event(0, "state", "forged"), RUN)
    observer.declare(("/run/event",))
    false = observer.declare_requests("state/status", "config/run")
    for _ in range(20):
        observer.publish("/run/event", forged)
        session.put(key_expression(RIG, MEAS_TOPIC), b"forged")
        assert false.poll() is None
    rig.waiting += [("/run/event", encode_item(Event(1, "state", "true"), RUN))]
    (message,) = took(inbox, 1)
    assert decode_item(*message)[1] == Event(1, "state", "true")
    assert inbox.get(0.7) is None
    assert not [event for event in rig.events if event.text == "forged"]
    assert rig.orders == before
    other.close()


def test_garbage_does_not_disturb_the_gateway(
    observer: BusLink, rig: Rig, spec: ProcessConfig
) -> None:
    chance = random.Random(2)
    session = observer._session
    paths = ["state/held", "state/status", "cmd/stop/x", "cmd/stop/*", "**", "config/*", "alive/x"]
    before = list(rig.orders)
    start = observer.subscribe(("/run/start",), history=True, capacity=QUEUE_CAPACITY).get_fragment(
        PATIENCE_S
    )
    assert start is not None
    numbers = ("1e999", "-1e999", "1e30", "-1e30", "-1", "NaN", "[]", f"{2**63 - 1}", "9" * 5000)
    next_one = '{"who": "x", "history": true, "next": {"/run/start": {"%s": %s}}}'
    texts = [next_one % (start.publisher, number) for number in numbers]
    nested = ["[" * 60_000, '{"a":' * 10_000, '{"next":' * 500, "[" * 4000]
    texts += nested * 2
    for _ in range(1000):
        where = f"shaketwin/{RIG}/{chance.choice(paths)}"
        body = chance.randbytes(chance.choice((0, 1, 100, 5000, 70_000)))
        if chance.random() < 0.3:
            body = chance.choice(texts).encode()
        if chance.random() < 0.5:
            session.get(where, lambda _: None, payload=body, timeout=0.05)
        elif "*" not in where:
            session.put(where, body, attachment=body[:17])
    other = connect(spec)
    assert other.query("state/status", timeout_s=PATIENCE_S) is not None
    assert rig.orders == before
    other.close()


@pytest.mark.parametrize(
    ("order", "who", "role", "text", "part"),
    [
        ("hold", "anna", "command", f"{RUN}\nwhy", ""),
        ("abort", "anna", "command", RUN, ""),
        ("start", "anna", "command", RUN, "known: hold, resume, stop, abort"),
        ("hold", "a b", "command", RUN, "allowed: up to 64"),
        ("hold", "a" * 65, "command", RUN, "allowed: up to 64"),
        ("hold", "../rig", "command", RUN, "allowed: up to 64"),
        ("hold", "anna", "observe", RUN, "role observe"),
        ("hold", "anna", "twin", RUN, "has the role twin"),
        ("hold", "anna", "command", "other\nwhy", f"this is run {RUN}"),
        ("hold", "anna", "command", f"{RUN}\n{'x' * 1001}", "1001 characters"),
        ("hold", "anna", "command", f"{RUN}\n\x1b[2J", "printable"),
        ("hold", "anna", "command", f"{RUN}\na\nb", "printable"),
    ],
)
def test_a_command_is_refused_with_the_reason(
    order: str, who: str, role: str, text: str, part: str
) -> None:
    problem = validate_command(order, who, role, RUN, text)
    assert part in problem
    assert bool(problem) == bool(part)


def test_refusals_are_recorded_again_after_a_while() -> None:
    refusals = RefusalLimiter()
    answers = [refusals.limit("no", 0.001 * number) for number in range(1000)]
    assert [answer for answer in answers if answer] == ["no"] * MAX_REFUSAL_BURST
    assert (
        refusals.limit("no", 11.0)
        == f"no (and {1000 - MAX_REFUSAL_BURST} more since the last one recorded)"
    )
    assert refusals.limit("no", 11.1) == ""


def test_gateway_waits_for_slow_subscribers_after_the_end(
    spec: ProcessConfig, rig: Rig, door: list[Door]
) -> None:
    late = connect(spec)
    inbox = late.subscribe((MEAS_TOPIC, "/run/stop"), history=True, capacity=QUEUE_CAPACITY)
    bodies = [(MEAS_TOPIC, random.randbytes(20_000)) for _ in range(200)]
    rig.waiting += [*bodies, ("/run/stop", encode_item(RunStop(9, "complete", "", ()), RUN))]
    until(lambda: not rig.waiting)
    door[-1].shut.set()
    sent = [sent for sent in rig.sent if sent[0] in (MEAS_TOPIC, "/run/stop")]
    assert len(took(inbox, len(sent))) == len(sent)
    late.close()
    door[-1].thread.join()
    door.append(Door(spec))
