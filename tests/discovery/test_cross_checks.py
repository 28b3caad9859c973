"""Warnings of an identification on estimates that disagree."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from twin.discovery import cross_checks
from twin.discovery.build_verdict import build_interval, build_parameter
from twin.discovery.contact_onsets import ContactGaps
from twin.discovery.cross_checks import SubsetEstimate, list_disagreements
from twin.discovery.least_squares import FitResult
from twin.discovery.motion import RecordScale
from twin.discovery.page import format_estimate
from twin.discovery.parameters import FreeParameter, GapKey, ParameterKey, ParameterSet
from twin.discovery.result import Interval

KEYS: list[ParameterKey] = [GapKey(log) for log in range(12)]


def test_disagreements_come_in_the_order_of_the_parameters() -> None:
    free = tuple(FreeParameter(key, -math.inf, math.inf, 1.0, "m") for key in KEYS)
    joint = FitResult(
        ParameterSet(dict.fromkeys(KEYS, 0.0), free), dict.fromkeys(KEYS, 0.0),
        dict.fromkeys(KEYS, 1e-5), np.eye(len(KEYS)), 1.0, True, (),
    )  # fmt: skip
    apart = [
        SubsetEstimate(source, dict.fromkeys(keys, (value, 1e-5)), 1000, True)
        for source, value, keys in (("early", 0.0, KEYS), ("late", 1e-3, [*KEYS[::-1]][:-1]))
    ]
    scale = RecordScale(0.02, 0.2, 3.0, 1e-3, 1650.0, 5e-3, 2e-3, 25.0, {})
    names = [text.split(":")[0] for text in list_disagreements(joint, apart, scale)]
    assert names == [str(key) for key in KEYS[1:]]


def test_too_few_cycles_give_no_interval() -> None:
    few, many = KEYS[:2]
    fit = FitResult(
        ParameterSet({}), {}, {few: 5.0, many: 0.1}, np.eye(2), 1.0, True, (), (),
        {few: 1.4, many: 12.0},
    )  # fmt: skip
    assert math.isinf(fit.interval_error(few))
    assert fit.interval_error(many) == 0.1
    estimate = build_interval(36e3, fit.interval_error(few), "N/m")
    assert format_estimate(estimate) == "36.00 kN/m"
    fitted = replace(fit, values={few: 36e3})
    parameter = build_parameter(fitted, FreeParameter(few, 0.0, 1e6, 1.0, "N/m"))
    limits = Interval.model_validate_json(parameter.to_json())
    assert limits == parameter
    assert (limits.value, limits.low, limits.high) == (36e3, None, None)


@pytest.mark.parametrize(("shift_mm", "is_warned"), [(-0.06, False), (-0.14, True), (0.14, True)])
def test_onsets_are_off_where_they_lie_beyond_their_scatter(
    monkeypatch: pytest.MonkeyPatch, shift_mm: float, is_warned: bool
) -> None:
    """A filter moves all onsets by about as much as they scatter, a law of the bumper by more."""
    monkeypatch.setattr(cross_checks, "fitted_gap", lambda *_: 2e-3)
    spread_m = 0.034e-3 / 1.4826 * np.resize([-1.0, 1.0], 160)
    gaps = ContactGaps(0, "right", "onset", 2e-3 + 1e-3 * shift_mm + spread_m, np.zeros(160))
    log: Any = SimpleNamespace(
        signals=SimpleNamespace(name="log"), scale=SimpleNamespace(u=5e-3), log_number=0
    )
    joint: Any = SimpleNamespace(std_errors={})
    assert len([*cross_checks.list_onset_warnings([log], joint, [gaps])]) == is_warned
