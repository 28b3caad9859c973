"""The integrated and the linear path: an independent integrator, order, energy, friction."""

import math

import numpy as np
import pytest
from scipy.special import hyp2f1

from tests.model.cases import FORCES, drive, having, noisy, typical
from tests.model.independent_solution import Witness
from tests.model.motion import sine
from tests.model.reference import snm
from twin.laws.library import find_effect
from twin.model.event_integrator_kernel import (
    DIRECTION,
    STATE_B_L,
    STATE_B_R,
    STATE_F,
    STATE_S,
    STATE_Z,
)
from twin.model.model import Model
from twin.model.prepare import prepare_solver
from twin.model.solver import StateEstimate

PAIRS = [
    ("bouc_wen", "bumper_hardening"), ("maxwell_damper", "bumper_maxwell"),
    ("coulomb_friction", "maxwell_damper"), ("hunt_crossley", "bumper_hardening"),
    ("gap_drift", "bumper_maxwell"), ("bouc_wen", "coulomb_friction"),
    ("cubic_stiffness", "quadratic_damping"), ("appendage", "stribeck_friction"),
    ("stribeck_friction", "coulomb_friction"), ("adhesion", "bumper_maxwell"),
    ("dead_band", "bumper_cubic"),
]  # fmt: skip
BARE = {"bumper_damping_r": 0.0, "bumper_damping_l": 0.0}
MODELS = [having(effect) for effect in FORCES]
COUPLED = [having(*map(find_effect, pair)) for pair in PAIRS]
MODELS += COUPLED
MODELS += [having(find_effect("bumper_maxwell"), base=snm(-0.001)),
           having(find_effect("bumper_hardening"), base=snm(-0.002)),
           having(find_effect("hunt_crossley"), base=snm(**BARE)),
           having(find_effect("bumper_hardening"), base=snm(**BARE)),
           having(find_effect("gap_drift"), values=lambda _: {"rate": -1e-4})]  # fmt: skip
SPEED_M_S = 0.15


def name(model: Model) -> str:
    return "+".join(effect.name for effect in model.effects)


@pytest.mark.parametrize(
    "model",
    [pytest.param(m, marks=[pytest.mark.slow] if m in COUPLED else []) for m in MODELS],
    ids=name,
)
def test_agrees_with_dop853(model):
    """A cycle of a drive that is linear between samples, from a blow; contacts and reversals."""
    rate, hz = 2000.0, 2.6
    base = 2 * sine(hz, rate, 0.4)
    table = np.concatenate([[0.0], base])
    times = np.arange(1, base.size + 1) / rate
    witness = Witness(model, lambda t: float(np.interp(t * rate, np.arange(table.size), table)))
    p = model.parameters
    start = [0.0, SPEED_M_S, max(-p.gap_r, 0.0), max(-p.gap_l, 0.0), 0.0, 0.0, 0.0, 0.0]
    witness.contact = [
        -p.gap_r > 0 and p.bumper_damping_r * SPEED_M_S > p.bumper_stiffness_r * p.gap_r,
        -p.gap_l > 0 and -p.bumper_damping_l * SPEED_M_S > p.bumper_stiffness_l * p.gap_l,
    ]
    want = witness.run(start, times)
    first = StateEstimate(0, 0.0, SPEED_M_S, start[2], -start[3], p.gap_r < 0, p.gap_l < 0)
    state, out = drive(model, base, first, rate)
    assert witness.events > 3
    assert np.abs(out[0] - want[0]).max() < 2e-9
    assert np.abs(out[1] - want[1]).max() < 2e-7
    assert state[STATE_Z] == pytest.approx(want[7, -1], abs=1e-6)
    branches = state[[STATE_F, STATE_B_R, STATE_B_L]]
    assert branches == pytest.approx(want[4:7, -1] * [1, 1, -1], abs=1e-3)


@pytest.mark.parametrize("effect", ["cubic_stiffness", "quadratic_damping", "coulomb_friction",
                                    "bouc_wen", "bumper_hardening", "hunt_crossley",
                                    "appendage", "stribeck_friction", "position_damping",
                                    "bumper_cubic", "adhesion", "dead_band"])  # fmt: skip
def test_order_of_convergence_through_events(effect):
    """Free motion after a blow: contacts, reversals, sticking; fourth order, of two doublings."""
    values = typical(find_effect(effect))
    if effect == "coulomb_friction":
        values = {"fc": 300.0}
    base = snm(0.02, bumper_damping_r=2e4, bumper_damping_l=2e4)
    model = having(find_effect(effect), base=base, values=lambda _: values)
    ends = []
    coarsest = 208.0 if effect == "bumper_cubic" else 104.0  # so stiff that it divides these
    for rate in (coarsest, 2 * coarsest, 4 * coarsest, 64 * coarsest):
        state, out = drive(model, np.zeros(round(rate)), StateEstimate(0, 0.0, 0.4), rate)
        assert out[3].max() > 0
        ends.append(state[:2] * [1.0, 0.1])
    errors = [np.abs(end - ends[-1]).max() for end in ends[:-1]]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    print(effect, errors, orders)
    assert orders.mean() > 3.9


def energy(model: Model, state: np.ndarray) -> float:
    """All that is stored in J, from the laws' own potentials."""
    p, values = model.parameters, model.flatten()

    def value(effect: str, parameter: str) -> float:
        return values.get(f"{effect}.{parameter}", 0.0)

    u, v, sides = state[0], state[1], (abs(state[2]), abs(state[3]))
    total = 0.5 * p.mass * v * v + 0.5 * p.stiffness * u * u
    total += 0.25 * value("cubic_stiffness", "k3") * u**4
    z, uy = state[STATE_Z], value("bouc_wen", "yield_displacement")
    total += 0.5 * value("bouc_wen", "force") * uy * z * z
    for k, f in ((value("maxwell_damper", "k1"), state[STATE_F]),
                 (value("bumper_maxwell", "kb"), state[STATE_B_R]),
                 (value("bumper_maxwell", "kb"), state[STATE_B_L])):  # fmt: skip
        total += 0.5 * f * f / k if k else 0.0
    stiffness = p.bumper_stiffness_r, p.bumper_stiffness_l
    for k, d in zip(stiffness, sides, strict=True):
        total += 0.5 * k * d * d + value("bumper_hardening", "k2") * d**3 / 3
        total += 0.25 * value("bumper_cubic", "kc") * d**4
    if width := value("dead_band", "width"):
        # the integral of q / (1 + q^4)^(1/4) from 0 to r is r^2 / 2 times this
        square = (u / width) ** 2
        mean = float(hyp2f1(0.25, 0.5, 1.5, -(square**2)))
        total -= 0.5 * p.stiffness * u * u * mean
    if mass := value("appendage", "mass"):
        w = 2 * math.pi * value("appendage", "frequency")
        stretch, speed = state[STATE_S : STATE_S + 2]
        total += 0.5 * mass * (w * w * stretch**2 + speed**2)
    return total


PASSIVE = [m for m in MODELS if "gap_drift" not in name(m)]


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("model", PASSIVE, ids=name)
def test_no_effect_creates_energy(model, seed):
    """Shaken at random, then left alone: what is stored only falls, events included."""
    model = Model(model.base, model.effects)
    solver = prepare_solver(model, 2000.0)
    state, _ = drive(model, noisy(0.5, seed))
    out, before = np.empty((7, 1)), math.inf
    solver.advance(state, np.zeros(1), np.zeros(1), out)
    first = energy(model, state)
    for _ in range(1200):
        level = energy(model, state)
        assert level <= before + 1e-9 * first
        before = level
        solver.advance(state, np.zeros(1), np.zeros(1), out)
    assert before < 0.999 * first


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_mass_that_was_exactly_at_rest_starts_in_either_direction(sign):
    """u' = -A t at first, as from a step; a law of u' moves the mass by rounding before it."""
    model = having(find_effect("appendage"), base=snm(math.inf))
    _, out = drive(model, sign * np.r_[np.zeros(20), np.ones(4)])
    expected = -sign * (np.arange(4) + 0.5) / 2000.0
    assert out[1, 20:] == pytest.approx(expected, rel=0.01)
    assert not out[1, :20].any()


def test_friction_holds_the_mass_until_it_is_overcome():
    """Held exactly still, slips when M A reaches Fc, and never trembles."""
    model = having(find_effect("coulomb_friction"), base=snm(math.inf))
    ramp = np.linspace(0, 0.2, 2000)
    state, out = drive(model, ramp[1:])
    slip = np.flatnonzero(out[1])[0]
    assert ramp[1:][slip] == pytest.approx(50.0 / 550.0, abs=2e-4)
    assert not out[0, :slip].any()
    assert (out[1, slip:] < 0).all()
    assert state[DIRECTION] == -1.0
    assert np.array_equal(out[2, :slip], ramp[1:][:slip])


def test_friction_stops_a_free_mass_for_good():
    model = having(find_effect("coulomb_friction"), base=snm(math.inf))
    state, out = drive(model, np.zeros(8000), StateEstimate(0, 0.01, 0.0))
    assert state[DIRECTION] == 0.0
    assert not out[1, -2000:].any()
    assert 0 < abs(state[0]) <= 50.0 / 36e3


def test_hysteresis_does_not_depend_on_speed():
    """The closed form against a fine Euler walk of the law, and at a thousandth of the speed."""
    from twin.model.force_laws import hysteretic_variable

    way = 3e-3 * np.cumsum(np.random.default_rng(5).standard_normal(40))
    z = walked = 0.0
    for step in np.diff(way, prepend=0.0):
        z = hysteretic_variable(z, step, math.copysign(1.0, step), 2e-3)
        for part in np.full(20000, step / 20000):
            walked += (part - 0.5 * (abs(part) * walked * abs(walked) + part * walked**2)) / 2e-3
    assert z == pytest.approx(walked, abs=2e-4)
    assert abs(z) < 1


def test_a_bumper_without_damping_has_no_memory():
    """C_j = 0 in closed form: as C_j -> 0; force zero at touch, u_j back at release."""
    base = 3 * sine(2.6, 2000.0, 1.0)
    out = drive(Model(snm(bumper_damping_r=0.0, bumper_damping_l=0.0)), base)[1]
    near = drive(Model(snm(bumper_damping_r=1e-6, bumper_damping_l=1e-6)), base)[1]
    assert np.abs(out[0] - near[0]).max() < 1e-9
    assert out[3].max() > 100
    assert (out[5][out[3] == 0] < 1e-12).all()
    assert np.abs(out[3] - 510e3 * out[5]).max() < 1e-6
