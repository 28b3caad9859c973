"""The link between the processes of a run: bytes of the wire over zenoh. The only file with zenoh.

A star: the rig opens the hub, everybody else is a spoke; what a spoke publishes reaches the other
spokes through the hub. Keys, with <topic> as in `wire.TOPIC_TYPES`:

| key on the bus                   | carries                                | made by           |
|----------------------------------|----------------------------------------|-------------------|
| shaketwin/<rig>/stream<topic>    | what comes with every block            | publish()         |
| shaketwin/<rig>/event<topic>     | every other record, when it happens    | publish()         |
| shaketwin/<rig>/cmd/<name>       | a command to the rig, and its answer   | request()         |
| shaketwin/<rig>/alive/<component>| nothing; is there while the process is | alive()           |

so /rig/meas travels on shaketwin/<rig>/stream/rig/meas and /run/start on .../event/run/start.
"""

import json
import re
import threading
from collections import deque
from dataclasses import dataclass, field
from typing import Any

import zenoh
import zenoh.ext

from table_io.profile import BadInput
from twin.stream.wire import BLOCK_TOPICS, COMPARED

HUB_MODE = "router"
CACHE_SAMPLES = 5000
HEARTBEAT_S = 0.5
LARGEST_BYTES = 4 * 2**20
COMMANDS_WAITING = 16
STREAMS = frozenset((*BLOCK_TOPICS.values(), COMPARED))


def key(rig: str, topic: str) -> str:
    """Key on the bus of a wire topic."""
    return f"shaketwin/{rig}/{'stream' if topic in STREAMS else 'event'}{topic}"


class Inbox:
    """What arrived and was not fetched yet, in order per topic, at most `capacity` messages.

    `missed` messages were lost on the way beyond recovery, `dropped` ones pushed out by newer ones
    because nobody fetched them, `ignored` ones too large.
    """

    def __init__(self, capacity: int) -> None:
        self.missed = 0
        self.dropped = 0
        self.ignored = 0
        self._capacity = capacity
        self._queue: deque[tuple[str, bytes]] = deque()
        self._filled = threading.Condition()

    def __len__(self) -> int:
        return len(self._queue)

    def get(self, timeout_s: float) -> tuple[str, bytes] | None:
        """The oldest (topic, payload); None when nothing comes within `timeout_s`."""
        with self._filled:
            if not self._queue and not self._filled.wait_for(lambda: self._queue, timeout_s):
                return None
            return self._queue.popleft()

    def _put(self, topic: str, sample: Any) -> None:
        if len(sample.payload) > LARGEST_BYTES:
            self.ignored += 1
            return
        payload = sample.payload.to_bytes()
        with self._filled:
            if len(self._queue) >= self._capacity:
                self._queue.popleft()
                self.dropped += 1
            self._queue.append((topic, payload))
            self._filled.notify()

    def _miss(self, miss: Any) -> None:
        self.missed += miss.nb


@dataclass(frozen=True, slots=True)
class Command:
    """A command that waits for `reply`; whoever sent it gets nothing if that is never called."""

    name: str
    text: str
    _query: Any = field(repr=False)

    def reply(self, text: str) -> None:
        """Answer, once."""
        with self._query as query:
            query.reply(query.key_expr, text)


class Commands:
    """Commands to the rig. No thread: they wait in zenoh, the oldest gives way when it is full."""

    def __init__(self, queryable: Any) -> None:
        self.ignored = 0
        self._queryable = queryable

    def poll(self) -> Command | None:
        """The next command, or None at once."""
        while (query := self._queryable.try_recv()) is not None:
            payload = query.payload
            if payload is None or len(payload) <= LARGEST_BYTES:
                try:
                    text = "" if payload is None else payload.to_string()
                    return Command(str(query.key_expr).rsplit("/", 1)[1], text, query)
                except UnicodeDecodeError:
                    pass
            self.ignored += 1
            query.drop()
        return None


class Link:
    """One process's end of the star; made by `open_hub` or `open_spoke`.

    `refused` counts payloads that were too large to publish.
    """

    def __init__(self, rig: str, session: Any) -> None:
        self.refused = 0
        self._rig = rig
        self._session = session
        self._publishers: dict[str, Any] = {}
        self._subscribers: list[Any] = []
        self._others: list[Any] = []

    def declare(self, topics: tuple[str, ...]) -> None:
        """Make ready to publish `topics`, so that the first one costs no more than the others."""
        for topic in topics:
            if topic not in self._publishers:
                self._publishers[topic] = zenoh.ext.declare_advanced_publisher(
                    self._session,
                    key(self._rig, topic),
                    congestion_control=zenoh.CongestionControl.DROP,
                    cache=zenoh.ext.CacheConfig(max_samples=CACHE_SAMPLES),
                    sample_miss_detection=zenoh.ext.MissDetectionConfig(
                        heartbeat=HEARTBEAT_S, sporadic_heartbeat=None
                    ),
                    publisher_detection=True,
                )

    def publish(self, topic: str, payload: bytes) -> None:
        """Send to whoever subscribed, and keep for those who come late. Never waits."""
        if len(payload) > LARGEST_BYTES:
            self.refused += 1
            return
        self._publishers[topic].put(payload)

    def subscribe(self, topics: tuple[str, ...], *, history: bool, capacity: int) -> Inbox:
        """Inbox of `topics`; with `history` it begins with what their publishers still hold."""
        inbox = Inbox(capacity)
        for topic in topics:
            self._subscribe(topic, inbox, history)
        return inbox

    def _subscribe(self, topic: str, inbox: Inbox, history: bool) -> None:
        # indirect=False: zenoh's own thread fills the inbox, instead of a Python thread per topic.
        subscriber = zenoh.ext.declare_advanced_subscriber(
            self._session,
            key(self._rig, topic),
            zenoh.handlers.Callback(lambda sample: inbox._put(topic, sample), indirect=False),
            history=zenoh.ext.HistoryConfig(detect_late_publishers=True) if history else None,
            recovery=zenoh.ext.RecoveryConfig(heartbeat=True, periodic_queries=None),
        )
        self._subscribers.append(subscriber)
        subscriber.sample_miss_listener(zenoh.handlers.Callback(inbox._miss, indirect=False))

    def commands(self) -> Commands:
        """The commands that others send to this process."""
        queryable = self._session.declare_queryable(
            f"shaketwin/{self._rig}/cmd/*", zenoh.handlers.RingChannel(COMMANDS_WAITING)
        )
        self._others.append(queryable)
        return Commands(queryable)

    def request(self, command: str, text: str = "", timeout_s: float = 1.0) -> str | None:
        """The rig's answer to a command; None if there is none within `timeout_s`."""
        where = f"shaketwin/{self._rig}/cmd/{command}"
        for reply in self._session.get(where, payload=text, timeout=timeout_s):
            if reply.ok is not None:
                return str(reply.ok.payload.to_string())
        return None

    def alive(self, component: str) -> None:
        """Be among `components()` of everybody until this process ends."""
        where = f"shaketwin/{self._rig}/alive/{component}"
        self._others.append(self._session.liveliness().declare_token(where))

    def components(self) -> set[str]:
        """Names of the components whose processes are connected."""
        where = f"shaketwin/{self._rig}/alive/*"
        replies = self._session.liveliness().get(where, timeout=1.0)
        return {str(one.ok.key_expr).rsplit("/", 1)[1] for one in replies if one.ok is not None}

    def close(self) -> None:
        """Leave the star; may be called again."""
        # Subscribers first: a session that closes under them never ends (zenoh-python issue 624).
        for one in (*self._subscribers, *self._others, *self._publishers.values()):
            one.undeclare()
        self._subscribers, self._others, self._publishers = [], [], {}
        if not self._session.is_closed():
            self._session.close()


def open_hub(rig: str, endpoint: str) -> Link:
    """The end that listens at `endpoint`; BadInput where that cannot be."""
    _check(rig, endpoint)
    try:
        return Link(rig, zenoh.open(_config(HUB_MODE, "listen", endpoint, 0)))
    except zenoh.ZError as error:
        raise BadInput(
            f"endpoint {endpoint}: cannot listen there ({_last(error)}); end the run that holds the "
            "port, or give a free one"
        ) from None


def open_spoke(rig: str, endpoint: str, timeout_s: float) -> Link:
    """An end connected to the hub at `endpoint`; BadInput when none answers in `timeout_s`."""
    _check(rig, endpoint)
    try:
        return Link(rig, zenoh.open(_config("client", "connect", endpoint, timeout_s)))
    except zenoh.ZError as error:
        raise BadInput(
            f"endpoint {endpoint}: no rig answers there within {timeout_s:g} s ({_last(error)}); "
            "start the run first, or give its endpoint"
        ) from None


def _check(rig: str, endpoint: str) -> None:
    if not re.fullmatch(r"[^*$?#/\s]+", rig):
        raise BadInput(f"rig {rig!r}: not a name for the bus; allowed: no spaces and none of * $ ? # /")
    match = re.fullmatch(r"tcp/(\[[0-9A-Fa-f:]+\]|[\w.-]+):(\d{1,5})", endpoint)
    if not match or not 0 < int(match[2]) < 2**16:
        raise BadInput(
            f"endpoint {endpoint!r}: not an endpoint; write tcp/<host>:<port>, e.g. tcp/127.0.0.1:7447"
        )


def _last(error: Exception) -> str:
    return str(error)


def _config(mode: str, way: str, endpoint: str, timeout_s: float) -> Any:
    """Session settings: nothing but the one endpoint; full queues drop at once."""
    return zenoh.Config.from_json5(
        json.dumps(
            {
                "mode": mode,
                "listen": {"endpoints": [], "timeout_ms": 0, "exit_on_failure": True},
                "connect": {"endpoints": [], "timeout_ms": 0, "exit_on_failure": True},
                "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
                "transport": {
                    "shared_memory": {"enabled": False},
                    "link": {
                        "tx": {
                            "queue": {
                                "congestion_control": {
                                    "drop": {
                                        "wait_before_drop": 0,
                                        "max_wait_before_drop_fragments": 0,
                                    }
                                }
                            }
                        }
                    },
                },
            }
            | {
                way: {
                    "endpoints": [endpoint],
                    "timeout_ms": round(timeout_s * 1000),
                    "exit_on_failure": True,
                }
            }
        )
    )
