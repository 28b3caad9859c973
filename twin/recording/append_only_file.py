"""Append-only file: always a clean prefix of the data written, also when the disk fails."""

import contextlib
import os
import sys
from itertools import chain, count
from pathlib import Path
from typing import BinaryIO

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
        self._copy: BinaryIO | None = None  # of a lost file, while it is written again
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

    @property
    def is_lost(self) -> bool:
        """Whether the file, or its folder, was deleted or moved, and is not whole again."""
        is_deleted = os.fstat(self._descriptor).st_nlink == 0
        return is_deleted or self._copy is not None or not self.path.exists()

    def restore(self, max_bytes: int = sys.maxsize) -> bool:
        """Write a lost file again, at most so many bytes in one call; return True once it is whole.

        The open file still holds all data. A file that was moved gets its name back as a link. If
        another file has taken the place, `path` is a free name next to it. OSError if nothing can
        be written: a later call tries again.
        """
        try:
            if self._copy is None:
                self.path.parent.mkdir(parents=True, exist_ok=True)
                self.path = find_free_path(self.path)
                if self._link_again():
                    return True
                self._copy = self.path.open("xb")
            return self._continue_copy(max_bytes)
        except OSError as error:
            self._abandon_copy()
            raise self._with_path(error) from None

    def _link_again(self) -> bool:
        try:
            os.link(f"/proc/self/fd/{self._descriptor}", self.path, follow_symlinks=True)
        except OSError:  # deleted, or on another disk
            return False
        return True

    def _continue_copy(self, max_bytes: int) -> bool:
        """Copy on; once all is copied, the descriptor becomes that of the new file."""
        assert self._copy is not None
        with Path(f"/proc/self/fd/{self._descriptor}").open("rb") as lost:
            lost.seek(self._copy.tell())
            while max_bytes > 0 and (data := lost.read(min(max_bytes, WRITE_CHUNK_BYTES))):
                self._copy.write(data)
                max_bytes -= len(data)
        self._copy.flush()
        if max_bytes <= 0:
            return False
        os.dup2(self._copy.fileno(), self._descriptor, inheritable=False)
        self._copy.close()
        self._copy = None
        return True

    def _abandon_copy(self) -> None:
        if self._copy is not None:
            copy, self._copy = self._copy, None
            with contextlib.suppress(OSError):
                self.path.unlink()
            with contextlib.suppress(OSError):  # its buffer may not fit either
                copy.close()

    def sync(self) -> None:
        """Wait until drained data are on the disk (fsync)."""
        try:
            os.fsync(self._descriptor)
        except OSError as error:
            raise self._with_path(error) from None

    def close(self) -> None:
        """Drain and close; may be called again, also after an OSError.

        A lost file is written again.
        """
        self.drain()
        if self._descriptor >= 0:
            if self.is_lost:
                self.restore()
            os.close(self._descriptor)
            self._descriptor = -1

    def _with_path(self, error: OSError) -> OSError:
        return OSError(error.errno, error.strerror, str(self.path))


def find_free_path(path: Path) -> Path:
    """Return `path`, or the first of <stem>-2, <stem>-3, ... that does not exist."""
    numbered = (path.with_stem(f"{path.stem}-{number}") for number in count(2))
    return next(candidate for candidate in chain([path], numbered) if not candidate.exists())
