"""Conversion between volts and SI units: volts = (value + offset) * volts_per_si.

The offset is the tare: the SI value that the sensor showed at rest, before precompression.
"""

import numpy as np

from table_io.block import Float1D, Float2D
from table_io.config.rig import OutputConfig
from table_io.config.sensor import SensorConfig


def volts_to_si(
    volts: Float2D, sensors: tuple[SensorConfig, ...], tare: dict[str, float]
) -> Float2D:
    """Convert volts, (channel, sample), to SI values of the same shape."""
    slope = np.array([1.0 / sensor.volts_per_si for sensor in sensors])
    offset = np.array([tare.get(sensor.channel, 0.0) for sensor in sensors])
    return volts * slope[:, None] - offset[:, None]


def si_to_volts(
    values: Float2D, sensors: tuple[SensorConfig, ...], tare: dict[str, float]
) -> Float2D:
    """Convert SI values, (channel, sample), to volts; the inverse of `volts_to_si`."""
    slope = np.array([sensor.volts_per_si for sensor in sensors])
    offset = np.array([tare.get(sensor.channel, 0.0) for sensor in sensors])
    return (values + offset[:, None]) * slope[:, None]


def command_to_volts(displacement_m: Float1D, output: OutputConfig) -> Float1D:
    """Convert a displacement in m, (sample,), to volts of the command channel."""
    return displacement_m * output.volts_per_m


def command_to_si(volts: Float1D, output: OutputConfig) -> Float1D:
    """Convert volts of the command channel, (sample,), to displacement in m."""
    return volts / output.volts_per_m


def compute_tare(volts: Float2D, sensors: tuple[SensorConfig, ...]) -> dict[str, float]:
    """Compute the tare, the mean SI value of each channel at rest, except the command.

    Lost samples (NaN) are ignored; a sensor without any valid sample gets NaN and so stays lost.
    """
    return {
        sensor.channel: float(samples[~np.isnan(samples)].mean())
        if not np.isnan(samples).all()
        else float("nan")
        for sensor, samples in zip(sensors, volts_to_si(volts, sensors, {}), strict=True)
        if sensor.channel != "drive_disp_m"
    }


def measure_noise(
    volts: Float2D, sensors: tuple[SensorConfig, ...]
) -> dict[str, tuple[float, int]]:
    """Return (noise rms in SI, longest run of equal samples) per channel at rest, NaN ignored."""
    noise = {}
    for sensor, samples in zip(sensors, volts_to_si(volts, sensors, {}), strict=True):
        known = samples[~np.isnan(samples)]
        if known.size:
            edges = np.flatnonzero(np.diff(known, prepend=np.nan, append=np.nan))
            noise[sensor.channel] = (float(known.std()), int(np.diff(edges).max()))
    return noise
