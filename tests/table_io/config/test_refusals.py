"""Files that people write: each fault names its key, what is allowed and what to do."""

import copy
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from table_io.config.base import ConfigModel, format_toml, parse_toml
from table_io.config.profile import Profile, load_profile
from table_io.config.rig import RigConfig
from tests.builders.rigs import LAB_TEXT, RIG_TEXT, read_rig_text
from tests.input_errors import raises_input_error

SWEEP: dict[str, Any] = {
    "title": "a test",
    "specimen": {"mass_kg": 550.0, "gap_mm": 4.0},
    "sweep": {"start_hz": 0.5, "stop_hz": 5.0, "step_hz": 0.1, "cycles": 10},
}
LEVELS = {"sweep__start_hz": 1.0, "sweep__stop_hz": 4.0, "sweep__step_hz": 1.0, "sweep__cycles": 3}
CHIRP = {"start_hz": 1.0, "stop_hz": 8.0, "duration_s": 10.0}
TEXTS = {
    "rig": (RigConfig, RIG_TEXT),
    "lab": (RigConfig, LAB_TEXT),
    "ni": (RigConfig, read_rig_text("ni_simulated")),
    "accelerometer": (RigConfig, RIG_TEXT),
}
ACCELEROMETER = 'channel = "table_acc_m_s2"\nunit = "g"\n'
TRACK = {"start_hz": 1.0, "stop_hz": 1.6, "step_hz": 0.1, "cycles": 5, "measured_cycles": 2}


def format_sweep(changes: Mapping[str, Any]) -> str:
    """Return the text of the test with other values: `sweep__step_hz`; None leaves a key out."""
    tables = copy.deepcopy(SWEEP)
    for path, value in changes.items():
        *table, key = path.split("__")
        place = tables.setdefault(table[0], {}) if table else tables
        if value is None:
            del place[key]
        else:
            place[key] = value
    return format_toml(tables)


def make_file(base: str, change: Any) -> tuple[type[ConfigModel], str]:
    """Return the class and the text of a file: a base with one change.

    A mapping changes keys, a pair replaces a text, and a list adds lines.
    """
    if base == "sweep":
        return Profile, format_sweep(change)
    if base == "levels":
        changes = {f"sweep__{key}": value for key, value in change.items()}
        return Profile, format_sweep(LEVELS | changes)
    if base == "track":
        return Profile, "\n".join([format_toml(SWEEP | {"sweep": TRACK}), *change])
    if base not in TEXTS:
        excitation = {"excitation": {"kind": base, **change}}
        tables = {key: value for key, value in SWEEP.items() if key != "sweep"}
        return Profile, format_toml(tables | excitation)
    model, text = TEXTS[base]
    if base == "accelerometer":
        change = (ACCELEROMETER, ACCELEROMETER + "\n".join(change) + "\n")
    assert change[0] in text
    return model, text.replace(change[0], change[1], 1)


# fmt: off
REFUSALS: list[tuple[str, Any, str, dict[str, Any]]] = [
    ("sweep", {"titel": "x"}, "titel", {"remedy": "did you mean 'title'?"}),
    ("sweep", {"title": None}, "title", {"remedy": "add it"}),
    ("sweep", {"sweep__start_hz": None}, "sweep.start_hz", {"remedy": "add it"}),
    ("sweep", {"specimen__gap": 4.0}, "specimen.gap", {"remedy": "did you mean 'gap_mm'?"}),
    ("sweep", {"acquisition__qqq": 4.0},
     "acquisition.qqq", {"remedy": "known: rate_hz, block_samples, rest_s"}),
    ("sweep", {"sweep__start_hz": 0.0}, "sweep.start_hz", {"value": 0.0}),
    ("sweep", {"sweep__stop_hz": math.inf}, "sweep.stop_hz", {"value": math.inf}),
    ("sweep", {"sweep__stop_hz": 0.4}, "sweep.stop_hz", {}),
    ("sweep", {"sweep__step_hz": 0.4}, "sweep.step_hz", {"remedy": "nearest: 0.409091"}),
    ("sweep", {"sweep__step_hz": 0.0001}, "sweep.step_hz", {"allowed": "at least 0.0009"}),
    ("sweep", {"sweep__step_hz": 1e-310}, "sweep.step_hz", {"allowed": "at least 0.0009"}),
    ("sweep", {"sweep__cycles": 1}, "sweep.cycles", {"value": 1}),
    ("sweep", {"sweep__cycles": 10.5}, "sweep.cycles", {"value": 10.5}),
    ("sweep", {"sweep__cycles": True}, "sweep.cycles", {"value": True}),
    ("sweep", {"sweep__measured_cycles": 11}, "sweep.measured_cycles", {}),
    ("sweep", {"sweep__directions": []},
     "sweep.directions", {"allowed": "'forward', 'backward', in any order"}),
    ("sweep", {"sweep__directions": ["up"]}, "sweep.directions.0", {"value": "up"}),
    ("sweep", {"sweep__blend_cycles": 1.0}, "sweep.blend_cycles", {"value": 1.0}),
    ("sweep", {"sweep__acceleration_g": True}, "sweep.acceleration_g", {"value": True}),
    ("sweep", {"specimen__mass_kg": math.inf}, "specimen.mass_kg", {"value": math.inf}),
    ("sweep", {"specimen__gap_mm": -math.inf},
     "specimen.gap_mm", {"allowed": "a number in mm, or inf for no bumpers"}),
    ("sweep", {"specimen__gap_right_mm": 2.0}, "specimen.gap_left_mm", {}),
    ("sweep", {"specimen__gap_left_mm": 2.0}, "specimen.gap_left_mm", {}),
    ("sweep", {"sweep": 3}, "sweep", {"value": 3}),
    ("rig", ('"mass_acc_m_s2"', '"mass_acc_m_s"'),
     "sensors.4.channel", {"remedy": "did you mean 'mass_acc_m_s2'? or declare it"}),
    ("rig", ('"force_l2_n"', '"force_l1_n"'), "sensors", {"remedy": "one sensor per channel"}),
    ("rig", ('"table_acc_m_s2"', '"rel_disp_m"'),
     "sensors.2.unit", {"allowed": "m, mm, um, cm, in, ft"}),
    ("rig", ("volts_per_unit = 5.0", "volts_per_unit = 0.0"),
     "sensors.2.volts_per_unit", {"allowed": "not 0"}),
    ("rig", ("noise_rms = 0.0005", "noise = 0.0005"),
     "sensors.2.noise", {"remedy": "did you mean 'noise_rms'?"}),
    ("rig", ("stroke_mm = 60.0", "stroke_mm = inf"), "limits.stroke_mm", {"value": math.inf}),
    ("rig", ("bits = 18", "bits = 40"), "output.bits", {"value": 40}),
    ("rig", ("seed = 1", "sead = 1"), "simulated.sead", {"remedy": "did you mean 'seed'?"}),
    ("rig", ("rates_hz = [1000.0, 2000.0, 4000.0]", "rates_hz = []"), "rates_hz", {"value": []}),
    ("lab", ('"acceleration"', '"accelerating"'),
     "channels.0.quantity", {"remedy": "did you mean 'acceleration'?"}),
    ("lab", ('unit = "m/s2"', 'unit = "g"'), "channels.0.unit", {}),
    ("lab", ('name = "mass_acc_2_m_s2"', 'name = "mass_acc_2_m"'),
     "channels.0.name", {"allowed": "..._m_s2"}),
    ("lab", ('name = "mass_acc_2_m_s2"', 'name = "Mass_m_s2"'),
     "channels.0.name", {"allowed": "words of a to z and 0 to 9 joined by _"}),
    ("lab", ('name = "mass_acc_2_m_s2"', 'name = "a/b_m_s2"'),
     "channels.0.name", {"allowed": "words of a to z and 0 to 9 joined by _"}),
    ("lab", ('name = "mass_acc_2_m_s2"', 'name = "mass_acc_m_s2"'),
     "channels.0.name", {}),
    ("lab", ('name = "mass_acc_2_m_s2"', 'name = "twin_m_s2"'), "channels.0.name", {}),
    ("lab", ('name = "mass_edge_acc_m_s2"', 'name = "mass_acc_2_m_s2"'),
     "channels", {"remedy": "keep one"}),
    ("lab", ('body = "mass"', 'body = "mas"'), "channels.0.body", {"value": "mas"}),
    ("lab", ('positive = "left"', 'positive = "compression"'),
     "channels.0.positive", {"allowed": "right, left, up, down, front, back"}),
    ("lab", ('positive = "left"', ""),
     "channels.0.positive", {"allowed": "right, left, up, down, front, back"}),
    ("lab", ('body = "other"', 'body = "other"\npositive = "up"'),
     "channels.1.positive", {"allowed": "none, leave it out"}),
    ("lab", ("constant = 21.5", "constant = inf"),
     "channels.1.simulated.constant", {"value": math.inf}),
    ("lab", ("{ constant = 21.5 }", "{}"), "channels.1.simulated", {"value": {}}),
    ("lab", ("{ constant = 21.5 }", "{ table_dis_m = 1.0 }"),
     "channels.1.simulated", {"remedy": "did you mean 'table_disp_m'?"}),
    ("lab", ('meaning = "Air', 'meanin = "Air'),
     "channels.1.meanin", {"remedy": "did you mean 'meaning'?"}),
    ("lab", ("simulated = { constant = 21.5 }", ""), "simulated", {}),
    ("lab", ('channel = "air_temp_degc"', 'channel = "air_temp"'),
     "sensors.10.channel", {"remedy": "did you mean 'air_temp_degc'? or declare it"}),
    ("lab", ('unit = "degC"\nrange', 'unit = "V"\nrange'), "sensors.10.unit", {"allowed": "degC"}),
    ("lab", ('unit = "degC"\nrange', 'unit = "K"\nrange'),
     "sensors.10.unit", {"allowed": "m, mm, um, cm, in, ft, m/s"}),
    ("accelerometer", ['calibrated = "2025-02-30"'],
     "sensors.2.calibrated", {"allowed": "year-month-day"}),
    ("accelerometer", ["calibrated = 2025-02-03T10:00:00"],
     "sensors.2.calibrated", {"allowed": "year-month-day"}),
    ("accelerometer", ["calibrated = 20250203"],
     "sensors.2.calibrated", {"allowed": "year-month-day"}),
    ("accelerometer", ["interval_months = 12"], "sensors.2.interval_months", {}),
    ("accelerometer", ["calibrated = 2025-02-03", "interval_months = 0"],
     "sensors.2.interval_months", {"value": 0}),
    ("accelerometer", ["calibrated = 2025-02-03", "due = 2025-02-02"],
     "sensors.2.due", {"remedy": "correct one"}),
    ("accelerometer", ["calibrated = 2025-02-03", "due = 2026-02-03", "interval_months = 12"],
     "sensors.2.interval_months", {"remedy": "keep one"}),
    ("accelerometer", ['calibrated = "9990-01-01"', "interval_months = 600"],
     "sensors.2.interval_months", {"remedy": "give fewer months"}),
    ("accelerometer", ['due = "２０２０-03-01"'],
     "sensors.2.due", {"allowed": "year-month-day"}),
    ("accelerometer", ["shunt = 1.0"],
     "sensors.2.shunt_tolerance", {"remedy": "give both or neither"}),
    ("accelerometer", ["shunt = 0.0", "shunt_tolerance = 0.1"],
     "sensors.2.shunt_tolerance", {"allowed": "not 0"}),
    ("accelerometer", ["seriall = 'x'"], "sensors.2.seriall", {"remedy": "did you mean 'serial'?"}),
    ("ni", ("[ni]\n", "[ni]\nheartbeat_back = 'Dev1/ai0'\n"), "ni.heartbeat_back", {}),
    ("ni", ("[ni]\n", "[ni]\nwell = { limit = 'port0' }\n"), "ni.well.limit", {}),
    ("ni", ("127.0.0.1:7470", "7470"), "ni.endpoint", {}),
    ("ni", ("127.0.0.1:7470", "8.8.8.8:7470"), "ni.endpoint", {}),
    ("ni", ("Dev1/ao0", "ao0"), "ni.output", {}),
    ("ni", ("Dev1/port0/line0", "Dev1/line0"), "ni.heartbeat", {}),
    ("ni", ('"Dev1/ai1"', '"Dev1/ai0"'), "ni.inputs", {}),
    ("ni", ("held_by_device_ms = 20.0", "held_by_device_ms = 0.0"), "ni.held_by_device_ms", {}),
    ("ni", ("held_by_device_ms = 20.0", "held_by_device = 20.0"), "ni.held_by_device", {}),
    ("ni", ("held_by_device_ms = 20.0", 'start_trigger = "PFI0"'), "ni.start_trigger", {}),
    ("track", ["[dwell]"], "dwell.seconds", {}),
    ("track", ["[dwell]\ncycles = 5\nseconds = 3.0"], "dwell.seconds", {}),
    ("track", ["[track]\nby = 'phase'\nstep_hz = 0.05"], "track.resolution_hz", {}),
    ("track", ["[track]\nby = 'phase'\nstep_hz = 0.05\nresolution_hz = 0.04"],
     "track.resolution_hz", {"allowed": "at most 0.025"}),
    ("track", ["[track]\nby = 'peak'\nresolution_hz = 0.01\nstep_hz = 0.05\nphase_deg = 90.0"],
     "track.phase_deg", {}),
    ("track", ["[track]\nby = 'peak'\nresolution_hz = 0.01\nstep_hz = 0.05\nhighest_hz = 1.7"],
     "track", {"allowed": "1 to 1.6"}),
    ("track", ["[track]\nby = 'peak'\nresolution_hz = 0.01\nstep_hz = 0.4"],
     "track", {"allowed": "a range of at least two steps"}),
    ("track", ["[refine]\ncycles = 9\nresolution_hz = 0.1"],
     "refine", {"allowed": "0.000781 to below 0.1"}),
    ("track", ["[refine]\ncycles = 9\nresolution_hz = 0.01\napproach_hz = 0.9"],
     "refine", {"allowed": "1 to 1.6"}),
    ("track", ["[dwell]\ncycles = 5\n[refine]\ncycles = 9\nresolution_hz = 0.01"],
     "refine", {"allowed": "one of dwell, track, refine"}),
    ("sine_pulse", {"frequency_hz": 0.0}, "excitation.frequency_hz", {"problem": "greater than 0"}),
    ("half_sine", {"duration_s": 0.1, "compensation": 0.0},
     "excitation.compensation", {"problem": "0.05"}),
    ("chirp", {"start_hz": 1.0, "stop_hz": 1.0, "duration_s": 10.0},
     "excitation.stop_hz", {"remedy": "sine_pulse"}),
    ("chirp", {**CHIRP, "level_points": [[1.0, 0.1]]},
     "excitation.level_points", {"allowed": "two"}),
    ("chirp", {**CHIRP, "level_points": [[2.0, 0.1], [8.0, 0.1]]},
     "excitation.level_points", {"allowed": "1 to 8 Hz"}),
    ("chirp", {**CHIRP, "level_points": [[8.0, 0.1], [1.0, 0.1]]},
     "excitation.level_points", {"allowed": "ascending"}),
    ("random", {"low_hz": 0.5, "high_hz": 0.5}, "excitation.high_hz", {"problem": "low_hz 0.5"}),
    ("random", {"low_hz": 0.5, "high_hz": 15.0, "corner_hz": 20.0},
     "excitation.corner_hz", {"allowed": "0.5 to 15"}),
    ("random", {"low_hz": 0.5, "high_hz": 15.0, "duration_s": 0.5},
     "excitation.duration_s", {"allowed": "0.5517"}),
    ("cyclic", {"protocol": []}, "excitation.protocol", {"problem": "at least 1"}),
    ("cyclic", {"protocol": [[5.0, 1.0, 2.5]]}, "excitation.protocol.0.2", {"problem": "integer"}),
    ("levels", {"level_points": [[1.0, 0.1], [3.0, 0.1]]},
     "sweep.level_points", {"allowed": "1 to 4 Hz", "remedy": "each end"}),
    ("levels", {"level_points": [[1.0, 0.1], [4.0, -0.1]]}, "sweep.level_points.1.1", {}),
    ("levels", {"level_points": [[4.0, 0.1], [1.0, 0.1]]},
     "sweep.level_points", {"allowed": "ascending"}),
    ("levels", {"schedule_db": [-80.0]}, "sweep.schedule_db", {"allowed": "-60 to 20 dB"}),
    ("levels", {"schedule_db": [-6.0, -6.0]}, "sweep.schedule_db", {"allowed": "once"}),
    ("sweep", {**LEVELS, "sweep__schedule_db": [-6.0, 0.0], "dwell__cycles": 3},
     "dwell", {"remedy": "[dwell]"}),
]

TRACKING = [
    ("band_hz = [8.0, 1.0]", "tracking.band_hz", {"remedy": "exchange"}),
    ("band_hz = [1.0, 1200.0]", "tracking", {"allowed": "1000"}),
    ("band_hz = [1.0]", "tracking.band_hz.1", {}),
    ("damping = 0.0", "tracking.damping", {}),
    ("required_upper = 0.9", "tracking.required_upper", {}),
    ("bandwidth_hz = 1.0", "tracking.bandwidth_hz", {"remedy": "band_hz"}),
    ('required_spectrum = "other.csv"', "tracking.required_spectrum", {}),
]
# fmt: on


@pytest.mark.parametrize(("base", "change", "key", "fields"), REFUSALS)
def test_fault_names_key_and_what_is_allowed(
    base: str, change: Any, key: str, fields: dict[str, Any]
) -> None:
    model, text = make_file(base, change)
    with raises_input_error(key=key, **fields) as error:
        parse_toml(text, model, "some/file.toml")
    assert error.value.where == "some/file.toml"


@pytest.mark.parametrize(("line", "key", "fields"), TRACKING)
def test_fault_of_tracking_names_its_key(
    line: str, key: str, fields: dict[str, str], tmp_path: Path
) -> None:
    rows = "".join(f"{k / 100},{np.sin(k / 10):.6f}\n" for k in range(100))
    (tmp_path / "motion.csv").write_text("time_s,disp_mm\n" + rows)
    tables = {key: value for key, value in SWEEP.items() if key != "sweep"}
    record = {"excitation": {"kind": "record", "file": "motion.csv"}}
    path = tmp_path / "test.toml"
    path.write_text(f"{format_toml(tables | record)}\n[tracking]\n{line}\n")
    with raises_input_error(key=key, **fields):
        load_profile(path)


@pytest.mark.parametrize(
    ("table", "key"),
    [
        ("[track]\nby = 'peak'\nresolution_hz = 0.01\nstep_hz = 0.05", "track"),
        ("[refine]\ncycles = 9\nresolution_hz = 0.01", "refine"),
    ],
)
def test_frequency_leaves_nothing_to_track_or_to_refine(table: str, key: str) -> None:
    single = format_toml(SWEEP | {"sweep": TRACK | {"stop_hz": 1.0}})
    with raises_input_error(key=key, remedy="stop_hz"):
        parse_toml(f"{single}\n{table}", Profile, "some/test.toml")
    dwell = parse_toml(f"{single}\n[dwell]\ncycles = 5", Profile, "some/test.toml").dwell
    assert dwell is not None


def test_all_faults_of_a_file_stand_in_one_refusal() -> None:
    text = format_sweep(
        {
            "nonsense": 1,
            "specimen__mass_kg": -5.0,
            "specimen__gap_mm": math.nan,
            "specimen__gap_right_mm": 1.0,
            "sweep__stp_hz": 0.1,
            "sweep__step_hz": 0.31,
            "sweep__cycles": 2,
            "sweep__acceleration_g": "0.05",
            "acquisition__rest_s": 0.0,
            "on_death__twin": "explode",
        }
    )
    with raises_input_error(key="nonsense") as error:
        parse_toml(text, Profile, "some/test.toml")
    assert [(fault.key, fault.value) for fault in error.value.faults] == [
        ("specimen.mass_kg", -5.0),
        ("specimen.gap_mm", None),
        ("specimen.gap_left_mm", None),
        ("sweep.step_hz", None),
        ("sweep.measured_cycles", None),
        ("sweep.acceleration_g", "0.05"),
        ("sweep.stp_hz", None),
        ("acquisition.rest_s", 0.0),
        ("on_death.twin", "explode"),
        ("nonsense", None),
    ]
