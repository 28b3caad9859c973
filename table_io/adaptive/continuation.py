"""Continuation of measured orbits: references, corrected until the feedback vanishes.

All harmonics are real vectors (`PlannedOrbit`) at the phase of the table's acceleration, in m. An
orbit is unknown in its reference r (harmonics of x) and in its frequency f. Held with the feedback
c, the harmonics x of the motion show how far r is off: without feedback the motion would be
x - J c, with J the derivative of x with respect to the command. Newton's residual is therefore

    rho(r, f) = x - J c - r,    d rho / d(r, f) = [-1, dx/df] at first, by Broyden afterwards

One more equation selects the point: the corrections stay across the direction of the branch in the
space of U_1 and f (pseudo-arclength), which passes through folds and resonances. On a backbone it
is phase resonance instead: u leads the table's acceleration by 90 degrees, Im U_1 = 0.
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from table_io.block import Float1D, Float2D
from table_io.config.excitation.continuation import (
    OrbitPlan,
    PlannedOrbit,
    pack_harmonics,
    unpack_harmonics,
)

MAX_FREQUENCY_CHANGE = 0.02  # of the frequency, in one update
FREQUENCY_WEIGHT = 3.0  # of a relative change of frequency against one of the amplitude
MAX_SENSITIVITY = 20.0  # of u to the table's motion, off a fold
MAX_REFERENCE_CHANGE = 0.15  # of the amplitude of u, in one update
# Change of the reference that tells as much of the derivative as of the noise: in m where there is
# none, and over the standard error of the feedback.
BROYDEN_CHANGE_M = 5e-6
BROYDEN_NOISE = 5.0
MAX_AMPLITUDE_ERROR = 0.05  # of an accepted orbit, measured against the sought amplitude


@dataclass(frozen=True, slots=True, eq=False)
class OrbitMeasurement:
    """Harmonics over whole cycles in m, at the phase of the table's acceleration.

    `u`, `x` and `feedback` (of the command) are real vectors, `response` is the table's motion over
    its command at harmonics 0, 1, ..., complex. `noise_m` is the standard error of `feedback_m`.
    """

    u: Float1D
    x: Float1D
    feedback: Float1D
    response: Float1D
    noise_m: float = 0.0

    @property
    def feedback_m(self) -> float:
        """Root of the sum of squares of the amplitudes of the feedback."""
        return float(np.linalg.norm(self.feedback))

    @property
    def amplitude_m(self) -> float:
        """Amplitude of the fundamental of u."""
        return fundamental(self.u)


@dataclass(frozen=True, eq=False)
class OrbitTarget:
    """Orbit sought at a planned point: reference (harmonics of x) and frequency.

    `slopes` is the derivative of the residual with respect to the reference and to the frequency
    over `scale_hz_m`, both in m, (2 H + 1, 2 H + 2). Corrections stay in the plane through
    `origin`, where the target began, across the `direction` of the branch, (3,) each. `last_change`
    is that of reference and frequency, `last_shift` what the table's change was to add to x, in m.
    """

    position: int
    reference: Float1D
    frequency_hz: float
    slopes: Float2D = field(repr=False)
    scale_hz_m: float
    direction: Float1D = field(default_factory=lambda: np.zeros(3))
    origin: Float1D = field(default_factory=lambda: np.zeros(3))
    update: int = 0
    last_change: Float1D | None = None
    last_shift: Float1D | None = None
    last_residual: Float1D | None = None


@dataclass(frozen=True, eq=False)
class MeasuredOrbit:
    """Accepted orbit of a planned point."""

    position: int
    reference: Float1D
    frequency_hz: float


def fundamental(vector: Float1D) -> float:
    """Return the amplitude of the fundamental of a real vector of harmonics."""
    return float(math.hypot(vector[1], vector[2]))


def measure_phase(vector: Float1D) -> float:
    """Return the phase in degrees by which the fundamental leads the table's acceleration."""
    return math.degrees(math.atan2(vector[2], vector[1])) + 90.0


def rotate_harmonics(vector: Float1D, angle: float) -> Float1D:
    """Return the harmonics at a phase that lags by `angle` rad: X_k exp(i k angle)."""
    coefficients = unpack_harmonics(vector)
    return pack_harmonics(coefficients * np.exp(1j * angle * np.arange(coefficients.size)))


def table_harmonics(frequency_hz: float, acceleration_m_s2: float, harmonics: int) -> Float1D:
    """Return the harmonics in m of a table whose acceleration is a sin(phi)."""
    vector = np.zeros(2 * harmonics + 1)
    vector[2] = acceleration_m_s2 / (2 * math.pi * frequency_hz) ** 2
    return vector


def planned_reference(orbit: PlannedOrbit) -> Float1D:
    """Return the harmonics in m of the mass's displacement on a planned orbit."""
    u = orbit.harmonics_m
    return u + table_harmonics(orbit.frequency_hz, orbit.acceleration_m_s2, u.size // 2)


def plan_target(plan: OrbitPlan, position: int, measured: tuple[MeasuredOrbit, ...]) -> OrbitTarget:
    """Return the target of a planned point, shifted by what the last measured orbits differ by.

    The difference from the plan is continued linearly along the branch.
    """
    orbit = plan.points[position]
    reference, frequency_hz = planned_reference(orbit), orbit.frequency_hz
    differences = [
        (earlier.position, _difference_from_plan(plan, earlier)) for earlier in measured[-2:]
    ]
    if differences:
        last, shift = differences[-1]
        if len(differences) == 2 and position > last > differences[0][0]:
            first, before = differences[0]
            if position - last <= last - first:
                shift = shift + (shift - before) * (position - last) / (last - first)
        reference, frequency_hz = reference + shift[:-1], frequency_hz + float(shift[-1])
    slope = frequency_slope(orbit)
    scale = float(np.linalg.norm(slope))
    slopes = np.column_stack([-np.eye(reference.size), slope / scale])
    target = OrbitTarget(position, reference, frequency_hz, slopes, 1.0 / scale)
    direction = find_direction(plan, target, measured[-1] if measured else None)
    origin = _relative_position(orbit, reference, frequency_hz)
    return replace(target, direction=direction, origin=origin)


def frequency_slope(orbit: PlannedOrbit) -> Float1D:
    """Return the derivative of the harmonics of x with respect to the frequency, in m/Hz.

    At a given motion u a higher frequency needs more inertia force, k^2 w^2 m U_k, as if the table
    moved by 2 U_k / f per Hz. So it follows from the Jacobian, and both grow alike at a fold. The
    force of damping, a few percent of this, is left to Broyden's correction.
    """
    u, f = orbit.harmonics_m, orbit.frequency_hz
    table = table_harmonics(f, orbit.acceleration_m_s2, u.size // 2)
    slope: Float1D = 2.0 / f * (_bounded_jacobian(orbit) @ u - table)
    return slope


def _difference_from_plan(plan: OrbitPlan, measured: MeasuredOrbit) -> Float1D:
    """Return reference and frequency minus those planned, across the planned branch, (2 H + 2,).

    A difference along the branch is none: carried on, it would add up from point to point. On a
    backbone the level fixes the place, so it counts.
    """
    orbit = plan.points[measured.position]
    reference = measured.reference - planned_reference(orbit)
    frequency_hz = measured.frequency_hz - orbit.frequency_hz
    if plan.condition == "phase":
        return np.append(reference, frequency_hz)
    tangent, tangent_hz = _planned_change(plan, measured.position)
    along = _relative_position(orbit, tangent, tangent_hz)
    square = float(along @ along)
    if square:
        share = float(along @ _relative_position(orbit, reference, frequency_hz)) / square
        reference, frequency_hz = reference - share * tangent, frequency_hz - share * tangent_hz
    return np.append(reference, frequency_hz)


def _planned_change(plan: OrbitPlan, position: int) -> tuple[Float1D, float]:
    """Return the change of (reference, frequency) from the point before to the point after."""
    points = plan.points
    before, after = points[max(position - 1, 0)], points[min(position + 1, len(points) - 1)]
    reference = planned_reference(after) - planned_reference(before)
    return reference, after.frequency_hz - before.frequency_hz


def find_direction(plan: OrbitPlan, target: OrbitTarget, measured: MeasuredOrbit | None) -> Float1D:
    """Return the direction of the branch at a target: U_1 (Re, Im) and frequency, relative, (3,).

    From the last measured orbit to the target, or by the plan if there is none.
    """
    if measured is not None:
        reference = target.reference - measured.reference
        frequency_hz = target.frequency_hz - measured.frequency_hz
    else:
        reference, frequency_hz = _planned_change(plan, target.position)
    direction = _relative_position(plan.points[target.position], reference, frequency_hz)
    size = float(np.linalg.norm(direction))
    return direction / size if size else np.array([0.0, 0.0, 1.0])


def _relative_position(orbit: PlannedOrbit, reference: Float1D, frequency_hz: float) -> Float1D:
    """Return (Re, Im of the fundamental over that of u, weighted relative frequency), (3,)."""
    size = fundamental(orbit.harmonics_m)
    frequency = FREQUENCY_WEIGHT * frequency_hz / orbit.frequency_hz
    return np.array([reference[1] / size, reference[2] / size, frequency])


def correct_target(
    plan: OrbitPlan,
    target: OrbitTarget,
    measured: OrbitMeasurement,
    table_change: Float1D | float = 0.0,
) -> OrbitTarget:
    """Return the target after one Newton step with Broyden's derivative.

    `table_change` are the harmonics of x in m by which the command will change the table.
    """
    orbit = plan.points[target.position]
    shift = _move_mass(orbit, np.zeros(target.reference.size) + table_change)
    residual = measured.x - _move_mass(orbit, _move_table(measured)) - target.reference
    slopes = _correct_slopes(target, residual, measured.noise_m)
    residual = residual + shift
    condition, goal = (
        _phase_condition(orbit, target)
        if plan.condition == "phase"
        else _arclength_condition(orbit, target)
    )
    matrix = np.vstack([slopes, condition])
    change = np.linalg.solve(matrix, np.append(-residual, goal))
    shares = (
        np.linalg.norm(change[:-1]) / (MAX_REFERENCE_CHANGE * fundamental(target.reference)),
        abs(change[-1]) * target.scale_hz_m / (MAX_FREQUENCY_CHANGE * target.frequency_hz),
    )
    change /= max(1.0, *shares)
    return replace(
        target,
        reference=target.reference + change[:-1],
        frequency_hz=target.frequency_hz + float(change[-1] * target.scale_hz_m),
        slopes=slopes,
        update=target.update + 1,
        last_change=change,
        last_shift=shift,
        last_residual=residual,
    )


def _correct_slopes(target: OrbitTarget, residual: Float1D, noise_m: float) -> Float2D:
    """Return the derivative of the residual by Broyden's rule, (2 H + 1, 2 H + 2).

    `residual` is that of the motion as it was measured. Reference, frequency and table changed
    together; what the last change did not foresee is shared among them and the noise.
    """
    change, shift = target.last_change, target.last_shift
    if change is None or shift is None or target.last_residual is None:
        return target.slopes
    error = residual - target.last_residual - target.slopes @ change
    spread_m = max(BROYDEN_CHANGE_M, BROYDEN_NOISE * noise_m)
    slopes: Float2D = target.slopes + np.outer(error, change) / (
        change @ change + shift @ shift + spread_m**2
    )
    return slopes


def _arclength_condition(orbit: PlannedOrbit, target: OrbitTarget) -> tuple[Float1D, float]:
    """Return (row, right side) of the equation by which a target stays across the branch."""
    here = _relative_position(orbit, target.reference, target.frequency_hz)
    goal = float(target.direction @ (target.origin - here))
    condition = np.zeros(target.reference.size + 1)
    condition[1:3] = target.direction[:2] / fundamental(orbit.harmonics_m)
    condition[-1] = target.direction[2] * FREQUENCY_WEIGHT * target.scale_hz_m / orbit.frequency_hz
    return condition, goal


def _phase_condition(orbit: PlannedOrbit, target: OrbitTarget) -> tuple[Float1D, float]:
    """Return (row, right side) of Im U_1 = 0, over |U_1|: that of x less that of the table."""
    size = fundamental(orbit.harmonics_m)
    table_m = table_harmonics(target.frequency_hz, orbit.acceleration_m_s2, 1)[2]
    condition = np.zeros(target.reference.size + 1)
    condition[2] = 1.0 / size
    condition[-1] = 2.0 * table_m / target.frequency_hz * target.scale_hz_m / size
    return condition, -float(target.reference[2] - table_m) / size


def _bounded_jacobian(orbit: PlannedOrbit) -> Float2D:
    """Return the planned Jacobian with singular values up to MAX_SENSITIVITY, (2 H + 1,) squared.

    It is singular at the fold of the plan, where that of the specimen need not be. The bound acts
    on the feedback and on the frequency alike, so the frequency sought at a fold is the same.
    """
    left, values, right = np.linalg.svd(orbit.jacobian_matrix)
    bounded: Float2D = (left * np.minimum(values, MAX_SENSITIVITY)) @ right
    return bounded


def find_feedback_motion(orbit: PlannedOrbit, measured: OrbitMeasurement) -> Float1D:
    """Return the harmonics of u in m by which the feedback moves the mass, (2 H + 1,)."""
    return _bounded_jacobian(orbit) @ _move_table(measured)


def _move_table(measured: OrbitMeasurement) -> Float1D:
    """Return the harmonics in m by which the feedback moves the table."""
    return pack_harmonics(unpack_harmonics(measured.feedback) * measured.response)


def _move_mass(orbit: PlannedOrbit, table: Float1D) -> Float1D:
    """Return the harmonics in m by which harmonics of the table change those of x."""
    return _bounded_jacobian(orbit) @ table + table


def is_on_branch(plan: OrbitPlan, target: OrbitTarget, measured: OrbitMeasurement) -> bool:
    """Return True if the motion has the amplitude of the sought orbit."""
    table = table_harmonics(
        target.frequency_hz,
        plan.points[target.position].acceleration_m_s2,
        target.reference.size // 2,
    )
    sought = fundamental(target.reference - table)
    return abs(measured.amplitude_m / sought - 1.0) <= MAX_AMPLITUDE_ERROR
