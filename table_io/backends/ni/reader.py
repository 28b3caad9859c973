"""Input reader in a separate thread, so that a driver that hangs does not block the caller."""

import threading
from collections.abc import Callable
from queue import Empty, Queue

from table_io.block import Float2D

ReadInputs = Callable[[int], Float2D]


class InputReader:
    """Reader thread that serves one request for samples at a time."""

    def __init__(self, read_inputs: ReadInputs) -> None:
        self._read_inputs = read_inputs
        self._requests: Queue[int] = Queue(1)
        self._results: Queue[Float2D | Exception] = Queue(1)
        self._thread = threading.Thread(target=self._run, name="input", daemon=True)
        self._thread.start()

    def request(self, samples: int) -> None:
        """Request the next `samples` samples, 1 or more."""
        self._requests.put_nowait(samples)

    def poll(self, timeout_s: float) -> Float2D | None:
        """Return the requested volts, (channel, sample), or None; raise the error of the read."""
        try:
            result = self._results.get(timeout=timeout_s)
        except Empty:
            return None
        if isinstance(result, Exception):
            raise result
        return result

    def close(self, timeout_s: float) -> None:
        """End the thread; abandon it if the driver blocks it longer than the timeout."""
        if self._requests.empty():
            self._requests.put_nowait(0)
        self._thread.join(timeout_s)

    def _run(self) -> None:
        while samples := self._requests.get():
            try:
                self._results.put(self._read_inputs(samples))
            except Exception as error:
                self._results.put(error)
