"""Design of the next test: what physics says of two explanations, the design finds by itself."""

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest

from table_io.block import Label
from table_io.config.base import format_toml
from table_io.errors import InputError
from table_io.safety.preflight import check_limits
from tests.discovery.played import idealize
from tests.laws.test_effect_files import read_effect
from twin.discovery import decisive_test
from twin.discovery.decisive_test import CandidateTest, list_candidate_tests
from twin.discovery.discover import PreparedLog, PreparedProblem, prepare_problem
from twin.discovery.evidence import build_evidence
from twin.discovery.experiment_design import (
    IdealTableMotion,
    Rival,
    add_hidden_effects,
    find_interval_ends,
    list_rivals,
    predict_separation,
    rank_tests,
    simulate_motion,
)
from twin.discovery.hidden_effects import (
    find_blind_spots,
    find_hidden_effects,
)
from twin.discovery.parameters import (
    DAMPING,
    STIFFNESS,
    EffectKey,
    GapKey,
    ParameterKey,
    ParameterSet,
)
from twin.discovery.selection import FittedSet, SelectionResult
from twin.discovery.signals import build_signals
from twin.discovery.verdict import DiscoveryVerdict, widen_for_form
from twin.evidence.linear import LinearEvidence
from twin.model.model import EffectInstance, Model
from twin.model.parameters import Parameters
from twin.model.prepare import prepare_solver
from twin.model.solver import OUTPUT_COUNT
from twin.setup.run_config import from_texts

SNM = Model(Parameters(550.0, 36e3, 1.1e3, 510e3, 900.0, 510e3, 900.0, math.inf, math.inf))
RATE_HZ = 1000.0
NOISE = {
    "table_disp_m": 2e-5, "table_acc_m_s2": 1e-2, "mass_disp_m": 2e-5, "mass_acc_m_s2": 1e-2,
}  # fmt: skip


def make_test(
    start_hz: float, stop_hz: float, level_g: float, cycles: int = 20, gap_mm: float = math.inf
) -> CandidateTest:
    """A stepped sine up a few frequencies, of a specimen without bumpers."""
    sweep = {
        "start_hz": start_hz, "stop_hz": stop_hz, "step_hz": (stop_hz - start_hz) / 4 or 1.0,
        "cycles": cycles, "acceleration_g": level_g, "directions": ["forward"],
    }  # fmt: skip
    text = format_toml(
        {
            "title": f"{start_hz:g} to {stop_hz:g} Hz, {level_g:g} g, {cycles} cycles",
            "specimen": {"mass_kg": 550.0, "gap_mm": gap_mm},
            "sweep": sweep,
            "acquisition": {"rate_hz": RATE_HZ, "rest_s": 1.0},
            "loop_check": {"enabled": False},
            "control": {"enabled": False},
        }
    )
    shipped = build_shipped()
    return CandidateTest(from_texts("t", text, shipped[0], shipped[1], "test"))


def build_shipped() -> tuple[str, str]:
    """Texts of the simulated rig and the shipped model."""
    from table_io.config.base import PROFILES_DIR

    folders = ("rigs", "simulated.toml"), ("models", "snm.toml")
    rig, model = ((PROFILES_DIR / folder / name).read_text() for folder, name in folders)
    return rig, model


def record_model(model: Model, motion: IdealTableMotion, noise_ratio: float = 1.0) -> PreparedLog:
    """Readings with noise of a specimen that is a model, on an ideal table."""
    block = motion.block
    table_disp, table_acc = (block.channel(name) for name in ("table_disp_m", "table_acc_m_s2"))
    solver, out = prepare_solver(model, RATE_HZ), np.empty((OUTPUT_COUNT, len(block)))
    solver.advance(solver.rest_state(-1), table_acc, table_disp, out)
    values = np.array([table_disp, table_acc, table_disp + out[0], out[2]])
    noise = np.random.default_rng(7).standard_normal(values.shape)
    values = values + noise_ratio * np.array([*NOISE.values()])[:, None] * noise
    measured = replace(block, channels=tuple(NOISE), values=values)
    return PreparedLog(build_signals((measured,), "first", 550.0, motion.gaps_m), 0.0)


@dataclass
class Recorded:
    """A recording of a model, as a problem, with fits of sets of effects."""

    prepared: PreparedProblem

    def fit(self, *names: str, **values: float) -> Rival:
        """Fit these effects, from these values of their parameters."""
        problem, start = self.prepared.problem, self.prepared.parameters
        effects = [next(c for c in problem.library if c.name == name) for name in names]
        for effect in effects:
            start = effect.add_to(start, effect.shapes[0])
        given: dict[ParameterKey, float] = {
            free.key: values[free.key.name]
            for effect in effects
            for free in effect.free
            if isinstance(free.key, EffectKey) and free.key.name in values
        }
        return Rival(" + ".join(names), problem.fit_effects(start.with_values(given), effects))


def record_first(
    model: Model, level_g: float = 0.05, cycles: int = 20, stop_hz: float = 2.0, noise: float = 1.0
) -> Recorded:
    """One frequency at one level, or more frequencies."""
    log = record_model(model, make_test(2.0, stop_hz, level_g, cycles).motion, noise)
    return Recorded(prepare_problem([log], SNM))


def record_ideal(model: Model, level_g: float = 0.05, cycles: int = 20) -> Recorded:
    """One frequency, by instruments that have noise alone."""
    return Recorded(idealize(record_first(model, level_g, cycles).prepared))


def linearize(recorded: Recorded, null: Rival) -> LinearEvidence:
    problem = recorded.prepared.problem
    return build_evidence(problem.log_residuals, null.fitted.fit.parameters, problem.library, {})


@pytest.fixture(scope="module")
def relaxing() -> Recorded:
    return record_first(SNM.with_effect("maxwell_damper", k1=12e3, tau=0.06))


def test_a_relaxing_branch_and_a_dashpot_separate_at_another_frequency(relaxing: Recorded) -> None:
    """At one frequency the branch is a stiffness and a dashpot; over frequency it is neither."""
    rivals = relaxing.fit("maxwell_damper", k1=12e3, tau=0.06), relaxing.fit()
    same, louder = make_test(2.0, 2.0, 0.05), make_test(2.0, 2.0, 0.1)
    wider = make_test(0.8, 4.0, 0.05, cycles=8)
    ranked = rank_tests(
        relaxing.prepared.problem, rivals, [test.motion for test in (same, louder, wider)]
    )
    by_name = {test.motion.name: test for test in ranked}
    assert ranked[0].motion.name == wider.title
    assert ranked[0].sigma > 4 * by_name[same.title].sigma
    assert ranked[0].probability > 0.95


def test_friction_and_quadratic_damping_separate_at_another_level() -> None:
    """Equivalent damping falls with the amplitude by the one, and rises by the other."""
    recorded = record_ideal(SNM.with_effect("coulomb_friction", fc=40.0))
    rivals = recorded.fit("coulomb_friction", fc=40.0), recorded.fit("quadratic_damping", c2=1e3)
    problem = recorded.prepared.problem
    same, louder = (
        predict_separation(problem, rivals, make_test(2.0, 2.0, level).motion)
        for level in (0.05, 0.2)
    )
    assert louder.sigma > 1.3 * same.sigma > 0


def test_a_model_is_not_separated_from_itself(relaxing: Recorded) -> None:
    rival = relaxing.fit("maxwell_damper", k1=12e3, tau=0.06)
    motion = make_test(0.8, 4.0, 0.05, cycles=8).motion
    prediction = predict_separation(relaxing.prepared.problem, (rival, rival), motion)
    assert prediction.pairs == ()
    twin = Rival("the same", rival.fitted, is_held=True)
    rival = replace(rival, is_held=True)
    prediction = predict_separation(relaxing.prepared.problem, (rival, twin), motion)
    assert [pair.sigma for pair in prediction.pairs] == [0.0, 0.0]
    assert prediction.probability < 1e-3


def hold_stiffness(recorded: Recorded, share: float) -> Rival:
    """The base model with its stiffness held at a multiple of the fitted one."""
    null = recorded.fit().fitted
    parameters = null.fit.parameters
    values = {**parameters.values, STIFFNESS: share * parameters.values[STIFFNESS]}
    free = tuple(own for own in parameters.free if own.key != STIFFNESS)
    return Rival(
        f"{share:g}", FittedSet((), replace(null.fit, parameters=ParameterSet(values, free))), True
    )


def test_what_a_refit_absorbs_separates_nothing() -> None:
    """A set whose stiffness is 5 % off, but free, is the same explanation."""
    recorded = record_first(SNM)
    free = recorded.fit()
    parameters = free.fitted.fit.parameters
    off = parameters.with_values({STIFFNESS: 1.05 * parameters.values[STIFFNESS]})
    fitted = replace(free.fitted, fit=replace(free.fitted.fit, parameters=off))
    motion = make_test(0.8, 4.0, 0.05, cycles=8).motion
    rivals = free, Rival("off", fitted, is_held=True)
    prediction = predict_separation(recorded.prepared.problem, rivals, motion)
    assert len(prediction.pairs) == 1
    assert abs(prediction.sigma) < 0.1
    (stepped,) = rank_tests(recorded.prepared.problem, rivals, [motion])
    assert abs(stepped.sigma) < 0.5


def test_the_separation_of_two_stiffnesses_is_the_closed_form() -> None:
    """Forces differ by dK u on the same motion: sum of squares n (dK U)^2 / 2, over the noise."""
    recorded = record_ideal(SNM)
    problem, share = recorded.prepared.problem, 2e-3
    rivals = hold_stiffness(recorded, 1.0), hold_stiffness(recorded, 1.0 + share)
    test = make_test(2.0, 2.0, 0.05, cycles=200)
    prediction = predict_separation(problem, rivals, test.motion)
    sigma = np.mean([pair.sigma for pair in prediction.pairs])
    k, c, m = 36e3, 1.1e3, 550.0
    w = 2 * math.pi * 2.0
    amplitude = m * 0.05 * 9.80665 / abs(k - m * w**2 + 1j * c * w)
    noise_n = m * NOISE["mass_acc_m_s2"]
    squares = RATE_HZ * 100.0 * (share * k * amplitude) ** 2 / 2 / noise_n**2
    assert sigma == pytest.approx(math.sqrt(squares) / 2, rel=0.2)


def test_the_separation_grows_with_the_root_of_the_time() -> None:
    recorded = record_ideal(SNM, cycles=10)
    rivals = hold_stiffness(recorded, 1.0), hold_stiffness(recorded, 1.002)
    short, long = (
        predict_separation(
            recorded.prepared.problem, rivals, make_test(2.0, 2.0, 0.05, cycles=cycles).motion
        )
        for cycles in (60, 240)
    )
    assert long.sigma / short.sigma == pytest.approx(2.0, rel=0.3)


def test_the_ends_of_a_wide_interval_are_rivals_and_a_narrow_one_has_none(
    relaxing: Recorded,
) -> None:
    fitted = relaxing.fit("maxwell_damper", k1=12e3, tau=0.06).fitted
    key = next(free.key for free in fitted.fit.free if str(free.key) == "maxwell_damper.k1")

    def with_error(share: float) -> FittedSet:
        errors = {
            free.key: share * fitted.fit.values[free.key] if free.key == key else 0.0
            for free in fitted.fit.free
        }
        return replace(fitted, fit=replace(fitted.fit, std_errors=errors))

    assert find_interval_ends(with_error(0.01)) == ()
    low, high = find_interval_ends(with_error(0.2))
    values = [end.fitted.fit.parameters.values[key] for end in (low, high)]
    expected = fitted.fit.values[key] * (1 + 1.96 * 0.2 * np.array([-1, 1]))
    assert values == pytest.approx(expected)
    assert low.is_held
    assert high.is_held


def test_the_ends_of_an_interval_keep_the_law_of_an_effect_file() -> None:
    text = """id = "own_cubic"
force = "k * u**3"
[parameters.k]
unit = "N/m3"
low = 0.0
high = 1e12
vanishing = 0.0
typical = 1e7
"""
    effect = read_effect(text)
    model = Model(SNM.base, (EffectInstance.create(effect, {"k": 2e8}),))
    test = make_test(2.0, 2.0, 0.05, cycles=10)
    problem = prepare_problem([record_model(model, test.motion)], model)
    fitted = problem.problem.fit_effects(problem.parameters, ())
    key = EffectKey("own_cubic", "k")
    assert fitted.fit.values[key] == pytest.approx(2e8, rel=0.05)
    errors = {free.key: 0.0 for free in fitted.fit.free} | {key: 0.2 * fitted.fit.values[key]}
    wide = replace(fitted, fit=replace(fitted.fit, std_errors=errors))
    rivals = find_interval_ends(wide)
    for rival, sign in zip(rivals, (-1.0, 1.0), strict=True):
        (instance,) = rival.fitted.fit.parameters.to_model().effects
        assert instance.effect is effect
        expected = fitted.fit.values[key] * (1.0 + sign * 1.96 * 0.2)
        assert instance.values["k"] == pytest.approx(expected)
    assert predict_separation(problem.problem, rivals, test.motion).sigma > 0.0


def test_an_effect_that_the_noise_hides_shows_at_a_higher_level() -> None:
    recorded = record_first(SNM, level_g=0.02)
    null = recorded.fit()
    problem = recorded.prepared.problem
    hidden = find_hidden_effects(linearize(recorded, null), null.fitted)
    rivals = (null, *add_hidden_effects(null.fitted, hidden))
    assert {"cubic_stiffness", "quadratic_damping"} <= {rival.name for rival in rivals}
    quiet, loud = make_test(2.0, 2.0, 0.02), make_test(2.0, 2.0, 0.2)
    ranked = rank_tests(problem, rivals, [quiet.motion, loud.motion])
    assert ranked[0].motion.name == loud.title
    assert ranked[0].is_confirmation
    assert ranked[0].probability > ranked[1].probability


def test_a_test_that_leads_a_sensor_out_of_its_range_is_not_proposed() -> None:
    """The higher level shows more, but the laser does not reach as far: with all rivals in view."""
    recorded = record_ideal(SNM, level_g=0.02)
    problem = recorded.prepared.problem
    rivals = (recorded.fit(), recorded.fit("quadratic_damping"), recorded.fit("coulomb_friction"))
    quiet, loud = make_test(2.0, 2.0, 0.02).motion, make_test(2.0, 2.0, 0.2).motion
    assert rank_tests(problem, rivals, [quiet, loud])[0].motion is loud
    peak_m = max(
        np.abs(block.channel("mass_disp_m")).max()
        for block in predict_separation(problem, rivals, loud).simulated.values()
    )
    for reach, expected in ((0.99, [quiet]), (1.01, [loud, quiet])):
        narrow = [
            replace(motion, allowed_peaks={"mass_disp_m": reach * peak_m})
            for motion in (quiet, loud)
        ]
        ranked = rank_tests(problem, rivals, narrow)
        assert [test.motion.name for test in ranked] == [motion.name for motion in expected]


def test_a_rival_too_fast_for_the_sampling_rate_is_refitted_but_not_simulated(
    relaxing: Recorded,
) -> None:
    """A branch that a fit made stiff and short: the solver refuses it, the other is simulated."""
    slow, branch = relaxing.fit("quadratic_damping"), relaxing.fit("maxwell_damper", tau=0.06)
    values: dict[ParameterKey, float] = {EffectKey("maxwell_damper", "tau"): 1e-9}
    parameters = branch.fitted.fit.parameters.with_values(values)
    fit = replace(branch.fitted.fit, parameters=parameters)
    fast = Rival("fast", replace(branch.fitted, fit=fit))
    test = make_test(2.0, 2.0, 0.1)
    with pytest.raises(InputError):
        simulate_motion(parameters, test.motion, relaxing.prepared.problem.log_residuals[-1])
    prediction = predict_separation(relaxing.prepared.problem, (slow, fast), test.motion)
    assert {*prediction.simulated} == {0}
    assert [(pair.truth, pair.other) for pair in prediction.pairs] == [(0, 1)]


def test_a_sweep_shows_what_a_noisy_test_at_one_frequency_cannot() -> None:
    """There a Maxwell branch is a spring and a dashpot, and that nothing is left proves nothing."""
    blind = []
    for stop_hz in (2.0, 4.0):
        recorded = record_first(SNM, stop_hz=stop_hz, noise=3.0)
        null = recorded.fit()
        spots = find_blind_spots(linearize(recorded, null), null.fitted)
        blind.append([effect.candidate.name for effect in spots])
    assert blind == [["maxwell_damper"], []]


def test_a_proposed_law_is_among_the_rivals(relaxing: Recorded) -> None:
    null, law = relaxing.fit().fitted, relaxing.fit("cubic_stiffness").fitted
    unexplained = DiscoveryVerdict("unexplained", null, 0.9, 0.9, (), True, "", "", 1.0)
    rivals = list_rivals(SelectionResult(null, null), unexplained, law)
    assert [rival.fitted for rival in rivals] == [null, law]


def test_intervals_hold_what_an_inexact_form_leaves(relaxing: Recorded) -> None:
    """Half of the residual squares: as much in each of the parameters, over their white errors."""
    best = relaxing.fit("maxwell_damper", k1=12e3, tau=0.06).fitted
    key = EffectKey("maxwell_damper", "k1", "")
    exact = DiscoveryVerdict("named", best, 0.9, 0.9, (), False, "", "", best.cost)
    unseen = widen_for_form(exact)
    assert unseen.best.fit.std_errors == best.fit.std_errors
    half = replace(exact, floor=best.cost / 2)
    widened = widen_for_form(half).best.fit
    count = sum(entries.size for entries in best.held_out)
    fitted = [STIFFNESS, DAMPING, key, replace(key, name="tau")]
    squares = best.cost * (1 - 1.05 / 2) * count / len(fitted)
    own = widened.std_errors[key] ** 2 - best.fit.std_errors[key] ** 2
    assert own == pytest.approx(squares * best.fit.white_errors[key] ** 2)
    stated = math.sqrt(0.05 * best.cost * count / len(fitted)) * best.fit.white_errors[key]
    assert unseen.form_errors[key] == pytest.approx(stated)
    assert GapKey(0) not in unseen.form_errors


@pytest.mark.parametrize("stroke_mm", [60.0, 5.0])
def test_every_candidate_is_within_the_limits_of_the_rig(stroke_mm: float) -> None:
    rig = build_shipped()[0].replace("stroke_mm = 60.0", f"stroke_mm = {stroke_mm}")
    recorded = make_test(1.0, 4.0, 0.02, gap_mm=4.0).config.make_start_factory("r", "table")(
        {}, 0.0
    )
    tests = list_candidate_tests(recorded, rig, 1.5, can_change_gap=True)
    assert tests
    for test in tests:
        check_limits(test.config.margins, test.config.profile, test.config.rig, test.title)
        assert max(demand.displacement_m for demand in test.config.margins) <= 1e-3 * stroke_mm
        assert test.minutes <= 1.5
        assert test.motion.allowed_peaks["mass_disp_m"] == pytest.approx(0.1 / 1.2)
    labels = tests[0].motion.block.label
    assert labels[0] == labels[-1] == Label.REST
    by_set_up = {test.set_up for test in tests}
    assert {"", "set: no bumpers", "set: total gap 2 mm"} <= by_set_up


def test_without_an_operator_no_gap_is_changed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(decisive_test, "LEVEL_RATIOS", (1.0, 1.0, 1.0, 1.0))
    rig = build_shipped()[0]
    recorded = make_test(2.0, 2.0, 0.02, gap_mm=4.0).config.make_start_factory("r", "table")(
        {}, 0.0
    )
    assert not any(test.set_up for test in list_candidate_tests(recorded, rig, 5.0))


def test_a_rig_that_can_play_nothing_has_no_candidates() -> None:
    rig = build_shipped()[0].replace("acceleration_g = 1.0", "acceleration_g = 0.0001")
    recorded = make_test(1.0, 4.0, 0.02).config.make_start_factory("r", "table")({}, 0.0)
    assert list_candidate_tests(recorded, rig, 10.0) == []
