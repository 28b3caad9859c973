"""Output that is closed, not UTF-8, or made of foreign text: no traceback, no escape sequence."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from rich.table import Table
from rich.text import Text

from table_io.config.base import PROFILES_DIR
from tests.command_line import call_main
from twin.system.terminal import SafeConsole

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


@pytest.mark.slow  # 6 s
def test_a_reader_that_leaves_ends_nothing(tmp_path: Path) -> None:
    """As `shaketwin ... | true`: the command goes on to its end."""
    line = f"({PROGRAM[0]} -c '{PROGRAM[2]}' simulate demo --out out; echo $? > code) | true"
    subprocess.run(line, shell=True, check=True, timeout=120, cwd=tmp_path)
    until = time.monotonic() + 60
    while time.monotonic() < until and not (tmp_path / "code").is_file():
        time.sleep(0.1)
    assert (tmp_path / "code").read_text() == "0\n"
    assert (tmp_path / "out" / "report.html").is_file()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
def test_output_that_is_lost_is_an_error_of_its_own() -> None:
    with Path("/dev/full").open("w") as full:
        words = [*PROGRAM, "list", "effects"]
        ended = subprocess.run(words, stdout=full, stderr=-1, check=False, timeout=120)
    assert ended.returncode == 2
    assert b"No space left" in ended.stderr
    assert b"Traceback" not in ended.stderr


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


def test_whatever_is_printed_is_shown_without_escapes(capsys: pytest.CaptureFixture[str]) -> None:
    hostile = "a\x1b]0;owned\x07 Versuch\u00a04\tend"
    table = Table(hostile)
    table.add_row(Text(hostile))
    for printed in (hostile, Text(hostile), table):
        SafeConsole(width=100).print(printed)
        output = capsys.readouterr().out
        assert "owned" in output
        assert "\x1b" not in output
        assert "Versuch\u00a04" in output, "text of other languages stays"
