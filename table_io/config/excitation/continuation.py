"""Kinds that hold orbits by feedback: a continuation along a branch, stable or not, and a backbone.

The orbits come from an orbit plan, which the twin computes before the test: periodic orbits along a
branch, with feedback gains. A plan is JSON text, so it travels in the `files` of an excitation and
thus in the recorded profile. With the phase phi = 2 pi f t of the sine a sin(phi) that the table's
acceleration follows, the relative displacement is u(t) = Re sum_k U_k exp(i k phi). As a real
vector its harmonics are [Re U_0, Re U_1, Im U_1, Re U_2, Im U_2, ...], (2 harmonics + 1,).
"""

import json
import math
from functools import cached_property
from typing import ClassVar, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field, ValidationError, ValidationInfo, field_validator

from table_io.block import Float1D, Float2D
from table_io.config.base import (
    ConfigModel,
    Count,
    Finite,
    NonNegative,
    Number,
    Positive,
    find_attached_text,
)
from table_io.config.excitation import (
    MIN_BLEND_CYCLES,
    Excitation,
    ExcitationPlan,
    register_excitation,
)
from table_io.errors import InputError
from table_io.records import Step

JACOBIAN_DIGITS = 7  # significant digits in a file; a measured orbit corrects far larger errors
MAX_HARMONICS = 30
AMPLITUDE_SAMPLES = 512  # of a period, at which the swing of u is taken
Complex1D = npt.NDArray[np.complex128]


class PlannedOrbit(ConfigModel):
    """Periodic orbit of the model at a frequency and peak table acceleration.

    `jacobian` is the derivative of the harmonics of u with respect to those of the table's
    displacement, without feedback.

    The feedback to the command is gain (x - x_ref) + rate_gain_s (x' - x_ref'), `latency_s` later,
    of the mass's displacement x in the laboratory frame (u plus the table's). Fed back from u, the
    table's own correction would come back at a gain of about -gain, at every frequency above the
    resonance: at 45 ms x holds the orbits of G4 with gains of 1.1 to 0.45 and -2 ms.
    """

    frequency_hz: Positive
    acceleration_m_s2: Positive
    stable: bool
    multiplier: Finite | tuple[Finite, Finite] = Field(
        description="Largest Floquet multiplier: real, or real and imaginary part."
    )
    u_m: tuple[tuple[Finite, Finite], ...] = Field(description="U_0, U_1, ..., each (Re, Im), m.")
    jacobian: tuple[tuple[Finite, ...], ...]
    gain: Finite
    rate_gain_s: Finite

    @field_validator("jacobian")
    @classmethod
    def _check_jacobian(
        cls, rows: tuple[tuple[float, ...], ...], info: ValidationInfo
    ) -> tuple[tuple[float, ...], ...]:
        size = 2 * len(info.data.get("u_m", ())) - 1
        if len(rows) != size or any(len(row) != size for row in rows):
            raise InputError(
                f"jacobian has {len(rows)} rows for {len(info.data.get('u_m', ()))} harmonics of u",
                allowed=f"{size} rows of {size}",
            )
        return rows

    @property
    def multiplier_size(self) -> float:
        """Magnitude of the largest Floquet multiplier."""
        return abs(complex(*np.atleast_1d(self.multiplier)))

    @property
    def harmonics_m(self) -> Float1D:
        """Harmonics of u in m as a real vector, (2 harmonics + 1,)."""
        return pack_harmonics(np.array([complex(*pair) for pair in self.u_m]))

    @cached_property
    def amplitude_m(self) -> float:
        """Half of max u - min u in m."""
        turns = np.exp(2j * math.pi * np.arange(AMPLITUDE_SAMPLES) / AMPLITUDE_SAMPLES)
        harmonics = np.array([complex(*pair) for pair in self.u_m])
        return float(np.ptp(np.polyval(harmonics[::-1], turns).real)) / 2.0

    @property
    def jacobian_matrix(self) -> Float2D:
        """Derivative of the harmonics of u by those of the table, (2 harmonics + 1,) squared."""
        return np.array(self.jacobian)


class OrbitPlan(ConfigModel):
    """Orbits in order: of one branch, through its folds, or in phase resonance by rising level."""

    version: Literal[1] = 1
    condition: Literal["arclength", "phase"] = Field(
        "arclength",
        description="What selects a point: its place along the branch, or a phase of 90 degrees.",
    )
    harmonics: Count = Field(ge=1, le=MAX_HARMONICS)
    latency_s: NonNegative = Field(description="From motion to the table's answer to it.")
    jitter_s: NonNegative = Field(0.0, description="Variation of the latency.")
    points: tuple[PlannedOrbit, ...] = Field(min_length=1)
    leads: tuple[PlannedOrbit, ...] = Field(
        (), description="Orbits from one that rest leads to, to the first point; not measured."
    )

    @field_validator("points", "leads")
    @classmethod
    def _check_harmonics(
        cls, points: tuple[PlannedOrbit, ...], info: ValidationInfo
    ) -> tuple[PlannedOrbit, ...]:
        count = info.data.get("harmonics")
        for number, point in enumerate(points):
            if count is not None and len(point.u_m) != count + 1:
                raise InputError(
                    f"point {number} has u_m up to harmonic {len(point.u_m) - 1}",
                    allowed=f"{count}, as harmonics states",
                )
        return points

    def to_json(self) -> str:
        """Return the plan as JSON text, one point a line."""
        head = self.model_dump(exclude={"points", "leads"})
        points, leads = (
            ",\n".join(_to_line(orbit) for orbit in orbits) for orbits in (self.points, self.leads)
        )
        tail = f', "leads": [\n{leads}\n]' if self.leads else ""
        return f'{json.dumps(head)[:-1]}, "points": [\n{points}\n]{tail}}}\n'


def _to_line(orbit: PlannedOrbit) -> str:
    """Return an orbit as one line of JSON."""
    table = orbit.model_dump()
    table["jacobian"] = [
        [float(f"{value:.{JACOBIAN_DIGITS}g}") for value in row] for row in orbit.jacobian
    ]
    return json.dumps(table, separators=(",", ":"))


def parse_orbit_plan(text: str, name: str) -> OrbitPlan:
    """Parse the JSON text of an orbit plan; InputError names the first value at fault."""
    try:
        return OrbitPlan.model_validate_json(text)
    except ValidationError as error:
        details = error.errors(include_url=False)[0]
        cause = details.get("ctx", {}).get("error")
        raise InputError(
            cause.problem if isinstance(cause, InputError) else str(details["msg"]),
            where=name,
            key=".".join(str(part) for part in details["loc"]),
            allowed=cause.allowed if isinstance(cause, InputError) else "",
            remedy="make the orbit plan again",
        ) from None


def pack_harmonics(coefficients: Complex1D) -> Float1D:
    """Return complex harmonics U_0 .. U_H, (H + 1,), as a real vector, (2 H + 1,)."""
    vector = np.empty(2 * coefficients.size - 1)
    vector[0] = coefficients[0].real
    vector[1::2] = coefficients[1:].real
    vector[2::2] = coefficients[1:].imag
    return vector


def unpack_harmonics(vector: Float1D) -> Complex1D:
    """Return a real vector of harmonics, (2 H + 1,), as complex U_0 .. U_H, (H + 1,)."""
    return np.concatenate([vector[:1], vector[1::2] + 1j * vector[2::2]])


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
    points: Count = Field(
        60,
        ge=1,
        le=1000,
        description="Unstable orbits along the branch; more where they would lie too far apart.",
    )
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
        description="Largest amplitude of the feedback over that of the command.",
    )
    multiplier_periods: Count = Field(
        32,
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
