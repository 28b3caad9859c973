"""Intervals hold what the priors of nuisances leave open, whatever the weight of a recording."""

from dataclasses import replace

import pytest

from tests.discovery.played import prepare_bare_log
from twin.discovery.least_squares import fit_parameters
from twin.discovery.parameters import NuisanceKey


def test_a_nuisance_that_nothing_determines_is_as_uncertain_as_its_prior() -> None:
    prepared = prepare_bare_log()
    (residuals,) = prepared.problem.log_residuals
    key = next(k for k in prepared.parameters.values if isinstance(k, NuisanceKey))
    light = replace(residuals, weights=dict.fromkeys((*residuals.rows, "rest"), 1e6))
    fit = fit_parameters([light], prepared.parameters)
    assert fit.std_errors[key] == pytest.approx(1.0, rel=0.05)
