"""How near the machine is to what stops it: peaks of the last second against card and sensors."""

from dataclasses import dataclass

import numpy as np

from table_io.block import Float1D
from table_io.profile import Profile
from table_io.rig import Rig
from table_io.units import GRAVITY_M_S2, UNITS
from twin.service.monitor.recent import Recent

VELOCITY_S = 0.01  # over which protection makes a displacement a velocity


@dataclass(frozen=True, slots=True)
class Margin:
    """Peak and limit of one quantity in `unit`; `why` says whose limit it is. NaN: lost."""

    name: str
    peak: float
    limit: float
    unit: str
    why: str

    @property
    def share(self) -> float:
        return self.peak / self.limit


def margins(rig: Rig, profile: Profile, tare: dict[str, float], recent: Recent) -> list[Margin]:
    """One Margin a sensor, then velocity and force of the table; the smallest limit of each counts.

    A sensor's range bounds what it sees, its tare included; the machine's limits bound the motion.
    Velocity and force as protection takes them (`table_io.protection.watch`).
    """
    channels, values = recent.second()
    card = rig.limits
    machine = {
        "drive_disp_m": (card.stroke_mm * 1e-3, "stroke"),
        "table_disp_m": (card.stroke_mm * 1e-3, "stroke"),
        "table_acc_m_s2": (card.acceleration_g * GRAVITY_M_S2, "table"),
    }
    seen = dict(zip(channels, values, strict=True))
    rows = []
    for sensor in rig.sensors:
        if sensor.channel not in seen:
            continue
        samples = seen[sensor.channel]
        peaks = [(_peak(samples + tare.get(sensor.channel, 0.0)), sensor.range_si, "range")]
        if sensor.channel in machine:
            peaks.append((_peak(samples), *machine[sensor.channel]))
        peak, limit, why = max(peaks, key=lambda one: one[0] / one[1])
        scale = UNITS[sensor.unit][1]
        rows.append(Margin(sensor.channel, peak / scale, limit / scale, sensor.unit, why))
    if {"table_disp_m", "table_acc_m_s2"} <= seen.keys():
        span = round(VELOCITY_S * recent.blocks[-1].rate_hz)
        moved = seen["table_disp_m"]
        velocity = (moved[span:] - moved[:-span]) * 1e3 / VELOCITY_S
        rows.append(Margin("velocity", _peak(velocity), card.velocity_mm_s, "mm/s", "table"))
        force = rig.moving_mass_kg * seen["table_acc_m_s2"]
        if "mass_acc_m_s2" in seen:
            force = force + profile.specimen.mass_kg * np.nan_to_num(seen["mass_acc_m_s2"])
        rows.append(Margin("force", _peak(force) * 1e-3, card.force_kn, "kN", "table"))
    return rows


def _peak(samples: Float1D) -> float:
    """Largest magnitude; NaN where all are lost."""
    known = samples[np.isfinite(samples)]
    return float(np.abs(known).max()) if known.size else float("nan")
