"""Versions that affect bitwise reproducibility: libraries, processor, numerics revision."""

import platform
from collections.abc import Mapping
from functools import cache
from importlib.metadata import version

LIBRARIES = ("shaketwin", "numpy", "scipy", "numba", "protobuf", "eclipse-zenoh", "mcap")
# Increase it when model or comparison compute other bits from the same samples;
# tests/system/test_versions.py reminds of it. A hash of the source changes with every renaming.
NUMERICS_REVISION = "revision 3"
# Recordings of version 0.1.0 hold a hash of the source instead.
REVISION_BY_SOURCE_HASH = {"1947a383fe41": "revision 1"}


@cache
def read_installed_versions() -> dict[str, str]:
    """Return versions by name, as recorded at the start of a run.

    `machine` is the processor that kernels are compiled for, `kernels` the revision of the
    numerics of model and comparison.
    """
    from llvmlite.binding import get_host_cpu_name

    return {name: version(name) for name in LIBRARIES} | {
        "python": platform.python_version(),
        "machine": f"{platform.machine()} {get_host_cpu_name()}",
        "kernels": NUMERICS_REVISION,
    }


VersionPairs = dict[str, dict[str, str | None]]


def compare_versions(recorded: dict[str, str]) -> VersionPairs:
    """Return the recorded and the installed version by name, None if unknown."""
    installed = read_installed_versions()
    kernels = recorded.get("kernels", "")
    if kernels in REVISION_BY_SOURCE_HASH:
        recorded = {**recorded, "kernels": REVISION_BY_SOURCE_HASH[kernels]}
    return {
        name: {"recorded": recorded.get(name), "installed": installed.get(name)}
        for name in sorted({*recorded, *installed})
    }


def find_version_changes(recorded: dict[str, str]) -> VersionPairs:
    """Return the pairs in which both versions are known and differ."""
    return {
        name: pair
        for name, pair in compare_versions(recorded).items()
        if pair["recorded"] not in (None, pair["installed"])
    }


def find_version_problem(recorded: Mapping[str, str], installed: Mapping[str, str]) -> str:
    """Return how installed versions differ from recorded ones, missing ones too; "" if equal.

    The processor may differ, although the last bits may too.
    """
    return format_version_changes(
        {
            name: {"recorded": recorded.get(name), "installed": installed.get(name)}
            for name in sorted({*recorded, *installed} - {"machine"})
            if recorded.get(name) != installed.get(name)
        }
    )


def format_version_changes(pairs: VersionPairs) -> str:
    """Format version changes as `name old -> new`, comma-separated; "" for none."""
    return ", ".join(
        f"{name} {pair['recorded']} -> {pair['installed'] or 'none'}"
        for name, pair in pairs.items()
    )
