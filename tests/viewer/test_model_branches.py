"""Branches in the PRC plot, and the fold ahead of the motion, for G4 at 0.05 g."""

from dataclasses import replace

import numpy as np
import pytest

from table_io.config.base import PROFILES_DIR
from table_io.records import NormalizedResponse, PrcPoint, RunStart
from twin.setup.run_config import read_run_config
from twin.viewer.model_branches import ModelBranches

FOLD_DOWN_HZ, FOLD_UP_HZ = 4.027372, 2.787294
NAN = float("nan")


@pytest.fixture(scope="module")
def start() -> RunStart:
    config = read_run_config(PROFILES_DIR / "tests" / "quickstart.toml")
    return config.make_start_factory("run", "table")({}, 0.0)


@pytest.fixture(scope="module")
def branches(start: RunStart) -> ModelBranches:
    branches = ModelBranches.from_start(start)
    assert branches is not None
    return branches


def make_point(
    direction: str, frequency_hz: float, u_m: float, branches: ModelBranches
) -> PrcPoint:
    """Return a PRC point whose measured motion has half a swing of `u_m`."""
    eta_d = u_m / branches.u_star_m
    response = NormalizedResponse(eta_d, NAN, NAN, NAN, NAN, NAN, (), (), NAN, NAN)
    return PrcPoint(0, 0, direction, frequency_hz, response, None, NAN, NAN, NAN)


@pytest.mark.parametrize(
    ("direction", "u_mm", "fold_hz"),
    [("forward", 5.123, FOLD_DOWN_HZ), ("backward", 1.247, FOLD_UP_HZ)],
)
def test_the_fold_ahead_is_that_of_the_measured_branch(
    branches: ModelBranches, direction: str, u_mm: float, fold_hz: float
) -> None:
    fold = branches.find_fold(make_point(direction, 3.4, 1e-3 * u_mm, branches))
    assert fold is not None
    assert fold.fold_hz == pytest.approx(fold_hz, abs=1e-5)
    assert fold.distance_hz == pytest.approx(abs(fold_hz - 3.4), abs=1e-5)


def test_no_fold_lies_ahead_where_the_branch_leaves_the_range(branches: ModelBranches) -> None:
    assert branches.find_fold(make_point("backward", 3.4, 5.123e-3, branches)) is None
    assert branches.find_fold(make_point("forward", 3.4, 1.247e-3, branches)) is None


def test_a_motion_on_no_branch_has_no_fold(branches: ModelBranches) -> None:
    assert branches.find_fold(make_point("forward", 3.4, 2.3e-3, branches)) is None
    point = make_point("forward", 3.4, 5.123e-3, branches)
    assert branches.find_fold(replace(point, measured=None)) is None


def test_the_shares_of_both_motions_are_the_whole(branches: ModelBranches) -> None:
    """Every start leads to one of two motions, and the impacting one fades towards its fold."""
    shares = []
    for frequency_hz, high_mm, low_mm in ((3.4, 5.123, 1.247), (4.0, 6.52, 0.86)):
        pair = [
            branches.find_fold(make_point(direction, frequency_hz, 1e-3 * u_mm, branches))
            for direction, u_mm in (("forward", high_mm), ("backward", low_mm))
        ]
        assert None not in pair
        shares.append([fold.basin_share for fold in pair if fold is not None])
    assert np.sum(shares, axis=1) == pytest.approx([1.0, 1.0], abs=1e-9)
    assert shares[0][0] > shares[1][0] + 0.2


def test_the_drawn_lines_cover_the_branch_and_its_unstable_part_is_dashed(
    branches: ModelBranches,
) -> None:
    lines = [line for _, line in branches.draw()]
    ends = np.concatenate(lines)
    assert ends[:, 0].min() == pytest.approx(2.4)
    assert ends[:, 0].max() == pytest.approx(4.4)
    (branch,) = branches.branches
    unstable = branches.eta_d(branch)[~branch.stable]
    dashes = [line for line in lines if len(line) == 2]
    assert len(dashes) > 20
    middle = np.array([line.mean(axis=0) for line in dashes])
    assert middle[:, 1].min() > unstable.min() * 0.98
    assert middle[:, 1].max() < unstable.max() * 1.02


def test_a_run_without_a_model_has_no_branches(start: RunStart) -> None:
    assert ModelBranches.from_start(replace(start, model_toml="")) is None
    assert ModelBranches.from_start(replace(start, steps=start.steps[:1])) is None
