"""Branches and loci: bifurcations by number, switching, and why a branch ends."""

import math

import numpy as np
import pytest

from tests.dynamics.maps import BILINEAR, BILINEAR_LEVEL, FormulaMap, model_map, settle
from tests.dynamics.random_models import is_admissible
from tests.input_errors import raises_input_error
from tests.model.reference import AG
from twin.dynamics.closed_form_map import ClosedFormMap
from twin.dynamics.continuation import continue_branch, switch_branch
from twin.dynamics.loci import continue_locus
from twin.dynamics.orbits import find_orbit
from twin.model.model import Model


def values_of(branch, *kinds):
    return [b.value for b in branch.of_kind(*kinds)]


@pytest.fixture(scope="module")
def g4():
    """The primary branch at G4 from 1.5 Hz, impacting, to 5 Hz, in flight."""
    return continue_branch(settle(model_map(), 5.0), "frequency", (1.5, 5.0))


def test_bilinear_oscillator_folds_and_grazes_where_known() -> None:
    """The fold agrees with a solution in 30 digits for the two event times and the velocity."""
    orbit = settle(ClosedFormMap(Model(BILINEAR), 1.0, BILINEAR_LEVEL), 1 / math.pi)
    branch = continue_branch(orbit, "frequency", (0.5 / (2 * math.pi), 1 / math.pi))
    grazings = 2 * math.pi * np.array(values_of(branch, "grazing"))
    assert grazings == pytest.approx([0.74087833, 1.20045796], abs=1e-8)
    assert 2 * math.pi * values_of(branch, "fold")[0] == pytest.approx(1.504028650771736, abs=1e-11)
    for bifurcation in branch.of_kind("fold"):
        assert abs(bifurcation.orbit.multipliers - 1).min() < 1e-8
    for bifurcation in branch.of_kind("grazing"):
        assert bifurcation.orbit.u_max == pytest.approx(1.0, abs=1e-9)
        assert (bifurcation.side, bifurcation.guard) == ("right", "clearance")


def test_folds_and_grazing_at_g4(g4) -> None:
    assert values_of(g4, "fold") == pytest.approx([4.027372, 2.787294], abs=1e-6)
    assert values_of(g4, "grazing") == pytest.approx([2.79359], abs=5e-6)
    assert g4.of_kind("grazing")[0].side == "both"
    assert g4.of_kind("grazing")[0].orbit.u_max == pytest.approx(0.002, abs=1e-10)
    assert [end.reason for end in g4.ends] == ["range end", "range end"]
    assert len(g4.folds) == 2


@pytest.mark.parametrize(
    "gap, forward, backward, grazing",
    [(0.010, 3.157626, 2.013866, 2.01441), (0.030, 1.948, 1.526, 1.526),
     (0.016, 2.634, 1.762, None), (-0.001, 5.2632, 5.2325, None), (-0.002, 6.1501, 5.8086, None)],
)  # fmt: skip
def test_folds_at_other_gaps(gap, forward, backward, grazing) -> None:
    branch = continue_branch(settle(model_map(gap), 8.0), "frequency", (1.3, 8.0))
    tolerance = 1e-6 if gap == 0.010 else 6e-4
    folds = sorted(values_of(branch, "fold"))
    assert [folds[-1], folds[-2]] == pytest.approx([forward, backward], abs=tolerance)
    if grazing:
        nearest = min(abs(value - grazing) for value in values_of(branch, "grazing"))
        assert nearest < max(tolerance, 5e-6)


@pytest.mark.parametrize(
    "frequency, amplitudes_mm, multiplier",
    [(3.4, (5.123, 3.297, 1.247), 3.115), (3.0, (None, 2.516341, None), 5.9259),
     (3.8, (None, 4.548419, None), 1.7204)],
)  # fmt: skip
def test_coexisting_orbits_at_g4(g4, frequency, amplitudes_mm, multiplier) -> None:
    orbits = g4.orbits_at(frequency)
    assert [orbit.stable for orbit in orbits] == [True, False, True]
    for orbit, want in zip(orbits, amplitudes_mm, strict=True):
        if want:
            assert 1e3 * orbit.u_max == pytest.approx(want, abs=5e-4 if want != 2.516341 else 1e-6)
    assert orbits[1].multipliers[0] == pytest.approx(multiplier, abs=5e-4)


def test_multipliers_are_those_of_small_perturbations(g4) -> None:
    """Brute force: eigenvalues of how the map moves perturbed starts."""
    for orbit in (*g4.orbits_at(3.4), *g4.orbits_at(2.7)):
        h, period_map = 1e-8, orbit.period_map
        free, directions = period_map.free_directions(orbit.x)
        columns = [
            (period_map.iterate(orbit.x + step, 1) - period_map.iterate(orbit.x - step, 1))[free]
            for step in h * directions.T[:2]
        ]
        brute = np.linalg.eigvals(np.array(columns).T[:2] / (2 * h))
        assert sorted(np.abs(brute)) == pytest.approx(
            sorted(np.abs(orbit.multipliers[:2])), abs=1e-4
        )


@pytest.mark.parametrize(
    "frequency, grazing_mm, fold_mm", [(3.4, 2.493783, 7.950152), (2.0, 10.235079, 28.526996)]
)
def test_branch_over_the_gap(frequency, grazing_mm, fold_mm) -> None:
    branch = continue_branch(settle(model_map(0.04), frequency), "gap", (0.001, 0.04))
    assert 1e3 * np.array(values_of(branch, "grazing"))[-1] == pytest.approx(grazing_mm, abs=1e-6)
    assert 1e3 * max(values_of(branch, "fold")) == pytest.approx(fold_mm, abs=1e-6)


def test_symmetry_breaking_period_doubling_and_their_branches(g4) -> None:
    (pitchfork,) = g4.of_kind("pitchfork")
    assert pitchfork.value == pytest.approx(1.7365957697, abs=1e-8)
    assert abs(pitchfork.orbit.multipliers[0] - 1) < 1e-6
    doublings = []
    for side in (1, -1):
        broken = switch_branch(pitchfork, "frequency", (1.4, 1.8), side=side)
        assert abs(broken.points[5].orbit.u_max + broken.points[5].orbit.u_min) > 1e-5
        # a left hysteresis: the second impact of a side appears
        assert sorted(values_of(broken, "fold")) == pytest.approx([1.5185, 1.5512], abs=1e-4)
        (doubling,) = broken.of_kind("period doubling")
        assert doubling.value == pytest.approx(1.461722, abs=1e-6)
        doublings.append(doubling)
    doubled = switch_branch(doublings[0], "frequency", (1.43, 1.8))
    orbit = doubled.points[-1].orbit
    assert orbit.periods == 2
    assert np.abs(orbit.period_map.iterate(orbit.x, 1) - orbit.x).max() > 1e-5
    assert values_of(doubled, "period doubling") == pytest.approx([1.436643], abs=1e-6)


def test_a_branch_that_leaves_ends_where_it_meets_its_parent_again() -> None:
    symmetric = continue_branch(settle(model_map(0.04), 2.0), "gap", (1e-4, 0.04))
    low, high = sorted(symmetric.of_kind("pitchfork"), key=lambda b: b.value)
    for start, end in ((low, high), (high, low)):
        broken = switch_branch(start, "gap", (1e-4, 0.04))
        assert [end.reason for end in broken.ends] == ["start", "meets another branch"]
        assert broken.ends[1].value == pytest.approx(end.value, abs=1e-9)


def test_period_five_window_is_a_closed_loop() -> None:
    period_map = model_map(frequency_hz=1.178)
    orbit = find_orbit(period_map, period_map.iterate(period_map.rest(), 4000), 5)
    assert orbit is not None
    assert orbit.stable
    branch = continue_branch(orbit, "frequency", (1.0, 1.4))
    assert branch.ends[1].reason == "closed loop"
    stable_hz = branch.values[branch.stable]
    stable_hz = stable_hz[stable_hz > 1.15]
    assert (stable_hz.min(), stable_hz.max()) == pytest.approx((1.172, 1.186), abs=2e-3)


def test_a_near_pitchfork_is_no_crossing() -> None:
    """Unequal dashpots part the pitchfork: the branch stays on its own side of it."""
    period_map = model_map(0.00506, bumper_damping_r=300.0, damping=1371.0)
    branch = continue_branch(settle(period_map, 8.0), "frequency", (1.3, 8.0))
    assert not branch.of_kind("pitchfork")
    amplitudes = branch.extreme("u_max")
    steps = np.abs(np.diff(np.log(amplitudes)))
    assert steps.max() < 0.4


MODELS = {
    "memoryless": {"bumper_damping_r": 0.0, "bumper_damping_l": 0.0},
    "one bumper": {"gap_l": math.inf},
    "unequal gaps": {"gap_r": 0.003, "gap_l": 0.001},
    "one preloaded": {"gap_r": 0.002, "gap_l": -0.001},
    "both preloaded": {"gap_r": -0.001, "gap_l": -0.001},
    "slow bumpers": {"bumper_damping_r": 2e4, "bumper_damping_l": 3e3},
    "a single dashpot": {"bumper_damping_l": 0.0},
    "hardly damped": {"damping": 300.0},
}


@pytest.mark.parametrize("name", MODELS)
def test_every_orbit_of_any_model_is_periodic_and_admissible(name) -> None:
    orbit = settle(model_map(0.004, **MODELS[name]), 12.0)
    branch = continue_branch(orbit, "frequency", (0.9, 12.0))
    assert [end.reason for end in branch.ends] == ["range end", "range end"]
    for point in branch.points:
        orbit = point.orbit
        assert is_admissible(orbit)
        result = orbit.period_map.evaluate(orbit.x)
        residual = np.abs((result.end - orbit.x) / orbit.period_map.scales).max()
        assert residual < 1e-11 * max(1, abs(orbit.multipliers[0]))


@pytest.mark.parametrize(
    "parameter, limits", [("level", (0.1, 1.5)), ("mass", (300.0, 900.0)),
                          ("bumper_stiffness_r", (1e5, 1e6)), ("gap_l", (0.0005, 0.006))],
)  # fmt: skip
def test_continue_branch_over_any_parameter(parameter, limits) -> None:
    orbit = settle(model_map(), 3.4)
    branch = continue_branch(orbit, parameter, limits)
    assert {end.reason for end in branch.ends} == {"range end"}
    assert set(branch.values[[0, -1]]) <= set(limits)
    middle = branch.points[len(branch.points) // 2]
    own = middle.orbit
    assert own.period_map.iterate(own.x, 1) == pytest.approx(own.x, abs=1e-10)
    assert own.period_map.parameter(parameter) == middle.value


def test_folds_over_the_level_are_those_over_the_frequency(g4) -> None:
    fold = g4.of_kind("fold")[0]
    upper = g4.orbits_at(fold.value - 1e-3)[0]
    branch = continue_branch(upper, "level", (0.2, 0.8))
    (over_level,) = [b for b in branch.of_kind("fold") if abs(b.value - AG) < 0.01]
    assert over_level.orbit.frequency_hz == upper.frequency_hz
    assert abs(over_level.orbit.multipliers[0] - 1) < 1e-6
    assert AG - 0.01 < over_level.value < AG  # a smaller level folds at a lower frequency


def test_a_branch_without_a_fold_reaches_its_goal() -> None:
    branch = continue_branch(settle(model_map(-0.010), 6.0), "frequency", (4.0, 8.0), 1)
    assert branch.points[-1].value == 8.0
    assert not branch.bifurcations
    assert [end.reason for end in branch.ends] == ["start", "range end"]


# Maps with known bifurcations


def test_logistic_map() -> None:
    logistic = FormulaMap(lambda x, r: [r * x * (1 - x)])
    branch = continue_branch(logistic.find([0.6], 2.5), "frequency", (2.0, 4.0))
    (doubling,) = branch.of_kind("period doubling")
    assert doubling.value == pytest.approx(3.0, abs=1e-8)
    doubled = switch_branch(doubling, "frequency", (2.0, 4.0))
    assert values_of(doubled, "period doubling")[0] == pytest.approx(1 + math.sqrt(6), abs=1e-7)
    three = continue_branch(logistic.find([0.5], 3.84, 3), "frequency", (2.0, 3.9))
    assert values_of(three, "fold")[0] == pytest.approx(1 + math.sqrt(8), abs=1e-7)


def test_neimark_sacker_of_the_delayed_logistic_map() -> None:
    delayed = FormulaMap(lambda x, y, r: [r * x * (1 - y), x], size=2)
    branch = continue_branch(delayed.find([0.4, 0.4], 1.7), "frequency", (1.5, 2.3))
    (torus,) = branch.of_kind("Neimark-Sacker")
    assert torus.value == pytest.approx(2.0, abs=1e-8)
    assert torus.orbit.multipliers[0] == pytest.approx(np.exp(1j * math.pi / 3), abs=1e-6)


def test_isola_and_pitchfork_and_an_end() -> None:
    isola = FormulaMap(lambda x, p: [x + 0.5 * (1 - x * x - (p - 3) ** 2)])
    branch = continue_branch(isola.find([1.1], 3.0), "frequency", (1.0, 5.0))
    assert [end.reason for end in branch.ends] == ["closed loop"] * 2
    assert sorted(values_of(branch, "fold")) == pytest.approx([2.0, 4.0], abs=1e-8)

    parting = FormulaMap(lambda x, p: [x + (p - 2) * (x - 3) - (x - 3) ** 3])
    trivial = continue_branch(parting.find([3.0], 1.5), "frequency", (1.0, 3.0))
    (pitchfork,) = trivial.of_kind("pitchfork")
    assert pitchfork.value == pytest.approx(2.0, abs=1e-8)
    for side in (1, -1):
        branch = switch_branch(pitchfork, "frequency", (1.0, 3.0), side=side)
        assert branch.points[-1].orbit.x[0] == pytest.approx(3.0 + side, abs=1e-8)

    broken = FormulaMap(lambda x, p: [0.5 * x + (math.nan if p > 2.5 else p)])
    branch = continue_branch(broken.find([4.0], 2.0), "frequency", (1.0, 3.0), 1)
    assert branch.ends[1].reason == "no convergence"
    assert branch.ends[1].value == pytest.approx(2.5, abs=1e-3)


def test_points_and_inputs_are_limited() -> None:
    orbit = settle(model_map(), 5.0)
    branch = continue_branch(orbit, "frequency", (1.5, 5.0), -1, max_points=10)
    assert branch.ends[1].reason == "too many points"
    with raises_input_error(key="frequency", value=5.0):
        continue_branch(orbit, "frequency", (1.0, 4.0))
    with raises_input_error(key="mas", remedy="mass"):
        continue_branch(orbit, "mas", (1.0, 4.0))
    fold = continue_branch(orbit, "frequency", (2.0, 5.0)).folds[0]
    with raises_input_error(key="kind", value="fold"):
        switch_branch(fold, "frequency", (1.0, 5.0))


# Loci over two parameters

GAP_LIMITS, LEVEL_LIMITS = ((1.3, 5.5), (0.0, 0.03)), ((1.4, 5.0), (0.05, 2.0))


def flight_amplitude(frequency, level):
    w = 2 * math.pi * frequency
    return level / np.abs(36e3 / 550 - w * w + 2j * w)


def test_grazings_are_those_of_linear_flight(g4) -> None:
    grazing = g4.of_kind("grazing")[0]
    locus = continue_locus(grazing, ("frequency", "gap"), GAP_LIMITS)
    frequency, gap = locus.values.T
    assert gap == pytest.approx(2 * flight_amplitude(frequency, AG), rel=1e-10)
    assert [end.reason for end in locus.ends] == ["range end"] * 2
    locus = continue_locus(grazing, ("frequency", "level"), LEVEL_LIMITS)
    frequency, level = locus.values.T
    assert flight_amplitude(frequency, level) == pytest.approx(0.002, rel=1e-10)


def test_the_locus_of_folds_passes_both_folds_at_other_gaps(g4) -> None:
    """Folds of the branches at G10 and G16, and over the gap at 3.4 and 2.0 Hz, lie on it."""
    locus = continue_locus(g4.of_kind("fold")[0], ("frequency", "gap"), GAP_LIMITS)
    assert locus.kind == "fold"
    for orbit in locus.orbits[::10]:
        assert abs(orbit.multipliers - 1).min() < 2e-5
    frequency, gap_mm = locus.values[:, 0], 1e3 * locus.values[:, 1]
    cusp = int(frequency.argmax())
    curves = [slice(cusp, None), slice(None, cusp + 1)]
    for gap, folds_hz in ((10.0, (3.157626, 2.013866)), (4.0, (4.027372, 2.787294))):
        crossings = []
        for curve in curves:
            order = np.argsort(gap_mm[curve])
            crossings.append(np.interp(gap, gap_mm[curve][order], frequency[curve][order]))
        assert sorted(crossings) == pytest.approx(sorted(folds_hz), abs=0.01)


def test_permanent_contact_begins_at_the_lowest_grazing_of_the_push() -> None:
    orbit = settle(model_map(-0.010), 6.9)
    branch = continue_branch(orbit, "gap", (-0.010, -0.003))
    grazing = branch.bifurcations[0]
    assert (grazing.kind, grazing.side, grazing.guard) == ("grazing", "both", "push")
    locus = continue_locus(
        grazing, ("frequency", "gap"), ((6.0, 8.0), (-0.006, -0.001)), max_step=0.02
    )
    frequency, gap = locus.values.T
    lowest = int(gap.argmin())
    near = slice(lowest - 2, lowest + 3)
    a, b, c = np.polyfit(frequency[near] - frequency[lowest], gap[near], 2)
    assert 1e3 * (c - b * b / (4 * a)) == pytest.approx(-4.264886, abs=1e-6)


def test_locus_of_period_doublings_and_what_has_none(g4) -> None:
    """x -> r x (1 - x) - level doubles its period where (r - 1)^2 = 4 + 4 r level (by hand)."""
    logistic = FormulaMap(lambda x, r: [r * x * (1 - x)])
    branch = continue_branch(logistic.find([0.6], 2.5), "frequency", (2.0, 4.0))
    (doubling,) = branch.of_kind("period doubling")
    locus = continue_locus(doubling, ("frequency", "level"), ((2.0, 4.0), (-1.0, 1.0)))
    assert locus.values[:, 0] == pytest.approx(3.0, abs=1e-8)  # the level has no effect
    assert {locus.values[0, 1], locus.values[-1, 1]} == {-1.0, 1.0}
    with raises_input_error(key="kind", value="pitchfork"):
        continue_locus(g4.of_kind("pitchfork")[0])
    with raises_input_error(key="gap", value=0.004):
        continue_locus(g4.folds[0], ("frequency", "gap"), ((1.3, 5.5), (0.01, 0.03)))
