"""The force drawn for a law is that which the record requires."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from tests.recovery.scaled_specimens import Hidden, prepare, record_block, simulate, start_model
from twin.discovery.discover import Discovery, PreparedLog, discover_effects
from twin.discovery.figure_data import DiscoveryView
from twin.discovery.parameters import EffectKey

CUBIC = Hidden("cubic_stiffness", 3e6)


@cache
def without_accelerometer() -> tuple[Discovery, PreparedLog]:
    """A record whose force of inertia is a second derivative: its balance is whitened in a fit."""
    block = record_block(CUBIC, noise=2e-4)
    kept = [k for k, name in enumerate(block.channels) if name != "mass_acc_m_s2"]
    bare = replace(
        block, channels=tuple(block.channels[k] for k in kept), values=block.values[kept]
    )
    log = prepare(bare, CUBIC)
    return discover_effects([log], start_model()), log


def test_the_law_is_that_of_the_effect_over_its_displacement() -> None:
    discovery, log = without_accelerometer()
    assert discovery.verdict.best.names == ("cubic_stiffness",)
    (forces,) = DiscoveryView(discovery, [log]).forces_of_each
    u = simulate(CUBIC)[0]
    law = CUBIC.a * u**3
    k3 = discovery.verdict.best.fit.values[EffectKey("cubic_stiffness", "k3")]
    assert k3 == pytest.approx(CUBIC.a, rel=0.02)
    used = np.isfinite(forces.law[0])
    assert used.sum() > 0.8 * u.size
    largest = float(np.abs(law).max())
    assert forces.law[0][used] == pytest.approx(law[used], abs=0.03 * largest)
    required = forces.required[0][used]
    assert np.corrcoef(required, law[used])[0, 1] > 0.95
    assert np.isnan(forces.law[1:]).all()
