"""Messages on the alignment of drive and recording, and the check that the table is at rest."""

import numpy as np

from table_io.acquisition.drive_alignment import PlannedDrive
from table_io.acquisition.drive_follower import NOISE_LSB, NOISE_SIGMAS, DriveFollower
from table_io.block import Float1D
from table_io.config.sensor import SensorConfig
from table_io.errors import InputError

MEAN_WINDOW_S = 0.02  # averages out noise and mains hum, but not motion
MAX_MOTION_SHARE = 0.01  # of the drive's peak displacement; less does not mask the drive


def format_alignment(follower: DriveFollower) -> str:
    """Describe the alignment of the drive with the recording; empty if it was not found."""
    fit = follower.fit
    if fit is None:
        return ""
    start = fit.pivot - (fit.pivot + fit.offset) / (1.0 + 1e-6 * fit.ppm)
    is_playing = follower.state == "playing"
    precision = (
        f", the newest sample is located to +-{fit.drive_index_sd(follower.processed_end):.2g}"
        if is_playing
        else ""
    )
    return (
        f"{'' if is_playing else 'until the drive was lost: '}sample 0 of the drive is sample "
        f"{start:.2f} of the recording (+-{fit.drive_index_sd(round(start)):.2g}){precision}; "
        "the controller's clock deviates by "
        f"{fit.ppm:+.2f} ppm from the acquisition's (+-{fit.covariance[1, 1] ** 0.5:.2g}); its "
        f"command is {fit.gain:.4f} of the drive; correlation {fit.correlation:.5f}"
    )


def refuse_motion(
    tare_m: Float1D, sensor: SensorConfig, plan: PlannedDrive, rate_hz: float
) -> None:
    """Raise InputError if the command in m moved during the tare, (sample,)."""
    size = max(round(MEAN_WINDOW_S * rate_hz), 1)
    means = tare_m[: tare_m.size // size * size].reshape(-1, size).mean(axis=1)
    known = means[~np.isnan(means)]
    motion = float(np.ptp(known)) if known.size else 0.0
    noise = NOISE_SIGMAS * sensor.noise_rms * abs(sensor.si_per_unit)
    rest_limit = noise + NOISE_LSB * 2 * sensor.range_si / 2**sensor.bits
    if motion <= rest_limit:
        return
    allowed = rest_limit + MAX_MOTION_SHARE * _peak_displacement(plan, rate_hz)
    if motion > allowed:
        raise InputError(
            f"moved by {motion * 1e3:.3g} mm in the second before the start: the controller is "
            "already playing, or its command is disturbed",
            key=sensor.channel,
            allowed=f"at most {allowed * 1e3:.3g} mm",
            remedy="bring it to rest, start `run` again and play the drive when prompted (NOW)",
        )


def _peak_displacement(plan: PlannedDrive, rate_hz: float) -> float:
    """Return the peak displacement of the drive in m."""
    chunk = int(10 * rate_hz)
    starts = range(0, max(plan.rest_start, 1), chunk)
    return max(float(np.abs(plan.command(first, chunk)).max()) for first in starts)
