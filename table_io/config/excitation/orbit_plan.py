"""Orbit plan: periodic orbits along a branch, computed before the test, with feedback gains.

A plan is JSON text, so it travels in the `files` of an excitation and thus in the recorded profile.
With the phase phi = 2 pi f t of the sine a sin(phi) that the table's acceleration follows, the
relative displacement is u(t) = Re sum_k U_k exp(i k phi). As a real vector its harmonics are
[Re U_0, Re U_1, Im U_1, Re U_2, Im U_2, ...], (2 harmonics + 1,).
"""

import json
import math
from functools import cached_property
from typing import Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field, ValidationError, ValidationInfo, field_validator

from table_io.block import Float1D, Float2D
from table_io.config.base import ConfigModel, Count, Finite, NonNegative, Positive
from table_io.errors import InputError

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
    resonance: x holds all orbits of G4 at one pair of gains, about 0.7 and 0.005 s, up to 75 ms.
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
    vector[0], vector[1::2], vector[2::2] = (
        coefficients[0].real,
        coefficients[1:].real,
        coefficients[1:].imag,
    )
    return vector


def unpack_harmonics(vector: Float1D) -> Complex1D:
    """Return a real vector of harmonics, (2 H + 1,), as complex U_0 .. U_H, (H + 1,)."""
    return np.concatenate([vector[:1], vector[1::2] + 1j * vector[2::2]])
