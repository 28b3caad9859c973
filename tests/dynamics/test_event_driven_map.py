"""The event-driven period map beside the closed form, scipy's integrator and differences."""

import math
from dataclasses import replace

import numpy as np
import pytest

from tests.input_errors import raises_input_error
from tests.model.cases import FORCES, everything, having
from tests.model.independent_solution import Witness
from tests.model.reference import AG, snm
from twin.dynamics.continuation import continue_branch
from twin.dynamics.event_driven_map import EventDrivenMap
from twin.dynamics.orbits import settle_to_orbit
from twin.dynamics.period_map import ClosedFormPeriodMap, make_period_map
from twin.laws.library import find_effect
from twin.model.model import Model

START = {"u": 5e-4, "v": 0.05}
PERIODIC_FORCES = [effect for effect in FORCES if effect.id != "gap_drift"]


def start_of(period_map) -> np.ndarray:
    x = np.zeros(period_map.size)
    x[:2] = START["u"], START["v"]
    return x


def solve_orbit(period_map, frequency_hz, x, acceleration=AG, periods=1):
    """The periodic orbit that Newton's method finds from x, and its map."""
    for _ in range(20):
        result = period_map.evaluate(x, frequency_hz, acceleration, periods)
        error = result.end - x
        if np.abs(error / period_map.scales).max() < 1e-13:
            return x, result
        x = x - np.linalg.solve(result.jacobian - np.eye(period_map.size), error)
    raise AssertionError("Newton's method has not converged")


def multipliers(result) -> np.ndarray:
    return np.sort_complex(np.linalg.eigvals(result.jacobian))


BASES = {
    "snm": snm(),
    "unequal gaps": snm(gap_r=0.001, gap_l=0.004),
    "negative gaps": snm(-0.001),
    "one side": snm(gap_l=math.inf),
    "no memory": snm(bumper_damping_r=0.0, bumper_damping_l=0.0),
    "one memory": snm(bumper_damping_l=0.0, bumper_stiffness_l=2e5),
    "no gap": snm(0.0),
}


@pytest.mark.parametrize("base", BASES.values(), ids=BASES.keys())
@pytest.mark.parametrize("frequency_hz", [1.9, 3.4, 5.5])
def test_it_is_the_closed_form(base, frequency_hz):
    sampled, closed = EventDrivenMap(Model(base)), ClosedFormPeriodMap(Model(base))
    assert sampled.size == closed.size
    x = start_of(closed)
    for periods in (1, 2):
        want = closed.evaluate(x, frequency_hz, AG, periods)
        result = sampled.evaluate(x, frequency_hz, AG, periods)
        assert np.abs((result.end - want.end) / closed.scales).max() < 1e-9  # m, of motions of 5 mm
        scale = np.abs(want.jacobian).max()
        assert np.abs(result.jacobian - want.jacobian).max() < 1e-5 * scale
        for j in range(2):
            scale = np.abs(want.d_parameters[:, j]).max()
            assert np.abs(result.d_parameters - want.d_parameters[:, :2])[:, j].max() < 1e-5 * scale
        assert result.contacts == want.contacts


@pytest.mark.parametrize(
    ("frequency_hz", "u"), [(3.4, 5e-3), (3.4, 0.0), (2.0, 3e-3), (4.5, 1e-3), (0.9, 1e-3)]
)
def test_orbits_agree_to_1e_6_and_multipliers_to_1e_4(frequency_hz, u):
    model = Model(snm())
    sampled, closed = EventDrivenMap(model), make_period_map(model)
    x = np.zeros(4)
    x[0] = u
    x = closed.iterate(x, frequency_hz, AG, 150)
    x, want = solve_orbit(closed, frequency_hz, x)
    y, result = solve_orbit(sampled, frequency_hz, x * (1 + 1e-4))
    amplitude = sampled.find_extremes(y, frequency_hz, AG)
    exact = closed.find_extremes(x, frequency_hz, AG)
    assert np.abs(amplitude[:2] / exact[:2] - 1).max() < 1e-6
    assert amplitude[6:].tolist() == exact[6:].tolist()
    assert np.abs(amplitude[2:6] - exact[2:6]).max() < 1e-3 * np.abs(exact[2:6]).max()
    assert np.abs(multipliers(result) - multipliers(want)).max() < 1e-4


def test_the_unstable_orbit_of_g4_is_found_by_differences():
    period_map = EventDrivenMap(Model(snm()))
    high = settle_to_orbit(make_period_map(Model(snm())), 3.4, AG, np.array([5e-3, 0, 0, 0]))
    assert high is not None
    branch = continue_branch(high, "frequency", (2.5, 4.5))
    (unstable,) = [orbit for orbit in branch.orbits_at(3.4) if not orbit.stable]
    x, result = solve_orbit(period_map, 3.4, unstable.x * (1 + 1e-5))
    assert period_map.find_extremes(x, 3.4, AG)[0] == pytest.approx(3.297e-3, abs=1e-6)
    assert multipliers(result)[-2:].real == pytest.approx([0.138, 3.115], abs=1e-3)


@pytest.mark.parametrize("effect", PERIODIC_FORCES, ids=lambda effect: effect.id)
@pytest.mark.parametrize("frequency_hz", [1.8, 3.4])
def test_every_effect_has_orbits_that_perturbed_motion_confirms(effect, frequency_hz):
    """Multipliers from motions that start next to the orbit, at steps that Newton did not use."""
    period_map = make_period_map(having(effect))
    x = period_map.iterate(start_of(period_map), frequency_hz, AG, 120)
    x, result = solve_orbit(period_map, frequency_hz, x)
    free = np.abs(result.jacobian).max(axis=0) > 0
    jacobian = np.zeros_like(result.jacobian)
    steps = 1e-8 * np.maximum(period_map.scales, 1e-3)
    for j in np.flatnonzero(free):
        y = x.copy()
        y[j] -= math.copysign(steps[j], x[j])  # towards rest: a face at rest cannot stretch
        jacobian[:, j] = (period_map.iterate(y, frequency_hz, AG, 1) - x) / (y[j] - x[j])
    in_contact = result.contacts[0]
    if not in_contact:
        own = np.sort_complex(np.linalg.eigvals(jacobian))
        assert np.abs(own - multipliers(result)).max() < 1e-3
    assert np.abs(multipliers(result)).max() < 1


@pytest.mark.parametrize("effect", PERIODIC_FORCES, ids=lambda effect: effect.id)
def test_every_effect_agrees_with_an_independent_integrator(effect):
    model, frequency_hz = having(effect), 2.6
    period_map = make_period_map(model)
    x = start_of(period_map)
    witness = Witness(model, lambda t: AG * math.sin(2 * math.pi * frequency_hz * t))
    times = np.linspace(0, 2 / frequency_hz, 401)
    want = witness.run([START["u"], START["v"], 0, 0, 0, 0, 0, 0], times)
    motion = period_map.sample_motion(x, frequency_hz, AG, 2, 400)
    end = period_map.iterate(x, frequency_hz, AG, 2)
    amplitude, speed = np.abs(want[0]).max(), np.abs(want[1]).max()
    assert np.abs(motion[0] - want[0, 1:]).max() < 2e-6 * amplitude
    assert abs(end[0] - want[0, -1]) < 1e-6 * amplitude
    assert abs(end[1] - want[1, -1]) < 1e-5 * speed
    extremes = period_map.find_extremes(x, frequency_hz, AG, 2)
    assert extremes[:2] == pytest.approx([want[0].max(), want[0].min()], abs=3e-4 * amplitude)


def test_table_tilt_is_a_level_that_falls_with_frequency():
    """g tilt x on the mass is the same as another level: an independent closed form."""
    tilt, frequency_hz = 0.8, 1.7
    period_map = make_period_map(Model(snm()).with_effect("table_tilt", tilt=tilt))
    w = 2 * math.pi * frequency_hz
    factor = 1 - 9.80665 * tilt / w**2
    closed = make_period_map(Model(snm()))
    x = np.zeros(4)
    want = closed.evaluate(x, frequency_hz, AG * factor, 3)
    result = period_map.evaluate(x, frequency_hz, AG, 3)
    assert np.abs((result.end - want.end) / closed.scales).max() < 1e-9
    d_level = want.d_parameters[:, 1] * factor
    d_frequency = want.d_parameters[:, 0] + want.d_parameters[:, 1] * (
        2 * AG * (1 - factor) / frequency_hz
    )
    assert np.abs(result.d_parameters[:, 1] - d_level).max() < 1e-5 * np.abs(d_level).max()
    assert np.abs(result.d_parameters[:, 0] - d_frequency).max() < 1e-5 * np.abs(d_frequency).max()
    motion = period_map.sample_motion(x, frequency_hz, AG, 1, 64)
    exact = closed.sample_motion(x, frequency_hz, AG * factor, 1, 64)
    phase = 2 * math.pi * np.arange(1, 65) / 64
    total = exact[2] + AG * (1 - factor) * np.sin(phase)
    assert np.abs(motion[2] - total).max() < 1e-5 * np.abs(total).max()


def test_a_mass_that_friction_holds_at_the_section_has_zero_multipliers_for_speed():
    """It sticks over phase 0: u' there is zero whatever it was before."""
    base = replace(snm(), damping=0.0)
    period_map = make_period_map(Model(base).with_effect("coulomb_friction", fc=250.0))
    x = period_map.iterate(start_of(period_map), 1.05, AG, 60)
    assert x[1] == 0.0
    x, result = solve_orbit(period_map, 1.05, x)
    assert result.jacobian[1].tolist() == [0.0] * 4
    assert np.abs(result.jacobian[:, 1]).max() < 1e-3
    moved = x + np.array([1e-6, 0.0, 0.0, 0.0])
    slope = (period_map.iterate(moved, 1.05, AG, 1)[0] - x[0]) / 1e-6
    assert result.jacobian[0, 0] == pytest.approx(slope, abs=1e-4)


def test_a_mass_that_never_slips_stays():
    period_map = make_period_map(Model(snm()).with_effect("coulomb_friction", fc=400.0))
    x = np.array([1e-4, 0.0, 0.0, 0.0])
    result = period_map.evaluate(x, 2.0, AG)
    assert result.end.tolist() == x.tolist()
    assert result.jacobian[0, 0] == pytest.approx(1.0)
    assert np.abs(result.d_parameters).max() == 0.0


def test_a_model_with_every_effect_has_all_coordinates():
    model = everything().with_effect("gap_drift", rate=0.0)
    period_map = make_period_map(model)
    assert period_map.size == 10  # u, v, two faces, f, two b_j, z, two of the appendage
    x = period_map.iterate(start_of(period_map), 3.0, AG, 100)
    x, result = solve_orbit(period_map, 3.0, x)
    assert np.abs(multipliers(result)).max() < 1


def test_drifting_gaps_are_refused():
    drifting = find_effect("gap_drift")
    with raises_input_error(where="effect 'gap_drift'", remedy="remove"):
        make_period_map(having(drifting))


def test_parameters_are_those_of_the_model():
    period_map = make_period_map(Model(snm()).with_effect("coulomb_friction", fc=50.0))
    assert period_map.parameter("coulomb_friction.fc") == 50.0
    changed = period_map.with_parameter("coulomb_friction.fc", 60.0).with_parameter("gap", 0.01)
    assert changed.parameter("coulomb_friction.fc") == 60.0
    assert changed.parameter("gap_r") == pytest.approx(0.005)


def test_it_starts_at_the_static_equilibrium():
    model = Model(snm(-0.002, bumper_stiffness_r=2e5)).with_effect("bumper_hardening", k2=1e8)
    period_map = make_period_map(model)
    x = period_map.rest()
    assert x[0] > 0
    assert np.abs(period_map.iterate(x, 2.0, 0.0, 5) - x).max() < 1e-12
