"""Outcomes of nonlinear dynamics: folds and largest stable motion, basins of attraction."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from twin.compare.curves import FloatND
from twin.dynamics.basins import StartGrid, compute_basins
from twin.dynamics.continuation import Branch
from twin.dynamics.event_driven_map import make_period_map
from twin.dynamics.main_branches import find_peaks
from twin.studies.maps.cases import SampledCase
from twin.studies.maps.outcomes import CaseChunk, Outcome, OutcomeVariable

SAME_FOLD_DIGITS = 7  # of the frequency in Hz


def find_branch_folds(chunk: CaseChunk) -> Mapping[str, npt.NDArray[Any]]:
    """Return the folds of the primary resonance, its grazing, and the largest stable motion."""
    branches = chunk.branches

    def describe(index: int, _: SampledCase) -> FloatND:
        if not branches[index]:
            return np.full(len(FOLDS.variables), np.nan)
        return np.array([*locate_folds(branches[index]), *find_peaks(branches[index])])

    return chunk.collect_numbers(FOLDS.variables, describe)


def locate_folds(branches: Sequence[Branch]) -> tuple[float, float, float]:
    """Return (upper fold, lower fold, lowest grazing of the same branch) in Hz, NaN without.

    Of the branch with the highest fold: there a forward sweep falls, and at the lower fold a
    backward sweep jumps up.
    """
    nan = float("nan")
    folded = [branch for branch in branches if len(branch.folds) >= 2]
    if not folded:
        return nan, nan, nan
    branch = max(folded, key=lambda branch: max(fold.value for fold in branch.folds))
    # A branch that is followed to and fro has its folds twice, to the tolerance of Newton's method.
    folds = np.unique(np.round([fold.value for fold in branch.folds], SAME_FOLD_DIGITS)).tolist()
    if len(folds) < 2:
        return nan, nan, nan
    grazings = [bifurcation.value for bifurcation in branch.of_kind("grazing")]
    near = [value for value in grazings if value >= folds[-2]]
    return folds[-1], folds[-2], min(near, default=nan)


FOLDS = Outcome(
    "folds",
    "folds and largest stable motion, by continuation",
    (
        OutcomeVariable("upper_fold_hz", "Hz", "upper fold, where a forward sweep falls"),
        OutcomeVariable("lower_fold_hz", "Hz", "lower fold, where a backward sweep jumps up"),
        OutcomeVariable("grazing_hz", "Hz", "grazing between the folds"),
        OutcomeVariable("stable_disp_m", "m", "largest stable amplitude of displacement"),
        OutcomeVariable("stable_disp_hz", "Hz", "its frequency, displacement"),
        OutcomeVariable("stable_acc_m_s2", "m/s2", "largest stable amplitude of acceleration"),
        OutcomeVariable("stable_acc_hz", "Hz", "its frequency, acceleration"),
    ),
    find_branch_folds,
    needs_closed_form=True,
)


def measure_basins(chunk: CaseChunk) -> Mapping[str, npt.NDArray[Any]]:
    """Return which share of the initial states each kind of motion attracts at one frequency."""

    def measure(_: int, case: SampledCase) -> FloatND:
        settings = {**BASIN_DEFAULTS, **case.settings}
        side = round(settings["basins.starts_per_axis"])
        grid = StartGrid.from_limits(
            1e-3 * settings["basins.disp_mm"], settings["basins.vel_m_s"], side, side
        )
        frequency_hz = settings["basins.frequency_hz"]
        period_map = make_period_map(case.model, frequency_hz, case.acceleration_m_s2)
        basins = compute_basins(period_map, grid)
        in_contact = np.array([attractor.has_contact for attractor in basins.attractors])
        shares = basins.fractions
        return np.array(
            [shares[in_contact].sum(), shares.max(), len(basins.attractors), basins.undecided_share]
        )

    return chunk.collect_numbers(BASINS.variables, measure)


BASIN_DEFAULTS = {
    "basins.disp_mm": 6.0,
    "basins.vel_m_s": 0.15,
    "basins.starts_per_axis": 15.0,
}
BASINS = Outcome(
    "basins",
    "basins of attraction at one frequency",
    (
        OutcomeVariable("contact_share", "1", "share of starts that end in motions with contact"),
        OutcomeVariable("largest_share", "1", "share of the largest basin"),
        OutcomeVariable("attractor_count", "1", "number of attractors"),
        OutcomeVariable("undecided_share", "1", "share of starts that reach no attractor"),
    ),
    measure_basins,
    settings={
        "basins.frequency_hz": "Hz",
        "basins.disp_mm": "mm",
        "basins.vel_m_s": "m/s",
        "basins.starts_per_axis": "1",
    },
    required=("basins.frequency_hz",),
)
BRANCH_OUTCOMES = (FOLDS, BASINS)
