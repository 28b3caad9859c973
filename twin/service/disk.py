"""Room for a recording: asked for before a run, watched during it, kept in reserve for its end."""

import contextlib
import os
import shutil
import sys
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from table_io.card import BadInput
from twin.compare import PREDICTED
from twin.service.bundle import Bundle

SAMPLE_BYTES = 8  # what is written, packed, measured 0.60 to 0.77 of this a sample and channel
BESIDE_BYTES = 50 * 10**6  # report, figures and summary of a run
RESERVE_S = 60.0  # of recording: the way to rest and the end of the file
SHORT_S = 120.0  # of recording left: the second and last warning


def bytes_per_s(bundle: Bundle) -> float:
    """What a run writes in a second, at the most: its samples and the twin's, unpacked."""
    return bundle.drive.rate_hz * SAMPLE_BYTES * (len(bundle.rig.channels) + len(PREDICTED))


def planned_bytes(bundle: Bundle) -> float:
    """What the planned test leaves on the disk, at the most."""
    seconds = bundle.drive.planned_end / bundle.drive.rate_hz
    if bundle.rig.follow is not None:
        seconds += bundle.rig.follow.wait_s  # for the controller to be started
    return bytes_per_s(bundle) * (seconds + RESERVE_S) + BESIDE_BYTES


def free_bytes(folder: Path) -> int:
    """Bytes free where `folder` is or would be made."""
    there = next(one for one in (folder.absolute(), *folder.absolute().parents) if one.exists())
    usage = shutil.disk_usage(there)
    return usage.free if usage.total else sys.maxsize  # no disk at all: writing there will say so


def refuse_full(bundles: Iterable[Bundle], folder: Path) -> None:
    """BadInput where the tests do not fit on the disk of `folder`; nothing was started."""
    needed, free = sum(map(planned_bytes, bundles)), free_bytes(folder)
    if needed > free:
        raise BadInput(
            f"{folder}: {_size(free)} free on its disk, but the recording takes up to "
            f"{_size(needed)}; nothing was started. Make room, or give another disk with --out"
        )


@dataclass(slots=True)
class Room:
    """Foresees a full disk from how fast the recording grows; `look` says what is new."""

    planned_s: float
    _first: tuple[int, float] | None = None  # of this part: bytes, seconds of the run
    _said: set[str] = field(default_factory=set)

    def look(self, written: int, recorded_s: float, free: int) -> str | None:
        """A warning, each kind once, from bytes written in so many seconds and bytes free."""
        self._first = self._first or (written, recorded_s)
        bytes_before, s_before = self._first  # a successor begins with what the run had recorded
        seen_s = recorded_s - s_before
        rate = (written - bytes_before) / seen_s if seen_s > 0 else 0.0
        left_s = self.planned_s - recorded_s
        if rate <= 0 or left_s <= 0 or free > rate * left_s:
            return None
        room_s = free / rate
        kind = "short" if room_s < SHORT_S else "tight"
        if kind in self._said:
            return None
        self._said.add(kind)
        return (
            f"{_size(free)} left on the disk: room for {room_s:.0f} s of recording, the test needs "
            f"{left_s:.0f} s more; make room, or the table is stopped when the disk is full"
        )


class Reserve:
    """Room that a recorder keeps from others, to bring the table to rest on a full disk."""

    def __init__(self, path: Path, size: int) -> None:
        self._path = path
        # Without it (the disk is full, or cannot promise room) the recorder does what it can.
        with contextlib.suppress(OSError):
            descriptor = os.open(path, os.O_WRONLY | os.O_CREAT, 0o600)
            try:
                os.posix_fallocate(descriptor, 0, size)
            finally:
                os.close(descriptor)

    def release(self) -> None:
        """Give the room back; may be called again."""
        with contextlib.suppress(OSError):
            self._path.unlink(missing_ok=True)


def _size(count: float) -> str:
    return f"{count / 1e9:.3g} GB" if count >= 1e9 else f"{count / 1e6:.3g} MB"
