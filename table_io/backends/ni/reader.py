"""Reads one input in a thread of its own: a driver that does not answer holds nobody else."""

import threading
from collections.abc import Callable
from queue import Empty, Queue

from table_io.block import Float2D

Take = Callable[[int], Float2D]


class Reader:
    """Asked for samples, it hands them over when they have come; one request at a time."""

    def __init__(self, take: Take) -> None:
        self._take = take
        self._asked: Queue[int] = Queue(1)
        self._come: Queue[Float2D | Exception] = Queue(1)
        self._thread = threading.Thread(target=self._run, name="input", daemon=True)
        self._thread.start()

    def ask(self, samples: int) -> None:
        """Read so many, 1 or more."""
        self._asked.put_nowait(samples)

    def come(self, wait_s: float) -> Float2D | None:
        """What was asked for, (channel, sample), None where it has not come; errors are raised."""
        try:
            one = self._come.get(timeout=wait_s)
        except Empty:
            return None
        if isinstance(one, Exception):
            raise one
        return one

    def close(self, patience_s: float) -> None:
        """End the thread; where the driver holds it, leave it behind."""
        if self._asked.empty():
            self._asked.put_nowait(0)
        self._thread.join(patience_s)

    def _run(self) -> None:
        while samples := self._asked.get():
            try:
                self._come.put(self._take(samples))
            except Exception as error:
                self._come.put(error)
