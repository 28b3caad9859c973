"""Map of the resonance over the gap: peaks against slow sweeps, loci against single branches."""

from dataclasses import replace

import numpy as np
import pytest

from table_io.config.base import PROFILES_DIR
from table_io.units import GRAVITY_M_S2
from twin.dynamics.continuation import continue_branch
from twin.dynamics.event_driven_map import make_period_map
from twin.dynamics.main_branches import (
    ResonanceMap,
    compute_resonance_map,
    find_peaks,
    follow_main_branches,
    follow_sweep_branches,
    half_swings,
)
from twin.dynamics.orbits import settle_to_orbit
from twin.dynamics.period_map import FREQUENCY, GAP
from twin.model.model import Model
from twin.model.stepped_sine import simulate_stepped_sine
from twin.setup.run_config import read_run_config

LEVEL_M_S2 = 0.05 * GRAVITY_M_S2
LIMITS_HZ = (1.8, 6.0)
GAPS_M = (0.002, 0.004, 0.01)
MODEL = read_run_config(PROFILES_DIR / "tests" / "g4_ss3.toml").model
PERIOD_MAP = make_period_map(MODEL, LIMITS_HZ[1], LEVEL_M_S2)


@pytest.fixture(scope="module")
def resonance() -> ResonanceMap:
    return compute_resonance_map(PERIOD_MAP, GAP, GAPS_M, LIMITS_HZ)


@pytest.mark.parametrize("index", range(len(GAPS_M)))
def test_the_peaks_are_those_of_a_slow_sweep(resonance: ResonanceMap, index: int) -> None:
    period_map = PERIOD_MAP.with_parameter(GAP, GAPS_M[index])
    peaks = resonance.peaks
    frequencies = np.arange(1.8, peaks.u_hz[index] + 0.05, 0.005)
    sweep = simulate_stepped_sine(period_map.model.parameters, frequencies, LEVEL_M_S2, 60)
    u = (sweep.column("u_max") - sweep.column("u_min"))[:, -1] / 2
    a = (sweep.column("a_max") - sweep.column("a_min"))[:, -1] / 2
    assert peaks.u_m[index] == pytest.approx(u.max(), rel=2e-3)
    assert peaks.u_hz[index] == pytest.approx(frequencies[u.argmax()], abs=0.02)
    assert peaks.a_m_s2[index] == pytest.approx(a.max(), rel=2e-3)


def test_the_loci_pass_the_bifurcations_of_another_gap(resonance: ResonanceMap) -> None:
    """Folds and grazing at 6 mm, which is not among the gaps of the map."""
    gap_m = 0.006
    start = settle_to_orbit(PERIOD_MAP.with_parameter(GAP, gap_m))
    assert start is not None
    branch = continue_branch(start, FREQUENCY, LIMITS_HZ)
    bifurcations = branch.of_kind("fold", "grazing")
    assert len(bifurcations) == 3
    for bifurcation in bifurcations:
        crossings = [
            float(np.interp(gap_m, *pair.T[::-1]))
            for locus in resonance.loci
            if locus.kind == bifurcation.kind
            for pair in (sorted_pair(locus.values[i : i + 2]) for i in range(len(locus.values) - 1))
            if pair[0, 1] <= gap_m <= pair[1, 1]
        ]
        assert min(abs(hz - bifurcation.value) for hz in crossings) < 2e-3


def sorted_pair(pair: np.ndarray) -> np.ndarray:
    """Return two points in order of their second coordinate."""
    return pair[np.argsort(pair[:, 1])]


def test_a_peak_outside_of_the_range_is_unknown() -> None:
    """The resonance of a wide gap lies below 1.3 Hz."""
    resonance = compute_resonance_map(PERIOD_MAP, GAP, (0.1, 0.2), (2.0, 3.0))
    assert np.isnan(resonance.peaks.u_m).all()


def test_the_main_branch_of_g4_holds_the_three_solutions_at_3_4_hz() -> None:
    branches = follow_main_branches(PERIOD_MAP, LIMITS_HZ)
    orbits = [orbit for branch in branches for orbit in branch.orbits_at(3.4)]
    amplitudes_mm = sorted(500 * (orbit.u_max - orbit.u_min) for orbit in orbits)
    assert amplitudes_mm == pytest.approx([1.247, 3.297, 5.123], abs=1e-3)
    assert [orbit.stable for orbit in orbits].count(False) == 1


def test_a_small_motion_at_the_end_of_the_range_hides_no_peak() -> None:
    """A subharmonic at the lower end, far below the primary resonance, is followed too."""
    config = read_run_config(PROFILES_DIR / "tests" / "g4_ss3.toml")
    base = replace(config.model.base, mass=528.585, gap_r=1.99611e-3, gap_l=1.99611e-3)
    branches = follow_sweep_branches(
        Model(base), config.profile.sweep.frequencies_hz, [0.0451172 * GRAVITY_M_S2]
    )
    assert any(
        branch.ends[0].reason == "range end" and branch.values.max() < 1.0 for branch in branches
    )
    u, u_hz, a, a_hz = find_peaks(branches)
    assert (u_hz, a_hz) == pytest.approx((3.9348, 3.9350), abs=1e-3)
    main = max(branches, key=lambda branch: branch.values.max())
    swings = np.array([half_swings(point.orbit) for point in main.points])[main.stable]
    assert (u, a) == pytest.approx(swings.max(axis=0), rel=2e-3)


def test_a_branch_passes_a_grazing_that_another_one_is_near() -> None:
    """At 0.5939 Hz a second guard comes near zero; the branch goes on to its fold at 0.5934 Hz."""
    config = read_run_config(PROFILES_DIR / "tests" / "g4_ss3.toml")
    half_gap_m = 0.5e-3 * 4.331536849588156
    base = replace(
        config.model.base, mass=498.3017811458558, gap_r=half_gap_m, gap_l=half_gap_m
    )  # fmt: skip
    (main, *_) = sorted(
        follow_sweep_branches(
            Model(base),
            config.profile.sweep.frequencies_hz,
            [0.04756747011095285 * GRAVITY_M_S2],
        ),
        key=lambda branch: -np.ptp(branch.values),
    )
    assert sorted(end.value for end in main.ends) == pytest.approx([0.5, 5.0], abs=1e-9)
    folds = sorted(fold.value for fold in main.folds)
    assert np.diff(folds).min() > 1e-3  # none twice
    assert folds == pytest.approx([0.5934, 0.6305, 0.8882, 0.9788, 2.6804, 3.9883], abs=1e-3)
