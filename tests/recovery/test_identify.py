"""A planted truth, demanded back from recordings within the stated intervals."""

import math
import re
from functools import cache

import numpy as np
import pytest

from table_io.errors import InputError
from tests.recovery.recordings import FAR, TRUTH, make_noisy_blocks, prepare_log
from twin.discovery.cross_checks import fitted_gap
from twin.discovery.discover import prepare_problem
from twin.discovery.identify import IdentificationResult, identify_parameters
from twin.discovery.least_squares import FitResult, fit_parameters
from twin.discovery.parameters import (
    BUMPER_DAMPING,
    BUMPER_STIFFNESS,
    DAMPING,
    STIFFNESS,
    BaseKey,
    EffectKey,
    GapKey,
    ParameterKey,
    ParameterSet,
)
from twin.model.model import Model

SIGMA_OF_95_PERCENT = 1.96
TRUE_BASE: dict[ParameterKey, float] = {BaseKey(name): value for name, value in TRUTH.items()}
FLIGHT = (60.0, 60.0)  # gaps in mm that nothing reaches


@cache
def identify_wide_gaps() -> IdentificationResult:
    """From a start far off, with gaps that are each 0.4 mm wider than the log says."""
    blocks = make_noisy_blocks(0.01, 3, (2.4, 2.4))
    return identify_parameters([prepare_log(blocks)], [blocks], FAR)


def within(fit: FitResult, key: ParameterKey, value: float, sds: float = 3.5) -> bool:
    return abs(fit.values[key] - value) < sds * fit.std_errors[key]


def test_a_truth_far_from_the_start_is_found_within_its_intervals() -> None:
    joint = identify_wide_gaps().fit
    assert joint.converged
    assert joint.at_bound == ()
    for key, value in {**TRUE_BASE, GapKey(0): 4e-4}.items():
        assert within(joint, key, value), key
        size = 2.4e-3 if isinstance(key, GapKey) else value
        assert 0 < joint.std_errors[key] < 0.035 * size, key
    assert 0.8 < identify_wide_gaps().rms_over_noise < 1.05


def test_flight_contacts_and_onsets_agree() -> None:
    result = identify_wide_gaps()
    parts = {part.source: part.values for part in result.subsets}
    assert set(parts["free flight"]) == {STIFFNESS, DAMPING}
    assert set(parts["contact right"]) == {BUMPER_STIFFNESS, BUMPER_DAMPING, GapKey(0)}
    estimates = [(key, pair) for part in parts.values() for key, pair in part.items()]
    for key, (value, sd) in estimates:
        truth = {**TRUE_BASE, GapKey(0): 4e-4}[key]
        # a subset has the instruments of the joint fit, which that knows no better
        assert abs(value - truth) < max(4 * sd, result.fit.std_errors[key]), key
    kinds = {(gap.side, gap.kind) for gap in identify_wide_gaps().contact_gaps}
    assert kinds == {(s, k) for s in ("right", "left") for k in ("onset", "release")}
    for gap in identify_wide_gaps().contact_gaps:
        assert gap.value == pytest.approx(2.4e-3, abs=max(4 * gap.std_error, 8e-6)), gap.kind
    assert identify_wide_gaps().warnings == ()


def test_identified_windows_err_less_than_the_start_model() -> None:
    (pair,) = identify_wide_gaps().window_errors
    assert pair is not None
    before, after = pair
    assert after < 0.1
    assert before > 5 * after


def test_wrong_specimen_mass_is_reported() -> None:
    notes = " ".join(identify_wide_gaps().notes)
    assert "bumper_stiffness: " in notes


def test_log_without_contact_identifies_the_damper_only() -> None:
    blocks = make_noisy_blocks(0.01, 4, FLIGHT)
    result = identify_parameters([prepare_log(blocks, FLIGHT)], [blocks], FAR)
    for key in (STIFFNESS, DAMPING):
        assert within(result.fit, key, TRUE_BASE[key]), key
    assert result.fit.parameters.values[BaseKey("bumper_stiffness_r")] == 900e3
    assert any("K_j" in text for text in result.warnings)
    assert result.contact_gaps == ()


def test_two_logs_of_different_gaps_count_together() -> None:
    """The second states a gap that is wrong, the third touches nothing."""
    gaps = ((2.0, 2.0), (4.0, 4.0), FLIGHT)
    stated = ((2.0, 2.0), (4.3, 4.3), FLIGHT)
    blocks = [make_noisy_blocks(0.01, 5 + k, gap) for k, gap in enumerate(gaps)]
    logs = [
        prepare_log(b, gap, f"log{k}")
        for k, (b, gap) in enumerate(zip(blocks, stated, strict=True))
    ]
    result = identify_parameters(logs, blocks, FAR)
    for key, value in {**TRUE_BASE, GapKey(0): 0.0, GapKey(1): -3e-4}.items():
        assert within(result.fit, key, value), key
    alone = identify_parameters(logs[:1], blocks[:1], FAR)
    assert result.fit.std_errors[STIFFNESS] < 0.8 * alone.fit.std_errors[STIFFNESS]
    assert fitted_gap(result.problem.log_residuals[1], result.fit, "right") == pytest.approx(
        4e-3, abs=2e-5
    )
    assert any(text.startswith("log2: touches no bumper") for text in result.warnings)


def test_unequal_gaps_are_warned_of_with_the_right_sign() -> None:
    blocks = make_noisy_blocks(0.01, 6, (2.3, 1.7))
    result = identify_parameters([prepare_log(blocks)], [blocks], FAR)
    assert result.asymmetry is not None
    assert result.asymmetry[0] == pytest.approx(3e-4, abs=2e-5)
    (stated,) = [
        float(number)
        for text in result.warnings
        for number in re.findall(r"right \+([0-9.]+) mm", text)
    ]
    assert stated == pytest.approx(0.3, abs=0.02)


def test_a_changed_bumper_side_is_seen_between_the_parts() -> None:
    """The right cells read 10 % too much: a bumper, or an error that no laboratory has."""
    (block,) = make_noisy_blocks(0.01, 7)
    values = block.values.copy()
    values[4:6] *= 1.1
    changed = (type(block)(
        "meas", 0, block.rate_hz, block.channels, values, block.step, block.label, block.cycle
    ),)  # fmt: skip
    result = identify_parameters([prepare_log(changed)], [changed], FAR)
    assert any("gain of right" in text for text in result.warnings)


def test_an_effect_of_the_start_is_fitted_too() -> None:
    blocks = make_noisy_blocks(0.01, 8)
    start = FAR.with_effect("cubic_stiffness", k3=3e7)
    result = identify_parameters([prepare_log(blocks)], [blocks], start)
    assert within(result.fit, EffectKey("cubic_stiffness", "k3"), 0.0)
    assert within(result.fit, STIFFNESS, TRUTH["stiffness"])


def test_a_component_test_needs_no_balance() -> None:
    channels = ("rel_disp_m", "damper_force_n")
    blocks = make_noisy_blocks(0.01, 9, FLIGHT, channels)
    result = identify_parameters([prepare_log(blocks, FLIGHT)], [blocks], FAR)
    assert within(result.fit, STIFFNESS, TRUTH["stiffness"])
    assert result.window_errors == (None,)


def test_without_a_displacement_nothing_is_invented() -> None:
    blocks = make_noisy_blocks(0.01, 9, FLIGHT, ("table_acc_m_s2", "mass_acc_m_s2"))
    with pytest.raises(InputError, match="rel_disp_m"):
        prepare_log(blocks)


def test_too_short_a_log_is_refused() -> None:
    (block,) = make_noisy_blocks(0.01, 9)
    short = (block.cut(0, 3000),)
    with pytest.raises(InputError) as error:
        identify_parameters([prepare_log(short)], [short], FAR)
    assert error.value.remedy == (
        "record a longer test, every sensor within its range, or give several recordings of the "
        "specimen"
    )
    assert error.value.allowed is not None
    assert error.value.allowed.startswith("at least 1000")


def joint(noise: float, seed: int) -> FitResult:
    """Return the fit of the base to a noisy recording."""
    blocks = make_noisy_blocks(noise, seed)
    prepared = prepare_problem([prepare_log(blocks)], Model.from_flat({**FAR.flatten()}))
    return fit_parameters(prepared.problem.log_residuals, prepared.parameters)


@pytest.mark.slow  # 6 s
def test_intervals_cover_the_truth_at_their_level() -> None:
    """A handful: 95 % of 30 are 28.5, fewer than 25 come once in three hundred times."""
    hits = [
        abs(fit.values[key] - value) < SIGMA_OF_95_PERCENT * fit.std_errors[key]
        for noise in (0.01, 0.05)
        for seed in range(3)
        for fit in (joint(noise, 100 + seed),)
        for key, value in {**TRUE_BASE, GapKey(0): 0.0}.items()
    ]
    assert len(hits) == 30
    assert sum(hits) >= 25


def test_noise_of_the_motion_is_no_softening() -> None:
    """Errors of a regressor attenuate its slope: at 10 % samples made the bumpers too soft."""
    fits = [joint(0.1, 200 + seed) for seed in range(4)]
    errors = [fit.values[BUMPER_STIFFNESS] - TRUTH["bumper_stiffness"] for fit in fits]
    deviation = np.mean([fit.std_errors[BUMPER_STIFFNESS] for fit in fits])
    assert abs(np.mean(errors)) < 2.0 * deviation / math.sqrt(len(fits))


def test_parameters_without_data_keep_their_start() -> None:
    assert isinstance(identify_wide_gaps().start, ParameterSet)
    assert identify_wide_gaps().start.values[STIFFNESS] == 60e3
