"""Extremes, onsets and impacts of a cycle, and the ratios of a step, against closed forms."""

import cmath
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from table_io.block import Float1D, Label
from table_io.records import CycleExtremes, Extremes, Step
from table_io.units import GRAVITY_M_S2
from twin.compare.cycles import (
    UNKNOWN_CONTACT,
    CycleMotion,
    PrcScale,
    build_prc_point,
    correct_gaps,
    cycle_extremes,
    detect_onsets,
    extract_onset_depths,
    measure_table_motion,
    normalized_response,
    smooth,
)
from twin.model.closed_form import advance_state, discretized_params, rest_state
from twin.model.parameters import Parameters, free_flight_resonance
from twin.model.solver import OUTPUT_COUNT

RATE_HZ = 2000.0
LEVEL = 0.05 * GRAVITY_M_S2
WEIGHT = 550.0 * GRAVITY_M_S2
G4 = Parameters(550.0, 36e3, 1.1e3, 510e3, 900.0, 510e3, 900.0, 0.002, 0.002)
FREE = replace(G4, gap_r=math.inf, gap_l=math.inf)


def scale(parameters: Parameters = G4) -> PrcScale:
    u_star, a_star, _ = free_flight_resonance(parameters, LEVEL)
    gaps = (parameters.gap_r, parameters.gap_l)
    return PrcScale(parameters, RATE_HZ, 10.0, u_star, a_star, gaps)


def motion(u: Float1D, a: Float1D, right: Float1D | None = None) -> CycleMotion:
    nothing = np.zeros(u.size)
    return CycleMotion(u, a, nothing if right is None else right, nothing)


def cycle(
    number: int,
    onsets_r: Sequence[int] = (),
    length: int = 500,
    label: Label = Label.MEASURE,
    u: float = 0.003,
    force: float = 500.0,
) -> CycleExtremes:
    """A held cycle whose measured extremes are given; the twin has nothing to say."""
    first = number * length
    extremes = Extremes(u, -u, 1.0, -1.0, force, 0.0, tuple(onsets_r), ())
    return CycleExtremes(first + length, 0, number, int(label), length, extremes, None)


# Extremes


def test_smoothing_leaves_a_parabola_as_it_is() -> None:
    weights = scale().smoothing_weights
    half = weights.size // 2
    t = np.arange(200.0)
    parabola = 3.0 - 0.2 * t + 0.01 * t**2
    np.testing.assert_allclose(smooth(parabola, weights), parabola[half:-half], rtol=1e-12)
    assert weights.size >= 3
    assert weights.size % 2 == 1


@pytest.mark.parametrize("gap", [0.002, math.inf])
def test_smoothing_spans_a_tenth_of_the_shortest_half_period(gap: float) -> None:
    p = replace(G4, gap_r=gap, gap_l=gap)
    stiffness = p.stiffness + (2 * p.bumper_stiffness_r if math.isfinite(gap) else 0.0)
    tenth = 0.1 * math.pi * math.sqrt(p.mass / stiffness) * RATE_HZ
    size = scale(p).smoothing_weights.size
    assert size <= 33
    assert min(tenth, 32) - 2 <= size - 1 <= tenth


def test_smoothing_of_what_is_shorter_than_it_changes_nothing() -> None:
    weights = scale().smoothing_weights
    short = np.arange(weights.size - 1.0)
    np.testing.assert_array_equal(smooth(short, weights), short)


def test_noise_hardly_lifts_an_extreme() -> None:
    """The bias of the greatest of n noisy values is below s sqrt(2 ln n), s that of the mean."""
    rng, s, sigma = np.random.default_rng(1), scale(), 7e-6
    t = np.arange(round(RATE_HZ / 3.4)) / RATE_HZ
    u = 5e-3 * np.sin(2 * math.pi * 3.4 * t)
    still = np.zeros(t.size)
    left = math.sqrt(float(s.smoothing_weights @ s.smoothing_weights))
    smoothed, raw = [], []
    for _ in range(300):
        noisy = u + sigma * rng.standard_normal(t.size)
        extremes, _ = cycle_extremes(motion(noisy, still), 0, s, UNKNOWN_CONTACT)
        assert extremes is not None
        smoothed.append(extremes.u_max - 5e-3)
        raw.append(noisy.max() - 5e-3)
    # few samples lie so near the top that noise can choose between them
    assert 0 < np.mean(smoothed) < sigma * left * math.sqrt(2 * math.log(t.size))
    assert np.mean(smoothed) < 0.6 * np.mean(raw)


def test_a_contact_is_not_smeared() -> None:
    """The shortest contact is half a period on both bumpers: its peak is kept within 0.2 %."""
    s = scale()
    w = math.sqrt((36e3 + 510e3) / 550)
    t = np.arange(588) / RATE_HZ
    force = 2000.0 * np.clip(np.sin(w * (t - 0.1)), 0, None) * (abs(t - 0.15) < math.pi / w)
    extremes, _ = cycle_extremes(motion(t, t, force), 0, s, UNKNOWN_CONTACT)
    assert extremes is not None
    assert extremes.force_r == pytest.approx(2000.0, rel=2e-3)
    assert extremes.force_l == 0.0


@pytest.mark.parametrize("parameters", [G4, FREE])
def test_a_peak_at_the_cut_between_two_cycles_is_not_lost(parameters: Parameters) -> None:
    """A held cycle begins at any phase; without the samples that lead up to it 3 % would go."""
    s, n = scale(parameters), 400
    for phase in np.linspace(0, 2 * math.pi, 33):
        wave = np.cos(2 * math.pi * np.arange(-s.lead_samples, n) / n + phase)
        extremes, _ = cycle_extremes(
            CycleMotion(wave, wave, wave, wave), 0, s, UNKNOWN_CONTACT, s.lead_samples
        )
        assert extremes is not None
        got = (
            extremes.u_max,
            -extremes.u_min,
            extremes.a_max,
            -extremes.a_min,
            extremes.force_r,
            extremes.force_l,
        )
        np.testing.assert_allclose(got, 1.0, rtol=2e-4)


def test_contact_before_the_cycle_is_no_onset_of_it() -> None:
    s = scale()
    force = np.zeros(s.lead_samples + 500)
    force[2:6] = 100.0
    force[s.lead_samples + 50 : s.lead_samples + 60] = 100.0
    still = np.zeros(force.size)
    extremes, _ = cycle_extremes(
        motion(still, still, force), 3000, s, UNKNOWN_CONTACT, s.lead_samples
    )
    assert extremes is not None
    assert extremes.onsets_r == (3050,)


def test_extremes_keep_signs_and_sides() -> None:
    t = np.arange(588) / RATE_HZ
    wave = np.sin(2 * math.pi * 3.4 * t)
    pair = CycleMotion(1e-3 + 2e-3 * wave, 0.5 - wave, np.full(588, 30.0), np.full(588, 70.0))
    extremes, touching = cycle_extremes(pair, 1000, scale(), (False, True))
    assert extremes is not None
    got = (
        extremes.u_max,
        extremes.u_min,
        extremes.a_max,
        extremes.a_min,
        extremes.force_r,
        extremes.force_l,
    )
    np.testing.assert_allclose(got, (3e-3, -1e-3, 1.5, -0.5, 30.0, 70.0), rtol=1e-5)
    assert (extremes.onsets_r, extremes.onsets_l) == ((1000,), ())
    assert touching == (True, True)


def test_lost_displacement_leaves_no_extremes_and_an_unknown_contact() -> None:
    u = np.zeros(500)
    u[77] = np.nan
    assert cycle_extremes(motion(u, np.zeros(500)), 0, scale(), (True, False)) == (
        None,
        UNKNOWN_CONTACT,
    )


def test_a_lost_accelerometer_leaves_the_displacement() -> None:
    t = np.arange(588) / RATE_HZ
    u = 2e-3 * np.sin(2 * math.pi * 3.4 * t)
    extremes, _ = cycle_extremes(motion(u, np.full(588, np.nan)), 0, scale(), UNKNOWN_CONTACT)
    assert extremes is not None
    assert extremes.u_max == pytest.approx(2e-3, rel=1e-5)
    assert math.isnan(extremes.a_max)
    values = normalized_response(
        [CycleExtremes(588, 0, 0, int(Label.MEASURE), 588, extremes, None)], "measured", scale()
    )
    assert values is not None
    assert values.eta_d == pytest.approx(2e-3 / scale().u_star_m, rel=1e-5)
    assert math.isnan(values.eta_a)


# Onsets


def test_onsets_have_hysteresis() -> None:
    force = np.array([0.0, 9.0, 11.0, 6.0, 11.0, 4.9, 9.9, 10.1, 20.0])
    assert detect_onsets(force, 10.0, False) == ([2, 7], True)
    assert detect_onsets(force[1:], 10.0, True) == ([6], True)


def test_contact_at_the_first_sample_is_an_onset_only_where_there_was_none() -> None:
    force = np.array([50.0, 50.0, 0.0])
    assert detect_onsets(force, 10.0, False) == ([0], False)
    assert detect_onsets(force, 10.0, True) == ([], False)
    assert detect_onsets(force, 10.0, None) == ([], False)
    assert detect_onsets(np.array([7.0, 8.0]), 10.0, None) == ([], None)


def test_lost_samples_of_a_force_are_no_release() -> None:
    force = np.array([0.0, 50.0, np.nan, 50.0, np.nan, 0.0, np.nan])
    assert detect_onsets(force, 10.0, None) == ([1], False)


def test_a_lost_sample_of_a_force_in_contact_is_no_second_onset_of_its_cycle() -> None:
    force = np.zeros(500)
    force[100:160] = 400.0
    force[130] = np.nan
    extremes, touching = cycle_extremes(
        motion(force * 0 + 1, force, force), 0, scale(), UNKNOWN_CONTACT
    )
    assert extremes is None  # the displacement was lost with it
    still = np.zeros(500)
    extremes, touching = cycle_extremes(motion(still, still, force), 0, scale(), UNKNOWN_CONTACT)
    assert extremes is not None
    assert extremes.onsets_r == (100,)
    assert math.isnan(extremes.force_r)
    assert touching == (False, False)


def test_noise_counts_nothing_twice() -> None:
    """Slow contacts through the threshold under the rig's load cell noise: one onset each."""
    rng = np.random.default_rng(2)
    t = np.arange(100_000) / RATE_HZ
    force = np.clip(400.0 * np.sin(2 * math.pi * 1.0 * t), 0.0, None)
    places, _ = detect_onsets(force + 1.4 * rng.standard_normal(t.size), 10.0, False)
    assert len(places) == 50
    assert not detect_onsets(1.4 * rng.standard_normal(t.size), 10.0, False)[0]


# Impacts per cycle


def count_impacts(cycles: list[CycleExtremes]) -> tuple[int, ...]:
    values = normalized_response(cycles, "measured", scale())
    assert values is not None
    assert values.impacts_left == (0,) * len(values.impacts_right)
    return values.impacts_right


def make_cycles(places: Sequence[int], settle: int = 1, measure: int = 3) -> list[CycleExtremes]:
    """Settle and measured cycles of 500 samples with onsets where they fall."""
    return [
        cycle(
            number,
            [place for place in places if number * 500 <= place < (number + 1) * 500],
            label=Label.SETTLE if number < settle else Label.MEASURE,
        )
        for number in range(settle + measure)
    ]


def test_jitter_about_the_cut_between_cycles_counts_one_each() -> None:
    places = [498, 1003, 1496, 2001]  # about 500, 1000, 1500, 2000: 2 0 1 1 between plain cuts
    cycles = make_cycles(places)
    assert [len(cycle.measured.onsets_r) for cycle in cycles if cycle.measured] == [1, 0, 2, 0]
    assert count_impacts(cycles) == (1, 1, 1)


@pytest.mark.parametrize("phase", range(0, 500, 25))
@pytest.mark.parametrize("settle", [0, 1, 2])
def test_one_impact_per_cycle_at_any_phase(phase: int, settle: int) -> None:
    places = [phase + 500 * number for number in range(3 + settle)]
    assert count_impacts(make_cycles(places, settle)) == (1, 1, 1)


@pytest.mark.parametrize("phase", range(0, 500, 50))
def test_a_third_slight_impact_in_one_cycle_is_that_cycles(phase: int) -> None:
    """Two a cycle, in the last but one a third (physics.md: 0.71 Hz)."""
    places = [phase + 500 * k + more for k in range(-1, 4) for more in (0, 60)]
    places.append(phase + 500 * 2 + 120)
    impacts = count_impacts(make_cycles([place for place in places if place >= 0]))
    assert sorted(impacts) == [2, 2, 3]


def test_no_onset_is_no_impact() -> None:
    assert count_impacts(make_cycles([])) == (0, 0, 0)


def test_impacts_of_settle_cycles_do_not_count() -> None:
    assert count_impacts(make_cycles([100, 200, 300], settle=2)) == (0, 0, 0)


# Quantities


def swing(hz: float, parameters: Parameters = FREE) -> tuple[Float1D, Float1D]:
    """(u, a) of two steady cycles in free flight at 0.05 g: the linear oscillator."""
    p, w = parameters, 2 * math.pi * hz
    t = np.arange(2 * math.ceil(RATE_HZ / hz)) / RATE_HZ
    x = -LEVEL / complex(p.stiffness / p.mass - w**2, p.damping * w / p.mass)
    total = LEVEL - w**2 * x
    return tuple(
        abs(amplitude) * np.sin(w * t + cmath.phase(amplitude)) for amplitude in (x, total)
    )  # type: ignore[return-value]


def flying(hz: float, s: PrcScale) -> CycleExtremes:
    extremes, _ = cycle_extremes(motion(*swing(hz, s.parameters)), 0, s, UNKNOWN_CONTACT)
    return CycleExtremes(1, 0, 0, int(Label.MEASURE), 1, extremes, extremes)


def test_free_flight_at_resonance_is_the_unit() -> None:
    s = scale(FREE)
    assert s.u_star_m == pytest.approx(30.537e-3, abs=1e-6)
    assert s.a_star_m_s2 == pytest.approx(2.057, abs=1e-3)
    for source in ("measured", "twin"):
        values = normalized_response([flying(1.268, s)], source, s)
        assert values is not None
        assert values.eta_d == pytest.approx(1.0, abs=2e-5)
        assert values.eta_a == pytest.approx(1.0, abs=2e-5)
        assert (values.eta_r, values.eta_l, values.r_r, values.r_l) == (0, 0, 0, 0)
        assert (values.drift, values.spread) == (0, 0)
    # on the paper's 0.1 Hz grid the largest is 2 % less
    grid = normalized_response([flying(1.3, s)], "measured", s)
    assert grid is not None
    assert grid.eta_d == pytest.approx(29.95 / 30.537, abs=1e-3)


def test_no_contact_is_no_deformation_whatever_the_noise() -> None:
    """Load cells below the threshold carry nothing, even where u alone would say contact."""
    values = normalized_response([cycle(0, u=0.0021, force=9.9)], "measured", scale())
    assert values is not None
    assert (values.eta_r, values.r_r) == (0, 0)


def test_contact_gives_deformation_beyond_the_gap_and_force_over_weight() -> None:
    s = scale()
    values = normalized_response(
        [cycle(0, u=0.003), cycle(1, u=0.004, force=1500.0)], "measured", s
    )
    assert values is not None
    assert values.eta_d == pytest.approx(0.0035 / s.u_star_m)
    assert values.eta_r == pytest.approx((0.001 + 0.002) / 2 / s.u_star_m)
    assert values.r_r == pytest.approx(1000.0 / WEIGHT)
    assert (values.eta_l, values.r_l) == (0, 0)
    assert values.drift == pytest.approx(1 / 3.5)
    assert values.spread == pytest.approx(1 / 3.5)


def test_eta_of_a_lopsided_motion_is_half_its_range() -> None:
    s, extremes = scale(), Extremes(0.005, -0.001, 2.0, -0.5, 0.0, 0.0, (), ())
    values = normalized_response(
        [CycleExtremes(500, 0, 0, int(Label.MEASURE), 500, extremes, None)], "measured", s
    )
    assert values is not None
    assert values.eta_d == pytest.approx(0.003 / s.u_star_m)
    assert values.eta_a == pytest.approx(1.25 / s.a_star_m_s2)


def test_drift_has_a_sign_and_spread_has_none() -> None:
    cycles = [cycle(k, u=u) for k, u in enumerate((0.003, 0.004, 0.002))]
    values = normalized_response(cycles, "measured",
                        scale())  # fmt: skip
    assert values is not None
    assert values.drift == pytest.approx(-1 / 3)
    assert values.spread == pytest.approx(2 / 3)


def test_the_scatter_of_eta_a_is_its_range_over_its_mean() -> None:
    cycles = [
        replace(cycle(k), measured=Extremes(0.003, -0.003, top, -1.0, 0.0, 0.0, (), ()))
        for k, top in enumerate((1.0, 1.4, 0.9))
    ]
    values = normalized_response(cycles, "measured", scale())
    assert values is not None
    assert values.spread == 0
    assert values.spread_a == pytest.approx(0.25 / 1.05)
    dead = [replace(cycle(0), measured=Extremes(0.003, -0.003, 0.0, 0.0, 0.0, 0.0, (), ()))]
    values = normalized_response(dead, "measured", scale())
    assert values is not None
    assert values.spread_a is None


def test_negative_gap_includes_precompression() -> None:
    """At rest both bumpers are pressed in by 1 mm and bear 510 N."""
    s = scale(replace(G4, gap_r=-0.001, gap_l=-0.001))
    still = np.zeros(500)
    swing = 1e-4 * np.sin(2 * math.pi * np.arange(500) / 500)
    pair = CycleMotion(swing, still, still + 561.0, still + 459.0)
    extremes, _ = cycle_extremes(pair, 0, s, UNKNOWN_CONTACT)
    values = normalized_response(
        [CycleExtremes(500, 0, 0, int(Label.MEASURE), 500, extremes, None)], "measured", s
    )
    assert values is not None
    assert values.eta_r == pytest.approx(1.1e-3 / s.u_star_m, rel=1e-5)
    assert values.eta_l == pytest.approx(1.1e-3 / s.u_star_m, rel=1e-5)
    assert values.r_r == pytest.approx(561.0 / WEIGHT)
    assert (values.impacts_right, values.impacts_left) == ((0,), (0,))


# The gap at contact onset


def impacting(parameters: Parameters, hz: float = 2.6) -> tuple[list[CycleMotion], float]:
    """(cycles with a sample of lead, steady and with noise; largest u in m) of the model."""
    lead, length, cycles = 1, round(RATE_HZ / hz), 12
    phase = 2 * math.pi * np.arange(length * cycles) / length
    out = np.empty((OUTPUT_COUNT, phase.size))
    advance_state(
        rest_state(parameters), discretized_params(parameters, RATE_HZ), LEVEL * np.sin(phase), out
    )
    u, a, right, left = out[0], out[2], out[3], -out[4]
    rng = np.random.default_rng(3)
    noisy = u + 5e-6 * rng.standard_normal(u.size)
    starts = [length * number for number in range(cycles - 4, cycles)]
    pieces = [slice(start - lead, start + length) for start in starts]
    return (
        [CycleMotion(noisy[k], a[k], right[k], left[k]) for k in pieces],
        float(u[starts[0] :].max()),
    )


@pytest.mark.parametrize("error_m", [0.0, 2e-5, 3e-4, -3e-4])
def test_eta_j_takes_the_gap_at_onset_where_the_stated_one_cannot_be(error_m: float) -> None:
    """The specimen's gap is 2 mm a side; the profile states it with an error."""
    motions, u_max = impacting(G4)
    s = replace(scale(), gaps_m=(0.002 + error_m, 0.002 + error_m))
    cycles, onsets, table = [], [], LEVEL * np.sin(2 * math.pi * np.arange(769) / 769)
    for number, piece in enumerate(motions):
        first = 1000 * number
        extremes, _ = cycle_extremes(piece, first, s, (False, False), 1)
        assert extremes is not None
        assert len(extremes.onsets_r) == len(extremes.onsets_l) == 1
        cycles.append(
            CycleExtremes(first + 769, 0, number, int(Label.MEASURE), 769, extremes, None)
        )
        onsets.append(extract_onset_depths(piece, extremes, first - 1))
    gaps = correct_gaps(s, onsets)
    if error_m == 0:
        assert gaps == s.gaps_m
    assert gaps == (pytest.approx(0.002, abs=8e-5), pytest.approx(0.002, abs=8e-5))
    point = build_prc_point(Step(0, "forward", 2.6, LEVEL), cycles, table, s, onsets)
    assert point.measured is not None
    want = (u_max - 0.002) / s.u_star_m
    assert point.measured.eta_r == pytest.approx(want, abs=9e-5 / s.u_star_m)
    # without the onsets the error of the gap is that of the deformation
    point = build_prc_point(Step(0, "forward", 2.6, LEVEL), cycles, table, s)
    assert point.measured is not None
    assert point.measured.eta_r == pytest.approx(want - error_m / s.u_star_m, abs=1e-3)


def test_noise_of_the_laser_raises_neither_eta_d_nor_eta_j() -> None:
    """Extremes of single cycles lie 8 um further out, by the noise left in their parabola."""
    s, length = scale(), 769
    phase = 2 * math.pi * np.arange(length * 60) / length
    out = np.empty((OUTPUT_COUNT, phase.size))
    advance_state(rest_state(G4), discretized_params(G4, RATE_HZ), LEVEL * np.sin(phase), out)
    u, a, right, left = (row[-4 * length :] for row in (out[0], out[2], out[3], -out[4]))
    starts = range(length, 4 * length, length)
    points = []
    for seed in range(8):
        noisy = u + 30e-6 * np.random.default_rng(seed).standard_normal(u.size)
        cycles = []
        for number, start in enumerate(starts):
            k = slice(start - s.lead_samples, start + length)
            extremes, _ = cycle_extremes(
                CycleMotion(noisy[k], a[k], right[k], left[k]), start, s, (False, False)
            )
            cycles.append(
                CycleExtremes(start + length, 0, number, int(Label.MEASURE), length, extremes, None)
            )
        step = Step(0, "forward", RATE_HZ / length, LEVEL)
        table = LEVEL * np.sin(phase[: 3 * length])
        points.append(
            [
                build_prc_point(step, cycles, table, s, (), u_m).measured
                for u_m in (noisy[length:], np.empty(0))
            ]
        )
    steady, single = (
        np.array([[p.eta_d, p.eta_r] for p in column if p is not None])
        for column in zip(*points, strict=True)
    )
    true_m = np.array([0.5 * np.ptp(u[length:]), u[length:].max() - 0.002])
    assert np.abs(s.u_star_m * steady.mean(axis=0) - true_m).max() < 2e-6
    assert (s.u_star_m * single.mean(axis=0) - true_m).min() > 6e-6


def test_without_an_onset_the_stated_gap_stays() -> None:
    still = motion(np.zeros(50), np.zeros(50))
    extremes, _ = cycle_extremes(still, 0, scale(), UNKNOWN_CONTACT)
    assert correct_gaps(scale(), [extract_onset_depths(still, extremes, 0)]) == (0.002, 0.002)
    assert correct_gaps(scale(), [extract_onset_depths(still, None, 0)]) == (0.002, 0.002)
    # a spurious contact on a bumper that is not there
    free = scale(FREE)
    spurious = (np.array([[1e-3], [1.1e-3]]), np.empty((2, 0)))
    assert correct_gaps(free, [spurious]) == (math.inf, math.inf)


def test_lost_load_cells_are_not_zeros() -> None:
    """Force and impacts are unknown; the deformation is that of the displacement."""
    s = scale()
    values = normalized_response([cycle(0, u=0.003, force=math.nan)], "measured", s)
    assert values is not None
    assert math.isnan(values.r_r)
    assert values.impacts_right == ()
    assert values.eta_r == pytest.approx(0.001 / s.u_star_m)


def test_no_measured_cycle_is_no_point() -> None:
    assert normalized_response([cycle(0, label=Label.SETTLE)], "measured", scale()) is None
    assert normalized_response([cycle(0)], "twin", scale()) is None


# The table


HARMONICS = {2: 0.03, 3: 0.02, 7: 0.01}


@pytest.mark.parametrize("cycles", [2, 3])
@pytest.mark.parametrize("hz", [0.53, 3.4, 4.7, 9.9])
def test_harmonics_of_the_table_at_40_db(hz: float, cycles: int) -> None:
    """Fundamental and THD within 0.5 % though a cycle is no whole number of samples."""
    rng = np.random.default_rng(5)
    n = math.ceil(cycles * RATE_HZ / hz)
    got = []
    for parts in ({}, HARMONICS):
        for _ in range(20):
            turn = 2 * math.pi * hz * np.arange(n) / RATE_HZ + rng.uniform(0, 2 * math.pi)
            x = np.sin(turn)
            for order, part in parts.items():
                x += part * np.sin(order * turn + rng.uniform(0, 2 * math.pi))
            noise = 0.01 / math.sqrt(2) * rng.standard_normal(n)
            got.append(measure_table_motion(LEVEL * (x + noise), hz, RATE_HZ)[1:])
    fundamental, thd = np.array(got).reshape(2, 20, 2).transpose(2, 0, 1)
    assert abs(fundamental / LEVEL - 1).max() < 0.005
    want = np.array([0.0, math.hypot(*HARMONICS.values())])
    assert (abs(thd - want[:, None]) < 0.005).all()
    assert abs(thd[1].mean() - want[1]) < 0.0005


def test_an_offset_of_the_accelerometer_is_no_harmonic() -> None:
    turn = 2 * math.pi * 4.7 * np.arange(852) / RATE_HZ
    peak, fundamental, thd = measure_table_motion(LEVEL * np.sin(turn) + 0.05, 4.7, RATE_HZ)
    assert peak == pytest.approx(LEVEL + 0.05, rel=1e-3)
    assert fundamental == pytest.approx(LEVEL, rel=1e-9)
    assert thd < 1e-9


def test_lost_samples_of_the_table_leave_it_unknown() -> None:
    x = np.sin(2 * math.pi * 4.0 * np.arange(1000) / RATE_HZ)
    x[500] = np.nan
    assert all(math.isnan(motion) for motion in measure_table_motion(x, 4.0, RATE_HZ))
    assert all(math.isnan(motion) for motion in measure_table_motion(np.empty(0), 4.0, RATE_HZ))


def test_a_point_says_step_direction_and_frequency() -> None:
    turn = 2 * math.pi * 4.0 * np.arange(1000) / RATE_HZ
    got = build_prc_point(
        Step(7, "backward", 4.0, LEVEL), make_cycles([]), LEVEL * np.sin(turn), scale()
    )
    assert (got.index, got.step, got.direction, got.frequency_hz) == (2000, 7, "backward", 4.0)
    assert got.measured is not None
    assert got.twin is None
    assert got.table_acc_fundamental_m_s2 == pytest.approx(LEVEL)
    assert got.table_acc_peak_m_s2 == pytest.approx(LEVEL)
