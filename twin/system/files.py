"""Files and what differs between operating systems: hashes, locks, cores, the browser.

On Windows and macOS recordings are read, replayed, reported, viewed and made by `--speed max`; a
live run needs Linux.
"""

import contextlib
import hashlib
import os
import stat
import sys
import tempfile
import webbrowser
from pathlib import Path
from typing import TextIO

from table_io.clock import local_datetime

try:
    import fcntl
except ImportError:  # Windows
    HAS_FILE_LOCKS = False
else:
    HAS_FILE_LOCKS = True


def lock_file(file: TextIO, exclusive: bool = False) -> None:
    """Lock an open file until it is closed; BlockingIOError if it cannot be locked exclusively.

    Several processes may hold it shared. Does nothing on Windows, where nothing records live.
    """
    if HAS_FILE_LOCKS:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB if exclusive else fcntl.LOCK_SH)


def hash_file(path: Path) -> str:
    """Return the SHA-256 of a file, hexadecimal; empty if it cannot be read."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return ""


def replace_text(path: Path, text: str) -> None:
    """Replace a file atomically: a reader sees the old or the new one, never a part."""
    new = path.with_name(f"{path.name}.new")
    with new.open("w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    new.replace(path)


_locked_folders: dict[Path, int] = {}  # their descriptors, open until this process ends


def lock_folder(folder: Path) -> None:
    """Lock a folder until this process ends; BlockingIOError if another process has locked it."""
    if not HAS_FILE_LOCKS:
        return
    path = folder.resolve()
    if path in _locked_folders:
        if os.path.samestat(os.fstat(_locked_folders[path]), path.stat()):
            return
        os.close(_locked_folders.pop(path))  # deleted since, and made again
    descriptor = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        raise
    _locked_folders[path] = descriptor


def is_folder_locked(folder: Path) -> bool:
    """Return True if a process has locked the folder with `lock_folder`."""
    if not HAS_FILE_LOCKS:
        return False
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(descriptor)
    return False


def count_cores() -> int:
    """Return the number of cores that this process may use."""
    if sys.platform == "linux":
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def open_in_browser(page: Path) -> bool:
    """Open a page in the user's browser; False where there is no screen for one."""
    has_screen = sys.platform in ("win32", "darwin") or any(
        os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")
    )
    return has_screen and webbrowser.open(page.resolve().as_uri())


SOCKET_PREFIX, VIEW_PREFIX = "shaketwin-bus-", "shaketwin-view-"
MIN_AGE_S = {
    SOCKET_PREFIX: 10.0,  # a folder is locked right after it was made
    VIEW_PREFIX: 3600.0,  # the viewer loads the file after the command that opened it has ended
}
MAX_TEMP_FOLDER_CHARS = 70  # socket paths are limited to about 100


def make_private_folder(prefix: str) -> Path:
    """Create a folder readable by this user only, with a path short enough for a socket.

    It is locked until this process ends. Folders of processes that were killed are removed.
    """
    parent = find_temporary_parent()
    remove_unlocked_folders(parent)
    folder = Path(tempfile.mkdtemp(prefix=prefix, dir=parent))
    with contextlib.suppress(OSError):  # a file system without locks: the age protects it
        lock_folder(folder)
    return folder


def find_temporary_parent() -> Path:
    """Return the folder of temporary folders."""
    usual = Path(tempfile.gettempdir())
    return usual if len(str(usual)) <= MAX_TEMP_FOLDER_CHARS else Path("/tmp")


def remove_unlocked_folders(parent: Path) -> None:
    """Remove this user's temporary folders that no living process has locked.

    Only their files are deleted, no subfolders: nothing else is ever in such a folder.
    """
    for prefix, min_age_s in MIN_AGE_S.items():
        for folder in parent.glob(f"{prefix}*"):
            with contextlib.suppress(OSError):  # removed meanwhile, or not ours
                status = folder.lstat()
                is_ours = stat.S_ISDIR(status.st_mode) and status.st_uid == os.getuid()
                is_old = local_datetime().timestamp() - status.st_mtime > min_age_s
                if is_ours and is_old and not is_folder_locked(folder):
                    for path in folder.iterdir():
                        path.unlink()
                    folder.rmdir()
