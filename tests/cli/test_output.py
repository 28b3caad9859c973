"""Output that is closed, not UTF-8, or made of foreign text: no traceback, no escape sequence."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from table_io.config.base import PROFILES_DIR
from tests.command_line import call_main

PROGRAM = [sys.executable, "-c", "from twin.cli.entry import main; main()"]


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "utf-8"])
def test_what_an_encoding_lacks_ends_nothing(encoding: str) -> None:
    environment = {**os.environ, "PYTHONIOENCODING": encoding}
    words = [*PROGRAM, "list", "effects"]
    ended = subprocess.run(words, env=environment, check=True, capture_output=True, timeout=120)
    assert b"coulomb_friction" in ended.stdout


def test_closed_streams_end_nothing(tmp_path: Path) -> None:
    """As `shaketwin ... >&- 2>&-` in a shell."""
    line = f"exec {PROGRAM[0]} -c '{PROGRAM[2]}' new test {tmp_path / 'new.toml'} >&- 2>&-"
    subprocess.run(line, shell=True, check=True, timeout=120)
    assert (tmp_path / "new.toml").stat().st_size > 100


@pytest.mark.parametrize("words", [("check",), ("simulate", "--gap", "4", "--out", "out")])
def test_titles_of_strangers_send_no_escapes(words: tuple[str, ...], tmp_path: Path) -> None:
    text = (PROFILES_DIR / "tests" / "demo.toml").read_text(encoding="utf-8")
    hostile = text.replace('title = "Demo', 'title = "Demo\\u001b]0;owned\\u0007')
    assert hostile != text
    (tmp_path / "hostile.toml").write_text(hostile)
    command, *options = words
    ended = call_main(command, "hostile.toml", *options, cwd=tmp_path)
    assert ended.returncode == 0, ended.stderr
    assert "owned" in ended.stdout
    assert "\x1b" not in ended.stdout + ended.stderr


def test_an_error_shows_no_escapes(tmp_path: Path) -> None:
    (tmp_path / "hostile.toml").write_text(r'"\u001b]0;owned\u0007" = 1')
    ended = call_main("check", "hostile.toml", cwd=tmp_path)
    assert ended.returncode == 2
    assert "owned" in ended.stderr
    assert "\x1b" not in ended.stderr
