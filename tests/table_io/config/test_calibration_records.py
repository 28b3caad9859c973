"""Sensor cards and calibration records: what they refuse, when they are due, where they go."""

import json
import tomllib
from datetime import date, timedelta
from itertools import product
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from table_io.config.base import PROFILES_DIR, parse_toml
from table_io.config.calibration import find_overdue_calibrations
from table_io.config.rig import RigConfig
from table_io.config.rig_file import calibrations_dir, load_rig
from table_io.config.sensor import CalibrationRecord, SensorConfig, format_calibration_toml
from table_io.errors import InputError
from tests.builders.rigs import RIG_TEXT
from tests.input_errors import raises_input_error

TODAY = date(2026, 3, 10)
HEAD = 'channel = "table_acc_m_s2"\nunit = "g"\n'


def card(*lines: str) -> str:
    """The shipped card with more lines on its table's accelerometer."""
    assert RIG_TEXT.count(HEAD) == 1
    return RIG_TEXT.replace(HEAD, HEAD + "\n".join(lines) + "\n")


def acc(*lines: str) -> SensorConfig:
    rig = parse_toml(card(*lines), RigConfig, "card")
    return rig.sensors[rig.channels.index("table_acc_m_s2")]


def test_sensor_states_instrument_and_due_date() -> None:
    sensor = acc(
        'maker = "PCB"', 'model = "3713B"', 'serial = "LW 12"', "calibrated = 2025-03-11",
        "interval_months = 12", 'certificate = "K-77"', 'calibrated_by = "the institute"',
        "shunt = 1.0", "shunt_tolerance = 0.02", "filter_hz = 500.0", "delay_ms = 0.4",
    )  # fmt: skip
    assert sensor.calibrated == "2025-03-11"
    assert sensor.due_date == "2026-03-11"
    json.dumps(sensor.model_dump())  # it is sent to a machine in another process


def test_day_that_toml_does_not_know_is_refused() -> None:
    with pytest.raises(InputError) as raised:
        parse_toml(card("calibrated = 2025-02-30"), RigConfig, "card.toml")
    assert (raised.value.where, raised.value.faults) == ("card.toml", ())


@pytest.mark.parametrize(
    ("calibrated", "months", "due"),
    [
        ("2024-01-31", 1, "2024-02-29"),
        ("2025-01-31", 1, "2025-02-28"),
        ("2025-12-01", 12, "2026-12-01"),
        ("2025-11-30", 15, "2027-02-28"),
        ("2025-03-11", 24, "2027-03-11"),
    ],
)
def test_months_end_where_a_month_ends(calibrated: str, months: int, due: str) -> None:
    assert acc(f"calibrated = {calibrated}", f"interval_months = {months}").due_date == due


def test_undated_sensors_of_a_real_table_are_overdue() -> None:
    assert find_overdue_calibrations(parse_toml(RIG_TEXT, RigConfig, "card"), TODAY) == []
    real = parse_toml(card("due = 2027-01-01"), RigConfig, "card").model_copy(
        update={"simulated": None}
    )
    (warning,) = find_overdue_calibrations(real, TODAY)
    assert "mass_acc_m_s2" in warning
    assert "table_acc_m_s2" not in warning
    assert "drive_disp_m" not in warning


@pytest.mark.parametrize("is_simulated", [True, False])
@pytest.mark.parametrize("count", [1, 2, 6])
def test_sensors_with_overdue_impossible_or_no_dates_are_counted(
    count: int, is_simulated: bool
) -> None:
    """The first `count` sensors after the command have the dates; the others are in order."""
    simulated = parse_toml(RIG_TEXT, RigConfig, "card")
    rig = simulated if is_simulated else simulated.model_copy(update={"simulated": None})
    days = {shift: (TODAY + timedelta(shift)).isoformat() for shift in (-400, -1, 0, 1, 400)}
    assert rig.sensors[0].channel == "drive_disp_m"
    for calibrated, due in product([None, -400, 0, 1, 400], [None, -1, 0, 1, 400]):
        dates = {"calibrated": days.get(calibrated or 0), "due": days.get(due or 0)}
        dates = {
            key: value
            for (key, value), shift in zip(dates.items(), (calibrated, due), strict=True)
            if shift is not None
        }
        sensors = tuple(
            sensor.model_copy(update=dates if place <= count else {"due": days[400]})
            for place, sensor in enumerate(rig.sensors)
        )
        warnings = find_overdue_calibrations(rig.model_copy(update={"sensors": sensors}), TODAY)
        channels = [sensor.channel for sensor in sensors[1 : count + 1]]
        if due == -1 or calibrated in (1, 400):
            assert [warning.split(":")[0] for warning in warnings] == channels
        elif not dates and not is_simulated:
            (warning,) = warnings
            assert [name for name in rig.channels if name in warning] == channels
        else:
            assert warnings == []


def record(channel: str = "table_acc_m_s2", **other: object) -> CalibrationRecord:
    known: dict[str, object] = {
        "channel": channel, "unit": "g", "serial": "LW 12", "at": "2026-03-10T10:00:00+00:00",
        "by": "anna", "method": "points", "applied": (-1.0, 1.0), "volts": (-5.0, 5.005),
        "volts_sd": (1e-5, 1e-5), "volts_per_unit": 5.0025, "volts_per_unit_sd": 1e-5,
        "offset": 5e-4, "offset_sd": 1e-6, "card_volts_per_unit": 5.0, "departure_percent": 0.05,
        "departure_sd": 250.0, "tolerance_percent": 1.0, "passed": True,
    }  # fmt: skip
    return CalibrationRecord.model_validate(known | other)


@given(st.text(st.characters(exclude_categories=["Cs"])), st.floats(-1e9, 1e9))
def test_record_comes_back_from_its_file_as_it_was(by: str, number: float) -> None:
    calibration = record(by=by, offset=number, linearity_percent=0.1)
    (raw,) = tomllib.loads(format_calibration_toml(calibration))["calibrations"]
    assert CalibrationRecord.model_validate(raw) == calibration


@pytest.fixture
def path(tmp_path: Path) -> Path:
    file = tmp_path / "mine.toml"
    file.write_text(RIG_TEXT, encoding="utf-8")
    return file


def put(path: Path, name: str, calibration: CalibrationRecord) -> None:
    folder = calibrations_dir(path)
    folder.mkdir(exist_ok=True)
    (folder / name).write_text(format_calibration_toml(calibration), encoding="utf-8")


def test_card_without_records_is_read_as_it_is(path: Path) -> None:
    rig, text = load_rig(path)
    assert text == RIG_TEXT
    assert rig.calibrations == ()


def test_newest_record_of_each_channel_goes_into_the_text_of_the_card(path: Path) -> None:
    put(path, "20260101-000000-table_acc_m_s2.toml", record(by="old"))
    put(path, "20260201-000000-table_acc_m_s2.toml", record(by="new"))
    put(path, "20250101-000000-mass_acc_m_s2.toml", record("mass_acc_m_s2"))
    rig, text = load_rig(path)
    assert {(calibration.channel, calibration.by) for calibration in rig.calibrations} == {
        ("table_acc_m_s2", "new"),
        ("mass_acc_m_s2", "anna"),
    }
    assert text.startswith(RIG_TEXT)
    assert parse_toml(text, RigConfig, "as recorded") == rig
    # a record tells; it changes nothing that is measured
    assert rig.sensors == parse_toml(RIG_TEXT, RigConfig, "card").sensors


def test_newest_record_is_so_by_its_time_and_not_by_the_name_of_its_file(path: Path) -> None:
    old = {"by": "old", "at": "2020-01-01T00:00:00+00:00"}
    put(path, "20260301-000000-table_acc_m_s2.toml", record(by="new", at="2026-03-01T00:00:00"))
    put(path, "first.toml", record(**old))
    put(path, "zzz.toml", record("mass_acc_m_s2"))
    both = format_calibration_toml(record("mass_acc_m_s2", by="two")) + format_calibration_toml(
        record(**old)
    )
    (calibrations_dir(path) / "two.toml").write_text(both)
    rig, _ = load_rig(path)
    assert sorted((calibration.channel, calibration.by) for calibration in rig.calibrations) == [
        ("mass_acc_m_s2", "anna"),
        ("table_acc_m_s2", "new"),
    ]


@pytest.mark.parametrize("at", ["x", "", "2026-13-01T00:00:00"])
def test_record_without_a_time_is_refused(path: Path, at: str) -> None:
    put(path, "one.toml", record())
    (file,) = calibrations_dir(path).glob("*.toml")
    file.write_text(file.read_text().replace(record().at, at))
    with raises_input_error(where=str(file), key="at") as raised:
        load_rig(path)
    assert (raised.value.value, raised.value.allowed[:8]) == (at, "ISO 8601")


def test_bad_record_is_named_by_its_own_file(path: Path) -> None:
    put(path, "20260101-000000-table_acc_m_s2.toml", record())
    (file,) = calibrations_dir(path).glob("*.toml")
    file.write_text(file.read_text().replace("offset =", "ofset ="))
    with raises_input_error(where=str(file)) as raised:
        load_rig(path)
    remedies = {fault.key: fault.remedy for fault in raised.value.faults}
    assert remedies["calibrations.0.ofset"] == "did you mean 'offset'?"


def test_simulated_cards_differ_from_the_first_only_in_how_they_are_reached() -> None:
    first = parse_toml(RIG_TEXT, RigConfig, "card").model_dump(exclude={"name", "title", "backend"})
    for path in (PROFILES_DIR / "rigs").glob("*_simulated.toml"):
        other = load_rig(path)[0]
        reached = {"machine", "ni", "opendaq", "udp", "follow"}
        assert other.model_dump(exclude={"name", "title", "backend"} | reached) == {
            key: value for key, value in first.items() if key not in reached
        }, path
        assert getattr(other, other.backend) is not None
