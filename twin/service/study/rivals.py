"""Other methods on the same files: what is installed of them (`pip install shaketwin[rivals]`)."""

from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from twin.service.study.asking import opened
from twin.service.study.rivals_terms import Bench, bench_of

Json = dict[str, Any]
NEEDS = {"pysindy": "pysindy", "blackbox": "sklearn"}  # rival: the package it stands on
MISSING = "rivals left out, not installed: {}; pip install 'shaketwin[rivals]'"


def sindy(shown: Path) -> Json:
    """The verdict of PySINDy on the recording in a case's folder."""
    from twin.service.study.rivals_sindy import named

    return named(_bench(shown))


def blackbox(shown: Path) -> Json:
    """The error that boosted trees reach on it."""
    from twin.service.study.rivals_blackbox import floored

    return floored(_bench(shown))


def installed() -> dict[str, Callable[[Path], Json]]:
    """Rivals by name, of those whose package is there."""
    every = {"pysindy": sindy, "blackbox": blackbox}
    return {name: rival for name, rival in every.items() if find_spec(NEEDS[name])}


def missing() -> str:
    """A sentence where a rival is left out, else nothing."""
    away = [package for package in NEEDS.values() if not find_spec(package)]
    return MISSING.format(", ".join(away)) if away else ""


def _bench(shown: Path) -> Bench:
    logs, _, model = opened(shown)
    return bench_of(logs[0], model)
