"""`python -m tests.studies.external_control [alignment|labels|live] ...`: the figures of following.

alignment: random shifts, clocks to 100 ppm and noise of 1 % (rms, of the amplitude of the drive's
first motion) on the measured command; the error of the place of a sample, in samples.
labels: a whole test of twelve minutes beside a clock of 50 ppm.
live: quickstart through the openDAQ client, in real time, in a network of its own (as root).
"""

import json
import math
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from table_io.acquisition.drive_follower import DriveFollower, advance_follower, take_drive_indices
from table_io.acquisition.external_control import plan_open_loop_drive
from table_io.config.base import load_config
from table_io.config.folders import find_config
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig
from table_io.excitation.drive import Drive
from table_io.sim.opendaq import DrivePlayback
from tests.builders.drives import sine_segments

RATE_HZ = 2000.0
LSB = 2 * 0.06 / 2**24
LATER = (5.0, 10.0, 20.0, 40.0)  # s after the motion began
CASES = (
    ("quickstart", True, 2.4), ("quickstart", False, 2.4),
    ("g16", True, 1.0), ("g4_ss1", True, 0.5), ("g4_ss1", False, 0.5), ("g0", False, 0.5),
)  # fmt: skip
PROGRAM = Path(sys.executable).parent / "shaketwin"


def drive_of(name: str, check: bool) -> Drive:
    profile, _ = load_config(find_config(name, "tests"), Profile, "profile")
    rig, _ = load_config(find_config("follow_simulated", "rigs"), RigConfig, "card")
    raw = profile.model_dump() | {
        "loop_check": profile.loop_check.model_dump() | {"enabled": check}
    }
    return plan_open_loop_drive(Profile.model_validate(raw), rig)


def follow_drive(
    drive: Drive, ppm: float, begins: float, rng: np.random.Generator
) -> tuple[float, list[float]]:
    """(s from the motion's begin until it is found, error in samples at each of LATER)."""
    first = sine_segments(drive)[0]
    sigma = 0.01 * first.level1 / (2 * math.pi * first.f1) ** 2
    motion = begins + first.start
    count = int(motion + (LATER[-1] + 0.5) * RATE_HZ)
    played = DrivePlayback(drive.command(0, count), RATE_HZ, RATE_HZ, begins, ppm)
    follower, found_s, errors = DriveFollower(drive, RATE_HZ, sigma, LSB), math.nan, list[float]()
    for at in range(0, count, 500):
        command = played.command(at, 500) + sigma * rng.standard_normal(500)
        follower = advance_follower(follower, np.rint(command / LSB) * LSB)
        if follower.fit is None:
            continue
        since = (follower.processed_end - motion) / RATE_HZ
        error = (
            float(follower.fit.drive_index(np.array([follower.processed_end]))[0])
            - (follower.processed_end - begins) * played.values_per_sample
        )
        if not errors:
            found_s, errors = since, [abs(error)]
        elif len(errors) <= len(LATER) and since >= LATER[len(errors) - 1]:
            errors.append(abs(error))
    assert follower.state == "playing", follower.reason
    return found_s, errors


def alignment(lives: int) -> None:
    """The largest error of all lives, in samples."""
    later = ", ".join(f"at {later:g} s" for later in LATER)
    print(f"drive, lives: found after s at most; error when found p50, max; max {later}")
    for name, check, hz in CASES:
        drive, rng = drive_of(name, check), np.random.default_rng(11)
        all_of = [
            follow_drive(drive, rng.uniform(-100, 100), rng.uniform(3000, 9000), rng)
            for _ in range(lives)
        ]
        errors = np.array([error for _, error in all_of])
        print(
            f"{name} from {hz} Hz, {'with' if check else 'without'} loop check, {lives}: "
            f"{max(duration for duration, _ in all_of):.2f}; {np.median(errors[:, 0]):.3f}, "
            + ", ".join(f"{error:.3f}" for error in errors.max(axis=0)),
            flush=True,
        )


def labels(ppm: float = 50.0) -> None:
    drive, begins = drive_of("g4_ss3", True), 7000.37
    for noise in (0.0, 0.01):
        estimated, true = _estimate_indices(drive, ppm, begins, noise)
        moving = true >= sine_segments(drive)[0].start
        off = np.abs(estimated - true)[moving]
        low = int(min(estimated.min(), true.min())) - 1
        rows = drive.labels(low, int(max(estimated.max(), true.max())) + 4 - low)
        wrong = np.zeros(estimated.size, dtype=bool)
        for row in rows:
            wrong |= row[estimated - low] != row[np.rint(true).astype(int) - low]
        edges = sum(int(np.count_nonzero(np.diff(row))) for row in rows)
        print(
            f"labels over {true.size / RATE_HZ:.0f} s at {ppm:g} ppm, noise {100 * noise:g} %: "
            f"place off by {off.max():.2f} samples at most (0.5 is the nearest one), p99 "
            f"{np.percentile(off, 99):.2f}; {int(wrong[moving].sum())} of {moving.sum()} samples "
            f"have another label, at {edges} edges",
            flush=True,
        )


def _estimate_indices(
    drive: Drive, ppm: float, begins: float, noise: float
) -> tuple[np.ndarray, np.ndarray]:
    """(places told, true places) of every sample."""
    file, rng = drive.command(0, drive.rest_start + 1000), np.random.default_rng(3)
    first = sine_segments(drive)[0]
    sigma = noise * first.level1 / (2 * math.pi * first.f1) ** 2
    played = DrivePlayback(file, RATE_HZ, RATE_HZ, begins, ppm)
    follower, count, estimates = (
        DriveFollower(drive, RATE_HZ, sigma, LSB),
        played.end // 500 * 500,
        [],
    )
    for at in range(0, count, 500):
        command = played.command(at, 500) + sigma * rng.standard_normal(500)
        follower = advance_follower(follower, np.rint(command / LSB) * LSB)
        follower, places = take_drive_indices(follower, follower.located_end - follower.taken_end)
        estimates.append(places)
    assert follower.state == "playing", follower.reason
    return np.concatenate(estimates)[:count], (np.arange(count) - begins) * played.values_per_sample


def live() -> None:
    from tests.table_io.backends.separate_processes import own_network

    profile = find_config("quickstart", "tests")
    with tempfile.TemporaryDirectory() as folder, own_network():
        file, out = Path(folder) / "drive.csv", Path(folder) / "run"
        card = ["--table", "follow_simulated"]
        subprocess.run([PROGRAM, "drive", profile, *card, "-o", file], check=True)
        words: list[str | Path] = [
            "table",
            "--rig",
            "follow_simulated",
            "--play",
            file,
            "--ppm",
            "50",
        ]
        with subprocess.Popen([PROGRAM, *words], stdout=subprocess.PIPE, text=True) as table:
            assert table.stdout is not None
            assert "at rest" in table.stdout.readline()
            subprocess.run([PROGRAM, "run", profile, *card, "--out", out], check=False)
            table.send_signal(signal.SIGINT)
        summary = json.loads((out / "summary.json").read_text())
        print({key: summary[key] for key in ("verdict", "reason", "gaps")})
        print(json.dumps(summary["timing"]["components"], indent=1))


if __name__ == "__main__":
    asked = sys.argv[1:] or ["alignment", "labels", "live"]
    if "alignment" in asked:
        alignment(240)
    if "labels" in asked:
        labels()
    if "live" in asked:
        live()
