"""Application of a ground truth: hidden laws of the plant, distortion of sensor readings.

Everything in SI. Parameters and signs as in `ground_truth.DEFINITION_BY_ID`.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from table_io.block import Float2D
from table_io.sim.filters import FractionalDelay
from table_io.sim.ground_truth import GroundTruth
from table_io.sim.hidden_laws import StrangeLaws
from table_io.sim.imperfections import Imperfection, resolve_sides
from table_io.sim.plant import HiddenCoefficients, Plant

# Parameters whose coefficient has a different name.
COEFFICIENT_NAMES = {
    "coulomb_friction": {"slip_speed": "v0"},
    "bouc_wen": {"force": "fy", "yield_displacement": "uy", "exponent": "n"},
    "bumper_maxwell": {"tau": "tau_b"},
    "gap_drift": {"rate": "gap_rate"},
    "stiffness_drift": {"rate": "stiffness_rate"},
    "dead_band": {"width": "dead_width"},
    "adhesion": {"force": "pull"},
    "appendage": {"mass": "m2", "frequency": "w2", "damping_ratio": "z2"},
}


def hide_laws(plant: Plant, truth: GroundTruth) -> Plant:
    """Return the nominal plant with the true parameters and the hidden effects of a truth."""
    parameters = {
        name: getattr(plant, name) for name in ("mass_kg", "gap_right_m", "gap_left_m", "rate_hz")
    }
    parameters |= truth.base.model_dump(exclude_none=True)
    coefficients: dict[str, Any] = {}
    strange: dict[str, Any] = {}  # parameters of each law in turn
    for effect in truth.effects:
        p = effect.parameters
        match effect.id:
            case "mass_error":
                parameters["mass_kg"] /= p["ratio"]
            case "gap_offset":
                parameters["gap_right_m"] += p["offset"]
                parameters["gap_left_m"] -= p["offset"]
            case "bumper_asymmetry":
                coefficients["stiffness_ratio"] = (
                    2 * p["ratio"] / (1 + p["ratio"]),
                    2 / (1 + p["ratio"]),
                )
            case "stribeck_friction":
                coefficients["fs"] = p["fc"] * p["ratio"]
                coefficients |= {"fc": p["fc"], "vs": p["speed"], "v0": p["slip_speed"]}
            case name if name in StrangeLaws._fields:
                strange[name] = tuple(p[q.name] for q in effect.definition.parameters)
            case _ if not effect.definition.is_sensor_effect:
                names = COEFFICIENT_NAMES.get(effect.id, {})
                coefficients |= {names.get(key, key): value for key, value in p.items()}
    _apply_imperfections(truth.imperfections, parameters, coefficients)
    if "fc" in coefficients:
        coefficients.setdefault("fs", coefficients["fc"])
    if "w2" in coefficients:
        coefficients["w2"] *= 2 * math.pi
    hidden = HiddenCoefficients(
        **coefficients, is_strange=bool(strange), strange=StrangeLaws(**strange)
    )
    return replace(plant, **parameters, hidden=hidden)


def _apply_imperfections(
    imperfections: Sequence[Imperfection],
    parameters: dict[str, Any],
    coefficients: dict[str, Any],
) -> None:
    """Change the parameters and coefficients of a plant by the imperfections of the set-up."""
    for imperfection in imperfections:
        p = imperfection.parameters
        match imperfection.id:
            case "mass_reading":
                parameters["mass_kg"] *= p["ratio"]
            case "table_pitch":
                coefficients["tilt"] = coefficients.get("tilt", 0.0) + p["per_travel"]
                coefficients["pitch"] = p["per_acceleration"]
            case "time_base":
                parameters["rate_hz"] *= 1.0 + 1e-6 * p["deviation"]
    for side, p in resolve_sides(imperfections, "gap_reading").items():
        parameters[f"gap_{side}_m"] += p["offset"]


class SensorDistortion:
    """Distortion of sensor readings by gain, lag and offset; samples must come in order."""

    def __init__(self, truth: GroundTruth, channels: tuple[str, ...], rate_hz: float) -> None:
        for effect in truth.effects:
            effect.check_channel(channels, "the rig has no sensor of this channel")
        self._errors = [
            (effect.id, channels.index(str(effect.channel)), next(iter(effect.parameters.values())))
            for effect in sorted(truth.effects, key=lambda effect: effect.id == "sensor_offset")
            if effect.definition.is_sensor_effect
        ]
        self._delays = {
            row: FractionalDelay(size * rate_hz)
            for effect_id, row, size in self._errors
            if effect_id == "sensor_lag"
        }

    def apply(self, values: Float2D) -> Float2D:
        """Return distorted readings without noise from true values, (channel, sample) each."""
        values = values.copy()
        for effect_id, row, size in self._errors:
            match effect_id:
                case "sensor_gain":
                    values[row] *= size
                case "sensor_offset":
                    values[row] += size
                case "sensor_lag":
                    values[row] = self._delays[row].apply(values[row])
        return values
