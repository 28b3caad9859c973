"""Judgement of a table's twin on motion that it was not fitted to, and what a log must be for it.

A twin is compared with three baselines in the band in which the table follows its command at all:
the late command, the late command with a gain, both with the best values of the judged log itself,
and a smooth frequency response from the fitted logs. Structures from a delay to the hydraulic table
are fitted with parts of the time left out, and the simplest that is not worse is used.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from scipy import signal

from table_io.block import Float1D, Int1D
from table_io.errors import InputError
from twin.compare.quality import find_bad_samples
from twin.earthquakes.result import HYDRAULIC, ChannelEstimate, JudgedErrors, JudgedRun, Judgement
from twin.earthquakes.table_effects import LIBRARY
from twin.earthquakes.table_identification import (
    BOUNDS,
    HIGHEST_HZ,
    MAX_WORSE_RATIO,
    MIN_DURATION_S,
    TableFit,
    TableRehearsal,
    build_parameters,
)
from twin.earthquakes.table_model import TableModel
from twin.earthquakes.table_response import (
    ESTIMATED_FRICTION,
    FRICTION_TERMS,
    LAST_LAG_S,
    STRUCTURES,
    BandProjection,
    PredictiveModel,
    ResponseData,
    ResponseRegression,
    ResponseStructure,
    find_delay,
    find_resonance,
    measure_held_out,
)

LOWEST_HZ = 0.3  # of a band
MAX_RATE_SHARE = 0.4  # of the sampling rate, that a band may reach
SEGMENT_S = 5.0  # of the estimate of the coherence
FREQUENCY_STEP_HZ = 0.02  # at which it is read, so that each third octave has values
SEGMENT_SHARE = 0.95  # of half overlapping Hann segments that count as independent
OCTAVE, THIRD_OCTAVE = 2.0, 2.0 ** (1.0 / 3.0)
# Least coherence, less its bias, at which anything is promised: share of the power of the motion.
MIN_COHERENCE = 0.3
MAX_FOREIGN_SHARE = 0.5  # of the power of the table's acceleration that is not the command's
RESONANT_WIDTH_HZ = 0.5  # on either side of a peak that is no command's
MAX_HYDRAULIC_S = 180.0  # of logs to which the hydraulic table is fitted, at half a second each
PART_COUNT = 4  # of a single log, that are left out in turn
PIECE_COUNT = 4  # of each of them, whose scatter says how sure a gain is
MIN_CORRELATION = 0.7  # of channels of one motion, by size: less says nothing of sign and lag
MAX_LAG_S, SEARCHED_LAG_S = 0.5, 5.0  # of a slow table, and of a log on two clocks
ESTIMATE_ROUNDS = 3  # of the friction at the estimated speed, after which it moves no more
GAIN_LIMITS = 0.2, 5.0  # of displacement over command
ACCELEROMETER_LIMITS = 0.7, 1.4  # of acceleration over the derivative of the displacement
ACCELEROMETER_BAND_HZ = 0.8, 5.0  # where both are usually well above their noise
MAX_ERROR = 1e3  # that is stated: a twin that diverges


@dataclass(frozen=True, eq=False)
class NamedMotion:
    """Motion of a table, the name of the log that it is from, and its further channels."""

    log: str
    motion: TableRehearsal
    channels: Mapping[str, Float1D] = field(default_factory=dict)


def check_motion(named: NamedMotion) -> None:
    """Raise InputError with the cause if a log can neither fit nor judge a twin of its table."""
    motion, log = named.motion, named.log
    seconds = motion.command_m.size / motion.rate_hz
    if seconds < MIN_DURATION_S:
        raise InputError(
            f"{seconds:.1f} s of motion say too little of a table",
            where=log,
            allowed=f"at least {MIN_DURATION_S:g} s",
        )
    command, displacement = (row - row[0] for row in (motion.command_m, motion.displacement_m))
    for row, channel in ((command, "drive_disp_m"), (displacement, "table_disp_m")):
        if not np.ptp(row) > 0.0:
            raise InputError("does not change: the table rests", where=log, key=channel)
    rows = {"drive_disp_m": command, "table_disp_m": displacement}
    if motion.has_accelerometer:
        rows["table_acc_m_s2"] = motion.acceleration_m_s2
    for gap in find_bad_samples(rows, rows):
        raise InputError(
            f"is {gap.reason} from {gap.index / motion.rate_hz:.1f} s of the motion",
            where=log,
            key=gap.channel,
            remedy="leave that part out at the import, or record the motion again in the range of "
            "the sensor",
        )
    correlation, lag_s = _correlate(command, displacement, motion.rate_hz)
    if correlation < -MIN_CORRELATION:
        raise InputError(
            f"is reversed: its correlation with the command is {correlation:.2f}",
            where=log,
            key="table_disp_m",
            remedy="change the sign of this channel or that of drive_disp_m",
        )
    if correlation > MIN_CORRELATION and abs(lag_s) > MAX_LAG_S:
        raise InputError(
            f"is {lag_s:.2f} s late behind the command: the two are not of one clock",
            where=log,
            key="table_disp_m",
            allowed=f"up to {MAX_LAG_S:g} s",
            remedy="align the channels before the import",
        )
    gain = float(np.std(displacement) / np.std(command))
    if correlation > 0.9 and not GAIN_LIMITS[0] < gain < GAIN_LIMITS[1]:
        raise InputError(
            f"is {gain:.3g} times the command",
            where=log,
            key="table_disp_m",
            remedy="state the unit of both displacements, or correct the span",
        )
    if motion.has_accelerometer:
        _check_accelerometer(named)


def _correlate(command: Float1D, displacement: Float1D, rate_hz: float) -> tuple[float, float]:
    """Return the correlation of largest size of two motions and its lag in s, positive if late."""
    first, second = (row - row.mean() for row in (command, displacement))
    correlation = signal.correlate(second, first, "same") / np.sqrt(first @ first * second @ second)
    lags = np.arange(first.size) - first.size // 2
    correlation[np.abs(lags) > SEARCHED_LAG_S * rate_hz] = 0.0
    best = int(np.argmax(np.abs(correlation)))
    return float(correlation[best]), float(lags[best] / rate_hz)


def _check_accelerometer(named: NamedMotion) -> None:
    """Raise InputError if the accelerometer is not that of the measured displacement."""
    motion = named.motion
    projection = BandProjection(motion.command_m.size, motion.rate_hz, ACCELEROMETER_BAND_HZ)
    expected = projection.to_rows(projection.differentiate(motion.displacement_m))
    spectrum = np.fft.rfft(motion.acceleration_m_s2, projection.size)[projection.used]
    measured = projection.to_rows(spectrum)
    size = float(np.linalg.norm(expected) * np.linalg.norm(measured))
    correlation = float(expected @ measured) / max(size, 1e-300)
    gain = float(np.linalg.norm(measured) / max(float(np.linalg.norm(expected)), 1e-300))
    if correlation < -MIN_CORRELATION:
        raise InputError(
            f"is reversed: its correlation with the displacement's second derivative is "
            f"{correlation:.2f}",
            where=named.log,
            key="table_acc_m_s2",
            remedy="change the sign of this channel",
        )
    low, high = ACCELEROMETER_LIMITS
    if correlation > 0.8 and not low < gain < high:
        raise InputError(
            f"is {gain:.3g} times the second derivative of the displacement",
            where=named.log,
            key="table_acc_m_s2",
            remedy="state its unit, or correct its sensitivity",
        )


def find_predictable_band(logs: Sequence[NamedMotion]) -> tuple[float, float]:
    """Return the band in Hz in which the tables of logs follow their commands.

    It is that of the third octaves round the most coherent one whose coherence, less its bias, is
    at least MIN_COHERENCE. InputError if most of the motion is not the command's.
    """
    highest_hz = min(HIGHEST_HZ, *(MAX_RATE_SHARE * log.motion.rate_hz for log in logs))
    edges_hz = np.array([LOWEST_HZ])
    while edges_hz[-1] * THIRD_OCTAVE <= highest_hz:
        edges_hz = np.append(edges_hz, edges_hz[-1] * THIRD_OCTAVE)
    frequency_hz = np.arange(LOWEST_HZ, edges_hz[-1], FREQUENCY_STEP_HZ)
    cross = np.zeros(frequency_hz.size, complex)
    powers, segments = np.zeros((2, frequency_hz.size)), 0.0
    for log in logs:
        motion = log.motion
        projection = BandProjection(motion.command_m.size, motion.rate_hz, (0.2, highest_hz))
        measured = projection.to_rows(_transform(projection, motion))
        commanded = projection.to_rows(projection.differentiate(motion.command_m))
        rate_hz = measured.size * motion.rate_hz / motion.command_m.size
        length = round(SEGMENT_S * rate_hz)
        segments += SEGMENT_SHARE * (2.0 * measured.size / length - 1.0)
        share = 1.0 / float(measured @ measured)
        hz, own_cross = signal.csd(commanded, measured, rate_hz, nperseg=length)
        cross += share * np.interp(frequency_hz, hz, own_cross)
        for row, motion_row in enumerate((commanded, measured)):
            power = signal.welch(motion_row, rate_hz, nperseg=length)[1]
            powers[row] += share * np.interp(frequency_hz, hz, power)
    coherence = np.abs(cross) ** 2 / np.maximum(powers[0] * powers[1], 1e-300)
    coherence = np.clip(coherence - (1.0 - coherence) ** 2 / segments, 0.0, 1.0)
    octave = np.searchsorted(edges_hz, frequency_hz, side="right") - 1
    means = np.array([coherence[octave == k].mean() for k in range(edges_hz.size - 1)])
    follows = means >= MIN_COHERENCE
    foreign = (1.0 - coherence) * powers[1]
    _refuse_resonance(logs, frequency_hz, foreign, powers[1])
    first = last = int(np.argmax(means))
    share = 1.0
    if follows[first]:
        while first > 0 and follows[first - 1]:
            first -= 1
        while last + 1 < means.size and follows[last + 1]:
            last += 1
        # Far above the band a displacement's derivative is noise, of which nothing is promised.
        near = frequency_hz <= OCTAVE * edges_hz[last + 1]
        share = foreign[near].sum() / powers[1, near].sum()
    if share > MAX_FOREIGN_SHARE:
        raise InputError(
            f"{100.0 * share:.0f} % of the power of the table's acceleration is not the command's: "
            "it is mostly noise, or the channels are not of one run",
            where=", ".join(log.log for log in logs),
            allowed=f"at most {100.0 * MAX_FOREIGN_SHARE:.0f} %",
        )
    return float(round(edges_hz[first], 3)), float(round(edges_hz[last + 1], 3))


def _refuse_resonance(
    logs: Sequence[NamedMotion], frequency_hz: Float1D, foreign: Float1D, power: Float1D
) -> None:
    """Raise InputError if most of the power is in a narrow band and is not the command's."""
    peak_hz = float(frequency_hz[int(np.argmax(foreign))])
    near = np.abs(frequency_hz - peak_hz) <= RESONANT_WIDTH_HZ
    share = foreign[near].sum() / power.sum()
    elsewhere = foreign[~near].sum() / power[~near].sum()
    if share > MAX_FOREIGN_SHARE > elsewhere:
        peak_hz = float(np.average(frequency_hz[near], weights=foreign[near]))
        raise InputError(
            f"the specimen or the loop shakes the table at {peak_hz:.1f} Hz, where the command "
            f"does not: {100.0 * share:.0f} % of the power of its acceleration",
            where=", ".join(log.log for log in logs),
            allowed=f"at most {100.0 * MAX_FOREIGN_SHARE:.0f} %",
        )


def _transform(projection: BandProjection, motion: TableRehearsal) -> npt.NDArray[np.complex128]:
    """Return the spectrum of the measured acceleration in the band, (frequency,)."""
    acceleration = motion.acceleration_m_s2 if motion.has_accelerometer else None
    return projection.transform_motion(motion.displacement_m, acceleration)


@dataclass(frozen=True, eq=False)
class StructureTrial:
    """A structure fitted to logs: its model, its order of preference and what it leaves, held out.

    `held_out` is the acceleration that it leaves of each log, (row,), by fits without the part.
    """

    id: str
    model: PredictiveModel
    held_out: tuple[Float1D, ...]
    error: float


def prepare_data(logs: Sequence[NamedMotion], band_hz: tuple[float, float]) -> list[ResponseData]:
    """Return the logs in a band with the parts that are left out in turn.

    These are whole logs, or PART_COUNT stretches of time of a single one, of equal energy.
    """
    data = []
    for number, log in enumerate(logs):
        motion = log.motion
        projection = BandProjection(motion.command_m.size, motion.rate_hz, band_hz)
        spectrum = _transform(projection, motion)
        measured = projection.to_rows(spectrum)
        part = np.full(measured.size, number)
        if len(logs) == 1:
            part = _cut_by_energy(measured, PART_COUNT)
        data.append(ResponseData(projection, motion.command_m, spectrum, part, log.channels))
    return data


def fit_responses(data: Sequence[ResponseData]) -> list[StructureTrial]:
    """Return the fits of all structures of a response, from the simplest to the richest."""
    delay_s = find_delay(data)
    resonance = find_resonance(data, delay_s)
    trials = []
    for structure in STRUCTURES:
        regression = ResponseRegression.from_data(structure, data, delay_s, resonance)
        held_out = regression.held_out
        error = measure_held_out(held_out, data)
        trials.append(StructureTrial(structure.id, regression.build_model(), held_out, error))
    return trials


def try_hydraulic_fit(
    fit: TableFit, logs: Sequence[NamedMotion], data: Sequence[ResponseData]
) -> StructureTrial:
    """Return the hydraulic twin with what it leaves of each part by a fit without that part.

    That fit is one Gauss-Newton step from the parameters of all parts. It is given the measured
    force of the specimen.
    """
    bounds = dict(BOUNDS)
    for effect in LIBRARY:
        bounds |= effect.bounds
    low, high = (np.array([bounds[name][k] for name in fit.names]) for k in (1, 2))
    count = sum(log.motion.command_m.size for log in logs)
    block_rows = fit.problem.block.size - 1
    left = [log.measured_rows.copy() for log in data]
    start = 0
    for number, (log, own) in enumerate(zip(logs, data, strict=True)):
        size = log.motion.command_m.size
        for part in np.unique(own.part):
            # Rows of the fit's residuals that lie in the time of this part of this log.
            inside = np.flatnonzero(own.part == part)
            first, last = (
                (start + size * edge / own.part.size) / count * block_rows
                for edge in (inside[0], inside[-1] + 1)
            )
            is_left_out = np.zeros(block_rows + 1, bool)
            is_left_out[math.ceil(first) : math.floor(last)] = True
            values = np.clip(fit.values + fit.step_without(is_left_out), low, high)
            parameters = build_parameters(fit.names, values, fit.problem)
            model = TableModel(fit.problem.mass_kg, parameters)
            left[number][inside] -= _predict(model, log.motion, own)[inside]
        start += size
    model = TableModel(fit.problem.mass_kg, fit.parameters)
    return StructureTrial(HYDRAULIC, model, tuple(left), measure_held_out(left, data))


def choose_structure(
    trials: Sequence[StructureTrial], data: Sequence[ResponseData]
) -> StructureTrial:
    """Return the simplest structure that is not worse on held-out time than the best.

    Of those that gain on the delay in every part that was left out, by more than the standard error
    of that gain: what helps in some of its own parts only promises nothing for another run.
    """
    delay = next(trial for trial in trials if trial.id == "pure_delay")
    kept = [trial for trial in trials if trial is delay or _gains_everywhere(trial, delay, data)]
    best = min(trial.error for trial in kept)
    return next(trial for trial in kept if trial.error <= MAX_WORSE_RATIO * best)


def _gains_everywhere(
    trial: StructureTrial, delay: StructureTrial, data: Sequence[ResponseData]
) -> bool:
    """Return True if a structure leaves less than the delay of each part, by a standard error.

    It is that of the sum over PIECE_COUNT pieces of the part, of equal energy, by their scatter.
    """
    for own, left, late in zip(data, trial.held_out, delay.held_out, strict=True):
        for part in np.unique(own.part):
            rows = own.part == part
            piece = _cut_by_energy(own.measured_rows[rows], PIECE_COUNT)
            gains = np.bincount(piece, (late**2 - left**2)[rows], PIECE_COUNT)
            if not gains.sum() > math.sqrt(PIECE_COUNT) * gains.std(ddof=1):
                return False
    return True


def _cut_by_energy(measured: Float1D, count: int) -> Int1D:
    """Return the number of each row, (row,), in so many stretches of equal energy."""
    energy = np.cumsum(measured**2)
    return np.minimum((count * energy / energy[-1]).astype(int), count - 1)


def join_motions(logs: Sequence[NamedMotion]) -> TableRehearsal | None:
    """Return the motions of logs one after the other, each from rest to rest.

    None if they have no accelerometer, different sampling rates, or more than MAX_HYDRAULIC_S.
    """
    motions = [log.motion for log in logs]
    rates_hz = {motion.rate_hz for motion in motions}
    seconds = sum(motion.command_m.size / motion.rate_hz for motion in motions)
    if (
        len(rates_hz) > 1
        or seconds > MAX_HYDRAULIC_S
        or not all(motion.has_accelerometer for motion in motions)
    ):
        return None
    command, displacement, acceleration, reaction = (
        np.concatenate(rows)
        for rows in zip(*((m.command_m, m.displacement_m, m.acceleration_m_s2, m.reaction_n)
                          for m in motions), strict=True)
    )  # fmt: skip
    return TableRehearsal(motions[0].rate_hz, command, displacement, acceleration, reaction)


def judge_fitted_logs(
    chosen: StructureTrial,
    trials: Sequence[StructureTrial],
    logs: Sequence[NamedMotion],
    data: Sequence[ResponseData],
) -> Judgement:
    """Return the judgement of a twin by the parts of its own logs that were left out in turn."""
    frf = next(trial for trial in trials if trial.id == "frf")
    left = zip(chosen.held_out, frf.held_out, strict=True)
    on = "parts of the fitted logs, left out in turn"
    return _build_judgement(chosen, trials, logs, data, left, on)


def judge_other_logs(
    chosen: StructureTrial,
    trials: Sequence[StructureTrial],
    logs: Sequence[NamedMotion],
    data: Sequence[ResponseData],
) -> Judgement:
    """Return the judgement of a twin by logs that were not fitted."""
    frf = next(trial for trial in trials if trial.id == "frf")
    left = (
        (
            own.measured_rows - _predict(chosen.model, log.motion, own),
            own.measured_rows - _predict(frf.model, log.motion, own),
        )
        for log, own in zip(logs, data, strict=True)
    )
    return _build_judgement(chosen, trials, logs, data, left, "other logs")


def estimate_with_channels(
    data: Sequence[ResponseData], judges: Sequence[ResponseData]
) -> ChannelEstimate | None:
    """Return how well the acceleration follows from command and further measured channels.

    On the judging data, or without any on parts of the fitted one that were left out. These
    channels are measurements of the motion itself, so that this is no prediction: it says how much
    of what a twin leaves is the reaction of what stands on the table. Other than the command, they
    follow the motion as well as precede it, so that the lags have both signs, and they give the
    speed on which the friction acts, in ESTIMATE_ROUNDS. None without such channels.
    """
    names = set.intersection(*(set(log.channels) for log in (*data, *judges)))
    if not names:
        return None
    channels = tuple(sorted(names))
    terms: tuple[str, ...] = (*FRICTION_TERMS, *channels)
    delay_s = find_delay(data)
    for _ in range(ESTIMATE_ROUNDS):
        structure = ResponseStructure("estimate", "with channels", terms, first_lag_s=-LAST_LAG_S)
        regression = ResponseRegression.from_data(structure, data, delay_s)
        held_out, left = regression.held_out, [regression.leave(log) for log in judges]
        data, judges = (
            [log.add_estimated_friction(own, delay_s) for log, own in zip(logs, rest, strict=True)]
            for logs, rest in ((data, held_out), (judges, left))
        )
        terms = (*FRICTION_TERMS, *ESTIMATED_FRICTION, *channels)
    errors = (
        _round_error(float(np.linalg.norm(rest) / np.linalg.norm(log.measured_rows)))
        for rest, log in zip(left or held_out, judges or data, strict=True)
    )
    return ChannelEstimate(channels=channels, errors=tuple(errors))


def _predict(model: PredictiveModel, motion: TableRehearsal, data: ResponseData) -> Float1D:
    """Return the acceleration that a twin predicts in the band in m/s2, (row,)."""
    out = model.simulate(motion.command_m, motion.rate_hz, motion.reaction_n)
    if not np.isfinite(out).all():
        return np.full(data.part.size, np.inf)
    acceleration = out[1] if motion.has_accelerometer else None
    return data.projection.to_rows(data.projection.transform_motion(out[0], acceleration))


def _judge_run(
    log: NamedMotion, data: ResponseData, left: Float1D, left_by_frf: Float1D
) -> JudgedRun:
    """Return the errors of a twin and of the baselines on one log."""
    measured = data.measured_rows
    late = data.delay_command(find_delay([data]))
    gain = float(late @ measured) / float(late @ late)
    residuals = {
        "twin": left,
        "pure_delay": measured - late,
        "delay_gain": measured - gain * late,
        "frf": left_by_frf,
    }
    size = float(np.linalg.norm(measured))
    errors = {
        name: _round_error(float(np.linalg.norm(residual)) / size)
        for name, residual in residuals.items()
    }
    return JudgedRun(
        log=log.log, band_hz=data.projection.band_hz, error=JudgedErrors.model_validate(errors)
    )


def _build_judgement(
    chosen: StructureTrial,
    trials: Sequence[StructureTrial],
    logs: Sequence[NamedMotion],
    data: Sequence[ResponseData],
    left: Iterable[tuple[Float1D, Float1D]],
    on: str,
) -> Judgement:
    """Return a judgement by what the twin and the frequency response leave of each log."""
    runs = [_judge_run(log, own, *both) for log, own, both in zip(logs, data, left, strict=True)]
    return Judgement(
        structure=chosen.id,
        on=on,
        held_out={trial.id: _round_error(trial.error) for trial in trials},
        runs=tuple(runs),
    )


def _round_error(error: float) -> float:
    """Return an error as it is stated, with five digits; a twin may diverge."""
    return float(f"{min(error, MAX_ERROR):.5g}")
