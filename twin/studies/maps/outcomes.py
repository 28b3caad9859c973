"""Outcomes of a study: what is computed of every case, built in or of a plug-in.

Other packages add outcomes through entry points of the group `shaketwin.outcomes`, each an
`Outcome`.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from table_io.block import Float1D
from table_io.errors import InputError
from table_io.records import Step
from twin.compare.curves import FloatND, Hysteresis, PrcJump, Solutions, detect_all_hysteresis
from twin.dynamics.continuation import Branch
from twin.dynamics.main_branches import follow_sweep_branches
from twin.model.ideal_response import simulate_sweep
from twin.model.stepped_sine import EXTREME_NAMES
from twin.results.ideal_points import ResponseScale, compute_ratios
from twin.studies.maps.cases import SampledCase

ENTRY_POINT_GROUP = "shaketwin.outcomes"
CURVE_DIMS = ("direction", "frequency_hz")
Result = TypeVar("Result")
Shape = tuple[int, ...]


@dataclass(frozen=True, slots=True)
class SweepPlan:
    """The sweep of every case: its steps in driving order, and cycles per step."""

    steps: tuple[Step, ...]
    cycles: int
    measured_cycles: int

    @property
    def frequencies_hz(self) -> Float1D:
        """Frequency of every step, (step,)."""
        return np.array([step.frequency_hz for step in self.steps])

    @property
    def grid_hz(self) -> Float1D:
        """Ascending frequencies of the grid, (frequency,)."""
        return np.unique(self.frequencies_hz)

    @property
    def directions(self) -> tuple[str, ...]:
        """Directions, each a pass over the whole grid."""
        return tuple(dict.fromkeys(step.direction for step in self.steps))

    def find_shape(self, dims: Sequence[str]) -> Shape:
        """Return the sizes of dimensions of `CURVE_DIMS`."""
        sizes = dict(zip(CURVE_DIMS, (len(self.directions), self.grid_hz.size), strict=True))
        return tuple(sizes[dim] for dim in dims)

    def arrange(self, by_step: FloatND) -> FloatND:
        """Return values by step, (..., step), as (..., direction, frequency)."""
        passes = by_step.reshape(*by_step.shape[:-1], len(self.directions), -1)
        order = self.frequencies_hz.reshape(len(self.directions), -1).argsort(axis=1)
        return np.take_along_axis(passes, np.broadcast_to(order, passes.shape), axis=-1)


@dataclass(frozen=True)
class CaseChunk:
    """Cases that are computed together, and what several outcomes need of them.

    A case without a model, or whose computation fails, has NaN in all of it and its reason in
    `failures`, by its place in the chunk. `seeds`: of each case, for outcomes that draw numbers.
    `profile_toml`, `model_toml`: the test and the model of the study.
    """

    cases: tuple[SampledCase | None, ...]
    seeds: tuple[int, ...]
    sweep: SweepPlan
    failures: dict[int, str] = field(default_factory=dict)
    profile_toml: str = ""
    model_toml: str = ""

    def for_each(self, compute: Callable[[int, SampledCase], Result]) -> list[Result | None]:
        """Return what `compute` returns for each place and case, None where it fails."""
        results: list[Result | None] = []
        for index, case in enumerate(self.cases):
            try:
                results.append(None if case is None else compute(index, case))
            except (InputError, ArithmeticError, np.linalg.LinAlgError) as error:
                self.failures.setdefault(index, f"{error}")
                results.append(None)
        return results

    def collect(self, compute: Callable[[int, SampledCase], FloatND], shape: Shape) -> FloatND:
        """Return the array of `shape` of each case, (case, *shape), NaN where `compute` fails."""
        arrays = self.for_each(compute)
        missing = np.full(shape, math.nan)
        return np.stack([missing if array is None else array for array in arrays])

    def collect_numbers(
        self, variables: Sequence["OutcomeVariable"], compute: Callable[[int, SampledCase], FloatND]
    ) -> dict[str, FloatND]:
        """Return the array of each variable, (case,), from a number of each in every case."""
        rows = self.collect(compute, (len(variables),))
        return dict(zip([variable.name for variable in variables], rows.T, strict=True))

    @cached_property
    def extremes(self) -> FloatND:
        """`EXTREME_NAMES` of the measured cycles, (case, step, cycle, 8)."""
        sweep, frequencies = self.sweep, self.sweep.frequencies_hz

        def simulate(_: int, case: SampledCase) -> FloatND:
            extremes = simulate_sweep(
                case.model, frequencies, case.acceleration_m_s2, sweep.cycles, sweep.measured_cycles
            ).extremes
            is_finite = np.isfinite(extremes).all(axis=(1, 2))
            if not is_finite.all():
                first = frequencies[is_finite.argmin()]
                raise InputError(f"the model has no finite response from {first:g} Hz on")
            return extremes

        return self.collect(simulate, (len(sweep.steps), sweep.measured_cycles, len(EXTREME_NAMES)))

    def extreme(self, name: str) -> FloatND:
        """Return one of `EXTREME_NAMES`, (case, step, cycle)."""
        return self.extremes[..., EXTREME_NAMES.index(name)]

    @cached_property
    def scales(self) -> ResponseScale:
        """Scales of the ratios, each (case, 1, 1)."""

        def scale_case(_: int, case: SampledCase) -> FloatND:
            return np.array(ResponseScale.of_model(case.model, *case.find_resonance()[:2]))

        rows = self.collect(scale_case, (len(ResponseScale._fields),))
        return ResponseScale(*rows.T[..., None, None])

    @cached_property
    def ratios(self) -> dict[str, FloatND]:
        """Ratios of Eq. 1, each (case, step)."""
        sweep = self.sweep
        return compute_ratios(self.scales, sweep.frequencies_hz, self.extremes, sweep.cycles)

    @cached_property
    def hysteresis(self) -> list[tuple[list[PrcJump], list[Hysteresis]]]:
        """Jumps and hysteresis intervals of each case, by both directions."""
        ratios, arrange = self.ratios, self.sweep.arrange
        counts = [self.extreme(name) for name in ("onsets_r", "onsets_l")]
        columns = [
            *(ratios[name] for name in ("eta_d", "eta_a", "spread", "spread_a")),
            *(limit(axis=-1) for count in counts for limit in (count.min, count.max)),
        ]
        by_direction = np.stack([arrange(column) for column in columns])
        grid_hz = self.sweep.grid_hz.tolist()
        passes = [
            Solutions(*by_direction[..., self.sweep.directions.index(direction), :])
            for direction in ("forward", "backward")
        ]
        return list(detect_all_hysteresis(grid_hz, *passes).values())

    @cached_property
    def branches(self) -> list[tuple[Branch, ...]]:
        """Main branches of each case over the frequencies of the sweep, by continuation."""
        grid_hz = self.sweep.grid_hz.tolist()

        def follow(_: int, case: SampledCase) -> tuple[Branch, ...]:
            branches = follow_sweep_branches(case.model, grid_hz, [case.acceleration_m_s2])
            if not branches:
                raise InputError("no branch of periodic motions was found")
            return branches

        return [branches or () for branches in self.for_each(follow)]


@dataclass(frozen=True, slots=True)
class OutcomeVariable:
    """One array of an outcome: a number of each case, or one at each of further `dims`.

    `dims` are of ("direction", "frequency_hz"). `dtype` is one of floats: NaN is no result.
    """

    name: str
    unit: str
    title: str
    dims: tuple[str, ...] = ()
    dtype: str = "float64"


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a study can compute: its variables, and a function of a chunk that returns them.

    The function returns an array (case, *dims) of every variable, by name.
    `needs_both_directions`: of the sweep. `needs_closed_form`: of the model, whose effects then
    only change parameters. `settings`: further keys that a study may vary or fix, with their units;
    they begin with the name of the outcome, and are in `SampledCase.settings`; `required`: those
    that a study must state. `test`: what it computes in place of the model under the sweep.
    """

    name: str
    title: str
    variables: tuple[OutcomeVariable, ...]
    compute: Callable[[CaseChunk], Mapping[str, npt.NDArray[Any]]]
    needs_both_directions: bool = False
    needs_closed_form: bool = False
    settings: Mapping[str, str] = field(default_factory=dict)
    required: tuple[str, ...] = ()
    test: str = ""
