"""Protection in an imperfect laboratory: silent where all is sound, and no blinder than before."""

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from table_io.config.profile import Profile
from table_io.config.toml_text import format_toml
from table_io.safety.findings import Finding
from table_io.sim.imperfections import draw_laboratory
from tests.builders.rigs import make_faulty_rig
from tests.builders.sessions import play_guarded
from tests.table_io.safety.test_protection_simulated import identify_servo

RATE_HZ, FAULT_TIME_S = 1000.0, 9.0


def profile() -> Profile:
    """0.8 to 1.6 Hz upwards, where a low cut turns the phase most; 14 s."""
    return Profile.model_validate(
        {
            "title": "low",
            "specimen": {"mass_kg": 550.0, "gap_mm": 4.0},
            "sweep": {
                "start_hz": 0.8, "stop_hz": 1.6, "step_hz": 0.8, "cycles": 6,
                "measured_cycles": 2, "directions": ("forward",),
            },
            "acquisition": {"rate_hz": RATE_HZ, "block_samples": 50},
        }
    )  # fmt: skip


def list_findings(
    folder: Path, level: Any, seed: int, only: str | None = None, *faults: dict[str, Any]
) -> list[tuple[int, Finding]]:
    """Findings of a sweep in a random laboratory."""
    entries = draw_laboratory(level, np.random.default_rng(seed), only)
    table = {"imperfections": [entry.model_dump(exclude_none=True) for entry in entries]}
    path = folder / "truth.toml"
    path.write_text(format_toml(table))
    truth: dict[str, Any] = {
        "truth": str(path),
        "truth_sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
    }
    rig = make_faulty_rig(tuple(faults), seed=seed, **truth)
    return play_guarded(profile(), rig, identify_servo()).timed_findings


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_typical_laboratory_is_left_alone(seed: int, tmp_path: Path) -> None:
    assert list_findings(tmp_path, "typical", seed) == []


@pytest.mark.parametrize(
    ("fault", "kinds"),
    [
        ({"kind": "gain", "channel": "table_acc_m_s2", "size": 0.12}, {"consistency"}),
        ({"kind": "gain", "channel": "mass_acc_m_s2", "size": -0.12}, {"consistency"}),
        ({"kind": "polarity", "channel": "mass_acc_m_s2"}, {"consistency", "drift"}),
        ({"kind": "drift", "channel": "mass_acc_m_s2", "size": 0.02}, {"drift"}),
        ({"kind": "stuck", "channel": "table_disp_m"}, {"stuck", "following"}),
    ],
)
def test_fault_is_found_in_a_typical_laboratory(
    fault: dict[str, Any], kinds: set[str], tmp_path: Path
) -> None:
    findings = list_findings(tmp_path, "typical", 1, None, {"at_s": FAULT_TIME_S, **fault})
    known, first = findings[0]
    assert first.index > FAULT_TIME_S * RATE_HZ
    assert first.kind in kinds
    assert known / RATE_HZ - FAULT_TIME_S < 3.0


@pytest.mark.parametrize("only", ["highpass", "load_sharing", "laser_nonlinearity"])
def test_bad_instrument_is_no_fault_of_the_table(only: str, tmp_path: Path) -> None:
    findings = [finding for _, finding in list_findings(tmp_path, "bad", 1, only)]
    # A low cut makes the accelerometer read less than the level that the table plays.
    assert {finding.kind for finding in findings} <= {"consistency", "drift", "share", "level"}
    assert not any(finding.stop for finding in findings if finding.kind == "level")
