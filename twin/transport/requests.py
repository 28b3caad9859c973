"""Request queue: queries from other processes, bounded in number and size, and their replies."""

import json
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeVar

MAX_REQUEST_BYTES = 4096
MAX_HISTORY_QUERY_BYTES = 16 * 2**10  # larger: it names the publishers of every topic
T = TypeVar("T")


def parse_request(text: bytes, max_bytes: int, convert: Callable[[Any], T]) -> T | None:
    """Parse and convert untrusted JSON; return None where it is invalid.

    Invalid is: longer than `max_bytes`, not JSON, nested too deeply, or rejected by `convert`.
    """
    if len(text) > max_bytes:
        return None
    try:
        return convert(json.loads(text))
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError):
        return None


def parse_history_query(data: Any) -> dict[str, Any]:
    """Return `who`, `history` and `next` of a history query as `ReliableSubscriber` sends it.

    Raises one of the errors that `parse_request` catches where the data have another form.
    """
    next_sequences = {
        topic: {str(publisher): int(sequence) for publisher, sequence in sequences.items()}
        for topic, sequences in data["next"].items()
    }
    return {
        "who": str(data.get("who"))[:64],
        "history": bool(data["history"]),
        "next": next_sequences,
    }


class HistoryServer(Protocol):
    """Link that answers history queries."""

    def serve(self) -> bool:
        """Answer one pending history query; return whether there was one."""


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

    def __init__(self, link: HistoryServer, root: str, queryables: dict[str, Any]) -> None:
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
