"""Sensor errors on predicted channels: reading = gain x value(t - lag) + offset.

They change the prediction, never the motion. Each sample is computed on its own, so results are
bit-identical for any division into blocks.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from table_io.block import Block, Float1D, Float2D
from twin.model.model import SensorModel

INTERPOLATION_TAPS = 4  # samples of the interpolating cubic


def lag_samples(sensors: Sequence[SensorModel], rate_hz: float) -> int:
    """Return the number of past samples that the longest lag needs."""
    return max(
        (
            _delay_weights(sensor.lag * rate_hz)[0] + INTERPOLATION_TAPS - 1
            for sensor in sensors
            if sensor.lag
        ),
        default=0,
    )


def apply_sensors(
    sensors: Sequence[SensorModel],
    rate_hz: float,
    names: Sequence[str],
    values: Float2D,
    past: Float2D,
) -> Float2D:
    """Return readings (channel, sample) of `values`, whose columns follow those of `past`.

    NaN where a lag reaches back beyond the known samples.
    """
    if not sensors:
        return values
    joined = np.concatenate([past, values], axis=1)
    readings = values.copy()
    for sensor in sensors:
        for row, name in enumerate(names):
            if name.split("/")[-1] == sensor.channel:
                delayed = delay_signal(joined[row], sensor.lag * rate_hz)[past.shape[1] :]
                readings[row] = sensor.gain * delayed + sensor.offset
    return readings


def keep_last(values: Float2D, past: Float2D, samples: int) -> Float2D:
    """Return the last `samples` columns of `past` and `values`, fewer at the start."""
    joined = np.concatenate([past, values], axis=1)
    return joined[:, max(joined.shape[1] - samples, 0) :]


def delay_signal(x: Float1D, samples: float) -> Float1D:
    """Return x(t - samples) by a cubic through four samples, none later; NaN where unknown."""
    if samples == 0:
        return x
    first, weights = _delay_weights(samples)
    result = np.full(x.size, np.nan)
    oldest = first + INTERPOLATION_TAPS - 1
    if x.size > oldest:
        total = np.zeros(x.size - oldest)
        for tap, weight in enumerate(weights):
            age = first + tap
            total += weight * x[oldest - age : x.size - age]
        result[oldest:] = total
    return result


def _delay_weights(samples: float) -> tuple[int, list[float]]:
    """Return (age of the youngest sample used, Lagrange weights of it and the three before)."""
    first = max(math.floor(samples) - 1, 0)
    position = samples - first
    weights = []
    for tap in range(INTERPOLATION_TAPS):
        other_taps = [k for k in range(INTERPOLATION_TAPS) if k != tap]
        weights.append(math.prod((position - k) / (tap - k) for k in other_taps))
    return first, weights


def remove_sensor_errors(sensors: Sequence[SensorModel], block: Block) -> Block:
    """Return a measured block without gains and offsets; a lag stays, as it needs later samples."""
    values = block.values
    for sensor in sensors:
        if sensor.channel in block.channels and (sensor.gain, sensor.offset) != (1.0, 0.0):
            values = values.copy() if values is block.values else values
            row = block.channels.index(sensor.channel)
            values[row] = (values[row] - sensor.offset) / sensor.gain
    return block if values is block.values else replace(block, values=values)
