"""What a log hands out: the channels of one source, and the samples of one step."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from table_io.block import Float1D, Float2D, Int1D, Label
from table_io.records import Cycle, Point, Step

if TYPE_CHECKING:
    from twin.log import Log
    from twin.log.dataset import Dataset

UNKNOWN = -1  # step, label and cycle of a sample that was not recorded


class Track(Mapping[str, Float1D]):
    """Channels of one source by name, (sample,) each."""

    def __init__(self, name: str, names: tuple[str, ...], values: Float2D) -> None:
        self._name, self._names, self._values = name, names, values

    def __getitem__(self, name: str) -> Float1D:
        if name not in self._names:
            raise KeyError(f"no channel {name!r} ({self._name}); there: {', '.join(self._names)}")
        return self._values[self._names.index(name)]

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    def __repr__(self) -> str:
        return f"<{self._name}: {', '.join(self._names)}>"

    def cut(self, samples: slice) -> "Track":
        return Track(self._name, self._names, self._values[:, samples])


@dataclass(frozen=True, eq=False, repr=False)
class StepView:
    """The samples of one step, or of its held cycles; `step` as planned, `point` its result."""

    step: Step
    point: Point | None
    cycles: tuple[Cycle, ...]
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
    def measured(self) -> Track:
        return self.log.measured.cut(self.samples)

    @property
    def twin(self) -> Track:
        return self.log.twin.cut(self.samples)

    @property
    def window(self) -> Track:
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
        """The cycles alone that enter the PRC point; empty where the step has none."""
        inside = np.flatnonzero(self.label == Label.MEASURE)
        first, last = (inside[0], inside[-1] + 1) if inside.size else (0, 0)
        base = self.samples.start
        cut = slice(base + int(first), base + int(last))
        return StepView(self.step, self.point, self.cycles, self.log, cut)

    def to_xarray(self) -> "Dataset":
        """As `Log.to_xarray`, of these samples."""
        return self.log.to_xarray().isel(time=self.samples)

    def __len__(self) -> int:
        return int(self.samples.stop - self.samples.start)

    def __repr__(self) -> str:
        one = self.step
        return (
            f"<step {one.index}: {one.frequency_hz:g} Hz {one.direction}, "
            f"{one.acceleration_m_s2:.3g} m/s2, {len(self)} samples>"
        )
