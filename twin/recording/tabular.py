"""Tabular view of a log: one row per measured sample, with all its columns, for exports.

Samples are kept in scratch files, so that memory does not grow with the recording. Each sample has
one row, sorted by index, in whatever order and however often it was recorded. A gap has no rows;
twin columns are NaN where the twin has no output. Invalid items are left out by the rules of
`reader.read_recording`.
"""

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from table_io.block import Block, Float1D, Float2D, Int1D
from table_io.channels import (
    RELATIVE_DISP_SOURCES,
    TIME_COLUMN,
    Channel,
    list_derived_channels,
)
from table_io.config.channel import read_channels
from table_io.errors import InputError
from table_io.records import Event, PrcPoint, Record, RunStart, RunStop, Step, StepAdded
from twin.recording.mcap_log import iter_messages
from twin.recording.reader import START_TOPIC, iter_valid_items, read_start
from twin.transport.codec import TOPIC_TYPES, Item
from twin.transport.endpoint import MEAS_TOPIC, PRED_TOPIC

# Columns of every sample in addition to its channels, and their units.
LABEL_UNITS = {
    "step": "", "label": "", "cycle": "", "direction": "", "frequency_hz": "Hz",
    "level_m_s2": "m/s2",
}  # fmt: skip
DIRECTION_SIGNS = {"forward": 1, "backward": -1}
TWIN_PREFIX = "twin_"
UNIX_TIME_COLUMN = "unix_time_s"  # last of CSV, which holds no other facts of the run
SCRATCH_COLUMNS = ("index", "step", "label", "cycle")  # before the channels of a sample
KEPT_RECORDS = (RunStop, Event, PrcPoint, StepAdded)
MAX_LATENESS_S = 1.0  # of a message after later ones, in a log that can be read in order
WINDOW_ROWS = 2**14  # rows read at once
Columns = dict[str, npt.NDArray[Any]]  # (row,) each, float64 or int64


@dataclass(eq=False)
class _ScratchFile:
    """Blocks of one stream in order of arrival: (sample, SCRATCH_COLUMNS + channels), float64."""

    file: IO[bytes]
    channels: tuple[str, ...] = ()
    size: int = 0  # samples

    def add(self, block: Block, path: Path) -> None:
        """Append the samples of a block."""
        if not self.size:
            self.channels = block.channels
        if block.channels != self.channels:
            raise InputError(
                f"sample {block.index} has other channels than those before it",
                where=path,
                remedy="such a log cannot be exported as one table",
            )
        index = np.arange(block.index, block.end)
        rows = np.vstack([index, block.step, block.label, block.cycle, block.values]).T
        self.file.write(np.ascontiguousarray(rows, np.float64).tobytes())
        self.size += len(block)

    def sort_by_index(self) -> tuple[Float2D, Int1D, Int1D]:
        """Return (scratch array, rows sorted by sample index, these indices), each index once."""
        width = len(SCRATCH_COLUMNS) + len(self.channels)
        if not self.size:
            return np.empty((0, width)), np.empty(0, np.int64), np.empty(0, np.int64)
        self.file.flush()
        scratch = np.memmap(self.file, np.float64, "r", shape=(self.size, width))
        index = scratch[:, 0].astype(np.int64)
        if (np.diff(index) > 0).all():
            return scratch, np.arange(self.size), index
        index, positions = np.unique(index, return_index=True)
        return scratch, positions, index


@dataclass(frozen=True, eq=False)
class LogTable:
    """Rows of a log; `units` maps column names, in order, to SI units."""

    start: RunStart
    units: dict[str, str]
    steps: dict[int, Step]
    records: tuple[Record, ...]  # events and PRC points
    is_intact: bool  # has its stop record, and no item was left out
    measured: Float2D  # scratch array (sample, SCRATCH_COLUMNS + channels)
    predicted: Float2D  # the same of the twin
    row_positions: Int1D  # (2, row): row in `measured`, and in `predicted` or -1
    channels: tuple[tuple[str, ...], tuple[str, ...]]  # column names, measured and predicted

    @property
    def size(self) -> int:
        return int(self.row_positions.shape[1])

    @property
    def toml_texts(self) -> dict[str, str]:
        """TOML texts of profile, rig and model, with which the run can be repeated."""
        names = ("profile_toml", "rig_toml", "model_toml")
        return {name: getattr(self.start, name) for name in names}

    def iter_windows(self) -> Iterator[Columns]:
        """Yield all columns in consecutive windows of WINDOW_ROWS rows."""
        for first in range(0, self.size, WINDOW_ROWS):
            yield self.read_columns(slice(first, first + WINDOW_ROWS))

    def read_columns(self, rows: slice, *only: str) -> Columns:
        """Return the columns of a slice of rows, (row,) each; `only` those named if any."""
        measured_rows, twin_rows = self.row_positions[:, rows]
        has_twin = twin_rows >= 0
        step, label, cycle = (
            self.measured[measured_rows, k].astype(np.int64) for k in range(1, len(SCRATCH_COLUMNS))
        )
        columns: Columns = {TIME_COLUMN: self.sample_index(rows) / self.start.rate_hz}
        columns |= _label_columns(step, label, cycle, self.steps)
        for k, name in enumerate(self.channels[0], start=len(SCRATCH_COLUMNS)):
            if name in (only or self.units):
                columns[name] = self.measured[measured_rows, k]
        for name in list_derived_channels(self.channels[0]):
            if name in (only or self.units):
                mass_disp, table_disp = (
                    self.measured[
                        measured_rows, len(SCRATCH_COLUMNS) + self.channels[0].index(source)
                    ]
                    for source in RELATIVE_DISP_SOURCES
                )
                columns[name] = mass_disp - table_disp
        for k, name in enumerate(self.channels[1], start=len(SCRATCH_COLUMNS)):
            if name in (only or self.units):
                columns[name] = np.full(measured_rows.size, np.nan)
                columns[name][has_twin] = self.predicted[twin_rows[has_twin], k]
        return {name: columns[name] for name in only or self.units}

    def sample_index(self, rows: slice) -> Int1D:
        """Return the sample index of a slice of rows, (row,)."""
        return self.measured[self.row_positions[0, rows], 0].astype(np.int64)

    def select(self, channels: tuple[str, ...], steps: tuple[int, int] | None) -> "LogTable":
        """Select `channels` and the samples of `steps` (first, last); empty or None selects all."""
        unknown = sorted(set(channels) - self.units.keys())
        if unknown:
            raise InputError(f"no column {', '.join(unknown)}", allowed=", ".join(self.units))
        kept_names = {TIME_COLUMN, *LABEL_UNITS, *channels} if channels else self.units.keys()
        units = {name: unit for name, unit in self.units.items() if name in kept_names}
        if steps is None:
            return replace(self, units=units)
        step = self.measured[self.row_positions[0], SCRATCH_COLUMNS.index("step")]
        is_inside = (step >= steps[0]) & (step <= steps[1])
        if not is_inside.any():
            raise InputError(f"no sample in steps {steps[0]} to {steps[1]}")
        return replace(self, units=units, row_positions=self.row_positions[:, is_inside])


def read_log_table(path: Path) -> LogTable:
    """Read the rows of a log; raise InputError if it is no log or has no start record."""
    with TemporaryFile() as meas, TemporaryFile() as pred:  # the arrays outlive the open files
        return _read_log_table(
            path, {MEAS_TOPIC: _ScratchFile(meas), PRED_TOPIC: _ScratchFile(pred)}
        )


def _read_log_table(path: Path, scratch_files: dict[str, _ScratchFile]) -> LogTable:
    start = read_start(path)
    records: dict[bytes, Record] = {}
    problems: list[str] = []

    for message in iter_messages(path):
        if not issubclass(TOPIC_TYPES.get(message.topic, object), (Block, *KEPT_RECORDS)):
            continue
        for item in iter_valid_items(message.topic, [message.payload], start, problems):
            if isinstance(item, Block):
                scratch_files[message.topic].add(item, path)
            else:
                records[message.payload] = item
    sorted_records = sorted(records.values(), key=lambda record: record.index)
    table = _build_table(
        start, sorted_records, scratch_files[MEAS_TOPIC], scratch_files[PRED_TOPIC]
    )
    return replace(table, is_intact=table.is_intact and not problems)


def iter_batches(path: Path, count: int) -> Iterator[list[Item]] | None:
    """Iterate over the items of a log in batches of about `count`; None if it is out of order.

    In order means: the start record first, and no message more than MAX_LATENESS_S late.
    """
    start = read_start(path)
    latest = 0
    for position, message in enumerate(iter_messages(path)):
        if (message.topic == START_TOPIC) != (
            position == 0
        ) or message.log_time < latest - 1e9 * MAX_LATENESS_S:
            return None
        latest = max(latest, message.log_time)
    return _iter_batches(path, count, start)


def _iter_batches(path: Path, count: int, start: RunStart) -> Iterator[list[Item]]:
    yield [start]
    messages = (message for message in iter_messages(path) if message.topic in TOPIC_TYPES)
    while batch := list(islice(messages, count)):
        items: list[Item] = []
        for topic in dict.fromkeys(message.topic for message in batch):
            payloads = [message.payload for message in batch if message.topic == topic]
            items += iter_valid_items(topic, payloads, start, [])
        yield sorted(items, key=lambda item: item.index)


def _build_table(
    start: RunStart, records: list[Record], meas: _ScratchFile, pred: _ScratchFile
) -> LogTable:
    measured, row_positions, index = meas.sort_by_index()
    predicted, twin_positions, twin_index = pred.sort_by_index()
    twin_rows = np.full(row_positions.size, -1)
    if twin_index.size:
        nearest = np.minimum(np.searchsorted(twin_index, index), twin_index.size - 1)
        twin_rows = np.where(twin_index[nearest] == index, twin_positions[nearest], -1)
    twins = tuple(TWIN_PREFIX + name.replace("/", "_") for name in pred.channels)
    channels = read_channels(start.rig_toml)
    units = {
        TIME_COLUMN: "s",
        **{
            name: channel_unit(name, channels)
            for name in (*meas.channels, *list_derived_channels(meas.channels))
        },
        **LABEL_UNITS,
    }
    units |= {
        column: channel_unit(name, channels)
        for column, name in zip(twins, pred.channels, strict=True)
    }
    return LogTable(
        start,
        units,
        collect_steps(start, records),
        tuple(record for record in records if isinstance(record, (Event, PrcPoint))),
        any(isinstance(record, RunStop) for record in records),
        measured,
        predicted,
        np.array([row_positions, twin_rows]),
        (meas.channels, twins),
    )


def collect_steps(start: RunStart, items: Iterable[Item]) -> dict[int, Step]:
    """Return the steps by index: the planned ones, then those added during the test."""
    steps = {step.index: step for step in start.steps}
    for record in items:
        if isinstance(record, StepAdded):
            steps[record.step] = record.as_step
    return steps


def parse_step_range(steps: str) -> tuple[int, int]:
    """Return (first, last) step index of "FIRST:LAST" or of a single step."""
    match = re.fullmatch(r"(\d{1,9})(?::(\d{1,9}))?", steps)
    first, last = (int(match[1]), int(match[2] or match[1])) if match else (1, 0)
    if last < first:
        raise InputError(
            "not a range of steps",
            where=f"--steps {steps}",
            allowed="FIRST:LAST, both ends included, or one step, by `index` in summary.json "
            "(from 0), for example 12:20",
        )
    return first, last


def channel_unit(name: str, channels: Mapping[str, Channel]) -> str:
    """Return the recorded unit of a measured or twin channel of a registry, "" if unknown."""
    base_name = name.rpartition("/")[2]
    return (
        channels[base_name].unit
        if base_name in channels
        else {"rel_vel_m_s": "m/s"}.get(base_name, "")
    )


def _label_columns(step: Int1D, label: Int1D, cycle: Int1D, steps: dict[int, Step]) -> Columns:
    """Return the columns of LABEL_UNITS, (row,) each; direction 0 and NaN outside the steps."""
    numbers, position = np.unique(step, return_inverse=True)
    known_steps = [steps.get(number) for number in numbers.tolist()]
    nan = float("nan")
    directions = np.array(
        [DIRECTION_SIGNS.get(step.direction, 0) if step else 0 for step in known_steps],
        dtype=np.int64,
    )
    frequencies_hz: Float1D = np.array([step.frequency_hz if step else nan for step in known_steps])
    levels_m_s2: Float1D = np.array(
        [step.acceleration_m_s2 if step else nan for step in known_steps]
    )
    columns = (
        step,
        label,
        cycle,
        directions[position],
        frequencies_hz[position],
        levels_m_s2[position],
    )
    return dict(zip(LABEL_UNITS, columns, strict=True))
