"""The link between the processes of a run: bytes of the wire over zenoh. The only file with zenoh.

A star: the rig opens the hub, everybody else is a spoke; what a spoke publishes reaches the other
spokes through the hub. Keys, with <topic> as in `wire.TOPIC_TYPES`:

| key on the bus                    | carries                               | called by         |
|-----------------------------------|---------------------------------------|-------------------|
| shaketwin/<rig>/stream<topic>     | what comes with every block           | publish()         |
| shaketwin/<rig>/event<topic>      | every other record, when it happens   | publish()         |
| shaketwin/<rig>/state/held        | question: what do you hold from n on? | Inbox.get()       |
| shaketwin/<rig>/offer<topic>      | for the gate; it asks at state/offers | publish()         |
| shaketwin/<rig>/cmd/<name>        | a command to the rig, and its answer  | request()         |
| shaketwin/<rig>/cmd/<name>/<who>  | the same to the gate, from outside    | request()         |
| shaketwin/<rig>/alive/<component> | nothing; is there as long as it lives | alive()           |

Full queues drop, so a stalled spoke never slows a publisher. A payload travels in pieces that fit
into one batch of zenoh (with such queues, larger ones never arrive). Every publisher numbers its
pieces and holds the newest; an inbox that finds one missing asks for the rest, a chunk at a time,
and takes nothing newer until it has it. zenoh's own AdvancedPublisher will not do: its put() waits
while history is sent (0.1 s for 5000 blocks, 5 s if the one who asked is stopped), and its
subscriber loses, without a word, the history of a publisher that goes on publishing (1.10.2).
"""

import json
import secrets
from typing import Any

import zenoh

from table_io.card import BadInput
from twin.stream.endpoint import (
    INSIDE,
    OBSERVER,
    Settings,
    cannot_listen,
    check,
    held,
    host_and_port,
    innermost,
    key,
    merged,
    observers,
    safe,
    settings,
)
from twin.stream.keys import Keys
from twin.stream.questions import ASKED_HELD_BYTES, Question, Questions, asked_for, understood
from twin.stream.refusal import refusal, unlisted
from twin.stream.resend import ASK_EVERY_S, Inbox
from twin.stream.shelf import (
    GIVE_UP_S,
    LARGEST_BYTES,
    Listeners,
    Piece,
    Shelf,
    Shelves,
    answer,
    pieces,
)

# An answer is sent as its question was: so the rig's loop never waits for one who asks and stalls.
DROP = zenoh.CongestionControl.DROP
QUESTIONS_WAITING = 64
MOST_PRESENT = 256  # observers who are kept in mind; the run's own components always are


class Link:
    """One process's end of the star; made by `open_hub` or `open_spoke`, used by one thread.

    `refused` counts payloads that were too large to publish.
    """

    def __init__(self, rig: str, session: Any) -> None:
        self.refused = 0
        self._rig = rig
        self._session = session
        self._name = secrets.token_hex(8)
        self._publishers: dict[str, Any] = {}
        self._shelves: Shelves = {}
        self._tokens: dict[str, Any] = {}
        self._open: list[Any] = []
        self._questions: Any = None
        self.listeners = Listeners()

    def declare(self, topics: tuple[str, ...], *, offered: bool = False) -> None:
        """Make ready to publish `topics`, or to offer them to the gate, which no other hears."""
        for topic in topics:
            if topic not in self._publishers:
                self._publishers[topic] = self._session.declare_publisher(
                    key(self._rig, topic, offered=offered), congestion_control=DROP
                )
                self._shelves[topic, self._name] = Shelf()
        if self._questions is None:
            self._questions = self._queryable(held(offered=offered))

    def publish(self, topic: str, payload: bytes) -> None:
        """Send to whoever subscribed, and hold for those who ask later. Never waits."""
        if len(payload) > LARGEST_BYTES:
            self.refused += 1
            return
        end = self._shelves[topic, self._name].end
        for piece in pieces(topic, self._name, end, payload):
            self.relay(piece)
        self.serve()

    def relay(self, piece: Piece) -> None:
        """Send a piece, which may be another publisher's, and hold it. Never waits."""
        self._publishers[piece.topic].put(piece.body, attachment=piece.stamp)
        shelf = self._shelves.setdefault((piece.topic, piece.source), Shelf())
        shelf.add(piece.number, piece.place, piece.body)

    def serve(self) -> bool:
        """Answer one question for held messages if there is one, with at most a chunk.

        Everything one does with a link does this too; a publisher that does nothing for long must
        call it, until those who listen have what they need.
        """
        query = self._questions.try_recv() if self._questions is not None else None
        if query is None:
            return False
        with query:
            text = b"" if query.payload is None else query.payload.to_bytes()
            question = understood(text, ASKED_HELD_BYTES, asked_for)
            if question is None:
                return True  # not one of ours: nothing to say
            said, chunk = answer(self._shelves, question["next"], question["history"])
            self.listeners.note(question, self._shelves)
            if said:
                query.reply(query.key_expr, chunk, attachment=json.dumps(said))
        return True

    def behind(self, within_s: float = GIVE_UP_S) -> int:
        """The most pieces of a topic that anybody lacks who asked this process of late."""
        return self.listeners.behind(self._shelves, within_s)

    def ask(self, question: dict[str, Any], inbox: Inbox) -> None:
        """Ask all publishers for what they hold; answers arrive in the inbox. Never waits."""

        def answered(reply: Any) -> None:
            if reply.ok is not None:
                inbox.arrive("", reply.ok.attachment, reply.ok.payload)

        self._session.get(
            f"shaketwin/{self._rig}/{held(offered=inbox.offered)}",
            zenoh.handlers.Callback(answered, indirect=False),
            payload=json.dumps(question),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            congestion_control=DROP,
            allowed_destination=zenoh.Locality.REMOTE,
            timeout=ASK_EVERY_S,
        )

    def subscribe(
        self, topics: tuple[str, ...], *, history: bool, capacity: int, offered: bool = False
    ) -> Inbox:
        """Inbox of `topics` that keeps at most `capacity` pieces waiting.

        With `history` it begins with what the publishers still hold and loses nothing that they
        hold; without, it begins now and, when full, drops the oldest. `offered`: from outside.
        """
        inbox = Inbox(self, topics, history, capacity, offered)
        for topic in topics:

            def arrived(sample: Any, topic: str = topic) -> None:
                inbox.arrive(topic, sample.attachment, sample.payload)

            # indirect=False: zenoh's own thread fills the inbox, instead of a Python thread each.
            callback = zenoh.handlers.Callback(arrived, indirect=False)
            where = key(self._rig, topic, offered=offered)
            self._open.append(self._session.declare_subscriber(where, callback))
        return inbox

    def questions(self, *paths: str) -> Questions:
        """The questions that others ask under these paths, in which * stands for any part."""
        root = f"shaketwin/{self._rig}/"
        return Questions(self, root, {path: self._queryable(path) for path in paths})

    def commands(self) -> Questions:
        """The commands that others send to this process."""
        return self.questions("cmd/*")

    def _queryable(self, path: str) -> Any:
        waiting: Any = zenoh.handlers.RingChannel(QUESTIONS_WAITING)
        where = f"shaketwin/{self._rig}/{path}"
        self._open.append(self._session.declare_queryable(where, waiting))
        return self._open[-1]

    def inquire(self, path: str, text: str = "", timeout_s: float = 1.0) -> bytes | None:
        """The answer to a question; None if there is none within `timeout_s`."""
        where = f"shaketwin/{self._rig}/{path}"
        asked = self._session.get(where, payload=text, timeout=timeout_s, congestion_control=DROP)
        for reply in asked:
            if reply.ok is not None:
                return bytes(reply.ok.payload.to_bytes())
        return None

    def request(self, command: str, text: str = "", timeout_s: float = 1.0) -> str | None:
        """The answer to a command, to the gate as <name>/<who>; None as above."""
        answer = self.inquire(f"cmd/{command}", text, timeout_s)
        return None if answer is None else answer.decode(errors="replace")

    def pass_on(self, command: str, text: str, question: Question, timeout_s: float) -> None:
        """Answer a question by what the rig says to a command. Never waits."""

        def answered(reply: Any) -> None:
            if reply.ok is not None:
                question.reply(reply.ok.payload.to_bytes())

        callback = zenoh.handlers.Callback(answered, indirect=False)
        where = f"shaketwin/{self._rig}/cmd/{command}"
        self._session.get(where, callback, payload=text, timeout=timeout_s, congestion_control=DROP)

    def alive(self, component: str) -> None:
        """Be among everybody's `components()` until this process ends, or `gone`."""
        where = f"shaketwin/{self._rig}/alive/{component}"
        self._tokens[component] = self._session.liveliness().declare_token(where)

    def gone(self, component: str) -> None:
        """Be among them no more."""
        self._tokens.pop(component).undeclare()

    def components(self) -> set[str]:
        """Names of the components whose processes are connected."""
        self.serve()
        replies = self._session.liveliness().get(f"shaketwin/{self._rig}/alive/*", timeout=1.0)
        found = (str(one.ok.key_expr) for one in replies if one.ok is not None)
        return {safe(one.rsplit("/", 1)[1]) for one in found}

    def presence(self) -> set[str]:
        """The same as a set that zenoh's thread keeps up to date; copy it before you look."""
        names: set[str] = set()

        def changed(sample: Any) -> None:
            name = safe(str(sample.key_expr).rsplit("/", 1)[1])
            if sample.kind != zenoh.SampleKind.PUT:
                names.discard(name)
            elif not name.startswith(OBSERVER) or len(observers(names)) < MOST_PRESENT:
                names.add(name)

        callback = zenoh.handlers.Callback(changed, indirect=False)
        where = f"shaketwin/{self._rig}/alive/*"
        alive = self._session.liveliness()
        self._open.append(alive.declare_subscriber(where, callback, history=True))
        return names

    def close(self) -> None:
        """Leave the star; may be called again."""
        for one in (*self._open, *self._publishers.values(), *self._tokens.values()):
            one.undeclare()
        self._open, self._publishers, self._tokens, self._questions = [], {}, {}, None
        self._session.close()


def open_hub(
    rig: str, endpoint: str, also: Settings | None = None, keys: Keys | None = None
) -> Link:
    """The end that listens at `endpoint`, with settings beside ours; BadInput where it cannot.

    With `keys` only people with a certificate come in, and may do what their role allows.
    """
    check(rig, endpoint, keys is not None)
    config = merged(settings("router", "listen", endpoint, 0), also or {})
    if keys is not None:
        config = merged(config, merged(keys.tls(), keys.access(rig)))
    try:
        # "peer" measured the same, loss and latency; "router" is what zenoh documents for clients.
        return Link(rig, _session(config))
    except zenoh.ZError as error:
        raise BadInput(cannot_listen(endpoint, innermost(error))) from None


def open_spoke(rig: str, endpoint: str, timeout_s: float, keys: Keys | None = None) -> Link:
    """An end connected to the hub at `endpoint`; BadInput when none answers in `timeout_s`.

    Or when it refuses us, and why.
    """
    check(rig, endpoint, keys is not None)
    config = settings("client", "connect", endpoint, timeout_s)
    try:
        session = _session(merged(config, {} if keys is None else keys.tls()))
    except zenoh.ZError:
        why = "" if endpoint.startswith(INSIDE) else refusal(*host_and_port(endpoint), keys)
        start = "start the run first, or give the endpoint it listens at"
        nobody = f"no rig answers there within {timeout_s:g} s; {start}"
        raise BadInput(f"endpoint {endpoint}: {why or nobody}") from None
    link = Link(rig, session)
    if keys is not None and (why := unlisted(link.inquire, keys.name, rig)):
        link.close()
        raise BadInput(f"endpoint {endpoint}: {why}")
    return link


def _session(config: Settings) -> Any:
    return zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
