"""Batches: in order, the same on any number of cores."""

import numpy as np

from twin.model.model import Model
from twin.model.parameters import Parameters
from twin.model.sweep import stepped_sine
from twin.service.batch import at_gaps, batch

AG = 0.05 * 9.80665
G4 = Parameters(550.0, 36e3, 1100.0, 510e3, 900.0, 510e3, 900.0, 2e-3, 2e-3)


def test_a_batch_is_what_its_sweeps_are_one_by_one() -> None:
    models = at_gaps(Model(G4), [0.03, 0.01, 0.004, -0.002])
    models.append(Model(G4).with_effect("cubic_stiffness", k3=1e6))
    frequencies = [1.8, 2.0]
    one = batch(models, frequencies, AG, 4, cores=1)
    two = batch(models, frequencies, AG, 4, cores=2)
    for a, b in zip(one, two, strict=True):
        assert a.extremes.tobytes() == b.extremes.tobytes()
    for model, found in zip(models[:4], one, strict=False):
        want = stepped_sine(model.parameters, frequencies, AG, 4)
        assert np.array_equal(found.extremes, want.extremes)
    assert [m.parameters.gap_r for m in models[:4]] == [0.015, 0.005, 0.002, -0.001]
    assert batch([G4], frequencies, AG, 4)[0].extremes.tobytes() == one[2].extremes.tobytes()
