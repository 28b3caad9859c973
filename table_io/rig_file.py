"""A machine card from its file, with the newest calibration record of each channel beside it."""

from datetime import UTC, datetime
from pathlib import Path

from table_io.calibration_record import Calibration, Records, toml_of
from table_io.card import BadInput, load, parse
from table_io.rig import Rig


def calibrations_of(path: Path) -> Path:
    """The folder of the calibration records of a machine card."""
    return path.with_suffix(".calibrations")


def load_rig(path: Path) -> tuple[Rig, str]:
    """(machine card, its text with the records at its end); BadInput names the file at fault."""
    _, text = load(path, Rig, "machine card")
    newest: dict[str, tuple[datetime, Calibration]] = {}
    for file in sorted(calibrations_of(path).glob("*.toml")):
        records, _ = load(file, Records, "calibration record")
        for one in records.calibrations:
            at, before = _moment(one.at, file), newest.get(one.channel)
            if before is None or at >= before[0]:
                newest[one.channel] = at, one
    text = "\n".join([text, *(toml_of(one) for _, one in newest.values())])
    return parse(text, Rig, str(path)), text


def _moment(at: str, file: Path) -> datetime:
    """When a record was made; without a time zone that of Greenwich. BadInput names its file."""
    try:
        when = datetime.fromisoformat(at)
    except ValueError:
        raise BadInput(
            f"{file}: at = {at!r} is no time; allowed: ISO 8601, as 2026-03-10T10:00:00+00:00"
        ) from None
    return when if when.tzinfo is not None else when.replace(tzinfo=UTC)
