"""Drive: the command by which a table follows its target, from its twin and from earlier runs.

A target motion is played on the table's twin, and what the twin lacks is added to the command
through the inverse of its linear frequency response, until nothing more is gained: the inverse of
the nonlinear twin within the band. Above it the target fades out, and only what the twin adds there
is taken out. What a real run lacks in the band is added in the same way, which is the usual
iteration of a laboratory (for instance De Cuyper, Swevers, Mech. Syst. Signal Process. 2003);
friction, valve and impacts are then those of the last run.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.fft import next_fast_len

from table_io.block import Block, Float1D
from table_io.channels import CONTROL_CHANNELS
from table_io.config.excitation.drive_file import ExpectedResponse
from table_io.config.excitation.waveform import smoothstep
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig
from table_io.errors import InputError
from table_io.safety.loop_check import unwrap_phase
from table_io.safety.loop_check_data import LoopCheckData
from table_io.sequencer.procedure import start_test
from table_io.sequencer.state import TestPlan
from twin.earthquakes.table_response import CROSSOVER_HZ, PredictiveModel

BAND_EDGE_RATIO = 1.25  # target and inverse fall to nothing between a band's end and this multiple
MAX_AMPLIFICATION = 5.0  # of the inverse
MAX_ROUNDS = 25
LEAST_GAIN = 0.01  # relative fall of the error below which the search ends
SMOOTHING_HZ = 0.5  # of the ratio of what a run lacked to the noise
PADDING_S = 4.0  # of rest around the motion, so that its end does not reach its beginning


@dataclass(frozen=True, eq=False)
class TwinDrive:
    """Command in m, (sample,), and the twin's acceleration error in the band alone, relative."""

    command_m: Float1D
    expected_error: float


def compute_command(
    model: PredictiveModel,
    target_m: Float1D,
    rate_hz: float,
    band_hz: tuple[float, float],
    reaction_n: Float1D | None = None,
    highest_hz: float = 0.0,
) -> TwinDrive:
    """Compute the command for a target displacement in m, (sample,), at rest at both ends.

    `reaction_n`, (sample,), is the force of the specimen on the table during the target motion.
    The target fades out above the band; what the twin adds there, as its oil column rings, is taken
    out up to `highest_hz`, in ever smaller part up to BAND_EDGE_RATIO times that.
    """
    hz = np.asarray(np.fft.rfftfreq(target_m.size, 1.0 / rate_hz), float)
    wanted = np.fft.irfft(np.fft.rfft(target_m) * _taper(hz, band_hz[1]), target_m.size)
    wide_hz = band_hz[0], max(band_hz[1], highest_hz)
    best, best_error, lacking, step = np.zeros(target_m.size), math.inf, wanted, 1.0
    for _ in range(MAX_ROUNDS):
        command = best + step * compute_correction(lacking, model, rate_hz, wide_hz)
        achieved = model.simulate(command, rate_hz, reaction_n)[0]
        is_finite = np.isfinite(achieved).all()
        error = measure_error(achieved, wanted, rate_hz, band_hz) if is_finite else math.inf
        if error < best_error:
            gain, best, best_error = best_error - error, command, error
            lacking = wanted - achieved
            if gain < LEAST_GAIN * (gain + error):
                break
        else:
            step *= 0.5
            if step < 0.2:
                break
    if math.isinf(best_error):
        raise InputError("the twin of the table diverges on this target")
    return TwinDrive(best, best_error)


def compute_correction(
    lacking_m: Float1D, model: PredictiveModel, rate_hz: float, band_hz: tuple[float, float]
) -> Float1D:
    """Return the command for what the table lacks in m, (sample,), by the linear inverse."""
    count = lacking_m.size
    padding = round(PADDING_S * rate_hz)
    size = next_fast_len(count + 2 * padding)
    spectrum = np.fft.rfft(lacking_m, size)
    frequency_hz = np.fft.rfftfreq(size, 1.0 / rate_hz)
    inverse = _invert_response(model, np.asarray(frequency_hz, float), band_hz[1])
    correction = np.fft.irfft(spectrum * inverse, size)
    # The inverse leads: what it asks for before the first sample lies at the end of the period.
    limited: Float1D = correction[:count] * _rest_at_ends(count, rate_hz)
    return limited


@dataclass(frozen=True, eq=False)
class PlayedDrive:
    """A run of a drive: command and achieved table in m, specimen's force in N, (sample,) each.

    `noise_m` is the rms of the laser's noise in m, `noise_m_s2` that of the accelerometer's.
    """

    command_m: Float1D
    achieved_m: Float1D
    reaction_n: Float1D
    noise_m: float
    noise_m_s2: float


def correct_played_drive(
    run: PlayedDrive,
    model: PredictiveModel,
    target_m: Float1D,
    reaction_n: Float1D,
    rate_hz: float,
    band_hz: tuple[float, float],
) -> Float1D:
    """Return the next command, (sample,), for a target in m with the specimen's force in N.

    What another force of the specimen did in the run, for instance an impact at another time, is
    taken out by the twin: the next run will not repeat it. What is no larger than the noise of the
    sensors is left.
    """
    by_target, by_run = (
        model.simulate(run.command_m, rate_hz, force)[0] for force in (reaction_n, run.reaction_n)
    )
    lacking = target_m - (run.achieved_m + by_target - by_run)
    spectrum = np.fft.rfft(lacking)
    frequency_hz = np.fft.rfftfreq(lacking.size, 1.0 / rate_hz)
    square = np.where(frequency_hz > 0.0, (math.tau * frequency_hz) ** 2, 1.0)
    slow = frequency_hz < CROSSOVER_HZ
    noise = lacking.size * np.where(slow, run.noise_m, run.noise_m_s2 / square) ** 2
    width = max(round(SMOOTHING_HZ * lacking.size / rate_hz), 1)
    ratio = np.convolve(np.abs(spectrum) ** 2 / noise, np.ones(width) / width, mode="same")
    known = np.fft.irfft(spectrum * np.clip(1.0 - 1.0 / ratio, 0.0, 1.0), lacking.size)
    return run.command_m + compute_correction(known, model, rate_hz, band_hz)


def predict_loop_check(
    model: PredictiveModel, profile: Profile, rig: RigConfig
) -> ExpectedResponse | None:
    """Return the response that a loop check is to measure, without the specimen; None without it.

    The motions of the check are played on the table's twin, at their low level.
    """
    state = start_test(TestPlan(profile, rig, 0))
    count, rate_hz = state.trajectory.end, state.trajectory.rate_hz
    command = state.drive.command(0, count)
    if not command.any():
        return None
    values = np.stack([command, *model.simulate(command, rate_hz)])
    block = Block("meas", 0, rate_hz, CONTROL_CHANNELS, values, *state.drive.labels(0, count))
    data = LoopCheckData(block, state.drive, profile, rig, {})
    tones = data.tones("table_acc_m_s2")
    return ExpectedResponse(
        frequencies_hz=tuple(data.frequencies_hz.tolist()),
        levels_m_s2=tuple(data.levels_m_s2.tolist()),
        gain=tuple(np.abs(tones).tolist()),
        phase_rad=tuple(unwrap_phase(tones, data.frequencies_hz).tolist()),
    )


def measure_error(
    achieved_m: Float1D, target_m: Float1D, rate_hz: float, band_hz: tuple[float, float]
) -> float:
    """Return the rms error of acceleration in a band over that of the target, from m."""
    frequency_hz = np.fft.rfftfreq(target_m.size, 1.0 / rate_hz)
    inside = (frequency_hz >= band_hz[0]) & (frequency_hz <= band_hz[1])
    square = frequency_hz[inside] ** 2
    error = np.fft.rfft(achieved_m - target_m)[inside] * square
    return float(np.linalg.norm(error) / np.linalg.norm(np.fft.rfft(target_m)[inside] * square))


def _invert_response(
    model: PredictiveModel, frequency_hz: Float1D, highest_hz: float
) -> npt.NDArray[np.complex128]:
    """Return the inverse of the linear response, tapered above the band and bounded."""
    response = model.frequency_response(frequency_hz)
    size = np.maximum(np.abs(response), 1.0 / MAX_AMPLIFICATION)
    inverse: npt.NDArray[np.complex128] = np.conj(response) / size**2
    return inverse * _taper(frequency_hz, highest_hz)


def _taper(frequency_hz: Float1D, end_hz: float) -> Float1D:
    """Return a window of frequencies that is 1 up to a band's end and falls to 0 above it."""
    beyond = (frequency_hz / end_hz - 1.0) / (BAND_EDGE_RATIO - 1.0)
    taper: Float1D = np.cos(0.5 * math.pi * np.clip(beyond, 0.0, 1.0)) ** 2
    return taper


def _rest_at_ends(count: int, rate_hz: float) -> Float1D:
    """Return a window that is 1 but for half a second at either end, where it rises from 0."""
    edge = np.arange(count) / (0.5 * rate_hz)
    return smoothstep(np.minimum(edge, edge[::-1]))
