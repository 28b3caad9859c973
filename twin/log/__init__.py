"""Access to a log as numpy arrays, for notebooks and scripts.

>>> from twin.log import open_log
>>> log = open_log("runs/20260101-120000-g10")     # a run's folder, or its run.mcap
>>> log["mass_disp_m"]                             # measured, SI, one value per sample

| expression | value |
|---|---|
| `log["mass_disp_m"]`, `log.channels` | a measured channel; channel names (as in CSV exports) |
| `log["rel_disp_m"]` | u; mass minus table displacement where it is not measured itself |
| `log.twin["mass_disp_m"]` | free-running twin, driven by the table's motion alone |
| `log.window["mass_disp_m"]` | twin restarted from the measured state every window |
| `log.time_s`, `log.step_index`, `log.label`, `log.cycle` | time axis and labels of the drive |
| `log.steps`, `log.step(12)` | the steps (by `index`, as in summary.json); samples of one |
| `log.step(12).held["mass_acc_m_s2"]` | only the cycles that enter its PRC point |
| `log.prc`, `log.points` | the pseudo-resonance curves as arrays, and as records |
| `log.events`, `log.gaps`, `log.faults`, `log.stop` | events, gaps, faults and end of the run |
| `log.start`, `log.profile`, `log.rig`, `log.model` | inputs of the run |
| `log.units`, `log.to_xarray()` | SI unit by channel; all as an xarray.Dataset with units |

All arrays share one uniform time axis from the first to the last measured sample. In gaps, and
where a twin has no output, values are NaN; `step_index`, `label` and `cycle` are -1 there. Arrays
are float64, bit-identical to the recording, and read-only: copy them to change values. `open_log`
reads only the start record; a stream is read at its first use and cached. Where only a part of the
twin's output was recorded, its first use reruns the twin.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from table_io.block import Block, Float1D, Float2D, Int1D, Label
from table_io.channels import RELATIVE_DISP_SOURCES, Channel, list_derived_channels
from table_io.config.base import parse_toml
from table_io.config.channel import read_channels
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig
from table_io.errors import InputError, format_pip_line
from table_io.records import (
    RESPONSE_RATIOS,
    CycleExtremes,
    Event,
    Fault,
    NormalizedResponse,
    PrcPoint,
    RunStart,
    RunStop,
    SampleGap,
    Step,
    StepAdded,
)
from twin.compare import TWIN_CHANNELS
from twin.model.config import ModelConfig
from twin.model.model import Model
from twin.recording.reader import Recording, read_recording, read_start
from twin.recording.run_paths import resolve_log_path
from twin.recording.tabular import channel_unit, collect_steps
from twin.results.contracts import RunSummary
from twin.transport.codec import RECORD_TOPICS
from twin.transport.endpoint import MEAS_TOPIC, PRED_TOPIC

if TYPE_CHECKING:
    from xarray import Dataset  # of the extra `notebook`

UNKNOWN_LABEL = -1  # step, label and cycle of a sample that was not recorded


class ChannelMap(Mapping[str, Float1D]):
    """Channels of one source (measured or a twin) by name, (sample,) each, u always among them."""

    def __init__(self, name: str, names: tuple[str, ...], values: Float2D) -> None:
        self._source, self._rows, self._values = name, names, values
        self._names = (*names, *list_derived_channels(names))

    def __getitem__(self, name: str) -> Float1D:
        if name not in self._names:
            available = ", ".join(self._names)
            raise KeyError(f"no channel {name!r} ({self._source}); available: {available}")
        if name in self._rows:
            return self._values[self._rows.index(name)]
        mass_disp, table_disp = (self[source] for source in RELATIVE_DISP_SOURCES)
        values = mass_disp - table_disp
        values.setflags(write=False)
        return values

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    def __repr__(self) -> str:
        return f"<{self._source}: {', '.join(self._names)}>"

    def cut(self, samples: slice) -> "ChannelMap":
        return ChannelMap(self._source, self._rows, self._values[:, samples])


@dataclass(frozen=True, eq=False, repr=False)
class StepView:
    """Samples of one step or of its held cycles, with the planned `step` and its PRC `point`."""

    step: Step
    point: PrcPoint | None
    cycles: tuple[CycleExtremes, ...]
    log: "Log"
    samples: slice

    def __getitem__(self, name: str) -> Float1D:
        return self.measured[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.log)

    def __contains__(self, name: object) -> bool:
        return name in self.log

    def keys(self) -> tuple[str, ...]:
        return self.log.keys()

    @property
    def measured(self) -> ChannelMap:
        return self.log.measured.cut(self.samples)

    @property
    def twin(self) -> ChannelMap:
        return self.log.twin.cut(self.samples)

    @property
    def window(self) -> ChannelMap:
        return self.log.window.cut(self.samples)

    @property
    def time_s(self) -> Float1D:
        return self.log.time_s[self.samples]

    @property
    def label(self) -> Int1D:
        return self.log.label[self.samples]

    @property
    def cycle(self) -> Int1D:
        return self.log.cycle[self.samples]

    @property
    def held(self) -> "StepView":
        """Only the cycles that enter the PRC point; empty if the step has none."""
        held_samples = np.flatnonzero(self.label == Label.MEASURE)
        first, last = (held_samples[0], held_samples[-1] + 1) if held_samples.size else (0, 0)
        base = self.samples.start
        cut = slice(base + int(first), base + int(last))
        return StepView(self.step, self.point, self.cycles, self.log, cut)

    def to_xarray(self) -> "Dataset":
        """Return these samples as `Log.to_xarray` does."""
        return self.log.to_xarray().isel(time=self.samples)

    def __len__(self) -> int:
        return int(self.samples.stop - self.samples.start)

    def __repr__(self) -> str:
        step = self.step
        return (
            f"<step {step.index}: {step.frequency_hz:g} Hz {step.direction}, "
            f"{step.acceleration_m_s2:.3g} m/s2, {len(self)} samples>"
        )


RECORD_TOPICS_READ = [
    RECORD_TOPICS[kind]
    for kind in (RunStop, CycleExtremes, StepAdded, Event, Fault, SampleGap, PrcPoint)
]


def open_log(path: str | Path) -> "Log":
    """Open the log in a run's folder or file; raise InputError if there is none.

    A damaged or unfinished log opens with its readable part; `log.whole` is then False.
    """
    file = resolve_log_path(Path(path))
    if not file.is_file():
        raise InputError("no such log", where=file, remedy="give a run.mcap or the folder of a run")
    return Log(file, read_start(file))


class Log:
    """Recording by channel and by step; see the module docstring."""

    def __init__(self, path: Path, start: RunStart) -> None:
        self.path = path
        self.start = start

    def __getitem__(self, name: str) -> Float1D:
        """Return a measured channel in SI, (sample,)."""
        return self.measured[name]

    # Without these methods Python iterates a log as a sequence with indices 0, 1, 2.
    def __iter__(self) -> Iterator[str]:
        return iter(self.channels)

    def __contains__(self, name: object) -> bool:
        return name in self.channels

    def keys(self) -> tuple[str, ...]:
        """Return the names of the measured channels."""
        return self.channels

    def __repr__(self) -> str:
        start = self.start
        return (
            f"<log {self.path}: {self.profile.title or start.name}, run {start.run}, "
            f"{start.planned_samples / start.rate_hz:.0f} s planned at {start.rate_hz:g} Hz, "
            f"{len(start.steps)} steps, {len(self.channels)} channels: "
            f"{', '.join(self.channels)}>"
        )

    @property
    def channels(self) -> tuple[str, ...]:
        return (*self.start.channels, *list_derived_channels(self.start.channels))

    @property
    def rate_hz(self) -> float:
        return self.start.rate_hz

    @cached_property
    def summary(self) -> RunSummary:
        """Content of summary.json next to the log; InputError if there is none."""
        folder = self.path.parent
        return RunSummary.read(folder / "summary.json", f"run `shaketwin report {folder}`")

    @cached_property
    def profile(self) -> Profile:
        return parse_toml(self.start.profile_toml, Profile, f"profile of {self.path}")

    @cached_property
    def rig(self) -> RigConfig:
        return parse_toml(self.start.rig_toml, RigConfig, f"rig of {self.path}")

    @cached_property
    def model(self) -> Model:
        config = parse_toml(self.start.model_toml, ModelConfig, f"model of {self.path}")
        return config.build_model(self.profile.specimen)

    @cached_property
    def _records(self) -> Recording:
        return read_recording(self.path, RECORD_TOPICS_READ)

    @cached_property
    def _blocks(self) -> tuple[Block, ...]:
        return read_recording(self.path, (MEAS_TOPIC,)).contiguous_blocks("meas")

    @cached_property
    def whole(self) -> bool:
        """True if the file is undamaged and all its messages are valid in this run.

        Reads all topics once. The file of a test that was stopped early is whole too; see `stop`
        for its end and `gaps` for missing samples.
        """
        return read_recording(self.path).is_intact

    @property
    def stop(self) -> RunStop | None:
        return self._records.stop

    @property
    def points(self) -> tuple[PrcPoint, ...]:
        return self._records.records(PrcPoint)

    @property
    def events(self) -> tuple[Event, ...]:
        return self._records.records(Event)

    @property
    def gaps(self) -> tuple[SampleGap, ...]:
        return self._records.records(SampleGap)

    @property
    def faults(self) -> tuple[Fault, ...]:
        return self._records.records(Fault)

    @cached_property
    def _sample_range(self) -> tuple[int, int]:
        """First sample index of the time axis, and the index after the last."""
        blocks = self._blocks
        return (blocks[0].index, blocks[-1].end) if blocks else (0, 0)

    @cached_property
    def time_s(self) -> Float1D:
        """Time of each sample in s since the start of the run."""
        return _make_read_only(np.arange(*self._sample_range) / self.rate_hz)

    @cached_property
    def measured(self) -> ChannelMap:
        return ChannelMap(
            "measured", self.start.channels, self._place_on_axis(self._blocks, self.start.channels)
        )

    @cached_property
    def predicted(self) -> Float2D:
        """Outputs of both twins on the time axis, (channel, sample), rows as `TWIN_CHANNELS`."""
        return self._place_on_axis(
            self._read_predictions().contiguous_blocks("pred"), TWIN_CHANNELS
        )

    def _read_predictions(self) -> Recording:
        """Return the recording with the predictions; those not recorded are recomputed."""
        if self.start.has_all_predictions:
            return read_recording(self.path, (PRED_TOPIC,))
        from twin.results.rerun import restore_predictions

        return restore_predictions(read_recording(self.path))

    @cached_property
    def twin(self) -> ChannelMap:
        """Channels of the free-running twin."""
        return self._select_track("free", "twin, free-running")

    @cached_property
    def window(self) -> ChannelMap:
        """Channels of the twin restarted from the measured state every window."""
        return self._select_track("window", "twin, restarted")

    @cached_property
    def step_index(self) -> Int1D:
        """Step of each sample, -1 outside the steps."""
        return self._label_values("step")

    @cached_property
    def label(self) -> Int1D:
        """Phase of the drive at each sample, a `table_io.block.Label`."""
        return self._label_values("label")

    @cached_property
    def cycle(self) -> Int1D:
        """Number of the held cycle within its step, -1 outside."""
        return self._label_values("cycle")

    @cached_property
    def steps(self) -> tuple[Step, ...]:
        """Planned steps, then those added during the test."""
        return tuple(collect_steps(self.start, self._records.items).values())

    def step(self, index: int) -> StepView:
        """Return the samples of a step, blends included; raise KeyError if it was not recorded."""
        step = next((candidate for candidate in self.steps if candidate.index == index), None)
        inside = np.flatnonzero(self.step_index == index)
        if step is None or not inside.size:
            recorded = sorted(set(np.unique(self.step_index).tolist()) - {UNKNOWN_LABEL})
            available = f"{recorded[0]} to {recorded[-1]}" if recorded else "none"
            raise KeyError(f"no samples of step {index}; recorded: {available}")
        point = next((candidate for candidate in self.points if candidate.step == index), None)
        cycles = tuple(
            cycle for cycle in self._records.records(CycleExtremes) if cycle.step == index
        )
        return StepView(step, point, cycles, self, slice(int(inside[0]), int(inside[-1]) + 1))

    @cached_property
    def prc(self) -> dict[str, npt.NDArray[Any]]:
        """Pseudo-resonance curves as arrays (point,).

        Keys: step, direction, frequency_hz; eta_d, ... measured; twin_eta_d, ... of the twin. NaN
        where a value is missing.
        """
        points = self.points
        curves: dict[str, npt.NDArray[Any]] = {
            name: np.array([getattr(point, name) for point in points])
            for name in ("step", "direction", "frequency_hz")
        }
        for source, prefix in (("measured", ""), ("twin", "twin_")):
            for name in RESPONSE_RATIOS:
                values = (getattr(point, source) for point in points)
                curves[prefix + name] = np.array(
                    [_get_value(quantities, name) for quantities in values]
                )
        return curves

    @cached_property
    def units(self) -> dict[str, str]:
        """Recorded unit by channel, "" if unknown."""
        twins = (name.partition("/")[2] for name in TWIN_CHANNELS)
        channels = read_channels(self.start.rig_toml)
        return {name: channel_unit(name, channels) for name in (*self.channels, *twins)}

    def to_xarray(self) -> "Dataset":
        """Return all channels over `time` in s, the twins' as twin_free_... and twin_window_... .

        `step`, `label` and `cycle` are coordinates; units and meanings are attributes.
        """
        return build_dataset(self)

    def _select_track(self, track: str, title: str) -> ChannelMap:
        rows = [row for row, name in enumerate(TWIN_CHANNELS) if name.startswith(f"{track}/")]
        names = tuple(TWIN_CHANNELS[row].partition("/")[2] for row in rows)
        return ChannelMap(title, names, self.predicted[rows[0] : rows[-1] + 1])

    def _place_on_axis(self, blocks: tuple[Block, ...], names: tuple[str, ...]) -> Float2D:
        """Place blocks on the time axis, NaN between them, (channel, sample)."""
        first, end = self._sample_range
        if len(blocks) == 1 and (blocks[0].index, blocks[0].end) == (first, end):
            return blocks[0].values
        values = np.full((len(names), end - first), np.nan)
        for block in blocks:
            inside = block.cut(
                max(block.index, first), max(min(block.end, end), first, block.index)
            )
            values[:, inside.index - first : inside.end - first] = inside.values
        return _make_read_only(values)

    def _label_values(self, name: str) -> Int1D:
        first, end = self._sample_range
        values = np.full(end - first, UNKNOWN_LABEL)
        for block in self._blocks:
            values[block.index - first : block.end - first] = getattr(block, name)
        return _make_read_only(values)


def _make_read_only(values: Any) -> Any:
    values.setflags(write=False)
    return values


def _get_value(values: NormalizedResponse | None, name: str) -> float:
    return np.nan if values is None else float(getattr(values, name))


LABEL_MEANINGS = ", ".join(f"{int(label)} {label.name.lower()}" for label in Label)


def build_dataset(log: "Log") -> "Dataset":
    """Build a Dataset of all channels over `time` in s, with units and run as attributes."""
    try:
        import xarray
    except ImportError:
        raise InputError(
            "to_xarray needs xarray, which is not installed",
            remedy=format_pip_line("notebook"),
        ) from None
    channels = read_channels(log.start.rig_toml)
    data = {name: ("time", log[name], _channel_attributes(name, channels)) for name in log.channels}
    for row, name in zip(log.predicted, TWIN_CHANNELS, strict=True):
        data[f"twin_{name.replace('/', '_')}"] = (
            "time",
            row,
            _channel_attributes(name.split("/")[1], channels),
        )
    coordinates = {
        "time": ("time", log.time_s, {"units": "s"}),
        "step": ("time", log.step_index, {"meaning": "index of the step, -1 outside"}),
        "label": ("time", log.label, {"meaning": f"what the drive did: {LABEL_MEANINGS}"}),
        "cycle": ("time", log.cycle, {"meaning": "held cycle within the step, -1 outside"}),
    }
    run = log.start
    attributes = {
        "run": run.run, "name": run.name, "title": log.profile.title, "rate_hz": run.rate_hz,
        "started_at": run.started_at, "host": run.host, "profile_toml": run.profile_toml,
        "rig_toml": run.rig_toml, "model_toml": run.model_toml,
    }  # fmt: skip
    return xarray.Dataset(data, coordinates, attributes)


def _channel_attributes(name: str, channels: dict[str, Channel]) -> dict[str, str]:
    channel = channels.get(name)
    details = {"positive": channel.positive, "meaning": channel.meaning} if channel else {}
    return {"units": channel_unit(name, channels), **details}
