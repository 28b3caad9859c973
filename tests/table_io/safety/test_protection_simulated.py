"""Protection on the simulated table: silent on a sound one, and no planted fault goes unseen."""

from typing import Any

import numpy as np
import pytest

from table_io.config.base import PROFILES_DIR, load_config
from table_io.config.profile import Profile
from table_io.records import FrequencyResponse
from tests.builders.rigs import make_faulty_rig
from tests.builders.sessions import play_guarded
from tests.studies.planted_faults import SWEEPS, faults, short, study, try_fault

SEEDS = (1, 2, 3)


def profile(gap_mm: float = 4.0, rate_hz: float = 2000.0, **sweep: Any) -> Profile:
    """1.4, 2.4 and 3.4 Hz upwards, four cycles each: chaos, impacts, and a resonance; 10 s."""
    grid = {"start_hz": 1.4, "stop_hz": 3.4, "step_hz": 1.0, "cycles": 4, "measured_cycles": 2}
    return Profile.model_validate(
        {
            "title": "short",
            "specimen": {"mass_kg": 550.0, "gap_mm": gap_mm},
            "sweep": {"directions": ("forward",), **grid, **sweep},
            "acquisition": {"rate_hz": rate_hz, "block_samples": 20},
        }
    )


def identify_servo() -> FrequencyResponse:
    """The closed-form response of the machine card's servo."""
    f = np.array([1.0, 3.0, 10.0])
    pole = 20.0 / np.sqrt(np.sqrt(2.0) - 1.0)
    transfer = np.exp(-2j * np.pi * f * 0.005) / (1 + 1j * f / pole) ** 2
    return FrequencyResponse(
        0, tuple(f), tuple(np.abs(transfer)), tuple(np.unwrap(np.angle(transfer)))
    )


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
def test_sound_table_is_left_alone(rate_hz: float, noise: float, gap_mm: float) -> None:
    rig = make_faulty_rig(noise=noise, seed=round(rate_hz + 10 * noise))
    assert play_guarded(profile(gap_mm, rate_hz), rig, identify_servo()).findings == []


@pytest.mark.parametrize(
    "servo",
    [
        {"servo_bandwidth_hz": 7.0},
        {"servo_bandwidth_hz": 100.0, "servo_delay_ms": 1.0},
        {"servo_bandwidth_hz": 15.0, "servo_delay_ms": 30.0},
    ],
)
def test_sound_table_with_any_servo_is_not_stopped(servo: dict[str, Any]) -> None:
    findings = play_guarded(profile(), make_faulty_rig((), **servo)).findings
    assert {(finding.kind, finding.stop) for finding in findings} <= {("level", False)}


def test_fast_and_small_motions_are_left_alone_too() -> None:
    for gap_mm in (4.0, -10.0):
        fast = profile(gap_mm, start_hz=7.0, stop_hz=10.0, step_hz=1.5, cycles=20)
        findings = play_guarded(fast, make_faulty_rig(noise=3.0), identify_servo()).findings
        # Without control the servo's roll-off shows, and is told as what it is.
        assert {(finding.kind, finding.stop) for finding in findings} <= {("level", False)}


FAULT_TIME_S = 8.0125  # s: 2.4 Hz is held
FAULTS: tuple[tuple[dict[str, Any], set[str], bool, float], ...] = (
    ({"kind": "dropped", "for_s": 0.01}, {"lost"}, False, 0.02),
    ({"kind": "repeated", "for_s": 0.01}, {"repeated"}, False, 0.02),
    ({"kind": "replayed", "for_s": 0.02}, {"command"}, True, 0.05),
    ({"kind": "power_loss"}, {"following"}, True, 0.3),
    ({"kind": "oil_loss", "size": 0.4}, {"response"}, True, 5.0),
    ({"kind": "stuck", "channel": "drive_disp_m"}, {"stuck", "command"}, True, 0.05),
    ({"kind": "stuck", "channel": "mass_disp_m"}, {"stuck"}, True, 0.02),
    ({"kind": "stuck", "channel": "force_l2_n"}, {"stuck"}, True, 0.02),
    ({"kind": "cable_off", "channel": "table_disp_m"}, {"following", "silent"}, True, 0.12),
    ({"kind": "cable_off", "channel": "table_acc_m_s2"}, {"silent"}, True, 0.12),
    ({"kind": "cable_off", "channel": "force_r1_n"}, {"silent"}, True, 0.12),
    ({"kind": "gain", "channel": "table_disp_m", "size": 0.3}, {"following"}, True, 0.3),
    ({"kind": "gain", "channel": "table_acc_m_s2", "size": 0.1}, {"consistency"}, True, 1.5),
    ({"kind": "gain", "channel": "mass_acc_m_s2", "size": -0.1}, {"consistency"}, True, 1.5),
    ({"kind": "gain", "channel": "force_r2_n", "size": 0.25}, {"share"}, True, 2.0),
    ({"kind": "polarity", "channel": "table_disp_m"}, {"following"}, True, 0.3),
    ({"kind": "polarity", "channel": "table_acc_m_s2"}, {"consistency"}, True, 1.5),
    ({"kind": "polarity", "channel": "mass_disp_m"}, {"consistency", "drift"}, True, 1.5),
    ({"kind": "polarity", "channel": "force_l1_n"}, {"share", "drift"}, True, 2.0),
    ({"kind": "rail", "channel": "table_acc_m_s2"}, {"acceleration", "rail"}, True, 0.02),
    ({"kind": "rail", "channel": "force_r1_n"}, {"rail"}, True, 0.02),
    ({"kind": "drift", "channel": "table_disp_m", "size": 1.0}, {"following", "drift"}, True, 1.5),
    ({"kind": "drift", "channel": "mass_acc_m_s2", "size": 0.01}, {"drift"}, True, 3.0),
    ({"kind": "drift", "channel": "force_l1_n", "size": 0.02}, {"drift"}, True, 2.0),
    ({"kind": "spike", "channel": "table_disp_m", "size": 70.0}, {"spike"}, False, 0.02),
    ({"kind": "spike", "channel": "force_r1_n", "size": 0.1}, {"spike"}, False, 0.02),
    ({"kind": "nan", "channel": "table_disp_m"}, {"lost"}, False, 0.02),
    ({"kind": "nan", "channel": "mass_acc_m_s2"}, {"lost"}, False, 0.02),
)


@pytest.mark.parametrize(
    ("fault", "kinds", "stops", "within_s"),
    FAULTS,
    ids=[f"{fault[0]['kind']} {fault[0].get('channel', '')}" for fault in FAULTS],
)
def test_planted_fault_is_found(
    fault: dict[str, Any], kinds: set[str], stops: bool, within_s: float
) -> None:
    rig = make_faulty_rig(({"at_s": FAULT_TIME_S, **fault},))
    at = round(FAULT_TIME_S * 2000)
    played = play_guarded(profile(cycles=12), rig, identify_servo(), stop_after=at)
    (known, finding), *_ = played.findings_since(at)
    assert played.timed_findings[0][0] > at, "found before it was there"
    assert finding.kind in kinds
    assert finding.stop == stops
    assert (known - at) / 2000 <= within_s
    if finding.kind == "consistency":  # in a motion that never repeats either may be to blame
        assert finding.channel.split("_")[0] == fault["channel"].split("_")[0]
    elif finding.kind == "share":
        assert finding.channel[:-3] == fault["channel"][:-3]
    elif "channel" in fault:
        assert finding.channel == fault["channel"]


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(set(SWEEPS)))
@pytest.mark.parametrize("seed", SEEDS)
def test_whole_sweeps_of_a_sound_table_are_left_alone(name: str, seed: int) -> None:
    test = load_config(PROFILES_DIR / "tests" / f"{name}.toml", Profile, "test profile")[0]
    findings = play_guarded(test, make_faulty_rig(seed=seed), identify_servo()).findings
    assert {(finding.kind, finding.stop) for finding in findings} <= {("level", False)}


@pytest.mark.slow
def test_every_planted_fault_of_every_size_is_found_by_a_session() -> None:
    outcomes = study(("middle",), 1, seed=3)
    assert [outcome for outcome in outcomes if not outcome.by] == []
    assert sum(outcome.early for outcome in outcomes) == 0


def test_session_records_what_was_found_and_comes_to_rest() -> None:
    outcome = try_fault(
        short("middle"), {"kind": "polarity", "channel": "mass_acc_m_s2"}, 21.0, 3.4
    )
    assert (outcome.by, outcome.ended, outcome.early) == ("consistency", "aborted", 0)
    assert outcome.cycles < 3.0


def test_study_plants_every_kind() -> None:
    from table_io.sim.config import FAULT_KINDS

    assert {fault["kind"] for fault in faults()} == set(FAULT_KINDS)
