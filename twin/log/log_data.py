"""Views of a log: the channels of one source, and the samples of one step."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from table_io.block import Float1D, Float2D, Int1D, Label
from table_io.channels import RELATIVE_DISP_SOURCES, list_derived_channels
from table_io.records import CycleExtremes, PrcPoint, Step

if TYPE_CHECKING:
    from twin.log import Log
    from twin.log.dataset import Dataset

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
