"""Outcomes of continuation: folds, grazings and the largest stable motion."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from twin.compare.curves import FloatND
from twin.dynamics.continuation import Branch
from twin.dynamics.resonance_map import find_peaks
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

    rows = chunk.collect(describe, (len(FOLDS.variables),))
    return dict(zip([variable.name for variable in FOLDS.variables], rows.T, strict=True))


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
BRANCH_OUTCOMES = (FOLDS,)
