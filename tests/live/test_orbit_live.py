"""A live continuation whose processes die while the feedback acts."""

import json
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from table_io.records import Event, Fault
from tests.live.test_live import (
    finish,
    finish_at_rest,
    kill,
    read_until,
    replay_run,
    start,
)

PLAN = Path(__file__).parents[1] / "table_io" / "acquisition" / "unstable_orbits.json"
# Without a loop check the table's lag is not known and no orbit is accepted, but held it is.
PROFILE = f"""
title = "An unstable orbit"
[specimen]
mass_kg = 550.0
gap_mm = 4.0
[loop_check]
enabled = false
[excitation]
kind = "continuation"
start_hz = 2.85
stop_hz = 3.0
file = "orbits.json"
[excitation.files]
"orbits.json" = '''
{json.dumps(json.loads(PLAN.read_text(encoding="utf-8")))}
'''
"""
CAPTURE_S = 4.0  # from the start of the excitation: the feedback acts


@pytest.mark.slow  # 20 s
def test_an_orbit_is_held_on_though_the_twin_dies(tmp_path: Path) -> None:
    """The rig needs no twin for its feedback; the replay respects where the twin was dead."""
    process = start(tmp_path, profile=PROFILE)
    read_until(process, ".*state: running")
    time.sleep(CAPTURE_S)
    kill(process, "twin")
    read_until(process, r".*twin died")
    time.sleep(CAPTURE_S)
    process.send_signal(signal.SIGINT)
    _, recording, _ = finish_at_rest(process, tmp_path, 130, "stopped")
    (fault,) = recording.records(Fault)
    assert fault.component == "twin"
    assert not any(event.kind == "lost" for event in recording.records(Event))
    mass = recording.contiguous_blocks("meas")[-1].channel("mass_disp_m")
    before, after = (
        np.ptp(mass[fault.from_index + shift : fault.from_index + shift + 2000])
        for shift in (-2000, 2000)
    )
    assert after == pytest.approx(before, rel=0.1)
    again = replay_run(tmp_path)
    assert "identical to the bit" in again.stdout, again.stdout + again.stderr


@pytest.mark.slow  # 20 s
def test_a_rig_that_dies_while_the_feedback_acts_leaves_its_recording(tmp_path: Path) -> None:
    """What its queue plays then is shown in `test_orbit_faults.py`."""
    process = start(tmp_path, profile=PROFILE)
    read_until(process, ".*state: running")
    time.sleep(CAPTURE_S)
    kill(process, "rig")
    code, output, recording, summary = finish(process, tmp_path)
    assert code == 3, output
    assert summary["verdict"] == "halted"
    assert "Traceback" not in output
    (piece,) = recording.contiguous_blocks("meas")
    assert piece.index == 0
    assert len(piece) > CAPTURE_S * piece.rate_hz
