"""Names of configs: what they find, in which order, and what they never find."""

from pathlib import Path

import pytest

from table_io.config.folders import (
    FOLDERS_VARIABLE,
    find_config,
    list_configs,
    resolve_config,
)
from tests.input_errors import raises_input_error


@pytest.fixture
def user_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv(FOLDERS_VARIABLE, raising=False)
    return tmp_path


def test_the_nearest_folder_comes_first(user_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folders = [user_folder / "own", user_folder / "profiles", user_folder / "shared"]
    monkeypatch.setenv(FOLDERS_VARIABLE, str(folders[-1]))
    for folder in folders:
        (folder / "rigs").mkdir(parents=True)
        (folder / "rigs" / "simulated.toml").touch()
    profile = folders[0] / "tests" / "mine.toml"
    shipped = find_config("machine", "rigs", profile)
    for folder in folders:
        path = folder / "rigs" / "simulated.toml"
        assert find_config("simulated", "rigs", profile) == path
        path.unlink()
    assert find_config("simulated", "rigs", profile).parent == shipped.parent


def test_neither_files_without_suffix_nor_folders_hide_a_name(user_folder: Path) -> None:
    shipped = resolve_config(Path("quickstart"), "tests")
    (user_folder / "quickstart").write_text("no test")
    (user_folder / "profiles/tests/quickstart.toml").mkdir(parents=True)
    assert resolve_config(Path("quickstart"), "tests") == shipped
    assert list_configs("tests")["quickstart"] == shipped


def test_a_file_without_the_suffix_is_taken_where_no_config_has_its_name(user_folder: Path) -> None:
    for name in ("mytest", "Quick.TOML"):
        (user_folder / name).touch()
        assert resolve_config(Path(f"./{name}"), "tests") == Path(name)


@pytest.mark.usefixtures("user_folder")
def test_a_path_stays_a_path_and_an_unknown_name_is_an_input_error() -> None:
    assert resolve_config(Path("quickstart.toml"), "tests") == Path("quickstart.toml")
    with raises_input_error(key="quikstart"):
        resolve_config(Path("quikstart"), "tests")
