"""A log with everything in it that an export could lose."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from table_io.block import Block
from table_io.config.base import PROFILES_DIR
from table_io.records import Event, NormalizedResponse, PrcPoint, SampleGap
from tests.reports.recordings import blocks, start_record
from twin.exchange.export import ExportOptions, export_log
from twin.recording.mcap_log import write_items
from twin.recording.reader import Recording
from twin.transport.codec import Item

LOST = (40, 60)  # samples that no block has
SILENT_SAMPLES = 300  # samples at the start of which the twin says nothing


def items() -> list[Item]:
    """A run with a hole, lost samples, a negative zero, odd bits, and a twin that begins late."""
    kept: list[Item] = [Event(0, "state", "running"), SampleGap(40, 20, "", "lost")]
    for item in blocks():
        if isinstance(item, Block):
            values = item.values.copy()
            if item.stream == "meas":
                values[0, 3], values[2, 5:9] = -0.0, np.nan
                values[1] *= 1 + np.finfo(float).eps
            copy = replace(item, values=values)
            ends = (0, *LOST, copy.end) if item.index == 0 else (copy.index, copy.end)
            for first, last in zip(ends[::2], ends[1::2], strict=True):
                if item.stream == "meas" or first >= SILENT_SAMPLES:
                    kept.append(copy.cut(first, last))
        else:
            kept.append(item)
    ratios = NormalizedResponse(0.1, 0.2, 0.3, 0.4, 0.5, float("nan"), (1,), (1,), 0.0, 0.0)
    return [*kept, PrcPoint(1500, 0, "forward", 1.0, ratios, None, 0.49, 0.49, 0.01)]


def export_formats(folder: Path, kinds: tuple[str, ...]) -> tuple[Path, Path]:
    """(the log, it in these formats as out.csv and so on)."""
    path, base = folder / "run.mcap", folder / "out"
    profile = (PROFILES_DIR / "tests" / "g4_ss3.toml").read_text()
    start = replace(start_record(), profile_toml=profile)
    written = items()
    mixed = [*written[9:], *written[:9], written[4]]  # out of order, and one of them twice
    write_items(path, [start, *mixed], start)
    export_log(ExportOptions(path, kinds, base))
    return path, base


LABEL_FIELDS = ("step", "label", "cycle")


def join_measured_blocks(recording: Recording) -> tuple[np.ndarray, ...]:
    """(index, values, step, label, cycle) of every measured sample."""
    pieces = recording.contiguous_blocks("meas")
    index = np.concatenate([np.arange(piece.index, piece.end) for piece in pieces])
    values = np.concatenate([piece.values for piece in pieces], axis=1)
    labels = [np.concatenate([getattr(piece, k) for piece in pieces]) for k in LABEL_FIELDS]
    return index, values, *labels
