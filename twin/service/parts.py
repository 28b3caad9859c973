"""The parts of a live recording become one log; they go only when it has been read back whole."""

import fcntl
import os
import shutil
from pathlib import Path

from table_io.card import BadInput
from twin.service.terminal import say
from twin.stream.folder import PARTS as PARTS  # noqa: PLC0414
from twin.stream.merging import merge, verified
from twin.stream.salvage import UNFINISHED, salvage

LOCK = "lock"  # shared by supervisor and recorder while they live


def gather(folder: Path) -> Path:
    """run.mcap from the parts of a recording; they are kept until it is whole and on the disk."""
    held = folder / PARTS
    out = folder / "run.mcap"
    try:
        with (held / LOCK).open("a") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            parts = sorted(held.glob("part-*.mcap"))
            if out.exists():  # of a call that ended before the parts were away
                if not verified(out):
                    raise BadInput(f"{out}: not a whole log; move it away, the parts are in {held}")
            elif not parts:
                raise BadInput(f"{folder}: the recorder wrote nothing")
            else:
                damaged = [one for one in parts if _damaged(one)]
                _whole(parts, held / "run.mcap").rename(out)
                if damaged:
                    _keep(damaged, folder)
                _sync(folder)
            shutil.rmtree(held)
    except BlockingIOError:
        raise BadInput(f"{folder}: a run is still going on in this folder; wait") from None
    except OSError as error:
        raise BadInput(
            f"{error.filename or folder}: {error.strerror}; what was recorded is kept in {held} "
            f"and readable. Once this is mended: shaketwin report {folder}"
        ) from None
    return out


def _damaged(part: Path) -> bool:
    """True where more than the end of a part is missing: a disk lost something inside it."""
    if verified(part):
        return False
    lost = salvage(part).damage
    return any(one.at + one.size < part.stat().st_size for one in lost) or any(
        one.size == 0 and one.reason != UNFINISHED for one in lost
    )


def _keep(damaged: list[Path], folder: Path) -> None:
    """Parts of which something is lost are not thrown away: another tool may read more of them."""
    kept = folder / "damaged"
    kept.mkdir()
    for one in damaged:
        shutil.copy2(one, kept)
    say(f"{len(damaged)} parts of the recording are damaged; they are kept in {kept}: see verify")


def _whole(parts: list[Path], new: Path) -> Path:
    """One whole log with everything in the parts, read back by its hash and on the disk."""
    if len(parts) == 1 and verified(parts[0]):
        new = parts[0]
    else:
        new.unlink(missing_ok=True)  # of an earlier attempt
        merge(parts, new)
        if not verified(new):
            raise BadInput(f"{new}: not what was written; the parts are kept beside it")
    _sync(new)
    return new


def _sync(path: Path) -> None:
    """Wait until a file, or what a folder lists, is on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
