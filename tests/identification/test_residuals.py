"""Residuals: at the samples that they use they are those of the whole motion."""

from collections.abc import Mapping

import numpy as np
import pytest

from tests.identification.played import SNM, log
from twin.identification.parameters import EffectKey, ParameterKey, ParameterSet, TermKey
from twin.identification.residuals import FORCE_ROWS, build_log_residuals


@pytest.mark.parametrize(
    "values",
    [
        {},
        {EffectKey("cubic_stiffness", "k3"): 1e7},
        {EffectKey("table_tilt", "tilt"): 0.1},
        {EffectKey("bouc_wen", "force"): 1e2, EffectKey("bouc_wen", "yield_displacement"): 3e-3},
        {EffectKey("bumper_maxwell", "kb"): 2e5, EffectKey("bumper_maxwell", "tau"): 0.05},
        {TermKey("damper resonator", "force"): 10.0, TermKey("damper resonator", "width"): 3.0},
    ],
)
def test_forces_at_the_used_samples_are_those_of_the_whole_motion(
    values: Mapping[ParameterKey, float],
) -> None:
    prepared = log()
    (residuals,) = build_log_residuals([(prepared.signals, prepared.contact_n)], SNM)
    parameters = ParameterSet.from_model(SNM, 1).with_values(values)
    m = residuals.motion()
    whole = residuals.force_errors(parameters, m)
    noise = residuals.force_noise(m, m.mass_kg)
    rows = residuals.evaluate_rows(parameters, m)
    entry_row = residuals.entry_row[: rows.size]
    for row in range(len(FORCE_ROWS)):
        expected = whole[row][residuals.row_mask[row]] / noise[row]
        assert expected.size
        np.testing.assert_array_equal(rows[entry_row == row], expected)
