"""Every hidden effect: absent, of the size and sign it is named for, and integrated right."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from table_io.block import Float1D, Float2D
from table_io.errors import InputError
from table_io.sim.ground_truth import EFFECT_DEFINITIONS, EffectDefinition, GroundTruth
from table_io.sim.plant import SIGNALS, HiddenCoefficients, Plant
from table_io.sim.simulated_table import hide_laws
from table_io.units import GRAVITY_M_S2
from tests.input_errors import raises_input_error
from tests.table_io.sim.hidden_reference import CJ, KJ, MT, C, G, H, K, M, Reference

RIG = Plant(M, K, C, KJ, CJ, G, G, MT, 20.0, 0.005, True, 1.0 / H)
Y, Y_ACC, X, X_ACC, F_R, F_L, DAMPER = range(7)
PHYSICAL = [kind for kind in EFFECT_DEFINITIONS if not kind.is_sensor_effect]
# As large as it takes to see each in the motion below.
SIZES = {
    "cubic_stiffness": {"k3": 3e8},
    "table_tilt": {"tilt": 0.5},
    "gap_drift": {"rate": 1e-4},
    "stiffness_drift": {"rate": 1e-2},
    "adhesion": {"force": 300.0},
    "damping_drift": {"rate": 0.1},
    "position_damping": {"cu": 3e7},
    "cable_stiffness": {"coefficient": 1e8},
    "warming_friction": {"time": 1.0},
}


def names(kinds: list[EffectDefinition]) -> Any:
    return pytest.mark.parametrize("kind", kinds, ids=[f"{kind.id}-{kind.form}" for kind in kinds])


def typical(kind: EffectDefinition) -> dict[str, float]:
    return {parameter.name: parameter.typical for parameter in kind.parameters} | SIZES.get(
        kind.id, {}
    )


def with_effect(kind: EffectDefinition, values: dict[str, float], plant: Plant = RIG) -> Plant:
    effect = {"id": kind.id, "form": kind.form, "parameters": values}
    return hide_laws(plant, GroundTruth.model_validate({"effects": [effect]}))


def command(samples: int) -> Float1D:
    t = np.arange(samples) * H
    return 6e-3 * np.minimum(t, 1.0) ** 3 * np.sin(2 * np.pi * 2.4 * t)


def run(plant: Plant, path: Float1D, state: Float1D | None = None) -> Float2D:
    """SIGNALS, (signal, sample), for a command in m that stood at 0 before."""
    out = np.empty((len(SIGNALS), path.size))
    before = np.zeros(plant.history_samples)
    plant.advance(
        plant.rest_state() if state is None else state, np.concatenate([before, path]), out
    )
    return out


@names(PHYSICAL)
def test_at_its_vanishing_value_the_samples_are_those_without_it(kind: EffectDefinition) -> None:
    path = command(3000)
    values = {
        parameter.name: parameter.typical if parameter.vanishing is None else parameter.vanishing
        for parameter in kind.parameters
    }
    nominal = run(RIG, path)
    assert nominal[F_R].max() > 100.0
    assert nominal[F_L].min() < -100.0
    plant = with_effect(kind, values)
    assert plant.substep_s == RIG.substep_s
    np.testing.assert_allclose(run(plant, path), nominal, rtol=0, atol=1e-6)


class Along:
    """The true motion of a plant on the driven table, and its forces less the nominal ones."""

    def __init__(self, plant: Plant, seconds: float = 2.5) -> None:
        samples = round(seconds / H)
        path = np.concatenate([np.zeros(plant.history_samples), command(samples)])
        state = plant.rest_state()
        out = np.empty((7, samples))
        states = np.empty((state.size, samples))
        sample = np.empty((7, 1))
        for k in range(samples):
            plant.advance(state, path[k : k + plant.history_samples + 1], sample)
            out[:, k], states[:, k] = sample[:, 0], state
        self.t, self.y, self.table_acc = np.arange(samples) * H, out[Y], out[Y_ACC]
        self.u, self.v = out[X] - out[Y], states[1] - states[3]
        self.touched = states[6:8] > 0
        self.push = np.array([out[F_R], -out[F_L]])
        self.depth = states[4:6]
        self.d = np.array([self.u, -self.u]) - G
        self.rate = np.array([self.v, -self.v])
        balance = -M * out[X_ACC] - out[F_R] - out[F_L]
        self.damper = balance - C * self.v - K * self.u
        self.bumper = (self.push - KJ * self.d - CJ * self.rate) * self.touched
        self.load = balance

    def integrate_relaxation(self, path: Float1D, k: float, tau: float) -> Float1D:
        """f' = k path' - f / tau along the samples, by the trapezoidal rule."""
        force, out = 0.0, []
        for way in np.diff(path, prepend=path[0]):
            force = (force * (1 - H / 2 / tau) + k * way) / (1 + H / 2 / tau)
            out.append(force)
        return np.array(out)

    def integrate_appendage(self, mass: float, hz: float, damping_ratio: float) -> Float1D:
        """Force on the left side of a mass on a spring, along the samples: exact between them."""
        w = 2 * np.pi * hz
        a = np.array([[0.0, 1.0], [-w * w, -2 * damping_ratio * w]])
        step = expm(a * H)
        held = np.linalg.solve(a, step - np.eye(2)) @ np.array([0.0, 1.0])
        acc = np.gradient(self.v, H) + self.table_acc
        stretch, out = np.zeros(2), []
        for value in acc:
            out.append(-mass * (w * w * stretch[0] + 2 * damping_ratio * w * stretch[1]))
            stretch = step @ stretch - held * value
        return np.array(out)

    def integrate_hysteresis(self, uy: float) -> Float1D:
        """z of n = 2 with 1/2 and 1/2 along the samples, by small explicit steps."""
        z, out = 0.0, []
        for du in np.diff(self.u, prepend=self.u[0]):
            for _ in range(4):
                z += (du - 0.5 * (abs(du) * z * abs(z) + du * z * z)) / 4 / uy
            out.append(z)
        return np.array(out)


SIDE = np.array([[1.0], [-1.0]])
# (damper term, bumper terms (2, sample)) that the model's effect of this name stands for.
DOCUMENTED: dict[str, Any] = {
    "cubic_stiffness": lambda a, p: (p["k3"] * a.u**3, 0.0),
    "quadratic_damping": lambda a, p: (p["c2"] * a.v * abs(a.v), 0.0),
    # The rig's friction grows over a few mm/s, where the model's sticks.
    "coulomb_friction": lambda a, p: (
        np.where(abs(a.v) > 5e-3, p["fc"] * np.sign(a.v), a.damper),
        0.0,
    ),
    "bouc_wen": lambda a, p: (p["force"] * a.integrate_hysteresis(p["yield_displacement"]), 0.0),
    "maxwell_damper": lambda a, p: (a.integrate_relaxation(a.u, p["k1"], p["tau"]), 0.0),
    "bumper_hardening": lambda a, p: (0.0, p["k2"] * a.d * abs(a.d)),
    "hunt_crossley": lambda a, p: (0.0, p["ch"] * abs(a.d) * a.rate),
    "bumper_maxwell": lambda a, p: (
        0.0,
        np.array([a.integrate_relaxation(depth, p["kb"], p["tau"]) for depth in a.depth]),
    ),
    "bumper_asymmetry": lambda a, p: (
        0.0,
        KJ * a.d * (np.array([[2 * p["ratio"]], [2.0]]) / (1 + p["ratio"]) - 1.0),
    ),
    "gap_offset": lambda a, p: (0.0, -SIDE * KJ * p["offset"]),
    "gap_drift": lambda a, p: (0.0, -p["rate"] * (KJ * a.t + CJ)),
    "stribeck_friction": lambda a, p: (
        np.where(
            abs(a.v) > 5e-3,
            p["fc"] * (1 + (p["ratio"] - 1) * np.exp(-((a.v / p["speed"]) ** 2))) * np.sign(a.v),
            a.damper,
        ),
        0.0,
    ),
    "position_damping": lambda a, p: (p["cu"] * a.u**2 * a.v, 0.0),
    # far from the corner
    "dead_band": lambda a, p: (
        np.where(abs(a.u) > 3 * p["width"], -K * np.clip(a.u, -p["width"], p["width"]), a.damper),
        0.0,
    ),
    "appendage": lambda a, p: (
        a.integrate_appendage(p["mass"], p["frequency"], p["damping_ratio"]),
        0.0,
    ),
    "bumper_cubic": lambda a, p: (0.0, p["kc"] * a.d**3),
    "table_tilt": lambda a, p: (M * GRAVITY_M_S2 * p["tilt"] * a.y, 0.0),
    # ratio (C u' + K u + F_R + F_L) = -M a, with the forces themselves as they were.
    "mass_error": lambda a, p: (
        (p["ratio"] - 1.0) * (C * a.v + K * a.u + a.push[0] - a.push[1]),
        0.0,
    ),
}


@names([kind for kind in PHYSICAL if kind.in_library and kind.id != "adhesion"])
def test_forces_less_the_nominal_ones_are_the_term_of_that_name(kind: EffectDefinition) -> None:
    values = typical(kind)
    along = Along(with_effect(kind, values))
    assert along.touched.any(axis=1).all()
    rough = {"bouc_wen": 0.1}.get(kind.id, 0.02)
    damper, bumper = DOCUMENTED[kind.id](along, values)
    for force, term in ((along.damper, damper), (along.bumper, bumper * along.touched)):
        expected = term + np.zeros_like(force)
        size = np.sqrt(np.mean(expected**2))
        assert size == 0.0 or size > 5.0
        assert np.sqrt(np.mean((force - expected) ** 2)) <= rough * size + 1e-6


@names(PHYSICAL)
def test_adaptive_method_of_order_eight_finds_the_same_motion(kind: EffectDefinition) -> None:
    values = typical(kind) | {
        parameter.name: parameter.default for parameter in kind.parameters if parameter.default
    }
    plant, count = with_effect(kind, values), 400
    state, start = plant.rest_state(), np.zeros(8)
    state[:3] = start[:3] = 5e-3, 0.3, 5e-3
    if kind.id in ("appendage", "cubic_appendage", "table_resonator"):
        state[12] = start[6] = 5e-3
    out = run(plant, np.zeros(count), state)
    x = Reference(kind, values).samples(start, count)
    assert (np.diff((out[F_R] != 0).astype(int)) > 0).any()
    assert (np.diff((out[F_L] != 0).astype(int)) > 0).any()
    np.testing.assert_allclose(out[[X, Y]], x[[0, 2]], rtol=0, atol=1e-10)
    nominal = run(RIG, np.zeros(count), np.array([5e-3, 0.3, 5e-3, 0, 0, 0, 0, 0]))
    assert np.abs(nominal[X] - out[X]).max() > 1e-6


def test_integrator_is_of_fourth_order_through_contacts_with_many_laws() -> None:
    laws = HiddenCoefficients(
        k3=1e7,
        k5=3e10,
        ke=3e5,
        dead_width=1e-3,
        c2=2e3,
        c3=2e4,
        cu=3e6,
        k1=8e3,
        tau=0.05,
        k2=1e8,
        kc=4e10,
        ch=5e5,
        kb=2e5,
        tau_b=0.05,
        pull=50.0,
        gap_rate=1e-4,
        tilt=0.5,
        stiffness_ratio=(1.1, 0.9),
        m2=20.0,
        w2=30.0,
        z2=0.02,
    )
    given = with_effect(PHYSICAL[0], {"k3": 1e7})

    def ends(parts: int) -> Float1D:
        plant = replace(given, hidden=laws, rate_hz=1000.0, substep_s=1e-3 / parts)
        state = plant.rest_state()
        state[1] = 0.3
        return run(plant, np.zeros(250), state)[X, -5:]

    reference = ends(256)
    errors = [float(np.abs(ends(n) - reference).max()) for n in (8, 16, 32)]
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert (np.abs(orders - 4.0) < 0.5).all(), errors


@pytest.mark.parametrize("gaps", [(-1e-3, -1e-3), (-3e-3, -1e-3), (-2e-3, np.inf)])
def test_pressed_in_nonlinear_bumpers_rest(gaps: tuple[float, float]) -> None:
    pressed = replace(RIG, gap_right_m=gaps[0], gap_left_m=gaps[1])
    effects = [
        {"id": "bumper_hardening", "parameters": {"k2": 1e8}},
        {"id": "cubic_stiffness", "parameters": {"k3": 1e7}},
        {"id": "bumper_asymmetry", "parameters": {"ratio": 1.3}},
    ]
    plant = hide_laws(pressed, GroundTruth.model_validate({"effects": effects}))
    out = run(plant, np.zeros(400))
    np.testing.assert_allclose(out[X], plant.rest_state()[0], rtol=0, atol=1e-11)
    assert out[F_R].min() > 50.0
    np.testing.assert_allclose(out[DAMPER] + out[F_R] + out[F_L], 0.0, atol=1e-5)


def test_base_of_a_truth_stands_in_place_of_the_cards() -> None:
    base: dict[str, Any] = {
        "mass_kg": 500.0,
        "damper_stiffness_n_m": 30e3,
        "damper_damping_n_s_m": 1e3,
        "bumper_stiffness_n_m": 4e5,
        "bumper_damping_n_s_m": 800.0,
        "gap_right_m": 1e-3,
        "gap_left_m": 3e-3,
    }
    plant = hide_laws(RIG, GroundTruth.model_validate({"base": base}))
    np.testing.assert_allclose(
        run(plant, command(2000)), run(replace(RIG, **base), command(2000)), atol=1e-6
    )


def test_law_too_fast_to_follow_is_refused_with_a_limit() -> None:
    kind = next(definition for definition in EFFECT_DEFINITIONS if definition.id == "bouc_wen")
    with pytest.raises(InputError, match="2e-06 s") as error:
        with_effect(kind, {"force": 1.0, "yield_displacement": 1e-5, "exponent": 10.0})
    assert error.value.allowed.startswith("at least 5e-06 s")


def test_bumpers_that_soften_below_zero_are_refused() -> None:
    """They would pull the mass in, ever harder: no step of the integrator follows that."""
    kind = next(each for each in EFFECT_DEFINITIONS if each.id == "softening_bumper")
    soft, stiffness = replace(RIG, bumper_stiffness_n_m=1e5), kind.parameters[0]
    values = {"stiffness": 1.1e5, "time": 0.02}
    assert stiffness.low < values["stiffness"] < stiffness.high < KJ
    with raises_input_error(key="softening_bumper.stiffness", value=1.1e5, allowed="100000"):
        with_effect(kind, values, soft)
    with_effect(kind, {**values, "stiffness": 0.9e5}, soft)
