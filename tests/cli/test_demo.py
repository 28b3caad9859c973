"""The demonstration: what is sealed stays hidden, is valid, and is what the kept rig hides."""

import json
import tomllib
from pathlib import Path
from typing import Any

import pytest

from table_io.config.base import load_config
from table_io.config.rig import RigConfig
from table_io.errors import InputError
from table_io.sim.config import SimulatedTableConfig
from table_io.sim.simulated_table import load_ground_truth
from tests.command_line import call_main
from twin.demo.command import (
    HIDEABLE_EFFECTS,
    RIG_FILE,
    SEALED_FILE,
    compare_with_seal,
    keep_rig,
    open_seal,
    seal_effect,
)
from twin.discovery.result import EffectResult, Interval, Verdict
from twin.laws.library import EFFECTS


def read_table(path: Path) -> SimulatedTableConfig:
    return load_config(path, RigConfig, "rig")[0].require_section("simulated", SimulatedTableConfig)


def test_every_effect_is_drawn_and_valid_and_only_its_hash_is_in_the_rig(tmp_path: Path) -> None:
    drawn = set()
    for seed in range(60):
        digest = seal_effect(tmp_path, seed)
        (effect,) = open_seal(tmp_path, digest).effects
        drawn.add(effect.id)
        table = tomllib.loads((tmp_path / RIG_FILE).read_text())["simulated"]
        assert (table["truth_sha256"], table["seed"]) == (digest, seed)
        assert effect.id not in (tmp_path / RIG_FILE).read_text()
    assert drawn == set(HIDEABLE_EFFECTS) <= {known.id for known in EFFECTS}


def test_the_same_seed_hides_the_same_behind_another_hash(tmp_path: Path) -> None:
    first = seal_effect(tmp_path, 5)
    hidden = open_seal(tmp_path, first)
    second = seal_effect(tmp_path, 5)
    assert open_seal(tmp_path, second) == hidden
    assert first != second
    with pytest.raises(InputError, match=SEALED_FILE):
        open_seal(tmp_path, first)


def test_the_rig_that_is_kept_hides_what_was_sealed(tmp_path: Path) -> None:
    (tmp_path / "kept").mkdir()
    hidden = open_seal(tmp_path, seal_effect(tmp_path, 9))
    kept = read_table(keep_rig(tmp_path / "kept", hidden.effects[0], 9))
    sealed = read_table(tmp_path / RIG_FILE)
    assert kept.truth is None
    assert load_ground_truth(kept) == load_ground_truth(sealed) == hidden


def test_the_seal_is_compared_with_what_discovery_named(tmp_path: Path) -> None:
    (hidden,) = open_seal(tmp_path, seal_effect(tmp_path, 9)).effects
    name, value = next(iter(hidden.parameters.items()))
    fit = {name: Interval(value=1.01 * value, low=value, high=1.02 * value, unit="X")}
    right = EffectResult(id=hidden.id, confidence=0.9, parameters=fit)
    false = EffectResult(id="other", confidence=0.9, parameters={})
    lines = {
        key: compare_with_seal(
            hidden, Verdict.model_construct(**dict[str, Any](verdict=word, effects=effects))
        )
        for key, word, effects in (
            ("right", "named", [right]),
            ("more", "named", [right, false]),
            ("unsure", "ambiguous", [right]),
            ("none", "none", []),
        )
    }
    number = f"{1.01 * value:.4g}"
    has_value = {
        key: [number in line for line in lines_of_case] for key, lines_of_case in lines.items()
    }
    assert has_value == {
        "right": [False, True], "more": [False, True, False], "unsure": [False], "none": [False]
    }  # fmt: skip
    assert "other" in lines["more"][-1]


@pytest.mark.slow  # 25 s; the check of the wheel runs it too
def test_the_demonstration_names_what_is_hidden_and_the_twin_agrees_then(tmp_path: Path) -> None:
    run = call_main(
        "demo", "--seed", 3, "--no-open", "--out", tmp_path / "a", "--keep", tmp_path / "b"
    )
    assert run.returncode == 0, run.stderr
    (hidden,) = tomllib.loads((tmp_path / "a" / SEALED_FILE).read_text())["effects"]
    verdict = json.loads((tmp_path / "a" / "2-discovery" / "verdict.json").read_text())
    assert [effect["id"] for effect in verdict["effects"]] == [hidden["id"]]
    first, second = (
        json.loads((tmp_path / "a" / name / "summary.json").read_text())["comparison"]["rel_disp_m"]
        for name in ("1-first-run", "3-second-run")
    )
    assert first["nrmse"] > 10 * first["noise_floor"]
    assert second["nrmse"] < 2 * second["noise_floor"]
    assert (tmp_path / "a" / "report.html").stat().st_size > 20_000
    assert read_table(tmp_path / "b" / RIG_FILE).hidden is not None
