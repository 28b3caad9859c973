"""Checks of the loop check; each function yields those for which the rig has the channels.

An unknown value (NaN) fails. Values that the motion of the specimen could explain are not checked,
or only reported, without limits.
"""

import math
from collections.abc import Iterator

import numpy as np

from table_io.block import Float1D
from table_io.channels import CHANNEL_BY_NAME, LEFT_CELLS, RIGHT_CELLS
from table_io.records import Check
from table_io.safety.loop_check.data import MAX_MISMATCH_RATIO, Complex1D, LoopCheckData

TABLE_CHANNELS = ("table_disp_m", "table_acc_m_s2")
MASS_CHANNELS = ("mass_disp_m", "mass_acc_m_s2")
MOTION_CHANNELS = (*TABLE_CHANNELS, *MASS_CHANNELS, "rel_disp_m")

MAX_LOST_PERCENT = 1.0  # of the samples
MIN_TONE_SNR = 10.0  # tone over its standard error
DELAY_RANGE_MS = (-2.0, 100.0)
MAX_DELAY_SPREAD_RATIO = 0.5  # of the mean delay, if that is more than the rig's limit
MAX_READ_BACK_LSB, MAX_READ_BACK_RATIO = 4.0, 0.005  # DAC steps, and fraction of the command
MIN_NOISE_MARGIN_DB = 20.0
MAX_OFFSET_RATIO = 0.05  # of the motion of the test, or of the gap
MAX_RESIDUAL_MOTION_RATIO, RESIDUAL_NOISE_FACTOR = (
    0.02,
    2.0,
)  # of the motion of the test, and of the noise
MIN_LAG_SINE, MAX_LEAD_SINE = (
    0.2,
    -0.5,
)  # sines that prove lag or lead; a transient may look like a small lead
MIN_IN_PHASE_TONE, MAX_ANTIPHASE_TONE = (
    0.5,
    0.9,
)  # tone of the mass: at least this in phase with the table, at most this in antiphase


def make_check(
    data: LoopCheckData, name: str, channel: str, value: float, low: float, high: float, unit: str
) -> Check:
    """Make a check that passes if low <= value <= high; NaN fails."""
    value = float(value)
    return Check(data.block.end, name, channel, value, low, high, unit, low <= value <= high)


def check_lost_samples(data: LoopCheckData) -> Iterator[Check]:
    """Check the share of lost samples of each channel."""
    for name, values in zip(data.block.channels, data.block.values, strict=True):
        share = 100.0 * float(np.isnan(values).mean())
        yield make_check(data, "lost samples", name, share, 0.0, MAX_LOST_PERCENT, "%")


def check_alive(data: LoopCheckData) -> Iterator[Check]:
    """Check the signal-to-noise ratio of the fundamental of each motion sensor.

    An isolated mass hardly moves: its sensors need 2 % of the ratio of the table's sensors only.
    """
    for name in filter(data.has, (*TABLE_CHANNELS, *MASS_CHANNELS)):
        table_channel = name.replace("mass", "table")
        low = (
            MIN_TONE_SNR
            if name in TABLE_CHANNELS or not data.has(table_channel)
            else min(MIN_TONE_SNR, 0.02 * data.tone_snr(table_channel))
        )
        yield make_check(
            data, "alive, tone over noise", name, data.tone_snr(name), low, math.inf, ""
        )


def check_read_back(data: LoopCheckData) -> Iterator[Check]:
    """Compare the command read back with the computed one; rms error in DAC steps."""
    command = data.drive.command(data.block.index, len(data.block))
    lsb = data.rig.output.lsb_m
    error = data.block.channel("drive_disp_m") - command
    allowed = MAX_READ_BACK_LSB + MAX_READ_BACK_RATIO * _finite_rms(command) / lsb
    yield make_check(
        data, "command read back", "drive_disp_m", _finite_rms(error) / lsb, 0.0, allowed, "LSB"
    )


def check_table_response(data: LoopCheckData) -> Iterator[Check]:
    """Check polarity, gain and delay of the table's sensors against the command.

    A servo rolls off, so the gain is near 1 at the lowest frequency only; above it the gain must
    follow a smooth curve, within the range that amplitude control can correct. The rig file states
    the ranges.
    """
    allowed = data.rig.table_response
    frequencies_hz = data.frequencies_hz
    for name in TABLE_CHANNELS:
        if not _has_clear_tone(data, name):
            continue
        tones = data.tones(name)
        polarity = float(np.cos(np.angle(tones[0])))
        yield make_check(data, "polarity against the command", name, polarity, 0.0, 1.0, "")
        yield make_check(data, "gain", name, abs(tones[0]), *allowed.gain, "")
        swept = np.flatnonzero(frequencies_hz <= data.profile.plan.high_hz * (1 + 1e-9))
        if swept.size > 1:
            top_gain = abs(tones[swept[-1]])
            yield make_check(
                data, "gain at the highest frequency", name, top_gain, *allowed.top_gain, ""
            )
        if swept.size > 2:
            residual = 100.0 * _max_line_residual(
                frequencies_hz[swept] ** 2, np.log(np.abs(tones[swept]))
            )
            yield make_check(
                data,
                "gain off a smooth curve",
                name,
                residual,
                0.0,
                allowed.gain_residual_percent,
                "%",
            )
        delays = (
            -1e3
            * unwrap_phase(tones * np.sign(polarity), frequencies_hz)
            / (2 * math.pi * frequencies_hz)
        )
        longest = delays[np.argmax(np.abs(delays))]
        yield make_check(data, "delay", name, longest, *DELAY_RANGE_MS, "ms")
        if frequencies_hz.size > 1:
            max_spread = max(
                allowed.delay_spread_ms, MAX_DELAY_SPREAD_RATIO * abs(float(delays.mean()))
            )
            spread = float(np.ptp(delays))
            yield make_check(
                data, "delay over the frequencies", name, spread, 0.0, max_spread, "ms"
            )


def _has_clear_tone(data: LoopCheckData, *names: str) -> bool:
    """Return True if each channel has tones above the noise and lost none of them entirely."""
    return data.has(*names) and all(
        data.tone_snr(name) > MIN_TONE_SNR and bool(np.isfinite(data.tones(name)).all())
        for name in names
    )


def _max_line_residual(z: Float1D, values: Float1D) -> float:
    """Return the largest residual of values from their fitted straight line over z."""
    return float(np.abs(np.polyval(np.polyfit(z, values, 1), z) - values).max())


def unwrap_phase(tones: Complex1D, frequencies_hz: Float1D) -> Float1D:
    """Unwrap the phase in rad, (hold,): each follows the delay of the next lower frequency."""
    phase = np.angle(tones)
    for k in range(1, phase.size):
        expected = phase[k - 1] * frequencies_hz[k] / frequencies_hz[k - 1]
        if math.isfinite(expected - phase[k]):
            phase[k] += 2 * math.pi * round((expected - phase[k]) / (2 * math.pi))
    return phase


def check_mass_polarity(data: LoopCheckData) -> Iterator[Check]:
    """Check the polarity of the sensors of the mass without a model of the specimen."""
    for name in filter(data.has, MASS_CHANNELS):
        sine_of_lag = lag_sine(data, name)
        if sine_of_lag is not None:
            yield make_check(
                data, "polarity, lag behind the table", name, sine_of_lag, 0.0, 1.0, ""
            )


def lag_sine(data: LoopCheckData, name: str) -> float | None:
    """Return the sine of the lag of the mass behind the table at the lowest clear frequency.

    Work flows from the table into a passive specimen, so its acceleration lags that of the table by
    0 to 180 degrees: the sine is positive. Near 0 or 180 degrees the amplitude decides: a mass that
    moves as much as the table must be in phase, one that moves less is isolated and must be in
    antiphase; the result is 1 if so and -1 if not. (Wrong just above the resonance of a specimen
    with a few per cent of damping: use a lower frequency there.) None without a clear tone.
    """
    if not _has_clear_tone(data, "table_acc_m_s2"):
        return None
    tones = data.tones(name)
    clear = np.flatnonzero(np.abs(tones) > MIN_TONE_SNR * data.tone_errors(name))
    if not clear.size:
        return None
    table_tones = data.tones("table_acc_m_s2")
    # The polarity of the table itself is a separate check.
    tone = complex(tones[clear[0]] / table_tones[clear[0]]) * float(np.sign(table_tones[0].real))
    sine, amplitude = -tone.imag / abs(tone), abs(tones[clear[0]])
    if sine > MIN_LAG_SINE or sine < MAX_LEAD_SINE:
        return sine
    consistent = amplitude > MIN_IN_PHASE_TONE if tone.real > 0 else amplitude < MAX_ANTIPHASE_TONE
    return 1.0 if consistent else -1.0


def check_derivative_consistency(data: LoopCheckData) -> Iterator[Check]:
    """Compare the second derivative of each displacement with the acceleration of the same body.

    One number for errors of gain, sign, unit and time: |ratio - 1| of the weak form, the largest
    over all frequencies with low enough noise. It holds for any motion of the specimen. The low cut
    and delay of a sound accelerometer are fitted before.
    """
    pairs = (
        (("table_disp_m",), "table_acc_m_s2"),
        (("mass_disp_m",), "mass_acc_m_s2"),
        (("rel_disp_m", "table_disp_m"), "mass_acc_m_s2"),
    )
    for displacements, acceleration in pairs:
        if not _has_clear_tone(data, *displacements, acceleration):
            continue
        mismatch, _ = data.compare_sensors(displacements, acceleration)
        if not math.isnan(mismatch):
            name, high = f"second derivative against {acceleration}", 100.0 * MAX_MISMATCH_RATIO
            yield make_check(data, name, displacements[0], 100.0 * mismatch, 0.0, high, "%")


def check_noise(data: LoopCheckData) -> Iterator[Check]:
    """Check that the noise at rest is 20 dB below the test level at every frequency of the test.

    Displacements are compared with the smallest amplitude, that at the upper end of its band, load
    cells with a fifth of the contact threshold `comparison.contact_n`.
    """
    test_level = data.test_level
    min_displacement = test_level / (2 * math.pi * data.profile.plan.high_hz) ** 2
    for name in filter(data.has, MOTION_CHANNELS):
        amplitude = min_displacement if CHANNEL_BY_NAME[name].unit == "m" else test_level
        margin_db = 20.0 * math.log10(amplitude / math.sqrt(2.0) / data.noise(name))
        yield make_check(
            data, "noise under the level", name, margin_db, MIN_NOISE_MARGIN_DB, math.inf, "dB"
        )
    for name in filter(data.has, RIGHT_CELLS + LEFT_CELLS):
        max_noise = data.profile.comparison.contact_n / 5.0
        yield make_check(data, "noise", name, data.noise(name), 0.0, max_noise, "N")


def check_rest(data: LoopCheckData) -> Iterator[Check]:
    """Check the offset of motion sensors before the motion and the residual motion after it.

    Precompressed bumpers (negative gap) may shift the mass, so its position is not checked then;
    the ring-down of the mass is reported without a limit.
    """
    test_level = data.test_level
    min_gap = min(data.profile.specimen.gaps_m)
    max_displacement = test_level / (2 * math.pi * data.profile.plan.low_hz) ** 2
    max_displacement = min(max_displacement, min_gap) if min_gap > 0 else max_displacement
    for name in filter(data.has, MOTION_CHANNELS):
        is_displacement = CHANNEL_BY_NAME[name].unit == "m"
        unit, amplitude = ("m", max_displacement) if is_displacement else ("m/s2", test_level)
        rms = data.noise(name)
        if not (is_displacement and name not in TABLE_CHANNELS and min_gap <= 0):
            limit = max(MAX_OFFSET_RATIO * amplitude, 4.0 * rms)
            yield make_check(
                data,
                "offset",
                name,
                finite_mean(data.rest_before.channel(name)),
                -limit,
                limit,
                unit,
            )
        residual = _finite_rms(
            data.rest_after.channel(name) - finite_mean(data.rest_after.channel(name))
        )
        limit = MAX_RESIDUAL_MOTION_RATIO * amplitude / math.sqrt(2.0) + RESIDUAL_NOISE_FACTOR * rms
        limit = limit if name in TABLE_CHANNELS else math.inf
        yield make_check(data, "motion left after the check", name, residual, 0.0, limit, unit)


def _finite_rms(values: Float1D) -> float:
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if finite.size else math.nan


def finite_mean(values: Float1D) -> float:
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if finite.size else math.nan
