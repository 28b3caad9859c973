"""No file makes a command crash, hang or take all memory; thousands of them in the slow test."""

from pathlib import Path

import pytest

from tests.input_errors import raises_input_error
from tests.studies.hostile_files import Trials, call_command, watch
from twin.setup.run_config import from_texts

COMMANDS = {"verify", "prc", "replay", "import"}


@pytest.fixture(scope="module")
def trials(tmp_path_factory: pytest.TempPathFactory) -> Trials:
    return Trials(tmp_path_factory.mktemp("trials"))


@pytest.mark.parametrize(
    "number",
    [
        1, 3, 5, 7, 14, 18,
        pytest.param(108, marks=pytest.mark.slow),  # half a minute
    ],
)  # fmt: skip
def test_a_hostile_file_is_refused_or_read(
    number: int, trials: Trials, capsys: pytest.CaptureFixture[str]
) -> None:
    outcomes = trials.run(number)
    commands = COMMANDS if number % 10 == 8 else COMMANDS | {"export", "compare", "report"}
    assert {outcome.split()[0] for outcome in outcomes} == commands
    assert "CRASH" not in capsys.readouterr().out
    assert not any(outcome.endswith("crashed") for outcome in outcomes)


def test_crash_of_a_command_is_detected(trials: Trials, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("twin.replay.verify.examine_logs", lambda paths, _: paths[7])
    code, error = call_command(("verify", trials.folder / "whole.mcap"), report=False)
    assert code == "crashed"
    assert "IndexError" in error


def test_undamaged_files_are_accepted(trials: Trials, tmp_path: Path) -> None:
    log = trials.folder / "whole.mcap"
    assert call_command(("prc", log, "--json"), report=False)[0] == "0"
    (tmp_path / "a.csv").write_bytes(trials.table)
    assert call_command(("import", tmp_path / "a.csv", "-o", tmp_path / "a.mcap"), False)[0] == "0"


@pytest.mark.parametrize(
    ("old", "new", "fields"),
    [
        ("frequency_hz = 20.0", "frequency_hz = 1e-300", {"remedy": "power of ten"}),
        ("span_mm = 60.0", "span_mm = 1e308", {"remedy": "power of ten"}),
        ("span_mm = 60.0", "span_mm = " + "[" * 5000, {"remedy": "nesting"}),
    ],
)
def test_a_recorded_text_from_which_nothing_follows_is_refused(
    old: str, new: str, fields: dict[str, str], trials: Trials
) -> None:
    start = trials.start
    assert old in start.rig_toml
    with raises_input_error(**fields):
        from_texts(
            "n", start.profile_toml, start.rig_toml.replace(old, new), start.model_toml, "a.mcap"
        )


@pytest.mark.slow
def test_ten_thousand_hostile_files() -> None:
    counts, wrong = watch(0, 10_000)
    assert not wrong
    assert sum(counts.values()) >= 40_000
