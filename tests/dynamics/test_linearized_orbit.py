"""Linearized motion about orbits, beside the map's multipliers and orbits solved again."""

import math

import numpy as np
import pytest

from table_io.config.excitation.continuation import pack_harmonics
from tests.model.reference import AG, snm
from twin.dynamics.continuation import continue_branch
from twin.dynamics.event_driven_map import make_period_map
from twin.dynamics.linearized_orbit import LinearizedOrbit, find_harmonics
from twin.dynamics.orbits import settle_to_orbit
from twin.model.model import Model
from twin.model.prepare import prepare_solver
from twin.model.solver import OUTPUT_COUNT

FREQUENCY_HZ = 3.4
PERIOD_SAMPLES = 1000  # of a period with a perturbed drive


def find_unstable(model):
    """The unstable orbit between the two stable ones of G4 at 3.4 Hz."""
    start = settle_to_orbit(make_period_map(model, 4.6, AG))
    assert start is not None
    branch = continue_branch(start, "frequency", (2.7, 4.7))
    return next(orbit for orbit in branch.orbits_at(FREQUENCY_HZ) if not orbit.stable)


@pytest.fixture(scope="module", params=["closed form", "event-driven"])
def orbit(request):
    model = Model(snm())
    if request.param == "event-driven":
        model = model.with_effect("cubic_stiffness", k3=2e7)
    return find_unstable(model)


def solve_perturbed(orbit, added):
    """Harmonics of u on the orbit solved again with `added` m/s2, (PERIOD_SAMPLES,)."""
    phase = 2 * math.pi * np.arange(1, PERIOD_SAMPLES + 1) / PERIOD_SAMPLES
    base = orbit.acceleration_m_s2 * np.sin(phase) + added
    solver = prepare_solver(orbit.period_map.model, PERIOD_SAMPLES * orbit.frequency_hz)

    def advance(start):
        state = orbit.period_map.to_state(np.append(start, orbit.x[2:]))
        state[6] = base[-1]
        out = np.empty((OUTPUT_COUNT, PERIOD_SAMPLES))
        solver.advance(state, base, np.zeros(PERIOD_SAMPLES), out)
        return state[:2], out[0]

    start = orbit.x[:2].copy()
    for _ in range(8):
        end, motion = advance(start)
        columns = [
            (advance(start + step)[0] - advance(start - step)[0]) / (2 * step.sum())
            for step in np.diag([1e-8, 2e-7])
        ]
        start = start - np.linalg.solve(np.array(columns).T - np.eye(2), end - start)
    transform = 2 * np.fft.rfft(np.roll(motion, 1)) / PERIOD_SAMPLES
    transform[0] /= 2
    return pack_harmonics(transform[:4])


def test_parts_multiply_to_the_map_of_a_period(orbit):
    parts = LinearizedOrbit(orbit, 60).linearize_parts(200.0)
    product = np.linalg.multi_dot([part.transition for part in parts[::-1]])
    largest = np.sort(np.abs(np.linalg.eigvals(product)))[-2:]
    assert largest == pytest.approx(np.sort(np.abs(orbit.multipliers[:2])), rel=2e-3)
    assert largest[-1] > 3


def test_table_jacobian_equals_orbits_solved_again(orbit):
    jacobian = LinearizedOrbit(orbit, 1).table_jacobian(3)
    w, step_m = 2 * math.pi * orbit.frequency_hz, 1e-8
    phase = 2 * math.pi * np.arange(1, PERIOD_SAMPLES + 1) / PERIOD_SAMPLES
    for column, unit in ((1, 1.0), (2, 1.0j), (5, 1.0), (6, 1.0j)):
        k = (column + 1) // 2
        added = -step_m * (k * w) ** 2 * np.real(unit * np.exp(1j * k * phase))
        change = solve_perturbed(orbit, added) - solve_perturbed(orbit, -added)
        scale = np.abs(jacobian[:, column]).max()
        assert change / (2 * step_m) == pytest.approx(jacobian[:, column], abs=5e-3 * scale)
    assert not jacobian[:, 0].any()


def test_a_held_command_moves_the_table_to_it(orbit):
    """Constant command: the table ends at it, and the mean of u + y is that of the parts."""
    parts = LinearizedOrbit(orbit, 4).linearize_parts(200.0)
    z = np.zeros(parts[0].mean_row.size)
    for part in parts:
        z = part.transition @ z + part.from_command
    assert z[-2:] == pytest.approx([1.0, 0.0], abs=1e-9)


def test_harmonics_add_up_to_the_motion(orbit):
    harmonics = find_harmonics(orbit, 15)
    phase = 2 * math.pi * np.arange(1, 401) / 400
    motion = np.real(np.exp(1j * np.outer(phase, np.arange(16))) @ harmonics)
    assert motion == pytest.approx(orbit.sample_motion(400)[0], abs=2e-3 * orbit.u_max)
