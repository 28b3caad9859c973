"""Backbone: phase resonance over the level of the table, each orbit held by feedback."""

from pydantic import Field, ValidationInfo, field_validator

from table_io.config.base import Count, Positive
from table_io.config.excitation import register_excitation
from table_io.config.excitation.continuation import UPDATE_BLEND_CYCLES, Continuation
from table_io.errors import InputError

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
