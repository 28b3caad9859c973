"""The sensor cards of a run: warned of at its start, recorded, in `verify` and in the report."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from table_io.config.base import parse_toml
from table_io.config.rig import RigConfig
from table_io.records import Event, RunStart
from tests.builders.profiles import NO_LOOP_CHECK, format_test
from tests.builders.rigs import RIG_TEXT
from twin.cli.table import app
from twin.recording.reader import read_recording
from twin.results.sensor_table import build_sensor_rows

ACC, CELL = 'channel = "table_acc_m_s2"\n', 'channel = "force_l2_n"\n'
CARD = RIG_TEXT.replace(
    ACC, f'{ACC}maker = "PCB"\nmodel = "3713B"\nserial = "LW 12"\ncalibrated = 2020-03-11\n'
    'interval_months = 12\ncertificate = "K-77"\ncalibrated_by = "<the institute>"\n'
).replace(CELL, f"{CELL}due = 2999-01-01\n")  # fmt: skip
RECORD = """
[[calibrations]]
channel = "table_acc_m_s2"
unit = "g"
at = "2026-02-01T10:00:00+00:00"
by = "anna"
method = "points"
applied = [-1.0, 1.0]
volts = [-5.0, 5.01]
volts_sd = [1e-5, 1e-5]
volts_per_unit = 5.005
volts_per_unit_sd = 1e-5
offset = 0.001
offset_sd = 1e-6
card_volts_per_unit = 5.0
departure_percent = 0.1
tolerance_percent = 1.0
passed = true
"""
SHORT = format_test(3.4, 3.4, 0.2, directions=["forward"], tables=NO_LOOP_CHECK)


def start(rig_toml: str = CARD, started_at: str = "2026-03-11T10:00:00+00:00") -> RunStart:
    tare = {"table_acc_m_s2": 0.0980665, "force_l2_n": 5.0}
    texts = ("", rig_toml, "")
    return RunStart(
        0, "r", "n", "table", *texts, 2000.0, 20, (), (), 0, tare, {}, "", started_at, 0.0
    )


def test_a_row_says_what_the_card_says_and_the_tare_in_its_unit() -> None:
    rows = {row.channel: row for row in build_sensor_rows(start(CARD + RECORD))}
    assert list(rows) == list(parse_toml(CARD, RigConfig, "card").channels)
    acc = rows["table_acc_m_s2"]
    assert (acc.instrument, acc.serial, acc.certificate) == ("PCB 3713B", "LW 12", "K-77")
    assert (acc.calibrated, acc.due) == ("2020-03-11 by <the institute>", "2021-03-11")
    assert acc.sensitivity == "5 V/g"
    assert acc.tare == pytest.approx(0.01)
    assert acc.checked == "2026-02-01: +0.1 %"
    assert acc.overdue
    assert rows["force_l2_n"].tare == pytest.approx(0.005)
    assert not rows["force_l2_n"].overdue
    assert rows["drive_disp_m"].tare is None


def test_overdue_is_judged_on_the_day_of_the_run() -> None:
    before = {
        row.channel: row for row in build_sensor_rows(start(started_at="2021-03-11T23:00:00"))
    }
    after = {row.channel: row for row in build_sensor_rows(start(started_at="2021-03-12T00:10:00"))}
    assert not before["table_acc_m_s2"].overdue
    assert after["table_acc_m_s2"].overdue


@pytest.mark.parametrize("text", ["", "not = = toml", "sensors = 3", '[[sensors]]\nchannel = "x"'])
def test_without_a_card_the_tare_is_still_shown(text: str) -> None:
    rows = build_sensor_rows(start(text, started_at=""))
    assert [(row.channel, row.tare, row.unit) for row in rows] == [
        ("table_acc_m_s2", 0.0980665, "m/s2"),
        ("force_l2_n", 5.0, "N"),
    ]


def test_a_run_warns_records_and_reports_what_is_overdue(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "card.toml").write_text(CARD)
    (tmp_path / "short.toml").write_text(SHORT)
    words = ["run", "short.toml", "--table", "card.toml", "--speed", "max", "--out", "out"]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0, result.stdout
    reminder = "table_acc_m_s2 (serial LW 12): its calibration was due on 2021-03-11"
    assert f"warning: {reminder}" in result.stdout
    (event,) = (
        event
        for event in read_recording(Path("out/run.mcap")).records(Event)
        if event.kind == "calibration"
    )
    assert reminder in event.text
    assert event.index == 0
    page = Path("out/report.html").read_text(encoding="utf-8")
    assert "<h3>Sensors</h3>" in page
    assert "<b>2021-03-11, overdue</b>" in page
    assert "&lt;the institute&gt;" in page
    assert reminder in page
    output = CliRunner().invoke(app, ["verify", "out"]).stdout
    assert "serial LW 12" in output
    assert "OVERDUE when the run began" in output
    sensors = json.loads(CliRunner().invoke(app, ["verify", "out", "--json"]).stdout)["sensors"]
    assert [sensor["overdue"] for sensor in sensors if sensor["serial"]] == [True]
