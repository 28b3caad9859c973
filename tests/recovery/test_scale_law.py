"""A verdict does not depend on the size of the specimen, nor on the units of the recording."""

import tomllib
from functools import cache

import pytest

from tests.recovery.scaled_specimens import GAP, C, Hidden, K, record, start_model
from twin.discovery.discover import Discovery, discover_effects
from twin.discovery.model_file import format_fitted_model
from twin.discovery.parameters import DAMPING, STIFFNESS, EffectKey, GapKey, ParameterKey
from twin.model.config import ModelConfig

HIDDEN = {
    "nothing": Hidden(),
    "cubic_stiffness": Hidden("cubic_stiffness", 3e6),
    "quadratic_damping": Hidden("quadratic_damping", 2e3),
    "coulomb_friction": Hidden("coulomb_friction", 60.0),
    "bouc_wen": Hidden("bouc_wen", 200.0, 3e-3),
    "bumper_hardening": Hidden("bumper_hardening", 3e7, gap=GAP),
    "hunt_crossley": Hidden("hunt_crossley", 5e5, gap=GAP),
}
AMPLITUDES = {
    "cubic_stiffness": "k3", "quadratic_damping": "c2", "coulomb_friction": "fc",
    "bouc_wen": "force", "bumper_hardening": "k2", "hunt_crossley": "ch",
}  # fmt: skip
# lengths in the unit of a parameter, as exponents; K and C have none: force per length
LENGTHS = {"k3": -2, "c2": -1, "fc": 1, "force": 1, "yield_displacement": 1, "k2": -1, "ch": -1}


@cache
def discover(name: str, force: float, length: float) -> Discovery:
    """Return the discovery in a recording with mass and forces, and lengths, multiplied."""
    return discover_effects([record(HIDDEN[name], force, length)], start_model(force))


def expected_ratio(key: ParameterKey, force: float, length: float) -> float:
    """Return the ratio of a parameter to that of the recording of the original size."""
    match key:
        case EffectKey(_, "yield_displacement"):
            return length
        case EffectKey(_, name):
            return force * length ** LENGTHS[name]
    return force


@pytest.mark.slow  # 20 s
@pytest.mark.parametrize(
    ("force", "length"), [(0.01, 1.0), (1000.0, 1.0), (1.0, 0.01), (1.0, 1000.0)]
)
@pytest.mark.parametrize("name", HIDDEN)
def test_the_size_of_a_specimen_leaves_the_verdict(name: str, force: float, length: float) -> None:
    original, scaled = discover(name, 1.0, 1.0), discover(name, force, length)
    names = () if name == "nothing" else (name,)
    assert original.verdict.outcome == scaled.verdict.outcome == ("named" if names else "none")
    assert original.verdict.best.names == scaled.verdict.best.names == names
    assert scaled.verdict.confidence == pytest.approx(original.verdict.confidence, abs=0.01)
    values = original.verdict.best.fit.values
    for key, value in scaled.verdict.best.fit.values.items():
        if isinstance(key, EffectKey) or key in (STIFFNESS, DAMPING):
            ratio = expected_ratio(key, force, length)
            assert value == pytest.approx(ratio * values[key], rel=1e-3), key
        elif isinstance(key, GapKey):
            assert value == pytest.approx(length * values[key], abs=1e-3 * length * GAP)


@pytest.mark.parametrize("name", AMPLITUDES)
def test_the_parameters_are_those_of_the_simulation(name: str) -> None:
    fit = discover(name, 1.0, 1.0).verdict.best.fit
    assert fit.values[STIFFNESS] == pytest.approx(K, rel=5e-3)
    assert fit.values[DAMPING] == pytest.approx(C, rel=5e-3)
    assert fit.values[EffectKey(name, AMPLITUDES[name])] == pytest.approx(HIDDEN[name].a, rel=5e-3)


@pytest.mark.parametrize("force", [0.01, 1000.0])
def test_a_start_of_another_size_leaves_the_verdict(force: float) -> None:
    discovery = discover_effects([record(HIDDEN["bouc_wen"], force)], start_model())
    assert discovery.verdict.best.names == ("bouc_wen",)
    expected = discover("bouc_wen", 1.0, 1.0).verdict.best.fit.values
    values = discovery.verdict.best.fit.values
    for key in (STIFFNESS, DAMPING, EffectKey("bouc_wen", "force")):
        assert values[key] == pytest.approx(force * expected[key], rel=1e-3)
    shape = EffectKey("bouc_wen", "yield_displacement")
    assert values[shape] == pytest.approx(expected[shape], rel=1e-3)


def test_the_model_of_a_large_specimen_can_be_loaded() -> None:
    fit = discover("bouc_wen", 1000.0, 1.0).verdict.best.fit
    text, _ = format_fitted_model(fit, "large", "", "")
    (effect,) = ModelConfig.model_validate(tomllib.loads(text)).effects
    assert float(effect.parameters["force"]) > 1e5
