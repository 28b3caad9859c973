"""Points of a campaign where its sweeps of one gap overlap."""

import math

import pytest

from table_io.config.excitation.stepped_sine import Sweep
from table_io.records import PrcPoint
from twin.campaign.figures import _is_covered_finer


@pytest.mark.parametrize(
    ("direction", "hz", "is_covered"),
    [("forward", 3.4, True), ("backward", 3.4, False), ("forward", 4.4, False)],
)
def test_a_finer_sweep_of_one_direction_covers_its_own_points_only(
    direction: str, hz: float, is_covered: bool
) -> None:
    coarse = Sweep(start_hz=2.0, stop_hz=5.0, step_hz=0.2, cycles=4)
    finer = Sweep(start_hz=3.0, stop_hz=4.0, step_hz=0.1, cycles=4, directions=("forward",))
    point = PrcPoint(0, 0, direction, hz, None, None, math.nan, math.nan, math.nan)
    assert _is_covered_finer(point, coarse, [coarse, finer]) == is_covered
