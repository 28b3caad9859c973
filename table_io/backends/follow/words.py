"""Where the drive lies in a recording, in words, and what cannot be a table at rest."""

import numpy as np

from table_io.backends.follow.alignment import Plan
from table_io.backends.follow.follower import SIGMAS, STEPS, Follower
from table_io.block import Float1D
from table_io.card import BadInput
from table_io.sensor import Sensor

MEAN_S = 0.02  # over which noise and mains hum cancel, and motion does not
SHARE = 0.01  # of the drive's largest: less does not hide it


def aligned(now: Follower) -> str:
    """How the drive lies in what was acquired; empty where it was not found."""
    fit = now.fit
    if fit is None:
        return ""
    begun = fit.pivot - (fit.pivot + fit.offset) / (1.0 + 1e-6 * fit.ppm)
    playing = now.state == "playing"
    newest = f", the newest lies in it to +-{fit.sd(now.done):.2g}" if playing else ""
    return (
        f"{'' if playing else 'until it was left: '}sample 0 of the drive is sample {begun:.2f} of "
        f"the recording (+-{fit.sd(round(begun)):.2g}){newest}; the controller's clock runs "
        f"{fit.ppm:+.2f} ppm beside the acquisition's (+-{fit.covariance[1, 1] ** 0.5:.2g}); its "
        f"command is {fit.gain:.4f} of the drive; correlation {fit.correlation:.5f}"
    )


def refuse_motion(tare_m: Float1D, sensor: Sensor, plan: Plan, rate_hz: float) -> None:
    """BadInput where the command moved in the tare, (sample,): nothing of it would be told."""
    size = max(round(MEAN_S * rate_hz), 1)
    means = tare_m[: tare_m.size // size * size].reshape(-1, size).mean(axis=1)
    known = means[~np.isnan(means)]
    moved = float(np.ptp(known)) if known.size else 0.0
    noise = SIGMAS * sensor.noise_rms * abs(sensor.si_per_unit)
    still = noise + STEPS * 2 * sensor.range_si / 2**sensor.bits
    if moved <= still:
        return
    allowed = still + SHARE * _largest(plan, rate_hz)
    if moved > allowed:
        raise BadInput(
            f"{sensor.channel} moved by {moved * 1e3:.3g} mm in the second before the start; "
            f"allowed: {allowed * 1e3:.3g} mm. The controller plays already, or its command is "
            "disturbed: bring it to rest, start `run`, and play when it says NOW"
        )


def _largest(plan: Plan, rate_hz: float) -> float:
    """The drive's largest displacement, m."""
    piece = int(10 * rate_hz)
    pieces = range(0, max(plan.rest_from, 1), piece)
    return max(float(np.abs(plan.command(first, piece)).max()) for first in pieces)
