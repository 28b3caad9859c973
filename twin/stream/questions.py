"""Questions that others put to a process, bounded in number and size, and their answers."""

import json
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeVar

ASKED_BYTES = 4096  # of a question's text
ASKED_HELD_BYTES = 16 * 2**10  # of one for held pieces: it names each topic's publishers
T = TypeVar("T")


def understood(text: bytes, most: int, checked: Callable[[Any], T]) -> T | None:
    """What `checked` makes of JSON that somebody sent; None where it is not ours.

    That is more than `most` bytes, no JSON, nested too deep, or otherwise than `checked` wants it.
    """
    if len(text) > most:
        return None
    try:
        return checked(json.loads(text))
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError):
        return None


def asked_for(said: Any) -> dict[str, Any]:
    """A question for held pieces as `Inbox` puts it: `who`, `history` and `next`, no more.

    Raises what `understood` catches where it is none.
    """
    wanted = {
        topic: {str(name): int(number) for name, number in known.items()}
        for topic, known in said["next"].items()
    }
    return {"who": str(said.get("who"))[:64], "history": bool(said["history"]), "next": wanted}


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
