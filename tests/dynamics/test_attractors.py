"""Attractors, basins and brute-force diagrams: figures of the SNM, and full-length runs."""

import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from table_io.errors import InputError
from tests.model.reference import AG, snm
from twin.dynamics.attractors import AttractorSearch, estimate_exponent
from twin.dynamics.basins import (
    StartGrid,
    compute_basins,
    compute_basins_over,
    find_chaotic_bands,
    follow_attractor,
    record_section,
)
from twin.dynamics.event_driven_map import make_period_map
from twin.dynamics.period_map import PeriodMap
from twin.model.model import Model

G4 = Model(snm())
GRID = StartGrid.from_limits(6e-3, 0.15, 21, 21)


def at(frequency: float, model: Model = G4) -> PeriodMap:
    return make_period_map(model, frequency, AG)


def classify_in_full(basins, cycles: int) -> np.ndarray:
    """Index of the attractor whose u_max and mean u a long simulation ends with, for each start.

    Without capture, and by another kernel.
    """
    period_map = basins.period_map
    # over as many cycles as are compared
    want = [summarize(simulate(period_map, a.points[-1], 320)) for a in basins.attractors]
    labels = []
    for x in basins.grid.list_starts(period_map):
        ends = summarize(simulate(period_map, x, cycles)[-320:])
        labels.append(int(np.argmin([np.abs(ends - each).max() for each in want])))
    return np.array(labels).reshape(basins.grid.shape)


def simulate(period_map: PeriodMap, x, cycles: int) -> np.ndarray:
    """u_max and u_min of each cycle, (cycles, 2)."""
    return period_map.measure_periods(x, cycles)[:, :2]


def summarize(extremes: np.ndarray) -> np.ndarray:
    return np.concatenate([extremes.mean(axis=0), extremes.max(axis=0), extremes.min(axis=0)])


def test_basin_of_the_impacting_solution_at_3_4_hz():
    """87.4 % of 101 x 101 starts."""
    basins = compute_basins(at(3.4), StartGrid.from_limits(6e-3, 0.15, 101, 101))
    order = np.argsort([-attractor.u_max for attractor in basins.attractors])
    high, low = (basins.attractors[i] for i in order)
    assert basins.fractions[order] == pytest.approx([0.874, 0.126], abs=5e-4)
    assert basins.undecided_share == 0
    assert [attractor.u_max for attractor in (high, low)] == pytest.approx(
        [5.123e-3, 1.247e-3], abs=1e-6
    )
    assert (high.period, low.period) == (1, 1)
    assert (high.has_contact, low.has_contact) == (True, False)


REGIMES = [
    (0.53, 9),  # two chaotic attractors, mirror images
    (0.95, 15),
    (1.18, 9),  # period 5
    (1.44, 9),  # two of period 2
    (1.5385, 15),  # four of period 1
    (2.95, 15),  # small basin of the flight solution
    (4.011, 15),  # near the fold
]


@pytest.mark.parametrize("frequency, count", REGIMES)
def test_captured_starts_end_where_full_length_runs_end(frequency, count):
    basins = compute_basins(at(frequency), StartGrid.from_limits(6e-3, 0.15, count, count))
    assert basins.undecided_share == 0
    full = classify_in_full(basins, 700)
    assert (basins.labels != full).mean() <= 0.002


def test_mirror_images_are_distinguished():
    basins = compute_basins(at(1.5385), GRID)
    assert [a.period for a in basins.attractors] == [1, 1, 1, 1]
    for index, attractor in enumerate(basins.attractors):
        assert attractor.mirror not in (None, index)
        image = basins.attractors[attractor.mirror]
        assert image.mirror == index
        assert image.extremes[0, 0] == pytest.approx(-attractor.extremes[0, 1], abs=1e-9)
        assert image.exponent.value == pytest.approx(attractor.exponent.value, abs=1e-6)
    symmetric = compute_basins(at(3.4), GRID).attractors
    assert [a.mirror for a in symmetric] == [0, 1]


def test_an_unsymmetric_specimen_has_no_mirror_images():
    model = Model(snm(gap_r=1e-3, gap_l=3e-3))
    attractors = compute_basins(at(3.4, model), GRID).attractors
    with_contact = [a for a in attractors if a.has_contact]
    assert with_contact
    assert all(a.mirror is None for a in with_contact)


@pytest.mark.parametrize("frequency, period, count", [(1.18, 5, 1), (1.44, 2, 2)])
def test_periods_of_several_cycles(frequency, period, count):
    """The period-5 window of 1.172 to 1.186 Hz, and the doubled period from 1.4366 to 1.4617 Hz."""
    attractors = compute_basins(at(frequency), GRID).attractors
    assert [a.period for a in attractors] == [period] * count
    for attractor in attractors:
        assert len(attractor.points) == len(attractor.extremes) == period
        again = at(frequency).record(attractor.points[-1], period)
        assert again[:, :2] == pytest.approx(attractor.points[:, :2], abs=1e-10)


@pytest.mark.parametrize(
    "frequency, want, error",
    [(0.53, 0.6099, 12e-4), (0.71, 0.7365, 9e-4), (1.1, 0.6110, 25e-4), (1.4, 0.3276, 3e-4)],
)
def test_exponents_of_the_chaotic_attractors(frequency, want, error):
    search = AttractorSearch(at(frequency), 20000)
    search.classify(StartGrid.from_limits(2e-3, 0.05, 2, 2).list_starts(at(frequency)))
    assert search.attractors
    for attractor in search.attractors:
        exponent = attractor.exponent
        assert attractor.kind == "chaotic"
        assert exponent.is_positive
        assert exponent.standard_error < 0.005
        assert abs(exponent.value - want) < 4 * math.hypot(exponent.standard_error, error)


def test_standard_error_of_an_exponent_is_that_of_repeated_estimates():
    period_map = at(0.71)
    x = period_map.iterate(period_map.start(1e-3, 0.0), 500)
    growth, _ = period_map.measure_growth(x, 40000)
    scatter = growth.reshape(20, -1).mean(axis=1).std(ddof=1)
    assert estimate_exponent(period_map, x, 2000).standard_error == pytest.approx(scatter, rel=0.6)
    regular = at(2.4)
    settled = regular.iterate(regular.start(1e-3, 0.0), 1000)
    exponent = estimate_exponent(regular, settled, 4000)
    assert exponent.is_negative
    assert not exponent.is_positive


def test_linear_flight_has_a_single_basin():
    basins = compute_basins(at(2.0, Model(snm(math.inf))), GRID)
    (attractor,) = basins.attractors
    assert basins.fractions == [1.0]
    assert abs(attractor.multipliers[0]) == pytest.approx(math.exp(-1 / 2.0), rel=1e-9)
    assert attractor.exponent.value == pytest.approx(-1 / 2.0, rel=1e-9)
    assert not attractor.has_contact


def test_slow_bumpers_are_part_of_the_state():
    """Faces that relax in 0.12 s: capture must not overlook them."""
    model = Model(snm(0.004, bumper_damping_r=6e4, bumper_damping_l=6e4))
    basins = compute_basins(at(2.6, model), StartGrid.from_limits(6e-3, 0.15, 11, 11))
    assert len(basins.attractors[0].multipliers) == 4
    assert (basins.labels != classify_in_full(basins, 1200)).mean() == 0


def test_permanent_contact_and_unequal_bumpers():
    pressed = compute_basins(at(6.9, Model(snm(-0.010))), GRID)
    assert pressed.fractions == [1.0]
    assert pressed.attractors[0].has_contact


EFFECTS = {
    "bumper_hardening": {"k2": 2e7},
    "coulomb_friction": {"fc": 20.0},
    "maxwell_damper": {"k1": 8e3, "tau": 0.05},
    "table_tilt": {"tilt": 0.02},
}  # fmt: skip


@pytest.mark.parametrize("effect", EFFECTS)
def test_effects_have_basins_too(effect):
    model = G4.with_effect(effect, "", **EFFECTS[effect])
    basins = compute_basins(at(3.4, model), StartGrid.from_limits(6e-3, 0.15, 5, 5))
    assert basins.undecided_share == 0
    amplitudes = sorted(a.u_max for a in basins.attractors)
    assert len(amplitudes) == 2
    assert amplitudes == pytest.approx([1.247e-3, 5.123e-3], rel=0.15)


def test_a_vanishing_effect_changes_nothing_beyond_the_sampling():
    """The sampled path on a model that also has a closed form."""
    model = G4.with_effect("cubic_stiffness", "", k3=1e-3)
    grid = StartGrid.from_limits(6e-3, 0.15, 5, 5)
    sampled, exact = compute_basins(at(3.4, model), grid), compute_basins(at(3.4), grid)
    order = [np.argsort([a.u_max for a in b.attractors]) for b in (sampled, exact)]
    assert sampled.fractions[order[0]] == pytest.approx(exact.fractions[order[1]], abs=0.041)
    for i, j in zip(*order, strict=True):
        a, b = sampled.attractors[i], exact.attractors[j]
        assert a.u_max == pytest.approx(b.u_max, rel=2e-5)
        assert a.exponent.value == pytest.approx(b.exponent.value, rel=2e-3)


def test_drifting_gaps_have_no_basins():
    with pytest.raises(InputError) as error:
        compute_basins(at(3.4, G4.with_effect("gap_drift", "", rate=1e-5)), GRID)
    assert error.value.where == "effect 'gap_drift'"


@pytest.mark.parametrize(
    "arguments, key",
    [((0.0, 0.1, 3, 3), "u_limit"), ((1e-3, math.nan, 3, 3), "v_limit"), ((1, 1, 0, 3), "u_count")],
)
def test_impossible_grids_are_refused(arguments, key):
    with pytest.raises(InputError) as error:
        StartGrid.from_limits(*arguments)
    assert error.value.key == key


def test_threads_change_nothing():
    frequencies, grid = [0.71, 1.44, 3.4], StartGrid.from_limits(6e-3, 0.15, 9, 9)
    alone = compute_basins_over(at(1.0), "frequency", frequencies, grid)
    with ThreadPoolExecutor(2) as pool:
        together = compute_basins_over(at(1.0), "frequency", frequencies, grid, pool.map)
    for a, b in zip(alone, together, strict=True):
        assert (a.labels == b.labels).all()
        assert (a.cycles == b.cycles).all()


@pytest.mark.parametrize(
    "parameter, values", [("gap", [3e-3, 5e-3]), ("level", [0.3, 0.6]), ("stiffness", [3e4, 4e4])]
)
def test_basins_over_any_parameter(parameter, values):
    results = compute_basins_over(at(3.4), parameter, values, GRID)
    assert len({float(basins.fractions.max()) for basins in results}) == 2
    amplitudes = {max(a.u_max for a in basins.attractors) for basins in results}
    assert len(amplitudes) == 2


def test_an_attractor_met_again_is_the_same():
    search, starts = AttractorSearch(at(3.4)), GRID.list_starts(at(3.4))
    first, _ = search.classify(starts.copy())
    second, cycles = search.classify(starts)
    assert len(search.attractors) == 2
    assert (first == second).all()
    assert cycles.max() < 16


@pytest.mark.slow
def test_the_chaotic_bands_of_g4():
    """1.07 to 1.17, 1.19 to 1.22 and 1.23 to 1.41 Hz."""
    frequencies = np.arange(1055, 1430, 10) / 1000
    up = follow_attractor(at(1.2), "frequency", frequencies, 1000)
    down = follow_attractor(at(1.2), "frequency", frequencies[::-1], 1000)
    bands = find_chaotic_bands([up, down], 1e-3)
    ends = [(band.low, band.high) for band in bands]
    assert ends == [
        pytest.approx(want, abs=4e-3) for want in ((1.066, 1.170), (1.190, 1.221), (1.226, 1.4135))
    ]
    assert all(band.exponent.is_positive for band in bands)


def test_a_band_that_reaches_the_end_of_the_diagram_ends_there():
    up = follow_attractor(at(1.2), "frequency", [1.10, 1.11, 1.12], 500)
    (band,) = find_chaotic_bands([up], 1e-3)
    assert (band.low, band.high) == (1.10, 1.12)


def test_the_state_is_carried_through_the_hysteresis():
    frequencies = np.arange(270, 421, 5) / 100
    up = follow_attractor(at(1.2), "frequency", frequencies)
    down = follow_attractor(at(1.2), "frequency", frequencies[::-1])
    impacting = [
        {
            round(float(f), 3)
            for f, (a,) in zip(d.values, d.attractors, strict=True)
            if a.has_contact
        }
        for d in (up, down)
    ]
    assert max(impacting[0]) == pytest.approx(4.0273, abs=0.05)
    assert max(impacting[1]) == pytest.approx(2.7873, abs=0.05)


def test_over_the_gap_the_impacts_end_at_the_fold():
    """At 3.4 Hz: grazing at 2.4938 mm (decreasing gap), fold at 7.9502 mm (increasing gap)."""
    period_map = at(3.4, Model(snm(2e-3)))
    gaps = np.arange(200, 851, 10, dtype=np.float64) * 1e-5
    ends = []
    for values in (gaps, gaps[::-1]):
        diagram = follow_attractor(period_map, "gap", values)
        contacts = [a.has_contact for (a,) in diagram.attractors]
        ends.append(max(np.compress(contacts, diagram.values)))
    assert ends == pytest.approx([7.9502e-3, 2.4938e-3], abs=1e-4)


def test_a_subharmonic_of_small_basin_is_found():
    """4.55 Hz: period 6, a doubled period 3, beside the motion without contact."""
    basins = compute_basins(at(4.55), StartGrid.from_limits(6e-3, 0.15, 25, 25))
    assert basins.undecided_share == 0
    assert {attractor.period for attractor in basins.attractors} == {1, 6}


def test_a_section_lies_on_the_attractor():
    points = record_section(at(1.1), 1e-3, 0.0, 3000)
    assert points.shape == (3000, 2)
    assert np.unique(np.round(points, 9), axis=0).shape[0] > 2900
    periodic = record_section(at(1.18), 1e-3, 0.0, 50)
    assert np.unique(np.round(periodic, 7), axis=0).shape[0] == 5


def test_diagrams_over_different_values_have_no_common_bands():
    first = follow_attractor(at(1.2), "frequency", [2.0])
    with pytest.raises(InputError) as error:
        find_chaotic_bands([first, follow_attractor(at(1.2), "frequency", [2.1])], 1e-3)
    assert error.value.key == "diagrams"
