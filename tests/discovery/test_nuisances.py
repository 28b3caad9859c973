"""Small errors of instruments and set-up: found as such, and no effect of the specimen."""

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from table_io.channels import LEFT_CELLS, RIGHT_CELLS
from tests.discovery.played import (
    ACC_GAIN,
    CELL_SHARE,
    SNM,
    TRUE,
    distort,
    format_truth,
    imperfect_log,
    log,
    prepare_bare_log,
)
from twin.discovery.discover import (
    PreparedProblem,
    discover_effects,
    prepare_problem,
)
from twin.discovery.nuisances import (
    ACCELEROMETERS,
    LASERS,
    MAX_SIZE,
    TYPICAL_GAIN,
    TYPICAL_LASER_OFFSET,
    TYPICAL_SHARE,
    correct_signals,
    linearize_nuisances,
    list_nuisance_parameters,
    list_nuisances,
    sensor_mask,
)
from twin.discovery.parameters import DAMPING, STIFFNESS, NuisanceKey, ParameterSet
from twin.discovery.residuals import Nuisance, build_log_residuals
from twin.discovery.signals import LogSignals


@cache
def explain_imperfect_log() -> PreparedProblem:
    return prepare_problem([imperfect_log()], SNM)


@cache
def prepare_quiet_log() -> PreparedProblem:
    return prepare_problem([log(noise=0.2)], SNM)


def without_cells(acc_noise: float = 1.0, laser_noise: float = 1.0) -> LogSignals:
    """Return signals without load cells, with noise of the sensors changed by factors."""
    signals = log(noise=0.2).signals
    spectra = {k: v for k, v in signals.spectra.items() if k not in (*RIGHT_CELLS, *LEFT_CELLS)}
    factors = dict.fromkeys(ACCELEROMETERS, acc_noise) | dict.fromkeys(LASERS, laser_noise)
    noise = {k: v * factors.get(k, 1.0) for k, v in signals.noise.items()}
    return replace(signals, spectra=spectra, noise=noise)


def nuisance_values(prepared: PreparedProblem) -> Mapping[NuisanceKey, float]:
    """Return the nuisances of the first log in typical sizes."""
    terms = prepared.problem.log_residuals[0].nuisances
    assert terms is not None
    values = terms.centre + terms.values(prepared.parameters)
    return dict(zip(terms.keys, map(float, values), strict=True))


def test_a_usual_laboratory_is_explained_by_its_instruments() -> None:
    prepared = explain_imperfect_log()
    assert prepared.first_fit.cost < 1.1 * prepared.problem.expected_square
    values = nuisance_values(prepared)
    share = (CELL_SHARE - 0.5) / TYPICAL_SHARE
    assert values[NuisanceKey(0, "share", "right")] == pytest.approx(share, rel=0.1)
    assert values[NuisanceKey(0, "share", "left")] == pytest.approx(-share, rel=0.1)
    gain = (ACC_GAIN - 1.0) / TYPICAL_GAIN
    assert values[NuisanceKey(0, "gain", "mass_acc_m_s2")] == pytest.approx(gain, abs=0.3)


def test_its_parameters_are_those_of_the_specimen() -> None:
    fit = explain_imperfect_log().first_fit
    for key, true in ((STIFFNESS, TRUE.stiffness), (DAMPING, TRUE.damping)):
        assert fit.values[key] == pytest.approx(true, rel=0.01)
        assert abs(fit.values[key] - true) < 4.0 * fit.std_errors[key]


def test_where_the_bumpers_always_touch_their_noise_is_no_gain_of_a_cell() -> None:
    """A force then differs from its law by its noise alone, which its gain would explain."""
    closed = log(gap_mm=0.0)
    prepared = prepare_problem([replace(closed, signals=distort(closed.signals))], SNM)
    gains = [nuisance_values(prepared)[NuisanceKey(0, "gain", side)] for side in ("right", "left")]
    # a gain of 0.5 % of both cells is 14 % of the stiffness of the damper
    assert max(map(abs, gains)) < 1.0
    assert prepared.first_fit.values[STIFFNESS] == pytest.approx(TRUE.stiffness, rel=0.2)


def test_no_effect_is_named_in_it() -> None:
    verdict = discover_effects([imperfect_log()], SNM).verdict
    assert verdict.outcome == "none"
    assert verdict.best.effects == ()


@pytest.mark.slow
def test_an_effect_is_named_in_it_with_its_parameter() -> None:
    truth = format_truth("bumper_hardening", k2=3e7)
    verdict = discover_effects([imperfect_log(truth)], SNM).verdict
    assert verdict.outcome == "named"
    assert verdict.best.names == ("bumper_hardening",)
    (k2,) = verdict.best.effects[0].free
    assert verdict.best.fit.values[k2.key] == pytest.approx(3e7, rel=0.05)


def test_unequal_cells_blame_no_cell_and_move_no_parameter() -> None:
    """The force balance cannot tell the gain of one cell from the way in which two share."""
    truth = format_truth("sensor_gain", "force_r1_n", gain=1.05)
    verdict = discover_effects([log(truth)], SNM).verdict
    assert verdict.outcome == "none"
    stiffness = verdict.best.fit.values[STIFFNESS]
    assert abs(stiffness - TRUE.stiffness) < 2.5 * verdict.best.fit.std_errors[STIFFNESS]


@pytest.mark.parametrize(
    "kind_and_place",
    [
        ("gain", "right"), ("gain", "table_acc_m_s2"), ("lag", "mass_acc_m_s2"),
        ("offset1", "mass_disp_m"),
        ("chebyshev3", "table_disp_m"), ("share", "left"), ("plate", "right"),
        ("cross", "mass_acc_m_s2"), ("gap", ""),
    ],
)  # fmt: skip
def test_a_column_is_the_effect_of_its_nuisance(kind_and_place: tuple[str, str]) -> None:
    """Signals corrected by one typical size change the residual by the column."""
    problem = prepare_quiet_log()
    parameters = problem.parameters
    residuals = linearize_nuisances(problem.problem.log_residuals[0], parameters)
    terms = residuals.nuisances
    assert terms is not None
    number = [(nuisance.kind, nuisance.place) for nuisance in terms.nuisances].index(kind_and_place)
    bare = replace(residuals, nuisances=None, motion_cache=[])
    corrected = correct_signals(residuals.signals, terms.nuisances[number], 1.0)
    before = bare.evaluate_rows(parameters, residuals.signals.fuse_motion())
    change = bare.evaluate_rows(parameters, corrected.fuse_motion()) - before
    difference = change - terms.columns[number]
    assert math.sqrt(np.mean(difference**2)) < 0.2 * math.sqrt(np.mean(change**2))


@pytest.mark.parametrize("place", ["table_disp_m", "mass_acc_m_s2"])
def test_a_column_does_not_hang_on_what_the_model_lacks(place: str) -> None:
    """Without load cells the forces of the bumpers follow the motion that was measured.

    A motion that obeys the model instead would touch them elsewhere.
    """
    (bare,) = build_log_residuals([(without_cells(acc_noise=0.03), 0.0)], SNM)
    true = ParameterSet.from_model(SNM, 1)
    soft = true.with_values({STIFFNESS: 0.7 * true.values[STIFFNESS]})
    columns = []
    for parameters in (true, soft):
        terms = linearize_nuisances(bare, parameters).nuisances
        assert terms is not None
        number = [(each.kind, each.place) for each in terms.nuisances].index(("gain", place))
        columns.append(terms.columns[number][bare.entry_row[: terms.columns.shape[1]] == 0])
    of_true, of_soft = columns
    assert of_soft @ of_true > 0.9 * math.sqrt((of_true @ of_true) * (of_soft @ of_soft))


def test_noise_without_load_cells_is_that_of_what_is_touched() -> None:
    """A bumper that is 15 times as stiff as the damper makes so much more of the noise of u."""
    (bare,) = build_log_residuals([(without_cells(laser_noise=30.0), 0.0)], SNM)
    parameters = ParameterSet.from_model(SNM, 1)
    noise = bare.noise_copy.evaluate(parameters) - bare.evaluate(parameters)
    m, in_row = bare.motion(), bare.entry_row == 0
    depth = np.abs(m.u[bare.entry_sample]) - SNM.parameters.gap_r
    parts = in_row & (depth > 0.0), in_row & (depth < 0.0)
    assert all(part.sum() > 1000 for part in parts)
    touched, free = (math.sqrt(np.mean(noise[part] ** 2)) for part in parts)
    assert touched == pytest.approx(free, rel=0.1)


def test_a_prior_holds_every_nuisance() -> None:
    """Its entries are the values: an error four times the typical one costs eight of evidence."""
    prepared = prepare_bare_log()
    residuals = prepared.problem.log_residuals[0]
    values = nuisance_values(prepared)
    entries = residuals.evaluate(prepared.parameters)[-len(values) :]
    assert entries == pytest.approx([*values.values()])
    assert all(abs(value) <= MAX_SIZE for value in values.values())
    assert all(math.isinf(free.high) for free in list_nuisance_parameters([residuals]))
    assert not sensor_mask(residuals)[0]  # the damper row
    assert sensor_mask(residuals)[-1]


def test_without_a_rest_a_laser_may_have_any_zero() -> None:
    """Else a relaxing branch that forgets it would take the place of the spring."""
    quiet = log(noise=0.2)
    spectra = dict(quiet.signals.spectra)
    spectra["mass_disp_m"] = spectra["mass_disp_m"] + 3e-3 * quiet.signals.unit_spectrum
    moved = replace(quiet.signals, spectra=spectra)
    cut = replace(moved, rest_values={}, rest_noise={})
    for signals, zero in (
        (moved, TYPICAL_LASER_OFFSET * moved.channel_rms("mass_disp_m")),
        (cut, 3e-3),
    ):
        sizes = {(each.kind, each.place): each.size for each in list_nuisances(signals)}
        assert sizes["offset", "mass_disp_m"] == pytest.approx(zero, rel=0.1)
    fit = prepare_problem([replace(quiet, signals=cut)], SNM).first_fit
    assert fit.values[STIFFNESS] == pytest.approx(TRUE.stiffness, rel=0.01)


def test_a_zero_that_drifts_is_as_large_as_it_shows_in_flight_and_on_average() -> None:
    """Load cells by 10 N and accelerometers by 0.05 m/s2 over the record; they hide nothing."""
    quiet = log()
    ramp = np.linspace(0.0, 1.0, quiet.signals.time_s.size)
    spectra = dict(quiet.signals.spectra)
    drifts = dict.fromkeys((*RIGHT_CELLS, *LEFT_CELLS), 10.0) | {"mass_acc_m_s2": 0.05}
    for channel, drift in drifts.items():
        spectra[channel] = spectra[channel] + quiet.signals.grid.from_time_domain(drift * ramp)
    drifting = replace(quiet.signals, spectra=spectra)
    sizes = {(each.kind, each.place): each.size for each in list_nuisances(drifting)}
    for channel, drift in drifts.items():
        for kind in ("offset", "offset1"):  # a ramp is half its end, and half of it up and down
            assert sizes[kind, channel] == pytest.approx(0.5 * drift, rel=0.1)
    verdict = discover_effects([replace(quiet, signals=drifting)], SNM).verdict
    assert verdict.outcome == "none"
    assert verdict.best.fit.values[STIFFNESS] == pytest.approx(TRUE.stiffness, rel=0.01)


def test_what_nothing_contradicts_is_no_nuisance() -> None:
    """The scales of all displacements and of all forces are fixed."""
    nuisances = list_nuisances(log().signals)
    places = {nuisance.place for nuisance in nuisances if nuisance.kind == "gain"}
    assert places == {"table_disp_m", "mass_acc_m_s2", "table_acc_m_s2", "right", "left"}
    assert all(isinstance(nuisance, Nuisance) and nuisance.size > 0 for nuisance in nuisances)


def test_a_low_cut_is_restored_where_the_mass_accelerates_and_no_slow_noise_grows() -> None:
    """A low cut of 0.4 Hz takes a third of a motion at 0.8 Hz; below 0.1 Hz there is only noise."""
    signals = log().signals
    cut = 2.0 * math.pi * 0.4
    through = 1j * signals.omega / (1j * signals.omega + cut)
    read = signals.spectra["mass_acc_m_s2"] * through
    distorted = replace(signals, spectra={**signals.spectra, "mass_acc_m_s2": read})
    restored = correct_signals(distorted, Nuisance("low_cut", "mass_acc_m_s2", cut), 1.0)
    gain = np.abs(restored.spectra["mass_acc_m_s2"][1:] / read[1:])
    hz = signals.omega[1:] / (2.0 * math.pi)
    fast, slow = hz > 0.3, hz < 0.05
    true = signals.spectra["mass_acc_m_s2"][1:][fast]
    error = restored.spectra["mass_acc_m_s2"][1:][fast] - true
    assert np.linalg.norm(error) < 1e-3 * np.linalg.norm(true)
    assert gain[slow].max() < 1.1
    assert gain.max() < 5.0
