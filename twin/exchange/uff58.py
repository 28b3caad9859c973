"""Export to UFF 58: each channel over time, and each frequency response of the sweep.

Histories are binary sets with an even abscissa, so that no digit is lost: a sample that was not
recorded is NaN. Frequency responses are text, over the frequencies of the steps. Written by hand:
pyuff writes zeros for NaN.
"""

from pathlib import Path
from typing import BinaryIO

import numpy as np

from table_io.block import Float1D
from table_io.channels import TIME_COLUMN
from twin.exchange.response_functions import REFERENCE, compute_sweep_responses
from twin.recording.tabular import LABEL_UNITS, LogTable

DELIMITER = f"{-1:6d}\n"
QUANTITY_CODES = {"m": 8, "N": 9, "m/s": 11, "m/s2": 12}  # by unit
GENERAL_CODE, TIME_CODE, FREQUENCY_CODE = 1, 17, 18
NO_AXIS = (0, "NONE", "NONE")
ASCII_LINES = 11  # before the binary data
Axis = tuple[int, str, str]  # code of the quantity, its name and unit


def write_uff58(rows: LogTable, path: Path) -> None:
    """Write the channels of a log over time, and their frequency responses."""
    start = rows.start
    index = rows.index
    first, step_s = int(index[0]), 1.0 / start.rate_hz
    texts = [f"shaketwin {start.run}", start.started_at or "NONE", start.name, "NONE"]
    with path.open("wb") as file:
        for name, unit in rows.units.items():
            if name not in (TIME_COLUMN, *LABEL_UNITS):
                values = np.full(int(index[-1]) - first + 1, np.nan)
                values[index - first] = rows.read_columns(slice(None), name)[name]
                shape = f"{4:10d}{values.size:10d}{1:10d}{first * step_s:13.5E}{step_s:13.5E}"
                axes = [(TIME_CODE, "Time", "s"), describe_axis(name, unit), NO_AXIS]
                _write_history(file, [name, *texts], shape, axes, values)
        for response in compute_sweep_responses(rows):
            for name, ratio in response.ratios.items():
                shape = f"{6:10d}{ratio.size:10d}{0:10d}{0.0:13.5E}{0.0:13.5E}"
                axes = [
                    (FREQUENCY_CODE, "Frequency", "Hz"),
                    describe_axis(name, rows.units[name]),
                    describe_axis(REFERENCE, rows.units[REFERENCE]),
                ]
                lines = [f"{name}/{REFERENCE} {response.direction}", *texts]
                pairs = zip(response.frequency_hz.tolist(), ratio.tolist(), strict=True)
                body = "".join(f"{hz:13.5E}{z.real:20.12E}{z.imag:20.12E}\n" for hz, z in pairs)
                write_text_set(file, 4, lines, shape, axes, body)


def describe_axis(name: str, unit: str) -> Axis:
    return QUANTITY_CODES.get(unit, GENERAL_CODE), name, unit or "NONE"


def _format_head(function_type: int, texts: list[str], shape: str, axes: list[Axis]) -> str:
    """Return records 1 to 11 of a set: texts, function, shape of the data, and the axes."""
    place = f" {'NONE':<10}{1:10d}{1:4d}"
    lines = [text[:80] for text in texts]
    lines += [f"{function_type:5d}{1:10d}{0:5d}{0:10d}{place}{place}", f"{shape}{0.0:13.5E}"]
    for code, name, unit in (*axes, NO_AXIS):
        lines.append(f"{code:10d}{0:5d}{0:5d}{0:5d} {name[:20]:<20} {unit[:20]:<20}")
    return "\n".join(lines) + "\n"


def _write_history(
    file: BinaryIO, texts: list[str], shape: str, axes: list[Axis], values: Float1D
) -> None:
    """Write a function of time (type 1) as a binary set: little-endian, IEEE 754 double."""
    size = 8 * values.size
    kind = f"{58:6d}b{1:6d}{2:6d}{ASCII_LINES:12d}{size:12d}{0:6d}{0:6d}{0:12d}{0:12d}\n"
    head = DELIMITER + kind + _format_head(1, texts, shape, axes)
    file.write(head.encode("ascii", "replace") + values.astype("<f8").tobytes())
    file.write(b"\n" + DELIMITER.encode())


def write_text_set(
    file: BinaryIO, function_type: int, texts: list[str], shape: str, axes: list[Axis], body: str
) -> None:
    """Write a function as a text set, its data as lines."""
    head = f"{DELIMITER}{58:6d}\n" + _format_head(function_type, texts, shape, axes)
    file.write((head + body + DELIMITER).encode("ascii", "replace"))
