"""A planted truth, demanded back from recordings within the stated intervals."""

from functools import cache

import numpy as np
import pytest

from table_io.errors import InputError
from tests.recovery.recordings import FAR, TRUTH, logged, recorded
from twin.identification.cross_checks import fitted_gap
from twin.identification.discover import prepare_problem
from twin.identification.identify import IdentificationResult, correct_bias, identify_parameters
from twin.identification.least_squares import FitResult, fit_parameters
from twin.identification.parameters import ParameterSet
from twin.model.model import Model

SURE = 1.96
FLIGHT = (60.0, 60.0)  # gaps in mm that nothing reaches


@cache
def found() -> IdentificationResult:
    """From a start far off, with gaps that are each 0.4 mm wider than the log says."""
    blocks = recorded(0.01, 3, (2.4, 2.4))
    return identify_parameters([logged(blocks)], [blocks], FAR)


def within(fit: FitResult, name: str, value: float, sds: float = 3.5) -> bool:
    return abs(fit.values[name] - value) < sds * fit.std_errors[name]


def test_a_truth_far_from_the_start_is_found_within_its_intervals() -> None:
    joint = found().fit
    assert joint.converged
    assert joint.at_bound == ()
    for name, value in {**TRUTH, "gap0": 4e-4}.items():
        assert within(joint, name, value), name
        assert 0 < joint.std_errors[name] < 0.01 * value, name
    assert np.sqrt(joint.cost) == pytest.approx(1.0, abs=0.03)


def test_flight_contacts_and_onsets_say_the_same_each_from_samples_of_its_own() -> None:
    parts = {part.source: part.values for part in found().subsets}
    assert set(parts["free flight"]) == {"stiffness", "damping"}
    assert set(parts["contact right"]) == {"bumper_stiffness", "bumper_damping", "gap0"}
    told = [(name, pair) for part in parts.values() for name, pair in part.items()]
    for name, (value, sd) in told:
        truth = {**TRUTH, "gap0": 4e-4}[name]
        assert abs(value - truth) < max(4 * sd, 0.003 * truth), name
    kinds = {(one.side, one.kind) for one in found().contact_gaps}
    assert kinds == {(s, k) for s in ("right", "left") for k in ("onset", "release")}
    for one in found().contact_gaps:
        assert one.value == pytest.approx(2.4e-3, abs=max(4 * one.std_error, 8e-6)), one.kind
    assert found().warnings == ()


def test_windows_restarted_from_the_measured_state_go_better_than_with_the_start() -> None:
    (pair,) = found().window_errors
    assert pair is not None
    before, after = pair
    assert after < 0.1
    assert before > 5 * after


def test_a_wrong_specimen_is_said() -> None:
    notes = " ".join(found().notes)
    assert "bumper_stiffness: " in notes


def test_a_log_that_never_touches_gives_the_damper_and_says_what_it_keeps() -> None:
    blocks = recorded(0.01, 4, FLIGHT)
    one = identify_parameters([logged(blocks, FLIGHT)], [blocks], FAR)
    for name in ("stiffness", "damping"):
        assert within(one.fit, name, TRUTH[name]), name
    assert one.fit.parameters.values["bumper_stiffness_r"] == 900e3
    assert any("K_j" in text for text in one.warnings)
    assert one.contact_gaps == ()


def test_two_logs_of_different_gaps_count_together() -> None:
    """The second states a gap that is wrong, the third touches nothing."""
    gaps = ((2.0, 2.0), (4.0, 4.0), FLIGHT)
    stated = ((2.0, 2.0), (4.3, 4.3), FLIGHT)
    blocks = [recorded(0.01, 5 + k, gap) for k, gap in enumerate(gaps)]
    logs = [
        logged(b, gap, f"log{k}") for k, (b, gap) in enumerate(zip(blocks, stated, strict=True))
    ]
    one = identify_parameters(logs, blocks, FAR)
    for name, value in {**TRUTH, "gap0": 0.0, "gap1": -3e-4}.items():
        assert within(one.fit, name, value), name
    alone = identify_parameters(logs[:1], blocks[:1], FAR)
    assert one.fit.std_errors["stiffness"] < 0.8 * alone.fit.std_errors["stiffness"]
    assert fitted_gap(one.problem.log_residuals[1], one.fit, "right") == pytest.approx(
        4e-3, abs=2e-5
    )
    assert any(text.startswith("log2: touches no bumper") for text in one.warnings)


def test_unequal_gaps_are_warned_of_with_the_right_sign() -> None:
    blocks = recorded(0.01, 6, (2.3, 1.7))
    one = identify_parameters([logged(blocks)], [blocks], FAR)
    assert one.asymmetry is not None
    assert one.asymmetry[0] == pytest.approx(3e-4, abs=2e-5)
    assert any("right +0.3" in text for text in one.warnings)


def test_a_changed_bumper_side_is_seen_between_the_parts() -> None:
    """The right cells read 10 % too much: right and left contacts do not say the same."""
    (block,) = recorded(0.01, 7)
    values = block.values.copy()
    values[4:6] *= 1.1
    changed = (type(block)(
        "meas", 0, block.rate_hz, block.channels, values, block.step, block.label, block.cycle
    ),)  # fmt: skip
    one = identify_parameters([logged(changed)], [changed], FAR)
    assert any(
        text.startswith("bumper_stiffness") and "contact right" in text for text in one.warnings
    )


def test_an_effect_of_the_start_is_fitted_too() -> None:
    blocks = recorded(0.01, 8)
    start = FAR.with_effect("cubic_stiffness", k3=3e7)
    one = identify_parameters([logged(blocks)], [blocks], start)
    assert within(one.fit, "cubic_stiffness.k3", 0.0)
    assert within(one.fit, "stiffness", TRUTH["stiffness"])


def test_a_component_test_needs_no_balance() -> None:
    channels = ("rel_disp_m", "damper_force_n")
    blocks = recorded(0.01, 9, FLIGHT, channels)
    one = identify_parameters([logged(blocks, FLIGHT)], [blocks], FAR)
    assert within(one.fit, "stiffness", TRUTH["stiffness"])
    assert one.window_errors == (None,)


def test_without_a_displacement_nothing_is_invented() -> None:
    blocks = recorded(0.01, 9, FLIGHT, ("table_acc_m_s2", "mass_acc_m_s2"))
    with pytest.raises(InputError, match="rel_disp_m"):
        logged(blocks)


def test_too_short_a_log_is_refused() -> None:
    (block,) = recorded(0.01, 9)
    short = (block.cut(0, 3000),)
    with pytest.raises(InputError) as error:
        identify_parameters([logged(short)], [short], FAR)
    assert error.value.remedy == "record a longer test"


def joint(noise: float, seed: int) -> tuple[FitResult, FitResult]:
    """(the fit as it is, cured)."""
    blocks = recorded(noise, seed)
    prepared = prepare_problem([logged(blocks)], Model.from_flat({**FAR.flatten()}))
    raw = fit_parameters(prepared.problem.log_residuals, prepared.parameters, prepared.problem.base)
    return raw, correct_bias(prepared.problem.log_residuals, raw)


def test_intervals_hold_the_truth_as_often_as_they_say() -> None:
    """A handful: 95 % of 60 are 57, fewer than 52 come once in a hundred times."""
    hits = [
        abs(one.values[name] - value) < SURE * one.std_errors[name]
        for noise in (0.01, 0.05)
        for seed in range(6)
        for one in (joint(noise, 100 + seed)[1],)
        for name, value in {**TRUTH, "gap0": 0.0}.items()
    ]
    assert len(hits) == 60
    assert sum(hits) >= 52


def test_noise_of_the_motion_is_no_softening() -> None:
    """At 10 % noise least squares makes the bumpers too soft by far; the cure takes it back."""
    pairs = [joint(0.1, 200 + seed) for seed in range(4)]
    truth = TRUTH["bumper_stiffness"]
    raw, mended = (np.mean([one[k].values["bumper_stiffness"] for one in pairs]) for k in (0, 1))
    assert raw < truth
    assert abs(mended - truth) < 0.5 * abs(raw - truth)


def test_a_guess_keeps_what_nobody_fitted() -> None:
    assert isinstance(found().start, ParameterSet)
    assert found().start.values["stiffness"] == 60e3
