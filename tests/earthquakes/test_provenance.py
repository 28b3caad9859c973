"""Twins of tables, drives and models state what they were made for, and whoever uses them looks."""

import hashlib
import math
import re
from pathlib import Path

import pytest

from table_io.config.base import format_toml, parse_toml
from table_io.config.excitation import History
from table_io.config.profile import Specimen, load_profile
from table_io.config.provenance import HashedFile, Provenance, seal_text
from table_io.config.rig import RigConfig
from table_io.errors import InputError
from table_io.safety.preflight import list_setup_warnings
from tests.builders.rigs import read_model_text, read_rig_text
from tests.command_line import call_main
from tests.earthquakes.test_table_drive import RECORD, TWIN
from twin.earthquakes.result import DriveResult, load_table_twin
from twin.earthquakes.task import TableDriveOptions, TableTwinOptions, compute_drive, identify_table
from twin.setup.run_config import list_specimen_changes, read_run_config
from twin.system.files import hash_file

RIG_TOML = read_rig_text("hydraulic")


def parse_rig(text: str = RIG_TOML) -> RigConfig:
    return parse_toml(text, RigConfig, "rig")


def write_test(
    folder: Path, rig: str = "hydraulic", twin_of: str = "hydraulic"
) -> TableDriveOptions:
    """Write a record for a rig and the twin of a table; return the options of its drive."""
    identity = HashedFile(name=twin_of, sha256=HashedFile.of_rig(parse_rig()).sha256)
    provenance = Provenance(rigs=(identity,), masses_kg=(550.0,), gaps_mm=(math.inf,))
    header = format_toml({"provenance": provenance.model_dump()})
    (folder / "record.toml").write_text(RECORD.replace('"hydraulic"', f'"{rig}"'))
    (folder / "table.toml").write_text(TWIN + header)
    return TableDriveOptions(folder / "record.toml", folder / "table.toml")


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> DriveResult:
    """Return the drive of a test that names another rig than that of the twin."""
    return compute_drive(write_test(tmp_path_factory.mktemp("drive"), rig="simulated"))


@pytest.mark.parametrize(
    ("old", "new", "is_same"),
    [
        ("# Rig file of", "# The rig file of", True),
        ('title = "Sim', 'title = "A sim', True),
        ("[limits]", "extra = 1\n[limits]", None),
        ("servo_delay_ms = 2.0", "servo_delay_ms = 3.0", False),
        ("moving_mass_kg = 2000.0\n\n", "moving_mass_kg = 2100.0\n\n", False),
        ("span_v = 10.0\n", "", True),  # the default
    ],
)
def test_the_hash_of_a_rig_is_that_of_its_meaning(old: str, new: str, is_same: bool | None) -> None:
    assert old in RIG_TOML
    changed = RIG_TOML.replace(old, new, 1)
    if is_same is None:
        with pytest.raises(InputError):
            parse_rig(changed)
        return
    assert (HashedFile.of_rig(parse_rig(changed)) == HashedFile.of_rig(parse_rig())) is is_same


def test_a_drive_is_for_the_rig_of_its_twin_by_default(drive: DriveResult, tmp_path: Path) -> None:
    """As with README's el_centro, which names another rig."""
    assert drive.config.rig.name == "hydraulic"
    assert any("hydraulic" in note and "simulated" in note for note in drive.notes)
    written = drive.save(tmp_path / "out")
    assert read_run_config(written).rig.name == "hydraulic"
    excitation = load_profile(written)[0].excitation
    assert isinstance(excitation, History)
    assert excitation.drive_header is not None
    made_for = excitation.drive_header.provenance
    assert made_for == drive.provenance
    assert made_for.rigs == (HashedFile.of_rig(parse_rig()),)
    assert (made_for.masses_kg, made_for.gaps_mm) == ((550.0,), (8.0,))
    source = hashlib.sha256(drive.profile_path.with_name("table.toml").read_bytes()).hexdigest()
    assert made_for.sources == (HashedFile(name="table.toml", sha256=source),)
    assert list_setup_warnings(read_run_config(written).profile, parse_rig()) == []


def test_a_drive_is_played_on_its_own_rig_only(drive: DriveResult, tmp_path: Path) -> None:
    written = drive.save(tmp_path / "out")
    out = tmp_path / "run"
    result = call_main("run", written, "--table", "simulated", "--speed", "max", "--out", out)
    assert result.returncode == 2
    assert "'hydraulic'" in result.stderr
    assert "'simulated'" in result.stderr
    assert "table-drive" in result.stderr
    assert not out.exists()


def test_a_twin_of_another_rig_than_the_option_names_is_refused(tmp_path: Path) -> None:
    write_test(tmp_path)
    result = call_main(
        "table-drive", tmp_path / "record.toml", "--table-twin", tmp_path / "table.toml",
        "--table", "simulated", "--out", tmp_path / "out",
    )  # fmt: skip
    assert result.returncode == 2
    assert "'hydraulic'" in result.stderr
    assert "'simulated'" in result.stderr
    assert not (tmp_path / "out").exists()


def test_a_twin_whose_rig_is_not_found_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="elsewhere") as error:
        compute_drive(write_test(tmp_path, twin_of="elsewhere"))
    assert "--table" in error.value.remedy


def test_a_drive_of_another_rig_is_computed_again_for_this_one(
    drive: DriveResult, tmp_path: Path
) -> None:
    """The drive that the profile already has does not count."""
    written = drive.save(tmp_path / "out")
    driven = written.read_text().replace('"hydraulic"', '"simulated"')
    (tmp_path / "out" / "profile.toml").write_text(driven)
    (tmp_path / "table.toml").write_text(TWIN)
    again = compute_drive(TableDriveOptions(written, tmp_path / "table.toml"))
    assert again.config.rig.name == "simulated"


def test_files_without_provenance_are_used_with_a_warning(tmp_path: Path) -> None:
    """As those of version 0.1.0: the twin is taken for that of the profile's rig."""
    options = write_test(tmp_path)
    options.table_twin.write_text(TWIN)
    drive = compute_drive(options)
    assert drive.config.rig.name == "hydraulic"
    assert "does not say which rig" in drive.notes[0]
    written = drive.save(tmp_path / "out")
    file = tmp_path / "out" / "drive.csv"
    text = re.sub(r"# \[provenance\]\n(#.*\n)*", "", file.read_text())
    file.write_text(text[: text.index("# The last line")])
    warnings = list_setup_warnings(read_run_config(written).profile, parse_rig())
    assert len(warnings) == 1
    assert "does not say which rig" in warnings[0]


def test_altered_drive_and_altered_twin_are_refused(drive: DriveResult, tmp_path: Path) -> None:
    written = drive.save(tmp_path / "out")
    file = tmp_path / "out" / "drive.csv"
    lines = file.read_text().splitlines()
    lines[len(lines) // 2] = f"{float(lines[len(lines) // 2]) + 1e-3:.6f}"
    file.write_text("\n".join([*lines, ""]))
    with pytest.raises(InputError, match=r"drive\.csv was altered after it was written"):
        read_run_config(written)
    twin = tmp_path / "twin.toml"
    twin.write_text(seal_text(TWIN).replace("residual = 0.0", "residual = 0.1", 1))
    with pytest.raises(InputError, match=r"twin\.toml: the twin of the table was altered"):
        load_table_twin(twin)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("mass_kg = 550.0", "mass_kg = 700.0", "550 kg, the test has 700 kg (+27.3 %)"),
        ("gap_mm = 8.0", "gap_mm = inf", "total gap of 8 mm, the test has no bumpers"),
        ("mass_kg = 550.0", "mass_kg = 551.0", ""),
        ("gap_mm = 8.0", "gap_mm = 8.01", ""),
    ],
)
def test_a_drive_for_another_specimen_is_warned_of(
    drive: DriveResult, tmp_path: Path, old: str, new: str, words: str
) -> None:
    written = drive.save(tmp_path / "out")
    written.write_text(written.read_text().replace(old, new))
    warnings = list_setup_warnings(read_run_config(written).profile, parse_rig())
    assert len(warnings) == bool(words)
    assert words in " ".join(warnings)


def test_a_rig_file_that_changed_since_the_drive_is_warned_of(
    drive: DriveResult, tmp_path: Path
) -> None:
    profile = read_run_config(drive.save(tmp_path / "out")).profile
    changed = parse_rig(RIG_TOML.replace("servo_delay_ms = 2.0", "servo_delay_ms = 9.0"))
    (warning,) = list_setup_warnings(profile, changed)
    assert "hydraulic has changed" in warning


def test_the_command_writes_the_drive_of_the_task(drive: DriveResult, tmp_path: Path) -> None:
    result = call_main(
        "table-drive", drive.profile_path, "--table-twin",
        drive.profile_path.with_name("table.toml"), "--out", tmp_path / "out",
    )  # fmt: skip
    assert result.returncode == 0
    assert "the drive is for rig hydraulic" in result.stdout
    assert (tmp_path / "out" / "drive.csv").read_text() == drive.format_drive()
    assert drive.expected_error is not None
    assert f"{100 * drive.expected_error:.2g} %" in result.stdout


def test_a_twin_file_keeps_its_provenance(tmp_path: Path) -> None:
    twin = load_table_twin(write_test(tmp_path).table_twin)
    assert twin.provenance is not None
    assert twin.provenance.gaps_mm == (math.inf,)


@pytest.mark.slow  # 60 s
def test_the_command_writes_the_twin_of_the_task(tmp_path: Path) -> None:
    """With the hash of its recording, and the specimen, level and rig of that."""
    test = tmp_path / "record.toml"
    test.write_text(RECORD.replace("duration_s = 8.0", "duration_s = 12.0"))
    run = tmp_path / "run"
    assert call_main("run", test, "--speed", "max", "--out", run).returncode == 0
    out = tmp_path / "table.toml"
    assert call_main("table-twin", run, "--no-effects", "--out", out).returncode == 0
    result = identify_table(TableTwinOptions(run, with_effects=False))
    assert out.read_text() == result.format_toml()
    made_for = load_table_twin(out).provenance
    assert made_for is not None
    assert made_for.rigs == (HashedFile.of_rig(parse_rig()),)
    assert (made_for.masses_kg, made_for.gaps_mm) == ((550.0,), (8.0,))
    assert made_for.levels_m_s2[0] == load_profile(test)[0].plan.level_m_s2
    assert made_for.sources[0].sha256 == hash_file(run / "run.mcap")


@pytest.mark.parametrize(
    ("mass_kg", "gap_mm", "words"),
    [
        (550.0, math.inf, ""),
        (552.0, math.inf, ""),
        (700.0, math.inf, "550 kg, the test has 700 kg (+27.3 %)"),
        (550.0, 4.0, "without bumpers, the test has some at a total gap of 4 mm"),
    ],
)
def test_a_model_of_another_specimen_is_warned_of(
    mass_kg: float, gap_mm: float, words: str
) -> None:
    """With the specimen that its parameters do not describe; a gap as such is no difference."""
    provenance = Provenance(masses_kg=(550.0,), gaps_mm=(math.inf,))
    text = read_model_text("snm")
    text += "\n" + format_toml({"provenance": provenance.model_dump()})
    warnings = list_specimen_changes(text, Specimen(mass_kg=mass_kg, gap_mm=gap_mm))
    assert len(warnings) == bool(words)
    assert words in " ".join(warnings)
