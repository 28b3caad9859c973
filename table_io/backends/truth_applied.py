"""A sealed truth put to work: the plant that it makes of the nominal one, and what sensors misread.

Everything in SI. Parameters and signs as in `truth.KINDS`.
"""

import math
from dataclasses import fields
from typing import Any

import numpy as np

from table_io.backends.plant import Plant
from table_io.backends.plant_hidden import Hidden, HiddenPlant
from table_io.backends.truth import Truth
from table_io.block import Float1D, Float2D
from table_io.card import BadInput

# Parameters whose coefficient has another name than they have.
COEFFICIENTS = {
    "coulomb_friction": {"stribeck_speed": "vs", "slip_speed": "v0"},
    "bouc_wen": {"force": "fy", "yield_displacement": "uy", "exponent": "n"},
    "bumper_maxwell": {"tau": "tau_b"},
    "gap_drift": {"rate": "drift"},
    "stiffness_drift": {"rate": "warm"},
    "dead_band": {"width": "dead"},
    "adhesion": {"force": "pull"},
    "appendage": {"mass": "m2", "frequency": "w2", "damping_ratio": "z2"},
}
CUBIC = 4  # samples that an interpolated value is taken from


def hidden_plant(plant: Plant, truth: Truth) -> HiddenPlant:
    """The plant as it is, from the plant as the cards say."""
    stated: dict[str, Any] = {one.name: getattr(plant, one.name) for one in fields(Plant)}
    stated |= truth.base.model_dump(exclude_none=True)
    laws: dict[str, Any] = {}
    for one in truth.effects:
        p = one.parameters
        match one.id:
            case "mass_error":
                stated["mass_kg"] /= p["ratio"]
            case "gap_offset":
                stated["gap_right_m"] += p["offset"]
                stated["gap_left_m"] -= p["offset"]
            case "bumper_asymmetry":
                laws["stiff"] = 2 * p["ratio"] / (1 + p["ratio"]), 2 / (1 + p["ratio"])
            case _ if not one.kind.sensor:
                names = COEFFICIENTS.get(one.id, {})
                laws |= {names.get(key, key): value for key, value in p.items()}
    if "fc" in laws:
        laws.setdefault("fs", laws["fc"])
    if "w2" in laws:
        laws["w2"] *= 2 * math.pi
    return HiddenPlant(**stated, hidden=Hidden(**laws))


class Misread:
    """What sensors with gain, lag or offset read; samples must come in order."""

    def __init__(self, truth: Truth, channels: tuple[str, ...], rate_hz: float) -> None:
        self._rate_hz = rate_hz
        for one in truth.effects:
            if one.channel is not None and one.channel not in channels:
                raise BadInput(
                    f"the hidden truth: {one.id} of {one.channel}, but the rig has no such sensor; "
                    f"it has: {', '.join(channels)}"
                )
        self._errors = [
            (one.id, channels.index(str(one.channel)), next(iter(one.parameters.values())))
            for one in sorted(truth.effects, key=lambda one: one.id == "sensor_offset")
            if one.kind.sensor
        ]
        self._before: dict[int, Float1D] = {}

    def of(self, values: Float2D) -> Float2D:
        """Readings without noise from true values, (channel, sample) each."""
        values = values.copy()
        for name, row, size in self._errors:
            match name:
                case "sensor_gain":
                    values[row] *= size
                case "sensor_offset":
                    values[row] += size
                case "sensor_lag":
                    values[row] = self._late(row, values[row], size * self._rate_hz)
        return values

    def _late(self, row: int, values: Float1D, lag: float) -> Float1D:
        """values(t - lag), lag in samples: a cubic through four samples, none of them to come."""
        whole = max(math.floor(lag) - 1, 0)
        depth = whole + CUBIC - 1
        if values.size == 0:
            return values
        before = self._before.get(row, np.full(depth, values[0]))  # at rest before the first
        known = np.concatenate([before, values])
        self._before[row] = known[known.size - depth :]
        at = whole + np.arange(CUBIC) - lag  # of the four samples, from the wanted moment on
        weights = [math.prod(a / (a - b) for a in at if a != b) for b in at]
        late: Float1D = np.zeros(values.size)
        for back, weight in enumerate(weights):
            late += weight * known[depth - whole - back :][: values.size]
        return late
