"""A machine card from its file, with the newest calibration record of each channel beside it."""

from pathlib import Path

from table_io.calibration_record import Records
from table_io.card import load, parse
from table_io.rig import Rig


def calibrations_of(path: Path) -> Path:
    """The folder of the calibration records of a machine card."""
    return path.with_suffix(".calibrations")


def load_rig(path: Path) -> tuple[Rig, str]:
    """(machine card, its text with the records at its end); BadInput names the file at fault."""
    _, text = load(path, Rig, "machine card")
    newest: dict[str, str] = {}
    for file in sorted(calibrations_of(path).glob("*.toml")):
        records, told = load(file, Records, "calibration record")
        for one in records.calibrations:
            newest[one.channel] = told
    text = "\n".join([text, *dict.fromkeys(newest.values())])
    return parse(text, Rig, str(path)), text
