"""Tabular view of a log: one row per measured sample, with all its columns, for exports.

Each sample has one row, sorted by index, in whatever order and however often it was recorded. A gap
has no rows; twin columns are NaN where the twin has no output. Invalid items are left out by the
rules of `reader.read_recording`.
"""

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from table_io.block import Float1D, Int1D, Int2D
from table_io.channels import (
    RELATIVE_DISP_SOURCES,
    TIME_COLUMN,
    Channel,
    list_derived_channels,
)
from table_io.config.channel import read_channels
from table_io.errors import InputError
from table_io.records import Event, PrcPoint, Record, RunStart, RunStop, Step, StepAdded
from twin.recording.reader import Recording, read_recording
from twin.transport.codec import RECORD_TOPICS, Item
from twin.transport.endpoint import MEAS_TOPIC, PRED_TOPIC

# Columns of every sample in addition to its channels, and their units.
LABEL_UNITS = {
    "step": "", "label": "", "cycle": "", "direction": "", "frequency_hz": "Hz",
    "level_m_s2": "m/s2",
}  # fmt: skip
DIRECTION_SIGNS = {"forward": 1, "backward": -1}
TWIN_PREFIX = "twin_"
UNIX_TIME_COLUMN = "unix_time_s"  # last of CSV, which holds no other facts of the run
KEPT_RECORDS = (RunStop, Event, PrcPoint, StepAdded)
WINDOW_ROWS = 2**14  # rows read at once
Columns = dict[str, npt.NDArray[Any]]  # (row,) each, float64 or int64


@dataclass(frozen=True, eq=False)
class LogTable:
    """Rows of a log; `units` maps column names, in order, to SI units."""

    recording: Recording
    units: dict[str, str]
    steps: dict[int, Step]
    index: Int1D  # sample of each row, (row,)
    twin_channels: dict[str, str]  # predicted channels by the names of their columns

    @property
    def start(self) -> RunStart:
        return self.recording.start

    @property
    def records(self) -> list[Record]:
        """Events and PRC points, in order."""
        records = self.recording.items.records
        return [record for record in records if isinstance(record, (Event, PrcPoint))]

    @property
    def is_intact(self) -> bool:
        """Whether the log has its stop record, and no item was left out."""
        return self.recording.stop is not None and self.recording.is_intact

    @property
    def size(self) -> int:
        return self.index.size

    @property
    def toml_texts(self) -> dict[str, str]:
        """TOML texts of profile, rig and model, with which the run can be repeated."""
        names = ("profile_toml", "rig_toml", "model_toml")
        return {name: getattr(self.start, name) for name in names}

    def iter_windows(self) -> Iterator[Columns]:
        """Yield all columns in consecutive windows of WINDOW_ROWS rows."""
        for first in range(0, self.size, WINDOW_ROWS):
            yield self.read_columns(slice(first, first + WINDOW_ROWS))
            self.recording.items.release()

    def read_columns(self, rows: slice, *only: str) -> Columns:
        """Return the columns of a slice of rows, (row,) each; `only` those named if any."""
        index = self.index[rows]
        series = self.recording.items.series
        columns: Columns = {TIME_COLUMN: index / self.start.rate_hz}
        if {*LABEL_UNITS} & {*(only or self.units)}:
            labels = series[MEAS_TOPIC].pick_labels(index)
            columns |= _label_columns(labels, self.steps)
        for name in only or self.units:
            if name in columns:
                continue
            if name in self.twin_channels:
                columns[name] = series[PRED_TOPIC].pick(self.twin_channels[name], index)
            elif name in self.start.channels:
                columns[name] = series[MEAS_TOPIC].pick(name, index)
            else:
                sources = (series[MEAS_TOPIC].pick(each, index) for each in RELATIVE_DISP_SOURCES)
                columns[name] = np.subtract(*sources)
        return {name: columns[name] for name in only or self.units}

    def select(self, channels: tuple[str, ...], steps: tuple[int, int] | None) -> "LogTable":
        """Select `channels` and the samples of `steps` (first, last); empty or None selects all."""
        unknown = sorted(set(channels) - self.units.keys())
        if unknown:
            raise InputError(f"no column {', '.join(unknown)}", allowed=", ".join(self.units))
        kept_names = {TIME_COLUMN, *LABEL_UNITS, *channels} if channels else self.units.keys()
        units = {name: unit for name, unit in self.units.items() if name in kept_names}
        if steps is None:
            return replace(self, units=units)
        step = self.recording.items.series[MEAS_TOPIC].pick_labels(self.index)[0]
        is_inside = (step >= steps[0]) & (step <= steps[1])
        if not is_inside.any():
            raise InputError(f"no sample in steps {steps[0]} to {steps[1]}")
        return replace(self, units=units, index=self.index[is_inside])


def read_log_table(path: Path) -> LogTable:
    """Read the rows of a log; raise InputError if it is no log or has no start record."""
    records = (RECORD_TOPICS[kind] for kind in KEPT_RECORDS)
    recording = read_recording(path, (MEAS_TOPIC, PRED_TOPIC, *records))
    start = recording.start
    blocks = recording.contiguous_blocks("meas")
    channels = read_channels(start.rig_toml)
    measured = (*start.channels, *list_derived_channels(start.channels)) if blocks else ()
    twin = next(iter(recording.contiguous_blocks("pred")), None)
    twins = {TWIN_PREFIX + name.replace("/", "_"): name for name in (twin.channels if twin else ())}
    units = {
        TIME_COLUMN: "s",
        **{name: channel_unit(name, channels) for name in measured},
        **LABEL_UNITS,
        **{column: channel_unit(name, channels) for column, name in twins.items()},
    }
    index = [np.arange(block.index, block.end) for block in blocks]
    steps = collect_steps(start, recording.items.records)
    rows = np.concatenate([np.empty(0, np.int64), *index])
    return LogTable(recording, units, steps, rows, twins)


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


def _label_columns(labels: Int2D, steps: dict[int, Step]) -> Columns:
    """Return the columns of LABEL_UNITS, (row,) each; direction 0 and NaN outside the steps."""
    step, label, cycle = labels
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
