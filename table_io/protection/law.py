"""What the pass over every sample (`watch.py`) goes by and remembers.

Thresholds come from the machine card, from the noise that each sensor showed at rest, and from the
reasons beside the constants.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from table_io.block import Float1D, Float2D, Int1D
from table_io.profile import Profile
from table_io.protection.watch import CODES, LAG, MARKED, ONCE, PER, UNKNOWN
from table_io.rig import Rig
from table_io.sensor import Sensor
from table_io.units import GRAVITY_M_S2

PAST_S = 0.25  # of samples kept from before: the longest repetition that is found
EPISODE_S = 1.0  # a finding is told once, until it has been away so long
LAG_S = 0.1  # more than any table lags that can do a stepped sine; 15 ms at 20 Hz of bandwidth
VELOCITY_S = 0.01  # over which a displacement becomes a velocity: noise / 10 ms is below 1 mm/s
RAILED = 3  # samples in a row at the range: no spike
BLIND_S = 0.02  # of lost samples in a row: at the velocity limit the table has moved 10 mm
STUCK_S = 0.01
STUCK_RUNS = 10  # times the longest run of equal samples at rest
TELLING_S = 0.1  # the longest run at rest from which something can be told of a sensor
MOVED_LSB = 20.0  # expected movement in which a sensor without noise must have changed
SPIKE_SIGMA = 10.0  # white noise: once in 1e14 samples
SPIKE_RANGE = 1e-3
JERK_S = 1e-3  # of half the least lag: a table so stiff shows every step of its output
SAME = 5  # samples in a row that are all equal to earlier ones: noise never repeats itself
WRONG = 8  # samples in a row off the command: more than SAME, so a repetition is told as such
READ_GAIN = 0.01  # of a command that is read back
READ_RANGE = 5e-4
UNSEEN = 0.25  # of the amplitude, off the command: gain within +-20 %, as the loop check allows
FOLLOWING = 0.15  # of the amplitude, off what the table did a cycle ago
# Before the sweep a loop check is to judge: more than a sensor of the wrong sign or offset shows.
GROSS, GROSS_STROKE = 2.5, 0.02
FOLLOWING_STROKE = 1e-3


class Law(NamedTuple):
    """SI, times in samples; arrays are (channel,). `mass` is -1 where there is no such sensor."""

    rate: float
    past: int  # samples from before a block that the pass looks at
    episode: float
    drive: int  # rows of the channels that the controller needs
    table: int
    acc: int
    mass: int
    stroke: float
    velocity: float
    acceleration: float
    force: float
    table_kg: float
    mass_kg: float
    span: int  # over which a displacement becomes a velocity
    full: Float1D  # range of the sensors
    spike: Float1D
    stuck: Float1D  # inf where the noise does not tell
    moves: Float1D  # expected movement that must show; inf where it need not
    must: float  # for which it is then constant
    noisy: npt.NDArray[np.bool_]
    blind: float
    lagging: int  # the longest that the table may be behind before it was looked at
    read_back: float  # m, of the command
    astray: float  # m, of the table
    rough: float  # m, of both before the sweep
    railed: int = RAILED
    same: int = SAME
    wrong: int = WRONG
    read_gain: float = READ_GAIN
    unseen: float = UNSEEN
    following: float = FOLLOWING
    gross: float = GROSS
    leak: float = 0.1  # lost samples are forgotten so slowly: a loose contact adds up
    quiet_samples: float = 64.0
    # Of the power of the noise at rest: motion adds to it, nothing takes it away. A jump counts as
    # three times the noise, or it would hide the silence behind it.
    quiet: float = 1.0 / 9.0
    loudest: float = 9.0
    rest_enough: float = 100.0  # samples from which the noise at rest is known


class Memory(NamedTuple):
    """What the pass remembers; it changes them in place."""

    per: Float2D  # (row, channel)
    one: Float1D  # (place,)
    told: Int1D  # (code, channel): the sample at which it was last true


def law(profile: Profile, rig: Rig, noise: Mapping[str, tuple[float, int]]) -> Law:
    """The law of a machine and a test; `noise` of a channel: (rms, longest run) at rest."""
    rate, limits, names = profile.acquisition.rate_hz, rig.limits, rig.channels
    known = [noise.get(name, (math.nan, 0)) for name in names]
    rms, runs = np.array([one[0] for one in known]), np.array([float(one[1]) for one in known])
    sigma = np.where(np.isnan(rms), 0.0, rms)
    full = np.array([sensor.range_si for sensor in rig.sensors])
    lsb = np.array([_lsb(sensor) for sensor in rig.sensors])
    tells = (rms > 0) & (runs < TELLING_S * rate)
    needed = ("drive_disp_m", "table_disp_m", "table_acc_m_s2")
    drive, table, acc = (names.index(name) for name in needed)
    spike = np.maximum(SPIKE_SIGMA * sigma, SPIKE_RANGE * full)
    spike[acc] += rig.output.lsb_m / JERK_S**2
    steps = lsb.copy()
    steps[[drive, table]] = np.maximum(lsb[[drive, table]], rig.output.lsb_m)
    return Law(
        rate,
        math.ceil(PAST_S * rate),
        EPISODE_S * rate,
        drive,
        table,
        acc,
        names.index("mass_acc_m_s2") if "mass_acc_m_s2" in names else -1,
        limits.stroke_mm * 1e-3,
        limits.velocity_mm_s * 1e-3,
        limits.acceleration_g * GRAVITY_M_S2,
        limits.force_kn * 1e3,
        rig.moving_mass_kg,
        profile.specimen.mass_kg,
        math.ceil(VELOCITY_S * rate),
        full,
        spike,
        np.where(tells, np.maximum(STUCK_S * rate, STUCK_RUNS * runs), math.inf),
        np.where(np.isin(names, needed), MOVED_LSB * steps, math.inf),
        STUCK_S * rate,
        tells & (runs <= SAME),
        BLIND_S * rate,
        math.ceil(LAG_S * rate),
        READ_RANGE * full[drive] + 3 * (lsb[drive] + rig.output.lsb_m) + 10 * sigma[drive],
        FOLLOWING_STROKE * limits.stroke_mm * 1e-3 + 10 * sigma[table],
        GROSS_STROKE * limits.stroke_mm * 1e-3,
    )


def _lsb(sensor: Sensor) -> float:
    return 2 * sensor.range_si / 2**sensor.bits


def nothing(channels: int) -> Memory:
    """The memory before the first sample."""
    one = np.zeros(ONCE)
    one[LAG], one[MARKED] = UNKNOWN, -1.0
    told = np.full((CODES, channels), -(2**62), dtype=np.int64)
    return Memory(np.zeros((PER, channels)), one, told)
