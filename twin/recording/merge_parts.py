"""Merging of a live recording's parts; they are deleted once the log is verified."""

import os
import shutil
from pathlib import Path

from table_io.errors import InputError
from twin.recording.merge import merge, verify_log
from twin.recording.recovery import UNFINISHED_REASON, recover_log
from twin.recording.run_paths import PARTS_FOLDER
from twin.system.files import lock_file
from twin.system.terminal import print_line

LOCK_FILE = "lock"  # held shared by supervisor and recorder while they run


def merge_run_parts(folder: Path) -> Path:
    """Merge the parts of a recording into run.mcap and return its path.

    The parts are kept until the log is verified and synced to the disk.
    """
    parts_folder = folder / PARTS_FOLDER
    out = folder / "run.mcap"
    try:
        with (parts_folder / LOCK_FILE).open("a") as lock:
            lock_file(lock, exclusive=True)
            parts = sorted(parts_folder.glob("part-*.mcap"))
            if out.exists():  # an earlier call ended before it deleted the parts
                if not verify_log(out):
                    raise InputError(
                        f"not a complete log; its parts are in {parts_folder}",
                        where=out,
                        remedy=f"move it to another folder, then: shaketwin report {folder}",
                    )
            elif not parts:
                raise InputError("the recorder wrote nothing", where=folder)
            else:
                _merge_verified(parts, parts_folder / "run.mcap", folder).rename(out)
                _sync(folder)
            shutil.rmtree(parts_folder)
    except BlockingIOError:
        raise InputError(
            "a run is still recording into this folder", where=folder, remedy="wait until it ends"
        ) from None
    except OSError as error:
        raise InputError(
            f"{error.strerror}; the recording is kept in {parts_folder} and readable",
            where=error.filename or folder,
            remedy=f"correct the cause, then: shaketwin report {folder}",
        ) from None
    return out


def _merge_verified(parts: list[Path], new: Path, folder: Path) -> Path:
    """Merge the parts into one log, verified by its content hash and synced to the disk."""
    intact = [part for part in parts if verify_log(part)]
    if len(parts) == 1 and intact:
        new = parts[0]
    else:
        new.unlink(missing_ok=True)  # left by an interrupted attempt
        merge(parts, new)
        if not verify_log(new):
            raise InputError(
                "the merged log differs from what was written; its parts are kept next to it",
                where=new,
                remedy=f"check the disk, then: shaketwin report {folder}",
            )
        # Before the log is renamed: once run.mcap exists, the parts are deleted.
        _keep_damaged(
            [part for part in parts if part not in intact and _has_inner_damage(part)],
            folder / "damaged",
        )
    _sync(new)
    return new


def _has_inner_damage(part: Path) -> bool:
    """Return True if a part is damaged before its end, as by a disk error."""
    size = part.stat().st_size
    return any(
        damage.reason != UNFINISHED_REASON
        if damage.size == 0
        else damage.offset + damage.size < size
        for damage in recover_log(part).damage
    )


def _keep_damaged(parts: list[Path], folder: Path) -> None:
    """Copy damaged parts to `folder`: another tool may recover more of them."""
    if not parts:
        return
    folder.mkdir(exist_ok=True)  # may be left by an interrupted attempt
    for part in parts:
        shutil.copy2(part, folder)
        _sync(folder / part.name)
    print_line(
        f"{len(parts)} parts of the recording are damaged; they are kept in {folder}: see verify"
    )


def _sync(path: Path) -> None:
    """Sync a file or a folder's directory entries to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
