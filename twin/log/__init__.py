"""A log as arrays, for notebooks and scripts: three lines, and every channel is there.

>>> from twin.log import open_log
>>> log = open_log("runs/20260101-120000-g10")     # a run's folder, or its run.mcap
>>> log["mass_disp_m"]                             # measured, SI, one value a sample

| what | is |
|---|---|
| `log["mass_disp_m"]`, `log.channels` | a measured channel; their names (as in CSV exports) |
| `log.twin["mass_disp_m"]` | the twin that runs on from the start on the table's motion alone |
| `log.window["mass_disp_m"]` | the twin that restarts from the measured state every window |
| `log.time_s`, `log.step_index`, `log.label`, `log.cycle` | the one axis, and what the drive did |
| `log.steps`, `log.step(12)` | the steps (by `index`, as in summary.json); samples of one |
| `log.step(12).held["mass_acc_m_s2"]` | the cycles alone that enter its PRC point |
| `log.prc`, `log.points` | the pseudo-resonance curves as arrays, and as records |
| `log.events`, `log.gaps`, `log.faults`, `log.stop` | what happened |
| `log.start`, `log.profile`, `log.rig`, `log.model` | what the run was made with |
| `log.units`, `log.to_xarray()` | SI unit by channel; all as an xarray.Dataset with units |

One time axis for everything: from the first to the last measured sample, evenly spaced. In a gap,
and where a twin said nothing, values are NaN; `step_index`, `label` and `cycle` are -1 there.
Arrays are float64 to the bit as recorded, and read-only: copy what you want to change. Opening
reads the start only; the first look at a stream reads that stream, the next ones cost nothing.
"""

from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from table_io.block import Block, Float1D, Float2D, Int1D
from table_io.card import BadInput, parse
from table_io.profile import Profile
from table_io.records import (
    Cycle,
    Decided,
    Event,
    Fault,
    Gap,
    Point,
    Quantities,
    RunStart,
    RunStop,
    Step,
)
from table_io.rig import Rig
from twin.compare import PREDICTED
from twin.log.parts import UNKNOWN, StepView, Track
from twin.model.card import ModelCard
from twin.model.model import Model
from twin.stream.folder import log_path
from twin.stream.recording import Recording, read, start_of
from twin.stream.rows import all_steps, unit
from twin.stream.wire import MEAS_TOPIC, PRED_TOPIC, RECORD_TOPICS

if TYPE_CHECKING:
    from twin.log.dataset import Dataset

RECORDS = [RECORD_TOPICS[kind] for kind in (RunStop, Cycle, Decided, Event, Fault, Gap, Point)]


def open_log(path: str | Path) -> "Log":
    """The log in a run's folder, or in a file; BadInput where it is none.

    A log that was cut off opens too, with what is left of it: `log.whole` says so.
    """
    place = log_path(Path(path))
    if not place.is_file():
        raise BadInput(f"{place}: no such log; give a run.mcap or the folder of a run")
    return Log(place, start_of(place))


class Log:
    """A recording by channel and by step; see the module's first lines."""

    def __init__(self, path: Path, start: RunStart) -> None:
        self.path = path
        self.start = start

    def __getitem__(self, name: str) -> Float1D:
        """A measured channel in SI, (sample,)."""
        return self.measured[name]

    # Without these Python takes a log for a sequence, and asks for the channels 0, 1, 2.
    def __iter__(self) -> Iterator[str]:
        return iter(self.channels)

    def __contains__(self, name: object) -> bool:
        return name in self.channels

    def keys(self) -> tuple[str, ...]:
        """The names of the measured channels."""
        return self.channels

    def __repr__(self) -> str:
        one = self.start
        return (
            f"<log {self.path}: {self.profile.title or one.name}, run {one.run}, "
            f"{one.planned_samples / one.rate_hz:.0f} s planned at {one.rate_hz:g} Hz, "
            f"{len(one.steps)} steps, {len(one.channels)} channels: {', '.join(one.channels)}>"
        )

    @property
    def channels(self) -> tuple[str, ...]:
        return self.start.channels

    @property
    def rate_hz(self) -> float:
        return self.start.rate_hz

    @cached_property
    def profile(self) -> Profile:
        return parse(self.start.profile_toml, Profile, f"profile of {self.path}")

    @cached_property
    def rig(self) -> Rig:
        return parse(self.start.rig_toml, Rig, f"machine card of {self.path}")

    @cached_property
    def model(self) -> Model:
        card = parse(self.start.model_toml, ModelCard, f"model of {self.path}")
        return card.model(self.profile.specimen)

    @cached_property
    def _records(self) -> Recording:
        return read(self.path, RECORDS)

    @cached_property
    def _blocks(self) -> tuple[Block, ...]:
        return read(self.path, (MEAS_TOPIC,)).pieces("meas")

    @cached_property
    def whole(self) -> bool:
        """True where the file is undamaged, and each of its messages can be of this run.

        All topics are read for it, once. A test that was stopped early has a whole file too: how
        far it came is told by `stop`, what is missing in it by `gaps`.
        """
        return read(self.path).whole

    @property
    def stop(self) -> RunStop | None:
        return self._records.stop

    @property
    def points(self) -> tuple[Point, ...]:
        return self._records.of(Point)

    @property
    def events(self) -> tuple[Event, ...]:
        return self._records.of(Event)

    @property
    def gaps(self) -> tuple[Gap, ...]:
        return self._records.of(Gap)

    @property
    def faults(self) -> tuple[Fault, ...]:
        return self._records.of(Fault)

    @cached_property
    def _axis(self) -> tuple[int, int]:
        """(first sample, the one after the last) of the time axis."""
        blocks = self._blocks
        return (blocks[0].index, blocks[-1].end) if blocks else (0, 0)

    @cached_property
    def time_s(self) -> Float1D:
        """Time of each sample in s since the start of the run."""
        return _locked(np.arange(*self._axis) / self.rate_hz)

    @cached_property
    def measured(self) -> Track:
        return Track("measured", self.channels, self._placed(self._blocks, self.channels))

    @cached_property
    def predicted(self) -> Float2D:
        """Both twins on the time axis, rows as in `twin.compare.PREDICTED`, (channel, sample)."""
        return self._placed(read(self.path, (PRED_TOPIC,)).pieces("pred"), PREDICTED)

    @cached_property
    def twin(self) -> Track:
        """The free-running twin."""
        return self._track("free", "twin, free-running")

    @cached_property
    def window(self) -> Track:
        """The twin that restarts from the measured state every window."""
        return self._track("window", "twin, restarted")

    @cached_property
    def step_index(self) -> Int1D:
        """Step of each sample, -1 outside the steps."""
        return self._labels("step")

    @cached_property
    def label(self) -> Int1D:
        """What the drive did at each sample, a `table_io.block.Label`."""
        return self._labels("label")

    @cached_property
    def cycle(self) -> Int1D:
        """Number of the held cycle within its step, -1 outside."""
        return self._labels("cycle")

    @cached_property
    def steps(self) -> tuple[Step, ...]:
        """The planned steps, then those that were decided on during the test."""
        return tuple(all_steps(self.start, self._records.items).values())

    def step(self, index: int) -> StepView:
        """The samples of a step, blends included; KeyError where there is none of this index."""
        step = next((one for one in self.steps if one.index == index), None)
        inside = np.flatnonzero(self.step_index == index)
        if step is None or not inside.size:
            has = sorted(set(np.unique(self.step_index).tolist()) - {UNKNOWN})
            there = f"{has[0]} to {has[-1]}" if has else "none"
            raise KeyError(f"no samples of a step {index}; there: {there}")
        point = next((one for one in self.points if one.step == index), None)
        cycles = tuple(one for one in self._records.of(Cycle) if one.step == index)
        return StepView(step, point, cycles, self, slice(int(inside[0]), int(inside[-1]) + 1))

    @cached_property
    def prc(self) -> dict[str, Any]:
        """The curves as arrays (point,): step, direction, frequency_hz, then eta_d, ... measured,
        and twin_eta_d, ... of the twin; NaN where there is nothing."""
        points = self.points
        found: dict[str, Any] = {
            name: np.array([getattr(one, name) for one in points])
            for name in ("step", "direction", "frequency_hz")
        }
        for source, mark in (("measured", ""), ("twin", "twin_")):
            for name in ("eta_d", "eta_a", "eta_r", "eta_l", "r_r", "r_l"):
                values = (getattr(one, source) for one in points)
                found[mark + name] = np.array([_value(one, name) for one in values])
        return found

    @cached_property
    def units(self) -> dict[str, str]:
        """SI unit by channel; "" of one that the table of channels does not know."""
        twins = (name.partition("/")[2] for name in PREDICTED)
        return {name: unit(name) for name in (*self.channels, *twins)}

    def to_xarray(self) -> "Dataset":
        """All channels over `time` in s, the twins' as twin_free_... and twin_window_... .

        `step`, `label` and `cycle` are coordinates; units and meanings are attributes.
        """
        from twin.log.dataset import dataset

        return dataset(self)

    def _track(self, track: str, title: str) -> Track:
        rows = [row for row, name in enumerate(PREDICTED) if name.startswith(f"{track}/")]
        names = tuple(PREDICTED[row].partition("/")[2] for row in rows)
        return Track(title, names, self.predicted[rows[0] : rows[-1] + 1])

    def _placed(self, blocks: tuple[Block, ...], names: tuple[str, ...]) -> Float2D:
        """The blocks on the time axis, NaN between them, (channel, sample)."""
        first, end = self._axis
        if len(blocks) == 1 and (blocks[0].index, blocks[0].end) == (first, end):
            return blocks[0].values
        values = np.full((len(names), end - first), np.nan)
        for block in blocks:
            inside = block.cut(
                max(block.index, first), max(min(block.end, end), first, block.index)
            )
            values[:, inside.index - first : inside.end - first] = inside.values
        return _locked(values)

    def _labels(self, name: str) -> Int1D:
        first, end = self._axis
        values = np.full(end - first, UNKNOWN)
        for block in self._blocks:
            values[block.index - first : block.end - first] = getattr(block, name)
        return _locked(values)


def _locked(values: Any) -> Any:
    values.setflags(write=False)
    return values


def _value(values: Quantities | None, name: str) -> float:
    return np.nan if values is None else float(getattr(values, name))
