"""Paths in a run's folder."""

from pathlib import Path

import pytest

from table_io.errors import InputError
from twin.inspection.curves import print_curves
from twin.recording.run_paths import resolve_log_path


def test_a_folder_or_its_log_is_resolved_to_the_log(tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    log.touch()
    assert resolve_log_path(tmp_path) == resolve_log_path(log) == log


def test_a_folder_without_a_recording_is_named_as_typed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").touch()
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError) as error:
        print_curves(Path("full"), False)
    assert error.value.where == "full"
    assert "run.mcap" in error.value.remedy
