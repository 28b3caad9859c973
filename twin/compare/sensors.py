"""Predicted channels as the model's sensors read them: reading = gain x value(t - lag) + offset.

They change what is predicted, never the motion. Row by row and sample by sample, so that the cut
into blocks changes no bit.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from table_io.block import Block, Float1D, Float2D
from twin.model.model import Sensor

TAPS = 4  # samples through which a cubic gives the value in between


def memory(sensors: Sequence[Sensor], rate_hz: float) -> int:
    """Samples of the past that the longest lag needs."""
    return max((_delay(one.lag * rate_hz)[0] + TAPS - 1 for one in sensors if one.lag), default=0)


def read(
    sensors: Sequence[Sensor], rate_hz: float, names: Sequence[str], values: Float2D, past: Float2D
) -> Float2D:
    """Readings (channel, sample) of `values`, whose columns follow those of `past`.

    Where a lag reaches back beyond what is known, NaN.
    """
    if not sensors:
        return values
    joined = np.concatenate([past, values], axis=1)
    readings = values.copy()
    for sensor in sensors:
        for row, name in enumerate(names):
            if name.split("/")[-1] == sensor.channel:
                late = delayed(joined[row], sensor.lag * rate_hz)[past.shape[1] :]
                readings[row] = sensor.gain * late + sensor.offset
    return readings


def kept(values: Float2D, past: Float2D, samples: int) -> Float2D:
    """The last `samples` columns of `past` and `values`, fewer at the start."""
    joined = np.concatenate([past, values], axis=1)
    return joined[:, max(joined.shape[1] - samples, 0) :]


def delayed(x: Float1D, samples: float) -> Float1D:
    """x(t - samples) by the cubic through four samples, none of them later; NaN where unknown."""
    if samples == 0:
        return x
    first, weights = _delay(samples)
    result = np.full(x.size, np.nan)
    reach = first + TAPS - 1
    if x.size > reach:
        total = np.zeros(x.size - reach)
        for tap, weight in enumerate(weights):
            back = first + tap
            total += weight * x[reach - back : x.size - back]
        result[reach:] = total
    return result


def _delay(samples: float) -> tuple[int, list[float]]:
    """(age of the youngest sample used, the Lagrange weights of it and the three before)."""
    first = max(math.floor(samples) - 1, 0)
    at = samples - first
    weights = []
    for one in range(TAPS):
        others = [other for other in range(TAPS) if other != one]
        weights.append(math.prod((at - other) / (one - other) for other in others))
    return first, weights


def corrected(sensors: Sequence[Sensor], block: Block) -> Block:
    """A measured block without the gains and offsets; a lag is not foreseen, so it stays."""
    values = block.values
    for sensor in sensors:
        if sensor.channel in block.channels and (sensor.gain, sensor.offset) != (1.0, 0.0):
            values = values.copy() if values is block.values else values
            row = block.channels.index(sensor.channel)
            values[row] = (values[row] - sensor.offset) / sensor.gain
    return block if values is block.values else replace(block, values=values)
