"""The peak of the table next to its fundamental, which is controlled."""

from types import SimpleNamespace
from typing import Any

import pytest

from twin.results.excitation_verdict import describe_peaks


def make_step(frequency_hz: float, excess: float, thd: float) -> Any:
    return SimpleNamespace(
        frequency_hz=frequency_hz,
        direction="forward",
        table_acc_fundamental_m_s2=0.49,
        table_acc_peak_m_s2=0.49 * (1.0 + excess),
        thd=thd,
    )


def test_peak_that_harmonics_raise_is_stated_with_the_worst_step_and_what_cancels_them() -> None:
    steps = [make_step(3.9, 0.12, 0.07), make_step(4.0, 0.15, 0.08), make_step(5.0, 0.02, 0.04)]
    (sentence,) = describe_peaks(steps)
    assert "at 2 of 3" in sentence
    assert "+15 % at 4 Hz" in sentence
    assert "control.harmonics" in sentence


@pytest.mark.parametrize("excess, thd", [(0.04, 0.08), (0.2, 0.01)])
def test_small_peaks_and_those_of_noise_are_not(excess: float, thd: float) -> None:
    assert describe_peaks([make_step(4.0, excess, thd)]) == []
