"""Sweeps of a batch: each what it is alone, at its own gap."""

import json

from tests.builders.profiles import format_test
from twin.dynamics.period_map import set_total_gap
from twin.model.model import Model
from twin.model.parameters import Parameters
from twin.model.stepped_sine import simulate_stepped_sine
from twin.setup.run_config import read_model
from twin.studies.batch import Batch, read_batch, simulate_case

AG = 0.05 * 9.80665
G4 = Parameters(550.0, 36e3, 1100.0, 510e3, 900.0, 510e3, 900.0, 2e-3, 2e-3)
TEST = format_test(3.0, 3.2, 0.2)


def test_a_gap_is_shared_by_both_sides() -> None:
    models = [set_total_gap(Model(G4), gap) for gap in (0.03, 0.01, -0.002)]
    assert [m.parameters.gap_r for m in models] == [0.015, 0.005, -0.001]
    assert [m.parameters.gap_l for m in models] == [0.015, 0.005, -0.001]


def test_a_case_is_the_sweep_of_its_model_from_rest() -> None:
    """Whoever computes it, and after whichever other case."""
    snm = read_model("snm")[1]
    hardening = snm + '[[effects]]\nid = "bumper_hardening"\nparameters = { k2 = 6e7 }\n'
    batch = Batch("here", TEST, (("snm", snm), ("hardening", hardening)), (30.0, 4.0))
    profile, cases = read_batch(batch)
    assert [case.name for case in cases] == [
        "snm, G = 30 mm", "snm, G = 4 mm", "hardening, G = 30 mm", "hardening, G = 4 mm"
    ]  # fmt: skip
    frequencies = [step.frequency_hz for step in profile.sweep.steps]
    want = simulate_stepped_sine(cases[1].model.parameters, frequencies, AG, 4).extremes
    result = simulate_case(batch, 1)
    assert [row["impacts_right"] for row in result.rows] == want[:, -2:, 6].mean(axis=1).tolist()
    assert {row["gap_mm"] for row in result.rows} == {4.0}
    for number in (3, 2, 1):
        simulate_case(batch, number)
    assert simulate_case(batch, 1).rows == result.rows
    assert simulate_case(batch, 3).rows != result.rows
    json.dumps(result.entry.to_plain(), allow_nan=False)
