"""`shaketwin drive`: the planned drive as a file that another controller plays; and it read back.

    csv  a line of names, after comments with the units, the rate and the hash
    txt  time in s and displacement in mm, a tab between them, nothing else
    rpc  RPC III time history (MTS), one channel in mm, short integers: 32752 is its peak
    uff  universal file, one data set 58, evenly spaced double precision, in m
    mat  MATLAB 5: time_s, displacement_mm, rate_hz, sha256
    wav  32-bit PCM, one channel: full scale is the card's span

The hash is SHA-256 of the displacements in m as little-endian float64: `run` plans the same ones.
"""

import hashlib
import math
import struct
import wave
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from table_io.block import Float1D
from table_io.card import BadInput
from table_io.following import planned
from twin.service.bundle import read_bundle
from twin.service.terminal import say

COLUMNS = "time_s,drive_disp_mm"
RPC_FRAME = 1024  # points
# Counts. Readers differ in whether a value is counts * SCALE or that * INT_FULL_SCALE / 32768; with
# this header both are the same.
RPC_PEAK, RPC_FULL_SCALE = 32752, 32768
FULL_SCALE = 2**31 - 1


@dataclass(frozen=True, eq=False)
class DriveFile:
    """Displacement in m, (sample,), at a rate; `span_mm` is the command's full scale."""

    name: str
    values_m: Float1D
    rate_hz: float
    span_mm: float

    @property
    def sha256(self) -> str:
        return hashlib.sha256(self.values_m.astype("<f8").tobytes()).hexdigest()

    @property
    def time_s(self) -> Float1D:
        return np.arange(self.values_m.size) / self.rate_hz


def drive(profile: Path, table: str | None, out: Path, kind: str) -> None:
    """Writes the planned drive of a test to a new file."""
    kind = kind or ENDINGS.get(out.suffix.lower(), "")
    if kind not in WRITERS:
        raise BadInput(
            f"--format {kind or out.suffix or out.name!r}: unknown; allowed: {', '.join(WRITERS)}"
        )
    bundle = read_bundle(profile, table)
    plan, rig = planned(bundle.profile, bundle.rig), bundle.rig
    rest = math.ceil(bundle.profile.acquisition.rest_s * plan.rate_hz)
    values = plan.command(0, plan.rest_from + rest)
    file = DriveFile(bundle.name, values, plan.rate_hz, rig.output.span_mm)
    write(out, kind, file)
    say(
        f"{out} ({kind}): {values.size} values at {plan.rate_hz:g} Hz, "
        f"{values.size / plan.rate_hz:.1f} s, largest {abs(values).max() * 1e3:.4g} mm, sha256 "
        f"{file.sha256}"
    )
    if kind == "rpc":
        step = abs(values).max() * 1e6 / RPC_PEAK
        say(f"one step of its short integers is {step:.3g} um; the other formats are finer")
    say("play it once, from rest, unscaled, with no ramp and no filter of the controller's own")


def write(path: Path, kind: str, file: DriveFile) -> None:
    """Writes a new file of this kind; BadInput where it exists or cannot be written."""
    if path.exists():
        raise BadInput(f"-o {path}: exists; nothing is overwritten, name another")
    if kind == "wav" and not file.rate_hz.is_integer():
        raise BadInput(f"wav: a rate of {file.rate_hz:g} Hz is not whole; take another format")
    half = path.with_name(f".{path.name}.half")
    try:
        WRITERS[kind](half, replace(file, name=file.name.encode("ascii", "replace").decode()))
        half.rename(path)
    except OSError as error:
        raise BadInput(f"-o {path}: cannot write it: {error.strerror}") from None
    finally:
        half.unlink(missing_ok=True)


def _csv(path: Path, file: DriveFile) -> None:
    head = (
        f"# shaketwin drive of {file.name}\n# rate_hz {file.rate_hz!r}\n# unit mm, right positive\n"
        f"# sha256 {file.sha256}\n{COLUMNS}\n"
    )
    _columns(path, file, head, ",")


def _txt(path: Path, file: DriveFile) -> None:
    _columns(path, file, "", "\t")


def _columns(path: Path, file: DriveFile, head: str, between: str) -> None:
    rows = np.stack([file.time_s, file.values_m * 1e3], axis=1)
    with path.open("w", encoding="ascii") as out:
        out.write(head)
        np.savetxt(out, rows, fmt=("%.7f", "%.9f"), delimiter=between)


def _rpc(path: Path, file: DriveFile) -> None:
    frames = math.ceil(file.values_m.size / RPC_FRAME)
    peak = float(np.abs(file.values_m).max()) * 1e3
    scale = peak / RPC_PEAK
    values = np.zeros(frames * RPC_FRAME, dtype="<i2")
    values[: file.values_m.size] = np.rint(file.values_m * 1e3 / scale)
    words = {
        "FILE_TYPE": "TIME_HISTORY",
        "TIME_TYPE": "DRIVE",
        "DELTA_T": f"{1.0 / file.rate_hz:.6E}",
        "CHANNELS": "1",
        "DATE": "",
        "REPEATS": "1",
        "DATA_TYPE": "SHORT_INTEGER",
        "INT_FULL_SCALE": f"{RPC_FULL_SCALE}",
        "PTS_PER_FRAME": f"{RPC_FRAME}",
        "PTS_PER_GROUP": f"{RPC_FRAME}",
        "FRAMES": f"{frames}",
        "HALF_FRAMES": "0",
        "BYPASS_FILTER": "0",
        "PARTITIONS": "1",
        "PART.CHAN_1": "1",
        "PART.NCHAN_1": "1",
        "DESC.CHAN_1": "drive_disp",
        "UNITS.CHAN_1": "mm",
        "SCALE.CHAN_1": f"{scale:.9E}",
        "LOWER_LIMIT.CHAN_1": f"{-peak:.6E}",
        "UPPER_LIMIT.CHAN_1": f"{peak:.6E}",
        "MAP.CHAN_1": "1",
        "DRIVE_SHA256": file.sha256,
    }
    blocks = math.ceil((len(words) + 3) / 4)
    first = {
        "FORMAT": "BINARY_IEEE_LITTLE_END",
        "NUM_HEADER_BLOCKS": f"{blocks}",
        "NUM_PARAMS": f"{len(words) + 3}",
    }
    head = b"".join(
        struct.pack("32s96s", key.encode(), word.encode()) for key, word in (first | words).items()
    )
    path.write_bytes(head.ljust(512 * blocks, b"\0") + values.tobytes())


def _uff(path: Path, file: DriveFile) -> None:
    node = f" {'NONE':<10}{0:10d}{0:4d}"
    axis = "{:10d}{:5d}{:5d}{:5d} {:<20} {:<20}"
    lines = [
        f"{-1:6d}",
        f"{58:6d}",
        "drive_disp_m",
        f"shaketwin drive of {file.name}"[:80],
        "NONE",
        f"sha256 {file.sha256}",
        "NONE",
        f"{1:5d}{1:10d}{0:5d}{0:10d}{node}{node}",
        f"{4:10d}{file.values_m.size:10d}{1:10d}{0.0:13.5E}{1.0 / file.rate_hz:13.5E}{0.0:13.5E}",
        axis.format(17, 0, 0, 0, "Time", "s"),
        axis.format(8, 1, 0, 0, "Displacement", "m"),
        axis.format(0, 0, 0, 0, "NONE", "NONE"),
        axis.format(0, 0, 0, 0, "NONE", "NONE"),
    ]
    for k in range(0, file.values_m.size, 4):
        lines.append("".join(f"{one:20.12E}" for one in file.values_m[k : k + 4]))
    lines.append(f"{-1:6d}")
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


def _mat(path: Path, file: DriveFile) -> None:
    from scipy.io import savemat

    held = {
        "time_s": file.time_s[:, None],
        "displacement_mm": file.values_m[:, None] * 1e3,
        "rate_hz": file.rate_hz,
        "sha256": file.sha256,
    }
    savemat(path, held, appendmat=False)


def _wav(path: Path, file: DriveFile) -> None:
    share = file.values_m * 1e3 / file.span_mm
    with wave.open(str(path), "wb") as out:
        out.setparams((1, 4, int(file.rate_hz), share.size, "NONE", ""))
        out.writeframes(np.rint(share * FULL_SCALE).astype("<i4").tobytes())


WRITERS: dict[str, Callable[[Path, DriveFile], None]] = {
    "csv": _csv, "txt": _txt, "rpc": _rpc, "uff": _uff, "mat": _mat, "wav": _wav,
}  # fmt: skip
ENDINGS = {
    ".csv": "csv", ".txt": "txt", ".dat": "txt", ".asc": "txt", ".rpc": "rpc", ".drv": "rpc",
    ".rsp": "rpc", ".tim": "rpc", ".uff": "uff", ".unv": "uff", ".u58": "uff", ".mat": "mat",
    ".wav": "wav",
}  # fmt: skip


def read_drive(path: Path) -> tuple[Float1D, float]:
    """(displacement in m, (sample,), rate in Hz) of a csv or txt file; BadInput says what is wrong.

    For the simulated controller: a real one reads the file itself.
    """
    try:
        lines = path.read_text(encoding="ascii").splitlines()
        rows = [line for line in lines if line and line[0] in "0123456789-+. "]
        table = np.loadtxt(rows, delimiter="," if "," in rows[0] else None, ndmin=2)
    except (OSError, ValueError, IndexError) as error:
        raise BadInput(
            f"--play {path}: no drive file ({error}); make one: shaketwin drive PROFILE -o FILE.csv"
        ) from None
    steps = np.diff(table[:, 0])
    if table.shape[1] != 2 or table.shape[0] < 2 or not steps.min() > 0:
        raise BadInput(f"--play {path}: wants two columns, time in s and displacement in mm")
    if not np.isfinite(table).all():
        raise BadInput(f"--play {path}: has values that are no numbers; make it again")
    return table[:, 1] * 1e-3, round(float(1.0 / steps.mean()), 3)
