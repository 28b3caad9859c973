"""Component tests of a damper alone: a force at rest, and cycles that do not repeat."""

import numpy as np
import pytest

from table_io.block import Block, Label
from tests.recovery.recordings import oscillator
from twin.discovery.discover import PreparedLog, discover_effects
from twin.discovery.parameters import EffectKey
from twin.discovery.signals import build_signals

STIFFNESS, DAMPING, FRICTION = 20e3, 300.0, 15.0
RATE_HZ, CYCLES, REST_S = 200.0, 30, 2.0


def play_component_test(preload: float, last_share: float) -> PreparedLog:
    """One frequency, from 5 mm down to a share of it; friction, with noise of 1 um and 0.2 N."""
    rng = np.random.default_rng(7)
    rest, cycle = round(REST_S * RATE_HZ), round(RATE_HZ)
    time = np.arange(CYCLES * cycle) / RATE_HZ
    amplitude = 5e-3 * np.linspace(1.0, last_share, time.size)
    moved = amplitude * np.sin(2 * np.pi * time)
    speed = np.gradient(moved) * RATE_HZ
    force = STIFFNESS * moved + DAMPING * speed + FRICTION * np.tanh(speed / 5e-4) + preload
    still = np.zeros(rest)
    u = np.concatenate([still, moved]) + 1e-6 * rng.standard_normal(rest + time.size)
    f = np.concatenate([still + preload, force]) + 0.2 * rng.standard_normal(u.size)
    in_motion = np.arange(u.size) >= rest
    label = np.where(in_motion, int(Label.MEASURE), int(Label.REST))
    number = np.where(in_motion, (np.arange(u.size) - rest) // cycle, -1)
    step = np.where(in_motion, 0, -1)
    names = ("rel_disp_m", "damper_force_n")
    block = Block("meas", 0, RATE_HZ, names, np.array([u, f]), step, label, number)
    return PreparedLog(build_signals((block,), "component", 1.0, (np.inf, np.inf)), 1.0)


@pytest.mark.parametrize(("preload", "last_share"), [(0.0, 1.0), (40.0, 0.3)])
def test_friction_is_found_beside_a_force_at_rest_and_a_falling_amplitude(
    preload: float, last_share: float
) -> None:
    log = play_component_test(preload, last_share)
    verdict = discover_effects([log], oscillator(1e4, 100.0)).verdict
    assert verdict.outcome in ("named", "unexplained")
    assert "coulomb_friction" in verdict.best.names
    assert ("sensor_offset.damper_force_n" in verdict.best.names) == (preload > 0.0)
    values = verdict.best.fit.values
    assert values[EffectKey("coulomb_friction", "fc")] == pytest.approx(FRICTION, rel=0.05)
