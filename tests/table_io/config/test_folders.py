"""Names of configs: what they find, in which order, and what they never find."""

from pathlib import Path

import pytest

from table_io.config.base import PROFILES_DIR
from table_io.config.folders import FOLDERS_VARIABLE, find_config, list_configs, resolve_config
from tests.input_errors import raises_input_error


@pytest.fixture
def user_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv(FOLDERS_VARIABLE, raising=False)
    return tmp_path


def test_nearest_folder_comes_first(user_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_files_without_suffix_and_folders_hide_no_name(user_folder: Path) -> None:
    shipped = resolve_config(Path("quickstart"), "tests")
    (user_folder / "quickstart").write_text("no test")
    (user_folder / "profiles/tests/quickstart.toml").mkdir(parents=True)
    assert resolve_config(Path("quickstart"), "tests") == shipped
    assert list_configs("tests")["quickstart"] == shipped


def test_file_without_suffix_is_taken_where_no_config_has_its_name(user_folder: Path) -> None:
    for name in ("mytest", "Quick.TOML"):
        (user_folder / name).touch()
        assert resolve_config(Path(f"./{name}"), "tests") == Path(name)


@pytest.mark.usefixtures("user_folder")
def test_path_stays_a_path() -> None:
    assert resolve_config(Path("quickstart.toml"), "tests") == Path("quickstart.toml")
    with raises_input_error(key="quikstart"):
        resolve_config(Path("quikstart"), "tests")
    assert find_config("any/where.toml", "tests") == Path("any/where.toml")


@pytest.mark.parametrize(
    ("name", "kind", "remedy"),
    [
        ("g4_s1", "tests", "did you mean 'g4_ss1'?"),
        ("xyz", "tests", "quickstart"),
        ("bigtable", "rigs", "did you mean 'big_table'?"),
    ],
)
def test_unknown_name_is_refused_with_those_that_are_near(
    user_folder: Path, name: str, kind: str, remedy: str
) -> None:
    (user_folder / "rigs").mkdir()
    (user_folder / "rigs" / "big_table.toml").touch()
    with raises_input_error(key=name, remedy=remedy):
        find_config(name, kind, user_folder / "tests" / "mine.toml")


def test_folders_of_the_user_come_before_the_shipped_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    working, listed, own = (tmp_path / name for name in ("working", "listed", "own"))
    for root, names in (
        (working / "profiles", ("a",)),
        (listed, ("a", "b")),
        (own / "shaketwin", ("a", "b", "simulated")),
    ):
        (root / "rigs").mkdir(parents=True)
        for name in names:
            (root / "rigs" / f"{name}.toml").touch()
    (working / "quickstart").mkdir()  # a folder of results, not the test of that name
    monkeypatch.chdir(working)
    monkeypatch.setenv("SHAKETWIN_PROFILES", str(listed))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(own))
    places = [find_config(name, "rigs").parent.parent for name in ("a", "b", "simulated")]
    assert places == [working / "profiles", listed, own / "shaketwin"]
    assert list_configs("rigs").keys() >= {"a", "b", "simulated", "machine"}
    shipped = PROFILES_DIR / "tests" / "quickstart.toml"
    assert find_config("simulated", "rigs", shipped).parent.parent == own / "shaketwin"
    assert resolve_config(Path("quickstart"), "tests") == shipped
