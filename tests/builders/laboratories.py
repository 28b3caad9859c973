"""A random laboratory: imperfections of instruments and set-up, of typical or bad sizes."""

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np

from table_io.channels import CHANNELS
from table_io.errors import InputError, suggest
from table_io.sim.imperfections import (
    IMPERFECTION_DEFINITIONS,
    IMPERFECTION_IDS,
    INF,
    SIDES,
    SIZE_SCATTER,
    HiddenParameter,
    Imperfection,
    acts_on,
)

Level = Literal["typical", "bad"]
# Sensors of the canonical channels of the paper's rig: motion and load cells.
LABORATORY_CHANNELS = tuple(
    channel.name
    for channel in CHANNELS
    if channel.body not in ("command", "damper") and channel.name != "rel_disp_m"
)


def draw_laboratory(
    level: Level,
    generator: np.random.Generator,
    only: str | None = None,
    channels: Sequence[str] = LABORATORY_CHANNELS,
) -> list[Imperfection]:
    """Draw a random laboratory: imperfections of sizes about the typical or bad ones.

    Signs are random where a size can have both, sizes and phases differ between channels and
    sides. `only` draws a single imperfection; `channels` are canonical ones that the rig has.
    InputError if `only` is unknown.
    """
    if only is not None and only not in IMPERFECTION_IDS:
        raise InputError(
            "unknown imperfection", key="only", value=only, remedy=suggest(only, IMPERFECTION_IDS)
        )
    quantity_by_name = {channel.name: channel.quantity for channel in CHANNELS}
    laboratory = []
    for imperfection_id in IMPERFECTION_IDS if only is None else (only,):
        definitions = [d for d in IMPERFECTION_DEFINITIONS if d.id == imperfection_id]
        definition = definitions[generator.integers(len(definitions))]
        common = {
            parameter.name: float(np.exp(SIZE_SCATTER * generator.standard_normal()))
            for parameter in definition.parameters
        }
        mismatch = definition.mismatch if level == "typical" else SIZE_SCATTER
        places: list[dict[str, str]] = [{}]
        if definition.has_side:
            places = [{"side": side} for side in SIDES]
        elif definition.quantities:
            places = [
                {"channel": name}
                for name in channels
                if acts_on(definition, quantity_by_name[name])
            ]
        for place in places:
            parameters = {
                parameter.name: _draw_parameter(
                    parameter, level, common[parameter.name], mismatch, generator
                )
                for parameter in definition.parameters
            }
            laboratory.append(
                Imperfection.model_validate(
                    {"id": definition.id, "form": definition.form, "parameters": parameters} | place
                )
            )
    return laboratory


def _draw_parameter(
    parameter: HiddenParameter,
    level: Level,
    common: float,
    mismatch: float,
    generator: np.random.Generator,
) -> float:
    """Draw a size, with a factor `common` to all places, or a phase; other shapes are fixed."""
    size = parameter.typical if level == "typical" else float(parameter.bad or 0.0)
    if parameter.vanishing is None:
        is_phase = parameter.unit == "rad"
        return float(generator.uniform(0.0, math.tau)) if is_phase else size
    if parameter.is_integer:
        return size + float(generator.integers(-1, 2))
    factor = common * float(np.exp(mismatch * generator.standard_normal()))
    if parameter.vanishing == INF:
        return max(size * factor, parameter.low)
    is_signed = parameter.low < parameter.vanishing < parameter.high
    sign = float(generator.choice((-1.0, 1.0))) if is_signed else 1.0
    value = parameter.vanishing + sign * factor * (size - parameter.vanishing)
    return float(np.clip(value, parameter.low, parameter.high))
