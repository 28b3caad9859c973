"""Bytes altered at random in what the product writes: noticed where it is read, or harmless.

    python -m tests.studies.altered_bytes --count 200 --seed 1

In turn in a study of `map`, a recording, a drive, a twin of a table and a tare. An alteration is
harmless if every value that is read is the same as before.
"""

import argparse
import random
import shutil
from collections import Counter
from collections.abc import Callable, Hashable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from table_io.config.base import load_config
from table_io.config.excitation.drive_file import DriveHeader, format_drive, parse_drive
from table_io.config.provenance import Provenance, seal_text
from table_io.config.tare import TareFile, TareRecord, format_tare_toml
from table_io.errors import InputError
from tests.cli.test_hostile_toml import OWN
from tests.studies.random_laws import PROFILE
from tests.sweeps.small_study import make_stored_study, write_study
from twin.earthquakes.result import load_table_twin
from twin.recording.reader import read_recording
from twin.setup.run_config import read_run_config
from twin.setup.unpaced import play_unpaced
from twin.studies.maps.results import open_study
from twin.transport.codec import encode_item, topic_for

TARGET_M = 1e-3 * np.sin(np.linspace(0.0, 6 * np.pi, 400)) * np.hanning(400)


def read_study_values(folder: Path) -> Hashable:
    """Return everything that `open_study` returns, as bytes and text."""
    data = open_study(folder).load()
    arrays = tuple((name, array.values.tobytes()) for name, array in data.variables.items())
    return arrays, str(data.attrs), str([array.attrs for array in data.variables.values()])


def read_log_values(path: Path) -> Hashable:
    """Return all messages of a recording that says that it is whole."""
    recording = read_recording(path)
    if not recording.is_intact:
        raise InputError("cut off or damaged", where=path)
    return tuple((topic_for(item), encode_item(item, "run")) for item in recording.items)


def read_drive_values(path: Path) -> Hashable:
    return parse_drive(path.read_text(encoding="utf-8"), path.name, TARGET_M).tobytes()


def read_twin_values(path: Path) -> Hashable:
    return load_table_twin(path).model_dump_json()


def read_tare_values(path: Path) -> Hashable:
    return load_config(path, TareFile, "tare")[0].tare.model_dump_json()


def write_artefacts(folder: Path) -> dict[str, tuple[Path, Callable[[Path], Hashable]]]:
    """Write one artefact of each kind; return its path and reader by kind."""
    make_stored_study(write_study(folder), folder / "study", range(5))
    (folder / "short.toml").write_text(PROFILE)
    config = read_run_config(folder / "short.toml")
    play_unpaced(config, "run", folder / "run.mcap", lambda: None, lambda _: None)
    provenance = Provenance(code="0.2.0", levels_m_s2=(0.5,))
    drive = format_drive(
        1.02 * TARGET_M, TARGET_M, "drive of a test", DriveHeader(provenance=provenance)
    )
    (folder / "drive.csv").write_text(drive)
    (folder / "twin.toml").write_text(seal_text(OWN["twins"]))
    record = TareRecord(
        rig="simulated", at="2026-07-01T10:00:00+02:00", by="operator", seconds=4.0,
        channels=("mass_disp_m", "force_r1_n"), volts=(0.0123, -0.00456), noise_v=(1e-4, 2e-4),
    )  # fmt: skip
    (folder / "tare.toml").write_text(format_tare_toml(record))
    return {
        "study": (folder / "study", read_study_values),
        "recording": (folder / "run.mcap", read_log_values),
        "drive": (folder / "drive.csv", read_drive_values),
        "table twin": (folder / "twin.toml", read_twin_values),
        "tare": (folder / "tare.toml", read_tare_values),
    }


def alter_byte(path: Path, rng: random.Random) -> tuple[Path, int]:
    """Alter a byte of a file, or of one file of a folder; return which."""
    files = sorted(each for each in path.rglob("*") if each.is_file()) or [path]
    file = rng.choice(files)
    content = bytearray(file.read_bytes())
    place = rng.randrange(len(content))
    content[place] ^= rng.randrange(1, 256)
    file.write_bytes(content)
    return file, place


def judge_alteration(path: Path, read: Callable[[Path], Hashable], whole: Any) -> str:
    """Return "noticed", "harmless" or "WRONG"; another error than the product's is wrong too."""
    try:
        return "harmless" if read(path) == whole else "WRONG: other values without a word"
    except (InputError, UnicodeDecodeError):
        return "noticed"
    except Exception as error:
        return f"WRONG: {type(error).__name__}: {error}"


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    rng, ends = random.Random(options.seed), Counter[tuple[str, str]]()
    with TemporaryDirectory() as name:
        artefacts = write_artefacts(Path(name))
        values = {kind: read(path) for kind, (path, read) in artefacts.items()}
        for number in range(options.count):
            kind = [*artefacts][number % len(artefacts)]
            path, read = artefacts[kind]
            copy = path.with_name(f"altered{path.suffix}")
            (shutil.copytree if path.is_dir() else shutil.copy)(path, copy)
            file, place = alter_byte(copy, rng)
            end = judge_alteration(copy, read, values[kind])
            if end.startswith("WRONG"):
                print(f"{number} {kind} {file.relative_to(copy.parent)} at {place}: {end}")
            ends[kind, end.split(":")[0]] += 1
            (shutil.rmtree if copy.is_dir() else Path.unlink)(copy)
    for (kind, end), count in sorted(ends.items()):
        print(f"{kind}: {count} {end}")


if __name__ == "__main__":
    main()
