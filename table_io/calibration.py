"""Volts <-> SI, both directions side by side: volts = (value + offset) * volts_per_si.

The offset is the tare: the SI value that the sensor showed at rest, before precompression.
"""

import numpy as np

from table_io.block import Float1D, Float2D
from table_io.rig import Output
from table_io.sensor import Sensor


def to_si(volts: Float2D, sensors: tuple[Sensor, ...], tare: dict[str, float]) -> Float2D:
    """Values in SI, (channel, sample), from volts of the same shape."""
    slope = np.array([1.0 / sensor.volts_per_si for sensor in sensors])
    offset = np.array([tare.get(sensor.channel, 0.0) for sensor in sensors])
    return volts * slope[:, None] - offset[:, None]


def to_volts(values: Float2D, sensors: tuple[Sensor, ...], tare: dict[str, float]) -> Float2D:
    """Volts, (channel, sample), from values in SI of the same shape; undoes `to_si`."""
    slope = np.array([sensor.volts_per_si for sensor in sensors])
    offset = np.array([tare.get(sensor.channel, 0.0) for sensor in sensors])
    return (values + offset[:, None]) * slope[:, None]


def command_to_volts(displacement_m: Float1D, output: Output) -> Float1D:
    """Volts of the command channel from displacement in m, (sample,)."""
    return displacement_m * output.volts_per_m


def command_to_si(volts: Float1D, output: Output) -> Float1D:
    """Displacement in m from volts of the command channel, (sample,)."""
    return volts / output.volts_per_m


def tare_from(volts: Float2D, sensors: tuple[Sensor, ...]) -> dict[str, float]:
    """Mean SI value of each channel at rest; the command channel is not tared.

    Lost samples do not count; NaN for a sensor that is lost altogether, so that it stays lost.
    """
    return {
        sensor.channel: float(samples[~np.isnan(samples)].mean())
        if not np.isnan(samples).all()
        else float("nan")
        for sensor, samples in zip(sensors, to_si(volts, sensors, {}), strict=True)
        if sensor.channel != "drive_disp_m"
    }


def noise_from(volts: Float2D, sensors: tuple[Sensor, ...]) -> dict[str, tuple[float, int]]:
    """(rms in SI, longest run of equal samples) of each channel at rest; lost samples left out."""
    noise = {}
    for sensor, samples in zip(sensors, to_si(volts, sensors, {}), strict=True):
        known = samples[~np.isnan(samples)]
        if known.size:
            edges = np.flatnonzero(np.diff(known, prepend=np.nan, append=np.nan))
            noise[sensor.channel] = (float(known.std()), int(np.diff(edges).max()))
    return noise
