"""Sample checks: limits, broken sensors, and tracking errors of command and table, every sample.

One compiled kernel moves from sample to sample, so results do not depend on the division into
blocks. Limits apply to the median of the three newest samples: it rejects electrical spikes of one
sample and delays the detection of a real excess by one sample. Thresholds derive from the rig, the
noise of each sensor at rest and the constants below.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from table_io.block import Float1D, Float2D, Int1D
from table_io.channels import CONTROL_CHANNELS
from table_io.compilation import jit_untyped_helper, jit_untyped_kernel
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
# Of the amplitude: includes a gain of +-20 %, which the loop check allows where no lag is stated.
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
    rms = np.array([channel_noise[0] for channel_noise in rest_noise])
    runs = np.array([float(channel_noise[1]) for channel_noise in rest_noise])
    sigma = np.where(np.isnan(rms), 0.0, rms)
    full_scale = np.array([sensor.range_si for sensor in rig.sensors])
    lsb = np.array([sensor.lsb_si for sensor in rig.sensors])
    informative = (rms > 0) & (runs < MAX_REST_RUN_S * rate_hz)
    drive, table, acceleration = (names.index(name) for name in CONTROL_CHANNELS)
    spike_limit = np.maximum(MIN_SPIKE_SIGMA * sigma, MIN_SPIKE_RANGE * full_scale)
    measured = [rig.channel_by_name[name] for name in names]
    on_table = [(channel.quantity, channel.body) == TABLE_ACCELERATION for channel in measured]
    spike_limit[on_table] += rig.output.lsb_m / HALF_MIN_LAG_S**2
    # A converter resolves less than its bits where a reading at rest alternates between few values.
    steps = np.maximum(lsb, math.sqrt(12.0) * sigma)
    steps[[drive, table]] = np.maximum(steps[[drive, table]], rig.output.lsb_m)
    # Where noise proves a sensor alive, slow motion may show as many equal samples as rest.
    following_ratio = rig.table_response.following_ratio
    must_move = np.isin(names, CONTROL_CHANNELS) & ~informative
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


# Codes of findings.
STROKE, VELOCITY, ACCELERATION, FORCE, RAIL, LOST, BLIND = range(7)
STUCK, SILENT, SPIKE, REPEATED, COMMAND, FOLLOWING, DROPPED = range(7, 14)
CODE_COUNT = 14
UNKNOWN_LAG = -1.0  # lag of the table before its response is known
LOOP_CHECK_KEY = -1.0  # motion key of the loop check
SWEEP_STAGE = 1.0  # RUN_STAGE from the first step on; before it only gross deviations stop
HALF_CYCLE, NEW_MOTION = 1, 2  # marks: half a cycle is complete, another motion begins
# Rows of the state per channel.
RUN_LENGTH, RUN_ORIGIN, EXPECTED_MOTION, NOISE_POWER = range(4)
REST_POWER, REST_COUNT, LOST_COUNT, RAIL_COUNT = range(4, 8)
CHANNEL_ROWS = 8
# Indices of the scalar state.
COMMAND_PEAK, CYCLE_FRACTION, MOTION_KEY, RUN_STAGE, TABLE_GAIN, TABLE_LAG = range(6)
REPEAT_DISTANCE, REPEAT_COUNT, COMMAND_ERROR_COUNT, FOLLOWING_ERROR_COUNT = range(6, 10)
LAST_MARK, PAYLOAD_PEAK = 10, 11
SCALAR_COUNT = 12


class SampleCheckState(NamedTuple):
    """State of the sample checks, updated in place by the kernel."""

    channels: Float2D  # (row, channel)
    scalars: Float1D  # (index,)
    last_true: Int1D  # (code, channel): the last sample at which the code applied

    def copy(self) -> "SampleCheckState":
        return SampleCheckState(self.channels.copy(), self.scalars.copy(), self.last_true.copy())


def make_sample_state(channels: int) -> SampleCheckState:
    """Return the state before the first sample."""
    scalars = np.zeros(SCALAR_COUNT)
    scalars[TABLE_LAG], scalars[LAST_MARK] = UNKNOWN_LAG, -1.0
    last_true = np.full((CODE_COUNT, channels), -(2**62), dtype=np.int64)
    return SampleCheckState(np.zeros((CHANNEL_ROWS, channels)), scalars, last_true)


class CheckRun(NamedTuple):
    """What all checks of a call share; `finding_count[0]` is their number."""

    limits: Thresholds
    state: SampleCheckState
    findings: Float2D  # rows of sample, code, channel, value, limit
    finding_count: Int1D


@jit_untyped_helper
def _median(row, i):  # type: ignore[no-untyped-def]
    """Return the median of the samples i - 2 .. i; NaN if one of them is NaN."""
    a, b, c = row[i - 2], row[i - 1], row[i]
    if math.isnan(a) or math.isnan(b) or math.isnan(c):
        return math.nan
    return max(min(a, b), min(max(a, b), c))


@jit_untyped_helper
def _report(run, index, code, channel, value, limit):  # type: ignore[no-untyped-def]
    """Add a finding, once per episode."""
    last_index, count = run.state.last_true[code, channel], run.finding_count[0]
    run.state.last_true[code, channel] = index
    if index - last_index <= run.limits.episode_samples or count == run.findings.shape[0]:
        return
    finding = run.findings[count]
    finding[0], finding[1], finding[2] = index, code, channel
    finding[3], finding[4] = value, limit
    run.finding_count[0] = count + 1


@jit_untyped_helper
def _report_beyond(run, index, code, channel, value, limit):  # type: ignore[no-untyped-def]
    """Add a finding if a value exceeds its limit on either side."""
    if abs(value) > limit:
        _report(run, index, code, channel, value, limit)


@jit_untyped_helper
def _check_delivery(values, clipped, i, index, repeated, run):  # type: ignore[no-untyped-def]
    """Detect samples at the sensor's range and lost samples; count repeated ones as lost."""
    limits, channels, dropped = run.limits, run.state.channels, True
    for c in range(values.shape[0]):
        dropped = dropped and math.isnan(values[c, i])
    if dropped:
        _report(run, index, DROPPED, limits.drive_row, math.nan, 0.0)
    for c in range(values.shape[0]):
        x = values[c, i]
        channels[RAIL_COUNT, c] = channels[RAIL_COUNT, c] + 1.0 if clipped[c] else 0.0
        if channels[RAIL_COUNT, c] >= limits.rail_run:
            _report(run, index, RAIL, c, x, limits.full_scale[c])
        lost = math.isnan(x)
        if lost and not dropped:
            _report(run, index, LOST, c, x, 0.0)
        change = 1.0 if lost or repeated else -limits.loss_decay
        channels[LOST_COUNT, c] = max(channels[LOST_COUNT, c] + change, 0.0)
        if channels[LOST_COUNT, c] > limits.max_lost:
            lost_s = channels[LOST_COUNT, c] / limits.rate_hz
            _report(run, index, BLIND, c, lost_s, limits.max_lost / limits.rate_hz)


@jit_untyped_helper
def _check_stuck(values, i, index, command, demanded, run):  # type: ignore[no-untyped-def]
    """Detect stuck channels: runs of equal samples."""
    limits, channels = run.limits, run.state.channels
    for c in range(values.shape[0]):
        expected = demanded if c == limits.acceleration_row else command
        if values[c, i] != values[c, i - 1]:
            channels[RUN_LENGTH, c] = 1.0
            channels[RUN_ORIGIN, c] = expected
            channels[EXPECTED_MOTION, c] = 0.0
            continue
        channels[RUN_LENGTH, c] += 1.0
        length = channels[RUN_LENGTH, c]
        motion = max(channels[EXPECTED_MOTION, c], abs(expected - channels[RUN_ORIGIN, c]))
        channels[EXPECTED_MOTION, c] = motion
        must_change = motion >= limits.visible_motion[c] and length >= limits.visible_run
        if must_change or length >= limits.stuck_run[c]:
            _report(run, index, STUCK, c, length, min(limits.stuck_run[c], length))


@jit_untyped_helper
def _check_silence(values, i, index, run):  # type: ignore[no-untyped-def]
    """Detect channels whose noise, from second differences, fell below that at rest."""
    limits, channels = run.limits, run.state.channels
    for c in range(values.shape[0]):
        power = (values[c, i] - 2.0 * values[c, i - 1] + values[c, i - 2]) ** 2
        if math.isnan(power):
            continue
        if run.state.scalars[RUN_STAGE] == 0.0:
            channels[REST_POWER, c] += power
            channels[REST_COUNT, c] += 1.0
        if not limits.has_noise[c] or channels[REST_COUNT, c] < limits.min_rest_samples:
            continue
        rest_power = channels[REST_POWER, c] / channels[REST_COUNT, c]
        if channels[NOISE_POWER, c] == 0.0:
            channels[NOISE_POWER, c] = rest_power
        channels[NOISE_POWER, c] += (
            min(power, limits.max_power_ratio * rest_power) - channels[NOISE_POWER, c]
        ) / limits.noise_window
        least_power = limits.silence_ratio * rest_power
        if channels[NOISE_POWER, c] < least_power:
            # The second difference of white noise has six times the power of the noise.
            rms = math.sqrt(channels[NOISE_POWER, c] / 6.0)
            _report(run, index, SILENT, c, rms, math.sqrt(least_power / 6.0))


@jit_untyped_helper
def _check_spikes(values, i, index, run):  # type: ignore[no-untyped-def]
    """Detect a spike at sample i - 1 in exactly one channel; real motion shows in others too."""
    row, deviation, spike_count = -1, 0.0, 0
    for c in range(values.shape[0]):
        distance = abs(values[c, i - 1] - _median(values[c], i))
        if distance > run.limits.spike_limit[c]:
            row, deviation, spike_count = c, distance, spike_count + 1
    if spike_count == 1:
        _report(run, index - 1, SPIKE, row, deviation, run.limits.spike_limit[row])


@jit_untyped_helper
def _check_limits(values, i, index, run):  # type: ignore[no-untyped-def]
    """Check stroke, velocity, acceleration and force of the table."""
    limits = run.limits
    table, acceleration_row = limits.table_row, limits.acceleration_row
    displacement = _median(values[table], i)
    earlier = _median(values[table], i - limits.velocity_span)
    velocity = (displacement - earlier) * limits.rate_hz / limits.velocity_span
    acceleration = _median(values[acceleration_row], i)
    force = limits.table_kg * acceleration
    if limits.mass_row >= 0:
        mass_acceleration = _median(values[limits.mass_row], i)
        force += 0.0 if math.isnan(mass_acceleration) else limits.mass_kg * mass_acceleration
    _report_beyond(run, index, STROKE, table, displacement, limits.stroke_m)
    _report_beyond(run, index, VELOCITY, table, velocity, limits.velocity_m_s)
    max_acceleration = limits.acceleration_m_s2
    _report_beyond(run, index, ACCELERATION, acceleration_row, acceleration, max_acceleration)
    _report_beyond(run, index, FORCE, acceleration_row, force, limits.force_n)


@jit_untyped_helper
def _is_repeated(values, i, limits, scalars):  # type: ignore[no-untyped-def]
    """Return True if the last samples repeat earlier ones in every noisy channel."""
    for distance in range(max(int(scalars[REPEAT_DISTANCE]), 1), limits.history):
        noisy_count, is_same = 0, True
        for c in range(values.shape[0]):
            if limits.has_noise[c]:
                noisy_count += 1
                if values[c, i] != values[c, i - distance]:
                    is_same = False
                    break
        if is_same and noisy_count >= 2:
            scalars[REPEAT_COUNT] = (
                scalars[REPEAT_COUNT] + 1.0 if distance == scalars[REPEAT_DISTANCE] else 1.0
            )
            scalars[REPEAT_DISTANCE] = distance
            return scalars[REPEAT_COUNT] >= limits.repeat_run
    scalars[REPEAT_DISTANCE], scalars[REPEAT_COUNT] = 0.0, 0.0
    return False


@jit_untyped_helper
def _check_following(values, command, i, index, run):  # type: ignore[no-untyped-def]
    """Compare the command read back and the position of the table with the queued command."""
    limits, scalars, last_command = run.limits, run.state.scalars, command[i - 1]
    in_loop_check = scalars[RUN_STAGE] < SWEEP_STAGE
    error = _median(values[limits.drive_row], i) - last_command
    ratio = limits.loop_check_ratio if in_loop_check else limits.command_ratio
    limit = limits.command_tolerance_m + ratio * scalars[COMMAND_PEAK]
    limit += 2.0 * abs(last_command - command[i - 2])
    limit += limits.loop_check_tolerance_m if in_loop_check else 0.0
    scalars[COMMAND_ERROR_COUNT] = scalars[COMMAND_ERROR_COUNT] + 1.0 if abs(error) > limit else 0.0
    if scalars[COMMAND_ERROR_COUNT] >= limits.error_run:
        _report(run, index, COMMAND, limits.drive_row, error, limit)
    displacement = _median(values[limits.table_row], i)
    error = _following_error(displacement, command, i, limits, scalars)
    ratio = limits.following_ratio
    if scalars[TABLE_LAG] == UNKNOWN_LAG:
        ratio = limits.initial_following_ratio
    if in_loop_check:
        ratio = limits.loop_check_ratio
    limit = limits.following_tolerance_m + ratio * scalars[COMMAND_PEAK]
    if in_loop_check:
        limit += limits.loop_check_tolerance_m
    else:
        limit += _payload_deflection(values, i, limits, scalars)
    scalars[FOLLOWING_ERROR_COUNT] = scalars[FOLLOWING_ERROR_COUNT] + 1.0 if error > limit else 0.0
    if scalars[FOLLOWING_ERROR_COUNT] >= limits.error_run:
        _report(run, index, FOLLOWING, limits.table_row, error, limit)


@jit_untyped_helper
def _following_error(displacement, command, i, limits, scalars):  # type: ignore[no-untyped-def]
    """Return the deviation of the table from the position that its command predicts, m.

    While gain and lag are unknown, every position of the command within `max_lag` is accepted.
    """
    if scalars[TABLE_LAG] == UNKNOWN_LAG:
        low, high = command[i - 1], command[i - 1]
        for back in range(2, limits.max_lag + 1):
            low, high = min(low, command[i - back]), max(high, command[i - back])
        return max(low - displacement, displacement - high, 0.0)
    delay = min(scalars[TABLE_LAG] * limits.rate_hz, limits.max_lag) + 1.0
    whole_samples = int(delay)
    fraction = delay - whole_samples
    newer, older = command[i - whole_samples], command[i - whole_samples - 1]
    return abs(displacement - scalars[TABLE_GAIN] * ((1.0 - fraction) * newer + fraction * older))


@jit_untyped_helper
def _payload_deflection(values, i, limits, scalars):  # type: ignore[no-untyped-def]
    """Return the possible table displacement caused by the specimen, m.

    M / m a / p^2 with p = 2 / lag of a servo with a double pole p, and a the peak acceleration of
    the mass over the last EPISODE_S or so.
    """
    if limits.mass_row < 0 or scalars[TABLE_LAG] == UNKNOWN_LAG:
        return 0.0
    a = _median(values[limits.mass_row], i)
    if not math.isnan(a):
        faded = scalars[PAYLOAD_PEAK] * (1.0 - 1.0 / limits.episode_samples)
        scalars[PAYLOAD_PEAK] = max(abs(a), faded)
    ratio = limits.mass_kg / limits.table_kg
    return ratio * scalars[PAYLOAD_PEAK] * (0.5 * scalars[TABLE_LAG]) ** 2


@jit_untyped_helper
def _find_mark(command, phase, i, key, scalars, limits):  # type: ignore[no-untyped-def]
    """Return HALF_CYCLE if half a cycle is complete, NEW_MOTION if a motion begins, else 0.

    Also tracks the peak command of about the last cycle.
    """
    phase_step = phase[i] - phase[i - 1]
    phase_step -= math.floor(phase_step + 0.5)
    fading = math.exp(-max(abs(phase_step), 1.0 / limits.rate_hz))
    scalars[COMMAND_PEAK] = max(abs(command[i]), scalars[COMMAND_PEAK] * fading)
    if key != scalars[MOTION_KEY]:
        scalars[MOTION_KEY], scalars[CYCLE_FRACTION] = key, 0.0
        stage = SWEEP_STAGE if key > 0.0 else 0.5 if key < 0.0 else 0.0
        scalars[RUN_STAGE] = max(scalars[RUN_STAGE], stage)
        return NEW_MOTION
    scalars[CYCLE_FRACTION] += phase_step
    if scalars[CYCLE_FRACTION] >= 0.5:
        scalars[CYCLE_FRACTION] -= 0.5
        return HALF_CYCLE
    return 0


@jit_untyped_kernel
def check_samples(  # type: ignore[no-untyped-def]
    values, clipped, command, phase, demanded, keys, index, start, limits, state, findings
):
    """Check samples from `start` to the end or the next mark: return (sample, mark, finding count).

    If the mark is not 0, the returned sample is not checked yet; the next call starts there.
    values (channel, history + sample), command and phase (history + sample,), clipped (channel,
    sample), demanded acceleration and keys (sample,); `index` is that of the first sample after the
    history. Rows of `findings`: sample, code, channel, value, limit.
    """
    run, scalars = CheckRun(limits, state, findings, np.zeros(1, np.int64)), state.scalars
    for k in range(start, keys.size):
        i, sample = limits.history + k, index + k
        if sample != scalars[LAST_MARK]:
            mark = _find_mark(command, phase, i, keys[k], scalars, limits)
            if mark:
                scalars[LAST_MARK] = sample
                return k, mark, run.finding_count[0]
        repeated = _is_repeated(values, i, limits, scalars)
        _check_delivery(values, clipped[:, k], i, sample, repeated, run)
        _check_stuck(values, i, sample, command[i], demanded[k], run)
        _check_silence(values, i, sample, run)
        if repeated:
            repeat_s = scalars[REPEAT_DISTANCE] / limits.rate_hz
            _report(run, sample, REPEATED, limits.drive_row, repeat_s, 0.0)
            scalars[COMMAND_ERROR_COUNT] = scalars[FOLLOWING_ERROR_COUNT] = 0.0
            continue
        _check_spikes(values, i, sample, run)
        _check_limits(values, i, sample, run)
        _check_following(values, command, i, sample, run)
    return keys.size, 0, run.finding_count[0]
