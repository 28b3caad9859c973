"""Texts of files: tables written as TOML, texts with their hash, names with a null character."""

import math
import random
import tomllib
from pathlib import Path

import pytest

from table_io.config.base import PROFILES_DIR, format_toml
from table_io.config.provenance import require_seal, seal_text
from table_io.errors import InputError
from tests.input_errors import raises_input_error
from twin.campaign.config import read_plan
from twin.model.config import load_model_config
from twin.setup.run_config import read_run_config


def test_table_is_read_as_it_was_written() -> None:
    table = {
        "title": 'a "quote" \\ back\nline \x7f é',
        "gap_mm": math.inf,
        "least": -math.inf,
        "value": 0.1 + 0.2,
        "count": 3,
        "enabled": False,
        "band_hz": [0.3, math.inf],
        "excitation": {"kind": "record", "files": {"a b.csv": "1\n2\n", "plain_key": ""}},
        "sensors": [{"channel": "x", "range": 1e-12}, {"channel": "y", "deeper": {"a": 1}}],
    }
    assert tomllib.loads(format_toml(table)) == table
    assert math.isnan(tomllib.loads(format_toml({"none": math.nan}))["none"])


TEXT = 'title = "A table"\nresidual = 0.02\n[parameters]\ngain_1_s = 20.0\n'
SEALED = seal_text(TEXT)


def test_sealed_text_is_accepted_with_any_line_ends() -> None:
    assert SEALED.startswith(TEXT)
    for text in (SEALED, SEALED.replace("\n", "\r\n"), SEALED + "\n\n", TEXT):
        require_seal(text, "the twin", "make it again")


def test_every_altered_character_is_noticed() -> None:
    rng = random.Random(1)
    for place, character in enumerate(SEALED):
        other = chr(rng.choice([n for n in range(33, 127) if chr(n) != character]))
        with pytest.raises(InputError, match="the twin was altered after it was written"):
            require_seal(SEALED[:place] + other + SEALED[place + 1 :], "the twin", "make it again")


def test_removed_hash_is_noticed() -> None:
    with pytest.raises(InputError):
        require_seal(SEALED[: SEALED.rindex("# sha256")], "the twin", "make it again")


QUICKSTART = (PROFILES_DIR / "tests" / "quickstart.toml").read_text()


@pytest.mark.parametrize("null", ["\\u0000", "\\U00000000"])
@pytest.mark.parametrize("key", ["rig", "model"])
def test_null_character_in_a_file_name_is_refused_with_its_line(
    tmp_path: Path, key: str, null: str
) -> None:
    path = tmp_path / "test.toml"
    lines = [line for line in QUICKSTART.splitlines() if not line.startswith(f"{key} =")]
    path.write_text("\n".join([f'{key} = "x{null}.toml"', *lines]))
    with pytest.raises(InputError, match=r"test.toml: line 1: a null character; remove it"):
        read_run_config(path)


def test_null_character_in_the_file_of_a_record_or_of_a_run_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "record.toml"
    text = (PROFILES_DIR / "tests" / "el_centro.toml").read_text()
    path.write_text(text.replace('file = "el_centro.csv"', 'file = "x\\u0000.csv"'))
    with pytest.raises(InputError, match="a null character"):
        read_run_config(path)
    path.write_text('title = "x"\n[[runs]]\nprofile = "x\\u0000.toml"\n')
    with pytest.raises(InputError, match="line 3: a null character"):
        read_plan(path, None, None, lambda _config, _path: None)


def test_fault_of_an_effect_file_names_the_effect_file(tmp_path: Path) -> None:
    model = tmp_path / "model.toml"
    text = (PROFILES_DIR / "models" / "snm.toml").read_text()
    model.write_text(f'{text}\n[[effects]]\nfile = "own.toml"\nparameters = {{ k = 1.0 }}\n')
    (tmp_path / "own.toml").write_text('id = "own"\nforce = "k * w"\n[parameters]\n')
    with raises_input_error(where=str(tmp_path / "own.toml")) as caught:
        load_model_config(model)
    assert "model.toml" not in str(caught.value)
