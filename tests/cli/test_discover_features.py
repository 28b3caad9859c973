"""`discover --features` as a command: what it refuses, and what it leaves."""

import json
from pathlib import Path

import pytest

from table_io.config.base import load_config
from tests.command_line import call_main
from twin.discovery.result import FeatureVerdict
from twin.laws.library import EFFECTS
from twin.model.config import ModelConfig

FEATURES = """title = "Two peaks"
[specimen]
mass_kg = 550.0
[test]
acceleration_g = 0.05
start_hz = 0.5
end_hz = 10.0
step_hz = 0.1
[[features]]
kind = "peak_frequency"
gap_mm = inf
value_hz = 1.268
tolerance_hz = 0.01
place = "made up"
[[features]]
kind = "peak_frequency"
gap_mm = -10.0
value_hz = 7.43
tolerance_hz = 0.03
place = "made up"
"""


def test_features_take_the_place_of_recordings(tmp_path: Path) -> None:
    result = call_main("discover", "some_log", "--features", "paper", cwd=tmp_path)
    assert result.returncode == 2
    assert "--features" in result.stderr
    assert "--held-out" in result.stderr
    result = call_main("discover", cwd=tmp_path)
    assert result.returncode == 2
    assert "--features" in result.stderr


def test_an_unknown_name_is_refused_with_the_nearest(tmp_path: Path) -> None:
    result = call_main("discover", "--features", "papr", cwd=tmp_path)
    assert result.returncode == 2
    assert "paper" in result.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_the_results_keep_their_contract_and_nothing_is_overwritten(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(FEATURES)
    others = [word for effect in EFFECTS for word in ("--without", effect.id)]
    words = ["discover", "--features", "mine.toml", "--out", "result", *others]
    result = call_main(*words, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "base refitted: 2 of 2" in result.stdout
    folder = tmp_path / "result"
    content = json.loads((folder / "features.json").read_text())
    FeatureVerdict.model_validate(content)
    assert content["verdict"] == "none needed"
    assert [content[name]["explained"] for name in ("given", "refitted")] == [1, 2]
    assert set(content["fell_away"]) == {effect.id for effect in EFFECTS}
    assert (folder / "figures" / "dark" / "features.png").is_file()
    page = (folder / "report.html").read_text()
    assert "1 of 2" in page
    assert "7.43 Hz" in page
    assert call_main(*words, cwd=tmp_path).returncode == 2
    model, _ = load_config(folder / "model.toml", ModelConfig, "model file")
    assert "not to recordings" in model.provisional
    assert model.base.bumper_stiffness_n_m == pytest.approx(1.15 * 510e3, rel=0.02)
