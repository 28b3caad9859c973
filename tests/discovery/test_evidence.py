"""Evidence of sets of effects, in linear problems of known noise."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.stats import binom

from table_io.block import Float2D
from tests.discovery.played import prepare_bare_log
from twin.discovery import evidence
from twin.discovery.candidates import Candidate
from twin.discovery.evidence import build_evidence
from twin.discovery.law_terms import make_law_candidate
from twin.discovery.parameters import DAMPING, ParameterSet
from twin.discovery.residuals import LogResiduals
from twin.evidence.linear import (
    EFFECT_SHARE,
    UNKNOWN_ERROR_SHARE,
    LinearEvidence,
    Variant,
    cover_unknown_errors,
    softmax,
)
from twin.evidence.verdict import EXCLUDED_PROBABILITY
from twin.laws.terms import FAMILIES

ENTRIES, FORCE = 400, 100.0


@cache
def list_laws() -> tuple[Candidate, ...]:
    """Candidates of the library with one shape, which only lend their names."""
    library = prepare_bare_log().problem.library
    return tuple(law for law in library if len(law.shapes) == 1)


def build(columns: Float2D, residual: np.ndarray, noise: Float2D | None = None) -> LinearEvidence:
    """Evidence of columns, (column, entry), measured with products `noise` in excess."""
    count = len(columns)
    variants = tuple(Variant(law, (), 0) for law in list_laws()[:count])
    products = columns @ columns.T
    true = products if noise is None else products - noise
    scale = np.sqrt(np.diag(products))
    return LinearEvidence(variants, {}, true, products, -columns @ residual, scale, FORCE, 1.0, 1.0)


def draw(count: int, seed: int) -> Float2D:
    return np.random.default_rng(seed).standard_normal((count, ENTRIES))


def test_the_evidence_of_a_column_is_that_of_the_closed_form() -> None:
    """r = -a x + e: r is normal with covariance 1 + x x' / p, p the precision of a."""
    (x,), r = draw(1, 1), draw(1, 2)[0]
    p = float(x @ x) / (EFFECT_SHARE * FORCE) ** 2
    covariance = np.eye(ENTRIES) + np.outer(x, x) / p
    _, logdet = np.linalg.slogdet(covariance)
    expected = 0.5 * (r @ r - r @ np.linalg.solve(covariance, r)) - 0.5 * logdet
    assert build(np.array([x]), r).measure_set([0]) == pytest.approx(expected)


def test_no_set_has_two_laws_of_one_form_of_the_solver() -> None:
    """Their coefficients would be added: a relaxation time is no sum of two."""
    problem = prepare_bare_log().problem
    family = next(each for each in FAMILIES if each.name == "bumper_relaxation")
    laws = [each for each in problem.library if each.name in ("bumper_maxwell", "hunt_crossley")]
    laws.append(make_law_candidate(family, problem.log_residuals[0].scale))
    linear = build(draw(3, 5), draw(1, 6)[0])
    linear = replace(linear, variants=tuple(Variant(law, (), 0) for law in laws))
    pairs = [linear.names(state) for state in linear.rank_states(3) if len(state.columns) > 1]
    assert {*pairs} == {
        frozenset(("bumper_maxwell", "hunt_crossley")),
        frozenset(("law_bumper_relaxation", "hunt_crossley")),
    }


def test_a_planted_amplitude_is_found_within_its_deviation() -> None:
    columns, noise = draw(3, 3), draw(1, 4)[0]
    linear = build(columns, noise - 0.8 * columns[1])
    best, *others = linear.rank_states(2)
    assert best.columns == (1,)
    without = [each.log_evidence for each in others if 1 not in each.columns]
    assert best.log_evidence > max(without) + 10.0
    (amplitude,), (deviation,) = linear.estimate(best.columns)
    assert abs(amplitude - 0.8) < 3 * deviation
    assert deviation == pytest.approx(1 / np.sqrt(ENTRIES), rel=0.1)


@pytest.mark.parametrize(("share", "is_named"), [(0.001, False), (0.01, True)])
def test_what_unknown_errors_may_imitate_is_no_effect(share: float, is_named: bool) -> None:
    """Ten times the noise in a record of 10^4: certain by itself, but a tenth of a percent."""
    columns, noise = draw(3, 3), draw(1, 4)[0]
    force = 10.0 / 0.001
    amplitude = share * force / np.linalg.norm(columns[1])
    sure = replace(build(columns, noise - amplitude * columns[1]), force=force)
    unknown = cover_unknown_errors(
        sure.variants, sure.products, sure.scale, force, UNKNOWN_ERROR_SHARE
    )
    careful = replace(sure, covariance=sure.covariance + unknown)
    assert sure.rank_states(2)[0].columns == (1,)
    assert careful.rank_states(2)[0].columns == ((1,) if is_named else ())


def test_copies_of_the_null_are_named_no_more_often_than_stated() -> None:
    """The whole library and the stranger, on scores that the noise of a recording alone gives.

    The Bayes factor against the null is 1 on average where the null is true, so that no more than a
    share p of its copies leaves it a probability of p.
    """
    prepared = prepare_bare_log()
    problem = prepared.problem
    linear = build_evidence(problem.log_residuals, prepared.parameters, problem.library, {})
    size = np.sqrt(np.diag(linear.covariance))
    root = size[:, None] * np.linalg.cholesky(linear.covariance / np.outer(size, size))
    rng = np.random.default_rng(100)
    copies = 100
    probabilities = []
    for _ in range(copies):
        scores = root @ rng.standard_normal(size.size)
        states = replace(linear, scores=scores).rank_states(2)
        none = [not (state.columns or state.place) for state in states]
        probabilities.append(float(softmax(states)[none].sum()))
    for share in (EXCLUDED_PROBABILITY, 0.05):
        assert np.sum(np.array(probabilities) < share) <= binom.isf(0.001, copies, share)


def test_chance_is_named_no_more_often_than_stated() -> None:
    """Of 200 recordings of noise, few give any set more evidence than none."""
    columns = draw(8, 5)
    more = sum(
        build(columns, draw(1, 100 + seed)[0]).rank_states(2)[0].columns != ()
        for seed in range(200)
    )
    assert more <= 4


def test_a_column_that_is_noise_explains_nothing() -> None:
    """Its products with a residual of the same noise are large: on average by what is taken off."""
    noise = draw(1, 6)[0]
    column = np.array([noise])
    linear = build(column, -0.5 * noise, noise=np.array([[noise @ noise * (1 - 1e-6)]]))
    assert linear.measure_set([0]) < 1.0


def test_a_place_that_only_noise_reaches_is_no_unknown_force(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of two columns one is empty in the readings, but not in their copy with more noise."""

    def compute_forces(residuals: LogResiduals, parameters: ParameterSet) -> dict[str, list]:
        size = residuals.motion().u.size
        is_copy = residuals.fixed_noise is not None
        return {"here": [np.full((3, size), float(is_copy)), np.ones((3, size))]}

    monkeypatch.setattr(evidence, "compute_stranger_forces", compute_forces)
    prepared = prepare_bare_log()
    linear = build_evidence(prepared.problem.log_residuals, prepared.parameters, (), {})
    assert linear.places["here"].size == 1


def test_a_hat_without_samples_is_no_unknown_force(monkeypatch: pytest.MonkeyPatch) -> None:
    """What rounding leaves of it had an evidence of 10^24 on a measured motion."""

    def compute_forces(residuals: LogResiduals, parameters: ParameterSet) -> dict[str, list]:
        ones = np.ones((3, residuals.motion().u.size))
        return {"here": [1e-36 * ones, ones]}

    monkeypatch.setattr(evidence, "compute_stranger_forces", compute_forces)
    prepared = prepare_bare_log()
    linear = build_evidence(prepared.problem.log_residuals, prepared.parameters, (), {})
    assert linear.places["here"].size == 1
    assert linear.measure_set([], "here") < 10.0


def test_what_an_effect_stood_for_is_free_where_the_effect_is_gone() -> None:
    """A dashpot with a short relaxation may take all damping: without it, the damping is no gain.

    Held at 0, as where noise alone presses it there, every set without the dashpot was excluded.
    """
    prepared = prepare_bare_log()
    problem, fitted = prepared.problem, prepared.parameters
    drained = fitted.with_values({DAMPING: 0.0})
    assert drained.values[DAMPING] == next(p for p in fitted.free if p.key == DAMPING).low
    library = [each for each in problem.library if each.name == "maxwell_damper"]
    gains = [
        max(linear.measure_gain([column]) for column, _ in enumerate(linear.variants))
        for linear in (
            build_evidence(problem.log_residuals, start, library, {}) for start in (fitted, drained)
        )
    ]
    assert gains[1] < gains[0] + 10.0
