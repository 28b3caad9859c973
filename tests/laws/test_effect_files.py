"""Effect files: the grammar, units, and laws that equal those of the library."""

import math
import pickle

import numpy as np
import pytest

from table_io.compilation import jit_helper
from table_io.config.base import parse_toml
from table_io.errors import InputError
from tests.discovery.played import SNM
from twin.laws.effect_file import EffectFile, format_effect_file
from twin.laws.expression import FUNCTIONS, build_function, parse_expression, parse_unit
from twin.laws.library import find_effect
from twin.laws.properties import evaluate_law, is_linear_in_rate
from twin.model.config import ModelConfig, load_model_config
from twin.model.event_integrator import compile_laws
from twin.model.inverse_dynamics import forces_along
from twin.model.model import EffectInstance, Model
from twin.model.prepare import prepare_solver
from twin.model.solver import StateEstimate
from twin.model.valid_range import find_range_exits

HEADER = """title = "x"
[base]
stiffness_n_m = 36000.0
damping_n_s_m = 1100.0
bumper_stiffness_n_m = 510000.0
bumper_damping_n_s_m = 900.0
"""
K = (
    "[parameters.k]\nunit = '{unit}'\nlow = -1e15\nhigh = 1e15\nvanishing = 0.0\n"
    "typical = {typical}\n"
)
TAU = "[parameters.tau]\nunit = 's'\nlow = 1e-4\nhigh = 100.0\ntypical = 0.05\n"
CUBIC = "id = 'own_cubic'\nforce = 'k * u**3'\n" + K.format(unit="N/m3", typical=1e7)
DEEP = "id = 'deep'\nplace = 'bumpers'\nforce = 'k * d * abs(d)'\n" + K.format(
    unit="N/m2", typical=1e8
)
BRANCH = (
    "id = 'branch'\nforce = 'f'\n[states.f]\nunit = 'N'\nrate = 'k * v - f / tau'\n"
    + K.format(unit="N/m", typical=8e3)
    + TAU
)
TILT = "id = 'lean'\nplace = 'input'\nforce = 'k * y'\n" + K.format(unit="1/s2", typical=1.0)


def read_effect(text):
    return parse_toml(text, EffectFile, "effect file").build_effect()


def add(effect, **values):
    instance = EffectInstance.create(effect, values)
    return Model(SNM.base, (instance,))


def simulate(model, level=1.0, frequency=3.0, seconds=4.0):
    """Run a model under a growing sine at 1 kHz; return its outputs."""
    time = np.arange(round(seconds * 1000)) / 1000
    drive = level * time / seconds * np.sin(2 * np.pi * frequency * time)
    solver = prepare_solver(model, 1000.0)
    out = np.empty((7, time.size))
    solver.advance(solver.rest_state(), drive, -drive / (2 * np.pi * frequency) ** 2, out)
    return out


class TestGrammar:
    @pytest.mark.parametrize(
        "text",
        [
            "__import__('os').system('true')", "u.real", "u[0]", "[u]", "(lambda: u)()",
            "u if u else v", "'u'", "True", "u and v", "u < v", "abs(*u)", "abs(x=u)", "max(u)",
            "w", "exec(u)", "u := v", "1e999 * u", "u" + " + u" * 200, "-" * 40 + "u", "u @ v",
            "u // v", "~u", "f'{u}'", "u\nv", "",
        ],
    )  # fmt: skip
    def test_parse_expression_refuses_other_syntax(self, text):
        with pytest.raises(InputError) as caught:
            parse_expression(text, ["u", "v"])
        assert caught.value.allowed

    @pytest.mark.parametrize("name", FUNCTIONS)
    def test_the_function_equals_the_array(self, name):
        count = FUNCTIONS[name][2]
        text = f"2 * {name}({', '.join(['u', 'v'][:count])}) - u**3 / 7 + -v**2"
        expression = parse_expression(text, ["u", "v"])
        function = build_function(f"def f(u, v):\n    return {expression.write_source({})}")
        for u, v in ((0.3, 0.7), (1.2, -0.4), (0.0, 0.1)):
            if name == "log" and u == 0.0:
                continue
            assert function(u, v) == pytest.approx(float(expression.evaluate({"u": u, "v": v})))

    @pytest.mark.parametrize(("zero", "side"), [(0.0, 1.0), (-0.0, -1.0)])
    def test_the_sign_of_a_zero_is_its_side_in_every_form(self, zero, side):
        expression = parse_expression("sign(u)", ["u"])
        function = build_function(f"def f(u):\n    return {expression.write_source({})}")
        assert function(zero) == side
        assert jit_helper()(function)(zero) == side
        assert expression.evaluate({"u": np.array([zero])}) == [side]

    @pytest.mark.parametrize(
        ("unit", "dimension"),
        [("N s2/m2", (1, -1, 0)), ("", (0, 0, 0)), ("1/s", (0, 0, -1)), ("N/m3", (1, -2, -2))],
    )
    def test_parse_unit_returns_the_dimension(self, unit, dimension):
        assert parse_unit(unit) == dimension

    @pytest.mark.parametrize(
        ("force", "key"),
        [
            ("k * u**2", "force"), ("k * u**3 + u", "force"), ("k * tanh(u)", "force"),
            ("k * u**k", "force"), ("k * u**3 + max(u, v)", "force"), ("k * u**4 / u", "force"),
            ("k * z", "force"),
        ],
    )  # fmt: skip
    def test_a_wrong_unit_or_value_names_the_key(self, force, key):
        with pytest.raises(InputError) as caught:
            read_effect(CUBIC.replace("k * u**3", force))
        assert key in str(caught.value.faults[0])
        assert caught.value.faults[0].remedy

    def test_a_law_that_feeds_energy_is_no_damper(self):
        text = "id = 'x'\ndissipates = true\nforce = '-k * v'\n" + K.format(
            unit="N s/m", typical=9.0
        )
        with pytest.raises(InputError):
            read_effect(text)
        read_effect(text.replace("-k", "k"))


class TestRefusals:
    """What a stranger's file must not do, each found by trying."""

    @pytest.mark.parametrize(
        ("old", "new"),
        [
            ("own_cubic", "cubic_stiffness"),
            ("k * u**3", "k * u**3 + 1e5 * u * (k / k)"),
            ("k * u**3", "-k*u*1" + "0" * 320),
            ("k * u**3", "u" + ".a" * 400),
            ("N/m3", "N/m" + "9" * 400),
            ("vanishing = 0.0", "vanishing = 1e16"),
            ("k * u**3", "k * (u / 1)**100000000000000000000000"),
        ],
    )
    def test_a_bad_file_is_one_message(self, old, new):
        with pytest.raises(InputError):
            read_effect(CUBIC.replace(old, new))

    def test_dry_friction_belongs_to_the_library(self):
        text = "id = 'dry'\nforce = 'k * sign(v)'\n" + K.format(unit="N", typical=9.0)
        with pytest.raises(InputError) as caught:
            read_effect(text)
        assert "coulomb_friction" in str(caught.value)

    def test_too_many_states_are_refused_before_they_are_read(self):
        states = "".join(f"[states.s{i}]\nunit = 'm'\nrate = 'v'\n" for i in range(3000))
        with pytest.raises(InputError):
            read_effect(CUBIC + states)

    def test_values_beyond_floats_are_one_message(self):
        text = "id = 'steep'\nforce = 'k * sinh(u / w)'\n" + K.format(unit="N", typical=1.0)
        text += "[parameters.w]\nunit = 'm'\nlow = 1e-9\nhigh = 1.0\ntypical = 0.1\n"
        model = add(read_effect(text), k=1.0, w=1e-7)
        with pytest.raises(InputError) as caught:
            prepare_solver(model, 1000.0)
        assert "steep" in caught.value.where

    def test_growing_states_are_refused(self):
        text = BRANCH.replace("- f / tau", "+ f / tau")
        model = add(read_effect(text), k=1.0, tau=1e-3)
        with pytest.raises(InputError):
            prepare_solver(model, 1000.0)

    @pytest.mark.parametrize("name", ["../own.toml", "/dev/zero", "a\\u0000b", "sub/own.toml", ""])
    def test_a_model_names_files_next_to_it_only(self, tmp_path, name):
        folder = tmp_path / "models" / "sub"
        folder.mkdir(parents=True)
        for place in (tmp_path, folder):
            (place / "own.toml").write_text(CUBIC)
        model = tmp_path / "models" / "model.toml"
        model.write_text(f'{HEADER}[[effects]]\nfile = "{name}"\nparameters = {{ k = 1.0 }}\n')
        with pytest.raises(InputError):
            load_model_config(model)

    def test_a_recorded_text_is_a_model_file(self, tmp_path):
        (tmp_path / "own.toml").write_text(CUBIC)
        entry = "[[effects]]\nfile = 'own.toml'\nparameters = { k = 2e7 }\n"
        (tmp_path / "model.toml").write_text(HEADER + entry)
        _, text = load_model_config(tmp_path / "model.toml")
        (tmp_path / "own.toml").unlink()
        (tmp_path / "model.toml").write_text(text)
        config, again = load_model_config(tmp_path / "model.toml")
        assert again == text
        assert config.effects[0].instance.values == {"k": 2e7}


class TestLaws:
    @pytest.mark.parametrize(
        ("text", "values", "library"),
        [
            (CUBIC, {"k": 3e7}, ("cubic_stiffness", {"k3": 3e7})),
            (DEEP, {"k": 2e8}, ("bumper_hardening", {"k2": 2e8})),
            (BRANCH, {"k": 9e3, "tau": 0.03}, ("maxwell_damper", {"k1": 9e3, "tau": 0.03})),
            (TILT, {"k": 9.80665 * 0.2}, ("table_tilt", {"tilt": 0.2})),
        ],
        ids=("damper", "bumpers", "state", "input"),
    )
    def test_a_written_law_moves_as_that_of_the_library(self, text, values, library):
        name, own = library
        written, built_in = add(read_effect(text), **values), SNM.with_effect(name, **own)
        difference = simulate(written) - simulate(built_in)
        scale = np.abs(simulate(built_in)).max(axis=1, keepdims=True)
        assert np.abs(difference / np.maximum(scale, 1e-12)).max() < 2e-4

    @pytest.mark.parametrize("contact", [-1, 0])
    def test_forces_on_arrays_equal_the_compiled_ones(self, contact):
        generator = np.random.default_rng(3)
        time = np.arange(2000) / 1000
        u = 4e-3 * np.sin(7 * time) + 1e-3 * np.sin(31 * time)
        v = np.gradient(u, 1e-3)
        acc = generator.normal(size=time.size)
        state = np.full((2, time.size), contact, dtype=np.int8)
        if contact == 0:
            state[0], state[1] = u > 0.002, u < -0.002
        for text, values, name, own in (
            (CUBIC, {"k": 3e7}, "cubic_stiffness", {"k3": 3e7}),
            (DEEP, {"k": 2e8}, "bumper_hardening", {"k2": 2e8}),
        ):
            model = add(read_effect(text), **values)
            expected = forces_along(SNM.with_effect(name, "", **own), u, v, acc, time, state)
            np.testing.assert_allclose(
                forces_along(model, u, v, acc, time, state), expected, rtol=1e-9, atol=1e-9
            )

    def test_the_same_text_is_the_same_effect_also_when_pickled(self):
        effect = read_effect(BRANCH)
        assert pickle.loads(pickle.dumps(effect)) == effect
        assert hash(pickle.loads(pickle.dumps(effect))) == hash(effect)
        _, rates = evaluate_law(effect, (4.0, 0.1))
        assert rates(0.0, 0.5, 0.0, 0.0, (2.0,)) == (-18.0,)
        assert read_effect(format_effect_file(effect)) == effect

    def test_laws_that_compute_the_same_are_compiled_once(self):
        """A study or a service fits the same laws to one recording after another."""
        plain = read_effect(CUBIC)
        ranged = read_effect(CUBIC + "[range]\nu = [-1e-3, 2e-3]\n")
        doubled = read_effect(CUBIC.replace("k * u**3", "2.0 * k * u**3"))
        assert plain is not ranged
        compiled = [compile_laws((effect,)) for effect in (plain, ranged, doubled)]
        assert compiled[0] is compiled[1]
        assert compiled[0] is not compiled[2]
        assert compile_laws((plain, doubled)) is not compile_laws((doubled, plain))


class TestModelFile:
    def test_a_law_is_found_next_to_the_model_and_kept_in_its_text(self, tmp_path):
        (tmp_path / "own.toml").write_text(CUBIC)
        entry = "[[effects]]\nfile = 'own.toml'\nparameters = { k = 2e7 }\n"
        (tmp_path / "model.toml").write_text(HEADER + entry)
        config, text = load_model_config(tmp_path / "model.toml")
        assert config.effects[0].instance.values == {"k": 2e7}
        (tmp_path / "own.toml").unlink()
        assert parse_toml(text, ModelConfig, "x").effects[0].effect == config.effects[0].effect

    @pytest.mark.parametrize(
        ("entry", "law"),
        [
            ("file = 'gone.toml'", None), ("file = 'own.toml'\nid = 'other'", CUBIC),
            ("file = 'own.toml'", CUBIC + "x = 1\n"), ("file = 'own.toml'", "x" * 200_000),
            ("parameters = { k = 1 }", None),
        ],
    )  # fmt: skip
    def test_a_bad_entry_is_one_message(self, tmp_path, entry, law):
        if law:
            (tmp_path / "own.toml").write_text(law)
        (tmp_path / "model.toml").write_text(f"{HEADER}[[effects]]\n{entry}\n")
        with pytest.raises(InputError):
            load_model_config(tmp_path / "model.toml")

    def test_an_unattached_law_says_so(self):
        with pytest.raises(InputError):
            parse_toml(HEADER + "[[effects]]\nfile = 'own.toml'\n", ModelConfig, "x")


def make_motion(u):
    return {"u": u, "v": 0.3 + 0 * u, "t": np.arange(u.size) / 1e3}


class TestRange:
    def test_the_first_sample_outside_is_found(self):
        effect = read_effect(CUBIC + "[range]\nu = [-1e-3, 2e-3]\n")
        u = np.array([0.0, 1e-3, 2.05e-3, 2.1e-3, -2e-3])
        (range_exit,) = find_range_exits(add(effect, k=1e7), make_motion(u))
        assert (range_exit.sample, range_exit.value) == (3, 2.1e-3)
        assert not [*find_range_exits(add(effect, k=1e7), make_motion(u[:3]))]

    def test_a_bumper_in_flight_is_inside(self):
        effect = read_effect(DEEP + "[range]\nd = [0.0, 1e-3]\n")
        gap = SNM.base.gap_r
        assert not [*find_range_exits(add(effect, k=1e8), make_motion(np.array([-0.5 * gap, gap])))]
        deep = make_motion(np.array([0.0, -gap - 1.1e-3]))
        (range_exit,) = find_range_exits(add(effect, k=1e8), deep)
        assert range_exit.sample == 1
        assert math.isclose(range_exit.value, 1.1e-3)


def test_a_bumper_law_that_its_values_leave_undefined_is_refused() -> None:
    effect = read_effect(
        DEEP.replace("abs(d)", "abs(d) * (2.0 - sqrt(1.0 - v / w))")
        + TAU.replace("tau", "w").replace("'s'", "'m/s'").replace("0.05", "50.0")
    )
    values = {"k": 1e8, "w": 0.9}
    constants = tuple(effect.work_out_constants(SNM.base.as_dict(), values).values())
    with pytest.raises(InputError, match="cannot be evaluated with these values"):
        is_linear_in_rate(effect, constants)


def test_a_law_that_divides_by_zero_has_no_number_there():
    """The state is lost as where any other value is not finite, and the clock goes on."""
    pole = "id = 'pole'\nforce = 'k * u / (u - w)'\n" + K.format(unit="N", typical=1.0)
    pole += "[parameters.w]\nunit = 'm'\nlow = 1e-6\nhigh = 1.0\ntypical = 0.001\n"
    solver, out = prepare_solver(add(read_effect(pole), k=1.0, w=0.001), 1000.0), np.zeros((7, 5))
    state = solver.restart_state(StateEstimate(3, 0.001, 0.0))
    solver.advance(state, np.zeros(5), np.zeros(5), out)
    assert np.isnan(out).all()
    assert np.isnan(state[:-1]).all()
    assert state[-1] == 8.0


@pytest.mark.parametrize("v0, base", [(0.0, 2.0), (0.0, -2.0), (-0.01, -2.0), (0.01, 2.0)])
@pytest.mark.parametrize("name, value", [("position_damping", 1e-3), ("coulomb_friction", 1e-9)])
def test_the_first_sample_keeps_its_velocity_in_either_direction(v0, base, name, value):
    """A vanishing law with reversals of u' starts as the model without it does."""
    effect = find_effect(name)
    own = add(effect, **{effect.parameters[0].name: value})
    drive, outs = np.full(20, -base), []
    for model in (SNM, own):
        solver, out = prepare_solver(model, 1000.0), np.empty((7, 20))
        start = StateEstimate(0, 0.0005, v0, base_acc=base)
        solver.advance(solver.restart_state(start), drive, drive, out)
        outs.append(out)
    assert outs[1][1] == pytest.approx(outs[0][1], rel=1e-5, abs=1e-9)
