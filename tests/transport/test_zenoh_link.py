"""The link over loopback, with real processes where a process must stop, die or end."""

import errno
import os
import random
import select
import signal
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.builders.ports import free_endpoint
from tests.input_errors import raises_input_error
from twin.transport import reliable_subscriber
from twin.transport.endpoint import CMP_TOPIC, MEAS_TOPIC, PRED_TOPIC, key_expression
from twin.transport.history_cache import (
    MAX_CACHED_FRAGMENTS,
    MAX_PAYLOAD_BYTES,
)
from twin.transport.reliable_subscriber import ReliableSubscriber
from twin.transport.zenoh_link import BusLink, open_hub, open_spoke

BLOCK = bytes(2500)
SETTLED_S = 0.05  # in which a subscription has reached the hub
ROOT = Path(__file__).resolve().parents[2]

# A process that says "ready", and every message it gets as "<topic> <number>".
LISTENER = """
import struct, sys
from twin.transport.zenoh_link import open_spoke
link = open_spoke("rig", sys.argv[1], 5.0)
link.declare_alive("listener")
inbox = link.subscribe(tuple(sys.argv[3:]), history=sys.argv[2] == "history", capacity=20000)
print("ready", flush=True)
while True:
    if (got := inbox.get(0.1)) is not None:
        print(got[0], struct.unpack_from("<q", got[1])[0], inbox.missed, flush=True)
"""
# A process that publishes so many blocks at 100 Hz, then answers who asks for what it holds.
SPEAKER = """
import struct, sys, time
from twin.transport.zenoh_link import open_spoke
link = open_spoke("rig", sys.argv[1], 5.0)
topics = tuple(sys.argv[3:])
link.declare(topics)
begin = time.monotonic()
for number in range(int(sys.argv[2])):
    while time.monotonic() < begin + number * 0.01:
        time.sleep(0.001)
    for topic in topics:
        link.publish(topic, struct.pack("<q", number) + bytes(2500))
while True:
    link.serve()
    time.sleep(0.005)
"""

# A process that gives an order and asks a question, and stalls before it hears the answers.
ASKER = """
import os, signal, sys, threading, time
from twin.transport.zenoh_link import open_spoke
from tests.input_errors import raises_input_error
link = open_spoke("rig", sys.argv[1], 5.0)
inbox = link.subscribe(("/rig/meas",), history=True, capacity=20000)
link.forward_command("hold", "", None, 60.0)
threading.Thread(target=link.query, args=("cmd/resume", "", 60.0), daemon=True).start()
time.sleep(0.2)
os.kill(os.getpid(), signal.SIGSTOP)
"""

Start = Callable[..., "subprocess.Popen[str]"]


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


@pytest.fixture
def hub(endpoint: str) -> Iterator[BusLink]:
    link = open_hub("rig", endpoint)
    yield link
    link.close()


@pytest.fixture
def spoke(hub: BusLink, endpoint: str) -> Iterator[BusLink]:
    link = open_spoke("rig", endpoint, 5.0)
    yield link
    link.close()


@pytest.fixture
def start() -> Iterator[Start]:
    begun: list[subprocess.Popen[str]] = []

    def run(code: str, *arguments: str) -> "subprocess.Popen[str]":
        process = subprocess.Popen(
            [sys.executable, "-c", code, *arguments],
            stdout=subprocess.PIPE,
            text=True,
            cwd=ROOT,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
        )
        begun.append(process)
        return process

    yield run
    for process in begun:
        process.kill()
        process.wait()
        assert process.stdout is not None
        process.stdout.close()


def number_block(number: int) -> bytes:
    return struct.pack("<q", number) + BLOCK


def fetch(
    inbox: ReliableSubscriber, count: int, *publishers: BusLink, limit_s: float = 5.0
) -> list[tuple[str, bytes]]:
    """The next `count` messages, or fewer if they do not come; publishers here answer meanwhile."""
    got: list[tuple[str, bytes]] = []
    end = time.monotonic() + limit_s
    while len(got) < count and time.monotonic() < end:
        for publisher in publishers:
            publisher.serve()
        if (message := inbox.get(0.005)) is not None:
            got.append(message)
    return got


def numbers(messages: list[tuple[str, bytes]], topic: str) -> list[int]:
    return [struct.unpack_from("<q", body)[0] for where, body in messages if where == topic]


def publish_at_100_hz(link: BusLink, topic: str, span: range) -> list[float]:
    """Seconds that each publish() took."""
    took = []
    begin = time.monotonic()
    for place, number in enumerate(span):
        time.sleep(max(0.0, begin + place * 0.01 - time.monotonic()))
        took.append(time_publish(link, number, BLOCK, topic))
    return took


def time_publish(link: BusLink, number: int, rest: bytes, topic: str = MEAS_TOPIC) -> float:
    """Seconds that one publish() took."""
    before = time.monotonic()
    link.publish(topic, struct.pack("<q", number) + rest)
    return time.monotonic() - before


def read_lines(process: "subprocess.Popen[str]", count: int, link: BusLink) -> list[list[str]]:
    """The next `count` lines that a listener says, in words, while `link` answers it."""
    assert process.stdout is not None
    lines: list[list[str]] = []
    rest = ""
    end = time.monotonic() + 6.0
    os.set_blocking(process.stdout.fileno(), False)
    while len(lines) < count and time.monotonic() < end:
        link.serve()
        if select.select([process.stdout], [], [], 0.005)[0]:
            rest += os.read(process.stdout.fileno(), 65536).decode()
            *whole, rest = rest.split("\n")
            lines += [line.split() for line in whole]
    return lines


def test_a_rig_name_that_is_a_pattern_is_refused(endpoint: str) -> None:
    with raises_input_error(key="rig", value="a/**"):
        open_hub("a/**", endpoint)


def test_a_port_in_use_is_named_with_the_reason(hub: BusLink, endpoint: str) -> None:
    with raises_input_error(
        key="endpoint",
        value=endpoint,
        problem=os.strerror(errno.EADDRINUSE),
        remedy="end the run",
    ):
        open_hub("rig", endpoint)


def test_nothing_listening_is_reported_in_time(endpoint: str) -> None:
    begin = time.monotonic()
    with raises_input_error(key="endpoint", value=endpoint, problem="0.3 s"):
        open_spoke("rig", endpoint, 0.3)
    assert time.monotonic() - begin < 1.0


def test_only_the_given_endpoint_is_open(hub: BusLink, spoke: BusLink, endpoint: str) -> None:
    mine = {os.readlink(fd) for fd in Path("/proc/self/fd").iterdir() if os.path.lexists(fd)}
    listening = []
    for table in ("tcp", "tcp6", "udp", "udp6"):
        for line in Path(f"/proc/self/net/{table}").read_text().splitlines()[1:]:
            words = line.split()
            if f"socket:[{words[9]}]" in mine and (words[3] == "0A" or table.startswith("udp")):
                listening.append((table, words[1]))
    port = int(endpoint.rsplit(":", 1)[1])
    assert listening == [("tcp", f"0100007F:{port:04X}")]


def test_spokes_hear_hub_and_each_other_without_loss(
    hub: BusLink, spoke: BusLink, endpoint: str, start: Start
) -> None:
    inbox = spoke.subscribe((MEAS_TOPIC, PRED_TOPIC, CMP_TOPIC), history=True, capacity=1000)
    start(SPEAKER, endpoint, "100", PRED_TOPIC, CMP_TOPIC)
    hub.declare((MEAS_TOPIC,))
    publish_at_100_hz(hub, MEAS_TOPIC, range(100))
    messages = fetch(inbox, 300, hub)
    for topic in (MEAS_TOPIC, PRED_TOPIC, CMP_TOPIC):
        assert numbers(messages, topic) == list(range(100))
    assert (inbox.missed, inbox.dropped, inbox.ignored) == (0, 0, 0)


def test_late_subscriber_gets_the_cache_during_publishing(hub: BusLink, endpoint: str) -> None:
    hub.declare((MEAS_TOPIC, "/run/start"))
    hub.publish("/run/start", number_block(7))
    for number in range(2000):
        hub.publish(MEAS_TOPIC, number_block(number))
    late = open_spoke("rig", endpoint, 5.0)
    inbox = late.subscribe((MEAS_TOPIC, "/run/start"), history=True, capacity=100)
    messages = []
    for number in range(2000, 2100):
        publish_at_100_hz(hub, MEAS_TOPIC, range(number, number + 1))
        messages += fetch(inbox, 10**6, hub, limit_s=0.004)
    messages += fetch(inbox, 2101 - len(messages), hub)
    late.close()
    assert numbers(messages, MEAS_TOPIC) == list(range(2100))
    assert messages[0][0] == "/run/start"
    assert inbox.missed == 0


def test_a_large_payload_arrives_whole_and_a_larger_one_is_refused(
    hub: BusLink, spoke: BusLink
) -> None:
    inbox = spoke.subscribe(("/run/start",), history=True, capacity=1000)
    hub.declare(("/run/start",))
    largest = random.Random(2).randbytes(MAX_PAYLOAD_BYTES)
    for payload in (largest, b"", largest + b"x"):
        hub.publish("/run/start", payload)
    assert fetch(inbox, 3, hub, limit_s=2.0) == [("/run/start", largest), ("/run/start", b"")]
    assert hub.rejected == 1


@pytest.mark.slow  # 6 s
def test_a_stopped_listener_slows_nobody_and_gets_everything_afterwards(
    hub: BusLink, endpoint: str, start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    listener = start(LISTENER, endpoint, "history", MEAS_TOPIC)
    assert read_lines(listener, 1, hub) == [["ready"]]
    hub.declare((MEAS_TOPIC,))
    publish_at_100_hz(hub, MEAS_TOPIC, range(20))
    with monkeypatch.context() as later:
        later.setattr(hub, "serve", lambda: None)  # so that a question of it is open
        time.sleep(reliable_subscriber.QUERY_PERIOD_S)
        listener.send_signal(signal.SIGSTOP)
        took = [
            time_publish(hub, number, bytes(40_000)) for number in range(20, 520)
        ]  # 20 MB: all is full
    took += publish_at_100_hz(hub, MEAS_TOPIC, range(520, 620))
    listener.send_signal(signal.SIGCONT)
    took += publish_at_100_hz(hub, MEAS_TOPIC, range(620, 640))
    messages = read_lines(listener, 640, hub)
    assert [int(number) for _, number, _ in messages] == list(range(640))
    assert {missed for *_, missed in messages} == {"0"}
    assert max(took) < 0.1


def test_a_listener_stopped_while_it_fetches_history_slows_nobody(
    hub: BusLink, endpoint: str, start: Start
) -> None:
    hub.declare((MEAS_TOPIC,))
    for number in range(MAX_CACHED_FRAGMENTS):
        hub.publish(MEAS_TOPIC, number_block(number))
    listener = start(LISTENER, endpoint, "history", MEAS_TOPIC)
    assert len(read_lines(listener, 100, hub)) >= 100
    listener.send_signal(signal.SIGSTOP)
    assert (
        max(
            publish_at_100_hz(
                hub, MEAS_TOPIC, range(MAX_CACHED_FRAGMENTS, MAX_CACHED_FRAGMENTS + 150)
            )
        )
        < 0.1
    )


def test_a_killed_listener_is_seen_and_its_successor_gets_everything(
    hub: BusLink, spoke: BusLink, endpoint: str, start: Start
) -> None:
    hub.declare((MEAS_TOPIC,))
    first = start(LISTENER, endpoint, "history", MEAS_TOPIC)
    assert read_lines(first, 1, hub) == [["ready"]]
    publish_at_100_hz(hub, MEAS_TOPIC, range(30))
    assert spoke.list_components() == hub.list_components() == {"listener"}
    first.kill()
    end = time.monotonic() + 1.0
    while spoke.list_components() and time.monotonic() < end:
        time.sleep(0.005)
    assert spoke.list_components() == hub.list_components() == set()
    second = start(LISTENER, endpoint, "history", MEAS_TOPIC)
    publish_at_100_hz(hub, MEAS_TOPIC, range(30, 130))
    messages = read_lines(second, 131, hub)[1:]
    assert [int(number) for _, number, _ in messages] == list(range(130))


def test_commands_make_the_round_trip(hub: BusLink, spoke: BusLink) -> None:
    commands = hub.declare_commands()
    assert commands.poll() is None
    answers: list[str | None] = []
    asking = threading.Thread(target=lambda: answers.append(spoke.send_command("stop", "nöw")))
    asking.start()
    end = time.monotonic() + 1.0
    while (command := commands.poll()) is None and time.monotonic() < end:
        time.sleep(0.001)
    assert command is not None
    assert (command.name, command.text) == ("stop", "nöw")
    command.reply("stopping")
    asking.join()
    assert answers == ["stopping"]


def test_a_command_that_nobody_answers_is_none_in_time(hub: BusLink, spoke: BusLink) -> None:
    begin = time.monotonic()
    assert spoke.send_command("stop", timeout_s=0.5) is None
    assert time.monotonic() - begin < 0.3  # nobody there: at once
    commands = hub.declare_commands()
    assert spoke.send_command("stop", timeout_s=0.2) is None
    assert time.monotonic() - begin < 1.0
    assert commands.poll() is not None


def test_stalled_requester_does_not_delay_the_reply(
    hub: BusLink, endpoint: str, start: Start
) -> None:
    hub.declare((MEAS_TOPIC,))
    commands = hub.declare_commands()
    asker = start(ASKER, endpoint)
    os.waitid(os.P_PID, asker.pid, os.WSTOPPED | os.WEXITED | os.WNOWAIT)
    for _ in range(400):  # until nothing more goes into its pipe
        hub.publish(MEAS_TOPIC, bytes(40_000))
    given = [command for command in (commands.poll(), commands.poll()) if command is not None]
    begin = time.monotonic()
    for command in given:
        command.reply("yes")
    assert time.monotonic() - begin < 0.5
    assert sorted(command.name for command in given) == ["hold", "resume"]


def test_malformed_queries_and_messages_are_ignored(hub: BusLink, spoke: BusLink) -> None:
    hub.declare((MEAS_TOPIC,))
    inbox = spoke.subscribe((MEAS_TOPIC,), history=True, capacity=10)
    time.sleep(SETTLED_S)
    session = spoke._session
    next_one = b'{"next": {"/rig/meas": {"%s": 1e999}}, "history": 1}' % hub._name.encode()
    texts = (b"\xff", b"{}", b"[]", b'{"next": {"/rig/meas": 3}, "history": 1}', next_one)
    for text in (*texts, b"[" * 60_000):
        session.get("shaketwin/rig/state/held", payload=text, timeout=0.1)
    time.sleep(SETTLED_S)
    for _ in range(10):
        hub.serve()
    hub._session.put(key_expression("rig", MEAS_TOPIC), b"no stamp")
    hub._session.put(key_expression("rig", MEAS_TOPIC), b"odd", attachment=b"stamp")
    hub.publish(MEAS_TOPIC, number_block(0))
    assert numbers(fetch(inbox, 1, hub), MEAS_TOPIC) == [0]
    assert inbox.ignored == 2


@pytest.mark.parametrize("ending", ["link.close(); link.close()", "pass", "raise SystemExit(0)"])
def test_a_process_ends_promptly_and_has_no_thread_of_ours(
    hub: BusLink, endpoint: str, start: Start, ending: str
) -> None:
    code = f"""
import sys, threading
from twin.transport.zenoh_link import open_spoke
link = open_spoke("rig", sys.argv[1], 5.0)
link.declare(("/twin/pred",))
inbox = link.subscribe(("/rig/meas",), history=True, capacity=10)
commands = link.declare_commands()
link.declare_alive("x")
while inbox.get(0.1) is None: pass
print(threading.active_count(), flush=True)
{ending}
"""
    process = start(code, endpoint)
    hub.declare((MEAS_TOPIC,))
    hub.publish(MEAS_TOPIC, number_block(0))
    assert read_lines(process, 1, hub) == [["1"]]
    assert process.wait(timeout=2.0) == 0
