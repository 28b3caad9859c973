"""Task `drive`: export of the planned drive as a file for another controller, .

    csv  header line, after comments with unit, rate and hash
    txt  time in s and displacement in mm, separated by a tab, without header
    rpc  RPC III time history (MTS), one channel in mm, short integers with peak 32752
    uff  universal file, one data set 58, evenly spaced double precision, in m
    mat  MATLAB 5: time_s, displacement_mm, rate_hz, sha256
    wav  32-bit PCM, one channel; full scale is `output.span_mm` of the rig file

The hash is SHA-256 of the displacements in m as little-endian float64; `run` plans the same drive.
"""

import hashlib
import math
import struct
import wave
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from table_io.acquisition.external_control import plan_open_loop_drive
from table_io.block import Float1D
from table_io.errors import InputError
from twin.exchange.uff58 import NO_AXIS, TIME_CODE, describe_axis, write_text_set
from twin.setup.run_config import read_run_config

CSV_HEADER = "time_s,drive_disp_mm"
RPC_FRAME_POINTS = 1024
# Readers compute counts * SCALE or counts * SCALE * INT_FULL_SCALE / 32768; with 32768 both agree.
RPC_PEAK, RPC_FULL_SCALE = 32752, 32768
WAV_FULL_SCALE = 2**31 - 1


@dataclass(frozen=True, eq=False)
class DriveFile:
    """Drive displacement in m, (sample,), at `rate_hz`; `span_mm` is the command's full scale."""

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


@dataclass(frozen=True)
class DriveOptions:
    """Test whose planned drive is exported, on the table that it names or another one.

    `file_format`: a key of WRITERS; by the ending of `out` if it is empty.
    """

    profile: Path
    out: Path
    table: str | None = None
    file_format: str = ""


@dataclass(frozen=True)
class ExportedDrive:
    """New drive file: path, format, and the drive in it; its largest value in m."""

    path: Path
    file_format: str
    drive: DriveFile

    @property
    def peak_m(self) -> float:
        return float(np.abs(self.drive.values_m).max())


def export_drive(options: DriveOptions) -> ExportedDrive:
    """Write the planned drive of a test to a new file."""
    out = options.out
    file_format = options.file_format or FORMAT_BY_SUFFIX.get(out.suffix.lower(), "")
    if file_format not in WRITERS:
        raise InputError(
            "unknown format",
            where=f"--format {file_format or out.suffix or out.name!r}",
            allowed=", ".join(WRITERS),
        )
    bundle = read_run_config(options.profile, options.table)
    plan = plan_open_loop_drive(bundle.profile, bundle.rig)
    rest_samples = math.ceil(bundle.profile.acquisition.rest_s * plan.rate_hz)
    values = plan.command(0, plan.rest_start + rest_samples)
    drive = DriveFile(bundle.name, values, plan.rate_hz, bundle.rig.output.span_mm)
    write_drive(out, file_format, drive)
    return ExportedDrive(out, file_format, drive)


def write_drive(path: Path, file_format: str, file: DriveFile) -> None:
    """Write a new drive file; raise InputError if it exists or cannot be written."""
    if path.exists():
        raise InputError(
            "exists already; nothing is overwritten", where=f"-o {path}", remedy="give another name"
        )
    if file_format == "wav" and not file.rate_hz.is_integer():
        raise InputError(
            f"a rate of {file.rate_hz:g} Hz is not whole",
            where="--format wav",
            remedy="use another format",
        )
    partial_path = path.with_name(f".{path.name}.half")
    try:
        WRITERS[file_format](
            partial_path, replace(file, name=file.name.encode("ascii", "replace").decode())
        )
        partial_path.rename(path)
    except OSError as error:
        raise InputError(f"cannot write it: {error.strerror}", where=f"-o {path}") from error
    finally:
        partial_path.unlink(missing_ok=True)


def _write_csv(path: Path, file: DriveFile) -> None:
    header = (
        f"# shaketwin drive of {file.name}\n# rate_hz {file.rate_hz!r}\n# unit mm, right positive\n"
        f"# sha256 {file.sha256}\n{CSV_HEADER}\n"
    )
    _write_columns(path, file, header, ",")


def _write_txt(path: Path, file: DriveFile) -> None:
    _write_columns(path, file, "", "\t")


def _write_columns(path: Path, file: DriveFile, header: str, delimiter: str) -> None:
    rows = np.stack([file.time_s, file.values_m * 1e3], axis=1)
    with path.open("w", encoding="ascii") as out:
        out.write(header)
        np.savetxt(out, rows, fmt=("%.7f", "%.9f"), delimiter=delimiter)


def _write_rpc(path: Path, file: DriveFile) -> None:
    frames = math.ceil(file.values_m.size / RPC_FRAME_POINTS)
    peak = float(np.abs(file.values_m).max()) * 1e3
    scale = peak / RPC_PEAK
    values = np.zeros(frames * RPC_FRAME_POINTS, dtype="<i2")
    values[: file.values_m.size] = np.rint(file.values_m * 1e3 / scale)
    parameters = {
        "FILE_TYPE": "TIME_HISTORY",
        "TIME_TYPE": "DRIVE",
        "DELTA_T": f"{1.0 / file.rate_hz:.6E}",
        "CHANNELS": "1",
        "DATE": "",
        "REPEATS": "1",
        "DATA_TYPE": "SHORT_INTEGER",
        "INT_FULL_SCALE": f"{RPC_FULL_SCALE}",
        "PTS_PER_FRAME": f"{RPC_FRAME_POINTS}",
        "PTS_PER_GROUP": f"{RPC_FRAME_POINTS}",
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
    blocks = math.ceil((len(parameters) + 3) / 4)
    leading = {
        "FORMAT": "BINARY_IEEE_LITTLE_END",
        "NUM_HEADER_BLOCKS": f"{blocks}",
        "NUM_PARAMS": f"{len(parameters) + 3}",
    }
    header = b"".join(
        struct.pack("32s96s", key.encode(), value.encode())
        for key, value in (leading | parameters).items()
    )
    path.write_bytes(header.ljust(512 * blocks, b"\0") + values.tobytes())


def _write_uff(path: Path, file: DriveFile) -> None:
    lines = [
        "drive_disp_m",
        f"shaketwin drive of {file.name}",
        "NONE",
        f"sha256 {file.sha256}",
        "NONE",
    ]
    shape = f"{4:10d}{file.values_m.size:10d}{1:10d}{0.0:13.5E}{1.0 / file.rate_hz:13.5E}"
    axes = [(TIME_CODE, "Time", "s"), describe_axis("Displacement", "m"), NO_AXIS]
    rows = (file.values_m[k : k + 4] for k in range(0, file.values_m.size, 4))
    body = "".join("".join(f"{value:20.12E}" for value in row) + "\n" for row in rows)
    with path.open("wb") as out:
        write_text_set(out, 1, lines, shape, axes, body)


def _write_mat(path: Path, file: DriveFile) -> None:
    from scipy.io import savemat

    variables = {
        "time_s": file.time_s[:, None],
        "displacement_mm": file.values_m[:, None] * 1e3,
        "rate_hz": file.rate_hz,
        "sha256": file.sha256,
    }
    savemat(path, variables, appendmat=False)


def _write_wav(path: Path, file: DriveFile) -> None:
    share = file.values_m * 1e3 / file.span_mm
    with wave.open(str(path), "wb") as out:
        out.setparams((1, 4, int(file.rate_hz), share.size, "NONE", ""))
        out.writeframes(np.rint(share * WAV_FULL_SCALE).astype("<i4").tobytes())


WRITERS: dict[str, Callable[[Path, DriveFile], None]] = {
    "csv": _write_csv, "txt": _write_txt, "rpc": _write_rpc, "uff": _write_uff, "mat": _write_mat,
    "wav": _write_wav,
}  # fmt: skip
FORMAT_BY_SUFFIX = {
    ".csv": "csv", ".txt": "txt", ".dat": "txt", ".asc": "txt", ".rpc": "rpc", ".drv": "rpc",
    ".rsp": "rpc", ".tim": "rpc", ".uff": "uff", ".unv": "uff", ".u58": "uff", ".mat": "mat",
    ".wav": "wav",
}  # fmt: skip
