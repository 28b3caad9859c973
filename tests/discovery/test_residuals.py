"""Residuals: at the samples that they use they are those of the whole motion."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from tests.discovery.played import SNM, format_truth, log
from twin.discovery.learned_noise import limit_bumper_bands
from twin.discovery.nuisances import resolve_samples
from twin.discovery.parameters import (
    STIFFNESS,
    EffectKey,
    GapKey,
    ParameterKey,
    ParameterSet,
    TareKey,
)
from twin.discovery.residuals import CONTACT_ROWS, FORCE_ROWS, PULL_ROWS, build_log_residuals


@pytest.mark.parametrize(
    "values",
    [
        {},
        {EffectKey("cubic_stiffness", "k3"): 1e7},
        {EffectKey("table_tilt", "tilt"): 0.1},
        {EffectKey("bouc_wen", "force"): 1e2, EffectKey("bouc_wen", "yield_displacement"): 3e-3},
        {EffectKey("bumper_maxwell", "kb"): 2e5, EffectKey("bumper_maxwell", "tau"): 0.05},
    ],
)
def test_forces_at_the_used_samples_are_those_of_the_whole_motion(
    values: Mapping[ParameterKey, float],
) -> None:
    prepared = log()
    (of_facts,) = build_log_residuals([(prepared.signals, prepared.contact_n)], SNM)
    parameters = ParameterSet.from_model(SNM, 1).with_values(values)
    residuals = resolve_samples(of_facts, parameters)
    m = residuals.motion()
    whole = residuals.force_errors(parameters, m)
    noise = residuals.force_noise(m, m.mass_kg)
    rows = residuals.evaluate_rows(parameters, m)
    entry_row = residuals.entry_row[: rows.size]
    for row in range(len(FORCE_ROWS)):
        expected = whole[row][residuals.row_mask[row]] / noise[row]
        assert expected.size
        np.testing.assert_array_equal(rows[entry_row == row], expected)


def test_residuals_do_not_depend_on_what_was_evaluated_before() -> None:
    """Forces of the last models are kept, as most parameters of a fit change none."""
    prepared = log()
    pair = (prepared.signals, prepared.contact_n)
    (residuals,) = build_log_residuals([pair], SNM)
    start = ParameterSet.from_model(SNM, 1)
    others: list[dict[ParameterKey, float]] = [{STIFFNESS: 1e3 * k} for k in range(50, 60)]
    changes: list[dict[ParameterKey, float]] = [
        {},
        {STIFFNESS: 4e4},
        {TareKey(0, "u"): 1e-4},
        {TareKey(0, "acc"): 0.01},
        {TareKey(0, "acc"): 0.01, EffectKey("bouc_wen", "force"): 50.0,
         EffectKey("bouc_wen", "yield_displacement"): 1e-3},
        {GapKey(0): 2e-4},
        *others,
        {},
    ]  # fmt: skip
    results = []
    for change in changes:
        parameters = start.with_values(change)
        results.append(residuals.evaluate(parameters))
        (fresh,) = build_log_residuals([pair], SNM)
        np.testing.assert_array_equal(results[-1], fresh.evaluate(parameters))
    different = {entries.tobytes() for entries in results}
    assert len(different) == len(changes) - 1  # the last is the first


def test_ringing_before_a_step_of_the_force_is_neither_contact_nor_tension() -> None:
    """A dashpot in compression makes the force jump at touch; a band limit rings before it."""
    prepared = log(format_truth("compression_dashpot", coefficient=3000.0))
    (residuals,) = build_log_residuals([(prepared.signals, prepared.contact_n)], SNM)
    least_samples = 0.02 * residuals.motion().rate_hz  # of an impact; a ringing lasts 2 ms
    entries = residuals.evaluate(ParameterSet.from_model(SNM, 1))
    for side, name in enumerate(PULL_ROWS):
        changes = np.flatnonzero(np.diff(residuals.contact_state[side], prepend=0, append=0))
        assert changes.size > 80
        assert np.diff(changes)[::2].min() >= least_samples
        pulls = entries[residuals.entry_row == residuals.rows.index(name)]
        assert pulls.size > 200
        assert np.mean(pulls**2) < 1.0


def test_forces_are_fitted_up_to_where_they_exceed_the_noise_of_the_motion() -> None:
    """The stiff bumper makes force of the noise of a laser, at every frequency."""
    prepared, parameters = log(), ParameterSet.from_model(SNM, 1)
    bands = []
    for factor in (1.0, 10.0):
        noise = {name: factor * values for name, values in prepared.signals.noise.items()}
        signals = replace(prepared.signals, noise=noise)
        (residuals,) = build_log_residuals([(signals, prepared.contact_n)], SNM)
        bands.append(limit_bumper_bands(residuals, parameters).row_bands)
    quiet, loud = bands
    assert {*quiet} == {*CONTACT_ROWS}
    for name in CONTACT_ROWS:
        assert 1.0 < loud[name] <= quiet[name] <= prepared.signals.band_hz
    assert loud["right"] < 0.8 * quiet["right"]
