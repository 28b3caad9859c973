"""Drive follower: locates measured samples in a drive that an external controller plays.

The follower is an immutable value and processes chunks that end at fixed samples, so its result
does not depend on how the samples are cut into blocks. Every sample gets a drive index. Before the
drive is found all samples are at rest, and they are released MAX_ONSET_DELAY_S late, because a soft
start is detected after it began.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from table_io.acquisition.drive_alignment import (
    DriveAlignment,
    PlannedDrive,
    find_motion_onset,
    fit_alignment,
    measure_deviation,
    update_alignment,
)
from table_io.block import Float1D, Int1D

CHUNK_S = 0.25
MAX_ONSET_DELAY_S = 1.5  # longest time until a soft start is detected
MIN_SEARCH_S, MAX_SEARCH_S = (
    1.0,
    3.0,
)  # of motion before the first and the last attempt to find it in the drive
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


def flush_follower(follower: DriveFollower) -> DriveFollower:
    """Locate all remaining samples at the end of the recording."""
    return _locate_samples(follower, follower.end)


def _process_chunk(follower: DriveFollower) -> DriveFollower:
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


def _rest_level(follower: DriveFollower) -> float:
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
