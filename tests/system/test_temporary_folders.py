"""Temporary folders of processes that were killed are removed, those in use stay."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from twin.system import files
from twin.system.files import (
    MIN_AGE_S,
    SOCKET_PREFIX,
    VIEW_PREFIX,
    find_temporary_parent,
    make_private_folder,
    remove_unlocked_folders,
)

OWNER = """
import sys, time
from pathlib import Path
from twin.system import files
files.find_temporary_parent = lambda: Path(sys.argv[1])
folder = files.make_private_folder(sys.argv[2])
(folder / "bus").touch()
print(folder, flush=True)
time.sleep(60)
"""


def make_old(folder: Path, prefix: str, ages: float = 1.1) -> None:
    made_at = time.time() - ages * MIN_AGE_S[prefix]
    os.utime(folder, (made_at, made_at))


@pytest.mark.parametrize("prefix", [SOCKET_PREFIX, VIEW_PREFIX])
def test_the_folder_of_a_killed_process_is_removed_at_the_next_start(
    prefix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(files, "find_temporary_parent", lambda: tmp_path)
    command = [sys.executable, "-c", OWNER, str(tmp_path), prefix]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as owner:
        assert owner.stdout is not None
        folder = Path(owner.stdout.readline().strip())
        assert folder.is_dir()
        assert folder.stat().st_mode & 0o777 == 0o700
        make_old(folder, prefix)
        own_folder = make_private_folder(prefix)
        assert folder.is_dir(), "it is in use"
        os.kill(owner.pid, signal.SIGKILL)
    make_old(own_folder, prefix)
    make_private_folder(prefix)
    assert not folder.exists()
    assert own_folder.is_dir(), "it is in use by this process"


@pytest.mark.parametrize("prefix", [SOCKET_PREFIX, VIEW_PREFIX])
def test_a_folder_that_was_just_made_stays(prefix: str, tmp_path: Path) -> None:
    folder = tmp_path / f"{prefix}12345678"
    folder.mkdir()
    make_old(folder, prefix, ages=0.5)
    remove_unlocked_folders(tmp_path)
    assert folder.is_dir()
    make_old(folder, prefix)
    remove_unlocked_folders(tmp_path)
    assert not folder.exists()


def test_folders_of_other_programs_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    link, target = tmp_path / f"{SOCKET_PREFIX}link", tmp_path / "target"
    target.mkdir()
    (target / "file").touch()
    link.symlink_to(target)
    nested = tmp_path / f"{SOCKET_PREFIX}nested"
    (nested / "folder").mkdir(parents=True)
    results = tmp_path / "shaketwin-results"
    results.mkdir()
    for folder in (target, nested, results):
        make_old(folder, SOCKET_PREFIX, ages=1000.0)
    remove_unlocked_folders(tmp_path)
    assert (target / "file").exists()
    assert (nested / "folder").is_dir()
    assert results.is_dir()
    other = tmp_path / f"{SOCKET_PREFIX}other"
    other.mkdir()
    make_old(other, SOCKET_PREFIX)
    monkeypatch.setattr(os, "getuid", lambda: other.stat().st_uid + 1)
    remove_unlocked_folders(tmp_path)
    assert other.is_dir(), "it belongs to another user"


def test_socket_paths_stay_short(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / ("long" * 30)))
    assert find_temporary_parent() == Path("/tmp")
    monkeypatch.setattr("tempfile.tempdir", "/var/tmp")
    assert find_temporary_parent() == Path("/var/tmp")
