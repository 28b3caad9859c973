"""Generated pages: every key, command, effect and channel, from the objects themselves."""

import json
from typing import Any

import numpy as np
import pytest
import typer

from table_io.config.base import PROFILES_DIR, ConfigModel, load_config
from table_io.config.key_reference import derive_unit, describe_tables
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig
from twin.cli.table import COMMANDS, app
from twin.discovery.features.config import FeatureSet
from twin.discovery.features.prediction import describe_feature
from twin.discovery.result import FeatureVerdict
from twin.guide.gallery import write_gallery
from twin.guide.loops import compute_loops, find_loops
from twin.guide.markdown import convert_notebook
from twin.guide.paper_gap import RESULT_FILE, write_paper_gap
from twin.guide.reference import CONFIG_FILES, write_command_reference, write_key_reference
from twin.laws.effect import Effect
from twin.laws.library import EFFECTS

PROGRAM: Any = typer.main.get_command(app)


def test_every_key_of_every_file_has_a_meaning() -> None:
    missing = [
        f"{title} {table.name} {key.key}"
        for title, _, model in CONFIG_FILES
        for table in describe_tables(model)
        for key in table.keys
        if not (key.meaning and key.allowed) and "pulse_train" not in table.name  # of a test
    ]
    assert missing == []


def find_key(model: type[ConfigModel], table: str, key: str) -> tuple[str, str, bool, str]:
    tables = {description.name: description.keys for description in describe_tables(model)}
    (entry,) = (item for item in tables[table] if item.key == key)
    return entry.unit, entry.default, entry.is_required, entry.allowed


@pytest.mark.parametrize(
    ("model", "table", "key", "expected"),
    [
        (Profile, "[specimen]", "mass_kg", ("kg", "", True, "number, above 0")),
        (Profile, "[comparison]", "window_s", ("s", "0.25", False, "number, from 0.05 to 60")),
        (Profile, "[on_death]", "twin", ("", '"continue"', False, '"continue" or "stop"')),
        (
            Profile,
            '[excitation] kind = "continuation"',
            "points",
            ("", "60", False, "integer, from 1 to 1000"),
        ),
        (Profile, "[sweep]", "start_hz", ("Hz", "", True, "number, from 0.01")),
        (Profile, "[track]", "phase_deg", ("degrees", "", False, "number, from 20 to 160")),
        (RigConfig, "[[sensors]]", "bits", ("", "", True, "integer, from 8 to 32")),
        (RigConfig, "[[ni.inputs]]", "physical", ("", "", True, r"text, pattern ^[^/\s]+/ai\d+$")),
        (RigConfig, "[limits]", "velocity_mm_s", ("mm/s", "", True, "number, above 0")),
    ],
)
def test_a_key_has_the_unit_default_and_limits_of_its_model(
    model: type[ConfigModel], table: str, key: str, expected: tuple[str, str, bool, str]
) -> None:
    assert find_key(model, table, key) == expected


def test_the_unit_of_a_key_is_its_longest_ending() -> None:
    assert [derive_unit(key) for key in ("force_n", "damping_n_s_m", "cycles", "of_m_s2")] == [
        "N",
        "N s/m",
        "",
        "m/s2",
    ]


def test_the_pages_list_every_key_and_command() -> None:
    keys = write_key_reference(PROGRAM)
    for _, _, model in CONFIG_FILES:
        for key in model.list_keys():
            assert key in keys
    commands = write_command_reference(PROGRAM)
    for command in COMMANDS:
        if not command.hidden:
            assert f"### shaketwin {command.name}" in commands
    assert "### shaketwin keys add" in commands
    assert "| `--remote-twin` |" in commands


def test_a_notebook_becomes_a_page_with_its_outputs() -> None:
    cells = [
        {"cell_type": "markdown", "source": ["# Title\n", "\n", "Text."]},
        {
            "cell_type": "code",
            "source": ["print(1)"],
            "outputs": [
                {"output_type": "stream", "name": "stdout", "text": ["1\n"]},
                {"output_type": "display_data", "data": {"image/png": "AAAA\n"}},
            ],
        },
    ]
    text = json.dumps({"cells": cells})
    page = convert_notebook(text, "a.ipynb")
    assert page.startswith("# Title\n\nThis page is the notebook [a.ipynb](a.ipynb)")
    assert "```python\nprint(1)\n```\n\n```text\n1\n```" in page
    assert 'src="data:image/png;base64,AAAA"' in page


def test_the_gallery_has_every_effect_and_what_it_is_confused_with() -> None:
    gallery = write_gallery(PROGRAM)
    for effect in EFFECTS:
        section = gallery.partition(f"\n## {effect.id}\n")[2].partition("\n## ")[0]
        assert effect.residual in section
        assert section.count('<polygon class="') == 2
        for name in effect.confused_with:
            assert f"](#{name})" in section
        for parameter in effect.parameters:
            assert f"| `{parameter.name}` | {parameter.unit} |" in section


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.id)
def test_the_shipped_loops_are_those_of_the_model(effect: Effect) -> None:
    """Renew them with `python -m twin.guide.loops`."""
    without, with_effect = find_loops(effect)
    for shipped, computed in zip((without, with_effect), compute_loops(effect), strict=True):
        assert np.allclose(shipped.u_mm, computed.u_mm, atol=2e-3)
        assert np.allclose(shipped.force_kn, computed.force_kn, atol=2e-4)
    change = max(
        np.abs(with_effect.u_mm - without.u_mm).max() / np.abs(without.u_mm).max(),
        np.abs(with_effect.force_kn - without.force_kn).max() / np.abs(without.force_kn).max(),
    )
    assert change > 0.015  # visible


def test_the_result_on_the_paper_is_that_of_its_features_file() -> None:
    """The shipped numbers are stale once a feature is added or reads otherwise."""
    content = FeatureVerdict.model_validate_json(RESULT_FILE.read_text(encoding="utf-8"))
    features, _ = load_config(PROFILES_DIR / "features" / "paper.toml", FeatureSet, "features file")
    published = [(describe_feature(feature), feature.place) for feature in features.features]
    assert [(entry.published, entry.place) for entry in content.features] == published
    explained = [
        sum(getattr(entry, name).explained for entry in content.features)
        for name in ("given", "refitted", "best")
    ]
    assert explained[:2] == [content.given.explained, content.refitted.explained]
    assert explained[2] == max(fit.explained for fit in content.fits)
    page = write_paper_gap(PROGRAM)
    assert page.count(" ✗ |") == 3 * len(published) - sum(explained)
    assert content.next_run[1:] in page
