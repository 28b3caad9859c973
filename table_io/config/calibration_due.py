"""Calibration reminders: overdue or undated sensors of a rig. They never stop a test."""

from datetime import date

from table_io.config.rig import RigConfig
from table_io.config.sensor import SensorConfig


def find_overdue_calibrations(rig: RigConfig, today: date) -> list[str]:
    """Return one warning per sensor with an overdue calibration, and one for all undated ones.

    The command read back is not a sensor; a simulated rig needs no calibration dates.
    """
    sensors = [sensor for sensor in rig.sensors if sensor.channel != "drive_disp_m"]
    warnings = [sentence for sensor in sensors if (sentence := _format_due_warning(sensor, today))]
    undated = [
        sensor.channel for sensor in sensors if sensor.calibrated is None and sensor.due is None
    ]
    if undated and not rig.is_simulated:
        warnings.append(
            f"no date of calibration: {', '.join(undated)}; add `calibrated` and `due` to their "
            "[[sensors]] tables in the rig file"
        )
    return warnings


def _format_due_warning(sensor: SensorConfig, today: date) -> str:
    """Describe a fault in the calibration dates of one sensor; "" if there is none."""
    serial = f" (serial {sensor.serial})" if sensor.serial else ""
    due = sensor.due_date
    if due is not None and due < today.isoformat():
        ago = (today - date.fromisoformat(due)).days
        return (
            f"{sensor.channel}{serial}: its calibration was due on {due}, {ago} days ago; have it "
            "calibrated and update its [[sensors]] table in the rig file"
        )
    if sensor.calibrated is not None and sensor.calibrated > today.isoformat():
        return (
            f"{sensor.channel}{serial}: calibrated on {sensor.calibrated}, which is in the future; "
            "correct its [[sensors]] table in the rig file, or the clock of this computer"
        )
    return ""
