"""The sensors of a recording, as their cards were: which instruments, calibrated when, tared by."""

from dataclasses import dataclass
from typing import Any

from pydantic import ValidationError

from table_io.calibration_record import Calibration
from table_io.card import C
from table_io.channels import BY_NAME
from table_io.records import RunStart
from table_io.sensor import Sensor
from twin.service.evidence import cards


@dataclass(frozen=True, slots=True)
class SensorRow:
    """One sensor; `overdue` when the run began, `checked` by its newest calibration record."""

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


def sensor_rows(start: RunStart) -> list[SensorRow]:
    """A row for each sensor of the machine card, and for what was tared without one."""
    card = cards(start.rig_toml)
    records = {one.channel: one for one in _valid(Calibration, card.get("calibrations"))}
    sensors = {one.channel: one for one in _valid(Sensor, card.get("sensors"))}
    rows = [
        _row(one, records.get(one.channel), start) for one in sensors.values()
    ]  # fmt: skip
    bare = (name for name in start.tare if name not in sensors)
    return rows + [
        SensorRow(name, "", "", "", "", "", False, "", "", start.tare[name], _si(name))
        for name in bare
    ]


def _row(sensor: Sensor, record: Calibration | None, start: RunStart) -> SensorRow:
    due = sensor.due_on or ""
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


def _si(channel: str) -> str:
    return BY_NAME[channel].unit if channel in BY_NAME else ""


def _valid(kind: type[C], raw: Any) -> list[C]:
    """The cards of a list that are valid: what was recorded is shown as far as it can be."""
    found = []
    for one in raw if isinstance(raw, list) else []:
        try:
            found.append(kind.model_validate(one))
        except ValidationError:
            continue
    return found
