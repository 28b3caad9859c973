"""What there is and what a key means; templates, schemas, examples and completion."""

import json
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.core import TyperGroup

from table_io.channels import CHANNELS
from table_io.config.base import PROFILES_DIR
from table_io.config.profile import Profile
from tests.command_line import call_main
from twin.cli.table import COMMANDS, EXAMPLES
from twin.guide.reference_command import FileKind, build_file_schema
from twin.laws.library import EFFECTS

KEY = re.compile(r"(# )?\w+ = ")  # at the start of a line, perhaps commented out


@pytest.mark.parametrize(
    ("kind", "names"),
    [
        ("tests", {"quickstart", "g4_ss1"}),
        ("rigs", {"simulated", "machine"}),
        ("models", {"snm"}),
        ("campaigns", {"paper"}),
        ("features", {"paper"}),
        ("effects", {effect.id for effect in EFFECTS}),
        ("channels", {channel.name for channel in CHANNELS}),
    ],
)
def test_every_name_of_a_kind_is_listed(kind: str, names: set[str]) -> None:
    result = call_main("list", kind)
    assert result.returncode == 0
    assert all(re.search(rf"(?<!\w){name}(?!\w)", result.stdout) for name in names)


def test_a_list_shows_the_files_of_the_user_and_where_they_are(tmp_path: Path) -> None:
    folder = tmp_path / "profiles" / "models"
    folder.mkdir(parents=True)
    (folder / "mine.toml").write_text('title = "Our specimen"\n')
    (line,) = (
        row
        for row in call_main("list", "models", cwd=tmp_path).stdout.splitlines()
        if re.search(r"\bmine\b", row)
    )
    assert "Our specimen" in line
    assert str(folder) in line


@pytest.mark.parametrize("key", ["tolerance", "control.tolerance"])
def test_a_key_is_explained_with_default_and_limits(key: str) -> None:
    text = call_main("explain", key).stdout
    assert "[control]" in text
    assert "default: 0.02" in text
    assert "0.002 to 0.1" in text


def test_a_key_of_several_tables_is_explained_in_each_and_an_unknown_one_is_suggested() -> None:
    text = call_main("explain", "start_hz").stdout
    assert {'kind = "stepped_sine"', 'kind = "continuation"'} <= {
        line.partition("] ")[2].partition(":")[0] for line in text.splitlines()
    }
    result = call_main("explain", "gap_m")
    assert result.returncode == 2
    assert "gap_mm" in result.stderr


def test_a_new_test_passes_the_check_and_shows_every_key(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    assert call_main("new", "test", path).returncode == 0
    assert call_main("check", path).returncode == 0
    text = path.read_text()
    assert set(tomllib.loads(text)) == {"title", "rig", "model", "specimen", "excitation"}
    keys = set(Profile.model_fields) - {"excitation", "specimen", "set_up", "resume"}
    assert all(f"{key} =" in text or f"[{key}]" in text for key in keys)
    # What is commented out is TOML too, wherever it has a default.
    lines = [line.removeprefix("# ") for line in text.splitlines() if KEY.match(line)]
    tomllib.loads("\n".join(f"key_{n}.{line}" for n, line in enumerate(lines) if "..." not in line))
    again = call_main("new", "test", path)
    assert again.returncode == 2
    assert path.read_text() == text


@pytest.mark.parametrize("kind", ["rig", "model", "campaign"])
def test_other_templates_are_shipped_files(kind: str, tmp_path: Path) -> None:
    assert call_main("new", kind, tmp_path / "a.toml").returncode == 0
    shipped = [path.read_text() for path in PROFILES_DIR.rglob("*.toml")]
    assert (tmp_path / "a.toml").read_text() in shipped


def list_wrong_keys(schema: dict[str, Any], root: dict[str, Any], value: Any) -> Iterator[str]:
    """Keys of a TOML value that its schema does not know, at any depth."""
    variants = [
        root["$defs"][item["$ref"].rpartition("/")[2]] if "$ref" in item else item
        for item in schema.get("anyOf", [schema])
    ]
    if isinstance(value, list):
        for item in value:
            yield from list_wrong_keys(variants[0].get("items", {}), root, item)
    if not isinstance(value, dict) or not any("properties" in variant for variant in variants):
        return
    wrong = []
    for variant in variants:
        properties = variant.get("properties", {})
        wrong.append(
            [key for key in value if key not in properties]
            + [
                f"{key}.{inner}"
                for key in value
                if key in properties
                for inner in list_wrong_keys(properties[key], root, value[key])
            ]
        )
    yield from min(wrong, key=len)


@pytest.mark.parametrize("kind", ["test", "rig", "model", "campaign"])
def test_the_schema_knows_every_key_of_the_shipped_files_and_no_slip(kind: str) -> None:
    schema = build_file_schema(FileKind(kind))
    json.dumps(schema)
    for path in (PROFILES_DIR / f"{kind}s").glob("*.toml"):
        values = tomllib.loads(path.read_text())
        assert list(list_wrong_keys(schema, schema, values)) == [], path
        assert list(list_wrong_keys(schema, schema, values | {"titel": 1})) == ["titel"]


def test_every_command_has_two_examples_that_parse() -> None:
    commands = {row.name: row.load() for row in COMMANDS if not row.hidden}
    for name, command in commands.items():
        assert isinstance(command, TyperGroup) or len(EXAMPLES[name]) == 2, name
    for name, examples in EXAMPLES.items():
        assert all(f"shaketwin {example}" in (commands[name].epilog or "") for example in examples)
        for example in examples:
            words = shlex.split(example.partition(f"{name} ")[2])
            known = {option for item in commands[name].params for option in item.opts}
            known |= {option for item in commands[name].params for option in item.secondary_opts}
            assert {word for word in words if word.startswith("-")} <= known, example


def test_the_version_is_printed_and_names_are_completed(tmp_path: Path) -> None:
    assert call_main("--version").stdout.split()[0] == "shaketwin"
    code = "import sys; sys.argv = ['shaketwin']; from twin.cli.entry import main; main()"
    result = subprocess.run(
        [sys.executable, "-c", code],
        env={
            "PYTHONPATH": str(Path(__file__).parents[2]),
            "_SHAKETWIN_COMPLETE": "complete_bash",
            "COMP_WORDS": "shaketwin run qui",
            "COMP_CWORD": "2",
            "HOME": str(tmp_path),
        },
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.stdout.split() == ["quickstart"], result.stderr
