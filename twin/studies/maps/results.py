"""Results of a study as labelled arrays, while it runs too."""

import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from table_io.block import Float1D, Float2D
from table_io.errors import InputError, require_package, suggest
from twin.compare.curves import FloatND
from twin.studies.maps.cases import grid_axes
from twin.studies.maps.outcomes import OutcomeVariable
from twin.studies.maps.store import Manifest, open_group, read_definition, require_unchanged_store
from twin.studies.maps.study import Study

if TYPE_CHECKING:
    import xarray


def open_study(folder: Path | str, variables: Sequence[str] | None = None) -> "xarray.Dataset":
    """Return the results of a study as a labelled dataset, with units, title and versions.

    A grid has a dimension per parameter, named as its key, and `repeat` where cases are repeated;
    samples have the dimension `case`; curves also `direction` (1 forward, -1 backward) and
    `frequency_hz`. Cases without a result, such as those still to come, are NaN. `variables`:
    only these are returned. InputError for a folder without a study, for one in which results,
    parameters or seeds are not those that were stored, or an unknown variable.
    """
    require_package("xarray", "studies", "open_study")
    return StudyResults(Path(folder)).to_dataset(variables)


@dataclass(frozen=True)
class StudyResults:
    """The results in the folder of a study, each read once, as it is asked for."""

    folder: Path
    _arrays: dict[str, FloatND] = field(default_factory=dict, init=False, repr=False, compare=False)

    @cached_property
    def study(self) -> Study:
        return Study.from_definition(read_definition(self.folder), str(self.folder))

    @cached_property
    def manifest(self) -> Manifest:
        return Manifest(self.folder, [variable.name for variable in self.study.variables])

    @cached_property
    def _group(self) -> Any:
        """The arrays, of which every stored chunk is what was computed; else InputError."""
        require_unchanged_store(self.folder, self.study, read_definition(self.folder))
        group = open_group(self.folder, "r")
        self.manifest.require_unchanged(group)
        return group

    @property
    def scalars(self) -> tuple[OutcomeVariable, ...]:
        """Variables with one number of each case."""
        return tuple(variable for variable in self.study.variables if not variable.dims)

    @property
    def is_grid(self) -> bool:
        return self.study.config.sampling == "grid"

    def read_by_case(self, name: str) -> FloatND:
        """Return a variable or parameter, (case, ...); the same array at every call."""
        if name not in self._arrays:
            self._arrays[name] = self._group[name][:]
        return self._arrays[name]

    @property
    def stored_flags(self) -> np.ndarray[Any, np.dtype[np.bool_]]:
        """Which cases are stored, (case,)."""
        flags = np.zeros(self.study.config.case_count, dtype=bool)
        for chunk in self.manifest.chunks.values():
            flags[chunk.span] = True
        return flags

    def read_array(self, name: str) -> FloatND:
        """Return a variable: of a grid (*shape, ...), of samples (case, ...)."""
        values = self.read_by_case(name)
        return values.reshape(*self.study.config.shape, *values.shape[1:])

    def read_grid(self, name: str) -> FloatND:
        """Return a variable of a grid, (*parameters), the mean over repeated cases."""
        values = self.read_array(name)
        if self.study.config.repeats == 1:
            return values
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # all of a cell are missing
            return np.nanmean(values, axis=-1)

    def find_unit(self, name: str) -> str:
        """Return the unit of a parameter."""
        return self.study.factory.find_unit(name)

    def label_parameter(self, name: str) -> str:
        """Return the name of a parameter for a label, with its unit: "gap in mm"."""
        return describe_parameter(name, self.find_unit(name))

    def describe_value(self, name: str, value: float) -> str:
        """Return a parameter and its value: "gap 4 mm"."""
        plain, unit = self.label_parameter(name).split(" in ")[0], self.find_unit(name)
        text = f"{plain} {format_plain(value)} {format_unit(unit)}"
        return text.replace("-", "−").rstrip()

    def grid_axes(self) -> dict[str, Float1D]:
        """Return the values of each parameter of a grid, by its key."""
        config = self.study.config
        names = [parameter.name for parameter in config.parameters]
        return dict(zip(names, grid_axes(config), strict=True))

    def to_dataset(self, variables: Sequence[str] | None = None) -> "xarray.Dataset":
        """Return the dataset of `open_study`."""
        import xarray

        known = {variable.name: variable for variable in self.study.variables}
        for name in variables or ():
            if name not in known:
                raise InputError("no variable of this study", key=name, remedy=suggest(name, known))
        names = [parameter.name for parameter in self.study.config.parameters]
        repeats = ("repeat",) if self.study.config.repeats > 1 else ()
        own_dims = (*names, *repeats) if self.is_grid else ("case",)
        coordinates: dict[str, Any] = {
            dim: (dim, self._group[dim][:], dict(self._group[dim].attrs))
            for dim in ("direction", "frequency_hz")
        }
        axes = self.grid_axes() if self.is_grid else {}
        for name in names:
            attributes = dict(self._group[name].attrs)
            coordinates[name] = (
                (name, axes[name], attributes)
                if self.is_grid
                else ("case", self.read_by_case(name), attributes)
            )
        seeds = self._group["seed"][:].reshape(self.study.config.shape)
        coordinates["seed"] = (own_dims, seeds, dict(self._group["seed"].attrs))
        data = {
            name: (
                (*own_dims, *known[name].dims),
                self.read_array(name),
                dict(self._group[name].attrs),
            )
            for name in (variables if variables is not None else known)
        }
        attributes = {
            name: value for name, value in self._group.attrs.items() if name != "coordinates"
        }
        return xarray.Dataset(data, coordinates, attributes | {"cases": self.manifest.case_count})


def describe_parameter(name: str, unit: str) -> str:
    """Return the name of a parameter for a label: its key without the file's table, and its unit.

    The unit is not repeated: specimen.gap_mm is "gap in mm".
    """
    plain = name.split(".", 1)[1]
    suffix = "_" + unit.replace("/", "_").replace(" ", "_").lower()
    plain = plain.removesuffix(suffix).replace("_", " ").replace(".", " ")
    return f"{plain} in {format_unit(unit)}" if unit not in ("", "1") else plain


def format_plain(value: float) -> str:
    """Format a number without exponent, thousands apart."""
    return f"{value:,.0f}".replace(",", " ") if abs(value) >= 1000 else f"{value:.4g}"


def format_unit(unit: str) -> str:
    """Return a unit with raised exponents, m/s2 as m/s²; nothing for that of a ratio, 1."""
    if unit == "1":
        return ""
    return re.sub(r"(?<=[a-z])[23]", lambda match: "²³"[int(match.group()) - 2], unit)


def find_front(first: Float1D, second: Float1D) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    """Return the indices of the points that no other betters in both values, by the first.

    Points with NaN are none.
    """
    known = np.flatnonzero(np.isfinite(first) & np.isfinite(second))
    order = known[np.lexsort((second[known], first[known]))]
    if not order.size:
        return order
    best_before = np.r_[np.inf, np.minimum.accumulate(second[order])[:-1]]
    return order[second[order] < best_before]


RESAMPLE_COUNT = 500
INTERVAL_LEVEL = 0.95


@dataclass(frozen=True)
class SensitivityIndices:
    """Indices of each parameter, (parameter,), with intervals (2, parameter) by the bootstrap.

    `used_share`: of the base samples, those whose cases all have a number.
    """

    first: Float1D
    total: Float1D
    first_interval: Float2D
    total_interval: Float2D
    used_share: float


def compute_sensitivity(values: Float1D, parameter_count: int, seed: int) -> SensitivityIndices:
    """Compute the Sobol indices of an outcome over the cases of a sensitivity design, (case,).

    First order: a parameter alone; total: with all its interactions. Source: Saltelli et al.,
    Comput. Phys. Commun. 181 (2010) 259, Eq. (b) of Table 2 and, for the total, Jansen's Eq. (f).
    The order of the cases is that of `sample_parameters`. NaN without usable samples.
    """
    blocks = values.reshape(parameter_count + 2, -1)
    usable = np.isfinite(blocks).all(axis=0)
    blocks = blocks[:, usable]
    count, share = blocks.shape[1], float(usable.mean())
    nan = np.full(parameter_count, np.nan)
    if count < 2 or not np.ptp(blocks[:2]) > 0:
        return SensitivityIndices(nan, nan, np.stack([nan, nan]), np.stack([nan, nan]), share)
    first, total = _estimate_indices(blocks[:, None])
    rng = np.random.default_rng(seed)
    samples = [
        _estimate_indices(blocks[:, rng.integers(0, count, (1, count))])
        for _ in range(RESAMPLE_COUNT)
    ]
    tails = [(1 - INTERVAL_LEVEL) / 2, (1 + INTERVAL_LEVEL) / 2]
    first_interval, total_interval = (
        np.nanquantile(np.concatenate([sample[kind] for sample in samples]), tails, axis=0)
        for kind in range(2)
    )
    return SensitivityIndices(first[0], total[0], first_interval, total_interval, share)


def _estimate_indices(blocks: FloatND) -> tuple[FloatND, FloatND]:
    """Return (first order, total), each (set, parameter), of blocks (block, set, sample)."""
    with np.errstate(invalid="ignore", divide="ignore"):
        centred = blocks - blocks[:2].mean(axis=(0, 2))[:, None]
        a, b, mixed = centred[0], centred[1], centred[2:]
        variance = centred[:2].var(axis=(0, 2))
        first = (b * (mixed - a)).mean(axis=2) / variance
        total = ((a - mixed) ** 2).mean(axis=2) / (2 * variance)
    return first.T, total.T
