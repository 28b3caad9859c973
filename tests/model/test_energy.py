"""Energy of the exact solver: stored plus lost is the work of the drive, contacts included.

    d/dt (M u'^2 + K u^2 + sum K_j u_j^2) / 2 = -M A u' - C u'^2 - sum C_j u_j'^2

It holds in all phases: in flight C_j u_j' = -K_j u_j, the dashpot of a free bumper eats what its
spring holds. Between events all is smooth, so Gauss-Legendre nodes there see every digit; the
solver's own step goes to each node.
"""

import math

import numpy as np
import pytest

from tests.model.motion import kick
from tests.model.reference import AG, snm
from twin.model import closed_form
from twin.model.contact_regime import (
    CONTACT_L,
    CONTACT_R,
    MAX_EVENTS_PER_STEP,
    STEP,
    U_L,
    U_R,
    U,
    V,
    advance_to_event,
)
from twin.model.stepped_sine import simulate_stepped_sine

CYCLE_COUNT = 10
NODES, WEIGHTS = np.polynomial.legendre.leggauss(24)
SLOW = {"bumper_damping_r": 6e4, "bumper_damping_l": 3e4, "gap_l": -5e-4}


def stored_energy(p, state: np.ndarray) -> float:
    """J; in no phase does the energy know which one it is."""
    return 0.5 * (
        p.mass * state[V] ** 2 + p.stiffness * state[U] ** 2
        + p.bumper_stiffness_r * state[U_R] ** 2 + p.bumper_stiffness_l * state[U_L] ** 2
    )  # fmt: skip


def powers(p, state: np.ndarray, base: float) -> np.ndarray:
    """(work of the drive, loss in the damper, loss in both bumpers) in W."""
    v, lost = state[V], 0.0
    for k, c, u_j, contact in (
        (p.bumper_stiffness_r, p.bumper_damping_r, state[U_R], state[CONTACT_R]),
        (p.bumper_stiffness_l, p.bumper_damping_l, state[U_L], state[CONTACT_L]),
    ):
        lost += c * (v if contact else -u_j * k / c) ** 2
    return np.array([-p.mass * base * v, p.damping * v * v, lost])


def phase_integral(p, con, begin: np.ndarray, dt: float, drive) -> np.ndarray:
    """`powers` over a phase of dt s from the state `begin`, in J."""
    total = np.zeros(3)
    base, slope, (peak, w, phase) = drive
    for node, weight in zip(NODES, WEIGHTS, strict=True):
        t, state = 0.5 * dt * (node + 1), begin.copy()
        advance_to_event(state, con, t, base, slope, (peak, w, phase), False)
        force = base + slope * t + peak * math.sin(phase + w * t)
        total += 0.5 * dt * weight * powers(p, state, force)
    return total


def balance(p, frequency: float, rate: float, sampled: bool) -> tuple[np.ndarray, np.ndarray, int]:
    """(`powers` integrated over the run from a kick in J, the state at its end, onsets)."""
    con, state = closed_form.discretized_params(p, rate), kick(p, 0.1)
    h, w = con[STEP], 2 * math.pi * frequency
    total, onsets, still = np.zeros(3), 0, (0.0, 0.0, 0.0)
    for i in range(round(CYCLE_COUNT * rate / frequency)):
        t, before, after = 0.0, AG * math.sin(w * i * h), AG * math.sin(w * (i + 1) * h)
        for attempt in range(MAX_EVENTS_PER_STEP):
            assert attempt + 1 < MAX_EVENTS_PER_STEP
            if sampled:
                slope = (after - before) / h
                base, wave = before + slope * t, still
            else:
                base, slope, wave = 0.0, 0.0, (AG, w, w * (i * h + t))
            begin = state.copy()
            dt, side, *_ = advance_to_event(state, con, h - t, base, slope, wave, True)
            total += phase_integral(p, con, begin, dt, (base, slope, wave))
            t += dt
            if side < 0:
                break
            onsets += int(state[CONTACT_R + side])
    return total, state, onsets


def drive_to_end(p, frequency: float, rate: float, sampled: bool) -> np.ndarray:
    """The end of the same run by the driver itself."""
    if not sampled:
        return simulate_stepped_sine(p, [frequency], AG, CYCLE_COUNT, state=kick(p, 0.1)).states[0]
    base = AG * np.sin(
        2 * math.pi * frequency * np.arange(1, CYCLE_COUNT * rate / frequency + 1) / rate
    )
    state, out = kick(p, 0.1), np.empty((7, base.size))
    closed_form.advance_state(state, closed_form.discretized_params(p, rate), base, out)
    return state


@pytest.mark.parametrize("sampled", [False, True], ids=["sinusoid", "sampled"])
@pytest.mark.parametrize("p, frequency", [(snm(), 2.0), (snm(), 0.71), (snm(**SLOW), 1.3)])
def test_balance_closes_to_1e_9_of_the_work_done(p, frequency, sampled):
    """G4 impacting, G4 in chaos, and slow bumpers on unequal gaps."""
    con = closed_form.continuous_params(p)
    rate = frequency * 16 * closed_form.substep_count(con, 1 / (16 * frequency))
    (work, damper, bumpers), end, onsets = balance(p, frequency, rate, sampled)
    change = stored_energy(p, end) - stored_energy(p, kick(p, 0.1))
    assert onsets > 15
    assert min(work, damper, bumpers) > 0.01 * work > 0
    assert abs(work - damper - bumpers - change) < 1e-9 * work
    print(f"{frequency} Hz: {(work - damper - bumpers - change) / work:.1e} of {work:.3g} J")
    assert np.abs(end - drive_to_end(p, frequency, rate, sampled))[[U, U_R, U_L]].max() < 1e-9


def test_a_released_bumper_loses_all_that_it_holds():
    """Alone, with nothing to touch it."""
    p = snm(math.inf, gap_r=1.0)
    con, state = closed_form.discretized_params(p, 2000.0), closed_form.rest_state(p)
    state[U_R] = 1e-3
    begin, lost = state.copy(), 0.0
    for _ in range(100):
        here = state.copy()
        lost += phase_integral(p, con, here, con[STEP], (0.0, 0.0, (0.0, 0.0, 0.0)))[2]
        advance_to_event(state, con, con[STEP], 0.0, 0.0, (0.0, 0.0, 0.0), True)
    assert lost == pytest.approx(stored_energy(p, begin) - stored_energy(p, state), rel=1e-12)
    assert stored_energy(p, state) < 1e-20
