"""Search by features: files, curves against other paths, planted truths, and no truth at all."""

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from table_io.config.base import PROFILES_DIR, load_config, parse_toml
from table_io.config.profile import Specimen
from table_io.errors import InputError
from tests.model.independent_solution import Witness
from twin.discovery.features.config import Feature, FeatureSet
from twin.discovery.features.continued_curve import (
    compute_curve,
    find_permanent_gap_mm,
    sweep_curve,
)
from twin.discovery.features.curve import find_folds_along
from twin.discovery.features.decide import choose_deciding_test
from twin.discovery.features.describing_function import approximate_curve
from twin.discovery.features.fit import FeatureFit, FeatureProblem, judge_model
from twin.discovery.features.prediction import compute_residuals, judge_feature
from twin.discovery.features.search import (
    FeatureDiscovery,
    list_feature_effects,
    rank_fits,
    run_base_job,
    run_effect_job,
)
from twin.discovery.features.task import judge_discovery
from twin.discovery.parameters import ParameterSet
from twin.dynamics.period_map import set_total_gap
from twin.model.config import ModelConfig
from twin.model.model import Model
from twin.model.parameters import Parameters

PAPER, TEXT = load_config(PROFILES_DIR / "features" / "paper.toml", FeatureSet, "features file")
SNM = Model(Parameters(550.0, 36e3, 1.1e3, 510e3, 900.0, 510e3, 900.0, 0.0, 0.0))
HEAD = """title = "t"
[specimen]
mass_kg = 550.0
[test]
acceleration_g = 0.05
start_hz = 0.5
end_hz = 10.0
step_hz = 0.1
"""


def make_set(*features: str) -> FeatureSet:
    blocks = [f'[[features]]\nplace = "here"\n{text}\n' for text in features]
    return parse_toml(HEAD + "\n".join(blocks), FeatureSet, "features.toml")


def make_feature(text: str) -> Feature:
    return make_set(text).features[0]


def test_every_feature_of_the_paper_has_its_place() -> None:
    assert len(PAPER.features) == 29
    assert all(f.place.startswith(("Sect.", "Sects.", "Fig.")) for f in PAPER.features)


@pytest.mark.parametrize(
    ("old", "new", "key"),
    [
        ("tolerance_hz = 0.06", "tolerance_mm = 0.06", "tolerance_mm"),
        ("value_hz = 1.27\n", "", "value_hz"),
        ('shape = "right"', 'shape = "wrong"', "features.3.shape"),
        ('kind = "contact"', 'kind = "touch"', "features.10.kind"),
        ("impacts = [3, 3]", "impacts = [1, 3]", "impacts"),
        ("at_least_mm = -2.0", "at_least_mm = 2.0", "at_least_mm"),
        ("gap_mm = 30.0\n", "", "gap_mm"),
        ("end_hz = 10.0", "end_hz = 0.1", "end_hz"),
        ("stiffness = [0.5, 1.5]", "stiffness = [1.1, 1.5]", "stiffness"),
        ("mass_kg", "mass_k", "mass_k"),
    ],
)
def test_a_fault_in_a_file_names_its_key(old: str, new: str, key: str) -> None:
    assert old in TEXT
    with pytest.raises(InputError, match=r"features\.toml") as error:
        parse_toml(TEXT.replace(old, new, 1), FeatureSet, "features.toml")
    assert key in str(error.value)


def test_the_base_has_the_curves_of_its_closed_form() -> None:
    """Numbers of the exact solver that are stated for the paper's model."""
    free = compute_curve(set_total_gap(SNM, math.inf), PAPER.test)
    g4 = compute_curve(set_total_gap(SNM, 0.004), PAPER.test)
    assert free is not None
    assert g4 is not None
    assert free.find_peak() == (pytest.approx(1.2678, abs=2e-3), pytest.approx(0.030537, rel=1e-3))
    middle, width = g4.measure_hysteresis()
    assert middle - width / 2 == pytest.approx(2.787, abs=1e-3)
    assert middle + width / 2 == pytest.approx(4.027, abs=1e-3)
    assert g4.interpolate(3.4, "forward")[0] == pytest.approx(5.12e-3, rel=0.01)
    assert g4.interpolate(3.4, "backward")[0] == pytest.approx(1.247e-3, rel=0.01)
    onset = find_permanent_gap_mm(SNM, -10.0, lambda model: compute_curve(model, PAPER.test))
    assert onset == pytest.approx(-4.265, abs=2e-3)


@pytest.mark.parametrize(
    ("model", "gap_mm"),
    [
        *((SNM, gap_mm) for gap_mm in (16.0, 4.0, 0.0, -1.0, -2.0, -10.0)),
        (SNM.with_effect("table_tilt", tilt=2.0), 4.0),
        (SNM.with_effect("table_tilt", tilt=2.0), -1.0),
    ],
)
def test_describing_functions_agree_with_continuation(model: Model, gap_mm: float) -> None:
    model = set_total_gap(model, gap_mm / 1e3)
    near = approximate_curve(model, PAPER.test.acceleration_m_s2)
    exact = compute_curve(model, PAPER.test)
    assert near is not None
    assert exact is not None
    assert exact.method == "continuation"
    assert near.find_peak() == pytest.approx(exact.find_peak(), rel=0.03)
    assert near.measure_hysteresis() == pytest.approx(exact.measure_hysteresis(), abs=0.05)


def test_a_sweep_finds_the_folds_to_within_its_steps() -> None:
    model = set_total_gap(SNM, 0.004)
    swept, followed = sweep_curve(model, PAPER.test), compute_curve(model, PAPER.test)
    assert swept is not None
    assert followed is not None
    (middle, width), (exact, exact_width) = (c.measure_hysteresis() for c in (swept, followed))
    assert middle == pytest.approx(exact, abs=2 * PAPER.test.step_hz)
    assert width == pytest.approx(exact_width, abs=3 * PAPER.test.step_hz)


def test_folds_of_a_curve_that_turns_back() -> None:
    assert find_folds_along(np.array([1.0, 2.0, 3.0])) is None
    assert find_folds_along(np.array([1.0, 3.0, 2.9, 3.1, 2.0, 4.0])) == (3, 4)


def test_distances_are_in_tolerances() -> None:
    peak = make_feature('kind = "peak_frequency"\ngap_mm = 0.0\nvalue_hz = 4.8\ntolerance_hz = 0.2')
    assert compute_residuals(peak, (5.0,), 0.1) == [pytest.approx(1.0)]
    assert judge_feature(peak, (math.nan,), 0.1, "continuation").distance == math.inf
    left = make_feature(
        'kind = "hysteresis"\ngap_mm = -1.0\nshape = "left"\ninside_hz = [6.0]\ntolerance_hz = 0.1'
    )
    assert judge_feature(left, (6.3, -0.5), 0.1, "").distance == pytest.approx(0.5)
    assert not judge_feature(left, (6.0, 0.5), 0.1, "").is_explained  # right, not left
    assert not judge_feature(left, (6.0, -0.05), 0.1, "").is_explained  # narrower than a step
    jump = make_feature(
        'kind = "jump_down_frequency"\ngap_mm = 4.0\nvalue_hz = 4.0\ntolerance_hz = 0.1'
    )
    assert judge_feature(jump, (3.5, 1.0), 0.1, "").is_explained
    assert judge_feature(jump, (4.0, 0.0), 0.1, "").distance == math.inf  # no jump at all


@pytest.fixture(scope="module")
def own_features() -> FeatureSet:
    """Features of the base itself, but with 15 % more bumper stiffness than the model is given."""
    return make_set(
        'kind = "peak_frequency"\ngap_mm = inf\nvalue_hz = 1.268\ntolerance_hz = 0.01',
        'kind = "peak_displacement"\ngap_mm = inf\nvalue_mm = 30.5\ntolerance_mm = 0.5',
        'kind = "peak_frequency"\ngap_mm = -10.0\nvalue_hz = 7.43\ntolerance_hz = 0.03',
        'kind = "hysteresis"\ngap_mm = -10.0\nshape = "none"\ntolerance_hz = 0.1',
    )


@pytest.mark.slow
def test_other_parameters_suffice_where_no_effect_is_missing(own_features: FeatureSet) -> None:
    problem = FeatureProblem.create(own_features, SNM)
    base = run_base_job(problem)
    assert (base.given.score, base.refitted.score) == (3, 4)
    stiffness = base.refitted.model.base.bumper_stiffness_r
    assert stiffness == pytest.approx(1.15 * 510e3, rel=0.02)


@pytest.mark.slow
def test_no_effect_is_needed_where_other_parameters_suffice(own_features: FeatureSet) -> None:
    problem = FeatureProblem.create(own_features, SNM)
    base = run_base_job(problem)
    effects, excluded = list_feature_effects(problem, without=["bouc_wen"])
    assert "gap_drift" in excluded
    assert excluded["bouc_wen"] == "left out of the library"
    fit = run_effect_job(problem, base, effects, effects.index("cubic_stiffness"))
    discovery = rank_fits(problem, base, [fit], excluded)
    assert discovery.best is base.refitted
    assert judge_discovery(discovery)[0] == "none needed"


def test_the_deciding_test_is_where_two_models_differ_most() -> None:
    """A stiffer bumper shows most where both are always in contact, not in free flight."""
    base = replace(SNM.base, bumper_stiffness_r=612e3, bumper_stiffness_l=612e3)
    test = choose_deciding_test(PAPER, SNM, Model(base))
    assert test is not None
    assert test.gap_mm < 0
    assert test.difference > 1
    assert choose_deciding_test(PAPER, SNM, SNM).difference == 0  # type: ignore[union-attr]


def drive_sine(level: float, w: float, t: float) -> float:
    return level * math.sin(w * t)


def search_effects(features: FeatureSet, *names: str) -> FeatureDiscovery:
    problem = FeatureProblem.create(features, SNM)
    base = run_base_job(problem)
    fits = [run_effect_job(problem, base, names, number) for number in range(len(names))]
    return rank_fits(problem, base, fits, {})


@pytest.mark.slow
def test_a_planted_hysteresis_is_named() -> None:
    """Amplitudes of free flight from the other code: its own equations, DOP853 with events."""
    truth = Model(replace(SNM.base, stiffness=33e3, damping=700.0, gap_r=math.inf, gap_l=math.inf))
    truth = truth.with_effect("bouc_wen", force=90.0, yield_displacement=1.5e-3)
    level = PAPER.test.acceleration_m_s2
    texts = []
    for hz in (0.9, 1.1, 1.25, 1.4, 1.6, 2.0, 2.6):
        times = np.arange(0, 30 / hz, 1 / (60 * hz))
        witness = Witness(truth, partial(drive_sine, level, 2 * math.pi * hz))
        u = witness.run(np.zeros(8), times, 1e-8)[0, -60:]
        amplitude = 1e3 * np.ptp(u) / 2
        texts.append(
            f'kind = "displacement"\ngap_mm = inf\nat_hz = {hz}\ndirection = "forward"\n'
            f"value_mm = {amplitude:.6g}\ntolerance_mm = {0.02 * amplitude:.3g}"
        )
    names = "quadratic_damping", "coulomb_friction", "bouc_wen"
    discovery = search_effects(make_set(*texts), *names)
    assert discovery.best.names == ("bouc_wen",)
    assert discovery.best.score == len(texts)
    assert discovery.base.refitted.score < len(texts)
    values = discovery.best.model.flatten()
    assert values["bouc_wen.force"] == pytest.approx(90.0, rel=0.1)
    assert values["bouc_wen.yield_displacement"] == pytest.approx(1.5e-3, rel=0.2)
    assert values["stiffness"] == pytest.approx(33e3, rel=0.02)


@pytest.mark.slow
def test_by_hand_a_hysteresis_turns_four_departures_into_agreements() -> None:
    """Damper hysteresis of 170 N and 0.2 mm, bumpers unchanged: what it gains, and the price."""
    base = replace(SNM.base, stiffness=35e3, damping=200.0)
    by_hand = Model(base).with_effect("bouc_wen", force=170.0, yield_displacement=2e-4)
    problem = FeatureProblem.create(PAPER, SNM)
    given, hand = (judge(problem, model) for model in (SNM, by_hand))
    pairs = list(zip(PAPER.features, given.predicted, hand.predicted, strict=True))
    gained = {f.gap_mm for f, a, b in pairs if b.is_explained and not a.is_explained}
    assert {-1.0, -2.0, -10.0, None} <= gained
    lost = {(f.gap_mm, f.kind) for f, a, b in pairs if a.is_explained and not b.is_explained}
    assert {(0.0, "peak_frequency"), (4.0, "jump_down_frequency")} <= lost
    assert hand.predicted[-1].quantities[0] == pytest.approx(-2.1, abs=0.05)


def judge(problem: FeatureProblem, model: Model) -> FeatureFit:
    return judge_model(problem, ParameterSet.from_model(model, 0))


@pytest.mark.slow
def test_the_shipped_card_explains_what_it_says() -> None:
    path = PROFILES_DIR / "models" / "paper_hysteresis.toml"
    card, _ = load_config(path, ModelConfig, "model file")
    model = card.build_model(Specimen(mass_kg=550.0, gap_mm=0.0))
    fit = judge(FeatureProblem.create(PAPER, SNM), model)
    assert fit.score == 25
    assert "25 of them" in card.provisional
    unexplained = {f.kind for f, p in zip(PAPER.features, fit.predicted, strict=True)
                   if not p.is_explained}  # fmt: skip
    assert unexplained == {"jump_down_frequency", "peak_displacement", "impacts", "peak_frequency"}
