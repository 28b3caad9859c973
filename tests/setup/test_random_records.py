"""Law over random records: refused, or every limit of the rig holds and the table comes to rest."""

import sys
import tempfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from table_io.block import Block, Float1D
from table_io.config.excitation import add_drive_margin
from table_io.config.excitation.drive_file import DriveHeader, format_drive
from table_io.config.provenance import Provenance
from table_io.errors import InputError
from table_io.records import RunStop, Trip
from table_io.safety.preflight import list_limits
from table_io.units import GRAVITY_M_S2
from twin.setup.run_config import RunConfig, read_run_config
from twin.setup.unpaced import iter_simulated_session


@pytest.mark.parametrize("seed", [2, 25, 44])  # the third reaches 0.74 of a limit
def test_a_record_is_refused_or_safe(seed: int) -> None:
    outcome = play_case(seed)
    assert outcome.verdict == "complete"
    assert outcome.command_ratio > 0.05  # it moved
    assert find_faults(outcome) == []


@pytest.mark.slow
def test_random_records_are_refused_or_safe() -> None:
    outcomes = [play_case(seed) for seed in range(2000, 2100)]
    assert [
        (outcome.seed, faults) for outcome in outcomes if (faults := find_faults(outcome))
    ] == []
    assert 10 < sum(outcome.verdict != "refused" for outcome in outcomes) < 60


ROUNDING_RATIO = 1.01  # of the converter and of differences
TABLE_ALLOWANCE = 1.3  # by which a table may ring beyond the motion of its command


@dataclass(frozen=True)
class RecordOutcome:
    """What became of a record: refused, complete or aborted; peaks over the limits of the rig."""

    seed: int
    verdict: str
    command_ratio: float = 0.0  # largest of displacement, velocity, acceleration over its limit
    table_ratio: float = 0.0
    rest_m_s: float = 0.0  # speed of the table at the end
    tripped: bool = False


def draw_history(rng: np.random.Generator) -> Float1D:
    """Return a history of any kind, (sample,), with a peak of about 1."""
    count = int(rng.integers(3, 2500))
    x = np.linspace(0.0, 1.0, count)
    shapes = {
        "noise": lambda: rng.standard_normal(count),
        "drift": lambda: np.cumsum(rng.standard_normal(count)) / np.sqrt(count),
        "pulse": lambda: np.exp(-(((x - 0.5) / 0.05) ** 2)) * np.sin(20.0 * x),
        "spike": lambda: np.eye(1, count, count // 2)[0],
        "step": lambda: np.where(x > 0.4, 1.0, 0.0),
        "sine": lambda: np.sin(2.0 * np.pi * rng.uniform(0.2, 40.0) * x),
        "sweep": lambda: np.sin(2.0 * np.pi * 60.0 * x**2),
        "constant": lambda: np.ones(count),
        "quake": lambda: rng.standard_normal(count) * x * np.exp(1.0 - 6.0 * x) * 6.0,
    }
    shape = shapes[str(rng.choice(list(shapes)))]()
    if rng.random() < 0.1:
        shape = shape + rng.uniform(-10.0, 10.0)
    return shape


def write_case(seed: int, folder: Path) -> Path:
    """Write the profile of a seed with its record and its drive; return its path."""
    rng = np.random.default_rng([19, seed])
    history = draw_history(rng)
    if rng.random() < 0.5:  # near the limits of the table
        unit, scale = "g", 10.0 ** rng.uniform(-1.5, 0.5)
        step_s = float(10.0 ** rng.uniform(-2.5, -1.5))
    else:
        unit = str(rng.choice(["g", "m/s2", "cm/s2", "mm", "m"]))
        history *= 10.0 ** rng.uniform(-4.0, 4.0)
        scale = 10.0 ** rng.uniform(-2.0, 2.0)
        step_s = float(10.0 ** rng.uniform(-3.3, -1.0))
    rows = "".join(f"{value:.9g}\n" for value in history.tolist())
    (folder / "record.csv").write_text(f"motion\n{rows}")
    keys = [
        'kind = "record"',
        'file = "record.csv"',
        f'quantity = "{"displacement" if unit in ("mm", "m") else "acceleration"}"',
        f'unit = "{unit}"',
        f"step_s = {step_s!r}",
        f"scale = {float(rng.choice([-1.0, 1.0]) * scale)!r}",
        f"windows = {int(rng.integers(1, 9))}",
    ]
    if rng.random() < 0.3:
        low = float(10.0 ** rng.uniform(-1.5, 0.5))
        keys.append(f"band_hz = [{low!r}, {low * float(10.0 ** rng.uniform(0.1, 2.0))!r}]")
    if rng.random() < 0.3:
        keys.append(f"length_ratio = {float(10.0 ** rng.uniform(-2.0, 0.5))!r}")
        keys.append(f"acceleration_ratio = {float(10.0 ** rng.uniform(-0.5, 0.5))!r}")
    if rng.random() < 0.3 and unit not in ("mm", "m"):
        keys.append(f'baseline = "{rng.choice(["none", "mean", "linear"])}"')
    has_drive = rng.random() < 1.0 / 3.0
    path = folder / "record.toml"
    text = "\n".join(
        [
            'title = "Random record"',
            'rig = "hydraulic"',
            'model = "snm"',
            "[specimen]",
            "mass_kg = 550.0",
            f"gap_mm = {float(rng.choice([2.0, 4.0, 16.0]))!r}",
            "[acquisition]",
            "rate_hz = 1000.0",
            "[loop_check]",
            "enabled = false",
            "[excitation]",
            *keys,
            "",
        ]
    )
    path.write_text(text)
    if has_drive:
        write_wrong_drive(path, rng)
    return path


def write_wrong_drive(path: Path, rng: np.random.Generator) -> None:
    """Add a drive to a profile: its target, amplified or distorted as by a wrong twin."""
    try:
        config = read_run_config(path)
    except InputError:
        return
    target = add_drive_margin(config.profile.plan.target_m, config.drive.rate_hz)
    hz = np.fft.rfftfreq(target.size, 1e-3)
    gain = 1.0 + rng.uniform(-0.5, 3.0) * hz / (hz + rng.uniform(0.5, 20.0))
    wrong = np.fft.irfft(np.fft.rfft(target) * gain, target.size) * rng.choice([1.0, 1.0, 5.0])
    edge = np.clip(np.arange(target.size) / 500.0, 0.0, 1.0)
    window = np.minimum(edge, edge[::-1])
    (path.parent / "drive.csv").write_text(
        format_drive(wrong * window, target, "a wrong drive", DriveHeader(provenance=Provenance()))
    )
    path.write_text(
        path.read_text().replace("[excitation]\n", '[excitation]\ndrive = "drive.csv"\n')
    )


def play_case(seed: int) -> RecordOutcome:
    """Play the record of a seed; any exception but InputError is a fault of the code."""
    with tempfile.TemporaryDirectory() as name:
        path = write_case(seed, Path(name))
        try:
            config = read_run_config(path)
        except InputError:
            return RecordOutcome(seed, "refused")
        return play_record(seed, config)


def play_record(seed: int, config: RunConfig) -> RecordOutcome:
    """Play a record that was not refused, and compare its measured motion with the limits."""
    verdict, tripped = "", False
    blocks: list[Block] = []
    for item in iter_simulated_session(config, "run"):
        if isinstance(item, Block):
            blocks.append(item)
        elif isinstance(item, Trip):
            tripped = True
        elif isinstance(item, RunStop):
            verdict = item.verdict
    rate_hz = config.drive.rate_hz
    command, table, acceleration = (
        np.concatenate([block.channel(name) for block in blocks])
        for name in ("drive_disp_m", "table_disp_m", "table_acc_m_s2")
    )
    limits = {limit.name: limit.allowed for limit in list_limits(config.rig)}
    return RecordOutcome(
        seed, verdict,
        _compare(command, np.diff(command, 2) * rate_hz**2, rate_hz, limits),
        _compare(table, acceleration, rate_hz, limits),
        float(np.abs(np.diff(table[-200:].reshape(-1, 20).mean(axis=1))).max() * rate_hz / 20.0),
        tripped,
    )  # fmt: skip


def _compare(
    position_m: Float1D, acceleration_m_s2: Float1D, rate_hz: float, limits: dict[str, float]
) -> float:
    """Return the largest of displacement, velocity and acceleration over its limit.

    Noise is averaged over 5 ms.
    """
    smooth = np.ones(5) / 5.0
    position, acceleration = (
        np.convolve(values, smooth, "valid") for values in (position_m, acceleration_m_s2)
    )
    return max(
        1e3 * float(np.abs(position).max()) / limits["displacement"],
        1e3 * rate_hz * float(np.abs(np.diff(position)).max()) / limits["velocity"],
        float(np.abs(acceleration).max()) / GRAVITY_M_S2 / limits["acceleration"],
    )


def find_faults(outcome: RecordOutcome) -> list[str]:
    """Return what a played record broke."""
    if outcome.verdict == "refused":
        return []
    faults = []
    if outcome.command_ratio > ROUNDING_RATIO:
        faults.append(f"command {outcome.command_ratio:.3f} of a limit")
    if outcome.table_ratio > TABLE_ALLOWANCE:
        faults.append(f"table {outcome.table_ratio:.3f} of a limit")
    if outcome.table_ratio > ROUNDING_RATIO and not outcome.tripped:
        faults.append(f"table {outcome.table_ratio:.3f} of a limit without a trip")
    if outcome.rest_m_s > 2e-3:
        faults.append(f"{1e3 * outcome.rest_m_s:.2f} mm/s at the end")
    if outcome.verdict not in ("complete", "aborted"):
        faults.append(f"verdict {outcome.verdict!r}")
    return faults


def main() -> None:
    """Print the outcome of each seed that was played, and the counts."""
    first, last = map(int, sys.argv[1:3])
    verdicts: Counter[str] = Counter()
    faulty = 0
    for seed in range(first, last):
        outcome = play_case(seed)
        verdicts[outcome.verdict] += 1
        faults = find_faults(outcome)
        faulty += bool(faults)
        if outcome.verdict != "refused":
            print(outcome, *faults, flush=True)
    print(dict(verdicts), f"{faulty} with faults")


if __name__ == "__main__":
    main()
