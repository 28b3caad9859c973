"""A new file that holds a prefix of what was written to it, whatever its disk does."""

import os
from pathlib import Path

from table_io.card import BadInput

PIECE_BYTES = 2**20


class NewFile:
    """Refuses a file that exists. What was written waits in memory until `drain`.

    Where the disk is full or fails, `drain` raises OSError with the path and keeps what is left; it
    may be called again and goes on at the same byte, so that nothing stands twice or half.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._size = 0
        self._waiting = bytearray()
        try:
            self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
        except FileExistsError:
            raise BadInput(
                f"{path}: exists already; nothing recorded is ever overwritten"
            ) from None
        except OSError as error:
            raise BadInput(f"{path}: cannot write here: {error.strerror}") from None

    @property
    def waiting(self) -> int:
        """Bytes that are not in the file yet."""
        return len(self._waiting)

    def write(self, data: bytes) -> int:
        """Append to what waits."""
        self._waiting += data
        self._size += len(data)
        return len(data)

    def tell(self) -> int:
        """Bytes written so far, those that wait included."""
        return self._size

    def flush(self) -> None:
        """Nothing: whoever writes decides with `drain` when the disk is asked."""

    def drain(self) -> None:
        """Hand all that waits to the operating system."""
        try:
            while self._waiting:
                done = os.write(self._descriptor, self._waiting[:PIECE_BYTES])
                del self._waiting[:done]
        except OSError as error:
            raise self._named(error) from None

    def sync(self) -> None:
        """Wait until what was drained is on the disk itself."""
        try:
            os.fsync(self._descriptor)
        except OSError as error:
            raise self._named(error) from None

    def close(self) -> None:
        """Drain and close; may be called again, after an OSError too."""
        self.drain()
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1

    def _named(self, error: OSError) -> OSError:
        return OSError(error.errno, error.strerror, str(self.path))
