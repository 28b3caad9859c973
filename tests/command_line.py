"""The command line called in the process of a test, which does not import everything anew."""

import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path

import pytest
from typer.testing import CliRunner

from twin.cli import table as cli


def call_main(*words: object, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run `shaketwin` with these words in this process; an exception fails the test."""
    argv, out, err = ["shaketwin", *map(str, words)], StringIO(), StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out), redirect_stderr(err):
        patch.setattr(sys, "argv", argv)
        patch.setattr(cli, "configure_logging", lambda _: None)  # it would outlive the test
        if cwd is not None:
            patch.chdir(cwd)
        with pytest.raises(SystemExit) as ended:
            cli.main()
    assert isinstance(ended.value.code, int)
    return subprocess.CompletedProcess(argv, ended.value.code, out.getvalue(), err.getvalue())


def invoke(*words: object) -> tuple[int, str]:
    """Return (exit code, output) of `shaketwin` with these words; what is refused is raised."""
    result = CliRunner().invoke(cli.app, [*map(str, words)])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.stdout
