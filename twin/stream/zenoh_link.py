"""The link between the processes of a run: bytes of the wire over zenoh. The only file with zenoh.

A star: the rig opens the hub, everybody else is a spoke; what a spoke publishes reaches the other
spokes through the hub. Keys, with <topic> as in `wire.TOPIC_TYPES`:

| key on the bus                    | carries                               | called by         |
|-----------------------------------|---------------------------------------|-------------------|
| shaketwin/<rig>/stream<topic>     | what comes with every block           | publish()         |
| shaketwin/<rig>/event<topic>      | every other record, when it happens   | publish()         |
| shaketwin/<rig>/state/held        | question: what do you hold from n on? | Inbox.get()       |
| shaketwin/<rig>/cmd/<name>        | a command to the rig, and its answer  | request()         |
| shaketwin/<rig>/alive/<component> | nothing; is there as long as it lives | alive()           |

so /rig/meas travels on shaketwin/<rig>/stream/rig/meas and /run/start on .../event/run/start.

Full queues drop, so a stalled spoke never slows a publisher. A payload travels in pieces that fit
into one batch of zenoh (with such queues, larger ones never arrive). Every publisher numbers its
pieces and holds the newest; an inbox that finds one missing asks for the rest, a chunk at a time,
and takes nothing newer until it has it. zenoh's own AdvancedPublisher will not do: its put() waits
while history is sent (0.1 s for 5000 blocks, 5 s if the one who asked is stopped), and its
subscriber loses, without a word, the history of a publisher that goes on publishing (1.10.2).
"""

import json
import re
import secrets
from dataclasses import dataclass, field
from typing import Any

import zenoh

from table_io.card import BadInput
from twin.stream.resend import (
    ASK_EVERY_S,
    BEGINS,
    ENDS,
    LARGEST_BYTES,
    PIECE_BYTES,
    STAMP,
    Inbox,
    Listeners,
    Shelf,
)
from twin.stream.wire import BLOCK_TOPICS, CMP_TOPIC

QUESTIONS_WAITING = 16

STREAMS = frozenset((*BLOCK_TOPICS.values(), CMP_TOPIC))


def key(rig: str, topic: str) -> str:
    """Key on the bus of a wire topic."""
    return f"shaketwin/{rig}/{'stream' if topic in STREAMS else 'event'}{topic}"


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
    """Commands to this process. No thread: they wait in zenoh, where the oldest gives way."""

    def __init__(self, link: "Link", queryable: Any) -> None:
        self.ignored = 0
        self._link = link
        self._queryable = queryable

    def poll(self) -> Command | None:
        """The next command, or None at once."""
        self._link.serve()
        while (query := self._queryable.try_recv()) is not None:
            payload = b"" if query.payload is None else query.payload.to_bytes()
            try:
                if len(payload) <= LARGEST_BYTES:
                    return Command(str(query.key_expr).rsplit("/", 1)[1], payload.decode(), query)
            except UnicodeDecodeError:
                pass
            self.ignored += 1
            query.drop()
        return None


class Link:
    """One process's end of the star; made by `open_hub` or `open_spoke`, used by one thread.

    `refused` counts payloads that were too large to publish.
    """

    def __init__(self, rig: str, session: Any) -> None:
        self.refused = 0
        self._rig = rig
        self._session = session
        self._name = secrets.token_bytes(8)
        self._shelves: dict[str, Shelf] = {}
        self._open: list[Any] = []
        self._questions: Any = None
        self.listeners = Listeners(self._name.hex())

    def declare(self, topics: tuple[str, ...]) -> None:
        """Make ready to publish `topics`, so that the first one costs no more than the others."""
        for topic in topics:
            if topic not in self._shelves:
                publisher = self._session.declare_publisher(
                    key(self._rig, topic), congestion_control=zenoh.CongestionControl.DROP
                )
                self._shelves[topic] = Shelf(publisher)
        if self._questions is None:
            self._questions = self._queryable("state/held")

    def publish(self, topic: str, payload: bytes) -> None:
        """Send to whoever subscribed, and hold for those who ask later. Never waits."""
        if len(payload) > LARGEST_BYTES:
            self.refused += 1
            return
        shelf = self._shelves[topic]
        for at in range(0, max(len(payload), 1), PIECE_BYTES):
            piece = payload[at : at + PIECE_BYTES]
            place = BEGINS * (at == 0) | ENDS * (at + PIECE_BYTES >= len(payload))
            shelf.publisher.put(piece, attachment=STAMP.pack(self._name, shelf.end, place))
            shelf.add(place, piece)
        self.serve()

    def serve(self) -> None:
        """Answer one question for held messages if there is one, with at most a chunk.

        Everything one does with a link does this too; a publisher that does nothing for long must
        call it, until those who listen have what they need.
        """
        query = self._questions.try_recv() if self._questions is not None else None
        if query is None:
            return
        with query:
            try:
                question = json.loads(query.payload.to_bytes())
                topics, body = self._answer(question["next"], bool(question["history"]))
                self.listeners.note(question, self._shelves)
            except (ValueError, TypeError, KeyError, AttributeError):
                return  # not one of ours: nothing to say
            if topics:
                header = json.dumps({"source": self._name.hex(), "topics": topics})
                query.reply(query.key_expr, body, attachment=header)

    def _answer(
        self, asked: dict[str, dict[str, int]], history: bool
    ) -> tuple[dict[str, Any], bytes]:
        """({topic: [first, end, [(place, size)]]}, pieces in a row): a chunk of what is asked."""
        topics: dict[str, Any] = {}
        chunk: list[bytes] = []
        room = PIECE_BYTES
        # Rare topics first, so that the start of a run comes before its blocks.
        for topic in sorted(self._shelves.keys() & asked, key=lambda one: self._shelves[one].end):
            shelf = self._shelves[topic]
            known = asked[topic].get(self._name.hex())
            first = (shelf.first if history else shelf.end) if known is None else int(known)
            first = max(first, shelf.first)
            taken = shelf.take(first, room)
            room -= sum(len(piece) for _, piece in taken)
            chunk += [piece for _, piece in taken]
            if known is None or first < shelf.end:
                topics[topic] = [first, shelf.end, [(place, len(piece)) for place, piece in taken]]
        return topics, b"".join(chunk)

    @property
    def behind(self) -> int:
        """The most pieces of a topic that anybody lacks who listens to this process."""
        return self.listeners.behind(self._shelves)

    def ask(self, question: dict[str, Any], inbox: Inbox) -> None:
        """Ask all publishers for what they hold; answers arrive in the inbox. Never waits."""

        def answered(reply: Any) -> None:
            if reply.ok is not None:
                inbox.arrive("", reply.ok.attachment, reply.ok.payload)

        # Answers are sent with the congestion control of the question: dropped if we are stalled.
        self._session.get(
            f"shaketwin/{self._rig}/state/held",
            zenoh.handlers.Callback(answered, indirect=False),
            payload=json.dumps(question),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            congestion_control=zenoh.CongestionControl.DROP,
            allowed_destination=zenoh.Locality.REMOTE,
            timeout=ASK_EVERY_S,
        )

    def subscribe(self, topics: tuple[str, ...], *, history: bool, capacity: int) -> Inbox:
        """Inbox of `topics` that keeps at most `capacity` pieces waiting.

        With `history` it begins with what the publishers still hold and loses nothing that they
        hold; without, it begins now and, when full, drops the oldest.
        """
        inbox = Inbox(self, topics, history, capacity)
        for topic in topics:

            def arrived(sample: Any, topic: str = topic) -> None:
                inbox.arrive(topic, sample.attachment, sample.payload)

            # indirect=False: zenoh's own thread fills the inbox, instead of a Python thread each.
            callback = zenoh.handlers.Callback(arrived, indirect=False)
            self._open.append(self._session.declare_subscriber(key(self._rig, topic), callback))
        return inbox

    def commands(self) -> Commands:
        """The commands that others send to this process."""
        return Commands(self, self._queryable("cmd/*"))

    def _queryable(self, what: str) -> Any:
        where = f"shaketwin/{self._rig}/{what}"
        waiting: Any = zenoh.handlers.RingChannel(QUESTIONS_WAITING)
        self._open.append(self._session.declare_queryable(where, waiting))
        return self._open[-1]

    def request(self, command: str, text: str = "", timeout_s: float = 1.0) -> str | None:
        """The rig's answer to a command; None if there is none within `timeout_s`."""
        where = f"shaketwin/{self._rig}/cmd/{command}"
        for reply in self._session.get(where, payload=text, timeout=timeout_s):
            if reply.ok is not None:
                return str(reply.ok.payload.to_string())
        return None

    def alive(self, component: str) -> None:
        """Be among everybody's `components()` until this process ends."""
        where = f"shaketwin/{self._rig}/alive/{component}"
        self._open.append(self._session.liveliness().declare_token(where))

    def components(self) -> set[str]:
        """Names of the components whose processes are connected."""
        self.serve()
        replies = self._session.liveliness().get(f"shaketwin/{self._rig}/alive/*", timeout=1.0)
        return {str(one.ok.key_expr).rsplit("/", 1)[1] for one in replies if one.ok is not None}

    def close(self) -> None:
        """Leave the star; may be called again."""
        for one in (*self._open, *(shelf.publisher for shelf in self._shelves.values())):
            one.undeclare()
        self._open, self._shelves, self._questions = [], {}, None
        self._session.close()


def open_hub(rig: str, endpoint: str) -> Link:
    """The end that listens at `endpoint`; BadInput where that cannot be."""
    _check(rig, endpoint)
    if not re.match(r"tcp/(127\.[\d.]+|localhost|\[::1\]):", endpoint):
        raise BadInput(
            f"endpoint {endpoint}: would listen to the network, unprotected; allowed: this machine "
            "only, as tcp/127.0.0.1:7447"
        )
    try:
        # "peer" measured the same, loss and latency; "router" is what zenoh documents for clients.
        return Link(rig, zenoh.open(_config("router", "listen", endpoint, 0)))
    except zenoh.ZError as error:
        raise BadInput(
            f"endpoint {endpoint}: cannot listen there ({_why(error)}); "
            "end the run that holds the port, or give another one"
        ) from None


def open_spoke(rig: str, endpoint: str, timeout_s: float) -> Link:
    """An end connected to the hub at `endpoint`; BadInput when none answers in `timeout_s`."""
    _check(rig, endpoint)
    try:
        return Link(rig, zenoh.open(_config("client", "connect", endpoint, timeout_s)))
    except zenoh.ZError:
        raise BadInput(
            f"endpoint {endpoint}: no rig answers there within {timeout_s:g} s; "
            "start the run first, or give the endpoint it listens at"
        ) from None


def _check(rig: str, endpoint: str) -> None:
    if not re.fullmatch(r"[\w.-]+", rig):
        raise BadInput(f"rig {rig!r}: not a name for the bus; allowed: letters, digits and _ . -")
    match = re.fullmatch(r"tcp/(\[[0-9A-Fa-f:]+\]|[\w.-]+):(\d{1,5})", endpoint)
    if not match or not 0 < int(match[2]) < 2**16:
        raise BadInput(
            f"endpoint {endpoint!r}: not understood; write tcp/<host>:<port>, as tcp/127.0.0.1:7447"
        )


def _why(error: Exception) -> str:
    """The innermost reason in zenoh's message, without its source files."""
    reason = re.search(r"([A-Z][^\[\]:]*) \(os error", str(error))
    return reason[1] if reason else re.sub(r" at /\S+", "", str(error))


def _config(mode: str, way: str, endpoint: str, timeout_s: float) -> Any:
    """Session settings: the one endpoint and no other; full queues drop at once."""
    end = {"endpoints": [endpoint], "timeout_ms": round(timeout_s * 1000), "exit_on_failure": True}
    drop = {"wait_before_drop": 0, "max_wait_before_drop_fragments": 0}
    queue = {"congestion_control": {"drop": drop}, "size": {"data": 16}}
    config = {
        "mode": mode,
        "listen": {"endpoints": []},
        "connect": {"endpoints": []},
        way: end,
        "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {"shared_memory": {"enabled": False}, "link": {"tx": {"queue": queue}}},
    }
    return zenoh.Config.from_json5(json.dumps(config))
