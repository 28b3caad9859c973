"""The study of laws: what it measures of a model, and the page of its rows."""

import math
from dataclasses import replace

import numpy as np
import pytest

from table_io.block import Label
from tests.discovery.played import SNM
from tests.studies.blind.law_study import (
    STEADY_CYCLES,
    STRONGER_TEST,
    UNUSED_TEST,
    format_page,
    list_steady_samples,
    measure_curve_error,
    measure_force_error,
)
from tests.studies.blind.rig import PROFILE, make_rig_toml, simulate_signals

NOISE = np.array([1.0, 1.0, 1.0])


@pytest.fixture(scope="module")
def signals():
    return simulate_signals(make_rig_toml(0.0), UNUSED_TEST)


def with_base(**ratios):
    right, left = PROFILE.specimen.gaps_m
    base = replace(SNM.base, mass=PROFILE.specimen.mass_kg, gap_r=right, gap_l=left)
    values = {name: ratio * getattr(base, name) for name, ratio in ratios.items()}
    return replace(SNM, base=replace(base, **values))


def test_the_other_tests_are_stronger_and_between_the_frequencies():
    assert STRONGER_TEST.sweep.acceleration_g == 1.25 * PROFILE.sweep.acceleration_g
    own, other = PROFILE.sweep.frequencies_hz, UNUSED_TEST.sweep.frequencies_hz
    assert set(own).isdisjoint(other)
    assert min(own) < min(other)
    assert max(other) < max(own)


def test_the_true_model_has_no_error_and_another_one_has(signals):
    true, stiffer = with_base(), with_base(stiffness=1.3)
    assert measure_curve_error(true, signals) < 0.02 < measure_curve_error(stiffer, signals)
    own, other = (measure_force_error(model, signals, NOISE) for model in (true, stiffer))
    assert own < 0.05 * other
    u = signals.channels["mass_disp_m"] - signals.channels["table_disp_m"]
    expected = 0.3 * true.base.stiffness * np.std(u[signals.moving])
    # the rows of the bumpers, in contact alone, have no error
    assert 0.6 * expected < other < 1.05 * expected


def test_a_curve_is_that_of_steady_motion(signals):
    """Not of chaos at 1.4 Hz, nor of what comes after it, nor of the passages between steps."""
    steady = np.zeros(signals.step.size, bool)
    steady[np.concatenate(list_steady_samples(signals))] = True
    hz = np.array([step.frequency_hz for step in UNUSED_TEST.sweep.steps])
    counted = np.unique(signals.step[steady])
    assert hz[1] == hz[-2] == 1.4
    assert not {1, 2, hz.size - 2, hz.size - 1} & set(counted)
    assert {1.0, 2.2, 2.6, 3.0, 3.4, 1.8} <= set(hz[counted])
    for number in counted:
        cycles = (steady & (signals.step == number)).sum() * hz[number] / 1000.0
        assert cycles == pytest.approx(STEADY_CYCLES, abs=0.02)
    model, acc = with_base(), signals.channels["mass_acc_m_s2"]

    def spoil(is_spoiled):
        channels = {**signals.channels, "mass_acc_m_s2": np.where(is_spoiled, 2 * acc, acc)}
        return measure_curve_error(model, replace(signals, channels=channels))

    own = measure_curve_error(model, signals)
    assert spoil(~steady) == own < 1e-3
    restless = replace(signals, label=np.where(signals.step < 13, Label.BLEND, signals.label))
    assert math.isnan(measure_curve_error(model, restless))
    assert spoil(steady) > own + 0.2


def make_row(number, after, warnings=(), error=1.0, law=True, kind="unknown"):
    return {
        "number": number, "cell": "unknown/cubic_damping/3/1%", "kind": kind, "noise": 0.01,
        "sized": True, "before": 3.0, "after": after, "seconds": 10.0, "wall_s": 12.0,
        "law": [{"force": "k * v", "values": {"k": 1.0}}] if law else [], "exact": law,
        "outside": {"error": error, "said": [*warnings]}, "curve": {"before": 0.1, "after": 0.005},
        "forces": after, "rivals": {"pysindy": {"forces": 2.0}},
    }  # fmt: skip


def test_the_page_counts_what_reaches_its_goal():
    rows = [
        make_row(1, 1.0), make_row(2, 1.2, ["law.u"], 9.0), make_row(3, 1.0, error=9.0),
        make_row(4, 3.0, law=False), make_row(5, 1.0, law=False, kind="none"),
    ]  # fmt: skip
    text = "\n".join(format_page(rows))
    assert "<= 1.1 x floor | >= 85 % | 50.0 % (2/4;" in text
    assert "or said | >= 90 % | 66.7 % (2/3;" in text
    assert "nothing hidden: a law proposed | <= 2 % | 0.0 % (0/1;" in text
    assert "| pysindy | 2.000 | 0.0 % (0/4;" in text
