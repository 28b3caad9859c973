"""Loading of a rig file together with the newest calibration record of each channel."""

from datetime import UTC, datetime
from pathlib import Path

from table_io.config.base import load_config, parse_toml
from table_io.config.rig import RigConfig, require_backend
from table_io.config.sensor import CalibrationFile, CalibrationRecord, format_calibration_toml
from table_io.config.tare import TareFile, TareRecord, format_tare_toml
from table_io.errors import InputError


def calibrations_dir(path: Path) -> Path:
    """Return the folder of the calibration records of a rig file."""
    return path.with_suffix(".calibrations")


def tares_dir(path: Path) -> Path:
    """Return the folder of the tares of a rig file."""
    return path.with_suffix(".tares")


def load_rig(path: Path) -> tuple[RigConfig, str]:
    """Load (rig config, its text with the calibration records and the newest tare appended).

    InputError names a faulty file, and a backend that is not installed.
    """
    rig, text = load_config(path, RigConfig, "rig file")
    require_backend(rig.backend, path)
    for name in (rig.model_extra or {}).keys() - rig.sections.keys():
        require_backend(name, path, key=f"[{name}]")
    newest: dict[str, tuple[datetime, CalibrationRecord]] = {}
    for file in sorted(calibrations_dir(path).glob("*.toml")):
        records, _ = load_config(file, CalibrationFile, "calibration record")
        for record in records.calibrations:
            made_at, previous = _parse_time(record.at, file), newest.get(record.channel)
            if previous is None or made_at >= previous[0]:
                newest[record.channel] = made_at, record
    texts = [text, *(format_calibration_toml(record) for _, record in newest.values())]
    tares: list[tuple[datetime, TareRecord]] = []
    for file in sorted(tares_dir(path).glob("*.toml")):
        record_of_tare = load_config(file, TareFile, "tare")[0].tare
        made_at = _parse_time(record_of_tare.at, file)
        if record_of_tare.rig == rig.name:
            tares.append((made_at, record_of_tare))
    if tares:
        texts.append(format_tare_toml(max(tares, key=lambda entry: entry[0])[1]))
    text = "\n".join(texts)
    return parse_toml(text, RigConfig, str(path)), text


def _parse_time(at: str, file: Path) -> datetime:
    """Parse the time of a record, UTC if it has no time zone; InputError names its file."""
    try:
        made_at = datetime.fromisoformat(at)
    except ValueError:
        raise InputError(
            "not a time",
            where=file,
            key="at",
            value=at,
            allowed="ISO 8601, for example 2026-03-10T10:00:00+00:00",
            remedy="correct it or remove this record",
        ) from None
    return made_at if made_at.tzinfo is not None else made_at.replace(tzinfo=UTC)
