"""Reading of a run's configuration: an error names the option or the file that holds the fault."""

from pathlib import Path

import pytest

from table_io.config.base import PROFILES_DIR
from table_io.errors import InputError
from twin.setup.run_config import read_model_template, read_run_config

QUICKSTART = PROFILES_DIR / "tests" / "quickstart.toml"


@pytest.mark.parametrize(("table", "model"), [("nobody", None), (None, "nowhere")])
def test_an_unknown_name_is_reported_at_its_option(table: str | None, model: str | None) -> None:
    with pytest.raises(InputError) as raised:
        read_run_config(QUICKSTART, table, model)
    assert raised.value.where == ("--table nobody" if table else "--model nowhere")


@pytest.mark.parametrize(("key", "name"), [("rig", "simulated"), ("model", "snm")])
def test_an_unknown_name_in_a_profile_is_reported_at_the_profile(
    tmp_path: Path, key: str, name: str
) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(QUICKSTART.read_text().replace(f'{key} = "{name}"', f'{key} = "nowhere"'))
    with pytest.raises(InputError) as raised:
        read_run_config(path)
    assert (raised.value.where, raised.value.key) == (str(path), "nowhere")


def test_an_unknown_start_model_is_reported_at_its_option() -> None:
    with pytest.raises(InputError) as raised:
        read_model_template("nowhere")
    assert raised.value.where == "--model nowhere"
