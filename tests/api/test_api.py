"""The Python interface: logs, fits and verdicts as objects."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from tests.builders.profiles import AT_1_KHZ_BY_50, UNCHECKED, format_test
from tests.builders.rigs import RIG_TEXT
from tests.builders.truths import hide_truth
from tests.input_errors import raises_input_error
from twin import api
from twin.discovery.command import run_discovery, run_identification
from twin.laws.library import EFFECTS
from twin.model.config import ModelConfig
from twin.setup.run_config import RunConfig, read_model


@pytest.fixture
def profile(bundle: RunConfig, tmp_path: Path) -> Path:
    path = tmp_path / "across.toml"
    path.write_text(bundle.profile_toml)
    return path


def test_a_simulation_is_the_model_on_the_ideal_drive(profile: Path, tmp_path: Path) -> None:
    log = api.simulate(profile, tmp_path / "model")
    assert log.start.source == "model"
    assert np.nanmax(np.abs(log.twin["rel_disp_m"])) > 1e-3
    assert log.prc["twin_eta_d"].shape == (6,)
    with raises_input_error(key="--out"):
        api.simulate(profile, tmp_path / "model")
    with raises_input_error(where="--model no_model"):
        api.simulate(profile, tmp_path / "other", model="no_model")


def test_a_simulated_run_has_a_table_with_noise(profile: Path, tmp_path: Path) -> None:
    profile.write_text(profile.read_text().replace("stop_hz = 4.4", "stop_hz = 2.4"))
    log = api.run_simulated(profile, tmp_path / "run")
    assert [step.frequency_hz for step in log.steps] == [2.4, 2.4]
    assert log.start.source == "table"
    assert log["rel_disp_m"][: int(0.2 * log.rate_hz)].std() > 0.0


def test_a_replay_equals_the_recording_and_takes_another_model(
    log_file: Path, tmp_path: Path
) -> None:
    recorded = api.open_log(log_file)
    again = api.replay(log_file, tmp_path / "again")
    assert again.predicted.tobytes() == recorded.predicted.tobytes()
    _, text = read_model("snm")
    (tmp_path / "stiff.toml").write_text(text.replace("= 36000.0", "= 37000.0"))
    other = api.replay(log_file.parent, tmp_path / "other", model=tmp_path / "stiff.toml")
    assert other.model.base.stiffness == 37000.0
    assert other["mass_disp_m"].tobytes() == recorded["mass_disp_m"].tobytes()
    assert other.predicted.tobytes() != recorded.predicted.tobytes()


def test_a_fit_has_intervals_and_a_model_file(log_file: Path, tmp_path: Path) -> None:
    fitted = api.identify([log_file])
    stiffness = fitted.parameters["stiffness"]
    assert stiffness.unit == "N/m"
    assert stiffness.low is not None
    assert stiffness.high is not None
    assert stiffness.low < 36e3 * 1.02
    assert stiffness.high > 36e3 * 0.98
    assert 0.5 < fitted.rms_over_noise < 2.0
    assert any("gap" in name for name in fitted.log_parameters)
    config, _ = read_model(str(fitted.save_model(tmp_path / "fitted.toml")))
    assert isinstance(config, ModelConfig)
    assert config.base.stiffness_n_m == pytest.approx(stiffness.value)
    with raises_input_error(where=tmp_path / "fitted.toml"):
        fitted.save_model(tmp_path / "fitted.toml")


def test_a_discovery_has_the_verdict_and_the_model(log_file: Path, tmp_path: Path) -> None:
    found_model = api.discover([log_file])
    assert found_model.verdict.verdict == "none"
    assert found_model.verdict.effects == []
    config, _ = read_model(str(found_model.save_model(tmp_path / "found.toml")))
    assert config.effects == ()
    with raises_input_error(problem="effect 'no_effect'"):
        api.discover([log_file], without=["no_effect"])


HIDDEN_SPRING = """
[[effects]]
id = "saturating_stiffness"
parameters = { stiffness = 4000.0, length = 0.006 }
"""
TEST = format_test(
    1.0,
    2.0,
    0.2,
    math.inf,
    AT_1_KHZ_BY_50 | UNCHECKED,
    rig="rig.toml",
    measured_cycles=None,
    acceleration_g=0.05,
)


@pytest.mark.slow  # two searches of a law
@pytest.mark.parametrize("truth", ["", HIDDEN_SPRING])
def test_discover_and_identify_return_what_the_commands_write(truth: str, tmp_path: Path) -> None:
    """No effect of the library is tried, so that a law is searched for what is hidden."""
    (tmp_path / "rig.toml").write_text(hide_truth(RIG_TEXT, tmp_path, truth))
    (tmp_path / "test.toml").write_text(TEST)
    log = api.run_simulated(tmp_path / "test.toml", tmp_path / "run").path
    without = [effect.id for effect in EFFECTS]

    discovered = api.discover([log], without=without)
    run_discovery([log], "snm", tmp_path / "found", without)
    written = json.loads((tmp_path / "found" / "verdict.json").read_text())
    assert json.loads(discovered.verdict.to_json()) | {"seconds": 0} == written | {"seconds": 0}
    assert discovered.model_toml == (tmp_path / "found" / "model.toml").read_text()
    assert (discovered.verdict.law is not None) == bool(truth)

    fitted = api.identify([log])
    run_identification([log], "snm", tmp_path / "fitted.toml")
    written = json.loads((tmp_path / "fitted" / "identify.json").read_text())
    assert json.loads(fitted.report.to_json()) | {"seconds": 0} == written | {"seconds": 0}
    assert fitted.model_toml == (tmp_path / "fitted.toml").read_text()
