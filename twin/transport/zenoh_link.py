"""Bus link: publish-subscribe, queries and liveliness between the processes of a run, over zenoh.

Only this file imports zenoh. The topology is a star: the rig opens the hub, every other process is
a spoke, and the hub forwards between spokes. Keys, with <topic> as in `codec.TOPIC_TYPES`:

| key on the bus                    | carries                                 | sent by         |
|-----------------------------------|-----------------------------------------|-----------------|
| shaketwin/<rig>/stream<topic>     | blocks and comparisons                  | publish()       |
| shaketwin/<rig>/event<topic>      | all other records, when they occur      | publish()       |
| shaketwin/<rig>/state/held        | history query: cached fragments from n  | query_history() |
| shaketwin/<rig>/offer<topic>      | for the gateway only (state/offers)     | publish()       |
| shaketwin/<rig>/cmd/<name>        | command to the rig, and its reply       | send_command()  |
| shaketwin/<rig>/cmd/<name>/<who>  | command from outside, to the gateway    | send_command()  |
| shaketwin/<rig>/alive/<component> | liveliness token while the process runs | declare_alive() |

Full queues drop, so a stalled spoke never slows a publisher. A payload is split into fragments that
fit into one zenoh batch; with dropping queues larger messages never arrive. Publishers number and
cache their fragments; a subscriber that detects a gap requests retransmission chunk by chunk.
zenoh's AdvancedPublisher is unsuitable (1.10.2): its put() blocks while history is sent (0.1 s for
5000 blocks, 5 s if the requester is stopped), and its subscriber silently loses the history of a
publisher that keeps publishing.
"""

import json
import secrets
from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import zenoh

from table_io.clock import RealClock
from twin.security.access_control import ZenohSettings
from twin.transport.endpoint import (
    LOCAL_SOCKET_PREFIX,
    OBSERVER_PREFIX,
    check_endpoint,
    history_query_path,
    key_expression,
    list_observers,
    make_endpoint_error,
    make_listen_error,
    merge_settings,
    sanitize_name,
    session_settings,
    split_host_port,
    zenoh_error_reason,
)
from twin.transport.history_cache import (
    MAX_PAYLOAD_BYTES,
    PUBLISHER_TIMEOUT_S,
    Fragment,
    HistoryCache,
    HistoryCaches,
    HistoryQuery,
    SubscriberProgress,
    build_history_reply,
    parse_history_query,
    split_payload,
)
from twin.transport.reliable_subscriber import QUERY_PERIOD_S, ReliableSubscriber
from twin.transport.session_limits import SessionLimiter

if TYPE_CHECKING:
    from twin.security.credentials import Credentials

# A reply inherits the congestion control of its query: the rig never waits for a stalled requester.
DROP = zenoh.CongestionControl.DROP
MAX_WAITING_QUERIES = 64
MAX_REQUEST_BYTES = 4096
MAX_OBSERVERS = 256  # tracked at once; the run's own components are always tracked


@dataclass(frozen=True, slots=True)
class Request:
    """Pending request; its sender gets no answer unless `reply` is called.

    `path` is the key after shaketwin/<rig>/, for example cmd/stop.
    """

    path: str
    text: str
    _key: str = field(repr=False)
    _query: Any = field(repr=False)

    @property
    def name(self) -> str:
        """Last part of the path."""
        return self.path.rsplit("/", 1)[1]

    def reply(self, body: str | bytes) -> None:
        """Send the answer; call it once."""
        with self._query as query:
            query.reply(self._key, body)


class RequestQueue:
    """Requests to this process, polled without a thread.

    They wait in zenoh's ring buffers, which drop the oldest. `ignored` counts malformed requests.
    """

    def __init__(self, link: "BusLink", root: str, queryables: dict[str, Any]) -> None:
        self.ignored = 0
        self._link = link
        self._root = root
        self._queryables = deque(queryables.items())

    def poll(self) -> Request | None:
        """Return the next request, or None without waiting; also answer a history query."""
        self._link.serve()
        for _ in range(len(self._queryables)):
            self._queryables.rotate()  # so that a flood on one key does not starve the others
            path, queryable = self._queryables[0]
            while (query := queryable.try_recv()) is not None:
                # a query with a wildcard is answered under each key that it matches
                requested_path = (
                    path if "*" not in path else str(query.key_expr).removeprefix(self._root)
                )
                payload = b"" if query.payload is None else query.payload.to_bytes()
                try:
                    if len(payload) <= MAX_REQUEST_BYTES and "*" not in requested_path:
                        return Request(
                            requested_path, payload.decode(), self._root + requested_path, query
                        )
                except UnicodeDecodeError:
                    pass
                self.ignored += 1
                query.drop()
        return None


class BusLink:
    """Connection of one process to the bus; made by `open_hub` or `open_spoke`, for one thread.

    `rejected` counts payloads that were too large to publish.
    """

    def __init__(self, rig: str, session: Any) -> None:
        self.rejected = 0
        self._rig = rig
        self._session = session
        self._name = secrets.token_hex(8)
        self._publishers: dict[str, Any] = {}
        self._caches: HistoryCaches = {}
        self._tokens: dict[str, Any] = {}
        self._declared: list[Any] = []
        self._history_queries: Any = None
        self._session_limiter: SessionLimiter | None = None
        self.subscriber_progress = SubscriberProgress()

    def declare(self, topics: tuple[str, ...], *, offered: bool = False) -> None:
        """Declare publishers of `topics`; with `offered` only the gateway receives them."""
        for topic in topics:
            if topic not in self._publishers:
                self._publishers[topic] = self._session.declare_publisher(
                    key_expression(self._rig, topic, offered=offered), congestion_control=DROP
                )
                self._caches[topic, self._name] = HistoryCache()
        if self._history_queries is None:
            self._history_queries = self._declare_queryable(history_query_path(offered=offered))

    def publish(self, topic: str, payload: bytes) -> None:
        """Publish a payload and cache it for retransmission. Never blocks."""
        if len(payload) > MAX_PAYLOAD_BYTES:
            self.rejected += 1
            return
        end = self._caches[topic, self._name].end
        for fragment in split_payload(topic, self._name, end, payload):
            self.relay(fragment)
        self.serve()

    def relay(self, fragment: Fragment) -> None:
        """Send and cache a fragment, which may be another publisher's. Never blocks."""
        self._publishers[fragment.topic].put(fragment.body, attachment=fragment.header)
        cache = self._caches.setdefault((fragment.topic, fragment.publisher), HistoryCache())
        cache.add(fragment.sequence, fragment.flags, fragment.body)

    def serve(self) -> bool:
        """Answer one pending history query with at most one chunk; return whether there was one.

        Publishing and receiving call this too. An idle publisher must call it until its subscribers
        have caught up.
        """
        if self._session_limiter is not None:
            self._session_limiter.sweep()
        query = self._history_queries.try_recv() if self._history_queries is not None else None
        if query is None:
            return False
        with query:
            text = b"" if query.payload is None else query.payload.to_bytes()
            history_query = parse_history_query(text)
            if history_query is None:
                return True  # malformed: no reply
            entries, chunk = build_history_reply(
                self._caches, history_query.next, history_query.history
            )
            self.subscriber_progress.record_query(history_query, self._caches)
            if entries:
                query.reply(query.key_expr, chunk, attachment=json.dumps(entries))
        return True

    def max_subscriber_lag(self, within_s: float = PUBLISHER_TIMEOUT_S) -> int:
        """Return the largest lag in fragments of the subscribers seen within `within_s`."""
        return self.subscriber_progress.max_lag(self._caches, within_s)

    def query_history(self, query: HistoryQuery, inbox: ReliableSubscriber) -> None:
        """Send a history query to all publishers; replies arrive in `inbox`. Never blocks."""

        def on_reply(reply: Any) -> None:
            if reply.ok is not None:
                inbox.handle_sample("", reply.ok.attachment, reply.ok.payload)

        self._session.get(
            f"shaketwin/{self._rig}/{history_query_path(offered=inbox.offered)}",
            zenoh.handlers.Callback(on_reply, indirect=False),
            payload=query.encode(),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            congestion_control=DROP,
            allowed_destination=zenoh.Locality.REMOTE,
            timeout=QUERY_PERIOD_S,
        )

    def subscribe(
        self, topics: tuple[str, ...], *, history: bool, capacity: int, offered: bool = False
    ) -> ReliableSubscriber:
        """Subscribe to `topics` with a queue of at most `capacity` fragments.

        With `history` delivery starts at the oldest cached fragment and loses nothing that is
        cached. Without it delivery starts now, and a full queue drops the oldest. `offered`
        subscribes to the offers of a remote twin.
        """
        inbox = ReliableSubscriber(self, topics, history, capacity, offered)
        for topic in topics:

            def on_sample(sample: Any, topic: str = topic) -> None:
                inbox.handle_sample(topic, sample.attachment, sample.payload)

            # indirect=False: zenoh's own thread calls back, instead of a Python thread for each.
            callback = zenoh.handlers.Callback(on_sample, indirect=False)
            key = key_expression(self._rig, topic, offered=offered)
            self._declared.append(self._session.declare_subscriber(key, callback))
        return inbox

    def declare_requests(self, *paths: str) -> RequestQueue:
        """Return the queue of requests on these paths; * matches one part of a path."""
        root = f"shaketwin/{self._rig}/"
        return RequestQueue(self, root, {path: self._declare_queryable(path) for path in paths})

    def declare_commands(self) -> RequestQueue:
        """Return the queue of commands to this process."""
        return self.declare_requests("cmd/*")

    def _declare_queryable(self, path: str) -> Any:
        channel: Any = zenoh.handlers.RingChannel(MAX_WAITING_QUERIES)
        key = f"shaketwin/{self._rig}/{path}"
        self._declared.append(self._session.declare_queryable(key, channel))
        return self._declared[-1]

    def query(self, path: str, text: str = "", timeout_s: float = 1.0) -> bytes | None:
        """Return the reply to a query, or None after `timeout_s`; blocks meanwhile."""
        key = f"shaketwin/{self._rig}/{path}"
        replies = self._session.get(key, payload=text, timeout=timeout_s, congestion_control=DROP)
        for reply in replies:
            if reply.ok is not None:
                return bytes(reply.ok.payload.to_bytes())
        return None

    def send_command(self, command: str, text: str = "", timeout_s: float = 1.0) -> str | None:
        """Return the reply to a command, or None after `timeout_s`.

        Commands to the gateway are <name>/<who>.
        """
        answer = self.query(f"cmd/{command}", text, timeout_s)
        return None if answer is None else answer.decode(errors="replace")

    def forward_command(self, command: str, text: str, request: Request, timeout_s: float) -> None:
        """Send a command to the rig and answer `request` with the rig's reply. Never blocks."""

        def on_reply(reply: Any) -> None:
            if reply.ok is not None:
                request.reply(reply.ok.payload.to_bytes())

        callback = zenoh.handlers.Callback(on_reply, indirect=False)
        key = f"shaketwin/{self._rig}/cmd/{command}"
        self._session.get(key, callback, payload=text, timeout=timeout_s, congestion_control=DROP)

    def declare_alive(self, component: str) -> None:
        """Declare a liveliness token, valid until `undeclare_alive` or the end of this process."""
        key = f"shaketwin/{self._rig}/alive/{component}"
        self._tokens[component] = self._session.liveliness().declare_token(key)

    def undeclare_alive(self, component: str) -> None:
        """Withdraw the liveliness token of `component`."""
        self._tokens.pop(component).undeclare()

    def list_components(self) -> set[str]:
        """Return the names of the connected components and observers."""
        self.serve()
        replies = self._session.liveliness().get(f"shaketwin/{self._rig}/alive/*", timeout=1.0)
        keys = (str(reply.ok.key_expr) for reply in replies if reply.ok is not None)
        return {sanitize_name(key.rsplit("/", 1)[1]) for key in keys}

    def watch_components(self) -> set[str]:
        """Return the names of the connected components as a live set.

        zenoh's thread updates it: copy it before iterating.
        """
        names: set[str] = set()

        def on_change(sample: Any) -> None:
            name = sanitize_name(str(sample.key_expr).rsplit("/", 1)[1])
            if sample.kind != zenoh.SampleKind.PUT:
                names.discard(name)
            elif not name.startswith(OBSERVER_PREFIX) or len(list_observers(names)) < MAX_OBSERVERS:
                names.add(name)

        callback = zenoh.handlers.Callback(on_change, indirect=False)
        key = f"shaketwin/{self._rig}/alive/*"
        liveliness = self._session.liveliness()
        self._declared.append(liveliness.declare_subscriber(key, callback, history=True))
        return names

    def limit_sessions(self, limiter: SessionLimiter) -> None:
        """Let `limiter` follow, and close, the sessions of other processes with this hub."""
        self._session_limiter = limiter

        def on_change(event: Any) -> None:
            if event.kind == zenoh.SampleKind.PUT:
                limiter.add(event.link.dst, event.link.auth_identifier or "")
            else:
                limiter.remove(event.link.dst)

        callback = zenoh.handlers.Callback(on_change, indirect=False)
        info = self._session.info
        self._declared.append(info.declare_link_events_listener(callback, history=True))

    def drain_closed_sessions(self) -> set[str]:
        """Return the people of whom sessions were closed as too many since the last call."""
        return set() if self._session_limiter is None else self._session_limiter.drain_closed()

    def close(self) -> None:
        """Close the session; may be called again."""
        for declared in (*self._declared, *self._publishers.values(), *self._tokens.values()):
            declared.undeclare()
        self._declared, self._publishers, self._tokens, self._history_queries = [], {}, {}, None
        self._session.close()


def open_hub(
    rig: str,
    endpoint: str,
    extra_settings: ZenohSettings | None = None,
    keys: "Credentials | None" = None,
) -> BusLink:
    """Open the hub, listening at `endpoint`; raise InputError if that fails.

    With `keys` only certificates of the rig's authority connect, each with the rights of its role.
    """
    check_endpoint(rig, endpoint, keys is not None)
    config = merge_settings(session_settings("router", "listen", endpoint, 0), extra_settings or {})
    if keys is not None:
        config = merge_settings(
            config, merge_settings(keys.tls_settings(), keys.access_settings(rig))
        )
    try:
        # "peer" has the same loss and latency; zenoh documents "router" for serving clients.
        link = BusLink(rig, _open_session(config))
    except zenoh.ZError as error:
        raise make_listen_error(endpoint, zenoh_error_reason(error)) from None
    if keys is not None:
        _, port = split_host_port(endpoint)
        link.limit_sessions(SessionLimiter(port, keys.may_command, RealClock()))
    return link


def open_spoke(
    rig: str, endpoint: str, timeout_s: float, keys: "Credentials | None" = None
) -> BusLink:
    """Connect to the hub at `endpoint`.

    Raises InputError with the reason where it refuses, or does not answer within `timeout_s`.
    """
    check_endpoint(rig, endpoint, keys is not None)
    config = session_settings("client", "connect", endpoint, timeout_s)
    try:
        session = _open_session(merge_settings(config, {} if keys is None else keys.tls_settings()))
    except zenoh.ZError:
        from twin.security.tls_diagnostics import diagnose_refusal  # slow import

        is_local = endpoint.startswith(LOCAL_SOCKET_PREFIX)
        refusal = None if is_local else diagnose_refusal(*split_host_port(endpoint), keys)
        no_answer = (
            f"no rig answers there within {timeout_s:g} s",
            "start the run first, or give the endpoint it listens at",
        )
        raise make_endpoint_error(endpoint, *(refusal or no_answer)) from None
    link = BusLink(rig, session)
    if keys is not None:
        from twin.security.tls_diagnostics import diagnose_missing_role

        if refusal := diagnose_missing_role(link.query, keys.name, rig):
            link.close()
            raise make_endpoint_error(endpoint, *refusal)
    return link


def _open_session(config: ZenohSettings) -> Any:
    return zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
