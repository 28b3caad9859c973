"""The parts of a live recording become one log; they go only when it has been read back whole."""

import fcntl
import os
import shutil
from pathlib import Path

from table_io.card import BadInput
from twin.service.terminal import say
from twin.stream.folder import PARTS
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
                _whole(parts, held / "run.mcap", folder).rename(out)
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


def _whole(parts: list[Path], new: Path, folder: Path) -> Path:
    """One whole log with everything in the parts, read back by its hash and on the disk."""
    sound = [one for one in parts if verified(one)]
    if len(parts) == 1 and sound:
        new = parts[0]
    else:
        new.unlink(missing_ok=True)  # of an earlier attempt
        merge(parts, new)
        if not verified(new):
            raise BadInput(f"{new}: not what was written; the parts are kept beside it")
        # before the log has its name: whoever finds it takes the parts away
        _keep([one for one in parts if one not in sound and _damaged(one)], folder / "damaged")
    _sync(new)
    return new


def _damaged(part: Path) -> bool:
    """True where more than the end of a part is missing: a disk lost something inside it."""
    size = part.stat().st_size
    return any(
        one.reason != UNFINISHED if one.size == 0 else one.at + one.size < size
        for one in salvage(part).damage
    )


def _keep(damaged: list[Path], kept: Path) -> None:
    """Parts of which something is lost are not thrown away: another tool may read more of them."""
    if not damaged:
        return
    kept.mkdir(exist_ok=True)  # of an earlier attempt
    for one in damaged:
        shutil.copy2(one, kept)
        _sync(kept / one.name)
    say(f"{len(damaged)} parts of the recording are damaged; they are kept in {kept}: see verify")


def _sync(path: Path) -> None:
    """Wait until a file, or what a folder lists, is on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
