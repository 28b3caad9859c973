"""What a person should hear of the calibration of a rig's sensors; it never stops a test."""

from datetime import date

from table_io.rig import Rig
from table_io.sensor import Sensor


def overdue(rig: Rig, today: date) -> list[str]:
    """A sentence for every sensor whose calibration is overdue, one for those without any.

    The command wired back is no sensor; where all is simulated nobody calibrates.
    """
    sensors = [one for one in rig.sensors if one.channel != "drive_disp_m"]
    said = [sentence for one in sensors if (sentence := _said(one, today))]
    without = [one.channel for one in sensors if one.calibrated is None and one.due is None]
    if without and rig.simulated is None:
        said.append(
            f"no date of calibration: {', '.join(without)}; add `calibrated` and `due` to their "
            "sensor cards"
        )
    return said


def _said(sensor: Sensor, today: date) -> str:
    """What is wrong with the dates of one sensor; "" where nothing is."""
    serial = f" (serial {sensor.serial})" if sensor.serial else ""
    due = sensor.due_on
    if due is not None and due < today.isoformat():
        ago = (today - date.fromisoformat(due)).days
        return (
            f"{sensor.channel}{serial}: its calibration was due on {due}, {ago} days ago; have it "
            "calibrated, and mend its sensor card"
        )
    if sensor.calibrated is not None and sensor.calibrated > today.isoformat():
        return (
            f"{sensor.channel}{serial}: calibrated on {sensor.calibrated}, which is still to come; "
            "mend its sensor card, or this computer's clock"
        )
    return ""
