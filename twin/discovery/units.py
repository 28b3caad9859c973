"""Units of a recording that are judged together, and their cross-validation folds."""

import numpy as np

from table_io.block import Int1D
from twin.discovery.residuals import LogResiduals

FOLD_COUNT, NEVER_HELD_OUT = 3, -1
MIN_STEP_UNITS = 6  # with fewer steps, blocks are held out instead


def assign_units(residuals: LogResiduals) -> Int1D:
    """Return the unit of each entry, (entry,): its step or its block; the rest row comes last."""
    step = residuals.signals.step[residuals.entry_sample]
    steps = np.unique(step[step >= 0])
    if steps.size >= MIN_STEP_UNITS:
        # samples outside steps belong to the preceding step
        log_step = residuals.signals.step
        last = np.maximum.accumulate(np.where(log_step >= 0, np.arange(log_step.size), 0))
        step = log_step[last][residuals.entry_sample]
    else:
        step = residuals.entry_block
    at_rest = residuals.entry_row == len(residuals.rows)
    number = np.unique(step, return_inverse=True)[1]
    return np.where(at_rest, number.max() + 1, number)


def assign_folds(residuals: LogResiduals) -> Int1D:
    """Return the cross-validation fold of each entry, (entry,); the rest row is never held out."""
    at_rest = residuals.entry_row == len(residuals.rows)
    return np.where(at_rest, NEVER_HELD_OUT, assign_units(residuals) % FOLD_COUNT)
