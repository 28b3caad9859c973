"""A backend in a package of its own: CONNECT.md's example, installed, runs; without it, refused."""

import json
import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

import pytest

from table_io.backends import find_descriptor, open_backend, open_source
from table_io.clock import ManualClock
from table_io.config.base import PROFILES_DIR, load_config, parse_toml
from table_io.config.plugins import list_entry_points
from table_io.config.profile import Profile
from table_io.config.rig import BACKEND_GROUP, RigConfig, load_backend
from table_io.config.rig_file import load_rig
from table_io.errors import InputError
from table_io.sim.machine.table import SIMULATOR_GROUP, find_simulator
from tests.builders.profiles import format_test
from tests.builders.rigs import read_rig_text
from tests.command_line import call_main
from tests.input_errors import raises_input_error

ROOT = Path(__file__).resolve().parents[3]
SHAKETWIN = str(Path(sys.executable).parent / "shaketwin")
PAGE = (ROOT / "table_io" / "CONNECT.md").read_text(encoding="utf-8").partition("## 9.")[2]
MODULE, PROJECT = (
    re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)[0] for language in ("python", "toml")
)
UDP_RIG = read_rig_text("udp_example")
RIG = re.sub(r"\[udp\].*?(?=\[limits\])", "[ideal]\ngain = 1.0\n\n", UDP_RIG, flags=re.DOTALL)
RIG = RIG.replace('"udp"', '"ideal"').replace("udp_example", "ideal")
PROFILE = format_test(2.4, 2.8, 0.4, cycles=5)
ACQUIRES = """
from table_io.backends import BackendDescriptor
from table_io.config.rig import BackendConfig

class Inputs:
    def __init__(self, rig, rate_hz, clock):
        self.channels, self.rate_hz = rig.channels, rate_hz

BACKEND = BackendDescriptor(config=BackendConfig, open_source=Inputs)
"""
ENTRY = "ideal = ideal_table:BACKEND"


def install(
    site: Path, module: str = MODULE, entry: str = ENTRY, name: str = "ideal_table"
) -> Path:
    """Install a module with one entry point, as pip does."""
    info = site / f"{name}-0.1.dist-info"
    info.mkdir(parents=True)
    (site / f"{name}.py").write_text(module)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 0.1\n")
    (info / "entry_points.txt").write_text(f"[{BACKEND_GROUP}]\n{entry}\n")
    return site


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder of packages that this process finds too; what it imports from there is forgotten."""

    def forget() -> None:
        load_backend.cache_clear()
        list_entry_points.cache_clear()
        sys.modules.pop("ideal_table", None)

    folder = tmp_path / "site"
    monkeypatch.syspath_prepend(folder)
    forget()
    yield folder
    forget()


def shaketwin(folder: Path, *words: str, site: Path) -> tuple[int, str]:
    """Exit code and output of a command in a folder, with the packages of a site."""
    paths = [str(site), os.environ.get("PYTHONPATH", "")]
    process = subprocess.run(
        [SHAKETWIN, *words],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths))},
        capture_output=True,
        text=True,
        check=False,
    )
    return process.returncode, process.stdout + process.stderr


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a rig file of the example, a short test, and the package next to them."""
    folder = tmp_path_factory.mktemp("lab")
    entries = tomllib.loads(PROJECT)["project"]["entry-points"][BACKEND_GROUP]
    ((name, value),) = entries.items()
    install(folder / "site", entry=f"{name} = {value}")
    (folder / "rig.toml").write_text(RIG)
    (folder / "two.toml").write_text(PROFILE)
    return folder


@pytest.mark.slow  # 10 s
def test_example_is_checked_runs_and_is_replayed_without_its_package(lab: Path) -> None:
    site = lab / "site"
    table = ("two.toml", "--table", "rig.toml")
    code, text = shaketwin(lab, "check", *table, "--out", "checked", site=site)
    assert code == 0, text
    code, text = shaketwin(lab, "run", *table, "--speed", "max", "--out", "run", site=site)
    assert code == 0, text
    summary = json.loads((lab / "run" / "summary.json").read_text())
    assert (summary["verdict"], summary["gaps"], len(summary["steps"])) == ("complete", 0, 4)
    peaks = [step["table_acc_peak_m_s2"] for step in summary["steps"]]
    assert peaks == pytest.approx([0.05 * 9.80665] * 4, rel=0.02)
    replay = call_main("replay", "run/run.mcap", "--out", "replayed", cwd=lab)
    assert replay.returncode == 0, replay.stderr


def test_backend_that_is_not_installed_is_named_with_file_and_choice(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(RIG)
    with pytest.raises(InputError) as caught:
        load_rig(path)
    error = caught.value
    assert (error.where, error.key, error.value) == (str(path), "backend", "ideal")
    assert error.allowed.split(", ") == sorted(list_entry_points(BACKEND_GROUP))
    assert "install" in error.remedy
    rig = parse_toml(RIG, RigConfig, "a recording")  # is read all the same
    assert rig.model_extra == {"ideal": {"gain": 1.0}}
    assert not rig.runs_at_any_speed
    with raises_input_error(key="backend", value="ideal"):
        find_descriptor(rig)


def test_section_of_a_plugin_is_read_as_strictly_as_ours(site: Path) -> None:
    install(site)
    rig = parse_toml(RIG, RigConfig, "rig.toml")
    assert rig.runs_at_any_speed
    assert rig.is_simulated
    assert rig.sections["ideal"].model_dump() == {"gain": 1.0}
    with pytest.raises(InputError) as caught:
        parse_toml(RIG.replace("gain = 1.0", "gan = 1").replace("span_v", "spam"), RigConfig, "x")
    remedies = {fault.key: fault.remedy for fault in caught.value.faults}
    assert remedies["ideal.gan"] == "did you mean 'gain'?"
    assert remedies["output.spam"] == "did you mean 'span_mm'?"
    with pytest.raises(InputError) as caught:
        parse_toml(RIG.replace("[ideal]\ngain = 1.0", ""), RigConfig, "x")
    assert [fault.key for fault in caught.value.faults] == ["ideal"]


def test_source_does_not_drive(site: Path, tmp_path: Path) -> None:
    install(site, ACQUIRES)
    profile = parse_toml(PROFILE, Profile, "two.toml")
    rig = parse_toml(RIG.replace("gain = 1.0", ""), RigConfig, "rig.toml")
    assert not rig.under_external_control
    with raises_input_error(key="backend", value="ideal", remedy="follow"):
        open_backend(rig, profile, ManualClock())
    followed = RIG.replace("gain = 1.0", '[follow]\nsource = "ideal"').replace(
        'backend = "ideal"', 'backend = "follow"'
    )
    rig = parse_toml(followed, RigConfig, "rig.toml")
    assert rig.under_external_control
    assert open_source(rig, 2000.0, ManualClock()).channels == rig.channels
    # The same files in other processes: a run of the first is refused, before anything starts.
    (tmp_path / "rig.toml").write_text(RIG.replace("gain = 1.0", ""))
    (tmp_path / "two.toml").write_text(PROFILE)
    words = ("run", "two.toml", "--table", "rig.toml", "--out", "none")
    code, text = shaketwin(tmp_path, *words, site=site)
    assert code == 2, text
    assert not (tmp_path / "none").exists()


def test_recording_that_followed_a_plugin_is_read_without_it(tmp_path: Path) -> None:
    followed = RIG.replace("gain = 1.0", '[follow]\nsource = "ideal"').replace(
        'backend = "ideal"', 'backend = "follow"'
    )
    assert parse_toml(followed, RigConfig, "a recording").under_external_control
    path = tmp_path / "rig.toml"
    path.write_text(followed)
    with raises_input_error(key="[ideal]", value="ideal"):
        load_rig(path)


def test_source_that_drives_is_refused(site: Path) -> None:
    install(site)
    followed = RIG.replace("gain = 1.0", 'gain = 1.0\n[follow]\nsource = "ideal"').replace(
        'backend = "ideal"', 'backend = "follow"'
    )
    with pytest.raises(InputError) as caught:
        parse_toml(followed, RigConfig, "rig.toml")
    (fault,) = caught.value.faults
    assert fault.key == "follow"
    assert "'ideal'" in fault.problem


@pytest.mark.parametrize(
    ("module", "allowed"),
    [
        ("import a_library_that_is_not_there", ""),
        ("BACKEND = 3", "a BackendDescriptor"),
        (MODULE.replace("open=IdealTable, ", ""), "a BackendDescriptor with open or open_source"),
    ],
)
def test_unusable_plugin_is_an_error_of_input(site: Path, module: str, allowed: str) -> None:
    install(site, module)
    with pytest.raises(InputError) as caught:
        find_descriptor(parse_toml(RIG, RigConfig, "rig.toml"))
    (fault,) = caught.value.faults or (caught.value,)
    assert fault.allowed == allowed
    assert "package" in fault.remedy


def test_two_packages_with_one_name_are_refused(site: Path) -> None:
    install(site, entry="simulated = ideal_table:BACKEND")
    with raises_input_error(where=BACKEND_GROUP, key="simulated"):
        load_backend("simulated")
    assert load_backend("udp") is not None


def test_rig_files_are_read_without_any_vendor_library() -> None:
    code = (
        "import sys\n"
        "from table_io.config.base import PROFILES_DIR\n"
        "from table_io.config.rig_file import load_rig\n"
        "rigs = [load_rig(path)[0] for path in (PROFILES_DIR / 'rigs').glob('*.toml')]\n"
        "assert len({rig.backend for rig in rigs}) == 5\n"
        "late = {'nidaqmx', 'grpc', 'opendaq', 'table_io.sim.simulated_table', 'numba'}\n"
        "print(sorted(late & set(sys.modules)))\n"
    )
    process = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    assert process.stdout == "[]\n", process.stderr


@pytest.mark.parametrize("group", [BACKEND_GROUP, SIMULATOR_GROUP])
def test_installed_metadata_are_those_of_the_source(group: str) -> None:
    """If this fails alone, install again: `pip install -e .`"""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    installed = metadata.distribution("shaketwin").entry_points.select(group=group)
    assert {entry.name: entry.value for entry in installed} == project["entry-points"][group]


def test_shipped_backends_drive_or_acquire() -> None:
    profile, _ = load_config(PROFILES_DIR / "tests" / "quickstart.toml", Profile, "profile")
    served = set()
    for path in (PROFILES_DIR / "rigs").glob("*.toml"):
        rig, _ = load_rig(path)
        descriptor = find_descriptor(rig)
        assert descriptor.drives == (descriptor.open_source is None)
        assert rig.runs_at_any_speed == descriptor.any_speed
        if descriptor.drives:
            assert open_backend(rig, profile, ManualClock()).replace_after > 0
        if not descriptor.any_speed:
            served.add(rig.backend)
            assert callable(find_simulator(rig))
    assert served == {"machine", "ni", "udp", "follow"}
