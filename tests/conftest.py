"""One thread for matrices, as in a run; and a short run with a jump, for who needs a recording."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import settings

# Before anything is imported that computes; so whatever does is imported where it is needed.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

pytest_plugins = ["tests.reports.folders"]
settings.register_profile("any machine", deadline=None)  # no test needs a quiet one
settings.load_profile("any machine")

if TYPE_CHECKING:
    from twin.recording.reader import Recording
    from twin.run.run_config import RunConfig

SLOW_TIMEOUT_S = 3600.0
PROFILE = """
title = "Across the down-jump and back"
[specimen]
mass_kg = 550.0
gap_mm = 4.0
[sweep]
start_hz = 2.4
stop_hz = 4.4
step_hz = 1.0
cycles = 4
measured_cycles = 2
[loop_check]
enabled = false
[acquisition]
rate_hz = 1000.0
[recording]
predictions = "all"
"""


@pytest.hookimpl(tryfirst=True)
def pytest_configure(config: pytest.Config) -> None:
    """Let --benchmark-only measure, in one process, which the default options forbid."""
    if config.getoption("benchmark_only"):
        config.option.benchmark_enable = True
        config.option.dist, config.option.tx, config.option.numprocesses = "no", [], 0


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Give the long studies more time than a test has."""
    for item in items:
        if item.get_closest_marker("slow"):
            item.add_marker(pytest.mark.timeout(SLOW_TIMEOUT_S))


@pytest.fixture(autouse=True)
def forget_entry_points() -> Iterator[None]:
    """Scan the installed packages anew: a test may install some, which no other sees."""
    from table_io.config.plugins import list_entry_points

    list_entry_points.cache_clear()
    yield
    list_entry_points.cache_clear()


@pytest.fixture(scope="session")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> "RunConfig":
    """Six steps across the down-jump and back."""
    from twin.run.run_config import read_run_config

    path = tmp_path_factory.mktemp("across") / "across.toml"
    path.write_text(PROFILE)
    return read_run_config(path)


@pytest.fixture(scope="session")
def log_file(bundle: "RunConfig", tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recording of a run of it, alone in its folder."""
    from twin.run.unpaced import play_unpaced

    path = tmp_path_factory.mktemp("across") / "first" / "run.mcap"
    path.parent.mkdir()
    play_unpaced(bundle, "first", path, lambda: None, lambda _: None)
    return path


@pytest.fixture(scope="session")
def recording(log_file: Path) -> "Recording":
    from twin.recording.reader import read_recording

    return read_recording(log_file)
