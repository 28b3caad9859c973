"""What processes of a crew do in tests: they are sent by name, so it stands in a module."""

import os
import signal
from typing import Any

from twin.validation.study.scoring import score_verdict
from twin.validation.study.worker_pool import map_in_processes

CLEAN: dict[str, Any] = {
    "cell": "none/1%", "kind": "none", "noise": 0.01, "size": 0.0, "reached": 1.0,
    "region": None, "ended": "complete", "sized": True, "effects": [],
}  # fmt: skip


def fine(number: int) -> dict[str, Any]:
    return score_verdict({"verdict": "none"}, CLEAN | {"number": number}) | {"process": os.getpid()}


def deadly(number: int) -> dict[str, Any]:
    """Dies of an odd number."""
    if number % 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return fine(number)


def endless_if_odd(number: int) -> dict[str, Any]:
    return endless(number) if number % 2 else fine(number)


def endless(number: int) -> dict[str, Any]:
    """Never comes back."""
    signal.pause()
    return fine(number)


if __name__ == "__main__":  # a study to be killed: it writes the process of its first row
    for row in map_in_processes([0, 1], 1, fine, lambda: False):
        print(row["process"], flush=True)
        signal.pause()
