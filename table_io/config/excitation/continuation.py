"""Kinds that hold orbits by feedback: a continuation along a branch, stable or not, and a backbone.

The orbits come from an orbit plan, which the twin computes before the test (`orbit_plan.py`).
"""

from functools import cached_property
from typing import ClassVar

from pydantic import Field, ValidationInfo, field_validator

from table_io.config.base import Count, Number, Positive, find_attached_text
from table_io.config.excitation import (
    MIN_BLEND_CYCLES,
    Excitation,
    ExcitationPlan,
    register_excitation,
)
from table_io.config.excitation.orbit_plan import OrbitPlan, parse_orbit_plan
from table_io.errors import InputError
from table_io.records import Step

CAPTURE_CYCLES = 20  # held at the first orbit after a soft start
UPDATE_BLEND_CYCLES = 2.0  # between references of one point


@register_excitation("continuation")
class Continuation(Excitation):
    """Control-based continuation along a branch of periodic orbits.

    The first keys say which orbits the plan is made of, if the profile names no `file`.
    """

    FILE_KEYS: ClassVar[tuple[str, ...]] = ("file",)

    start_hz: Positive = Field(description="Frequency where the branch is entered.")
    stop_hz: Positive = Field(description="Frequency where it is left.")
    acceleration_g: Positive = Field(0.05, description="Peak table acceleration.")
    points: Count = Field(60, ge=1, le=1000, description="Unstable orbits along the branch.")
    settle_cycles: Count = Field(10, ge=2, le=1000, description="Before each evaluation.")
    measured_cycles: Count = Field(10, ge=2, le=1000, description="Of each evaluation.")
    blend_cycles: Number = Field(4.0, ge=MIN_BLEND_CYCLES, le=50, description="Between orbits.")
    updates: Count = Field(6, ge=1, le=50, description="Largest number of the reference a point.")
    tolerance: Number = Field(
        0.003, gt=0, le=0.05, description="Accepted feedback over the amplitude of the command."
    )
    max_feedback: Number = Field(
        0.5,
        gt=0,
        le=1.0,
        description="Largest feedback over the command: in amplitude, and in acceleration.",
    )
    multiplier_periods: Count = Field(
        24,
        ge=0,
        le=1000,
        description="Of an accepted orbit, to measure its Floquet multiplier; 0: not measured.",
    )
    retries: Count = Field(3, ge=0, le=100, description="Of a point where the orbit is lost.")
    table_lag_ms: Positive | None = Field(
        None,
        le=200,
        description="Lag of the table behind its command, which the gains allow for; omitted: "
        "table_response.lag_ms of the rig.",
    )
    files: dict[str, str] = Field({}, description="Texts of files by name; loading attaches them.")
    file: str | None = Field(None, description="Orbit plan; omitted: `run` computes it.")

    @field_validator("stop_hz")
    @classmethod
    def _check_ascending(cls, stop: float, info: ValidationInfo) -> float:
        if stop < info.data.get("start_hz", 0.0):
            raise InputError(f"stop_hz {stop} lies below start_hz", remedy="exchange them")
        return stop

    @field_validator("file")
    @classmethod
    def _check_file(cls, name: str | None, info: ValidationInfo) -> str | None:
        text = find_attached_text(name, info)
        if text is not None:
            parse_orbit_plan(text, str(name))
        return name

    @cached_property
    def orbit_plan(self) -> OrbitPlan:
        """Orbits to measure; InputError if the profile has no plan yet."""
        if self.file is None:
            raise InputError(
                "the profile has no orbit plan",
                key="excitation.file",
                remedy="`shaketwin run` computes it; or name the file of a plan",
            )
        return parse_orbit_plan(self.files[self.file], self.file)

    @property
    def expected_s(self) -> float:
        """Duration in s if each orbit needs one update of its reference."""
        cycles = 2 * (self.settle_cycles + self.measured_cycles + self.blend_cycles)
        cycles += self.multiplier_periods
        return sum(cycles / orbit.frequency_hz for orbit in self.orbit_plan.points)

    def plan(self, rate_hz: float) -> ExcitationPlan:
        """Return one step per planned orbit; the test adapts its frequency."""
        orbits = self.orbit_plan.points
        steps = tuple(
            Step(index, "forward", orbit.frequency_hz, orbit.acceleration_m_s2)
            for index, orbit in enumerate(orbits)
        )
        frequencies = [orbit.frequency_hz for orbit in orbits]
        return ExcitationPlan(
            max(orbit.acceleration_m_s2 for orbit in orbits),
            min(frequencies),
            max(frequencies),
            steps,
            blend_cycles=self.blend_cycles,
        )


MAX_POINT_PERIODS = 100  # of a point, without the capture of the first one


@register_excitation("backbone")
class Backbone(Continuation):
    """Backbone by phase control: at each level the frequency at which u leads by 90 degrees.

    There the fundamental of the table's force balances the damping alone. The frequency is
    controlled with the reference of the feedback, as in a continuation, whose keys apply; the
    points are spaced evenly by the logarithm of the level.
    """

    start_hz: Positive = Field(description="Lower end of the range of the resonance.")
    stop_hz: Positive = Field(description="Upper end of the range of the resonance.")
    acceleration_g: Positive = Field(0.05, description="Largest peak table acceleration.")
    points: Count = Field(16, ge=1, le=1000, description="Levels.")
    settle_cycles: Count = Field(8, ge=2, le=1000, description="Before each evaluation.")
    measured_cycles: Count = Field(8, ge=2, le=1000, description="Of each evaluation.")
    updates: Count = Field(4, ge=1, le=50, description="Largest number of the reference a point.")
    multiplier_periods: Count = Field(
        0,
        ge=0,
        le=1000,
        validate_default=True,
        description="Of an accepted orbit, to measure its Floquet multiplier; 0: not measured.",
    )
    min_acceleration_g: Positive = Field(0.005, description="Smallest peak table acceleration.")

    @field_validator("multiplier_periods")
    @classmethod
    def _check_periods(cls, periods: int, info: ValidationInfo) -> int:
        names = ("settle_cycles", "measured_cycles", "blend_cycles", "updates")
        if not all(name in info.data for name in names):
            return periods  # reported for themselves
        settle, measured, blend, updates = (info.data[name] for name in names)
        evaluation = settle + measured
        total = blend + evaluation + periods
        total += updates * (UPDATE_BLEND_CYCLES + evaluation)
        if total > MAX_POINT_PERIODS:
            raise InputError(
                f"a point would take up to {total:g} periods",
                allowed=f"up to {MAX_POINT_PERIODS}",
                remedy="lower updates, settle_cycles, measured_cycles or multiplier_periods",
            )
        return periods

    @field_validator("min_acceleration_g")
    @classmethod
    def _check_levels(cls, level: float, info: ValidationInfo) -> float:
        largest = info.data.get("acceleration_g", level)
        if level > largest:
            raise InputError(
                f"the smallest level {level:g} g lies above the largest, {largest:g} g",
                allowed="up to acceleration_g",
                remedy="exchange them",
            )
        return level
