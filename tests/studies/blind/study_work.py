"""What processes of a crew do in tests: they are sent by name, so it stands in a module."""

import os
from typing import Any

from tests.studies.blind.scoring import score_verdict

CLEAN: dict[str, Any] = {
    "cell": "none/1%", "kind": "none", "noise": 0.01, "size": 0.0, "reached": 1.0,
    "region": None, "ended": "complete", "sized": True, "effects": [],
}  # fmt: skip


def fine(number: int) -> dict[str, Any]:
    return score_verdict({"verdict": "none"}, CLEAN | {"number": number}) | {"process": os.getpid()}
