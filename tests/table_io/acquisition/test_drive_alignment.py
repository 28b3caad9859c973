"""A follower finds a drive in a measured command, keeps its place, and sees when it is left."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from table_io.acquisition.drive_follower import (
    REST_INDEX,
    DriveFollower,
    advance_follower,
    fit_alignment,
    format_alignment,
    interpolate_drive,
    take_drive_indices,
)
from table_io.block import Float1D, Int1D
from table_io.config.base import load_config
from table_io.config.folders import find_config
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig
from table_io.excitation.drive import Drive
from table_io.sequencer.procedure import make_test_plan, nominal_drive
from table_io.sim.opendaq import DrivePlayback
from tests.builders.drives import sine_segments

RATE_HZ = 2000.0
LSB = 2 * 0.06 / 2**24
DRIVE_START_SAMPLE = 5000.37
SWEEP = {"start_hz": 2.4, "stop_hz": 2.8, "step_hz": 0.2, "cycles": 3, "directions": ["forward"]}
SLOW = {"start_hz": 0.5, "stop_hz": 0.6, "step_hz": 0.1, "cycles": 3, "directions": ["forward"]}


def plan_drive(sweep: dict[str, object], check: bool) -> Drive:
    profile, _ = load_config(find_config("quickstart", "tests"), Profile, "profile")
    rig, _ = load_config(find_config("follow_simulated", "rigs"), RigConfig, "card")
    raw = profile.model_dump() | {"excitation": {**sweep, "measured_cycles": 2}}
    raw["loop_check"] = {"enabled": check}
    return nominal_drive(make_test_plan(Profile.model_validate(raw), rig))


@pytest.fixture(scope="module")
def drive() -> Drive:
    return plan_drive(SWEEP, check=False)


@dataclass(frozen=True)
class Acquisition:
    """A measured command, m, and where each sample truly lies in the drive."""

    command: Float1D
    place: np.ndarray


def acquire(
    drive: Drive, seconds: float = 0.0, ppm: float = 0.0, noise: float = 0.0
) -> Acquisition:
    """What is acquired while a controller plays the drive; noise is a share of its amplitude."""
    file = drive.command(0, drive.rest_start + 1000)
    count = round(seconds * RATE_HZ) or int(DRIVE_START_SAMPLE) + file.size + 2000
    played = DrivePlayback(file, RATE_HZ, RATE_HZ, DRIVE_START_SAMPLE, ppm)
    clean = np.concatenate(
        [played.command(at, min(5000, count - at)) for at in range(0, count, 5000)]
    )
    sigma = noise * np.abs(file).max()
    draw = np.random.default_rng(7).standard_normal(count)
    place = (np.arange(count) - DRIVE_START_SAMPLE) * played.values_per_sample
    return Acquisition(np.rint((clean + sigma * draw + 2e-5) / LSB) * LSB, place)


def follow_drive(
    drive: Drive, command: Float1D, noise_m: float = 0.0, block: int = 20
) -> DriveFollower:
    follower = DriveFollower(drive, RATE_HZ, noise_m, LSB)
    for at in range(0, command.size, block):
        follower = advance_follower(follower, command[at : at + block])
    return follower


def places(follower: DriveFollower) -> Int1D:
    return take_drive_indices(follower, follower.located_end)[1]


def test_drive_is_evaluated_between_its_samples(drive: Drive) -> None:
    """Against its own closed form, by the same drive planned at four times the rate."""
    at = np.linspace(3000.25, 3399.25, 400)
    value, slope = interpolate_drive(drive, at)
    fine = replace(
        drive,
        rate_hz=4 * RATE_HZ,
        segments=tuple(
            replace(segment, start=4 * segment.start, count=4 * segment.count)
            for segment in sine_segments(drive)
        ),
    )
    near = fine.command(int(4 * at[0]) - 1, 4 * 400 + 2)
    assert np.abs(value - near[1:-1:4]).max() < 1e-12
    assert np.abs(slope - 2 * (near[2::4] - near[:-2:4])).max() < 2e-10


@pytest.mark.parametrize("shift", [0.0, 0.13, 0.5, 0.91])
def test_shift_within_a_sample_is_found(drive: Drive, shift: float) -> None:
    file = drive.command(0, 6000)
    played = DrivePlayback(file, RATE_HZ, RATE_HZ, 800.0 + shift)
    fit = fit_alignment(drive, 0, played.command(0, 4000), -790.0, RATE_HZ, LSB)
    assert fit is not None
    assert fit.offset == pytest.approx(-800.0 - shift, abs=1e-3)
    assert fit.gain == pytest.approx(1.0, abs=1e-5)
    assert fit.correlation > 0.9999


@pytest.mark.parametrize("check", [False, True])
@pytest.mark.parametrize("sweep", [SWEEP, SLOW], ids=["fast", "slow"])
def test_samples_keep_their_places_under_another_clock(
    sweep: dict[str, object], check: bool
) -> None:
    """With 1 % of noise, no command before the start, and a clock of 80 ppm."""
    drive = plan_drive(sweep, check)
    acquisition = acquire(drive, 24.0 if not check else 60.0, ppm=80.0, noise=0.01)
    sigma = 0.01 * float(np.abs(drive.command(0, drive.rest_start)).max())
    follower = follow_drive(drive, acquisition.command, sigma)
    assert follower.state == "playing"
    assert follower.fit is not None
    end = np.array([follower.processed_end])
    true = (follower.processed_end - DRIVE_START_SAMPLE) * (1 + 80e-6)
    assert abs(follower.fit.drive_index(end)[0] - true) <= 0.2
    drive_indices = places(follower)[: acquisition.place.size]
    moving = np.flatnonzero(drive_indices != REST_INDEX)
    assert np.abs(drive_indices[moving] - acquisition.place[moving]).max() < (4.0 if check else 2.0)


def test_division_of_samples_changes_no_place(drive: Drive) -> None:
    acquisition = acquire(drive, 12.0, ppm=-40.0, noise=0.002)
    drive_indices = [
        places(follow_drive(drive, acquisition.command, 1e-6, cut)) for cut in (1000, 7, 64, 500)
    ]
    for other in drive_indices[1:]:
        assert np.array_equal(drive_indices[0], other)


def test_soft_start_below_the_noise_has_its_place(drive: Drive) -> None:
    acquisition = acquire(drive, 10.0, noise=0.04)
    sigma = 0.04 * float(np.abs(drive.command(0, drive.rest_start)).max())
    follower = follow_drive(drive, acquisition.command, sigma)
    assert follower.onset is not None
    drive_indices = places(follower)
    first = int(np.ceil(DRIVE_START_SAMPLE)) + sine_segments(drive)[0].start
    assert follower.onset > first + follower.chunk_samples
    assert abs(drive_indices[first] - sine_segments(drive)[0].start - 1) <= 3
    end = acquisition.place.size
    assert np.abs(drive_indices[first:end] - acquisition.place[first:].round()).max() <= 4


def test_lost_samples_do_not_lose_the_place(drive: Drive) -> None:
    acquisition = acquire(drive, 12.0)
    command = acquisition.command.copy()
    command[8000:8060] = np.nan
    command[15000:15700] = np.nan
    follower = follow_drive(drive, command)
    assert follower.state == "playing"
    drive_indices = places(follower)[:24000]
    assert np.abs(drive_indices[8000:] - acquisition.place[8000:24000]).max() <= 0.6


def other(drive: Drive, what: str, at: int) -> Float1D:
    """What is heard where a controller does something else from sample `at` on."""
    command = acquire(drive, 16.0).command.copy()
    if what == "stands still":
        command[at:] = command[at]
    elif what == "stops gently":
        command[at:] *= np.clip(1.0 - np.arange(command.size - at) / (0.5 * RATE_HZ), 0.0, 1.0)
    elif what == "jumps back":
        command[at:] = command[at - 2700 : -2700]
    elif what == "is a quarter":
        command[at:] *= 0.25
    return command


@pytest.mark.parametrize("what", ["stands still", "stops gently", "jumps back", "is a quarter"])
@pytest.mark.parametrize("at", [13000, 13333])
def test_departure_from_the_drive_is_detected_within_a_second(
    drive: Drive, what: str, at: int
) -> None:
    command = other(drive, what, at)
    before = follow_drive(drive, command[:at])
    assert before.state == "playing"
    follower = follow_drive(drive, command[: at + int(RATE_HZ)])
    assert follower.state == "left"
    assert at - follower.chunk_samples <= follower.lost_at <= at + RATE_HZ
    assert "off the drive" in follower.reason


@pytest.mark.parametrize(
    ("share", "words"), [(-1.0, "inverted sign"), (0.0, "not this drive")], ids=["sign", "noise"]
)
def test_other_command_is_recognized(drive: Drive, share: float, words: str) -> None:
    command = share * acquire(drive, 12.0).command
    if not share:
        t = np.arange(command.size - 5000) / RATE_HZ
        command[5000:] = 1e-3 * np.sin(2 * np.pi * 1.1 * t) * np.minimum(t, 1.0)
    follower = follow_drive(drive, command)
    assert follower.state == "other"
    assert words in follower.reason
    assert follower.onset is not None
    assert follower.processed_end - follower.onset > 0
    assert (places(follower) == REST_INDEX).all()


def test_spike_is_no_motion(drive: Drive) -> None:
    command = np.zeros(6000)
    command[3123] = 5e-3
    assert follow_drive(drive, command).onset is None


def test_motion_after_the_drive_is_not_the_drive(drive: Drive) -> None:
    command = acquire(drive).command
    end = int(DRIVE_START_SAMPLE) + drive.rest_start + 600
    t = np.arange(command.size - end) / RATE_HZ
    command[end:] += 1e-4 * np.sin(2 * np.pi * 3.0 * t)
    assert follow_drive(drive, command).state == "left"


@pytest.mark.parametrize("gain", [0.5, 1.5])
@pytest.mark.parametrize("at", [0, 13000])
def test_another_amplitude_is_not_the_drive(drive: Drive, gain: float, at: int) -> None:
    """Where no command is wired nothing else would tell."""
    command = acquire(drive, 12.0).command.copy()
    command[at:] *= gain
    follower = follow_drive(drive, command)
    assert follower.state == ("left" if at else "other")
    assert (
        f"{gain:g} of the drive's; allowed: 0.7 to 1.3" in follower.reason
        or "off the drive" in follower.reason
    )


def test_amplitude_within_a_third_is_followed(drive: Drive) -> None:
    follower = follow_drive(drive, 0.75 * acquire(drive, 12.0).command)
    assert follower.state == "playing"


def test_departure_does_not_change_the_stated_clock(drive: Drive) -> None:
    """Half a second of decay drags the place along before it is seen."""
    command = acquire(drive, 16.0, ppm=50.0).command.copy()
    command[16100:] *= np.clip(1.0 - np.arange(command.size - 16100) / RATE_HZ, 0.0, 1.0) ** 3
    follower = follow_drive(drive, command)
    assert follower.state == "left"
    assert follower.fit is not None
    assert follower.fit.ppm == pytest.approx(50.0, abs=3.0)
    assert format_alignment(follower).startswith("until the drive was lost: ")
    assert "newest" not in format_alignment(follower)
