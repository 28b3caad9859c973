"""The drive file: exactly what is planned, read back by readers that are not ours."""

import hashlib
import sys
from pathlib import Path

import numpy as np
import pytest
import pyuff
from scipy.io import loadmat, wavfile

from table_io.acquisition.external_control import plan_open_loop_drive
from table_io.block import Float1D
from table_io.config.folders import find_config
from table_io.sim.machine.table import read_drive
from tests.builders.profiles import format_test
from tests.input_errors import raises_input_error
from twin.exchange.drive_file import (
    WRITERS,
    DriveFile,
    DriveOptions,
    export_drive,
    write_drive,
)
from twin.rig.table import ExternalController, serve_table
from twin.setup.run_config import read_run_config

PROFILE = format_test(2.4, 2.6, 0.2, rig="follow_simulated", cycles=3)


@pytest.fixture(scope="module")
def profile(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("drive") / "short.toml"
    path.write_text(PROFILE)
    return path


@pytest.fixture(scope="module")
def plan(profile: Path) -> Float1D:
    """The planned drive in m: the loop check, the sweep and the rests."""
    bundle = read_run_config(profile)
    whole = plan_open_loop_drive(bundle.profile, bundle.rig)
    values: Float1D = whole.command(0, whole.rest_start + 1000)
    assert np.abs(values).max() > 1e-3
    return values


def export_file(profile: Path, folder: Path, name: str) -> Path:
    export_drive(DriveOptions(profile, folder / name))
    return folder / name


def test_csv_says_unit_rate_and_hash(profile: Path, plan: Float1D, tmp_path: Path) -> None:
    path = export_file(profile, tmp_path, "drive.csv")
    head = path.read_text().splitlines()[:5]
    digest = hashlib.sha256(plan.astype("<f8").tobytes()).hexdigest()
    assert f"# sha256 {digest}" in head
    assert "# rate_hz 2000.0" in head
    assert "# unit mm, right positive" in head
    assert head[-1] == "time_s,drive_disp_mm"
    table = np.genfromtxt(path, delimiter=",", names=True, skip_header=4)
    assert np.abs(table["drive_disp_mm"] * 1e-3 - plan).max() < 1e-12
    assert np.abs(table["time_s"] - np.arange(plan.size) / 2000.0).max() < 1e-7


def test_txt_is_two_columns_and_nothing_else(profile: Path, plan: Float1D, tmp_path: Path) -> None:
    rows = np.loadtxt(export_file(profile, tmp_path, "drive.txt"))
    assert rows.shape == (plan.size, 2)
    assert np.abs(rows[:, 1] * 1e-3 - plan).max() < 1e-12


def test_uff_is_read_by_pyuff(profile: Path, plan: Float1D, tmp_path: Path) -> None:
    path = export_file(profile, tmp_path, "drive.uff")
    held = pyuff.UFF(str(path)).read_sets(0)
    assert held["type"] == 58
    assert held["func_type"] == 1
    assert held["abscissa_inc"] == pytest.approx(5e-4)
    assert held["abscissa_spacing"] == 1
    assert held["ordinate_axis_units_lab"].strip() == "m"
    assert held["abscissa_spec_data_type"] == 17
    assert held["ordinate_spec_data_type"] == 8
    assert np.abs(held["data"] - plan).max() < 1e-13


def test_mat_is_read_by_scipy(profile: Path, plan: Float1D, tmp_path: Path) -> None:
    held = loadmat(export_file(profile, tmp_path, "drive.mat"))
    assert np.array_equal(held["displacement_mm"][:, 0], plan * 1e3)
    assert float(held["rate_hz"][0, 0]) == 2000.0


def test_wav_is_read_by_scipy(profile: Path, plan: Float1D, tmp_path: Path) -> None:
    """Full scale is the span of the card, 60 mm."""
    rate, values = wavfile.read(export_file(profile, tmp_path, "drive.wav"))
    assert rate == 2000
    assert values.dtype == np.int32
    assert np.abs(values / (2**31 - 1) * 0.06 - plan).max() < 0.06 / 2**31


def test_rpc_is_laid_out_as_specified(profile: Path, plan: Float1D, tmp_path: Path) -> None:
    """Records of 128 bytes, four a block of 512; the first three at fixed places; then frames."""
    raw = export_file(profile, tmp_path, "drive.rpc").read_bytes()
    records = [raw[k : k + 128] for k in range(0, 512 * 40, 128)]
    words = {
        record[:32].rstrip(b"\0").decode(): record[32:].rstrip(b"\0").decode()
        for record in records[:27]
    }
    assert list(words)[:3] == ["FORMAT", "NUM_HEADER_BLOCKS", "NUM_PARAMS"]
    blocks, frames = int(words["NUM_HEADER_BLOCKS"]), int(words["FRAMES"])
    assert 4 * (blocks - 1) < int(words["NUM_PARAMS"]) <= 4 * blocks
    assert float(words["DELTA_T"]) == 5e-4
    assert (words["DATA_TYPE"], words["INT_FULL_SCALE"]) == ("SHORT_INTEGER", "32768")
    values = np.frombuffer(raw[512 * blocks :], dtype="<i2") * float(words["SCALE.CHAN_1"])
    assert values.size == frames * int(words["PTS_PER_FRAME"])
    assert np.abs(values[: plan.size] * 1e-3 - plan).max() < 0.51 * plan.max() / 32752
    assert not values[plan.size :].any()


def test_rpc_is_read_by_another_reader(profile: Path, plan: Float1D, tmp_path: Path) -> None:
    reader = pytest.importorskip("rpc_reader.rpc_reader", reason="needs pip install rpc_reader")
    rpc = reader.ReadRPC(export_file(profile, tmp_path, "drive.rpc"))
    rpc.import_rpc_data_from_file()
    assert rpc.get_channels()[0]["Units"] == "mm"
    read = rpc.get_data()[: plan.size, 0] * 1e-3
    assert np.abs(read - plan).max() < 0.51 * plan.max() / 32752


@pytest.mark.parametrize("name", ["drive.csv", "drive.txt"])
def test_the_simulated_controller_reads_it(
    name: str, profile: Path, plan: Float1D, tmp_path: Path
) -> None:
    values, rate = read_drive(export_file(profile, tmp_path, name))
    assert rate == 2000.0
    assert np.abs(values - plan).max() < 1e-12


def test_export_drive_refuses_bad_input(profile: Path, tmp_path: Path) -> None:
    path = export_file(profile, tmp_path, "drive.csv")
    with raises_input_error(where=f"-o {path}"):
        export_drive(DriveOptions(profile, path))
    with raises_input_error(where="--format '.doc'", allowed="csv, txt"):
        export_drive(DriveOptions(profile, tmp_path / "drive.doc"))
    with raises_input_error(key="[track]"):
        export_drive(DriveOptions(find_config("track", "tests"), tmp_path / "track.csv"))
    (tmp_path / "empty.csv").write_text("nothing\n")
    with raises_input_error(where=f"--play {tmp_path / 'empty.csv'}", remedy="shaketwin drive"):
        read_drive(tmp_path / "empty.csv")


def test_a_rate_that_wav_cannot_say_leaves_no_file(tmp_path: Path) -> None:
    file = DriveFile("x", np.zeros(10), 1000.5, 60.0)
    with raises_input_error(where="--format wav", problem="1000.5 Hz"):
        write_drive(tmp_path / "x.wav", "wav", file)
    assert not (tmp_path / "x.wav").exists()


@pytest.mark.parametrize("kind", sorted(WRITERS))
def test_a_name_beyond_ascii_is_written(kind: str, tmp_path: Path) -> None:
    path = tmp_path / f"pr\u00fcfung.{kind}"
    write_drive(
        path, kind, DriveFile("pr\u00fcfung", 0.01 * np.sin(np.arange(100) / 9.0), 1000.0, 60.0)
    )
    assert path.stat().st_size > 0
    assert list(tmp_path.iterdir()) == [path]


def test_what_cannot_be_written_leaves_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path, _: DriveFile) -> None:
        path.write_text("half")
        raise OSError(28, "No space left on device")

    monkeypatch.setitem(WRITERS, "csv", full)
    with raises_input_error(where=f"-o {tmp_path / 'x.csv'}", problem="No space left on device"):
        write_drive(tmp_path / "x.csv", "csv", DriveFile("x", np.zeros(10), 1000.0, 60.0))
    assert not list(tmp_path.iterdir())


def test_drive_file_with_nan_is_refused(tmp_path: Path) -> None:
    (tmp_path / "nan.txt").write_text("0 0\n0.0005 nan\n0.001 1\n")
    with raises_input_error(where=f"--play {tmp_path / 'nan.txt'}"):
        read_drive(tmp_path / "nan.txt")


@pytest.mark.parametrize("after", [0.0, -1.0, 0.4, float("nan")])
def test_start_delay_below_its_minimum_is_refused(after: float) -> None:
    with raises_input_error(where=f"--after {after:g}", allowed="0.5 s"):
        serve_table(
            "follow_simulated",
            None,
            None,
            1.0,
            sys.stdout,
            controller=ExternalController(None, 0.0, after),
        )
