"""Adapter between study and discovery: folder of a case in, verdict out."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from twin.discovery.cross_checks import fitted_gap
from twin.discovery.discover import PreparedLog, discover_effects, fit_known_effects
from twin.discovery.identify import identify_parameters
from twin.discovery.loading import load_logs, load_recordings
from twin.discovery.parameters import GapKey
from twin.discovery.serialize import interval_to_json, parameter_to_json, verdict_to_json
from twin.model.model import Model
from twin.setup.run_config import read_model_template


def run_discovery(case_dir: Path) -> dict[str, Any]:
    """Run discovery on the recording of a case; return the verdict as in verdict.json."""
    logs, notes, model = load_case(case_dir)
    return verdict_to_json(discover_effects(logs, model), notes=notes)


def run_identification(case_dir: Path) -> dict[str, Any]:
    """Run identification on the recording of a case; return parameters and gaps with intervals.

    The gap of a side has no interval, as in the output of `identify`.
    """
    (loaded,) = load_recordings([case_dir / "log.mcap"])
    model = read_model_template(str(case_dir / "model.toml"))[0]
    result = identify_parameters([loaded.log], [loaded.blocks], model)
    fit, (residuals,) = result.fit, result.problem.log_residuals
    sides = {side: fitted_gap(residuals, fit, side) for side in ("right", "left")}
    sd = 2.0 * fit.std_errors.get(GapKey(0), math.inf)
    return {
        "verdict": "identified",
        "parameters": {free.name: parameter_to_json(fit, free) for free in fit.free}
        | {"gap": interval_to_json(sum(sides.values()), sd, "m")}
        | {f"gap_{side}": {"value": value, "unit": "m"} for side, value in sides.items()},
        "rms_over_noise": math.sqrt(fit.cost),
        "warnings": [*result.warnings],
    }


def fit_true_structure(case_dir: Path, effects: Sequence[str]) -> float | None:
    """Return the held-out rms over the noise with these effects fitted; None if they cannot be."""
    logs, _, model = load_case(case_dir)
    fit = fit_known_effects(logs, model, effects)
    return math.sqrt(fit.cost) if fit is not None else None


def load_case(case_dir: Path) -> tuple[Sequence[PreparedLog], Sequence[str], Model]:
    """Return the recording, notes on it, and the start model of a case."""
    logs, notes = load_logs([case_dir / "log.mcap"])
    return logs, notes, read_model_template(str(case_dir / "model.toml"))[0]
