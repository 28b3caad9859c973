"""Drive follower: locates measured samples in a drive that an external controller plays.

The follower is an immutable value and processes chunks that end at fixed samples, so its result
does not depend on how the samples are cut into blocks. Every sample gets a drive index. Before the
drive is found all samples are at rest, and they are released MAX_ONSET_DELAY_S late, because a soft
start is detected after it began.

The measured command is m(i) = gain d(i + offset + 1e-6 ppm (i - pivot)) + bias, where d is the
drive, its index a sample of the plan, and ppm the clock deviation of the controller. The search
correlates over a grid of offsets and refines the best one by Gauss-Newton; a Kalman filter of the
four parameters then tracks them chunk by chunk. The gain may wander, because the controller sets
the amplitude. No measured sample is ever moved or resampled: only its drive index is computed.
"""

from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from table_io.block import Float1D, Float2D, Int1D
from table_io.config.sensor import SensorConfig
from table_io.errors import InputError

MEAN_WINDOW_S = 0.02  # averages out noise and mains hum, but not motion
MAX_MOTION_SHARE = 0.01  # of the drive's peak displacement; less does not mask the drive


def format_alignment(follower: "DriveFollower") -> str:
    """Describe the alignment of the drive with the recording; empty if it was not found."""
    fit = follower.fit
    if fit is None:
        return ""
    start = fit.pivot - (fit.pivot + fit.offset) / (1.0 + 1e-6 * fit.ppm)
    is_playing = follower.state == "playing"
    precision = (
        f", the newest sample is located to +-{fit.drive_index_sd(follower.processed_end):.2g}"
        if is_playing
        else ""
    )
    return (
        f"{'' if is_playing else 'until the drive was lost: '}sample 0 of the drive is sample "
        f"{start:.2f} of the recording (+-{fit.drive_index_sd(round(start)):.2g}){precision}; "
        "the controller's clock deviates by "
        f"{fit.ppm:+.2f} ppm from the acquisition's (+-{fit.covariance[1, 1] ** 0.5:.2g}); its "
        f"command is {fit.gain:.4f} of the drive; correlation {fit.correlation:.5f}"
    )


def refuse_motion(
    tare_m: Float1D, sensor: SensorConfig, plan: "PlannedDrive", rate_hz: float
) -> None:
    """Raise InputError if the command in m moved during the tare, (sample,)."""
    size = max(round(MEAN_WINDOW_S * rate_hz), 1)
    means = tare_m[: tare_m.size // size * size].reshape(-1, size).mean(axis=1)
    known = means[~np.isnan(means)]
    motion = float(np.ptp(known)) if known.size else 0.0
    noise = NOISE_SIGMAS * sensor.noise_si
    rest_limit = noise + NOISE_LSB * 2 * sensor.range_si / 2**sensor.bits
    if motion <= rest_limit:
        return
    allowed = rest_limit + MAX_MOTION_SHARE * _peak_displacement(plan, rate_hz)
    if motion > allowed:
        raise InputError(
            f"moved by {motion * 1e3:.3g} mm in the second before the start: the controller is "
            "already playing, or its command is disturbed",
            key=sensor.channel,
            allowed=f"at most {allowed * 1e3:.3g} mm",
            remedy="bring it to rest, start `run` again and play the drive when prompted (NOW)",
        )


def _peak_displacement(plan: "PlannedDrive", rate_hz: float) -> float:
    """Return the peak displacement of the drive in m."""
    chunk = int(10 * rate_hz)
    starts = range(0, max(plan.rest_start, 1), chunk)
    return max(float(np.abs(plan.command(first, chunk)).max()) for first in starts)


SEARCH_S = 1.0  # on either side of the expected start of motion
GRID_HZ = 200.0  # of the search; the refinement uses every sample
MAX_ITERATIONS = 8
PRIOR_PPM_SD = 50.0  # standard deviation of an unknown clock
# Random walk per second, standard deviations: samples, ppm, gain, bias over the noise.
PROCESS_NOISE_SD = (3e-4, 3e-3, 5e-3, 3e-3)


class PlannedDrive(Protocol):
    """Interface of a drive that can be aligned."""

    def command(self, first: int, count: int) -> Float1D:
        """Return the displacement in m of samples first .. first + count - 1; 0 outside."""

    @property
    def rest_start(self) -> int:
        """Index from which the command is zero."""


@dataclass(frozen=True, eq=False)
class DriveAlignment:
    """Alignment: the four parameters, their covariance, the correlation and the residual noise."""

    offset: float  # samples
    ppm: float
    gain: float
    bias: float  # m
    pivot: int
    covariance: Float2D
    correlation: float
    noise: float  # rms residual of the measured command, m

    @property
    def parameters(self) -> Float1D:
        return np.array([self.offset, self.ppm, self.gain, self.bias])

    def drive_index(self, index: Int1D) -> Float1D:
        """Return the fractional drive index of measured samples, (sample,)."""
        return index + self.offset + 1e-6 * self.ppm * (index - self.pivot)

    def drive_index_sd(self, index: int) -> float:
        """Return the standard deviation of `drive_index` in samples."""
        row = np.array([1.0, 1e-6 * (index - self.pivot)])
        return float(np.sqrt(row @ self.covariance[:2, :2] @ row))


def interpolate_drive(plan: "PlannedDrive", position: Float1D) -> tuple[Float1D, Float1D]:
    """Interpolate (drive in m, slope in m per sample) at fractional indices, (sample,)."""
    low = int(np.floor(position.min())) - 2
    nearest = np.rint(position).astype(np.int64)
    d = plan.command(low, int(nearest.max()) - low + 3)
    k, fraction = nearest - low, position - nearest
    slope, bend = 0.5 * (d[k + 1] - d[k - 1]), d[k + 1] - 2.0 * d[k] + d[k - 1]
    # cubic through four neighbors, on the side of the index
    side = np.where(fraction >= 0, 1, -1)
    third = side * (d[k + 2 * side] - 3.0 * d[k + side] + 3.0 * d[k] - d[k - side])
    slope = slope - third / 6.0
    value = d[k] + fraction * (slope + fraction * (0.5 * bend + fraction * third / 6.0))
    return value, slope + fraction * (bend + 0.5 * fraction * third)


def find_motion_onset(plan: "PlannedDrive", threshold: float, rate_hz: float) -> int:
    """Return the first drive sample beyond the threshold in m; its end if there is none."""
    chunk, first = int(10 * rate_hz), 0
    while first < plan.rest_start:
        exceeding = np.flatnonzero(np.abs(plan.command(first, chunk)) > threshold)
        if exceeding.size:
            return first + int(exceeding[0])
        first += chunk
    return plan.rest_start


def fit_alignment(
    plan: "PlannedDrive",
    first: int,
    command_m: Float1D,
    expected_offset: float,
    rate_hz: float,
    lsb: float,
) -> DriveAlignment | None:
    """Fit the alignment to samples from `first`, (sample,) in m; None if they do not determine it.

    `expected_offset` in samples must be correct to SEARCH_S. A drive with inverted sign correlates
    with -1, and its fit has a negative gain.
    """
    index = first + np.flatnonzero(~np.isnan(command_m))
    m = command_m[index - first]
    if m.size < 8:
        return None
    offset, correlation = _search_offset(plan, index, m, expected_offset, rate_hz)
    gain, bias = 1.0, 0.0
    columns, normal, residual = np.ones((3, m.size)), np.eye(3), m
    for _ in range(MAX_ITERATIONS):
        d, slope = interpolate_drive(plan, np.asarray(index + offset, dtype=np.float64))
        columns = np.stack([slope, d, np.ones(m.size)])
        gain, bias = np.linalg.lstsq(columns[1:].T, m, rcond=None)[0]
        residual = m - gain * d - bias
        columns[0] *= gain
        normal = columns @ columns.T
        if not np.isfinite(normal).all() or np.linalg.cond(normal) > 1e30:
            return None
        step = float(np.linalg.solve(normal, columns @ residual)[0])
        offset += float(np.clip(step, -0.05 * rate_hz, 0.05 * rate_hz))
        if abs(step) < 1e-4:
            break
    noise = float(np.sqrt(np.mean(residual**2) + lsb**2 / 12.0))
    known_covariance = noise**2 * np.linalg.inv(normal)
    covariance = np.zeros((4, 4))
    covariance[np.ix_([0, 2, 3], [0, 2, 3])] = known_covariance
    covariance[1, 1] = PRIOR_PPM_SD**2
    # where the offset is known best: a clock error rotates about this sample
    pivot = round(float(columns[0] ** 2 @ index / (columns[0] ** 2).sum()))
    return DriveAlignment(
        offset, 0.0, float(gain), float(bias), pivot, covariance, correlation, noise
    )


def _search_offset(
    plan: "PlannedDrive", index: Int1D, m: Float1D, expected_offset: float, rate_hz: float
) -> tuple[float, float]:
    """Return (offset in samples, correlation) of the best match on the grid."""
    stride = max(round(rate_hz / GRID_HZ), 1)
    index, m = index[::stride], m[::stride]
    max_shift = round(SEARCH_S * rate_hz)
    offsets = round(expected_offset) + np.arange(-max_shift, max_shift + 1, stride)
    low = int(index[0] + offsets[0])
    d = plan.command(low, int(index[-1] + offsets[-1]) - low + 1)
    candidates = d[index[None, :] + offsets[:, None] - low]
    candidates = candidates - candidates.mean(axis=1, keepdims=True)
    m = m - m.mean()
    power = np.sqrt((candidates**2).sum(axis=1) * (m**2).sum())
    correlation = np.divide(candidates @ m, power, out=np.zeros(offsets.size), where=power > 0)
    best = int(np.abs(correlation).argmax())
    return float(offsets[best]), float(correlation[best])


def update_alignment(
    fit: DriveAlignment, plan: "PlannedDrive", first: int, command_m: Float1D, rate_hz: float
) -> DriveAlignment:
    """Update the alignment with a chunk of samples from `first`, (sample,) in m (Kalman filter)."""
    index = first + np.flatnonzero(~np.isnan(command_m))
    wander = np.array(PROCESS_NOISE_SD) * np.array([1.0, 1.0, 1.0, fit.noise])
    prior = fit.covariance + np.diag(wander**2) * command_m.size / rate_hz
    if index.size < command_m.size // 2:
        return replace(fit, covariance=prior)
    d, slope = interpolate_drive(plan, fit.drive_index(index))
    residual = command_m[index - first] - fit.gain * d - fit.bias
    columns = np.stack(
        [fit.gain * slope, 1e-6 * fit.gain * slope * (index - fit.pivot), d, np.ones(d.size)]
    )
    information = columns @ columns.T / fit.noise**2
    posterior: Float2D = np.linalg.inv(np.linalg.inv(prior) + information).astype(np.float64)
    change = posterior @ (columns @ residual) / fit.noise**2
    offset, ppm, gain, bias = (fit.parameters + change).tolist()
    return replace(fit, offset=offset, ppm=ppm, gain=gain, bias=bias, covariance=posterior)


def measure_deviation(
    fit: DriveAlignment, plan: "PlannedDrive", first: int, command_m: Float1D, rate_hz: float
) -> tuple[float, float]:
    """Return (rms deviation of a chunk from the drive, peak of the drive around it), both in m.

    NaN if the chunk is lost.
    """
    index = first + np.flatnonzero(~np.isnan(command_m))
    if index.size < command_m.size // 2:
        return np.nan, np.nan
    d, _ = interpolate_drive(plan, fit.drive_index(index))
    deviation = command_m[index - first] - fit.gain * d - fit.bias
    margin = round(rate_hz)
    drive_m = plan.command(int(fit.drive_index(index[:1])[0]) - margin, command_m.size + 2 * margin)
    return float(np.sqrt(np.mean(deviation**2))), float(np.abs(fit.gain * drive_m).max())


CHUNK_S = 0.25
MAX_ONSET_DELAY_S = 1.5  # longest time until a soft start is detected
# Of motion before the first and the last attempt to find it in the drive.
MIN_SEARCH_S = 1.0
MAX_SEARCH_S = 3.0
MAX_OFFSET_SD = 0.05  # of a sample: accept the fit before the last attempt
MIN_CORRELATION = 0.9  # below this it is another drive
MAX_DEVIATION_RATIO = 0.3  # deviation over the drive's amplitude; above, it is not the drive
MAX_CLOCK_PPM = 500.0  # larger than any clock error, so the motion is not the drive
NOISE_SIGMAS, NOISE_LSB = 6.0, 4.0  # threshold: multiple of the noise plus converter steps
REST_INDEX = -1  # drive index of a sample before the drive
QUIET_S = 0.4  # a stepped sine never pauses for this long


@dataclass(frozen=True, eq=False)
class DriveFollower:
    """State of the follower before sample `end`; `command_m` starts at sample `first`."""

    plan: PlannedDrive
    rate_hz: float
    sigma_m: float  # noise of the command at rest
    lsb_m: float  # converter step of the measured command
    state: str = "waiting"  # then playing, left (deviated from the drive) or other (another drive)
    fit: DriveAlignment | None = None
    clean_fit: DriveAlignment | None = None  # after the last chunk that deviated by noise only
    reason: str = ""  # why the motion is not the drive
    lost_at: int = 0  # sample from which it is not the drive
    deviation_m: tuple[float, float] = (0.0, 0.0)  # (deviation, limit)
    onset: int | None = None  # sample at which motion was detected
    processed_end: int = 0  # end of the processed samples
    first: int = 0
    command_m: Float1D = field(default_factory=lambda: np.empty(0))
    drive_indices: Int1D = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    taken_end: int = 0  # end of the samples whose drive index was taken

    @property
    def end(self) -> int:
        return self.first + self.command_m.size

    @property
    def chunk_samples(self) -> int:
        return round(CHUNK_S * self.rate_hz)

    @property
    def threshold_m(self) -> float:
        """Deviation from rest in m beyond which the command moves."""
        return NOISE_SIGMAS * self.sigma_m + NOISE_LSB * self.lsb_m

    @property
    def located_end(self) -> int:
        """End of the samples whose drive index is known."""
        return self.taken_end + self.drive_indices.size

    @property
    def is_quiet(self) -> bool:
        """True if the command has been still for QUIET_S."""
        last = self.command_m[-round(QUIET_S * self.rate_hz) :]
        known = last[~np.isnan(last)]
        if last.size < QUIET_S * self.rate_hz:
            return False
        return not known.size or float(np.ptp(known)) <= 2.0 * self.threshold_m

    @property
    def is_still(self) -> bool:
        """True if the command is at rest for good.

        While the drive is searched for it moves; while it is played it also rests in between.
        """
        if self.state == "waiting":
            return self.onset is None
        if self.state == "playing" and self.fit is not None:
            place = float(self.fit.drive_index(np.array([self.processed_end]))[0])
            return self.is_quiet and place >= self.plan.rest_start
        return self.is_quiet


def advance_follower(follower: DriveFollower, command_m: Float1D) -> DriveFollower:
    """Advance the follower by samples of the measured command in m, (sample,); NaN = lost."""
    follower = replace(follower, command_m=np.concatenate([follower.command_m, command_m]))
    while follower.end - follower.processed_end >= follower.chunk_samples:
        follower = _process_chunk(follower)
    kept_samples = (
        round((MAX_ONSET_DELAY_S + MAX_SEARCH_S) * follower.rate_hz) + 2 * follower.chunk_samples
    )
    dropped_samples = max(follower.command_m.size - kept_samples, 0)
    return replace(
        follower,
        command_m=follower.command_m[dropped_samples:],
        first=follower.first + dropped_samples,
    )


def take_drive_indices(follower: DriveFollower, count: int) -> tuple[DriveFollower, Int1D]:
    """Return (follower, drive indices of the next `count` samples); ValueError if unknown."""
    if follower.taken_end + count > follower.located_end:
        raise ValueError(
            f"drive indices are known up to sample {follower.located_end}, "
            f"not up to {follower.taken_end + count}"
        )
    remaining = replace(
        follower, drive_indices=follower.drive_indices[count:], taken_end=follower.taken_end + count
    )
    return remaining, follower.drive_indices[:count]


def flush_follower(follower: "DriveFollower") -> DriveFollower:
    """Locate all remaining samples at the end of the recording."""
    return _locate_samples(follower, follower.end)


def _process_chunk(follower: "DriveFollower") -> DriveFollower:
    """Process the next chunk: search, or compare with the drive and update the alignment."""
    first, end = follower.processed_end, follower.processed_end + follower.chunk_samples
    chunk = follower.command_m[first - follower.first : end - follower.first]
    follower = replace(follower, processed_end=end)
    if follower.state == "waiting":
        return _search_drive(follower, first, chunk)
    if follower.state == "playing":
        fit = follower.fit
        assert fit is not None
        deviation, swing = measure_deviation(fit, follower.plan, first, chunk, follower.rate_hz)
        limit = (
            MAX_DEVIATION_RATIO * swing
            + NOISE_SIGMAS * max(fit.noise, follower.sigma_m)
            + NOISE_LSB * follower.lsb_m
        )
        updated = update_alignment(fit, follower.plan, first, chunk, follower.rate_hz)
        reason, exceedance = _describe_mismatch(updated), (deviation, limit)
        if deviation > limit:
            reason = (
                f"the command is {deviation * 1e3:.3g} mm (rms) off the drive from sample "
                f"{first} on; allowed: {limit * 1e3:.3g} mm"
            )
        elif abs(updated.ppm) > MAX_CLOCK_PPM:
            reason = (
                f"the command is {deviation * 1e3:.3g} mm (rms) off the drive from sample "
                f"{first} on, with a clock deviation of {updated.ppm:+.0f} ppm; allowed: "
                f"{MAX_CLOCK_PPM:g} ppm"
            )
        elif abs(updated.gain - 1.0) > MAX_DEVIATION_RATIO and swing > 0.0:
            drive_m = swing / abs(fit.gain)
            exceedance = abs(updated.gain - 1.0) * drive_m, MAX_DEVIATION_RATIO * drive_m
        if reason:
            last_good = follower.clean_fit or fit  # later fits were drawn away from the drive
            follower = replace(
                follower,
                state="left",
                reason=reason,
                lost_at=first,
                deviation_m=exceedance,
                fit=last_good,
            )
        else:
            noise = NOISE_SIGMAS * max(fit.noise, follower.sigma_m) + NOISE_LSB * follower.lsb_m
            follower = replace(
                follower,
                fit=updated,
                clean_fit=updated if deviation <= noise else follower.clean_fit,
            )
    return _locate_samples(follower, end + follower.chunk_samples)


def _search_drive(follower: DriveFollower, first: int, chunk: Float1D) -> DriveFollower:
    """Search for the drive in a chunk: detect the onset of motion, then fit the alignment."""
    if follower.onset is None:
        filtered = np.median([chunk[:-2], chunk[1:-1], chunk[2:]], axis=0)  # ignore spikes
        moving_samples = np.flatnonzero(
            np.abs(filtered - _rest_level(follower)) > follower.threshold_m
        )
        if not moving_samples.size:
            return _locate_samples(
                follower, follower.processed_end - round(MAX_ONSET_DELAY_S * follower.rate_hz)
            )
        follower = replace(follower, onset=first + 1 + int(moving_samples[0]))
    assert follower.onset is not None
    motion_s = (follower.processed_end - follower.onset) / follower.rate_hz
    if motion_s < MIN_SEARCH_S:
        return follower
    start = max(follower.first, follower.onset - round(MAX_ONSET_DELAY_S * follower.rate_hz))
    command_m = follower.command_m[start - follower.first : follower.processed_end - follower.first]
    expected_offset = (
        find_motion_onset(follower.plan, follower.threshold_m, follower.rate_hz) - follower.onset
    )
    fit = fit_alignment(
        follower.plan, start, command_m, expected_offset, follower.rate_hz, follower.lsb_m
    )
    correlates = fit is not None and fit.correlation >= MIN_CORRELATION
    mismatch = _describe_mismatch(fit) if fit is not None and correlates else ""
    accepted = fit if correlates and not mismatch else None
    if accepted is not None and (
        accepted.drive_index_sd(accepted.pivot) <= MAX_OFFSET_SD or motion_s >= MAX_SEARCH_S
    ):
        playing = replace(follower, state="playing", fit=accepted, clean_fit=accepted)
        return _locate_samples(playing, follower.processed_end + follower.chunk_samples)
    if motion_s < MAX_SEARCH_S:
        return follower
    correlation = fit.correlation if fit is not None else 0.0
    reason = (
        f"the motion since sample {follower.onset} is not this drive "
        f"(correlation {correlation:.2f})"
    )
    if correlation <= -MIN_CORRELATION:
        reason = f"the drive is played with inverted sign (correlation {correlation:.2f})"
    reason = mismatch or reason
    follower = replace(follower, state="other", reason=reason, lost_at=follower.onset)
    return _locate_samples(follower, follower.processed_end + follower.chunk_samples)


def _describe_mismatch(fit: DriveAlignment) -> str:
    """Describe an amplitude that is not that of the drive; empty if it is within limits."""
    if abs(fit.gain - 1.0) > MAX_DEVIATION_RATIO + 3.0 * fit.covariance[2, 2] ** 0.5:
        return (
            f"the amplitude is {fit.gain:.3g} of the drive's; allowed: "
            f"{1.0 - MAX_DEVIATION_RATIO:.2g} to {1.0 + MAX_DEVIATION_RATIO:.2g}"
        )
    return ""


def _rest_level(follower: "DriveFollower") -> float:
    """Return the command at rest in m: the median of the earlier samples."""
    rest_m = follower.command_m[
        : max(
            follower.processed_end - follower.chunk_samples - follower.first,
            round(0.1 * follower.rate_hz),
        )
    ]
    known = rest_m[~np.isnan(rest_m)]
    return float(np.median(known)) if known.size else 0.0


def _locate_samples(follower: DriveFollower, end: int) -> DriveFollower:
    """Compute the drive indices of the samples before `end`."""
    index = np.arange(follower.located_end, end)
    if not index.size:
        return follower
    if follower.fit is None:
        places = np.full(index.size, REST_INDEX)
    else:
        places = np.rint(follower.fit.drive_index(index)).astype(np.int64)
        if follower.drive_indices.size:  # an improved fit must not go back in the drive
            places = np.maximum(places, follower.drive_indices[-1])
    return replace(follower, drive_indices=np.concatenate([follower.drive_indices, places]))
