"""Sample checks: limits, broken sensors, and tracking errors of command and table, every sample.

One compiled kernel moves from sample to sample, so results do not depend on the division into
blocks. Limits apply to the median of the three newest samples: it rejects electrical spikes of one
sample and delays the detection of a real excess by one sample.
"""

import math

from table_io.compilation import jit_untyped_kernel

# Codes of findings.
STROKE, VELOCITY, ACCELERATION, FORCE, RAIL, LOST, BLIND = range(7)
STUCK, SILENT, SPIKE, REPEATED, COMMAND, FOLLOWING, DROPPED = range(7, 14)
CODE_COUNT = 14
# Rows of the state per channel, then indices of the scalar state.
(
    RUN_LENGTH,
    RUN_ORIGIN,
    EXPECTED_MOTION,
    NOISE_POWER,
    REST_POWER,
    REST_COUNT,
    LOST_COUNT,
    RAIL_COUNT,
) = range(8)
(
    COMMAND_PEAK,
    CYCLE_FRACTION,
    MOTION_KEY,
    RUN_STAGE,
    TABLE_GAIN,
    TABLE_LAG,
    REPEAT_DISTANCE,
    REPEAT_COUNT,
    COMMAND_ERROR_COUNT,
    FOLLOWING_ERROR_COUNT,
    LAST_MARK,
    PAYLOAD_PEAK,
) = range(12)
CHANNEL_ROWS, SCALAR_COUNT = 8, 12
UNKNOWN_LAG = -1.0  # lag of the table before its response is known
LOOP_CHECK_KEY = -1.0  # motion key of the loop check
SWEEP_STAGE = 1.0  # RUN_STAGE from the first step on; before it only gross deviations stop
HALF_CYCLE, NEW_MOTION = 1, 2  # marks: half a cycle is complete, another motion begins


@jit_untyped_kernel
def _median(row, i):  # type: ignore[no-untyped-def]
    """Return the median of the samples i - 2 .. i; NaN if one of them is NaN."""
    a, b, c = row[i - 2], row[i - 1], row[i]
    if math.isnan(a) or math.isnan(b) or math.isnan(c):
        return math.nan
    return max(min(a, b), min(max(a, b), c))


@jit_untyped_kernel
def _report(state, findings, count, index, code, channel, value, limit, limits):  # type: ignore[no-untyped-def]
    """Add a finding, once per episode; return the number of findings."""
    last_index = state.last_true[code, channel]
    state.last_true[code, channel] = index
    if index - last_index <= limits.episode_samples or count == findings.shape[0]:
        return count
    findings[count, 0], findings[count, 1], findings[count, 2] = index, code, channel
    findings[count, 3], findings[count, 4] = value, limit
    return count + 1


@jit_untyped_kernel
def _check_delivery(values, clipped, i, index, repeated, limits, state, findings, count):  # type: ignore[no-untyped-def]
    """Detect samples at the sensor's range and lost samples; count repeated ones as lost."""
    channels, dropped = state.channels, True
    for c in range(values.shape[0]):
        dropped = dropped and math.isnan(values[c, i])
    if dropped:
        count = _report(
            state, findings, count, index, DROPPED, limits.drive_row, math.nan, 0.0, limits
        )
    for c in range(values.shape[0]):
        x = values[c, i]
        channels[RAIL_COUNT, c] = channels[RAIL_COUNT, c] + 1.0 if clipped[c] else 0.0
        if channels[RAIL_COUNT, c] >= limits.rail_run:
            count = _report(state, findings, count, index, RAIL, c, x, limits.full_scale[c], limits)
        lost = math.isnan(x)
        if lost and not dropped:
            count = _report(state, findings, count, index, LOST, c, x, 0.0, limits)
        channels[LOST_COUNT, c] = max(
            channels[LOST_COUNT, c] + (1.0 if lost or repeated else -limits.loss_decay), 0.0
        )
        if channels[LOST_COUNT, c] > limits.max_lost:
            lost_s, max_lost_s = (
                channels[LOST_COUNT, c] / limits.rate_hz,
                limits.max_lost / limits.rate_hz,
            )
            count = _report(state, findings, count, index, BLIND, c, lost_s, max_lost_s, limits)
    return count


@jit_untyped_kernel
def _check_stuck(values, i, index, command, demanded, limits, state, findings, count):  # type: ignore[no-untyped-def]
    """Detect stuck channels: runs of equal samples."""
    channels = state.channels
    for c in range(values.shape[0]):
        expected = demanded if c == limits.acceleration_row else command
        if values[c, i] != values[c, i - 1]:
            channels[RUN_LENGTH, c], channels[RUN_ORIGIN, c], channels[EXPECTED_MOTION, c] = (
                1.0,
                expected,
                0.0,
            )
            continue
        channels[RUN_LENGTH, c] += 1.0
        channels[EXPECTED_MOTION, c] = max(
            channels[EXPECTED_MOTION, c], abs(expected - channels[RUN_ORIGIN, c])
        )
        must_change = (
            channels[EXPECTED_MOTION, c] >= limits.visible_motion[c]
            and channels[RUN_LENGTH, c] >= limits.visible_run
        )
        if must_change or channels[RUN_LENGTH, c] >= limits.stuck_run[c]:
            run, limit = (
                channels[RUN_LENGTH, c],
                min(limits.stuck_run[c], channels[RUN_LENGTH, c]),
            )
            count = _report(state, findings, count, index, STUCK, c, run, limit, limits)
    return count


@jit_untyped_kernel
def _check_silence(values, i, index, limits, state, findings, count):  # type: ignore[no-untyped-def]
    """Detect channels whose noise, from second differences, fell below that at rest."""
    channels = state.channels
    for c in range(values.shape[0]):
        power = (values[c, i] - 2.0 * values[c, i - 1] + values[c, i - 2]) ** 2
        if math.isnan(power):
            continue
        if state.scalars[RUN_STAGE] == 0.0:
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
        if channels[NOISE_POWER, c] < limits.silence_ratio * rest_power:
            # The second difference of white noise has six times the power of the noise.
            value, limit = (
                math.sqrt(channels[NOISE_POWER, c] / 6.0),
                math.sqrt(limits.silence_ratio * rest_power / 6.0),
            )
            count = _report(state, findings, count, index, SILENT, c, value, limit, limits)
    return count


@jit_untyped_kernel
def _check_spikes(values, i, index, limits, state, findings, count):  # type: ignore[no-untyped-def]
    """Detect a spike at sample i - 1 in exactly one channel; real motion shows in others too."""
    row, deviation, spike_count = -1, 0.0, 0
    for c in range(values.shape[0]):
        distance = abs(values[c, i - 1] - _median(values[c], i))
        if distance > limits.spike_limit[c]:
            row, deviation, spike_count = c, distance, spike_count + 1
    if spike_count == 1:
        limit = limits.spike_limit[row]
        return _report(state, findings, count, index - 1, SPIKE, row, deviation, limit, limits)
    return count


@jit_untyped_kernel
def _check_limits(values, i, index, limits, state, findings, count):  # type: ignore[no-untyped-def]
    """Check stroke, velocity, acceleration and force of the table."""
    displacement = _median(values[limits.table_row], i)
    if abs(displacement) > limits.stroke_m:
        count = _report(
            state,
            findings,
            count,
            index,
            STROKE,
            limits.table_row,
            displacement,
            limits.stroke_m,
            limits,
        )
    velocity = (
        (displacement - _median(values[limits.table_row], i - limits.velocity_span))
        * limits.rate_hz
        / limits.velocity_span
    )
    if abs(velocity) > limits.velocity_m_s:
        count = _report(
            state,
            findings,
            count,
            index,
            VELOCITY,
            limits.table_row,
            velocity,
            limits.velocity_m_s,
            limits,
        )
    acceleration = _median(values[limits.acceleration_row], i)
    if abs(acceleration) > limits.acceleration_m_s2:
        count = _report(
            state,
            findings,
            count,
            index,
            ACCELERATION,
            limits.acceleration_row,
            acceleration,
            limits.acceleration_m_s2,
            limits,
        )
    force = limits.table_kg * acceleration
    if limits.mass_row >= 0:
        mass_acceleration = _median(values[limits.mass_row], i)
        force += 0.0 if math.isnan(mass_acceleration) else limits.mass_kg * mass_acceleration
    if abs(force) > limits.force_n:
        count = _report(
            state,
            findings,
            count,
            index,
            FORCE,
            limits.acceleration_row,
            force,
            limits.force_n,
            limits,
        )
    return count


@jit_untyped_kernel
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


@jit_untyped_kernel
def _check_following(values, command, i, index, limits, state, findings, count):  # type: ignore[no-untyped-def]
    """Compare the command read back and the position of the table with the queued command."""
    scalars, last_command, in_loop_check = (
        state.scalars,
        command[i - 1],
        state.scalars[RUN_STAGE] < SWEEP_STAGE,
    )
    error = _median(values[limits.drive_row], i) - last_command
    ratio = limits.loop_check_ratio if in_loop_check else limits.command_ratio
    limit = (
        limits.command_tolerance_m
        + ratio * scalars[COMMAND_PEAK]
        + 2.0 * abs(last_command - command[i - 2])
    )
    limit += limits.loop_check_tolerance_m if in_loop_check else 0.0
    scalars[COMMAND_ERROR_COUNT] = scalars[COMMAND_ERROR_COUNT] + 1.0 if abs(error) > limit else 0.0
    if scalars[COMMAND_ERROR_COUNT] >= limits.error_run:
        count = _report(
            state, findings, count, index, COMMAND, limits.drive_row, error, limit, limits
        )
    following_error = _following_error(
        _median(values[limits.table_row], i), command, i, limits, scalars
    )
    ratio = (
        limits.initial_following_ratio
        if scalars[TABLE_LAG] == UNKNOWN_LAG
        else limits.following_ratio
    )
    limit = (
        limits.following_tolerance_m
        + (limits.loop_check_ratio if in_loop_check else ratio) * scalars[COMMAND_PEAK]
    )
    limit += (
        limits.loop_check_tolerance_m
        if in_loop_check
        else _payload_deflection(values, i, limits, scalars)
    )
    scalars[FOLLOWING_ERROR_COUNT] = (
        scalars[FOLLOWING_ERROR_COUNT] + 1.0 if following_error > limit else 0.0
    )
    if scalars[FOLLOWING_ERROR_COUNT] >= limits.error_run:
        count = _report(
            state,
            findings,
            count,
            index,
            FOLLOWING,
            limits.table_row,
            following_error,
            limit,
            limits,
        )
    return count


@jit_untyped_kernel
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
    return abs(
        displacement
        - scalars[TABLE_GAIN]
        * (
            (1.0 - fraction) * command[i - whole_samples]
            + fraction * command[i - whole_samples - 1]
        )
    )


@jit_untyped_kernel
def _payload_deflection(values, i, limits, scalars):  # type: ignore[no-untyped-def]
    """Return the possible table displacement caused by the specimen, m.

    M / m a / p^2 with p = 2 / lag of a servo with a double pole p, and a the peak acceleration of
    the mass over the last EPISODE_S or so.
    """
    if limits.mass_row < 0 or scalars[TABLE_LAG] == UNKNOWN_LAG:
        return 0.0
    a = _median(values[limits.mass_row], i)
    if not math.isnan(a):
        scalars[PAYLOAD_PEAK] = max(
            abs(a), scalars[PAYLOAD_PEAK] * (1.0 - 1.0 / limits.episode_samples)
        )
    return (
        limits.mass_kg / limits.table_kg * scalars[PAYLOAD_PEAK] * (0.5 * scalars[TABLE_LAG]) ** 2
    )


@jit_untyped_kernel
def _find_mark(command, phase, i, key, scalars, limits):  # type: ignore[no-untyped-def]
    """Return HALF_CYCLE if half a cycle is complete, NEW_MOTION if a motion begins, else 0.

    Also tracks the peak command of about the last cycle.
    """
    phase_step = phase[i] - phase[i - 1]
    phase_step -= math.floor(phase_step + 0.5)
    scalars[COMMAND_PEAK] = max(
        abs(command[i]),
        scalars[COMMAND_PEAK] * math.exp(-max(abs(phase_step), 1.0 / limits.rate_hz)),
    )
    if key != scalars[MOTION_KEY]:
        scalars[MOTION_KEY], scalars[CYCLE_FRACTION] = key, 0.0
        scalars[RUN_STAGE] = max(
            scalars[RUN_STAGE], SWEEP_STAGE if key > 0.0 else 0.5 if key < 0.0 else 0.0
        )
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
    count, scalars = 0, state.scalars
    for k in range(start, keys.size):
        i, sample = limits.history + k, index + k
        if sample != scalars[LAST_MARK]:
            mark = _find_mark(command, phase, i, keys[k], scalars, limits)
            if mark:
                scalars[LAST_MARK] = sample
                return k, mark, count
        repeated = _is_repeated(values, i, limits, scalars)
        count = _check_delivery(
            values, clipped[:, k], i, sample, repeated, limits, state, findings, count
        )
        count = _check_stuck(
            values, i, sample, command[i], demanded[k], limits, state, findings, count
        )
        count = _check_silence(values, i, sample, limits, state, findings, count)
        if repeated:
            repeat_s = scalars[REPEAT_DISTANCE] / limits.rate_hz
            count = _report(
                state, findings, count, sample, REPEATED, limits.drive_row, repeat_s, 0.0, limits
            )
            scalars[COMMAND_ERROR_COUNT] = scalars[FOLLOWING_ERROR_COUNT] = 0.0
            continue
        count = _check_spikes(values, i, sample, limits, state, findings, count)
        count = _check_limits(values, i, sample, limits, state, findings, count)
        count = _check_following(values, command, i, sample, limits, state, findings, count)
    return keys.size, 0, count
