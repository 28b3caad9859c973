"""The only place where the study meets discovery: a case's folder in, a verdict out."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from twin.learn.discover import Log, discover, structured
from twin.model.model import Model
from twin.service.learning.command import model_of
from twin.service.learning.logs import logs_of
from twin.service.learning.told import verdict_json


def discovered(shown: Path) -> dict[str, Any]:
    """The verdict on the recording in a case's folder, as in verdict.json."""
    logs, notes, model = opened(shown)
    return verdict_json(discover(logs, model), notes=notes)


def true_structure(shown: Path, effects: Sequence[str]) -> float | None:
    """Held-out rms over the noise with exactly these effects, fitted; None: not to be had."""
    logs, _, model = opened(shown)
    found = structured(logs, model, effects)
    return math.sqrt(found.cost) if found is not None else None


def opened(shown: Path) -> tuple[Sequence[Log], Sequence[str], Model]:
    """The recording, what is to say of it, and the model to start from."""
    logs, notes = logs_of([shown / "log.mcap"])
    return logs, notes, model_of(str(shown / "model.toml"))[0]
