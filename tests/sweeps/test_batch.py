"""Batches: in order, the same on any number of cores."""

import numpy as np

from twin.model.model import Model
from twin.model.parameters import Parameters
from twin.model.stepped_sine import simulate_stepped_sine
from twin.studies.batch import iterate_sweeps, make_gap_variants, sweep_models

AG = 0.05 * 9.80665
G4 = Parameters(550.0, 36e3, 1100.0, 510e3, 900.0, 510e3, 900.0, 2e-3, 2e-3)


def test_a_batch_is_what_its_sweeps_are_one_by_one() -> None:
    models = make_gap_variants(Model(G4), [0.03, 0.01, 0.004, -0.002])
    models.append(Model(G4).with_effect("cubic_stiffness", k3=1e6))
    frequencies = [1.8, 2.0]
    single_core = sweep_models(models, frequencies, AG, 4, cores=1)
    two = sweep_models(models, frequencies, AG, 4, cores=2)
    for a, b in zip(single_core, two, strict=True):
        assert a.extremes.tobytes() == b.extremes.tobytes()
    for model, sweep in zip(models[:4], single_core, strict=False):
        want = simulate_stepped_sine(model.parameters, frequencies, AG, 4)
        assert np.array_equal(sweep.extremes, want.extremes)
    assert [m.parameters.gap_r for m in models[:4]] == [0.015, 0.005, 0.002, -0.001]
    assert (
        sweep_models([G4], frequencies, AG, 4)[0].extremes.tobytes()
        == single_core[2].extremes.tobytes()
    )


def test_once_asked_to_stop_no_sweep_begins_and_those_under_way_are_handed_out() -> None:
    models = make_gap_variants(Model(G4), [0.03, 0.02, 0.01, 0.004, 0.002, 0.0])
    whole = sweep_models(models, [1.8, 2.0], AG, 4)
    asked: list[bool] = []
    done = []
    for place, sweep in iterate_sweeps(models, [1.8, 2.0], AG, 4, cores=1, stop=lambda: asked):
        done.append(place)
        assert sweep.extremes.tobytes() == whole[place].extremes.tobytes()
        if place == 1:
            asked.append(True)
    assert done == sorted(done)
    assert done[:2] == [0, 1]
    slow = [G4] * 50
    handed = [place for place, _ in iterate_sweeps(slow, [1.8] * 40, AG, 200, 1, stop=lambda: True)]
    assert len(handed) < 5
