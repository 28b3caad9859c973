"""Search of laws that the library lacks, on recordings of the simulated rig."""

import ast
import math
from dataclasses import replace

import numpy as np
import pytest

from tests.discovery.played import SNM, format_truth, idealize, imperfect_log, log, prepare_bare_log
from tests.recovery.recordings import log_columns, oscillator
from tests.studies.blind.law_study import find_law_of_base
from twin.discovery import law_search
from twin.discovery.discover import discover_effects, prepare_problem
from twin.discovery.law_search import (
    is_playable,
    list_new_terms,
    propose_law,
    search_laws,
    select_law,
)
from twin.discovery.law_terms import LAW_PREFIX, list_law_candidates, make_law_candidate
from twin.discovery.motion import RecordScale
from twin.discovery.parameters import EffectKey, ParameterSet
from twin.discovery.symbolic_regression import make_term
from twin.laws.effect_file import format_effect_file
from twin.laws.expression import parse_unit
from twin.laws.terms import FAMILIES


def search(truth):
    prepared = prepare_problem([log(truth)], SNM)
    null = prepared.problem.fit_effects(prepared.parameters, ())
    return prepared, null, search_laws(prepared.problem, null, null)


class TestTerms:
    def test_every_family_is_a_law_on_any_scale(self):
        prepared = prepare_bare_log()
        scale = prepared.problem.log_residuals[0].scale
        candidates = list_law_candidates(scale, has_contact=True)
        assert len({candidate.name for candidate in candidates}) == len(FAMILIES)
        for candidate in candidates:
            assert candidate.shapes
            assert candidate.amplitude.vanishing == 0.0

    @pytest.mark.parametrize("size", [1e-3, 1.0, 1e3])
    def test_specimens_of_any_size_have_every_family(self, size):
        scale = RecordScale(
            0.006 * size, 0.12 * size, 5.0 * size, 6e-5 * size, 3e3 * size, 0.02 * size, 1e-3, 2.0,
            {},
        )  # fmt: skip
        candidates = list_law_candidates(scale, has_contact=True)
        assert len(candidates) == len(FAMILIES)

    @pytest.mark.parametrize("family", [each for each in FAMILIES if each.compiled])
    def test_the_solvers_own_form_of_a_law_has_the_forces_of_its_expression(self, family):
        problem = prepare_bare_log().problem
        (residuals,), start = problem.log_residuals, prepare_bare_log().parameters
        law = make_law_candidate(family, residuals.scale)
        written = replace(law, effect=replace(law.effect, compiled={}))
        size, shape = law.amplitude.scale, law.shapes[len(law.shapes) // 2]
        none, fast, slow = (
            residuals.evaluate(each.add_to(start, shape, amplitude))
            for each, amplitude in ((law, 0.0), (law, size), (written, size))
        )
        assert np.linalg.norm(fast - none) > 100.0
        assert np.linalg.norm(fast - slow) < 0.01 * np.linalg.norm(fast - none)

    def test_a_law_that_the_model_has_in_the_solvers_form_is_offered_no_more(self):
        problem = prepare_bare_log().problem
        model = SNM.with_effect("bumper_maxwell", kb=1e5, tau=0.05)
        fit = problem.fit_effects(ParameterSet.from_model(model, 1), ())
        offered = [term.name for term in list_new_terms(problem, fit)]
        assert "law_bumper_relaxation" not in offered
        assert {"law_relaxation", "law_bumper_power"} <= {*offered}

    def test_a_law_that_the_solver_cannot_integrate_is_not_playable(self):
        problem, start = prepare_bare_log().problem, prepare_bare_log().parameters
        scale = problem.log_residuals[0].scale
        (term,) = [
            each
            for each in list_law_candidates(scale, True)
            if each.name.endswith("compression_damping")
        ]
        fitted = problem.fit_effects(start, ())
        size, shape = term.amplitude.scale, term.shapes[0]
        opposing, driving = (
            replace(
                fitted, effects=(term,),
                fit=replace(fitted.fit, parameters=term.add_to(start, shape, amplitude)),
            )
            for amplitude in (size, -size)
        )  # fmt: skip
        assert is_playable(problem, opposing)
        assert not is_playable(problem, driving)

    def test_laws_of_bumpers_need_contact(self):
        scale = prepare_bare_log().problem.log_residuals[0].scale
        free = list_law_candidates(scale, has_contact=False)
        assert all(
            candidate.effect and candidate.effect.place in ("damper", "input") for candidate in free
        )


class TestExpressions:
    """Symbolic regression, whose expressions become terms as all others."""

    def make(self, text, place="damper"):
        scale = prepare_bare_log().problem.log_residuals[0].scale
        u, v = np.random.default_rng(1).uniform(-1.0, 1.0, (2, 200))
        names = ["(u / u0)" if place == "damper" else "(d / d0)", "(v / v0)"]
        return make_term(place, ast.parse(text, mode="eval").body, names, [u, v], scale, 0)

    def test_coefficients_that_the_amplitude_holds_are_fixed(self):
        term = self.make("tanh(8.0 * X2) * abs(-3.0 * X1)")
        assert term is not None
        assert term.effect.force == "k * (tanh(c1 * (v / v0)) * abs(-c2 * (u / u0)))"
        assert [free.key.name for free in term.free] == ["k", "c1"]
        assert term.shapes == ((8.0,),)
        assert term.constants[EffectKey(term.name, "c2")] == 3.0

    def test_squares_are_powers(self):
        term = self.make("square(X1) * X2")
        assert term is not None
        assert term.effect.force == "k * ((u / u0) ** 2 * (v / v0))"

    def test_a_bumper_that_pushes_at_touch_is_no_law(self):
        assert self.make("X1 + 0.5", "bumpers") is None
        assert self.make("X1 * X1", "bumpers") is not None

    @pytest.mark.slow
    def test_an_expression_explains_what_no_family_does(self, monkeypatch):
        pytest.importorskip("pyoperon")
        monkeypatch.setattr(law_search, "list_law_candidates", lambda *_: ())
        prepared, null, fitted_sets = search(format_truth("cubic_damping", c3=4e4))
        assert fitted_sets[0].effects[-1].name.startswith("law_expression_")
        assert null.cost > 1.5 * prepared.problem.expected_square
        assert fitted_sets[0].cost < 1.1 * prepared.problem.expected_square


@pytest.mark.parametrize(
    ("truth", "name", "place"),
    [
        (format_truth("cubic_damping", c3=4e4), "law_damping_power", "damper"),
        pytest.param(
            format_truth("bumper_cubic", kc=2e11),
            "law_bumper_power",
            "bumpers",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_the_planted_law_is_the_best(truth, name, place):
    prepared, null, fitted_sets = search(truth)
    best = fitted_sets[0]
    effect = best.effects[-1].effect
    assert effect is not None
    assert best.effects[-1].name == name
    assert effect.place == place
    assert null.cost > 1.5 * prepared.problem.expected_square
    assert best.cost < 1.1 * prepared.problem.expected_square


def record_slipping_coupling(hz, seed):
    """Component test of friction, 10 kN, behind 2 mm of slack and 1.5 mm of yielding coupling.

    The load cell was not tared: it reads 1.2 kN without load.
    """
    rate_hz, slack, reach, friction, tare = 200.0, 2e-3, 3.5e-3, 1e4, 1.2e3
    draw = np.random.default_rng(seed)
    time_s = np.arange(6 * rate_hz / hz) / rate_hz
    u = np.concatenate([size * np.sin(2 * np.pi * hz * time_s) for size in (6e-3, 12e-3, 20e-3)])
    deflection, force = 0.0, np.zeros(u.size)
    for i, step in enumerate(np.diff(u, prepend=0.0)):  # beyond its reach the coupling slips
        deflection = min(max(deflection + step, -reach), reach)
        taken_up = max(abs(deflection) - slack, 0.0) / (reach - slack)
        force[i] = math.copysign(friction * taken_up, deflection)
    columns = {
        "rel_disp_m": u + draw.normal(0.0, 1e-6, u.size),
        "damper_force_n": force + tare + draw.normal(0.0, 50.0, u.size),
    }
    return log_columns(f"{hz:g} Hz", rate_hz, columns)


def list_terms(scale, *families):
    """The terms of these families alone."""
    names = {f"{LAW_PREFIX}{family}" for family in families}
    return [term for term in list_law_candidates(scale, has_contact=False) if term.name in names]


@pytest.mark.slow  # 9 s
def test_friction_behind_slack_is_distinguished_from_plain_hysteresis(monkeypatch):
    families = ("hysteresis", "slack_hysteresis", "constant_force", "even_spring")
    monkeypatch.setattr(
        law_search, "list_law_candidates", lambda scale, _: list_terms(scale, *families)
    )
    monkeypatch.setattr(law_search, "list_symbolic_candidates", lambda *_: ())
    logs = [record_slipping_coupling(hz, seed) for hz, seed in ((0.5, 1), (1.0, 2))]
    prepared = prepare_problem(logs, oscillator(1e5, 1e3))
    null = prepared.problem.fit_effects(prepared.parameters, ())
    fitted_sets = search_laws(prepared.problem, null, null)
    assert "law_slack_hysteresis" in fitted_sets[0].names
    plain = next(each for each in fitted_sets if each.names == ("law_hysteresis",))
    names = {"law_slack_hysteresis", "law_constant_force"}
    fitted = next(each for each in fitted_sets if {*each.names} == names)
    assert fitted.cost < 0.05 * null.cost
    assert fitted.cost < 0.2 * plain.cost
    values = fitted.fit.parameters.values
    assert values[EffectKey("law_slack_hysteresis", "k")] == pytest.approx(1e4, rel=0.05)
    assert values[EffectKey("law_slack_hysteresis", "w")] == pytest.approx(3.5e-3, rel=0.05)
    assert values[EffectKey("law_constant_force", "k")] == pytest.approx(1.2e3, rel=0.05)


@pytest.mark.slow  # 8 s
def test_a_term_that_stood_in_for_another_is_dropped(monkeypatch):
    """A resonator on the table looks like one on the specimen, until it is fitted itself."""
    monkeypatch.setattr(law_search, "FIRST_REFITS", 1)
    monkeypatch.setattr(
        law_search, "list_law_candidates",
        lambda scale, has_contact: list_terms(scale, "resonator", "table_resonator"),
    )  # fmt: skip
    truth = {"mass": 27.0, "frequency": 4.1, "coupling": 19e3}
    prepared = idealize(
        prepare_problem([log(format_truth("table_resonator", "", "", **truth))], SNM)
    )
    null = prepared.problem.fit_effects(prepared.parameters, ())
    fitted_sets = search_laws(prepared.problem, null, null)
    single = next(each for each in fitted_sets if each.names == ("law_table_resonator",))
    assert single.cost < 1.05 * fitted_sets[0].cost
    values = single.fit.parameters.values
    fitted = {key.name: value for key, value in values.items() if isinstance(key, EffectKey)}
    assert fitted["k"] == pytest.approx(truth["coupling"], rel=0.02)
    assert fitted["mass"] == pytest.approx(truth["mass"], rel=0.02)
    held = (2 * math.pi * truth["frequency"]) ** 2 + truth["coupling"] / truth["mass"]
    assert fitted["omega2"] == pytest.approx(held, rel=0.02)
    stand_in = [each for each in fitted_sets if each.names == ("law_resonator",)]
    proposal = select_law(prepared.problem, null, stand_in)
    assert proposal is not None
    (law,) = proposal.laws  # its state has the letter of the table's position
    assert {name for name, *_ in law.valid_range} == {"a", "v"} & law.used_names
    assert 'id = "law_resonator"' in format_effect_file(law)


def test_a_law_that_diverges_on_the_record_is_a_bad_fit_and_no_error():
    """Steps of many yield displacements a sample, to a high power, leave the range of numbers."""
    prepared = prepare_problem([record_slipping_coupling(1.0, 1)], oscillator(1e5, 1e3))
    (term,) = list_terms(prepared.problem.log_residuals[0].scale, "slack_hysteresis")
    yield_displacement = min(shape[2] for shape in term.shapes) / 4
    start = term.add_to(prepared.parameters, (4.0, 12.0, yield_displacement), 1e4)
    null = prepared.problem.fit_effects(prepared.parameters, ())
    diverged = prepared.problem.log_residuals[0].evaluate(start)
    assert np.isfinite(diverged).all()
    assert np.abs(diverged).max() > 1e20
    fitted = prepared.problem.fit_effects(start, (term,))
    assert math.isfinite(fitted.cost)
    assert fitted.cost > null.cost
    assert not prepared.problem.is_worthwhile(null, fitted)


@pytest.mark.slow  # 17 s
def test_a_law_is_found_beside_the_errors_of_instruments():
    prepared = prepare_problem([imperfect_log(format_truth("cubic_damping", c3=4e4))], SNM)
    problem, null, proposal = find_law_of_base(prepared)
    assert null.cost > 1.5 * problem.expected_square
    assert proposal is not None
    assert proposal.is_sufficient
    (law,) = proposal.laws
    (parameter,) = law.parameters
    assert "**3" in law.force
    assert parameter.typical == pytest.approx(4e4, rel=0.05)


@pytest.mark.slow
class TestProposal:
    @pytest.mark.parametrize("record", [log, imperfect_log])
    @pytest.mark.parametrize(
        ("truth", "exponent", "value", "unit"),
        [
            (format_truth("cubic_damping", c3=4e4), 3, 4e4, "N s3/m3"),
            (format_truth("even_stiffness", ke=1e6), 2, 1e6, "N/m2"),
        ],
    )
    def test_the_planted_law_is_written_with_its_number(self, truth, exponent, value, unit, record):
        proposal = propose_law(discover_effects([record(truth)], SNM))
        assert proposal is not None
        (law,) = proposal.laws
        (parameter,) = law.parameters
        assert f"**{exponent}" in law.force
        assert parse_unit(parameter.unit) == parse_unit(unit)
        assert parameter.typical == pytest.approx(value, rel=0.05)
        assert proposal.is_sufficient
        assert proposal.misfit < 1.1

    def test_nothing_hidden_proposes_nothing(self):
        assert propose_law(discover_effects([log()], SNM)) is None
