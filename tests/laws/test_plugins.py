"""Effects of another package do all that those of the library do."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid
from scipy.optimize import brentq

from table_io.config.base import PROFILES_DIR
from table_io.errors import InputError
from tests.builders.rigs import read_model_text
from tests.discovery.played import SNM, format_truth, log
from tests.laws import laboratory_laws
from tests.model.cases import RATE_HZ, drive, noisy, typical
from tests.model.independent_solution import Witness
from tests.model.motion import sine
from tests.model.reference import snm
from tests.plugin_package import install_package
from twin.discovery.discover import discover_effects
from twin.discovery.parameters import EffectKey
from twin.dynamics.event_driven_map import make_period_map
from twin.laws.checks import check_effect
from twin.laws.effect import Effect, EffectParameter, State
from twin.laws.effect_file import EffectFile
from twin.laws.library import find_effect, load_plugins
from twin.model.inverse_dynamics import forces_along
from twin.model.model import EffectInstance, Model
from twin.model.prepare import prepare_solver
from twin.model.solver import StateEstimate

pytestmark = pytest.mark.usefixtures("forget_entry_points")

KICK = noisy(1.0)


@pytest.fixture(scope="module")
def package(tmp_path_factory) -> Path:
    """Install the laboratory's package; return the folder that holds it."""
    names = [name for name, item in vars(laboratory_laws).items() if isinstance(item, Effect)]
    return install_package(
        tmp_path_factory.mktemp("package"),
        "laboratory_package",
        Path(laboratory_laws.__file__).read_text(),
        {"shaketwin.effects": {name.lower(): f"laboratory_package:{name}" for name in names}},
    )


@pytest.fixture
def plugins(package, monkeypatch) -> None:
    monkeypatch.syspath_prepend(package)


def add(effect_id: str, base=None, **values: float) -> Model:
    effect = find_effect(effect_id)
    return Model(base or snm()).with_effect(effect_id, "", **(values or typical(effect)))


@pytest.mark.usefixtures("plugins")
class TestInstalled:
    def test_the_package_is_found(self):
        assert {effect.id for effect in load_plugins()} == {e.id for e in laboratory_laws.EFFECTS}

    def test_half_a_branch_of_ours_and_half_of_theirs_are_one(self):
        """Along a motion too, on which the mass meets a face that is still, and one that moves."""
        kb, tau = typical(find_effect("bumper_maxwell")).values()
        base = 2.0 * sine(2.6, RATE_HZ, 4.0)
        whole = SNM.with_effect("bumper_maxwell", "", kb=kb, tau=tau)
        halves = SNM.with_effect("bumper_maxwell", "", kb=0.5 * kb, tau=tau)
        halves = halves.with_effect("zener_bumper", "", kb=0.5 * kb, tau=tau)
        expected, out = (
            drive(model, base, StateEstimate(0, 0.0, 0.0))[1] for model in (whole, halves)
        )
        assert (np.abs(out - expected) <= 2e-6 * np.abs(expected).max(axis=1, keepdims=True)).all()
        u, v, _, right, left = expected[:5]
        time = np.arange(1, u.size + 1) / RATE_HZ
        touched = np.array([right > 0, left < 0])
        early = touched | np.roll(touched, -3, axis=1)  # as a filter makes of a measured contact
        unknown = np.full(touched.shape, -1)
        for contact in (touched, early, unknown):
            forces, own, plain = (
                forces_along(model, u, v, 0 * u, time, contact.astype(np.int8))
                for model in (whole, halves, SNM)
            )
            assert np.abs(own - forces)[1].max() < 0.02 * np.abs(plain - forces)[1].max()

    def test_one_law_on_each_side_is_the_law_on_both(self):
        both = Model(snm()).with_effect("bumper_hardening", k2=1e8)
        sides = Model(snm()).with_effect("hard_right", k2=1e8).with_effect("hard_left", k2=1e8)
        right = Model(snm()).with_effect("hard_right", k2=1e8)
        expected = drive(both, KICK)[1]
        assert np.abs(drive(sides, KICK)[1][0] - expected[0]).max() < 1e-9
        assert np.abs(drive(right, KICK)[1][0] - expected[0]).max() > 1e-6

    @pytest.mark.parametrize(
        ("effect", "values", "added"),
        [
            ("carried_mass", {"mass": 60.0}, lambda base, time: 60.0 * base),
            ("pulling_cable", {"rate": 80.0}, lambda base, time: 80.0 * time),
            (
                "dragged_floor", {"damping": 900.0},
                lambda base, time: 900.0 * cumulative_trapezoid(base, time, initial=0.0),
            ),
        ],
    )  # fmt: skip
    def test_a_law_of_base_acceleration_and_time_is_a_force_of_that_history(
        self, effect, values, added
    ):
        """Along with the forces on the same motion: M a + D + F_R + F_L = 0."""
        p, time = snm(), np.arange(KICK.size + 1) / RATE_HZ
        model = Model(p).with_effect(effect, "", **values)
        force = added(np.concatenate([[0.0], KICK]), time)[1:]
        expected = drive(Model(p), KICK + force / p.mass)[1]
        out = drive(model, KICK)[1]
        assert np.abs(out[0] - expected[0]).max() < 1e-6 * np.abs(expected[0]).max()
        assert np.abs(drive(Model(p), KICK)[1][0] - expected[0]).max() > 1e-2 * np.abs(out[0]).max()
        contact = np.array([out[3] > 0, out[4] < 0]).astype(np.int8)
        damper, right, left = forces_along(model, out[0], out[1], KICK, time[1:], contact)
        balance = p.mass * out[2] + damper + right + left
        assert np.abs(balance).max() < 1e-3 * np.abs(force).max()

    def test_time_is_that_of_the_run_after_a_restart(self):
        model = add("pulling_cable", rate=80.0).with_effect("ageing_bumper", rate=1e6)
        solver, whole = prepare_solver(model, RATE_HZ), np.empty((7, KICK.size))
        state, half = solver.rest_state(), KICK.size // 2
        solver.advance(state, KICK[:half], 0.01 * KICK[:half], whole[:, :half])
        u, v, _, right, left, u_r, u_l = whole[:, half - 1]
        start = StateEstimate(half, u, v, u_r, u_l, right > 0, left < 0, KICK[half - 1])
        restarted = solver.restart_state(start)
        parts = [np.empty((7, half)) for _ in range(2)]
        for at, part in zip((state, restarted), parts, strict=True):
            solver.advance(at, KICK[half:], 0.01 * KICK[half:], part)
        assert np.abs(parts[1][0] - parts[0][0]).max() < 1e-9

    def test_a_law_of_time_moves_the_equilibrium_and_has_no_steady_state(self):
        model = add("pulling_cable", rate=80.0)
        solver = prepare_solver(model, RATE_HZ)
        assert solver.rest_state(0)[0] == 0.0
        expected = -80.0 * 0.5 / model.parameters.stiffness
        assert solver.rest_state(round(0.5 * RATE_HZ))[0] == pytest.approx(expected, rel=1e-12)
        with pytest.raises(InputError) as error:
            make_period_map(model, 3.0, 0.5)
        assert "pulling_cable" in error.value.where

    @pytest.mark.parametrize("size", [1, 7, 64, 500])
    def test_blocks_of_any_size_give_the_same_bits(self, size):
        model = add("zener_bumper").with_effect("slip_damper", force=100.0, yield_displacement=1e-3)
        model = model.with_effect("cubic_bumper", kc=1e10).with_effect("ageing_bumper", rate=1e6)
        whole, out = drive(model, KICK)
        solver, cut = prepare_solver(model, RATE_HZ), np.empty_like(out)
        state = solver.rest_state()
        for first in range(0, KICK.size, size):
            part = KICK[first : first + size]
            solver.advance(state, part, 0.01 * part, cut[:, first : first + size])
        assert cut.tobytes() == out.tobytes()
        assert state.tobytes() == whole.tobytes()

    def test_more_plug_in_laws_than_allowed_are_refused(self):
        model = add("zener_bumper").with_effect("slip_damper", force=1.0, yield_displacement=1e-3)
        model = model.with_effect("zener_damper", k1=1.0, tau=1.0)
        prepare_solver(model.with_effect("dragged_floor", damping=1.0), RATE_HZ)
        crowded = model.with_effect("appendage", "", **typical(find_effect("appendage")))
        crowded = crowded.with_effect("dragged_floor", damping=1.0)
        with pytest.raises(InputError) as error:
            prepare_solver(crowded, RATE_HZ)
        assert error.value.allowed.startswith("at most 6")
        for extra in (
            "hard_right",
            "hard_left",
            "cubic_bumper",
            "pulling_cable",
            "ageing_bumper",
            "carried_mass",
            "position_damping",
            "dead_band",
            "stribeck_friction",
        ):
            model = model.with_effect(extra, "", **typical(find_effect(extra)))
        with pytest.raises(InputError) as error:
            prepare_solver(model, RATE_HZ)
        assert error.value.allowed.startswith("at most 16")
        with pytest.raises(InputError) as error:
            add("zener_bumper", base=snm(bumper_damping_r=0.0))
        assert "zener_bumper" in error.value.where

    @pytest.mark.parametrize(
        ("truth", "name", "parameter", "value", "without"),
        [
            pytest.param(
                format_truth("bumper_cubic", kc=2e9), "cubic_bumper", "kc", 2e9, ("bumper_cubic",),
                marks=pytest.mark.slow, id="bumper law",  # 20 s
            ),
            pytest.param(
                format_truth("maxwell_damper", k1=8e3, tau=0.05), "zener_damper", "k1", 8e3,
                ("maxwell_damper",), id="law with a state",
            ),
        ],
    )  # fmt: skip
    def test_discovery_names_it_with_its_parameter(self, truth, name, parameter, value, without):
        others = {effect.id for effect in laboratory_laws.EFFECTS} - {name}
        verdict = discover_effects([log(truth)], SNM, without=(*without, *others)).verdict
        assert verdict.outcome == "named", verdict.reason
        assert verdict.best.names == (name,)
        assert verdict.best.fit.values[EffectKey(name, parameter)] == pytest.approx(value, rel=0.05)


LAW = laboratory_laws.ZENER_BUMPER


@pytest.mark.parametrize(
    ("effect", "key", "words"),
    [
        (replace(LAW, force="", states={}), "force", "does nothing"),
        (replace(LAW, place="table"), "place", "no place"),  # type: ignore[arg-type]
        (replace(LAW, force=lambda w, c: c[0] * w), "force", "not an expression"),  # type: ignore[arg-type]
        (replace(LAW, force="b + kb * w"), "force", "'w' is unknown"),
        (replace(LAW, force="kb * b"), "force", "unit"),
        (replace(LAW, states={"b": State("N", "kb * d")}), "states.b.rate", "unit"),
        (
            replace(LAW, force="-kb * tau * v * tanh(d / (d - d))", states={}),
            "force", "not finite",
        ),
        (
            replace(LAW, force="-kb * tau * v * abs(tanh(v / abs(v)))"),
            "force", "not finite",
        ),
        (replace(LAW, force="kb * y", place="input"), "states", "no states"),
        (replace(LAW, break_away="kb * tau"), "break_away", "another place"),
        (replace(LAW, changes={"gap": "tau"}), "changes.gap", "no base parameter"),
        (replace(LAW, parameters=LAW.parameters[1:]), "parameters", "vanish"),
    ],
)  # fmt: skip
def test_law_that_cannot_work_is_refused_with_the_reason(effect, key, words):
    check_effect(LAW)
    with pytest.raises(InputError) as caught:
        check_effect(effect)
    assert caught.value.key == key
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("force", "words"),
    [("-k * v * abs(v) / s", "not linear in the rate"), ("k * s", "zero at deformation 0")],
)
def test_a_bumper_law_that_the_solver_cannot_integrate_is_refused(force, words):
    parameters = (
        EffectParameter("k", "N s/m", 0.0, 1e9, 0.0, 1.0),
        EffectParameter("s", "m/s", 1e-3, 1.0, None, 0.1),
    )
    with pytest.raises(InputError) as caught:
        check_effect(Effect(id="x", parameters=parameters, place="bumpers", force=force))
    assert words in str(caught.value)


class RateWitness(Witness):
    """Bumpers with a further push of their rate alone, whose free face moves without force."""

    def __init__(self, model, base, extra) -> None:
        super().__init__(model, base)
        self.extra = extra

    def bumper(self, side, d, dd, b):
        return super().bumper(side, d, dd, b) + self.extra(dd)

    def face(self, side, t, x):
        if self.contact[side]:
            return super().face(side, t, x)
        d = x[2 + side]
        fastest = -d * self.p.bumper_stiffness_r / self.p.bumper_damping_r
        if d < 1e-12:
            return d, fastest
        return d, brentq(lambda rate: self.bumper(side, d, rate, 0.0), 2.0 * fastest, 0.0)


@pytest.mark.parametrize(
    ("force", "unit", "k", "extra"),
    [
        ("k * v**3", "N s3/m3", 2e5, lambda v: 2e5 * v**3),
        pytest.param(
            "k * max(v, 0)", "N s/m", 2e3, lambda v: 2e3 * max(v, 0.0), marks=pytest.mark.slow
        ),
    ],
)
def test_a_bumper_whose_damping_is_not_linear_recovers_without_force(force, unit, k, extra):
    law = EffectFile.model_validate({
        "id": "rate_law", "place": "bumpers", "force": force,
        "parameters": {
            "k": {"unit": unit, "low": 0.0, "high": 1e7, "vanishing": 0.0, "typical": k}
        },
    })  # fmt: skip
    p, kick = snm(), KICK[:900]
    model = Model(p, (EffectInstance.create(law.build_effect(), {"k": k}),))
    out = drive(model, kick)[1]
    times = np.arange(kick.size + 1) / RATE_HZ
    samples = np.concatenate([[0.0], kick])
    witness = RateWitness(model, lambda t: float(np.interp(t, times, samples)), extra)
    expected = witness.run(np.zeros(8), times, 1e-9)
    assert witness.events > 4
    assert np.abs(out[0] - expected[0, 1:]).max() < 1e-6 * np.abs(out[0]).max()
    assert np.abs(out[5] - expected[2, 1:]).max() < 1e-4 * np.abs(out[5]).max()
    plain = drive(Model(p), kick)[1]
    assert np.abs(out[0] - plain[0]).max() > 1e-3 * np.abs(out[0]).max()


def test_simulate_command_accepts_plug_in_laws(package, tmp_path):
    """`simulate` with both kinds of law, in a process that finds the installed package."""
    snm_file = read_model_text("snm")
    model = tmp_path / "model.toml"
    model.write_text(
        snm_file
        + '\n[[effects]]\nid = "cubic_bumper"\nparameters = { kc = 1e10 }\n'
        + '\n[[effects]]\nid = "zener_damper"\n'
        + "parameters = { k1 = 8e3, tau = 0.05 }\n"
    )
    code = (
        f"import sys; sys.path.insert(0, {str(package)!r}); from twin.cli.table import main; "
        f"sys.exit(main())"
    )
    profile = tmp_path / "short.toml"
    quickstart = (PROFILES_DIR / "tests" / "quickstart.toml").read_text()
    profile.write_text(quickstart.replace("start_hz = 2.4", "start_hz = 4.2"))
    arguments = ["simulate", str(profile), "--model", str(model), "--out", str(tmp_path / "out")]
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out" / "summary.json").exists()
