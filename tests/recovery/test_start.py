"""A start is only a start: within a factor of three of the specimen it leaves the verdict."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from tests.recovery.scaled_specimens import C_J, GAP, K_J, C, Hidden, K, record, start_model
from twin.discovery.discover import Discovery, PreparedLog, discover_effects
from twin.model.model import Model

# both losses are several times that of the dashpot, which takes them up where they are missing
HIDDEN = {
    "coulomb_friction": Hidden("coulomb_friction", 120.0),
    "bouc_wen": Hidden("bouc_wen", 300.0, 3e-3),
    "hunt_crossley": Hidden("hunt_crossley", 5e5, gap=GAP),
}


@cache
def recording(name: str) -> PreparedLog:
    return record(HIDDEN[name])


def random_start(seed: int) -> Model:
    """Return a model whose parameters are off by up to a factor of three each."""
    limit = math.log(3.0)
    k, c, k_j, c_j = np.exp(np.random.default_rng(seed).uniform(-limit, limit, 4)) * (
        K,
        C,
        K_J,
        C_J,
    )
    return Model(
        replace(
            start_model().base, stiffness=k, damping=c, bumper_stiffness_r=k_j,
            bumper_stiffness_l=k_j, bumper_damping_r=c_j, bumper_damping_l=c_j,
        )
    )  # fmt: skip


@cache
def discover_from_near(name: str) -> Discovery:
    return discover_effects([recording(name)], start_model())


@pytest.mark.slow  # 10 s
@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("name", HIDDEN)
def test_a_rough_start_leaves_the_verdict(name: str, seed: int) -> None:
    verdict = discover_effects([recording(name)], random_start(seed)).verdict
    assert (verdict.outcome, verdict.best.names) == ("named", (name,)), verdict.reason
    assert verdict.confidence == pytest.approx(
        discover_from_near(name).verdict.confidence, abs=0.01
    )
    for key, value in discover_from_near(name).verdict.best.fit.values.items():
        sd = discover_from_near(name).verdict.best.fit.std_errors[key]
        assert verdict.best.fit.values[key] == pytest.approx(value, rel=1e-3, abs=0.1 * sd), key
