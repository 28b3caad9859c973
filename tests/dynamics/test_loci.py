"""Loci of bifurcations over two parameters."""

import math

import numpy as np
import pytest

from tests.dynamics.maps import FormulaMap, model_map, settle
from tests.input_errors import raises_input_error
from tests.model.reference import AG
from twin.dynamics.continuation import continue_branch
from twin.dynamics.loci import continue_locus

GAP_LIMITS, LEVEL_LIMITS = ((1.3, 5.5), (0.0, 0.03)), ((1.4, 5.0), (0.05, 2.0))


@pytest.fixture(scope="module")
def g4():
    return continue_branch(settle(model_map(), 5.0), "frequency", (1.8, 5.0))


def flight_amplitude(frequency, level):
    w = 2 * math.pi * frequency
    return level / np.abs(36e3 / 550 - w * w + 2j * w)


def test_grazings_are_those_of_linear_flight(g4) -> None:
    (grazing,) = g4.of_kind("grazing")
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


def test_permanent_contact_begins_at_the_lowest_grazing_of_the_push(g4) -> None:
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


def test_locus_of_period_doublings_and_what_has_none() -> None:
    """x -> r x (1 - x) - level doubles its period where (r - 1)^2 = 4 + 4 r level (by hand)."""
    logistic = FormulaMap(lambda x, r: [r * x * (1 - x)])
    branch = continue_branch(logistic.find([0.6], 2.5), "frequency", (2.0, 4.0))
    (doubling,) = branch.of_kind("period doubling")
    locus = continue_locus(doubling, ("frequency", "level"), ((2.0, 4.0), (-1.0, 1.0)))
    assert locus.values[:, 0] == pytest.approx(3.0, abs=1e-8)  # the level has no effect
    assert {locus.values[0, 1], locus.values[-1, 1]} == {-1.0, 1.0}
    with raises_input_error(key="gap", value=0.004):
        g4 = continue_branch(settle(model_map(), 5.0), "frequency", (2.0, 5.0))
        continue_locus(g4.folds[0], ("frequency", "gap"), ((1.3, 5.5), (0.01, 0.03)))
