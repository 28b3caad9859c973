"""Recordings are read, replayed and reported without extras and without Linux-only modules."""

import subprocess
import sys
from pathlib import Path

import pytest

from table_io.errors import InputError, require_package

LINUX_ONLY = ("fcntl", "grp", "pty", "pwd", "resource", "termios", "tty")
EXTRAS = ("duckdb", "h5py", "nidaqmx", "opendaq", "pyarrow", "rerun", "xarray")
# Blocks the modules, removes what Windows lacks, then runs each command given as an argument.
PROGRAM = f"""
import os, runpy, signal, sys
for name in {LINUX_ONLY + EXTRAS}:
    sys.modules[name] = None
for module, names in (os, ("fork", "killpg", "nice", "sched_getaffinity", "setpriority")), (
    signal, ("SIGALRM", "setitimer")
):
    for name in names:
        delattr(module, name)
from twin.cli.table import main
codes = []
for line in sys.argv[1:]:
    sys.argv = ["shaketwin", *line.split()]
    try:
        main()
    except SystemExit as ended:
        codes.append(ended.code)
print("codes", *codes)
import twin.log, twin.discovery.command
import twin.simulation.command, twin.demo.command
import twin.campaign.report, twin.exchange.import_table, twin.monitor.app, twin.studies.command
"""


@pytest.mark.slow  # 8 s
def test_recordings_are_used_without_extras_and_linux(log_file: Path, tmp_path: Path) -> None:
    commands = {
        f"replay {log_file} --steps 0 --out {tmp_path / 'again'}": 0,
        f"verify {log_file}": 0,
        f"prc {log_file}": 0,
        f"export {log_file} --csv -o {tmp_path / 'table'}": 0,
        f"export {log_file} --rrd -o {tmp_path / 'view'}": 2,
        f"run quickstart --view --speed max --out {tmp_path / 'run'}": 2,
        f"view {log_file}": 2,
    }
    result = subprocess.run(
        [sys.executable, "-c", PROGRAM, *commands], capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr
    codes = next(line for line in result.stdout.splitlines() if line.startswith("codes"))
    assert codes.split()[1:] == [str(code) for code in commands.values()], result.stderr
    assert result.stderr.count('"shaketwin[view]"') == 3
    assert not (tmp_path / "run").exists()


def test_a_package_of_an_extra_that_is_missing_is_named_with_its_extra() -> None:
    require_package("numpy", "view", "here")
    with pytest.raises(InputError) as error:
        require_package("no_such_package", "view", "here")
    assert "shaketwin[view]" in error.value.remedy
