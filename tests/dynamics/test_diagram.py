"""Complete bifurcation diagrams: the paper's G4, other parameters, and random models."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from tests.dynamics.random_models import (
    Findings,
    check_orbits,
    draw_case,
    find_missed,
    independent_return_error,
    study_case,
)
from tests.input_errors import raises_input_error
from tests.model.reference import AG, snm
from twin.dynamics import diagram as diagram_module
from twin.dynamics.bifurcations import BifurcationKind
from twin.dynamics.diagram import (
    Diagram,
    compute_diagram,
    cut_repetition,
    mirror_orbit,
    settle,
)
from twin.dynamics.event_driven_map import make_period_map
from twin.dynamics.orbits import find_orbit, reduce_period
from twin.model.model import Model

FAST_SEEDS = (4, 5, 7, 10)


@cache
def g4() -> Diagram:
    """G4 over the main resonance and the period doublings below it."""
    return compute_diagram(Model(snm()), (1.40, 5.0), AG, values=25, starts=4)


def values_of(diagram: Diagram, kind: BifurcationKind) -> list[float]:
    """The values of all bifurcations of a kind, each once."""
    values = [b.value for branch in diagram.branches for b in branch.of_kind(kind)]
    return sorted({round(value, 4) for value in values})


def test_g4_has_three_orbits_at_3_4_hz_one_unstable():
    orbits = sorted(g4().orbits_at(3.4), key=lambda orbit: orbit.u_max)
    assert [orbit.stable for orbit in orbits] == [True, False, True]
    assert [1e3 * orbit.u_max for orbit in orbits] == pytest.approx([1.247, 3.297, 5.123], abs=1e-3)


def test_g4_has_its_bifurcations():
    assert {2.7873, 4.0274} <= set(values_of(g4(), "fold"))
    assert {1.4366, 1.4617} <= set(values_of(g4(), "period doubling"))
    assert 2.7936 in values_of(g4(), "grazing")


def test_g4_has_branches_of_mirror_images_and_of_two_and_four_periods():
    orbits = [o for o in g4().orbits_at(1.6) if o.stable]
    asymmetric = [o for o in orbits if abs(o.u_max + o.u_min) > 1e-2 * o.u_max]
    assert len(asymmetric) == 2
    assert asymmetric[0].u_max == pytest.approx(-asymmetric[1].u_min, rel=1e-9)
    image = mirror_orbit(asymmetric[0])
    assert image is not None
    assert image.is_same(asymmetric[1])
    assert {1, 2, 4} <= {branch.points[0].orbit.periods for branch in g4().branches}


def test_g4_is_chaotic_below_1_41_hz():
    bands = g4().chaotic_bands
    assert any(band.low <= 1.41 and 0.1 < band.exponent < 1 for band in bands)
    assert all(band.high < 1.45 for band in bands)


def test_every_branch_states_why_it_ends():
    reasons = {end.reason for branch in g4().branches for end in branch.ends}
    assert reasons <= {
        "start", "range end", "closed loop",
        "meets another branch", "no convergence", "too many points",
    }  # fmt: skip


def test_no_branch_is_found_twice():
    for value in (1.5, 2.5, 3.4, 4.5):
        for branch in g4().branches:
            for orbit in branch.orbits_at(value):
                holders = [other for other in g4().branches if other.contains(orbit)]
                assert len(holders) == 1


def test_over_the_gap_at_3_4_hz_g4_grazes_and_folds():
    diagram = compute_diagram(
        Model(snm()), (1e-3, 12e-3), AG, parameter="gap", frequency_hz=3.4, values=12, starts=3
    )
    assert pytest.approx(find_nearest(diagram, "grazing", 2.493783e-3), abs=1e-9) == 2.493783e-3
    assert pytest.approx(find_nearest(diagram, "fold", 7.950152e-3), abs=1e-9) == 7.950152e-3
    assert len(diagram.orbits_at(4e-3)) == 3


def find_nearest(diagram: Diagram, kind: BifurcationKind, value: float) -> float:
    """The bifurcation of a kind that is nearest to a value."""
    values = [b.value for branch in diagram.branches for b in branch.of_kind(kind)]
    return min(values, key=lambda candidate: abs(candidate - value))


def test_over_the_level_the_impacting_orbit_begins_at_a_fold():
    diagram = compute_diagram(
        Model(snm()), (0.2 * AG, 2 * AG), AG, parameter="level", frequency_hz=3.4, values=10,
        starts=4,
    )  # fmt: skip
    assert len(diagram.orbits_at(AG)) == 3
    # All is in proportion to the gap: the gap 7.950152 mm at AG folds as G4 at a lower level.
    level = AG * 4 / 7.950152
    assert find_nearest(diagram, "fold", level) == pytest.approx(level, rel=1e-6)


def test_a_model_with_friction_has_a_diagram():
    model = Model(snm()).with_effect("coulomb_friction", fc=50.0)
    diagram = compute_diagram(model, (2.5, 4.5), AG, values=5, starts=3)
    orbits = sorted(diagram.orbits_at(3.2), key=lambda orbit: orbit.u_max)
    assert [orbit.stable for orbit in orbits] == [True, False, True]
    for orbit in orbits:
        assert independent_return_error(orbit) < 1e-4


@pytest.mark.slow  # 5 s
def test_random_starts_find_what_lies_between_the_values(monkeypatch):
    """A model with narrow isolas, at a few values of the frequency only."""
    case = draw_case(55)

    def count_branches():
        diagram = compute_diagram(case.model, case.limits, case.level, values=6, starts=8, seed=1)
        return len(diagram.branches)

    confirmed = count_branches()
    monkeypatch.setattr(diagram_module, "CONFIRMING_SHARE", 1000)
    assert count_branches() < confirmed


@pytest.mark.parametrize("seed", FAST_SEEDS)
def test_random_models_have_no_missing_and_no_false_orbit(seed):
    case, findings = draw_case(seed), Findings()
    diagram = compute_diagram(case.model, case.limits, case.level, values=41, starts=4, seed=seed)
    find_missed(case, diagram, 40, seed + 1_000_000, findings)
    check_orbits(diagram, 6, 1, seed, findings)
    assert findings.settled >= 30
    assert findings.missed == []
    assert findings.false == []
    assert findings.checked == 6


@pytest.mark.slow
@pytest.mark.timeout(0)
def test_a_hundred_random_models_have_no_missing_and_no_false_orbit():
    missed, false, settled = [], [], 0
    for seed in range(100):
        values, draws = (31, 3) if seed % 3 == 0 else (161, 10)
        _, _, findings = study_case(seed, 200, values, draws)
        missed += [(seed, *orbit) for orbit in findings.missed]
        false += [(seed, problem) for problem in findings.false]
        settled += findings.settled
    assert settled > 15_000
    assert missed == []
    assert false == []


def test_a_start_settles_to_its_least_period_or_to_chaos():
    period_map = make_period_map(Model(snm()), 1.45, AG)
    motion = settle(period_map, period_map.rest())
    assert motion.orbit is not None
    assert motion.orbit.periods == 2
    double = find_orbit(period_map, motion.orbit.x, 4)
    assert double is not None
    assert reduce_period(double).periods == 2
    later = find_orbit(period_map, period_map.iterate(motion.orbit.x, 1), 2)
    assert later is not None
    assert later.is_same(motion.orbit)
    chaos = settle(period_map.with_parameter("frequency", 0.71), period_map.rest())
    assert chaos.orbit is None
    assert chaos.is_chaotic


def test_a_repeated_loop_is_cut():
    branch = next(b for b in g4().branches if b.bifurcations)
    twice = replace(branch, bifurcations=(*branch.bifurcations, branch.bifurcations[0]))
    cut = cut_repetition(twice)
    assert cut.ends[1].reason == "closed loop"
    assert cut.bifurcations == branch.bifurcations
    assert cut_repetition(branch) is branch


def test_bad_input_is_named():
    model = Model(snm())
    with raises_input_error(key="frequency"):
        compute_diagram(model, (5.0, 0.5), AG)
    with raises_input_error(key="frequency_hz"):
        compute_diagram(model, (1e-3, 1e-2), AG, parameter="gap")
    with raises_input_error(key="acceleration_m_s2"):
        compute_diagram(model, (1.0, 2.0), math.nan)
    with raises_input_error(key="values", value=1):
        compute_diagram(model, (1.0, 2.0), AG, values=1)
    with raises_input_error(key="gpa"):
        compute_diagram(model, (1.0, 2.0), AG, parameter="gpa", frequency_hz=2.0)


def test_the_draw_holds_what_it_promises():
    cases = [draw_case(seed) for seed in range(100)]
    bases = [case.model.base for case in cases]
    assert sum(bool(case.effect) for case in cases) == 34
    assert len({case.effect for case in cases}) >= 9
    masses = np.array([base.mass for base in bases])
    assert masses.min() < 3
    assert masses.max() > 3e3
    for kind in (
        [base.gap_l == math.inf for base in bases],
        [base.gap_r < 0 for base in bases],
        [base.gap_r == 0 for base in bases],
        [base.gap_r != base.gap_l for base in bases],
        [base.bumper_damping_r == 0 for base in bases],
    ):
        assert sum(kind) >= 8
