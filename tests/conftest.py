"""One thread for matrices, as in a run; more time for long studies; fixtures of the builders."""

import os
from collections.abc import Iterator

import pytest
from hypothesis import settings

# Before anything is imported that computes; so whatever does is imported where it is needed.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

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
