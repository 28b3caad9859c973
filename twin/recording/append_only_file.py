"""Append-only file: always a clean prefix of the data written, also when the disk fails."""

import os
import shutil
from pathlib import Path

from table_io.errors import InputError

WRITE_CHUNK_BYTES = 2**20


class AppendOnlyFile:
    """New file with a write buffer in memory, written by `drain`; refuses to overwrite a file.

    If the disk is full or fails, `drain` raises OSError with the path and keeps the unwritten
    bytes. Called again, it continues at the same byte, so no data are repeated or lost.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._size = 0
        self._pending = bytearray()
        try:
            self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
        except FileExistsError:
            raise InputError(
                "exists already", where=path, remedy="nothing recorded is ever overwritten"
            ) from None
        except OSError as error:
            raise InputError(f"cannot write here: {error.strerror}", where=path) from None

    @property
    def pending_bytes(self) -> int:
        """Number of buffered bytes that are not in the file yet."""
        return len(self._pending)

    def write(self, data: bytes) -> int:
        """Append to the buffer; return the number of bytes."""
        self._pending += data
        self._size += len(data)
        return len(data)

    def tell(self) -> int:
        """Return the number of bytes written so far, including the buffer."""
        return self._size

    def flush(self) -> None:
        """Do nothing; mcap calls it, but `drain` decides when data are written."""

    def drain(self) -> None:
        """Write the buffer to the operating system."""
        try:
            while self._pending:
                written = os.write(self._descriptor, self._pending[:WRITE_CHUNK_BYTES])
                del self._pending[:written]
        except OSError as error:
            raise self._with_path(error) from None

    def restore(self) -> bool:
        """Write the file again where it, or its folder, was deleted or moved; True if it was.

        The open file still holds all data; the descriptor then is that of the new file. OSError if
        the new file cannot be written, or if another file has taken the place.
        """
        opened = os.fstat(self._descriptor)
        try:
            if os.path.samestat(opened, self.path.stat()):
                return False
        except FileNotFoundError:
            pass
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with (
                Path(f"/proc/self/fd/{self._descriptor}").open("rb") as lost,
                self.path.open("xb") as new,
            ):
                shutil.copyfileobj(lost, new, WRITE_CHUNK_BYTES)
                new.flush()
                os.dup2(new.fileno(), self._descriptor, inheritable=False)
        except OSError as error:
            raise self._with_path(error) from None
        return True

    def sync(self) -> None:
        """Wait until drained data are on the disk (fsync)."""
        try:
            os.fsync(self._descriptor)
        except OSError as error:
            raise self._with_path(error) from None

    def close(self) -> None:
        """Drain and close; may be called again, also after an OSError.

        A file that was deleted or moved is written again.
        """
        self.drain()
        if self._descriptor >= 0:
            self.restore()
            os.close(self._descriptor)
            self._descriptor = -1

    def _with_path(self, error: OSError) -> OSError:
        return OSError(error.errno, error.strerror, str(self.path))
