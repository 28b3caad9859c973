"""Diagnostics of the processes: which are logged, and how a line reads."""

import logging
import re
from collections.abc import Iterator

import pytest

from tests.input_errors import raises_input_error
from twin.system.diagnostics import LEVEL_VARIABLE, LEVELS, configure_logging

LOG = logging.getLogger("twin.live.test")


@pytest.fixture(autouse=True)
def logger() -> Iterator[logging.Logger]:
    package = logging.getLogger("twin")
    handlers, level = package.handlers, package.level
    yield package
    package.handlers = handlers
    package.setLevel(level)


def write_one_of_each() -> None:
    for level in LEVELS:
        LOG.log(getattr(logging, level.upper()), "a 100 %% %s", level)
    logging.getLogger("matplotlib").debug("drawn")


@pytest.mark.parametrize("level", LEVELS)
def test_lines_from_a_level_on_name_time_process_and_level(
    level: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv(LEVEL_VARIABLE, level)
    configure_logging("100 %s")
    write_one_of_each()
    captured = capsys.readouterr()
    lines = captured.err.splitlines()
    kept = LEVELS[LEVELS.index(level) :]
    assert len(lines) == len(kept)
    for line, name in zip(lines, kept, strict=True):
        assert re.fullmatch(
            rf"\d{{4}}-\d\d-\d\d [\d:,]+ 100 %s {name.upper()} a 100 % {name}", line
        )
    assert not captured.out


def test_only_errors_are_logged_unless_asked_for(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv(LEVEL_VARIABLE, raising=False)
    configure_logging("first")
    configure_logging("rig")  # replaces the former
    write_one_of_each()
    (line,) = capsys.readouterr().err.splitlines()
    assert " rig ERROR " in line


def test_an_unknown_level_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(LEVEL_VARIABLE, "loud")
    with raises_input_error(key=LEVEL_VARIABLE, value="loud", allowed="debug"):
        configure_logging("rig")
