"""Find, name, add, show: what is hidden in the simulated rig, in its own form, is named.

The whole study is `shaketwin study discovery`; here stands one case of each kind of verdict.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from table_io.block import Int1D, Label
from tests.discovery.played import SNM, format_truth, log, prepare_bare_log
from tests.input_errors import raises_input_error
from tests.recovery.recordings import log_columns, oscillator
from tests.studies.blind.oracle import fit_known_effects
from twin.discovery.discover import (
    Discovery,
    PreparedLog,
    discover_effects,
    prepare_problem,
)
from twin.discovery.evidence import build_evidence
from twin.discovery.localization import PHASES, build_cells, classify_phases, localize_excess
from twin.discovery.nuisances import resolve_samples
from twin.discovery.parameters import EffectKey
from twin.discovery.selection import FittedSet, SelectionProgress
from twin.discovery.sensor_checks import check_sensors
from twin.discovery.units import assign_folds
from twin.discovery.verdict import closed_fraction
from twin.evidence.selection import Cancelled, Explanation
from twin.evidence.verdict import SelectionVerdict, judge_selection
from twin.laws.library import EFFECTS

# What is left out where the library is not the subject: with the whole of it, it takes long.
FEW = ("table_tilt", "bumper_hardening", "cubic_stiffness", "coulomb_friction")
BUT_A_FEW = tuple(effect.id for effect in EFFECTS if effect.id not in FEW)


@cache
def discover(truth: str) -> Discovery:
    """What is discovered in the recording that hides a truth; not to be changed."""
    return discover_effects([log(truth)], SNM)


def test_where_nothing_is_hidden_nothing_is_named() -> None:
    discovery = discover("")
    assert discovery.verdict.outcome == "none"
    assert discovery.verdict.best.effects == ()
    assert 0.7 < discovery.prepared.problem.measure_misfit(discovery.selection.null) < 1.1


@pytest.mark.parametrize(
    ("truth", "key", "value"),
    [
        (format_truth("bumper_hardening", k2=3e7), EffectKey("bumper_hardening", "k2"), 3e7),
        pytest.param(
            format_truth("coulomb_friction", fc=30.0),
            EffectKey("coulomb_friction", "fc"), 30.0, marks=pytest.mark.slow,
        ),
        pytest.param(
            format_truth("maxwell_damper", k1=8e3, tau=0.05),
            EffectKey("maxwell_damper", "k1"), 8e3, marks=pytest.mark.slow,
        ),
        pytest.param(
            format_truth("gap_offset", offset=6e-4),
            EffectKey("gap_offset", "offset"), 6e-4, marks=pytest.mark.slow,
        ),
    ],
)  # fmt: skip
def test_an_effect_is_named_with_its_parameter(truth: str, key: EffectKey, value: float) -> None:
    discovery = discover(truth)
    verdict = discovery.verdict
    assert verdict.outcome == "named", verdict.reason
    assert verdict.best.names == (".".join(filter(None, (key.effect, key.channel))),)
    assert verdict.confidence > 0.9
    assert verdict.best.fit.values[key] == pytest.approx(value, rel=0.05)
    measure = discovery.prepared.problem.measure_misfit
    before, after = measure(discovery.selection.null), measure(verdict.best)
    assert closed_fraction(before, after, min(1.0, after)) > 0.95


@pytest.mark.slow  # 4 s
def test_two_effects_are_both_named() -> None:
    truth = format_truth("bumper_hardening", k2=3e7) + format_truth("coulomb_friction", fc=30.0)
    verdict = discover_effects([log(truth)], SNM).verdict
    assert verdict.outcome == "named"
    assert {*verdict.best.names} == {"bumper_hardening", "coulomb_friction"}


@pytest.mark.parametrize(
    "truth",
    [
        format_truth("cubic_damping", c3=3e4),
        pytest.param(format_truth("quintic_bumper", coefficient=2e14), marks=pytest.mark.slow),
        pytest.param(format_truth("position_friction", coefficient=5e3), marks=pytest.mark.slow),
    ],
)
def test_what_is_not_in_the_library_is_unexplained(truth: str) -> None:
    discovery = discover_effects([log(truth)], SNM)
    assert discovery.verdict.outcome == "unexplained"
    assert discovery.verdict.place
    # of the sets that do not explain it, none predicts held-out steps better
    problem, closest = discovery.prepared.problem, discovery.verdict.best
    for each in discovery.selection.tried:
        assert problem.leaves_noise(each) or not problem.is_worthwhile(closest, each)


NEW_EFFECTS = [
    ("stribeck_friction", {"fc": 10.0, "ratio": 6.0, "speed": 0.02}, "fc", 0.1),
    ("position_damping", {"cu": 2e7}, "cu", 0.05),
    ("appendage", {"mass": 5.0, "frequency": 6.0, "damping_ratio": 0.02}, "mass", 0.05),
    ("bumper_cubic", {"kc": 2e9}, "kc", 0.05),
]


@pytest.mark.slow  # 4 s each
@pytest.mark.parametrize(("effect", "planted", "parameter", "error"), NEW_EFFECTS)
def test_a_law_with_shapes_or_states_is_named(
    effect: str, planted: dict[str, float], parameter: str, error: float
) -> None:
    verdict = discover_effects([log(format_truth(effect, "", "", **planted))], SNM).verdict
    assert verdict.outcome == "named", verdict.reason
    assert verdict.best.names == (effect,)
    value = verdict.best.fit.values[EffectKey(effect, parameter)]
    assert value == pytest.approx(planted[parameter], rel=error)


@pytest.mark.slow  # 4 s
def test_a_bumper_that_pulls_is_named_though_it_acts_for_milliseconds() -> None:
    discovery = discover_effects([log(format_truth("adhesion", force=60.0))], SNM)
    assert discovery.verdict.outcome == "named", discovery.verdict.reason
    assert discovery.verdict.best.names == ("adhesion",)
    force = discovery.verdict.best.fit.values[EffectKey("adhesion", "force")]
    assert force == pytest.approx(60.0, rel=0.1)
    residuals = discovery.prepared.problem.log_residuals[0]
    # the low pass smears the last sample of each release: a tenth of the squares remains
    for name in ("right pull", "left pull"):
        mask = residuals.entry_row == residuals.rows.index(name)
        before = discovery.selection.null.held_out[0][mask]
        after = discovery.verdict.best.held_out[0][mask]
        assert np.mean(before**2) > 100.0
        assert np.mean(after**2) < 0.15 * np.mean(before**2)


def test_a_bumper_that_pulls_is_seen_without_adhesion_in_the_library() -> None:
    truth = format_truth("adhesion", force=60.0)
    discovery = discover_effects([log(truth)], SNM, without=("adhesion",))
    assert discovery.verdict.outcome == "unexplained", discovery.verdict.reason
    assert {"force_r1_n", "force_l1_n"} <= {*discovery.localization.channels}
    assert discovery.localization.phase == "contact_both"
    assert sum("bumper pulls" in note for note in discovery.notes) == 2


def test_a_misfit_in_the_few_samples_of_contact_is_not_noise() -> None:
    discovery = discover_effects([log(format_truth("bumper_hardening", k2=3e7), noise=28.0)], SNM)
    expected = discovery.prepared.problem.expected_square
    assert discovery.selection.null.cost < 1.3 * expected  # of all rows together: as noise may be
    assert discovery.verdict.outcome in ("named", "ambiguous")
    assert "bumper_hardening" in discovery.verdict.best.names


def test_a_bumper_is_judged_by_the_contact_rows_beside_a_dominant_effect() -> None:
    truth = format_truth("table_tilt", tilt=10.0) + format_truth("bumper_hardening", k2=3e7)
    selection = discover_effects([log(truth, noise=20.0)], SNM, without=BUT_A_FEW).selection
    assert {*selection.best.names} == {"table_tilt", "bumper_hardening"}
    null, tilted = selection.null.cost, selection.tried[0].cost
    assert tilted - selection.best.cost < 0.02 * (null - selection.best.cost)  # of all rows: minor


@pytest.mark.slow  # 8 s
def test_a_hysteresis_is_named_and_not_the_friction_that_is_nearest_to_it() -> None:
    truth = format_truth("bouc_wen", force=60.0, yield_displacement=1e-3, exponent=1.0, beta=0.5)
    verdict = discover_effects([log(truth)], SNM).verdict
    assert verdict.best.names == ("bouc_wen",)


def test_a_fault_of_a_sensor_is_seen_by_the_other_sensor_and_named_by_no_force() -> None:
    truth = format_truth("sensor_gain", "mass_acc_m_s2", gain=1.04)
    discovery = discover(truth)
    assert discovery.verdict.outcome == "none", discovery.verdict.reason
    residuals, best = discovery.prepared.problem.log_residuals, discovery.verdict.best
    checks = check_sensors(residuals, best.fit, True)
    (gain,) = (check for check in checks if not check.is_healthy)
    assert (gain.kind, gain.channels) == ("gain", ("mass_disp_m", "mass_acc_m_s2"))
    assert gain.value == pytest.approx(0.04, abs=0.002)


def record_untared_damper(amplitude_m: float, seed: int) -> PreparedLog:
    """A component test: spring, dashpot, 50 N of friction, a force cell that was not tared."""
    rate_hz, frequency_hz, tare_n = 200.0, 2.0, 400.0
    draw = np.random.default_rng(seed)
    phase = 2 * np.pi * frequency_hz * np.arange(8 * rate_hz / frequency_hz) / rate_hz
    u, v = amplitude_m * np.sin(phase), 2 * np.pi * frequency_hz * amplitude_m * np.cos(phase)
    force = 1500.0 * u + 150.0 * v + 50.0 * np.sign(v) + tare_n
    columns = {
        "rel_disp_m": u + draw.normal(0.0, 2e-6, u.size),
        "damper_force_n": force + draw.normal(0.0, 1.0, u.size),
    }
    return log_columns(f"{1e3 * amplitude_m:g} mm", rate_hz, columns)


def test_a_channel_that_was_not_tared_hides_no_law() -> None:
    logs = [record_untared_damper(size, seed) for seed, size in enumerate((2e-3, 5e-3, 10e-3))]
    verdict = discover_effects(logs, oscillator(1e3, 1e2)).verdict
    assert verdict.outcome == "named", verdict.reason
    assert {*verdict.best.names} == {"sensor_offset.damper_force_n", "coulomb_friction"}
    values = verdict.best.fit.values
    assert values[EffectKey("coulomb_friction", "fc")] == pytest.approx(50.0, rel=0.05)
    offset = values[EffectKey("sensor_offset", "offset", "damper_force_n")]
    assert offset == pytest.approx(400.0, rel=0.02)


@pytest.mark.slow  # 20 s
def test_without_the_truth_in_the_library_nothing_is_named_with_confidence() -> None:
    prepared = log(format_truth("coulomb_friction", fc=30.0))
    discovery = discover_effects(
        [prepared], SNM, without=("coulomb_friction", "bouc_wen", "stribeck_friction")
    )
    assert discovery.verdict.outcome == "unexplained"


def test_the_place_of_the_disagreement() -> None:
    discovery = discover(format_truth("bumper_hardening", k2=3e7))
    assert discovery.localization.phase == "contact_both"
    assert "force_r1_n" in discovery.localization.channels
    assert sum(cell.excess * cell.count for cell in discovery.map_after) < 0.1 * sum(
        cell.excess * cell.count for cell in discovery.map_before
    )


def test_a_misfit_of_one_side_has_its_place_there() -> None:
    prepared = log()
    problem = prepare_bare_log()
    (residuals,) = problem.problem.log_residuals
    sampled = resolve_samples(residuals, problem.parameters)
    entries = np.random.default_rng(0).standard_normal(sampled.entry_row.size)
    entries[classify_phases(sampled) == PHASES.index("contact_left")] += 5.0
    cells = build_cells([sampled], [entries], 1.0)
    where = localize_excess([sampled], [entries], cells, [prepared.steps])
    assert where.phase == "contact_left"
    assert {"force_l1_n", "force_l2_n"} <= {*where.channels}


def test_a_motion_without_steps_has_a_place_too() -> None:
    """In flight, and within the band in which the table was driven."""
    prepared = log(format_truth("cubic_stiffness", k3=3e8))
    driven = [step.frequency_hz for step in prepared.steps]
    nowhere = np.full(prepared.signals.step.size, -1)
    discovery = discover_effects(
        [PreparedLog(replace(prepared.signals, step=nowhere), prepared.contact_n)],
        SNM,
        without=BUT_A_FEW,
    )
    assert discovery.localization.frequency_hz is not None
    low, high = discovery.localization.frequency_hz
    assert 0.8 * min(driven) < low < high < 5.5 * max(driven)  # with the fifth harmonic
    assert discovery.localization.channels == ("mass_acc_m_s2",)
    assert discovery.localization.direction == "both"


def test_what_all_probable_sets_share_is_named() -> None:
    discovery = discover(format_truth("bumper_hardening", k2=3e7))
    named, problem = discovery.selection, discovery.prepared.problem
    some = [effect for effect in problem.library if effect.name in ("gap_drift", "table_tilt")]
    sets = [replace(named.best, effects=(*named.best.effects, effect)) for effect in some]
    tried = (named.best, *sets)

    def judge(
        fitted: Sequence[FittedSet], probabilities: Sequence[float]
    ) -> SelectionVerdict[FittedSet]:
        explanations = tuple(
            Explanation(tuple(sorted(each.names)), "", probability)
            for each, probability in zip(fitted, probabilities, strict=True)
        )
        selection = replace(named, best=fitted[0], tried=tried, explanations=explanations)
        return judge_selection(problem, selection)

    shared = judge(sets, (0.6, 0.4))
    assert (shared.outcome, shared.best.names) == ("named", ("bumper_hardening",))
    assert shared.confidence == pytest.approx(1.0)
    apart = [replace(named.best, effects=(effect,)) for effect in some]
    tried = tuple(apart)
    open_verdict = judge(apart, (0.6, 0.4))
    assert open_verdict.outcome == "ambiguous"
    assert [fitted.names for fitted in open_verdict.alternatives] == [apart[1].names]


@pytest.mark.parametrize(("none", "outcome"), [(0.5, "ambiguous"), (0.005, "named")])
def test_an_effect_is_named_only_where_its_absence_is_excluded(none: float, outcome: str) -> None:
    discovery = discover(format_truth("bumper_hardening", k2=3e7))
    named = discovery.selection
    explanations = (
        Explanation(named.best.names, "", 1.0 - none), Explanation((), "", none)
    )  # fmt: skip
    selection = replace(named, explanations=explanations)
    verdict = judge_selection(discovery.prepared.problem, selection)
    assert verdict.outcome == outcome
    assert verdict.effects_confidence == pytest.approx(1.0 - none)


def test_a_stranger_beside_no_effect_is_unexplained_in_its_place() -> None:
    discovery = discover(format_truth("bumper_hardening", k2=3e7))
    named = discovery.selection
    explanations = (Explanation((), "bumpers", 0.97), Explanation((), "", 0.03))
    selection = replace(named, best=named.null, explanations=explanations)
    verdict = judge_selection(discovery.prepared.problem, selection)
    assert (verdict.outcome, verdict.place) == ("unexplained", "bumpers")
    assert "bumpers" in verdict.reason


@pytest.mark.slow  # 5 s
def test_several_logs_count_together() -> None:
    truth = format_truth("bumper_hardening", k2=1e7)
    both = discover_effects([log(truth), log(truth, gap_mm=2.0)], SNM).verdict
    alone = discover_effects([log(truth)], SNM).verdict
    assert both.best.names == alone.best.names == ("bumper_hardening",)
    key = EffectKey("bumper_hardening", "k2")
    assert both.best.fit.std_errors[key] < alone.best.fit.std_errors[key]


def test_short_logs_are_enough_together() -> None:
    """None of them has nine cycles or 1,000 samples of its own."""
    whole = log("")
    moving = np.flatnonzero(whole.signals.label != Label.REST)
    pieces = [shorten(whole, piece) for piece in np.array_split(moving, 24)[4:14:2]]
    with raises_input_error(where=pieces[0].signals.name, allowed="9 cycles"):
        prepare_problem(pieces[:1], SNM)
    with raises_input_error(allowed="in all logs together"):
        prepare_problem(pieces[:2], SNM)
    prepared = prepare_problem(pieces, SNM)
    assert prepared.first_fit.converged


def test_a_log_with_a_sensor_off_its_range_throughout_is_refused() -> None:
    whole = log()
    signals = replace(whole.signals, good=np.zeros_like(whole.signals.good))
    with raises_input_error(where=signals.name, allowed="at least 1000"):
        discover_effects([replace(whole, signals=signals)], SNM)


def shorten(whole: PreparedLog, samples: Int1D) -> PreparedLog:
    """The log with only these samples usable."""
    good = np.zeros_like(whole.signals.good)
    good[samples] = whole.signals.good[samples]
    return replace(whole, signals=replace(whole.signals, good=good))


def test_where_too_much_is_recorded_the_last_cycles_say_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    truth = format_truth("bumper_hardening", k2=3e7)
    whole = prepare_problem([log(truth)], SNM).problem.log_residuals[0]
    monkeypatch.setattr(
        "twin.discovery.residuals.MAX_SAMPLES", int(whole.motion().moving.sum()) // 2
    )
    discovery = discover_effects([log(truth)], SNM, without=BUT_A_FEW)
    (thin,) = discovery.prepared.problem.log_residuals
    assert thin.entry_row.size < 0.6 * whole.entry_row.size
    m = thin.motion()
    for step in np.unique(m.step[m.step >= 0]):
        cycles = np.unique(m.cycle[thin.row_mask[0] & (m.step == step) & (m.cycle >= 0)])
        held = m.cycle[m.step == step].max() + 1
        assert cycles.tolist() == list(range(held - max(held // thin.thinning, 2), held))
    assert discovery.verdict.best.names == ("bumper_hardening",)
    assert discovery.verdict.best.fit.values[EffectKey("bumper_hardening", "k2")] == pytest.approx(
        3e7, rel=0.05
    )
    assert any("only the last are used" in note for note in discovery.notes)


def test_linear_algebra_foresees_what_a_refit_finds() -> None:
    prepared = prepare_problem([log(format_truth("coulomb_friction", fc=5.0))], SNM)
    bench, start = prepared.problem, prepared.parameters
    linear = build_evidence(bench.log_residuals, start, bench.library, {})
    (column,) = linear.rank_states(1)[0].columns
    variant = linear.variants[column]
    assert variant.candidate.name == "coulomb_friction"
    amplitude = float(linear.estimate([column])[0][0])
    refitted = bench.refit(bench.fit_effects(start, ()), [(variant, amplitude)])
    entries = sum(residual.size for residual in refitted.held_out)
    kept = (bench.fit_effects(start, ()).fit.cost - refitted.fit.cost) * entries
    assert linear.measure_gain([column]) * linear.inflation == pytest.approx(kept, rel=0.05)


def test_no_step_is_judged_by_a_fit_that_saw_it() -> None:
    """A fold's fit does not change with the samples that it holds out."""
    prepared = prepare_problem([log()], SNM)
    (sheet,) = prepared.problem.log_residuals
    fold = assign_folds(sheet)
    steps = sheet.signals.step[sheet.entry_sample]
    held = steps >= 0
    for number in np.unique(steps[held]):
        assert np.unique(fold[held & (steps == number) & (fold >= 0)]).size == 1


@pytest.mark.slow  # 10 s
def test_the_oracle_is_not_far_better() -> None:
    prepared = log(format_truth("maxwell_damper", k1=8e3, tau=0.05))
    oracle = fit_known_effects([prepared], SNM, ["maxwell_damper"])
    assert oracle is not None
    discovery = discover_effects([prepared], SNM)
    # both over the noise of the sensors
    expected = prepare_problem([prepared], SNM).problem.measure_misfit(oracle)
    fitted = discovery.prepared.problem.measure_misfit(discovery.verdict.best)
    assert fitted <= 1.05 * expected


def test_whoever_has_enough_keeps_what_was_found() -> None:
    reports: list[SelectionProgress] = []

    def tell(progress: SelectionProgress) -> None:
        reports.append(progress)
        if progress.best is not None and progress.best.effects:
            raise Cancelled

    truth = format_truth("bumper_hardening", k2=3e7) + format_truth("coulomb_friction", fc=30.0)
    discovery = discover_effects([log(truth)], SNM, tell, BUT_A_FEW)
    assert not discovery.selection.complete
    best = reports[-1].best
    assert best is not None
    kept = discovery.verdict.best
    assert (kept.names, kept.cost) == (best.names, best.cost)
    assert best.cost < discovery.selection.null.cost
