"""Thresholds of the sample checks (`sample_checks.py`).

Thresholds derive from the rig, the noise of each sensor at rest and the constants below.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from table_io.block import Float1D
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig, TableResponse
from table_io.units import GRAVITY_M_S2

HISTORY_S = 0.25  # of earlier samples: the longest repetition that is detected
EPISODE_S = 1.0  # a finding is repeated only after it was absent for this long
# More than the lag of any table fit for stepped sine tests; 15 ms at 20 Hz bandwidth.
MAX_TABLE_LAG_S = 0.1
# Span of the difference quotient: noise / 10 ms is below 1 mm/s.
VELOCITY_SPAN_S = 0.01
MIN_RAIL_SAMPLES = 3  # consecutive samples at the range: longer than a spike
MAX_LOST_S = 0.02  # of consecutive lost samples: the table moves 10 mm at the velocity limit
MIN_STUCK_S = 0.01
STUCK_RUN_FACTOR = 10  # times the longest run of equal samples at rest
MAX_REST_RUN_S = 0.1  # longest run at rest for which noise can prove a sensor alive
MIN_MOTION_LSB = 20.0  # expected motion within which a sensor without noise must change
MIN_SPIKE_SIGMA = 10.0  # white noise: once in 1e14 samples
MIN_SPIKE_RANGE = 1e-3
HALF_MIN_LAG_S = 1e-3  # half the shortest lag: such a stiff table follows every step of its output
TABLE_ACCELERATION = ("acceleration", "table")  # quantity and body
# Consecutive samples equal to earlier ones: noise never repeats itself.
MIN_REPEAT_SAMPLES = 5
# Consecutive samples with an error of the command: more than MIN_REPEAT_SAMPLES, so that a
# repetition is reported as such.
MIN_ERROR_SAMPLES = 8
MAX_READ_BACK_RATIO = 0.01  # of the command
MAX_READ_BACK_RANGE = 5e-4
# Of the amplitude: includes the gain of +-20 % that the loop check allows.
MAX_INITIAL_FOLLOWING_RATIO = 0.25
# Before the sweep: more than a sensor of wrong sign or offset shows, which the loop check reports.
MAX_CHECK_ERROR_RATIO, MAX_CHECK_ERROR_STROKE = 2.5, 0.02
MAX_FOLLOWING_STROKE = 1e-3


class Thresholds(NamedTuple):
    """Thresholds of the sample checks in SI, times in samples; arrays are (channel,).

    `mass_row` is -1 without accelerometer on the mass.
    """

    rate_hz: float
    history: int  # earlier samples that the kernel needs
    episode_samples: float
    drive_row: int  # rows of the channels that the controller needs
    table_row: int
    acceleration_row: int
    mass_row: int
    stroke_m: float
    velocity_m_s: float
    acceleration_m_s2: float
    force_n: float
    table_kg: float
    mass_kg: float
    velocity_span: int  # of the difference quotient of the displacement
    full_scale: Float1D  # range of the sensors
    spike_limit: Float1D
    stuck_run: Float1D  # inf where noise is too small
    visible_motion: Float1D  # expected motion that must change the reading; inf: not checked
    visible_run: float  # shortest run of equal samples despite that motion
    has_noise: npt.NDArray[np.bool_]
    max_lost: float
    max_lag: int  # longest lag of the table while its response is unknown
    command_tolerance_m: float  # m, of the command
    following_tolerance_m: float  # m, of the table
    loop_check_tolerance_m: float  # m, of both before the sweep
    rail_run: int = MIN_RAIL_SAMPLES
    repeat_run: int = MIN_REPEAT_SAMPLES
    error_run: int = MIN_ERROR_SAMPLES
    command_ratio: float = MAX_READ_BACK_RATIO
    initial_following_ratio: float = MAX_INITIAL_FOLLOWING_RATIO
    following_ratio: float = TableResponse().following_ratio
    loop_check_ratio: float = MAX_CHECK_ERROR_RATIO
    loss_decay: float = 0.1  # per valid sample: slow, so that losses of a loose contact add up
    noise_window: float = 64.0
    # Ratios to the noise power at rest, which motion can only increase. A jump is limited to three
    # times the rms noise, so that it does not mask a following loss of noise.
    silence_ratio: float = 1.0 / 9.0
    max_power_ratio: float = 9.0
    min_rest_samples: float = 100.0  # needed to estimate the noise at rest


def compute_thresholds(
    profile: Profile, rig: RigConfig, noise: Mapping[str, tuple[float, int]]
) -> Thresholds:
    """Compute the thresholds for a rig and a test; `noise`: (rms, longest run) at rest."""
    rate_hz, limits, names = profile.acquisition.rate_hz, rig.limits, rig.channels
    rest_noise = [noise.get(name, (math.nan, 0)) for name in names]
    rms, runs = (
        np.array([channel_noise[0] for channel_noise in rest_noise]),
        np.array([float(channel_noise[1]) for channel_noise in rest_noise]),
    )
    sigma = np.where(np.isnan(rms), 0.0, rms)
    full_scale = np.array([sensor.range_si for sensor in rig.sensors])
    lsb = np.array([sensor.lsb_si for sensor in rig.sensors])
    informative = (rms > 0) & (runs < MAX_REST_RUN_S * rate_hz)
    needed = ("drive_disp_m", "table_disp_m", "table_acc_m_s2")
    drive, table, acceleration = (names.index(name) for name in needed)
    spike_limit = np.maximum(MIN_SPIKE_SIGMA * sigma, MIN_SPIKE_RANGE * full_scale)
    measured = [rig.channel_by_name[name] for name in names]
    on_table = [(channel.quantity, channel.body) == TABLE_ACCELERATION for channel in measured]
    spike_limit[on_table] += rig.output.lsb_m / HALF_MIN_LAG_S**2
    # A converter resolves less than its bits where a reading at rest alternates between few values.
    steps = np.maximum(lsb, math.sqrt(12.0) * sigma)
    steps[[drive, table]] = np.maximum(steps[[drive, table]], rig.output.lsb_m)
    # Where noise proves a sensor alive, slow motion may show as many equal samples as rest.
    following_ratio = rig.table_response.following_ratio
    must_move = np.isin(names, needed) & ~informative
    return Thresholds(
        rate_hz,
        math.ceil(HISTORY_S * rate_hz),
        EPISODE_S * rate_hz,
        drive,
        table,
        acceleration,
        names.index("mass_acc_m_s2") if "mass_acc_m_s2" in names else -1,
        limits.stroke_mm * 1e-3,
        limits.velocity_mm_s * 1e-3,
        limits.acceleration_g * GRAVITY_M_S2,
        limits.force_kn * 1e3,
        rig.moving_mass_kg,
        profile.specimen.mass_kg,
        math.ceil(VELOCITY_SPAN_S * rate_hz),
        full_scale,
        spike_limit,
        np.where(informative, np.maximum(MIN_STUCK_S * rate_hz, STUCK_RUN_FACTOR * runs), math.inf),
        np.where(must_move, MIN_MOTION_LSB * steps, math.inf),
        MIN_STUCK_S * rate_hz,
        informative & (runs <= MIN_REPEAT_SAMPLES),
        MAX_LOST_S * rate_hz,
        math.ceil(MAX_TABLE_LAG_S * rate_hz),
        MAX_READ_BACK_RANGE * full_scale[drive]
        + 3 * (lsb[drive] + rig.output.lsb_m)
        + 10 * sigma[drive],
        MAX_FOLLOWING_STROKE * limits.stroke_mm * 1e-3 + 10 * sigma[table],
        MAX_CHECK_ERROR_STROKE * limits.stroke_mm * 1e-3,
        initial_following_ratio=max(MAX_INITIAL_FOLLOWING_RATIO, following_ratio),
        following_ratio=following_ratio,
    )
