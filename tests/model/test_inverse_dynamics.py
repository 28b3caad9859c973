"""Forces along a motion are those of the solver that made it, its hidden states included."""

import numpy as np
import pytest

from tests.model.cases import FORCES, RATE_HZ, drive, having
from tests.model.motion import sine
from twin.laws.library import find_effect
from twin.model.inverse_dynamics import forces_along
from twin.model.model import Model
from twin.model.solver import StateEstimate

RELAXING = [
    having(find_effect("bumper_maxwell"), values=lambda _, kb=kb, tau=tau: {"kb": kb, "tau": tau})
    for kb, tau in ((3e5, 0.04), (2e6, 0.03), (1e5, 0.5))
]


def name(model: Model) -> str:
    return "+".join(effect.name for effect in model.effects)


@pytest.mark.parametrize("model", [*map(having, FORCES), *RELAXING], ids=name)
def test_the_forces_are_those_that_the_motion_was_made_with(model: Model) -> None:
    base = 2.0 * sine(2.6, RATE_HZ, 4.0)
    _, out = drive(model, base, StateEstimate(0, 0.0, 0.0), RATE_HZ)
    u, v, _, right, left = out[:5]
    time = np.arange(1, u.size + 1) / RATE_HZ
    touched = np.array([right > 0.0, left < 0.0]).astype(np.int8)
    forces = forces_along(model, u, v, base, time, touched)
    for side, (expected, measured) in enumerate(zip((right, left), touched, strict=True)):
        inside = (measured > 0) & (np.roll(measured, 1) > 0)  # a touch falls between two samples
        assert inside.sum() > 200
        error = np.abs(forces[1 + side] - expected)[inside].max()
        assert error < 1e-3 * np.abs(expected).max(), error / np.abs(expected).max()
