"""Figures of attractors: each is drawn, on a light and on a dark ground, with what it claims."""

import matplotlib as mpl
import numpy as np
import pytest

from tests.model.reference import AG, snm
from twin.drawing.basin_figures import (
    KIND_COLOURS,
    describe_kind,
    draw_basin_fractions,
    draw_basin_map,
    draw_bifurcation_diagram,
    draw_section,
)
from twin.drawing.pictures import save_figures
from twin.dynamics.basins import (
    StartGrid,
    compute_basins,
    compute_basins_over,
    find_chaotic_bands,
    follow_attractor,
    record_section,
)
from twin.dynamics.event_driven_map import make_period_map
from twin.model.model import Model

POINT = make_period_map(Model(snm()), 3.4, AG)
GRID = StartGrid.from_limits(6e-3, 0.15, 7, 7)


@pytest.mark.parametrize("dark", [False, True])
def test_every_figure_is_drawn(tmp_path, dark):
    def figures():
        yield draw_basin_map(compute_basins(POINT, GRID), np.array([[1.02e-3, 61.2e-3]]))
        values = np.array([1.2, 3.4])
        results = compute_basins_over(POINT, "frequency", values, GRID)
        yield draw_basin_fractions(results, "frequency", values)
        yield draw_section(record_section(POINT, 0.0, 0.0, 50), "3.4 Hz")
        up = follow_attractor(POINT, "gap", np.array([2e-3, 4e-3]))
        yield draw_bifurcation_diagram(up, up, find_chaotic_bands([up], 1e-4))

    pictures = save_figures(figures(), tmp_path, dark)
    assert len(pictures) == 4
    for picture in pictures:
        corner = mpl.image.imread(picture.path)[0, 0, :3].mean()
        assert (corner < 0.2) == dark


@pytest.mark.parametrize(
    "frequency, kinds",
    [
        (1.1, {"chaotic"}),
        (1.18, {"period 2 or more"}),
        (1.64, {"period 1, mirror pair"}),
        (3.4, {"period 1", "no contact"}),
    ],
)
def test_kinds_of_attractors(frequency, kinds):
    attractors = compute_basins(POINT.with_parameter("frequency", frequency), GRID).attractors
    described = {describe_kind(attractors, index) for index in range(len(attractors))}
    assert described == kinds
    assert described <= set(KIND_COLOURS)


def test_shares_of_the_figure_add_up_and_chaos_is_named():
    up = follow_attractor(POINT, "frequency", np.array([1.10, 1.12]), 500)
    drawing = draw_bifurcation_diagram(up, up, bands=find_chaotic_bands([up], 1e-3))
    assert "1.1 to 1.12" in drawing.caption
