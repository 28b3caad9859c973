"""Loop check: verification of wiring, sensors and servo at low level before every run.

    plan_targets(profile, rig) -> steady motions, in the order in which they are driven
    count_hold_cycles(target, profile) -> cycles to hold, the first SETTLE_CYCLES not evaluated
    evaluate(block, drive, profile, rig, tare_noise=None) -> (checks, response or None)

No check judges the specimen: it may resonate and touch its bumpers. Each function yields the checks
for which the rig has the channels. An unknown value (NaN) fails. Values that the motion of the
specimen could explain are not checked, or only reported, without limits.

An unloaded cell shows neither its sign nor its gain. Without contact the checks cover its noise,
which must be present and small, its offset, and cross-talk from the motion of the table. In contact
(bumpers touched, or precompressed by a negative gap) they also cover its sign and its share of the
force.
"""

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from table_io.block import Block, Float1D, finite_mean
from table_io.channels import (
    CHANNEL_BY_NAME,
    LEFT_CELLS,
    RIGHT_CELLS,
    contact_forces,
    relative_displacement,
)
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig
from table_io.excitation.drive import Drive
from table_io.excitation.trajectory import SineTarget
from table_io.records import Check, Event, FrequencyResponse, Record
from table_io.safety.consistency import MAX_CELL_OFFSET_RATIO, SENSOR_PAIRS
from table_io.safety.loop_check_data import (
    MAX_MISMATCH_RATIO,
    Complex1D,
    LoopCheckData,
    PreloadLimits,
)
from table_io.units import GRAVITY_M_S2

TABLE_CHANNELS = ("table_disp_m", "table_acc_m_s2")
MASS_CHANNELS = ("mass_disp_m", "mass_acc_m_s2")
MOTION_CHANNELS = (*TABLE_CHANNELS, *MASS_CHANNELS, "rel_disp_m")
LOAD_CELLS = RIGHT_CELLS + LEFT_CELLS
NOISY = MOTION_CHANNELS + LOAD_CELLS

MAX_LOST_PERCENT = 1.0  # of the samples
MIN_NEW_PERCENT = 70.0  # of the samples: noise of two converter steps repeats 14 % of them
MIN_STEPS_OF_CHANGE = 4.0  # change of a channel over its step, from which it repeats few
MIN_LARGE_SHARE = 0.01  # of the samples, which change by so much: more than the tail of noise
MIN_TONE_SNR = 10.0  # tone over its standard error
DELAY_RANGE_MS = (-2.0, 100.0)
MAX_DELAY_SPREAD_RATIO = 0.5  # of the mean delay, if that is more than the rig's limit
BEYOND_NOISE = "difference beyond noise from"
MAX_UNNOTICED_PERCENT = 0.5  # of the motion, by which calibrated sensors of one body differ
MAX_READ_BACK_LSB, MAX_READ_BACK_RATIO = 4.0, 0.005  # DAC steps, and fraction of the command
MIN_NOISE_MARGIN_DB = 20.0
KNOWN_SIGMAS = 4.0  # by which the noise of a short rest may be more than that of the rig file
MAX_OFFSET_RATIO = 0.05  # of the motion of the test, or of the gap
# Of the motion of the test, and of the noise.
MAX_RESIDUAL_MOTION_RATIO = 0.02
RESIDUAL_NOISE_FACTOR = 2.0
# Sines that prove lag or lead; a transient may look like a small lead.
MIN_LAG_SINE = 0.2
MAX_LEAD_SINE = -0.5
# Tone of the mass: at least this in phase with the table, at most this in antiphase.
MIN_IN_PHASE_TONE = 0.5
MAX_ANTIPHASE_TONE = 0.9
NO_LIMITS = (-math.inf, math.inf)
MIN_FLOOR_MOTION = 0.3  # of the table's tone, in what the laser of the mass reads


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


def check_sample_rate(data: LoopCheckData) -> Iterator[Check]:
    """Check that a channel whose motion its converter resolves has a new value at every sample.

    One that is sampled at a lower rate repeats each value, and so changes by none after a large
    change; a cell may rest between impacts. One that never changes is dead. The step is the
    smallest change of a motion: a rig file may state more bits than the converter has.
    """
    windows = [data.window(hold) for hold in data.holds]
    for name in filter(data.has, NOISY):
        shares = []
        for window in windows:
            changes = np.abs(np.diff(window.channel(name)))
            is_new = changes > 0.0
            step = float(changes[is_new].min(initial=math.inf))
            is_large = changes[:-1] > MIN_STEPS_OF_CHANGE * step
            if is_large.mean() > MIN_LARGE_SHARE:
                shares.append(100.0 * float(is_new[1:][is_large].mean()))
        if shares:
            yield make_check(data, "new samples", name, min(shares), MIN_NEW_PERCENT, 100.0, "%")


def check_read_back(data: LoopCheckData) -> Iterator[Check]:
    """Compare the command read back with the computed one; rms error in DAC steps."""
    command = data.drive.command(data.block.index, len(data.block))
    lsb = data.rig.output.lsb_m
    error = data.block.channel("drive_disp_m") - command
    allowed = MAX_READ_BACK_LSB + MAX_READ_BACK_RATIO * _finite_rms(command) / lsb
    yield make_check(
        data, "command read back", "drive_disp_m", _finite_rms(error) / lsb, 0.0, allowed, "LSB"
    )


def _widen_gains(low: float, high: float, noise: float) -> tuple[float, float]:
    """Return a range of gains with what noise may change of one; no gain is below zero."""
    return max(low - noise, 0.0), high + noise


def check_table_response(data: LoopCheckData) -> Iterator[Check]:
    """Check polarity, gain and delay of the table's sensors against the command.

    A servo rolls off, so the gain is near 1 at the lowest frequency only; above it the gain must
    follow a smooth curve, within the range that amplitude control can correct. A drive relies on
    the table for which it was computed: gain and delay are then compared with what is expected of
    that table. The rig file states the ranges; below its least level friction holds the table back,
    and no gain is too low. What the noise at rest may change of a value is added to its range.
    """
    allowed = data.rig.table_response
    frequencies_hz, expected = data.frequencies_hz, data.expected_tones
    is_stated = expected is not None or not is_below_friction(data.profile, data.rig)

    def limit(high: float) -> float:
        return high if is_stated else math.inf

    for name in TABLE_CHANNELS:
        if not _has_clear_tone(data, name):
            continue
        tones = data.tones(name)
        noise = KNOWN_SIGMAS * data.tone_errors(name)
        relative_noise = noise / np.abs(tones)
        ratios = tones if expected is None else tones / expected
        polarity = float(np.cos(np.angle(tones[0])))
        yield make_check(data, "polarity against the command", name, polarity, 0.0, 1.0, "")
        least_gain = allowed.find_least_gain(float(frequencies_hz[0])) if is_stated else 0.0
        gain_range = _widen_gains(least_gain, allowed.gain[1], noise[0])
        yield make_check(data, "gain", name, abs(tones[0]), *gain_range, "")
        swept = np.flatnonzero(frequencies_hz <= data.profile.plan.high_hz * (1 + 1e-9))
        if swept.size > 1:
            top = swept[-1]
            least_gain = allowed.top_gain[0] if is_stated else 0.0
            top_range = _widen_gains(least_gain, allowed.top_gain[1], noise[top])
            label, top_gain = "gain at the highest frequency", abs(tones[top])
            yield make_check(data, label, name, top_gain, *top_range, "")
        if expected is not None or swept.size > 2:
            label, logarithms = "gain off that of the drive", np.log(np.abs(ratios))
            if expected is None:
                label, z = "gain off a smooth curve", frequencies_hz[swept] ** 2
                logarithms = logarithms[swept] - np.polyval(np.polyfit(z, logarithms[swept], 1), z)
            off = 100.0 * np.abs(logarithms).max()
            max_off = allowed.gain_residual_percent + 100.0 * relative_noise[swept].max()
            yield make_check(data, label, name, off, 0.0, limit(max_off), "%")
        delays = _find_delays(tones * np.sign(polarity), frequencies_hz)
        delay_noise = 1e3 * relative_noise / (2 * math.pi * frequencies_hz)
        longest = np.argmax(np.abs(delays))
        low, high = DELAY_RANGE_MS
        delay_range = low - delay_noise[longest], high + delay_noise[longest]
        yield make_check(data, "delay", name, delays[longest], *delay_range, "ms")
        if frequencies_hz.size > 1:
            max_spread = max(
                allowed.delay_spread_ms, MAX_DELAY_SPREAD_RATIO * abs(float(delays.mean()))
            )
            off_drive = " off that of the drive," if expected is not None else ""
            differences = _find_delays(ratios * np.sign(polarity), frequencies_hz)
            ends = [np.argmin(differences), np.argmax(differences)]
            max_spread += float(np.linalg.norm(delay_noise[ends]))
            spread = float(np.ptp(differences))
            label = f"delay{off_drive} over the frequencies"
            yield make_check(data, label, name, spread, 0.0, limit(max_spread), "ms")


def _has_clear_tone(data: LoopCheckData, *names: str) -> bool:
    """Return True if each channel has tones above the noise and lost none of them entirely."""
    return data.has(*names) and all(
        data.tone_snr(name) > MIN_TONE_SNR and bool(np.isfinite(data.tones(name)).all())
        for name in names
    )


def _find_delays(tones: Complex1D, frequencies_hz: Float1D) -> Float1D:
    """Return the delay of each tone in ms, (hold,)."""
    return -1e3 * unwrap_phase(tones, frequencies_hz) / (2 * math.pi * frequencies_hz)


def unwrap_phase(tones: Complex1D, frequencies_hz: Float1D) -> Float1D:
    """Unwrap the phase in rad, (hold,): each follows the delay of the next lower frequency."""
    phase = np.angle(tones)
    for k in range(1, phase.size):
        expected = phase[k - 1] * frequencies_hz[k] / frequencies_hz[k - 1]
        if math.isfinite(expected - phase[k]):
            phase[k] += 2 * math.pi * round((expected - phase[k]) / (2 * math.pi))
    return phase


def check_laser_mount(data: LoopCheckData) -> Iterator[Check]:
    """Check that the laser of the mass stands on the floor, where its accelerometer can tell.

    On the table it reads the tone of the mass less that of the table. The value is the largest
    distance from that over the table's tone: 1 on the floor, 0 on the table.
    """
    if _has_clear_tone(data, "table_acc_m_s2", "mass_acc_m_s2", "mass_disp_m"):
        table, mass = data.tones("table_acc_m_s2"), data.tones("mass_acc_m_s2")
        distance = np.abs((data.tones("mass_disp_m") - mass) / table + 1.0).max()
        yield make_check(
            data,
            "motion against the floor",
            "mass_disp_m",
            distance,
            MIN_FLOOR_MOTION,
            math.inf,
            "",
        )


def check_mass_polarity(data: LoopCheckData) -> Iterator[Check]:
    """Check the polarity of the sensors of the mass without a model of the specimen."""
    for name in _list_absolute(data, MASS_CHANNELS):
        sine_of_lag = lag_sine(data, name)
        if sine_of_lag is not None:
            yield make_check(
                data, "polarity, lag behind the table", name, sine_of_lag, 0.0, 1.0, ""
            )


def _list_absolute(data: LoopCheckData, names: Iterable[str]) -> list[str]:
    """Return the channels that the rig has, but a laser that looks mounted on the table."""
    on_table = {check.channel for check in check_laser_mount(data) if not check.passed}
    return [name for name in filter(data.has, names) if name not in on_table]


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
    over all frequencies with low enough noise, and what noise does not explain of it. It holds for
    any motion of the specimen. The low cut and delay of a sound accelerometer are fitted before.
    """
    for displacements, acceleration in SENSOR_PAIRS:
        if not _has_clear_tone(data, *displacements, acceleration):
            continue
        if displacements[0] == "mass_disp_m" and not _list_absolute(data, displacements[:1]):
            continue
        mismatch, excess, _ = data.compare_sensors(displacements, acceleration)
        if not math.isnan(mismatch):
            name, high = f"second derivative against {acceleration}", 100.0 * MAX_MISMATCH_RATIO
            yield make_check(data, name, displacements[0], 100.0 * mismatch, 0.0, high, "%")
            name = f"{BEYOND_NOISE} {acceleration}"
            yield make_check(data, name, displacements[0], 100.0 * excess, *NO_LIMITS, "%")


def check_noise(data: LoopCheckData) -> Iterator[Check]:
    """Check that the noise at rest is 20 dB below the motion of the test, at every frequency."""
    channels = filter(data.has, NOISY)
    for name, value, low, high, unit in list_noise_margins(data.profile, channels, data.noise):
        label = "noise" if name in LOAD_CELLS else "noise under the level"
        yield make_check(data, label, name, value, low, high, unit)


def list_noise_margins(
    profile: Profile, channels: Iterable[str], noise: Callable[[str], float]
) -> Iterator[tuple[str, float, float, float, str]]:
    """Yield (channel, value, low, high, unit): the noise of each channel against the test.

    Displacements are compared with the smallest amplitude, that at the upper end of the band, or
    with the peak of a history, which has its displacement at the lower end; load cells with a fifth
    of the contact threshold `comparison.contact_n`. `noise` returns the rms of a channel in SI.
    """
    smallest_m = find_amplitude(profile, profile.plan.high_hz)
    for name in channels:
        if name in LOAD_CELLS:
            yield name, noise(name), 0.0, profile.comparison.contact_n / 5.0, "N"
            continue
        is_displacement = CHANNEL_BY_NAME[name].unit == "m"
        amplitude = smallest_m if is_displacement else profile.plan.level_m_s2
        margin_db = 20.0 * math.log10(amplitude / math.sqrt(2.0) / noise(name))
        yield name, margin_db, MIN_NOISE_MARGIN_DB, math.inf, "dB"


def find_amplitude(profile: Profile, frequency_hz: float) -> float:
    """Return the displacement of a test at a frequency in m; without steps its largest."""
    plan = profile.plan
    if not plan.steps:
        return plan.peak_disp_m
    return plan.level_m_s2 / (2 * math.pi * frequency_hz) ** 2


def _find_known_noise(rig: RigConfig, name: str) -> tuple[float, str]:
    """Return (rms noise of a channel at rest, SI; where it is stated), the larger of two."""
    sensor, tare = rig.sensor(name), rig.tare
    known = [(math.hypot(sensor.noise_si, sensor.lsb_si / math.sqrt(12.0)), "the rig file")]
    if tare is not None and name in tare.channels:
        noise_v = tare.noise_v[tare.channels.index(name)]
        known.append((noise_v / abs(sensor.volts_per_si), f"the tare of {tare.at}"))
    return max(known)


def list_known_faults(profile: Profile, rig: RigConfig) -> list[str]:
    """List what the loop check will refuse by what is known before: noise and converter steps.

    By the noise that the rig file states, its converter's included, as the rest before the motion
    may show it, or by that of the newest tare if it is more. A sentence each, with the remedy.
    """
    if not profile.loop_check.enabled:
        return []
    rest_samples = profile.acquisition.rest_s * profile.acquisition.rate_hz
    factor = 1.0 + KNOWN_SIGMAS / math.sqrt(2.0 * rest_samples)

    def noise(name: str) -> float:
        return factor * _find_known_noise(rig, name)[0]

    faults = [
        f"noise of {name} is {value:.3g} {unit} "
        + ("below the level " if unit == "dB" else "")
        + f"in a short rest by {_find_known_noise(rig, name)[1]}, allowed "
        + (f"at least {low:g}" if unit == "dB" else f"at most {high:.3g}")
        + f" {unit}"
        for name, value, low, high, unit in list_noise_margins(
            profile, (name for name in NOISY if name in rig.channels), noise
        )
        if not low <= value <= high
    ]
    targets = plan_targets(profile, rig)
    for name in TABLE_CHANNELS:
        is_displacement = CHANNEL_BY_NAME[name].unit == "m"
        ratios = [
            target.level_m_s2
            / ((2 * math.pi * target.frequency_hz) ** 2 if is_displacement else 1)
            / noise(name)
            * math.sqrt(
                0.5
                * profile.acquisition.rate_hz
                * (count_hold_cycles(target, profile) - 1)
                / target.frequency_hz
            )
            for target in targets
        ]
        if ratios and max(ratios) < MIN_TONE_SNR:
            faults.append(
                f"{name} is {max(ratios):.3g} times its noise in the loop check, allowed at least "
                f"{MIN_TONE_SNR:g} times"
            )
    return faults


def check_rest(data: LoopCheckData) -> Iterator[Check]:
    """Check the offset of motion sensors before the motion and the residual motion after it.

    Precompressed bumpers (negative gap) may shift the mass, so its position is not checked then;
    the ring-down of the mass is reported without a limit.
    """
    test_level = data.test_level
    min_gap = min(data.profile.specimen.gaps_m)
    max_displacement = find_amplitude(data.profile, data.profile.plan.low_hz)
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


NEAR_GAP_RATIO = 0.9  # of the gap: below this displacement there is no contact
MIN_NOISE_RATIO = 0.1  # of the noise stated in the rig file
MIN_LOADED_SNR = 50.0  # tone over its standard error above which a cell counts as loaded
MIN_FORCE_SHARE = 0.1  # of the force of the other cell on the same side
MAX_CROSS_TALK_RATIO = 0.5  # of the contact threshold


def check_load_cells(data: LoopCheckData) -> Iterator[Check]:
    """Check every load cell of the rig."""
    for name in filter(data.has, LOAD_CELLS):
        yield from _check_noise_present(data, name)
        yield from _check_preload(data, name)
        yield from _check_cross_talk(data, name)
        yield from _check_polarity(data, name)
        yield from _check_force_share(data, name)
    if data.has(*LOAD_CELLS) and min(data.profile.specimen.gaps_m) < 0:
        right, left = (abs(finite_mean(force)) for force in contact_forces(data.rest_before))
        asymmetry = (right - left) / (right + left)
        yield make_check(data, "preload, right over left", "force", asymmetry, *NO_LIMITS, "")
    if data.has(*LOAD_CELLS) and data.preload_n is not None:
        forces = contact_forces(data.rest_before)
        for side, sign, force, limits in zip(
            ("right", "left"), (1.0, -1.0), forces, data.preload_n, strict=True
        ):
            preload = sign * finite_mean(force)
            yield make_check(data, f"preload of the {side} bumper", "force", preload, *limits, "N")


def _check_noise_present(data: LoopCheckData, name: str) -> Iterator[Check]:
    """Check that a cell shows noise if its converter resolves it."""
    sensor = data.rig.sensor(name)
    if sensor.noise_si > sensor.lsb_si:
        yield make_check(
            data, "alive, noise at rest", name, data.noise(name), MIN_NOISE_RATIO * sensor.noise_si,
            math.inf, "N",
        )  # fmt: skip


def _check_preload(data: LoopCheckData, name: str) -> Iterator[Check]:
    """Check the offset of a cell at rest; with precompressed bumpers report the preload only."""
    preload = finite_mean(data.rest_before.channel(name))
    if min(data.profile.specimen.gaps_m) > 0:
        max_offset = MAX_CELL_OFFSET_RATIO * data.profile.comparison.contact_n
        yield make_check(data, "offset", name, preload, -max_offset, max_offset, "N")
    else:
        yield make_check(data, "preload", name, preload, *NO_LIMITS, "N")


def _find_contact_holds(data: LoopCheckData) -> npt.NDArray[np.bool_]:
    """Find the held motions in which the mass may have touched a bumper, bool (hold,)."""
    min_distance = NEAR_GAP_RATIO * min(data.profile.specimen.gaps_m)
    distances = [np.abs(relative_displacement(data.window(hold))).max() for hold in data.holds]
    return ~(np.array(distances) < min_distance)


def _check_cross_talk(data: LoopCheckData, name: str) -> Iterator[Check]:
    """Check the force on a cell, scaled to the test level, in motions without contact."""
    free = ~_find_contact_holds(data)
    if free.any():
        force = float(np.abs(data.tones(name))[free].max()) * data.test_level
        max_force = MAX_CROSS_TALK_RATIO * data.profile.comparison.contact_n
        yield make_check(data, "cross-talk from the motion", name, force, 0.0, max_force, "N")


def _find_loaded_holds(data: LoopCheckData, name: str) -> npt.NDArray[np.bool_]:
    """Find the held motions in which a cell is loaded, bool (hold,)."""
    return _find_contact_holds(data) & (
        np.abs(data.tones(name)) > MIN_LOADED_SNR * data.tone_errors(name)
    )


def _check_polarity(data: LoopCheckData, name: str) -> Iterator[Check]:
    """Check the sign of a loaded cell: compression is positive.

    A right bumper pushes the mass to the left, so the force correlates negatively with the
    acceleration of the mass on the right, positively on the left. The relative displacement u is
    not used: on a stiff specimen the gain errors of two lasers hide it.
    """
    if not data.has("mass_acc_m_s2") or (lag_sine(data, "mass_acc_m_s2") or 0.0) <= 0:
        return
    windows = [data.window(data.holds[k]) for k in np.flatnonzero(_find_loaded_holds(data, name))]
    if not windows:
        return
    a = np.concatenate([window.channel("mass_acc_m_s2") for window in windows])
    load = np.concatenate([window.channel(name) for window in windows])
    finite = np.isfinite(a) & np.isfinite(load)
    if finite.any():
        sign = -1.0 if name in RIGHT_CELLS else 1.0
        correlation = sign * float(np.corrcoef(a[finite], load[finite])[0, 1])
        yield make_check(data, "polarity in contact", name, correlation, 0.0, 1.0, "")


def _check_force_share(data: LoopCheckData, name: str) -> Iterator[Check]:
    """Check that a cell bears a share of the force of the other cell on its side."""
    side = RIGHT_CELLS if name in RIGHT_CELLS else LEFT_CELLS
    for neighbour in filter(data.has, side):
        loaded = _find_loaded_holds(data, neighbour)
        if neighbour != name and loaded.any():
            shares = np.abs(data.tones(name)[loaded] / data.tones(neighbour)[loaded])
            share = float(shares.max())
            yield make_check(
                data, "force ratio to its neighbour", name, share, MIN_FORCE_SHARE, math.inf, ""
            )


SETTLE_CYCLES = 1
MIN_HOLD_S = 2.0  # noise then changes a gain by 0.2 % at 10 Hz; over five cycles by 0.5 %
MAX_LEVEL_RATIO = 0.1  # of the test level
MIN_CHECK_HZ = 1.0
MIN_FREQUENCY_RATIO = 1.1  # closer frequencies are merged
MAX_CANCELLED_ORDER = 5  # highest harmonic of the table that may be canceled
CHECK_FUNCTIONS = (
    check_lost_samples,
    check_sample_rate,
    check_alive,
    check_read_back,
    check_table_response,
    check_laser_mount,
    check_mass_polarity,
    check_derivative_consistency,
    check_noise,
    check_rest,
    check_load_cells,
)
REMEDIES = {
    "lost samples": "check the cable and the acquisition device",
    "new samples": "the channel is sampled at a lower rate than the test: raise its rate, or lower "
    "acquisition.rate_hz",
    "alive": "check the cable, supply and range of the sensor",
    "command read back": "connect the command output to its input, and check span_mm and span_v of "
    "the output",
    "polarity": "turn the sensor around, or change the sign of volts_per_unit in the rig file",
    "gain off that of": "the table is not that of its twin: check for a loose sensor, or "
    "identify the table again (shaketwin table-twin) and compute the drive anew",
    "gain off": "check for a loose sensor or a resonance of the table",
    "gain at": "lower the frequencies of the excitation or tune the servo",
    "gain": "check unit and volts_per_unit in the rig file against the sensor, then the servo",
    "delay": "check filters and the clocks of output and input",
    "second derivative": "check gain, unit, sign, filter and input of both sensors; they may be "
    "swapped",
    "motion against": "the laser looks mounted on the table, it reads mass minus table: state its "
    'channel as "rel_disp_m" in the rig file, or mount it on the floor',
    "noise": "check for ground loops and the range, or raise the level of the excitation",
    "offset": "tare again with the table at rest and the bumpers unloaded",
    "preload of": "tare with the bumpers clear of the mass (shaketwin tare), else correct the "
    "gap of the profile or the bumper stiffness of the model",
    "motion left": "let the servo come to rest, or raise loop_check.rest_s",
    "cross-talk": "check that the gap is as large as stated; if so, the cell responds to the "
    "motion of the table",
    "force ratio": "check that both load cells of this side are connected and loaded",
}


def is_below_friction(profile: Profile, rig: RigConfig) -> bool:
    """Return True if friction shapes what the table plays of a test, even at its largest."""
    return profile.plan.level_m_s2 < rig.table_response.least_level_g * GRAVITY_M_S2


def find_friction_level(profile: Profile, rig: RigConfig) -> float:
    """Return the level in m/s2 that a rig with friction asks for, at most that of the test."""
    return min(rig.table_response.least_level_g * GRAVITY_M_S2, profile.plan.level_m_s2)


def plan_targets(profile: Profile, rig: RigConfig) -> tuple[SineTarget, ...]:
    """Plan the steady motions of the check as sine targets, lowest frequency first.

    Three frequencies in equal ratios between the ends of the excitation's band (from 1 Hz if it
    starts below and ends above it); two more, up to the fifth harmonic of the highest frequency, if
    harmonics are canceled. Where an amplitude has fewer DAC steps than `output.least_lsb`, the
    level is raised to at most a tenth of the test level; beyond that the frequency is lowered, and
    the response above it is extrapolated. A rig with friction may ask for a larger level, at which
    higher frequencies are resolved.
    """
    plan, settings = profile.plan, profile.loop_check
    test_level = plan.level_m_s2
    lowest = max(settings.level * test_level, find_friction_level(profile, rig))
    min_amplitude_m = rig.output.least_lsb * rig.output.lsb_m

    def limit_frequency(f: float) -> float:
        highest = max(MAX_LEVEL_RATIO * test_level, lowest)
        resolvable_hz = math.sqrt(highest / min_amplitude_m) / (2 * math.pi)
        return min(f, resolvable_hz, rig.limits.frequency_hz)

    requested_hz = list(settings.frequencies_hz)
    if not requested_hz:
        high_hz = limit_frequency(plan.high_hz)
        low_hz = min(
            max(plan.low_hz, MIN_CHECK_HZ) if high_hz > MIN_CHECK_HZ else plan.low_hz, high_hz
        )
        requested_hz = [low_hz, math.sqrt(low_hz * high_hz), high_hz]
        if plan.steps and profile.control.harmonics:
            top_hz = limit_frequency(MAX_CANCELLED_ORDER * plan.high_hz)
            requested_hz += [math.sqrt(high_hz * top_hz), top_hz]
    targets: list[SineTarget] = []
    for f in sorted(map(limit_frequency, requested_hz)):
        if not targets or f > MIN_FREQUENCY_RATIO * targets[-1].frequency_hz:
            targets.append(SineTarget(f, max(lowest, min_amplitude_m * (2 * math.pi * f) ** 2)))
    return tuple(targets)


def count_hold_cycles(target: SineTarget, profile: Profile) -> int:
    """Count the cycles to hold at a target, settling included; they last MIN_HOLD_S or longer."""
    return SETTLE_CYCLES + max(
        profile.loop_check.cycles, math.ceil(MIN_HOLD_S * target.frequency_hz - 1e-9)
    )


def evaluate(
    block: Block,
    drive: Drive,
    profile: Profile,
    rig: RigConfig,
    tare_noise: dict[str, float] | None = None,
    preload_n: PreloadLimits | None = None,
) -> tuple[tuple[Check, ...], FrequencyResponse | None]:
    """Evaluate the loop check: return (checks, frequency response of the table).

    `block` holds the rest before, the motions and the rest after them, SI. Checks whose channels
    are missing are omitted. The response is None if the table's accelerometer is lost.
    """
    data = LoopCheckData(block, drive, profile, rig, tare_noise or {}, preload_n)
    if not data.holds:
        return (), None
    checks = tuple(check for check_function in CHECK_FUNCTIONS for check in check_function(data))
    return checks, _compute_response(data)


def find_remedy(check: Check) -> str:
    """Return the remedy for a failed check; empty if there is none."""
    return next((text for name, text in REMEDIES.items() if check.name.startswith(name)), "")


def list_check_records(checks: Iterable[Check], index: int) -> list[Record]:
    """Return the checks as evaluated at sample `index`, then what the operator is told of them."""
    dated = [replace(check, index=index) for check in checks]
    notices = (Event(index, "instrument", text) for check in dated if (text := find_notice(check)))
    return [*dated, *notices]


def find_notice(check: Check) -> str:
    """Return what the operator is told of a check that passed; empty if nothing."""
    if not check.passed or not check.name.startswith(BEYOND_NOISE):
        return ""
    if not check.value > MAX_UNNOTICED_PERCENT:
        return ""
    return (
        f"{check.channel} differs from {check.name.removeprefix(BEYOND_NOISE).strip()} by "
        f"{check.value:.2g} % more than noise explains: check gain, filter and clock of both, and "
        "whether the body rocks"
    )


def _compute_response(data: LoopCheckData) -> FrequencyResponse | None:
    tones = data.tones("table_acc_m_s2")
    if not (np.isfinite(tones).all() and np.abs(tones).all()):
        return None
    frequencies_hz = data.frequencies_hz
    phase = unwrap_phase(tones, frequencies_hz)
    gain = np.abs(tones)
    return FrequencyResponse(
        data.block.end, tuple(frequencies_hz.tolist()), tuple(gain.tolist()), tuple(phase.tolist())
    )
