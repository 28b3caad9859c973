"""Adapter between study and discovery: folder of a case in, verdict out."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from twin.discovery.build_verdict import build_interval, build_parameter, build_verdict
from twin.discovery.cross_checks import fitted_gap
from twin.discovery.discover import PreparedLog, discover_effects, fit_known_effects
from twin.discovery.identify import identify_parameters
from twin.discovery.loading import load_logs, load_recordings
from twin.discovery.parameters import GapKey
from twin.model.model import Model
from twin.setup.run_config import read_model_template


def discover_in_case(case_dir: Path) -> dict[str, Any]:
    """Run discovery on the recording of a case; return the verdict as in verdict.json."""
    logs, notes, model = load_case(case_dir)
    verdict = build_verdict(discover_effects(logs, model), notes=notes).to_plain()
    for effect in verdict["effects"]:
        effect["parameters"] = {
            name: cover_every_value(estimate) for name, estimate in effect["parameters"].items()
        }
    return verdict


def cover_every_value(estimate: dict[str, Any]) -> dict[str, Any]:
    """Return an estimate whose interval is infinite where it is unknown: it covers the truth."""
    if estimate.get("low", 0.0) is None:
        return estimate | {"low": -math.inf, "high": math.inf}
    return estimate


def identify_in_case(case_dir: Path) -> dict[str, Any]:
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
        "parameters": {
            name: cover_every_value(estimate.to_plain())
            for name, estimate in (
                *((free.name, build_parameter(fit, free)) for free in fit.free),
                ("gap", build_interval(sum(sides.values()), sd, "m")),
            )
        }
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
