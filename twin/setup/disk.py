"""Disk space for a recording: checked before a run, forecast during it, reserved for its end."""

import contextlib
import os
import shutil
import sys
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from table_io.errors import InputError
from twin.compare import TWIN_CHANNELS
from twin.setup.run_config import RunConfig

SAMPLE_BYTES = 8  # per sample and channel, uncompressed; compressed 0.60 to 0.77 of it, measured
COMPARISON_CHANNELS = 2  # comparisons and hashes take as much as so many channels
REPORT_BYTES = 50 * 10**6  # report, figures and summary
RESERVE_S = 60.0  # of recording: to bring the table to rest and close the file
LAST_WARNING_S = 120.0  # of recording left, at which the second and last warning is given


def bytes_per_s(config: RunConfig) -> float:
    """Return the upper bound of the recording rate in bytes/s: samples and twin, uncompressed."""
    twin_channels = len(TWIN_CHANNELS) / max(config.predictions_every, 1) + COMPARISON_CHANNELS
    return config.drive.rate_hz * SAMPLE_BYTES * (len(config.rig.channels) + twin_channels)


def planned_bytes(config: RunConfig) -> float:
    """Return the upper bound in bytes of what the planned test writes to the disk."""
    seconds = config.expected_s
    seconds += config.rig.backend_section.max_start_wait_s
    return bytes_per_s(config) * (seconds + RESERVE_S) + REPORT_BYTES


def free_bytes(folder: Path) -> int:
    """Return the free bytes on the disk of `folder`, which need not exist yet."""
    existing = next(
        path for path in (folder.absolute(), *folder.absolute().parents) if path.exists()
    )
    usage = shutil.disk_usage(existing)
    return usage.free if usage.total else sys.maxsize  # not a disk: writing there will fail


def require_disk_space(configs: Iterable[RunConfig], folder: Path) -> None:
    """Raise InputError if the recordings of the tests do not fit on the disk of `folder`."""
    needed, free = sum(map(planned_bytes, configs)), free_bytes(folder)
    if needed > free:
        raise InputError(
            f"{format_size(free)} free on its disk, but the recording takes up to "
            f"{format_size(needed)}; nothing was started",
            where=folder,
            remedy="make room, or give another disk with --out",
        )


@dataclass(slots=True)
class DiskForecast:
    """Forecast of a full disk from the growth rate of the recording."""

    planned_s: float
    _baseline: tuple[int, float] | None = None  # first bytes and run time in s of this part
    _warned_kinds: set[str] = field(default_factory=set)

    def check(self, written: int, recorded_s: float, free: int) -> str | None:
        """Return a warning, each kind once, or None if the remaining test fits on the disk.

        `written` and `free` are in bytes, `recorded_s` is the run time recorded.
        """
        self._baseline = self._baseline or (written, recorded_s)
        # A restarted recorder begins by writing what the run has published so far.
        bytes_before, seconds_before = self._baseline
        elapsed_s = recorded_s - seconds_before
        rate = (written - bytes_before) / elapsed_s if elapsed_s > 0 else 0.0
        remaining_s = self.planned_s - recorded_s
        if rate <= 0 or remaining_s <= 0 or free > rate * remaining_s:
            return None
        room_s = free / rate
        kind = "short" if room_s < LAST_WARNING_S else "tight"
        if kind in self._warned_kinds:
            return None
        self._warned_kinds.add(kind)
        return (
            f"{format_size(free)} left on the disk: room for {room_s:.0f} s of recording, the "
            f"test needs {remaining_s:.0f} s more; make room, or the table is stopped when the "
            "disk is full"
        )


class DiskReserve:
    """Preallocated file, released on a full disk so that the way to rest can still be recorded."""

    def __init__(self, path: Path, size: int) -> None:
        self._path = path
        # Optional: a full disk or a file system without preallocation leaves no reserve.
        with contextlib.suppress(OSError):
            descriptor = os.open(path, os.O_WRONLY | os.O_CREAT, 0o600)
            try:
                os.posix_fallocate(descriptor, 0, size)
            finally:
                os.close(descriptor)

    def release(self) -> None:
        """Delete the reserve file; repeated calls have no effect."""
        with contextlib.suppress(OSError):
            self._path.unlink(missing_ok=True)


def format_size(size_bytes: float) -> str:
    return f"{size_bytes / 1e9:.3g} GB" if size_bytes >= 1e9 else f"{size_bytes / 1e6:.3g} MB"
