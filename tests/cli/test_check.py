"""What `check` says, draws and refuses before anything moves."""

import hashlib
import math
from dataclasses import replace
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from rich.console import Console

from table_io.config.base import PROFILES_DIR
from table_io.errors import InputError
from table_io.safety.preflight import list_limits
from table_io.units import GRAVITY_M_S2
from tests.builders.profiles import format_test
from tests.builders.rigs import RIG_TEXT, read_model_text, read_rig_text
from tests.builders.sessions import play_session
from tests.command_line import call_main
from twin.api import check_test
from twin.rig.check import check_config, find_worst_rows, print_plan, select_rows, sum_durations_s
from twin.rig.drive_figure import draw_drive
from twin.rig.predicted_ranges import format_clipping_warnings, predict_response
from twin.setup.folders import make_output_folder, remove_empty_folders
from twin.setup.run_config import RunConfig, from_texts, read_run_config

SNM = read_model_text("snm")
TEST = format_test(3.0, 3.4, 0.2, title="Short")


def bundle(test: str = TEST, rig: str = RIG_TEXT) -> RunConfig:
    return from_texts("short", test, rig, SNM, "short.toml")


def read_shipped(name: str) -> RunConfig:
    return read_run_config(PROFILES_DIR / "tests" / f"{name}.toml")


def format_plan(config: RunConfig) -> str:
    console = Console(width=80, record=True, file=StringIO())
    print_plan(console, check_config(config))
    return console.export_text()


@pytest.mark.parametrize("name", ["quickstart", "g4_ss3", "gm10", "track"])
def test_the_plan_of_a_shipped_test_is_whole_and_fits_a_terminal(name: str) -> None:
    config = read_shipped(name)
    text = format_plan(config)
    assert "…" not in text
    for word in ("specimen", "sweep", "level", "loop check", "duration", "buffer", "DAC steps"):
        assert word in text
    tables = text[text.index("peaks of the drive") :]
    assert max(map(len, tables.splitlines())) <= 80
    assert "warning" not in text
    assert text.rstrip().endswith("ready: nothing exceeds the limits of the rig file")
    assert len(tables.splitlines()) < 50


def test_the_plan_names_the_loop_check_the_buffer_and_the_room_that_is_left() -> None:
    text = format_plan(read_shipped("g4_ss3"))
    assert "1, 2.24, 5 Hz at 0.005 g, then 5 s of rest" in text
    assert "0.52 s of command queued ahead, 52 blocks of 20 samples; 20 ms of it" in text
    (row,) = (line.split() for line in text.splitlines() if line.split()[:1] == ["0.5"])
    assert row[1] == "49.68"
    assert row[-4:] == ["83", "%", "99", "%"]  # of the stroke, as it is and 20 % larger
    assert "no bumpers" in format_plan(read_shipped("ginf"))
    assert "loop check none" in format_plan(bundle(TEST + "[loop_check]\nenabled = false\n"))


def test_the_plan_states_why_a_loop_check_is_played_at_more_than_a_tenth() -> None:
    sticky, smooth = (
        format_plan(bundle(TEST, read_rig_text("hydraulic"))),
        format_plan(bundle(TEST)),
    )
    assert "not a tenth: below table_response.least_level_g = 0.05 friction" in sticky
    assert "not a tenth" not in smooth


def test_the_parts_of_a_test_are_its_duration() -> None:
    config = read_shipped("quickstart")
    parts = sum_durations_s(config.drive)
    assert sum(parts.values()) == pytest.approx(config.drive.planned_end / config.drive.rate_hz)
    sweep = config.profile.sweep
    held = sum(sweep.cycles / step.frequency_hz for step in config.steps)
    assert parts["held cycles"] == pytest.approx(held, abs=len(config.steps) / config.drive.rate_hz)
    assert parts["rest"] == pytest.approx(0.5 + 5.0, abs=0.5)
    assert min(parts.values()) > 0
    assert (
        sum_durations_s(config.ideal_drive)["loop check"]
        == sum_durations_s(config.ideal_drive)["tuning"]
        == 0
    )


def test_of_many_frequencies_the_ends_and_the_worst_are_shown() -> None:
    config = read_shipped("gm10")
    every = find_worst_rows([row for row in config.margins if row.step >= 0])
    assert [row.frequency_hz for row in every] == list(config.profile.sweep.frequencies_hz)
    for row in config.margins:
        if row.step >= 0:
            place = config.profile.sweep.frequencies_hz.index(row.frequency_hz)
            assert every[place].velocity_m_s >= row.velocity_m_s
    # A step in the middle that asks most of one limit is never left out.
    every[40] = replace(every[40], force_n=1e4)
    shown = select_rows(every, list_limits(config.rig))
    assert every[0] in shown
    assert every[40] in shown
    assert every[-1] in shown
    assert 10 <= len(shown) <= 16
    assert select_rows(every[:9], list_limits(config.rig)) == every[:9]


def test_what_the_sensors_should_see_in_free_flight_is_the_closed_form() -> None:
    test = TEST.replace("gap_mm = 4.0", "gap_mm = inf").replace("stop_hz = 3.4", "stop_hz = 3.0")
    config = bundle(test.replace("cycles = 4", "cycles = 60"))
    rows = {row.sensor.channel: row for row in predict_response(config).peaks}
    level, w = 0.05 * GRAVITY_M_S2, 2 * math.pi * 3.0
    spring = 36e3 + 1j * w * 1.1e3
    ratio = spring / (spring - 550.0 * w**2)  # acceleration of the mass over that of the table
    table_mm, u_mm = 1e3 * level / w**2, 1e3 * abs(1 - ratio) * level / w**2
    assert rows["mass_acc_m_s2"].peak == pytest.approx(0.05 * abs(ratio), rel=1e-3)
    assert rows["table_disp_m"].peak == pytest.approx(table_mm)
    assert rows["mass_disp_m"].peak == pytest.approx(u_mm + table_mm, rel=1e-3)
    assert rows["force_r1_n"].peak == 0.0
    assert rows["table_acc_m_s2"].range_share == pytest.approx(0.05 / 2.0)
    # A sweep begins softly, so its first step has no transient of an abrupt start (2.5 times this).
    sweep = bundle(TEST.replace("gap_mm = 4.0", "gap_mm = inf"))
    (mass,) = (
        row for row in predict_response(sweep).peaks if row.sensor.channel == "mass_acc_m_s2"
    )
    assert 0.05 * abs(ratio) < mass.peak < 1.7 * 0.05 * abs(ratio)


def test_a_load_cell_bears_half_of_its_side_and_the_preload() -> None:
    config = read_shipped("gm10")
    rows = {row.sensor.channel: row for row in predict_response(config).peaks}
    preload_kn = 510e3 * 5e-3 / 2 / 1e3
    assert preload_kn < rows["force_r1_n"].peak < 3 * preload_kn
    cells = [sensor for sensor in config.rig.sensors if sensor.channel != "force_r2_n"]
    alone = replace(config, rig=config.rig.model_copy(update={"sensors": tuple(cells)}))
    single = {row.sensor.channel: row for row in predict_response(alone).peaks}
    assert single["force_r1_n"].peak == pytest.approx(2 * rows["force_r1_n"].peak)
    assert single["force_l1_n"].peak == pytest.approx(rows["force_l1_n"].peak)


def test_a_sensor_that_the_model_drives_out_of_range_is_warned_of_not_refused() -> None:
    small = RIG_TEXT.replace('unit = "g"\nrange = 5.0', 'unit = "g"\nrange = 0.3')
    config = bundle(rig=small)
    (warning,) = format_clipping_warnings(predict_response(config).peaks, config.rig)
    assert warning.startswith("mass_acc_m_s2: ")
    text = format_plan(config)
    assert f"warning: {warning}" in " ".join(text.split())
    assert "ready" in text
    assert format_clipping_warnings(predict_response(bundle()).peaks, bundle().rig) == []


@pytest.mark.parametrize(
    "test",
    [
        TEST,
        TEST + "[loop_check]\nenabled = false\n[control]\nenabled = false\n",
        TEST.replace("stop_hz = 3.4", "stop_hz = 3.0") + 'directions = ["backward"]\n',
    ],
    ids=["plain", "sweep alone", "one step"],
)
def test_the_drawing_shows_every_kind_of_drive(
    test: str, tmp_path: Path, full_quality: None
) -> None:
    picture = imread(draw_drive(bundle(test), tmp_path / "drive.png"))
    assert picture.shape[0] > 1000
    assert picture.shape[1] > 1000
    inked = (picture[:, :, :3].min(axis=2) < 0.9).mean(axis=1)
    panels = np.array_split(inked, 4)  # each with something in it
    assert min(float(part.mean()) for part in panels) > 0.005
    settling = np.array([0x5C, 0x8F, 0xC2]) / 255
    assert (np.abs(picture[:, :, :3] - settling).max(axis=2) < 0.02).mean() > 0.004


def test_a_record_is_identified_by_checksum_and_peaks() -> None:
    config = read_shipped("record_example")
    text = format_plan(config)
    file = PROFILES_DIR / "tests" / "record_example.csv"
    assert hashlib.sha256(file.read_bytes()).hexdigest() in text
    history = config.profile.plan.history_m
    rate_hz = config.drive.rate_hz
    words = next(line for line in text.splitlines() if line.startswith("  target")).split()
    peaks = [float(words[k]) for k in (2, 4, 6)]
    assert peaks == pytest.approx(
        [
            np.abs(np.diff(history, 2)).max() * rate_hz**2 / GRAVITY_M_S2,
            1e3 * np.abs(np.diff(history)).max() * rate_hz,
            1e3 * np.abs(history).max(),
        ],
        rel=1e-3,
    )


@pytest.mark.parametrize("title", ["[/a]", "[bold]gap [m]", "a\\[b]"])
def test_brackets_of_a_title_are_shown_as_they_are(title: str, tmp_path: Path) -> None:
    profile = tmp_path / "test.toml"
    profile.write_text(TEST.replace('"Short"', f"'{title}'"))
    result = call_main("check", profile)
    assert result.returncode == 0, result.stderr
    assert title in result.stdout


def test_units_of_effects_are_listed() -> None:
    assert "[m]" in call_main("list", "effects").stdout


def test_a_refused_command_leaves_no_folder(tmp_path: Path) -> None:
    missing = tmp_path / "missing.mcap"
    assert call_main("compare", missing, missing, cwd=tmp_path).returncode == 2
    assert call_main("discover", missing, cwd=tmp_path).returncode == 2
    assert call_main("check", tmp_path / "no.toml", "--out", tmp_path / "out").returncode == 2
    assert not [*tmp_path.iterdir()]


def test_a_folder_with_results_stays_after_a_refusal(tmp_path: Path) -> None:
    empty, full = (make_output_folder(tmp_path / name, "") for name in ("empty", "full"))
    (full / "run.mcap").write_bytes(b"recorded")
    remove_empty_folders()
    assert not empty.exists()
    assert (full / "run.mcap").exists()


RIG = (PROFILES_DIR / "rigs" / "simulated.toml").read_text(encoding="utf-8")


def write_record(folder: Path, period_s: float, peak_g: float, noise_mm: float) -> Path:
    """Write a record of one long period, with a little of 5 Hz, and its rig."""
    t = np.arange(0.0, 10 * period_s, 0.01)
    wave = np.sin(2 * np.pi * t / period_s) * np.sin(np.pi * t / t[-1]) ** 2
    wave += 0.4 * np.sin(10 * np.pi * t) * np.sin(np.pi * t / t[-1]) ** 2
    wave *= peak_g / np.abs(wave).max()
    rows = "\n".join(f"{x:.2f},{a:.8f}" for x, a in zip(t, wave, strict=True))
    (folder / "long.csv").write_text(f"time_s,acc_g\n{rows}\n", encoding="utf-8")
    rig = RIG.replace("noise_rms = 0.005", f"noise_rms = {noise_mm}")
    (folder / "rig.toml").write_text(rig, encoding="utf-8")
    path = folder / "test.toml"
    path.write_text(
        'title = "long"\nrig = "rig.toml"\nmodel = "snm"\n[specimen]\nmass_kg = 550.0\n'
        'gap_mm = inf\n[excitation]\nkind = "record"\nfile = "long.csv"\n',
        encoding="utf-8",
    )
    return path


def test_record_of_a_long_period_is_judged_by_its_own_displacement(tmp_path: Path) -> None:
    """Its level over the square of the highest frequency is 50 um, its displacement 20 mm."""
    path = write_record(tmp_path, 2.5, 0.02, 0.03)
    checked = check_test(path)
    played = play_session(checked.config.profile, rig=checked.config.rig, stop_s=30.0)
    assert "loop check" not in played.stop.reason


@pytest.mark.parametrize("period_s", [1.0, 2.5])
def test_noise_that_the_loop_check_would_refuse_is_refused_before_motion(
    tmp_path: Path, period_s: float
) -> None:
    peak_mm = 3.0 * 9.80665 / (2 * math.pi / period_s) ** 2
    path = write_record(tmp_path, period_s, 0.003, 0.2 * peak_mm)
    with pytest.raises(InputError, match="noise of table_disp_m is") as caught:
        check_test(path)
    assert "noise_rms" in str(caught.value)
