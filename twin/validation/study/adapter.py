"""Adapter between study and discovery: folder of a case in, verdict out."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from twin.identification.discover import PreparedLog, discover_effects, fit_known_effects
from twin.model.model import Model
from twin.reports.discovery.loading import load_logs
from twin.reports.discovery.serialize import verdict_to_json
from twin.run.run_config import read_model_template


def run_discovery(case_dir: Path) -> dict[str, Any]:
    """Run discovery on the recording of a case; return the verdict as in verdict.json."""
    logs, notes, model = load_case(case_dir)
    return verdict_to_json(discover_effects(logs, model), notes=notes)


def fit_true_structure(case_dir: Path, effects: Sequence[str]) -> float | None:
    """Return the held-out rms over the noise with these effects fitted; None if they cannot be."""
    logs, _, model = load_case(case_dir)
    fit = fit_known_effects(logs, model, effects)
    return math.sqrt(fit.cost) if fit is not None else None


def load_case(case_dir: Path) -> tuple[Sequence[PreparedLog], Sequence[str], Model]:
    """Return the recording, notes on it, and the start model of a case."""
    logs, notes = load_logs([case_dir / "log.mcap"])
    return logs, notes, read_model_template(str(case_dir / "model.toml"))[0]
