"""Extrapolation of a measured ratio over the frequency of a sweep."""

import math

import numpy as np
import pytest

from table_io.block import Float1D
from table_io.control.sweep_control import choose_curve, extrapolate_ratio, make_curve

LN_F = np.log(np.arange(2.0, 3.0, 0.02))
RESONANCE = 0.8 * np.exp(-(((LN_F - math.log(2.4)) / 0.03) ** 2))


@pytest.mark.parametrize("measured", [RESONANCE, 0.3 * LN_F])
def test_an_earlier_pass_counts_where_the_specimen_is_on_its_branch(measured: Float1D) -> None:
    """The earlier pass went through a resonance at 2.4 Hz; this one does, or does not.

    That it does not is seen from the second point of the resonance on.
    """
    known = make_curve(list(zip(LN_F.tolist(), RESONANCE.tolist(), strict=True)))
    points = list(zip(LN_F.tolist(), measured.tolist(), strict=True))
    for k in range(10, LN_F.size - 3):
        curve = choose_curve(points[:k], known)
        ahead = extrapolate_ratio(points[:k], curve, float(LN_F[k + 2]))
        assert ahead == pytest.approx(measured[k + 2], abs=0.11)


@pytest.mark.parametrize(("first", "then"), [(1.5, 7.0), (40.0, 40.0), (40.0, 15.0)])
def test_noise_does_not_decide_against_an_earlier_pass(first: float, then: float) -> None:
    """The earlier pass has a bend ahead of the points, or a flank steeper than MAX_SLOPE."""
    rng = np.random.default_rng(1)
    grid = np.linspace(-0.1, 0.2, 301)
    curve = np.where(grid < 0.05, first * grid, 0.05 * first + then * (grid - 0.05))
    known = make_curve(list(zip(grid.tolist(), curve.tolist(), strict=True)))
    at = np.linspace(0.0, 0.048, 5)
    for _ in range(200):
        measured = first * at + 0.001 * rng.standard_normal(5)
        points = list(zip(at.tolist(), measured.tolist(), strict=True))
        ahead = extrapolate_ratio(points, choose_curve(points, known), 0.088)
        assert ahead == pytest.approx(known(0.088), abs=0.02)


def test_a_pass_begins_with_what_is_known() -> None:
    known = make_curve([(0.0, 0.0), (1.0, 2.0)])
    assert extrapolate_ratio([], known, 0.5) == pytest.approx(1.0)
    assert extrapolate_ratio([(0.4, 1.0)], known, 0.5) == pytest.approx(1.2)
