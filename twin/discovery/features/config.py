"""Features files: published or measured features of a specimen's response, from TOML."""

import math
from collections.abc import Mapping
from typing import Literal, NamedTuple, Self

from pydantic import Field, ValidationInfo, field_validator, model_validator

from table_io.config.base import ConfigModel, Count, Finite, NonNegative, Number, Positive
from table_io.errors import InputError
from table_io.units import GRAVITY_M_S2

FeatureKind = Literal[
    "peak_frequency", "peak_displacement", "displacement", "jump_up_frequency",
    "jump_down_frequency", "hysteresis", "contact", "impacts", "permanent_contact_gap",
]  # fmt: skip
Shape = Literal["right", "left", "none"]
ContactState = Literal["always", "some", "none"]
FeatureDirection = Literal["forward", "backward"]
_PLACE_KEYS = frozenset({"kind", "gap_mm", "place", "weight"})


class KindKeys(NamedTuple):
    """Keys of a kind of feature, beside `kind`, `gap_mm`, `place` and `weight`."""

    unit: str  # of its value and tolerance
    required: tuple[str, ...]
    optional: tuple[str, ...] = ()
    has_value: bool = True  # needs value, at_least or at_most, in the unit

    @property
    def values(self) -> tuple[str, ...]:
        """Keys of the value: itself, or limits."""
        names = ("value", "at_least", "at_most") if self.has_value else ()
        return tuple(f"{name}_{self.unit}" for name in names)

    @property
    def tolerance(self) -> str:
        return f"tolerance_{self.unit}"


KIND_KEYS: Mapping[str, KindKeys] = {
    "peak_frequency": KindKeys("hz", ()),
    "peak_displacement": KindKeys("mm", ()),
    "displacement": KindKeys("mm", ("at_hz", "direction")),
    "jump_up_frequency": KindKeys("hz", ()),
    "jump_down_frequency": KindKeys("hz", ()),
    "hysteresis": KindKeys("hz", ("shape",), ("inside_hz",), has_value=False),
    "contact": KindKeys("mm", ("contact",), ("at_hz", "direction"), has_value=False),
    "impacts": KindKeys("share", ("at_hz", "impacts"), has_value=False),
    "permanent_contact_gap": KindKeys("mm", ()),
}


class Feature(ConfigModel):
    """A feature of the response at a gap, with the tolerance within which a model explains it.

    `peak_*`: the largest swing of u, halved. `displacement`: half the swing at `at_hz` in a
    direction. `jump_*_frequency`: where the primary hysteresis ends. `permanent_contact_gap`: the
    largest total gap at which no bumper is left at any frequency.
    """

    kind: FeatureKind = Field(description="What the feature is.")
    gap_mm: Number | None = Field(
        None,
        validate_default=True,
        description="Total gap; inf = no bumpers. Not with `permanent_contact_gap`.",
    )
    place: str = Field(min_length=1, description="Where it is published, or how it was measured.")
    weight: NonNegative = Field(1.0, description="Weight in the fit; it always counts as one.")
    value_hz: Positive | None = Field(None, description="Published frequency.")
    at_least_hz: Positive | None = Field(None, description="Lower limit instead of a value.")
    at_most_hz: Positive | None = Field(None, description="Upper limit instead of a value.")
    tolerance_hz: Positive | None = Field(None, description="Half width of what still agrees.")
    value_mm: Finite | None = Field(None, description="Published length.")
    at_least_mm: Finite | None = Field(None, description="Lower limit instead of a value.")
    at_most_mm: Finite | None = Field(None, description="Upper limit instead of a value.")
    tolerance_mm: Positive | None = Field(
        None, description="Half width of what still agrees; of a contact, the error of a gap."
    )
    tolerance_share: Positive | None = Field(
        None, description="Share of the cycles that may have other impacts."
    )
    at_hz: Positive | None = Field(None, description="Frequency at which it was observed.")
    direction: FeatureDirection | None = Field(None, description="Direction of the sweep.")
    shape: Shape | None = Field(
        None, description="Primary hysteresis: right is hardening, left softening."
    )
    inside_hz: tuple[Positive, ...] = Field((), description="Frequencies inside the hysteresis.")
    contact: ContactState | None = Field(
        None,
        description="Contact over a cycle at `at_hz`, or, without it, at every frequency: always "
        "with both bumpers (precompressed), with loss or for some of the time, or none.",
    )
    impacts: tuple[Count, ...] = Field(
        (), description="Impacts per cycle on the two sides, the larger count first."
    )

    @field_validator("gap_mm")
    @classmethod
    def _check_total_gap(cls, gap: float | None, info: ValidationInfo) -> float | None:
        kind = info.data.get("kind")
        if kind is None:
            return gap
        if (gap is None) != (kind == "permanent_contact_gap"):
            raise InputError(
                f"{kind} {'needs' if gap is None else 'has no'} gap_mm",
                remedy="add it" if gap is None else "leave it out",
            )
        if gap is not None and (math.isnan(gap) or gap == -math.inf):
            raise InputError(f"gap_mm is {gap}", allowed="a number in mm, or inf for no bumpers")
        return gap

    @field_validator("impacts")
    @classmethod
    def _check_impacts(cls, impacts: tuple[int, ...]) -> tuple[int, ...]:
        if impacts and (len(impacts) != 2 or impacts[0] < impacts[1] or impacts[1] < 0):
            raise InputError(
                f"impacts is {list(impacts)}", allowed="two counts, the larger one first"
            )
        return impacts

    @model_validator(mode="after")
    def _check_keys(self) -> Self:
        keys = KIND_KEYS[self.kind]
        required = (*keys.required, keys.tolerance)
        allowed = {*_PLACE_KEYS, *required, *keys.optional, *keys.values}
        for key in sorted(self.model_fields_set - allowed):
            raise InputError(
                f"not a key of {self.kind}", key=key,
                allowed=", ".join(sorted(allowed - _PLACE_KEYS)), remedy="leave it out",
            )  # fmt: skip
        for key in required:
            if getattr(self, key) in (None, ()):
                raise InputError(f"{self.kind} needs {key}", key=key, remedy="add it")
        given = [key for key in keys.values if getattr(self, key) is not None]
        has_limits = bool(given) and keys.values[0] not in given
        if keys.values and not (has_limits or given == [keys.values[0]]):
            raise InputError(
                f"{self.kind} needs a value or limits", key=keys.values[0],
                remedy=f"give {keys.values[0]}, or {keys.values[1]} and {keys.values[2]}",
            )  # fmt: skip
        if keys.values and self.limits[0] > self.limits[1]:
            raise InputError(
                "the limits exclude each other", key=keys.values[1],
                value=self.limits[0], allowed=f"at most {self.limits[1]:g}",
            )  # fmt: skip
        if (self.at_hz is None) != (self.direction is None) and self.kind == "contact":
            raise InputError(
                "at_hz and direction go together", key="at_hz", remedy="give both or neither"
            )
        return self

    @property
    def limits(self) -> tuple[float, float]:
        """Smallest and largest value in hz or mm that agrees without the tolerance."""
        value, least, most = (getattr(self, key) for key in KIND_KEYS[self.kind].values)
        if value is not None:
            return value, value
        return -math.inf if least is None else least, math.inf if most is None else most

    @property
    def tolerance(self) -> float:
        """Tolerance in hz, mm or as a share, as the kind has it."""
        return float(getattr(self, KIND_KEYS[self.kind].tolerance))


class FeatureTest(ConfigModel):
    """Stepped sine in which the features were observed."""

    acceleration_g: Positive = Field(description="Peak table acceleration.")
    start_hz: Positive = Field(description="Lowest frequency of the sweep.")
    end_hz: Positive = Field(description="Highest frequency of the sweep.")
    step_hz: Positive = Field(
        description="Frequency step; a narrower hysteresis would not have been seen."
    )

    @field_validator("end_hz")
    @classmethod
    def _check_range(cls, end_hz: float, info: ValidationInfo) -> float:
        if end_hz <= info.data.get("start_hz", 0.0):
            raise InputError(f"end_hz is {end_hz}", allowed="above start_hz")
        return end_hz

    @property
    def acceleration_m_s2(self) -> float:
        return self.acceleration_g * GRAVITY_M_S2


class FeatureSpecimen(ConfigModel):
    """Specimen of all features; each feature states its gap."""

    mass_kg: Positive = Field(description="Moving mass, with everything fixed to it.")


class RefitRange(ConfigModel):
    """By which factors a refit may change the base model: bounds, and 95 % of the prior."""

    stiffness: tuple[Positive, Positive] = Field((0.5, 1.5), description="Of the damper.")
    damping: tuple[Positive, Positive] = Field((0.1, 2.0), description="Of the damper.")
    bumper_stiffness: tuple[Positive, Positive] = Field((0.7, 1.4), description="Of each bumper.")
    bumper_damping: tuple[Positive, Positive] = Field((0.3, 3.0), description="Of each bumper.")

    @field_validator("*")
    @classmethod
    def _check_factors(
        cls, factors: tuple[float, float], info: ValidationInfo
    ) -> tuple[float, float]:
        if not factors[0] <= 1.0 <= factors[1] or factors[0] == factors[1]:
            raise InputError(
                f"{info.field_name} is {list(factors)}", allowed="[low, high] around 1, as factors"
            )
        return factors


class FeatureSet(ConfigModel):
    """A features file: what was observed of a specimen, for `discover --features`."""

    title: str = Field(description="Title in every report.")
    citation: str = Field("", description="Source of the features.")
    specimen: FeatureSpecimen
    test: FeatureTest
    refit: RefitRange = RefitRange()
    features: tuple[Feature, ...] = Field(min_length=1, description="What was observed.")

    @property
    def gaps_mm(self) -> tuple[float, ...]:
        """Total gaps of the features in mm, from large to small."""
        gaps = {feature.gap_mm for feature in self.features if feature.gap_mm is not None}
        return tuple(sorted(gaps, reverse=True))
