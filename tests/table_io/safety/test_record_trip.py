"""A drive that moves the table far beyond its target trips it; one that is right does not."""

from pathlib import Path

import numpy as np
import pytest

from table_io.config.excitation import History, add_drive_margin
from table_io.config.excitation.drive_file import DriveHeader, format_drive
from table_io.config.profile import load_profile
from table_io.config.provenance import Provenance
from table_io.records import Trip
from tests.builders.rigs import change_rig
from tests.builders.sessions import play_session

RECORD = """
title = "Short pulse"
[specimen]
mass_kg = 550.0
gap_mm = 8.0
[acquisition]
rate_hz = 1000.0
[loop_check]
enabled = false
[excitation]
kind = "random"
low_hz = 0.5
high_hz = 6.0
rms_g = 0.03
duration_s = 8.0
seed = 3
drive = "drive.csv"
"""


@pytest.mark.parametrize(
    ("factor", "least_level_g", "trips"),
    [(1.0, 0.0, False), (1.83, 0.0, True), (1.83, 0.02, True), (1.83, 0.4, False)],
)
def test_a_table_far_off_the_target_of_its_drive_trips(
    tmp_path: Path, factor: float, least_level_g: float, trips: bool
) -> None:
    # Half of the least level is friction, which adds to the acceleration of any target.
    path = tmp_path / "record.toml"
    path.write_text(RECORD.replace('drive = "drive.csv"\n', ""))
    excitation = load_profile(path)[0].excitation
    assert isinstance(excitation, History)
    target = add_drive_margin(excitation.displacement(1000.0), 1000.0)
    drive = format_drive(factor * target, target, "drive", DriveHeader(provenance=Provenance()))
    (tmp_path / "drive.csv").write_text(drive)
    path.write_text(RECORD)
    rig = change_rig(table_response={"least_level_g": least_level_g})
    session = play_session(load_profile(path)[0], rig=rig)
    trip_records = session.select(Trip)
    assert bool(trip_records) is trips
    if trips:
        assert trip_records[0].kind == "record"
        assert trip_records[0].channel == "table_acc_m_s2"
        assert abs(trip_records[0].value) > trip_records[0].limit
        # Rest follows: the table is not cut off.
        assert np.abs(session.block.channel("drive_disp_m")[-100:]).max() < 1e-4
    assert (session.stop.verdict == "complete") is not trips
