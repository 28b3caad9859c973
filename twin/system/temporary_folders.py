"""Temporary folders of this program: private, locked while in use, removed if their owner died."""

import contextlib
import os
import stat
import tempfile
from pathlib import Path

from table_io.clock import local_datetime
from twin.system.files import is_folder_locked, lock_folder

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
