"""The force drawn for a law is that which the record requires, and a generic term is called so."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from tests.recovery.scaled_specimens import Hidden, prepare, record_block, simulate, start_model
from twin.discovery.discover import Discovery, PreparedLog, discover_effects
from twin.discovery.figure_data import DiscoveryView
from twin.discovery.force_figures import draw_residual_forces
from twin.discovery.parameters import EffectKey
from twin.discovery.selection import fit_generic_terms

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


def test_a_generic_term_is_drawn_apart_from_what_was_named() -> None:
    discovery, log = without_accelerometer()
    problem, best = discovery.prepared.problem, discovery.verdict.best
    generic = fit_generic_terms(problem, best)[0]
    named = replace(discovery, verdict=replace(discovery.verdict, generic=generic))
    view = DiscoveryView(named, [log])
    assert view.law is named.verdict.best
    assert view.law_name == "cubic_stiffness"
    assert [forces.is_generic for forces in view.forces_of_each] == [False, True]
    assert view.forces_of_each[1].label.startswith("generic term damper ")
    figures = {drawn.name: drawn for drawn in draw_residual_forces(view)}
    assert [*figures] == ["laws", "damper_force"]
    assert len(figures["laws"].figure.axes) == 4
    unnamed = replace(named, verdict=replace(named.verdict, outcome="unexplained"))
    assert DiscoveryView(unnamed, [log]).law is generic
