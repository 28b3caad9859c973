"""Protection on the simulated table, also in an imperfect laboratory: silent where all is sound.

Sizes and times of each fault on its own are in test_protection.py; here each kind is planted where
servo, impacts and chaos surround it.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from table_io.config.base import format_toml
from table_io.config.profile import Profile
from table_io.records import FrequencyResponse
from table_io.sim.config import FAULT_KINDS
from tests.builders.laboratories import draw_laboratory
from tests.builders.profiles import make_profile, read_shipped_profile
from tests.builders.rigs import make_faulty_rig
from tests.builders.sessions import GuardedDrive, play_guarded
from tests.builders.truths import seal_truth
from tests.studies.planted_faults import SWEEPS, faults, short, study, try_fault

ONLY_LEVEL = {("level", False)}  # without control the roll-off of the servo shows
LABORATORY_HZ = 1000.0


def make_test(gap_mm: float = 4.0, rate_hz: float = 2000.0, **sweep: Any) -> Profile:
    """Return 1.4, 2.4 and 3.4 Hz upwards: chaos, impacts, and a resonance; 10 s."""
    grid = {"start_hz": 1.4, "stop_hz": 3.4, "step_hz": 1.0, "directions": ("forward",)}
    tables = {"acquisition": {"rate_hz": rate_hz, "block_samples": 20}}
    return make_profile(gap_mm, tables, **grid | sweep)


def identify_servo() -> FrequencyResponse:
    """Return the response of the rig's servo in closed form."""
    f = np.array([1.0, 3.0, 10.0])
    pole = 20.0 / np.sqrt(np.sqrt(2.0) - 1.0)
    transfer = np.exp(-2j * np.pi * f * 0.005) / (1 + 1j * f / pole) ** 2
    phases = tuple(np.unwrap(np.angle(transfer)))
    return FrequencyResponse(0, tuple(f), tuple(np.abs(transfer)), phases)


def list_kinds(played: GuardedDrive) -> set[tuple[str, bool]]:
    return {(finding.kind, finding.stop) for finding in played.findings}


@pytest.mark.parametrize(
    ("rate_hz", "noise", "gap_mm"),
    [
        (1000.0, 1.0, 4.0),
        (4000.0, 1.0, 4.0),
        (2000.0, 0.2, 4.0),
        (2000.0, 3.0, 4.0),
        (2000.0, 3.0, -10.0),
        (2000.0, 1.0, float("inf")),
    ],
)
def test_sound_table_has_no_finding(rate_hz: float, noise: float, gap_mm: float) -> None:
    rig = make_faulty_rig(noise=noise, seed=round(rate_hz + 10 * noise))
    assert play_guarded(make_test(gap_mm, rate_hz), rig, identify_servo()).findings == []


FAULT_TIME_S = 8.0125  # 2.4 Hz is held
# fmt: off
FAULTS: tuple[tuple[dict[str, Any], set[str], bool, float], ...] = (
    ({"kind": "dropped", "for_s": 0.01}, {"lost"}, False, 0.02),
    ({"kind": "repeated", "for_s": 0.01}, {"repeated"}, False, 0.02),
    ({"kind": "replayed", "for_s": 0.02}, {"command"}, True, 0.05),
    ({"kind": "power_loss"}, {"following"}, True, 0.3),
    ({"kind": "oil_loss", "size": 0.4}, {"response"}, True, 5.0),
    ({"kind": "stuck", "channel": "drive_disp_m"}, {"stuck", "command"}, True, 0.05),
    ({"kind": "stuck", "channel": "force_l2_n"}, {"stuck"}, True, 0.02),
    ({"kind": "cable_off", "channel": "table_disp_m"}, {"following", "silent"}, True, 0.12),
    ({"kind": "cable_off", "channel": "force_r1_n"}, {"silent"}, True, 0.12),
    ({"kind": "gain", "channel": "table_disp_m", "size": 0.3}, {"following"}, True, 0.3),
    ({"kind": "gain", "channel": "table_acc_m_s2", "size": 0.1}, {"consistency"}, True, 1.5),
    ({"kind": "gain", "channel": "mass_acc_m_s2", "size": -0.1}, {"consistency"}, True, 1.5),
    ({"kind": "gain", "channel": "force_r2_n", "size": 0.25}, {"share"}, True, 2.0),
    ({"kind": "polarity", "channel": "table_disp_m"}, {"following"}, True, 0.3),
    ({"kind": "polarity", "channel": "mass_disp_m"}, {"consistency", "drift"}, True, 1.5),
    ({"kind": "polarity", "channel": "force_l1_n"}, {"polarity", "drift"}, True, 2.0),
    ({"kind": "rail", "channel": "table_acc_m_s2"}, {"acceleration", "rail"}, True, 0.02),
    ({"kind": "drift", "channel": "table_disp_m", "size": 1.0}, {"following", "drift"}, True, 1.5),
    ({"kind": "drift", "channel": "mass_acc_m_s2", "size": 0.01}, {"drift"}, True, 3.0),
    ({"kind": "drift", "channel": "force_l1_n", "size": 0.02}, {"drift"}, True, 2.0),
    ({"kind": "spike", "channel": "table_disp_m", "size": 70.0}, {"spike"}, False, 0.02),
    ({"kind": "nan", "channel": "mass_acc_m_s2"}, {"lost"}, False, 0.02),
)
# fmt: on


@pytest.mark.parametrize(
    ("fault", "kinds", "stops", "within_s"),
    FAULTS,
    ids=[f"{fault[0]['kind']} {fault[0].get('channel', '')}" for fault in FAULTS],
)
def test_planted_fault_is_found(
    fault: dict[str, Any], kinds: set[str], stops: bool, within_s: float
) -> None:
    rig = make_faulty_rig([{"at_s": FAULT_TIME_S, **fault}])
    at = round(FAULT_TIME_S * 2000)
    played = play_guarded(make_test(cycles=12), rig, identify_servo(), stop_after=at)
    (known, finding), *_ = played.findings_since(at)
    assert played.timed_findings[0][0] > at, "found before it was there"
    assert finding.kind in kinds
    assert finding.stop == stops
    assert (known - at) / 2000 <= within_s
    channel = fault.get("channel", finding.channel)
    if finding.kind == "consistency":  # in a motion that never repeats either may be to blame
        assert finding.channel.split("_")[0] == channel.split("_")[0]
    elif finding.kind == "share":
        assert finding.channel[:-3] == channel[:-3]
    else:
        assert finding.channel == channel


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(set(SWEEPS)))
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_whole_sweep_of_a_sound_table_is_not_stopped(name: str, seed: int) -> None:
    rig = make_faulty_rig(seed=seed)
    assert list_kinds(play_guarded(read_shipped_profile(name), rig, identify_servo())) <= ONLY_LEVEL


@pytest.mark.slow
def test_every_planted_fault_of_every_size_is_found_by_a_session() -> None:
    assert {fault["kind"] for fault in faults()} == set(FAULT_KINDS)
    outcomes = study(("middle",), 1, seed=3)
    assert [outcome for outcome in outcomes if not outcome.by] == []
    assert sum(outcome.early for outcome in outcomes) == 0


def test_session_records_a_finding_and_comes_to_rest() -> None:
    fault = {"kind": "polarity", "channel": "mass_acc_m_s2"}
    outcome = try_fault(short("middle"), fault, 21.0, 3.4)
    assert (outcome.by, outcome.ended, outcome.early) == ("consistency", "aborted", 0)
    assert outcome.cycles < 3.0


# An imperfect laboratory: 0.8 to 1.6 Hz upwards, where a low cut turns the phase most; 14 s


def play_in_laboratory(
    folder: Path, level: Any, seed: int, only: str | None = None, *faults: dict[str, Any]
) -> GuardedDrive:
    """Play a sweep in a random laboratory."""
    grid = {"start_hz": 0.8, "stop_hz": 1.6, "step_hz": 0.8, "cycles": 6}
    tables = {"acquisition": {"rate_hz": LABORATORY_HZ, "block_samples": 50}}
    profile = make_profile(tables=tables, directions=("forward",), **grid)
    entries = draw_laboratory(level, np.random.default_rng(seed), only)
    truth = {"imperfections": [entry.model_dump(exclude_none=True) for entry in entries]}
    rig = make_faulty_rig(faults, seed=seed, **seal_truth(folder, format_toml(truth)))
    return play_guarded(profile, rig, identify_servo())


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_typical_laboratory_has_no_finding(seed: int, tmp_path: Path) -> None:
    assert play_in_laboratory(tmp_path, "typical", seed).findings == []


@pytest.mark.parametrize("only", ["highpass", "load_sharing", "laser_nonlinearity"])
def test_bad_instrument_is_no_fault_of_the_table(only: str, tmp_path: Path) -> None:
    findings = play_in_laboratory(tmp_path, "bad", 1, only).findings
    # A low cut makes the accelerometer read less than the level that the table plays.
    assert {finding.kind for finding in findings} <= {"consistency", "drift", "share", "level"}
    assert not any(finding.stop for finding in findings if finding.kind == "level")
