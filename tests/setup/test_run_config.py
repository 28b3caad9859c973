"""Reading of a run's configuration: an error names the option or the file that holds the fault."""

from pathlib import Path

import pytest

from table_io.config.base import PROFILES_DIR
from tests.input_errors import raises_input_error
from twin.setup.run_config import read_model_template, read_run_config

QUICKSTART = PROFILES_DIR / "tests" / "quickstart.toml"


@pytest.mark.parametrize(("table", "model"), [("nobody", None), (None, "nowhere")])
def test_an_unknown_name_is_reported_at_its_option(table: str | None, model: str | None) -> None:
    with raises_input_error(where="--table nobody" if table else "--model nowhere"):
        read_run_config(QUICKSTART, table, model)


@pytest.mark.parametrize(("key", "name"), [("rig", "simulated"), ("model", "snm")])
def test_an_unknown_name_in_a_profile_is_reported_at_the_profile(
    tmp_path: Path, key: str, name: str
) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(QUICKSTART.read_text().replace(f'{key} = "{name}"', f'{key} = "nowhere"'))
    with raises_input_error(where=str(path), key="nowhere"):
        read_run_config(path)


def test_an_unknown_start_model_is_reported_at_its_option() -> None:
    with raises_input_error(where="--model nowhere"):
        read_model_template("nowhere")
