"""`Model`: made from a card, checked, flat and back, which path it takes, plug-ins, batches."""

import math
import subprocess
import sys
from dataclasses import replace
from importlib import metadata

import numpy as np
import pytest

from table_io.config.base import parse_toml
from table_io.config.profile import Specimen
from table_io.errors import InputError
from tests.input_errors import raises_input_error
from tests.model.cases import RATE_HZ, drive, everything, having, noisy
from tests.model.reference import AG, snm
from tests.model.test_parameters import CARD
from twin.laws.effect import Effect, EffectParameter
from twin.laws.library import find_effect
from twin.model.closed_form import ClosedFormSolver
from twin.model.config import ModelConfig
from twin.model.event_integrator import EventDrivenSolver
from twin.model.ideal_response import simulate_sweep
from twin.model.model import Model, SensorModel
from twin.model.prepare import prepare_solver
from twin.model.solver import StateEstimate

pytestmark = pytest.mark.usefixtures("forget_entry_points")

G4 = Specimen(mass_kg=550.0, gap_mm=4.0)


QUINTIC = Effect(
    id="quintic_spring",
    term="k5 u^5 + c u^2 u'",
    parameters=(
        EffectParameter("k5", "N/m5", 0.0, 1e14, 0.0, 1e12, "Quintic coefficient."),
        EffectParameter("c", "N s/m3", 0.0, 1e9, 0.0, 1e7, "Loss with it."),
    ),
    force="k5 * u**5 + c * v * u * u",
    residual="fifth harmonic",
    confused_with=("cubic_stiffness",),
)


def install_effects(monkeypatch, *effects):
    """Entry points that load these."""

    class Entry:
        def __init__(self, effect):
            self.effect, self.name, self.value = effect, "theirs", "their.module:EFFECT"

        def load(self):
            if isinstance(self.effect, Exception):
                raise self.effect
            return self.effect

    installed = metadata.entry_points  # of numba, which asks before its first compilation

    def find_entries(**wanted):
        is_ours = wanted.get("group") == "shaketwin.effects"
        return [Entry(effect) for effect in effects] if is_ours else installed(**wanted)

    monkeypatch.setattr(metadata, "entry_points", find_entries)


def test_a_plug_in_adds_a_force(monkeypatch):
    install_effects(monkeypatch, QUINTIC)
    text = CARD + '[[effects]]\nid = "quintic_spring"\nparameters = { k5 = 1e12, c = 1e7 }\n'
    model = parse_toml(text, ModelConfig, "x").build_model(G4)
    _, out = drive(model, noisy(0.5))
    p, (u, v) = snm(), out[:2]
    force = p.damping * v + p.stiffness * u + out[3] + out[4] + 1e12 * u**5 + 1e7 * v * u * u
    assert np.abs(p.mass * out[2] + force).max() < 1e-9 * np.abs(force).max()
    plain = drive(Model(snm()), noisy(0.5))[1]
    assert np.abs(out[0] - plain[0]).max() > 1e-5
    solvers = prepare_solver(model, RATE_HZ), prepare_solver(model, 2 * RATE_HZ)
    assert isinstance(solvers[0], EventDrivenSolver)
    assert isinstance(solvers[1], EventDrivenSolver)
    assert solvers[0].laws is solvers[1].laws  # compiled once
    with raises_input_error(remedy="'quintic_spring'"):
        find_effect("quintic_sprin")


def test_plug_ins_that_repeat_a_built_in_law_agree_with_it_and_keep_apart(monkeypatch):
    ours = find_effect("cubic_stiffness")
    theirs = replace(ours, id="their_cubic", compiled={})
    install_effects(monkeypatch, QUINTIC, theirs)
    first = Model(snm()).with_effect("cubic_stiffness", k3=1e7)
    two = Model(snm()).with_effect("their_cubic", k3=1e7)
    assert np.abs(drive(first, noisy(0.5))[1] - drive(two, noisy(0.5))[1])[0].max() < 1e-12
    three = two.with_effect("quintic_spring", k5=1e12, c=1e7)
    four = first.with_effect("quintic_spring", k5=1e12, c=1e7)
    assert np.abs(drive(three, noisy(0.5))[1] - drive(four, noisy(0.5))[1])[0].max() < 1e-12


@pytest.mark.parametrize(
    "effect, problem",
    [
        (ImportError("no module"), "no module"),
        ("text", "got str"),
        (replace(QUINTIC, force=""), "does nothing"),
        (replace(QUINTIC, force=lambda q, c: c[0] * q), "not an expression"),  # type: ignore[arg-type]
        (replace(QUINTIC, compiled={"k3": "k5"}), "`compiled`"),
        (replace(QUINTIC, place="sensor"), "sensors"),
    ],
)
def test_a_bad_plug_in_is_named(monkeypatch, effect, problem):
    install_effects(monkeypatch, effect)
    with raises_input_error(
        where="plug-in their.module:EFFECT of shaketwin.effects", problem=problem
    ):
        find_effect("not_ours")
    assert find_effect("bouc_wen").id == "bouc_wen"


def test_flat_names_and_back():
    model = everything().with_effect("sensor_gain", "mass_acc_m_s2", gain=1.1)
    model = model.with_effect("sensor_gain", "force_r1_n", gain=0.9)
    flat = model.flatten()
    assert flat["bouc_wen.yield_displacement"] == 3e-3
    assert flat["sensor_gain.force_r1_n.gain"] == 0.9
    assert flat["mass"] == 550.0
    assert flat["gap_r"] == 2e-3  # the base, before gap_offset
    again = Model.from_flat(flat)
    assert again == model
    with raises_input_error(remedy="'bouc_wen'"):
        Model.from_flat({**flat, "bouc_wem.force": 1.0})


def test_build_model_with_sensor_effects():
    text = CARD + (
        '[[effects]]\nid = "sensor_gain"\nparameters = { channel = "mass_acc_m_s2", gain = 1.1 }\n'
        '[[effects]]\nid = "sensor_lag"\nparameters = { channel = "mass_acc_m_s2", lag = 1e-3 }\n'
        '[[effects]]\nid = "sensor_gain"\nparameters = { channel = "force_l1_n", gain = 0.9 }\n'
    )
    model = parse_toml(text, ModelConfig, "x").build_model(G4)
    assert model.sensors == (
        SensorModel("mass_acc_m_s2", gain=1.1, lag=1e-3), SensorModel("force_l1_n", gain=0.9),
    )  # fmt: skip
    assert isinstance(prepare_solver(model, RATE_HZ), ClosedFormSolver)


@pytest.mark.parametrize(
    "entry, fields",
    [
        ('id = "boucwen"\nparameters = {}', {"remedy": "'bouc_wen'"}),
        ('id = "sensor_gain"\nparameters = { gain = 1.1 }',
         {"key": "channel", "remedy": "rel_disp_m"}),
        ('id = "sensor_gain"\nparameters = { channel = "mass_ac_m_s2", gain = 1.1 }',
         {"key": "channel", "value": "mass_ac_m_s2", "remedy": "'mass_acc_m_s2'"}),
        ('id = "coulomb_friction"\nparameters = { channel = "mass_acc_m_s2", fc = 1.0 }',
         {"key": "channel", "value": "mass_acc_m_s2", "remedy": "omit"}),
        ('id = "coulomb_friction"\nparameters = { fc = "much" }',
         {"key": "fc", "value": "much", "allowed": "finite"}),
        ('id = "coulomb_friction"\nparameters = { fc = inf }',
         {"key": "fc", "value": math.inf, "allowed": "finite"}),
        ('id = "coulomb_friction"\nparameters = { fc = -1.0 }',
         {"key": "fc", "value": -1.0, "allowed": "0 to 1e+09 N"}),
        ('id = "bouc_wen"\nparameters = { force = 1.0 }', {"key": "yield_displacement"}),
    ],
)  # fmt: skip
def test_a_bad_effect_is_refused_in_words(entry, fields):
    with raises_input_error(**fields):
        parse_toml(CARD + "[[effects]]\n" + entry, ModelConfig, "x")


@pytest.mark.parametrize("key", ["stiffness_n_m", "bumper_stiffness_n_m", "damping_n_s_m"])
def test_negative_and_zero_numbers_of_a_card(key):
    with raises_input_error(key=f"base.{key}"):
        parse_toml(CARD.replace(f"\n{key} = ", f"\n{key} = -"), ModelConfig, "x")
    no_damping = CARD.replace("bumper_damping_n_s_m = 900.0", "bumper_damping_n_s_m = 0")
    assert parse_toml(no_damping, ModelConfig, "x").build_model(G4).parameters.bumper_damping_l == 0


def test_a_rate_too_low_for_the_bumper_is_refused():
    with pytest.raises(InputError) as error:
        prepare_solver(Model(snm()), 50.0)
    assert (error.value.key, error.value.value) == ("rate_hz", 50.0)
    assert error.value.allowed.startswith("100")
    assert prepare_solver(Model(snm(math.inf)), 50.0)
    steel = snm(bumper_stiffness_r=5e9)
    with raises_input_error(key="rate_hz", value=2000.0, remedy="rate_hz"):
        prepare_solver(Model(steel), 2000.0)
    stiff = having(find_effect("bouc_wen"), base=snm(bumper_damping_r=0.1))
    with raises_input_error(key="rate_hz", value=2000.0, remedy="tau"):
        prepare_solver(stiff, 2000.0)


@pytest.mark.parametrize("rate", [math.nan, math.inf, 0.0, -1.0])
def test_a_rate_that_is_none_is_refused(rate):
    with pytest.raises(InputError) as error:
        prepare_solver(Model(snm(math.inf)), rate)
    assert (error.value.key, error.value.allowed) == ("rate_hz", "above 0 Hz, finite")


@pytest.mark.parametrize("model", [Model(snm()), having(find_effect("cubic_stiffness"))])
def test_too_little_room_is_refused_before_anything_is_written(model):
    solver, base = prepare_solver(model, RATE_HZ), np.ones(9)
    out = np.zeros((7, 8))
    for state, room in ((solver.rest_state(), out), (solver.rest_state()[:6], np.zeros((7, 9))),
                        (solver.rest_state(), np.zeros((6, 9)))):  # fmt: skip
        with pytest.raises(ValueError, match="too small"):
            solver.advance(state, base, base, room)
        assert not room.any()


def test_relaxing_face_without_viscous_damping_is_refused():
    bare = snm(bumper_damping_r=0.0, bumper_damping_l=0.0)
    model = Model(bare).with_effect("hunt_crossley", ch=1e5)
    with raises_input_error(allowed="bumper damping above 0"):
        model.with_effect("bumper_maxwell", kb=1e5, tau=0.1)


def test_restart_takes_hidden_states_and_refuses_nan():
    model = everything()
    solver = prepare_solver(model, RATE_HZ)
    state, _ = drive(model, noisy(0.5))
    u, v, u_r, u_l = state[:4]
    again = solver.restart_state(StateEstimate(int(state[-1]), u, v, u_r, u_l, hidden=state))
    assert np.array_equal(again[7:11], state[7:11])
    assert again[-1] == state[-1]
    assert not solver.restart_state(StateEstimate(0, 0.0, 0.1)).take(range(7, 11)).any()
    assert np.isnan(solver.restart_state(StateEstimate(5, math.nan, 0.1))[:-1]).all()


def test_the_plain_model_starts_without_the_integrator():
    code = (
        "from twin.compare import pipeline; from twin.model.model import Model;"
        "from twin.model.parameters import Parameters as P;"
        "from twin.model.prepare import prepare_solver;"
        "prepare_solver(Model(P(550., 36e3, 1100., 5e5, 900., 5e5, 900., .002, .002)), 2000.);"
        "from twin.model.event_integrator_kernel import build_kernel;"
        "assert build_kernel.cache_info().currsize == 0"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("effect", ["cubic_stiffness", "table_tilt", "gap_drift"])
def test_sampled_sweep_of_a_model_is_near_the_closed_one(effect):
    """A vanishingly small effect takes the other road to the same extremes."""
    parameter = find_effect(effect).parameters[0].name
    model = Model(snm()).with_effect(effect, "", **{parameter: 1e-12})
    frequencies = [2.0, 2.2, 3.0]
    got = simulate_sweep(model, frequencies, AG, 6)
    want = simulate_sweep(Model(snm()), frequencies, AG, 6)
    assert got.extremes.shape == want.extremes.shape
    assert np.array_equal(got.extremes[..., 6:], want.extremes[..., 6:])
    assert got.extremes[..., :4] == pytest.approx(want.extremes[..., :4], rel=1e-4)


def test_a_sampled_sweep_takes_as_many_samples_as_a_hard_bumper_needs():
    hard = snm(bumper_stiffness_r=5e8, bumper_stiffness_l=5e8)
    model = Model(hard).with_effect("cubic_stiffness", k3=1e-9)
    got, want = (simulate_sweep(start, [1.4], AG, 1).extremes for start in (model, Model(hard)))
    assert model.min_rate_hz > 1000 * 1.4
    assert got[..., :2] == pytest.approx(want[..., :2], rel=1e-4)
    assert got[..., 6:].tolist() == want[..., 6:].tolist()


@pytest.mark.parametrize("effect", [None, "gap_drift"])
@pytest.mark.parametrize("measured", [1, 3, 6])
def test_measuring_fewer_cycles_changes_no_bit_of_them(effect, measured):
    """Neither of those that are measured, nor of the state that goes on to the next step."""
    model = Model(snm()) if effect is None else Model(snm()).with_effect(effect, rate=1e-6)
    whole = simulate_sweep(model, [2.0, 2.9, 3.0], AG, 6)
    part = simulate_sweep(model, [2.0, 2.9, 3.0], AG, 6, measured)
    assert np.array_equal(part.extremes, whole.extremes[:, -measured:])
    assert np.array_equal(part.states, whole.states)
