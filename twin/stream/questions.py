"""Questions that others put to a process, bounded in number and size, and their answers."""

from collections import deque
from dataclasses import dataclass, field
from typing import Any, Protocol

ASKED_BYTES = 4096  # of a question's text


class Answerer(Protocol):
    """What questions need of their link."""

    def serve(self) -> bool:
        """Answer a question for held messages, if there is one."""


@dataclass(frozen=True, slots=True)
class Question:
    """A question that waits for `reply`; whoever asks gets nothing if that is never called.

    `path` is what follows the rig in its key, as cmd/stop.
    """

    path: str
    text: str
    _key: str = field(repr=False)
    _query: Any = field(repr=False)

    @property
    def name(self) -> str:
        """The last part of its path."""
        return self.path.rsplit("/", 1)[1]

    def reply(self, body: str | bytes) -> None:
        """Answer, once."""
        with self._query as query:
            query.reply(self._key, body)


class Questions:
    """Questions to this process. No thread: they wait in zenoh, where the oldest gives way."""

    def __init__(self, link: Answerer, root: str, queryables: dict[str, Any]) -> None:
        self.ignored = 0
        self._link = link
        self._root = root
        self._queryables = deque(queryables.items())

    def poll(self) -> Question | None:
        """The next question, or None at once."""
        self._link.serve()
        for _ in range(len(self._queryables)):
            self._queryables.rotate()  # a flood of one kind of question keeps no other waiting
            path, queryable = self._queryables[0]
            while (query := queryable.try_recv()) is not None:
                # who asks for many keys at once is answered under each that is one
                asked = path if "*" not in path else str(query.key_expr).removeprefix(self._root)
                payload = b"" if query.payload is None else query.payload.to_bytes()
                try:
                    if len(payload) <= ASKED_BYTES and "*" not in asked:
                        return Question(asked, payload.decode(), self._root + asked, query)
                except UnicodeDecodeError:
                    pass
                self.ignored += 1
                query.drop()
        return None
