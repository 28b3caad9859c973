"""Too little memory or too few open files: one message that names the limit, and nothing begun."""

import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest

from tests.input_errors import raises_input_error
from twin.cli import entry
from twin.system.resource_limits import (
    MIN_OPEN_FILES,
    WANTED_OPEN_FILES,
    limit_matrix_threads,
    require_open_files,
)

MAIN = "from twin.cli.entry import main; main()"


def run_limited(limit: str, words: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    command = f'ulimit {limit}; exec "$@"'
    return subprocess.run(
        ["bash", "-c", command, "bash", sys.executable, "-c", MAIN, *words],
        capture_output=True,
        check=False,
        text=True,
        cwd=folder,
        env={"PYTHONPATH": str(Path(__file__).parents[2]), "PATH": "/usr/bin:/bin"},
    )


@pytest.mark.parametrize(
    ("limit", "key", "allowed"),
    [("-v 400000", "ulimit -v", "at least 976562 kB"),
     ("-v 1500000", "ulimit -v", "at least 1953125 kB"),
     ("-n 64", "ulimit -n", "at least 128")],
)  # fmt: skip
def test_a_run_under_too_low_a_limit_is_refused_with_the_limit(
    limit: str, key: str, allowed: str, tmp_path: Path
) -> None:
    completed = run_limited(limit, ["run", "quickstart", "--out", "new"], tmp_path)
    assert completed.returncode == 2
    assert "Traceback" not in completed.stderr
    for part in (key, limit.split()[1], allowed, f"raise it with `{key}"):
        assert part in completed.stderr
    assert not (tmp_path / "new").exists()


def test_stop_command_is_sent_with_any_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    sent: list[list[str]] = []

    def send(words: list[str]) -> bool:
        sent.append(words)
        return True

    monkeypatch.setattr(entry, "send_order", send)
    monkeypatch.setattr(entry, "require_memory", lambda _: pytest.fail("the order was delayed"))
    entry.run_words(["control", "stop"])
    assert sent == [["control", "stop"]]


def test_memory_that_runs_out_is_one_message(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(_: object) -> None:
        raise MemoryError

    monkeypatch.setattr(entry, "run_words", fail)
    monkeypatch.setattr(entry, "prepare_streams", lambda: [])
    with pytest.raises(SystemExit, match="2"):
        entry.main()
    assert capsys.readouterr().err == f"shaketwin: {entry.NO_MEMORY_MESSAGE}\n"


@pytest.mark.parametrize(
    ("limits", "raised_to"),
    [((64, 4096), WANTED_OPEN_FILES), ((64, 512), 512), ((4096, 4096), None), ((1024, 1024), None),
     ((512, 512), None), ((64, resource.RLIM_INFINITY), WANTED_OPEN_FILES),
     ((resource.RLIM_INFINITY, resource.RLIM_INFINITY), None), ((64, 64), "refused"),
     ((64, MIN_OPEN_FILES - 1), "refused")],
)  # fmt: skip
def test_open_files_are_raised_as_far_as_they_are_allowed(
    limits: tuple[int, int], raised_to: int | str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    limits_set: list[tuple[int, int]] = []
    monkeypatch.setattr(resource, "getrlimit", lambda _: limits)
    monkeypatch.setattr(resource, "setrlimit", lambda _, pair: limits_set.append(pair))
    if raised_to == "refused":
        with raises_input_error(key="ulimit -n", value=limits[1]):
            require_open_files()
    else:
        require_open_files()
        assert limits_set == ([] if raised_to is None else [(raised_to, limits[1])])


@pytest.mark.parametrize(("asked", "threads"), [(None, "1"), ("4", "4")])
def test_limit_matrix_threads_keeps_what_the_user_asks_for(
    asked: str | None, threads: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("OPENBLAS_NUM_THREADS")
    if asked is not None:
        monkeypatch.setenv("OPENBLAS_NUM_THREADS", asked)
    limit_matrix_threads()
    assert os.environ["OPENBLAS_NUM_THREADS"] == threads
