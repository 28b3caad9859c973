"""Sensor table of a recording: instrument, calibration and tare as configured for the run."""

from dataclasses import dataclass
from typing import Any

from pydantic import ValidationError

from table_io.config.base import ConfigT
from table_io.config.channel import read_channels
from table_io.config.sensor import CalibrationRecord, SensorConfig
from table_io.records import RunStart
from twin.results.summary import parse_toml_tables


@dataclass(frozen=True, slots=True)
class SensorRow:
    """Row of a sensor; `overdue` at the start of the run, `checked`: newest calibration record."""

    channel: str
    instrument: str
    serial: str
    sensitivity: str
    calibrated: str
    due: str
    overdue: bool
    certificate: str
    checked: str
    tare: float | None  # in `unit`
    unit: str


def build_sensor_rows(start: RunStart) -> list[SensorRow]:
    """Build a row for each sensor of the rig file and each tared channel without a sensor entry."""
    rig_tables = parse_toml_tables(start.rig_toml)
    records = {
        record.channel: record
        for record in _parse_valid(CalibrationRecord, rig_tables.get("calibrations"))
    }
    sensors = {
        sensor.channel: sensor for sensor in _parse_valid(SensorConfig, rig_tables.get("sensors"))
    }
    rows = [
        _build_row(sensor, records.get(sensor.channel), start) for sensor in sensors.values()
    ]  # fmt: skip
    unlisted = (name for name in start.tare if name not in sensors)
    channels = read_channels(start.rig_toml)
    units = {name: channel.unit for name, channel in channels.items()}
    return rows + [
        SensorRow(name, "", "", "", "", "", False, "", "", start.tare[name], units.get(name, ""))
        for name in unlisted
    ]


def _build_row(
    sensor: SensorConfig, record: CalibrationRecord | None, start: RunStart
) -> SensorRow:
    due = sensor.due_date or ""
    tare = start.tare.get(sensor.channel)
    return SensorRow(
        sensor.channel,
        " ".join(filter(None, (sensor.maker, sensor.model))),
        sensor.serial,
        f"{sensor.volts_per_unit:.6g} V/{sensor.unit}",
        " by ".join(filter(None, (sensor.calibrated, sensor.calibrated_by))),
        due,
        bool(due) and due < start.started_at[:10],
        sensor.certificate,
        f"{record.at[:10]}: {record.departure_percent:+.2g} %" if record is not None else "",
        None if tare is None else tare / sensor.si_per_unit,
        sensor.unit,
    )


def _parse_valid(config_class: type[ConfigT], raw: Any) -> list[ConfigT]:
    """Parse a list of tables, skipping invalid ones so that the valid ones are still shown."""
    configs = []
    for table in raw if isinstance(raw, list) else []:
        try:
            configs.append(config_class.model_validate(table))
        except ValidationError:
            continue
    return configs
