"""Live margins: peaks of the last second relative to table limits and sensor ranges."""

from dataclasses import dataclass

import numpy as np

from table_io.block import Float1D
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig
from table_io.units import GRAVITY_M_S2, UNITS
from twin.monitor.recent import RecentSamples

VELOCITY_WINDOW_S = 0.01  # difference interval of the velocity, as in protection


@dataclass(frozen=True, slots=True)
class LiveMargin:
    """Peak and limit of one quantity in `unit`; `limit_source` names the limit. NaN: data lost."""

    name: str
    peak: float
    limit: float
    unit: str
    limit_source: str

    @property
    def share(self) -> float:
        return self.peak / self.limit


def compute_live_margins(
    rig: RigConfig, profile: Profile, tare: dict[str, float], recent: RecentSamples
) -> list[LiveMargin]:
    """Compute one margin per sensor, then velocity and force of the table; the tightest limit each.

    A sensor range applies to the reading including tare, a table limit to the motion. Velocity and
    force as in `table_io.safety.protection.sample_checks`.
    """
    channels, values = recent.last_second()
    limits = rig.limits
    table_limits = {
        "drive_disp_m": (limits.stroke_mm * 1e-3, "stroke"),
        "table_disp_m": (limits.stroke_mm * 1e-3, "stroke"),
        "table_acc_m_s2": (limits.acceleration_g * GRAVITY_M_S2, "table"),
    }
    samples_by_channel = dict(zip(channels, values, strict=True))
    rows = []
    for sensor in rig.sensors:
        if sensor.channel not in samples_by_channel:
            continue
        samples = samples_by_channel[sensor.channel]
        peaks = [(_peak(samples + tare.get(sensor.channel, 0.0)), sensor.range_si, "range")]
        if sensor.channel in table_limits:
            peaks.append((_peak(samples), *table_limits[sensor.channel]))
        peak, limit, limit_source = max(peaks, key=lambda candidate: candidate[0] / candidate[1])
        scale = UNITS[sensor.unit][1]
        rows.append(
            LiveMargin(sensor.channel, peak / scale, limit / scale, sensor.unit, limit_source)
        )
    if {"table_disp_m", "table_acc_m_s2"} <= samples_by_channel.keys():
        span_samples = round(VELOCITY_WINDOW_S * recent.blocks[-1].rate_hz)
        displacement = samples_by_channel["table_disp_m"]
        velocity = (
            (displacement[span_samples:] - displacement[:-span_samples]) * 1e3 / VELOCITY_WINDOW_S
        )
        rows.append(LiveMargin("velocity", _peak(velocity), limits.velocity_mm_s, "mm/s", "table"))
        force = rig.moving_mass_kg * samples_by_channel["table_acc_m_s2"]
        if "mass_acc_m_s2" in samples_by_channel:
            force = force + profile.specimen.mass_kg * np.nan_to_num(
                samples_by_channel["mass_acc_m_s2"]
            )
        rows.append(LiveMargin("force", _peak(force) * 1e-3, limits.force_kn, "kN", "table"))
    return rows


def _peak(samples: Float1D) -> float:
    """Return the largest magnitude; NaN if all samples are lost."""
    known = samples[np.isfinite(samples)]
    return float(np.abs(known).max()) if known.size else float("nan")
