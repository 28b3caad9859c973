"""Continuation: Newton steps on a linear specimen with feedback, and through a fold."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from table_io.adaptive.continuation import (
    MeasuredOrbit,
    OrbitMeasurement,
    correct_target,
    find_feedback_motion,
    fundamental,
    is_on_branch,
    measure_phase,
    plan_target,
    planned_reference,
    rotate_harmonics,
    table_harmonics,
)
from table_io.config.excitation.continuation import OrbitPlan, PlannedOrbit

A, MASS, DAMPING, F_HZ = 0.49, 550.0, 1100.0, 3.4
FOLD_HZ, FOLD_M, CURVATURE = 4.0, 5e-3, 4.0e4  # f = FOLD_HZ - CURVATURE (|U_1| - FOLD_M)^2


def make_orbit(frequency_hz: float, u1: complex, jacobian: np.ndarray) -> PlannedOrbit:
    return PlannedOrbit(
        frequency_hz=frequency_hz,
        acceleration_m_s2=A,
        stable=False,
        multiplier=2.0,
        u_m=((0.0, 0.0), (u1.real, u1.imag)),
        jacobian=tuple(tuple(row) for row in jacobian.tolist()),
        gain=0.7,
        rate_gain_s=0.005,
    )


def linear_response(frequency_hz: float, stiffness: float) -> complex:
    """U_1 of M u'' + C u' + K u = -M a sin(phi) over the table's displacement."""
    w = 2 * math.pi * frequency_hz
    return MASS * w**2 / (stiffness - MASS * w**2 + 1j * w * DAMPING)


def real_matrix(ratio: complex) -> np.ndarray:
    matrix = np.zeros((3, 3))
    matrix[1:, 1:] = [[ratio.real, -ratio.imag], [ratio.imag, ratio.real]]
    return matrix


def hold(
    reference: np.ndarray, free: np.ndarray, jacobian: np.ndarray, feedback: complex
) -> OrbitMeasurement:
    """Motion x = free + J c with the feedback c = F (x - reference), an ideal table."""
    law = real_matrix(feedback)
    total = jacobian + np.eye(3)
    x = np.linalg.solve(np.eye(3) - total @ law, free - total @ law @ reference)
    c = law @ (x - reference)
    return OrbitMeasurement(x, x, c, np.ones(2, dtype=np.complex128))


def make_plan(*orbits: PlannedOrbit, **keywords: Any) -> OrbitPlan:
    return OrbitPlan(harmonics=1, latency_s=0.046, points=orbits, **keywords)


def plan_linear_orbit(
    u_factor: float = 1.0, jacobian_factor: float = 1.0
) -> tuple[OrbitPlan, np.ndarray, np.ndarray, np.ndarray]:
    """(plan, Jacobian, harmonics of the table, of u) of an orbit of a linear specimen at F_HZ.

    u and Jacobian of the plan are wrong by the factors.
    """
    jacobian, table = real_matrix(linear_response(F_HZ, 200e3)), table_harmonics(F_HZ, A, 1)
    u = jacobian @ table
    orbit = make_orbit(F_HZ, u_factor * complex(u[1], u[2]), jacobian_factor * jacobian)
    return make_plan(orbit), jacobian, table, u


def test_step_finds_the_orbit_of_a_linear_specimen() -> None:
    plan, jacobian, table, u = plan_linear_orbit(1.1)
    target = plan_target(plan, 0, ())
    measured = hold(target.reference, u + table, jacobian, 0.5 - 0.3j)
    assert measured.feedback_m > 1e-5
    moved = find_feedback_motion(plan.points[0], measured) + measured.feedback
    np.testing.assert_allclose(measured.x - moved, u + table, atol=1e-12)
    target = correct_target(plan, target, measured)
    np.testing.assert_allclose(target.reference, u + table, atol=1e-12)
    assert target.frequency_hz == F_HZ


def test_step_is_for_the_level_that_the_table_will_have() -> None:
    """The table was 3 % too low while the motion was held."""
    plan, jacobian, table, u = plan_linear_orbit()
    target = plan_target(plan, 0, ())
    measured = hold(target.reference, 0.97 * (u + table), jacobian, 0.5 - 0.3j)
    target = correct_target(plan, target, measured, 0.03 * table)
    np.testing.assert_allclose(target.reference, u + table, atol=1e-12)
    assert target.frequency_hz == F_HZ


def test_broyden_corrects_a_wrong_jacobian() -> None:
    plan, jacobian, table, u = plan_linear_orbit(1.1, 1.3)
    target, sizes = plan_target(plan, 0, ()), []
    for _ in range(6):
        measured = hold(target.reference, u + table, jacobian, 0.5 - 0.3j)
        sizes.append(measured.feedback_m)
        target = correct_target(plan, target, measured)
    assert sizes[-1] < 0.02 * sizes[0]
    assert np.abs(target.reference - u - table).max() < 0.02 * fundamental(u)


def test_broyden_learns_no_derivative_from_noise() -> None:
    """Changes of 5 um tell the derivative where the feedback is known to 0.1 um, not to 10 um."""
    plan, jacobian, table, u = plan_linear_orbit()
    target, shift = plan_target(plan, 0, ()), np.array([0.0, 3e-6, 4e-6])
    first = hold(target.reference, u + table + shift, jacobian, 0.5 - 0.3j)
    errors = []
    for noise_m in (1e-7, 1e-5):
        second = correct_target(plan, target, first)
        moved = replace(first, x=first.x + np.array([0.0, 2e-5, -2e-5]), noise_m=noise_m)
        slopes = correct_target(plan, second, moved).slopes
        errors.append(float(np.abs(slopes - target.slopes).max()))
    assert errors[0] > 0.3
    assert errors[1] < 0.1


def test_phase_resonance_of_a_linear_specimen_is_found_by_the_measured_phase() -> None:
    resonance_hz, start_hz = math.sqrt(200e3 / MASS) / (2 * math.pi), 3.1
    jacobian = real_matrix(linear_response(start_hz, 200e3))
    planned = jacobian @ table_harmonics(start_hz, A, 1)
    orbit = make_orbit(start_hz, complex(planned[1], planned[2]), jacobian)
    plan = make_plan(orbit, condition="phase")
    target = plan_target(plan, 0, ())
    for _ in range(8):
        response = real_matrix(linear_response(target.frequency_hz, 200e3))
        table = table_harmonics(target.frequency_hz, A, 1)
        measured = hold(target.reference, response @ table + table, response, 0.5 - 0.3j)
        target = correct_target(plan, target, measured)
    assert target.frequency_hz == pytest.approx(resonance_hz, rel=1e-4)
    assert measure_phase(measured.x - table) == pytest.approx(90.0, abs=0.1)
    assert measured.feedback_m < 1e-3 * fundamental(table)


def branch_orbit(amplitude_m: float) -> PlannedOrbit:
    """An orbit of a branch with a fold: J is singular there along the amplitude."""
    f = FOLD_HZ - CURVATURE * (amplitude_m - FOLD_M) ** 2
    # 2 U / f per Hz acts as a table displacement: J follows from dA/df = 1 / (df/dA).
    slope_m_hz = -1.0 / (2.0 * CURVATURE * (amplitude_m - FOLD_M))
    gain = slope_m_hz * f / (2.0 * amplitude_m)
    jacobian = np.zeros((3, 3))
    jacobian[1, 1], jacobian[2, 2] = 1.0, gain
    return make_orbit(f, 1j * amplitude_m, jacobian)


def test_orbits_are_found_past_a_fold_that_lies_lower_than_planned() -> None:
    amplitudes = np.array([4.6e-3, 4.75e-3, 4.9e-3, 5.06e-3, 5.2e-3])
    plan = make_plan(*map(branch_orbit, amplitudes))
    shift_hz = -0.05
    for position in (2, 3):
        orbit = plan.points[position]
        target = plan_target(plan, position, ())
        for _ in range(8):
            # The true branch is the planned one, shift_hz lower, quadratic through its fold.
            table = table_harmonics(target.frequency_hz, A, 1)
            u = target.reference - table
            needed_hz = orbit.frequency_hz + shift_hz - target.frequency_hz
            error = 2.0 * u[2] / target.frequency_hz * needed_hz
            feedback = np.array([0.0, u[1] * 0.5, -error])
            x = target.reference + feedback / 0.7
            measured = OrbitMeasurement(x - table, x, feedback, np.ones(2, dtype=np.complex128))
            target = correct_target(plan, target, measured)
        table = table_harmonics(target.frequency_hz, A, 1)
        assert fundamental(target.reference - table) == pytest.approx(amplitudes[position], 5e-3)
        assert target.frequency_hz == pytest.approx(orbit.frequency_hz + shift_hz, abs=2e-3)


def test_next_target_continues_what_the_last_orbits_differed_by_across_the_branch() -> None:
    plan = make_plan(*map(branch_orbit, (4.0e-3, 4.2e-3, 4.4e-3)))
    along = planned_reference(plan.points[2]) - planned_reference(plan.points[0])
    along_hz = plan.points[2].frequency_hz - plan.points[0].frequency_hz
    across = np.array([1e-5, 2e-5, 0.0])
    measured = (
        MeasuredOrbit(0, planned_reference(plan.points[0]) + across, plan.points[0].frequency_hz),
        MeasuredOrbit(
            1,
            planned_reference(plan.points[1]) + 2 * across + 0.3 * along,
            plan.points[1].frequency_hz + 0.3 * along_hz,
        ),
    )
    target = plan_target(plan, 2, measured)
    np.testing.assert_allclose(
        target.reference - planned_reference(plan.points[2]), 3 * across, atol=1e-12
    )
    assert target.frequency_hz == pytest.approx(plan.points[2].frequency_hz)


def test_motion_on_another_branch_is_recognized() -> None:
    plan = make_plan(branch_orbit(4.5e-3))
    target = plan_target(plan, 0, ())
    u = plan.points[0].harmonics_m
    for factor, expected in ((1.02, True), (1.4, False), (0.5, False)):
        measured = OrbitMeasurement(
            factor * u, target.reference, np.zeros(3), np.ones(2, dtype=np.complex128)
        )
        assert is_on_branch(plan, target, measured) is expected


def test_rotation_shifts_the_phase_of_every_harmonic() -> None:
    vector = np.array([1.0, 2.0, 0.0, 0.0, 3.0])
    np.testing.assert_allclose(
        rotate_harmonics(vector, math.pi / 2), [1.0, 0.0, 2.0, 0.0, -3.0], atol=1e-12
    )
