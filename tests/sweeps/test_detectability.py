"""Outcome `discovery` of a map: what a case states and hides, and what discovery makes of it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.input_errors import raises_input_error
from twin.detectability import describe_truth, make_rig_toml, play_test, state_case
from twin.laws.library import find_effect
from twin.model.model import EffectInstance, Model
from twin.studies.maps.cases import SampledCase
from twin.studies.maps.store import make_seeds
from twin.studies.maps.study import Study
from twin.studies.maps.task import compute_outcomes


@pytest.fixture(scope="module")
def study() -> Study:
    return Study.read(Path("discovery_power"))


def build_case(study: Study, **base: float) -> SampledCase:
    case = study.factory.build([5.0, 3.0])
    return replace(case, model=Model(replace(case.model.base, **base), case.model.effects))


def test_a_case_states_its_mass_gap_and_level_and_hides_the_rest(study: Study) -> None:
    case = replace(build_case(study, mass=500.0, gap_r=3e-3, gap_l=3e-3), acceleration_m_s2=1.0)
    stated = state_case(case, {"sweep": {"start_hz": 1.0}, "specimen": {"gap_mm": 4.0}})
    assert stated["specimen"] == {"mass_kg": 500.0, "gap_mm": pytest.approx(6.0)}
    assert stated["sweep"] == {"start_hz": 1.0, "acceleration_g": pytest.approx(0.10197, rel=1e-4)}
    truth = describe_truth(build_case(study, stiffness=4e4).model)
    assert truth["base"]["damper_stiffness_n_m"] == 4e4
    assert [effect["id"] for effect in truth["effects"]] == ["coulomb_friction"]
    assert truth["effects"][0]["parameters"]["fc"] == 5.0


def test_an_effect_that_the_plant_lacks_is_refused(study: Study) -> None:
    sensor = find_effect("coulomb_friction")
    lacking = EffectInstance.create(replace(sensor, id="unheard_of"), {"fc": 1.0})
    with raises_input_error(key="effects.unheard_of"):
        describe_truth(Model(study.factory.model.base, (lacking,)))


def test_a_test_that_is_stopped_has_no_verdict(study: Study, tmp_path: Path) -> None:
    truth = tmp_path / "truth.toml"
    truth.write_text("")
    loud = make_rig_toml(1000.0, 0, truth)
    with raises_input_error(problem="500 mm/s"):
        play_test(study.profile_toml, loud, study.model_toml, tmp_path / "log.mcap")


@pytest.mark.slow
def test_discovery_names_a_large_friction_and_nothing_where_there_is_none(study: Study) -> None:
    arrays, failures = compute_outcomes(
        study, np.array([[16.0, 1.0], [0.0, 1.0]]), make_seeds(1, range(2))
    )
    assert not failures
    assert arrays["named_right"].tolist() == [1.0, 1.0]
    assert arrays["named_wrong"].tolist() == [0.0, 0.0]
    assert arrays["gap_closed"][0] > 0.9
