"""One thread for matrices, as in a run; coarse pictures; more time for long studies; fixtures."""

import gc
import os
import runpy
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

from twin.system.resource_limits import limit_matrix_threads

# Before anything is imported that computes; so whatever does is imported where it is needed.
limit_matrix_threads()
# The process that reads a foreign file is forked, and what grpc does there once failed a check.
os.environ.setdefault("GRPC_ENABLE_FORK_SUPPORT", "0")

# What is imported is compiled once for all the processes that the tests start.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# Drawing was a fifth of the time of all tests. So every line is drawn, but coarsely and without
# ticks, here and in the processes that tests start. `full_quality` is for tests of the pictures.
DRAFT_SITE = Path(__file__).parent / "draft"
if "--benchmark-only" not in sys.argv and str(DRAFT_SITE) not in os.environ.get("PYTHONPATH", ""):
    paths = (str(DRAFT_SITE), os.environ.get("PYTHONPATH"))
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, paths))
    runpy.run_path(str(DRAFT_SITE / "sitecustomize.py"))

pytest_plugins = ["tests.builders.recordings", "tests.reports.folders"]
settings.register_profile("any machine", deadline=None)  # no test needs a quiet one
settings.load_profile("any machine")

SLOW_TIMEOUT_S = 3600.0


@pytest.hookimpl(tryfirst=True)
def pytest_configure(config: pytest.Config) -> None:
    """Let --benchmark-only measure, in one process, which the default options forbid."""
    if config.getoption("benchmark_only"):
        config.option.benchmark_enable = True
        config.option.dist, config.option.tx, config.option.numprocesses = "no", [], 0


def pytest_collection_finish() -> None:
    """Spare the collector all that lives as long as the session: modules and tests."""
    gc.collect()
    gc.freeze()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Give the long studies more time than a test has."""
    for item in items:
        if item.get_closest_marker("slow"):
            item.add_marker(pytest.mark.timeout(SLOW_TIMEOUT_S))


@pytest.fixture
def forget_entry_points() -> Iterator[None]:
    """Scan the installed packages anew, for a test that installs some, which no other sees."""
    from table_io.config.plugins import list_entry_points

    list_entry_points.cache_clear()
    yield
    list_entry_points.cache_clear()
