"""Study file: what is varied and how, and what is computed."""

import math
from typing import Literal

from pydantic import Field, field_validator, model_validator

from table_io.config.base import ConfigModel, Count, Finite
from table_io.errors import InputError

Sampling = Literal["grid", "latin_hypercube", "sobol", "sensitivity"]
MAX_CASES = 100_000_000
MAX_VALUES = 100_000  # of one parameter
MAX_CHUNK = 1000
MIN_CHUNKS = 16  # of a small study, so that every core has work


class VariedParameter(ConfigModel):
    """A parameter and its values: a list, or from `start` to `stop`.

    A grid takes `count` values, or one every `step`; random samples lie anywhere between the ends.
    """

    name: str = Field(
        description="Key in a test or model file, such as specimen.gap_mm, sweep.acceleration_g, "
        "base.stiffness_n_m or effects.coulomb_friction.fc."
    )
    values: tuple[Finite, ...] = Field((), description="Values of a grid.")
    start: Finite | None = Field(None, description="Lowest value, in the unit of the key.")
    stop: Finite | None = Field(None, description="Highest value.")
    step: Finite | None = Field(None, description="Distance of the values of a grid.")
    count: Count | None = Field(
        None, ge=2, le=MAX_VALUES, description="Number of values of a grid."
    )
    scale: Literal["linear", "log"] = Field(
        "linear", description="log: evenly spaced in the logarithm."
    )

    @model_validator(mode="after")
    def _require_values(self) -> "VariedParameter":
        if self.values:
            if (self.start, self.stop, self.step, self.count) != (None,) * 4:
                raise ValueError("give either values, or start and stop")
            if len(set(self.values)) < len(self.values) or list(self.values) != sorted(self.values):
                raise ValueError("values must ascend, each of them once")
            if self.scale == "log" and self.values[0] <= 0:
                raise ValueError("on a log scale, values must be above 0")
            return self
        if self.start is None or self.stop is None or not self.start < self.stop:
            raise ValueError("give values, or start and a larger stop")
        if self.scale == "log" and self.start <= 0:
            raise ValueError("on a log scale, start must be above 0")
        if self.step is not None:
            steps = (self.stop - self.start) / self.step if self.step > 0 else math.nan
            if not 1 <= steps <= MAX_VALUES or abs(steps - round(steps)) > 1e-6 or self.count:
                raise ValueError(
                    "step must divide the range from start to stop, and excludes count"
                )
            if self.scale == "log":
                raise ValueError("on a log scale, give count instead of step")
        return self

    @property
    def limits(self) -> tuple[float, float]:
        """Lowest and highest value."""
        if self.values:
            return self.values[0], self.values[-1]
        assert self.start is not None
        assert self.stop is not None
        return self.start, self.stop

    @property
    def grid_size(self) -> int:
        """Number of values of a grid, 0 without one."""
        if self.values:
            return len(self.values)
        if self.step is not None:
            return round((self.limits[1] - self.limits[0]) / self.step) + 1
        return self.count or 0


class FrontConfig(ConfigModel):
    """Front of the cases that none betters in two outcomes at once: a trade between them."""

    minimise: tuple[str, str] = Field(
        description="Two variables with one number of each case, such as peak_disp_m."
    )
    each: str = Field(
        "", description="Parameter with a front for each of its values; empty: one front."
    )
    limits: tuple[Finite, ...] = Field(
        (),
        description="Values that the second variable must not exceed, in its unit: the page names "
        "the case with the least of the first for each.",
    )


class StudyConfig(ConfigModel):
    """A study of a model under the ideal stepped sine of a test, over any of their parameters."""

    title: str = Field(description="Title of the study in its report.")
    citation: str = Field("", description="Source of the question.")
    profile: str = Field(
        description="Name of a test, or path of a .toml file relative to this file."
    )
    model: str = Field("", description="Name or path of a model; empty: the one of the test.")
    outcomes: tuple[str, ...] = Field(min_length=1, description="What is computed of every case.")
    sampling: Sampling = Field(
        "grid",
        description="All combinations of the values, or samples between their ends; "
        "sensitivity: those that Sobol indices need.",
    )
    samples: Count | None = Field(
        None, ge=2, le=MAX_CASES,
        description="Number of samples, of sobol and sensitivity a power of 2; of sensitivity, "
        "base samples.",
    )  # fmt: skip
    repeats: Count = Field(
        1, ge=1, le=1000, description="Cases of every combination of a grid, with other seeds."
    )
    seed: Count = Field(0, ge=0, lt=2**32, description="Seed of the samples, and of every case.")
    chunk: Count | None = Field(
        None, ge=1, le=MAX_CHUNK,
        description="Cases that are computed and stored together; by default up to 1000.",
    )  # fmt: skip
    parameters: tuple[VariedParameter, ...] = Field(min_length=1)
    fixed: dict[str, Finite] = Field(
        default={},
        description="Values of other keys, in place of those of the test and model; the keys in "
        'quotes: "specimen.mass_kg" = 500.0.',
    )

    front: FrontConfig | None = None

    @field_validator("parameters")
    @classmethod
    def _require_distinct(
        cls, parameters: tuple[VariedParameter, ...]
    ) -> tuple[VariedParameter, ...]:
        names = [parameter.name for parameter in parameters]
        if len(set(names)) < len(names):
            raise ValueError("each parameter at most once")
        return parameters

    @model_validator(mode="after")
    def _require_sizes(self) -> "StudyConfig":
        if self.sampling == "grid":
            lacking = [p.name for p in self.parameters if not p.grid_size]
            if lacking:
                raise InputError(
                    "without values", key=", ".join(lacking), remedy="give values, step or count"
                )
            if self.samples is not None:
                raise InputError("a grid has its own number of cases", key="samples")
        else:
            if self.repeats > 1:
                raise InputError("of a grid only", key="repeats", remedy="give more samples")
            if self.samples is None:
                raise InputError("missing", key="samples", allowed=f"2 to {MAX_CASES}")
            listed = [p.name for p in self.parameters if p.values]
            if listed:
                raise InputError(
                    "samples lie anywhere in a range",
                    key=", ".join(listed),
                    remedy="give start and stop in place of values",
                )
            if self.sampling != "latin_hypercube" and self.samples & (self.samples - 1):
                below = 1 << (self.samples.bit_length() - 1)
                raise InputError(
                    "not a power of 2, with which alone Sobol's points are even",
                    key="samples",
                    value=self.samples,
                    remedy=f"give {below} or {2 * below}",
                )
        if self.case_count > MAX_CASES:
            raise InputError(
                f"{self.case_count:.3g} cases are too many", allowed=f"{MAX_CASES} cases"
            )
        return self

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of values of each parameter of a grid, and of repeats; of samples their number."""
        if self.sampling == "grid":
            repeats = (self.repeats,) if self.repeats > 1 else ()
            return (*(parameter.grid_size for parameter in self.parameters), *repeats)
        assert self.samples is not None
        if self.sampling == "sensitivity":
            return (self.samples * (len(self.parameters) + 2),)
        return (self.samples,)

    @property
    def case_count(self) -> int:
        return math.prod(self.shape)

    @property
    def chunk_size(self) -> int:
        """Cases of a chunk; it does not depend on the workers, so neither do the stored bytes."""
        return self.chunk or max(1, min(MAX_CHUNK, math.ceil(self.case_count / MIN_CHUNKS)))

    @property
    def chunk_count(self) -> int:
        return math.ceil(self.case_count / self.chunk_size)
