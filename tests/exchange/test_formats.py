"""Other people's formats: the same recording out of each, and what none of them may do to us."""

import errno
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from table_io.block import Float1D
from table_io.errors import InputError
from table_io.formats import read_table
from table_io.formats.table import ForeignTable
from tests.input_errors import raises_input_error
from twin.exchange.columns import ColumnMap, ImportedSamples, read_samples

h5py = pytest.importorskip("h5py")
nptdms = pytest.importorskip("nptdms")
pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")
pyuff = pytest.importorskip("pyuff")

RATE, N = 200.0, 400
TIME = np.arange(N) / RATE
DISP: Float1D = 10.0 * np.sin(2 * np.pi * TIME) / 3  # mm
FORCE: Float1D = 36.0 * DISP + 0.1
FORCE[7] = np.nan
MAP: dict[str, Any] = {
    "rel_disp_m": {"column": "u", "unit": "mm"},
    "damper_force_n": {"column": "F"},
}
TIMED = {**MAP, "time_s": {"column": "t"}}


def parquet(path: Path) -> None:
    force = pa.array(FORCE, from_pandas=True)  # its NaN is a null
    pq.write_table(pa.table({"t": TIME, "u": DISP, "F": force, "note": ["x"] * N}), path)


def mat5(path: Path) -> None:
    others = {"z": 1j * TIME, "cube": np.zeros((3, 4, 5)), "cell": np.array([1, "a"], object)}
    savemat(path, {"test": {"t": TIME, "u": DISP, "F": FORCE, "who": "me"}}, do_compression=True)
    with path.open("ab") as file:
        savemat(file, others)


def mat73(path: Path) -> None:
    """As MATLAB writes v7.3: HDF5 after 512 bytes of its own, rows for columns, text as numbers."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in (("t", TIME), ("u", DISP), ("F", FORCE)):
            file.create_dataset(f"test/{name}", data=values[None, :])
        text = file.create_dataset("who", data=np.array([[109], [101]], np.uint16))
        text.attrs["MATLAB_class"] = np.bytes_("char")
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\0\2IM")


def hdf5(path: Path) -> None:
    with h5py.File(path, "w") as file:
        test = file.create_group("test")
        test["t"] = TIME
        test.create_dataset("u", data=DISP, compression="gzip").attrs["units"] = "mm"
        test["F"] = FORCE
        test["F"].attrs["unit"] = np.bytes_("N")
        file["elsewhere"] = h5py.ExternalLink("/etc/passwd", "/x")


def tdms(path: Path) -> None:
    def channel(name: str, values: Float1D, unit: str) -> Any:
        properties = {"wf_increment": 1 / RATE, "wf_start_offset": 0.0, "unit_string": unit}
        return nptdms.ChannelObject("test", name, values, properties=properties)

    with nptdms.TdmsWriter(str(path)) as file:
        file.write_segment([channel("u", DISP[:99], "mm"), channel("F", FORCE[:99], "N")])
        file.write_segment([channel("u", DISP[99:], "mm"), channel("F", FORCE[99:], "N")])


def uff(path: Path, binary: int, even: int = 1, spacing: float = 1 / RATE) -> None:
    file = pyuff.UFF(str(path))
    for name, values, unit in (("u", DISP, "mm"), ("F", np.nan_to_num(FORCE), "N")):
        file.write_sets(
            {
                "type": 58, "binary": binary, "func_type": 1, "id1": name, "rsp_node": 1,
                "rsp_dir": 1, "ref_node": 0, "ref_dir": 0, "data": values, "x": TIME,
                "abscissa_spacing": even, "abscissa_inc": spacing, "abscissa_min": 0.0,
                "abscissa_spec_data_type": 17, "ordinate_spec_data_type": 8,
                "abscissa_axis_units_lab": "s", "ordinate_axis_units_lab": unit,
                "orddenom_spec_data_type": 0,
            },
            "add",
        )  # fmt: skip


def npz(path: Path) -> None:
    np.savez(path, t=TIME[:, None], both=np.array([DISP, FORCE]).T, o=np.array([1, "a"], object))


FORMATS: dict[str, tuple[str, Callable[[Path], None], dict[str, Any]]] = {
    "parquet": ("a.parquet", parquet, {"columns": TIMED}),
    "mat v5": ("a.mat", mat5, {"columns": TIMED, "group": "test"}),
    "mat v7.3": ("b.mat", mat73, {"columns": TIMED, "group": "test"}),
    "hdf5": ("a.h5", hdf5, {"columns": TIMED}),
    "tdms": ("a.tdms", tdms, {"columns": MAP}),
    "uff binary": ("a.uff", lambda path: uff(path, 1), {"columns": MAP}),
    "uff text": ("b.unv", lambda path: uff(path, 0), {"columns": MAP}),
    "npz": (
        "a.npz",
        npz,
        {
            "columns": {
                "time_s": {"column": "t"},
                "rel_disp_m": {"column": "both:1", "unit": "mm"},
                "damper_force_n": {"column": "both:2"},
            }
        },
    ),
}


def make_table(folder: Path, kind: str) -> ForeignTable:
    name, write, card = FORMATS[kind]
    write(folder / name)
    return read_table(folder / name, card.get("group", ""))


def import_table(table: ForeignTable, kind: str, **changed: Any) -> ImportedSamples:
    return read_samples(table, ColumnMap.model_validate({**FORMATS[kind][2], **changed}))


@pytest.mark.parametrize("kind", FORMATS)
def test_a_component_test_is_the_same_out_of_every_format(tmp_path: Path, kind: str) -> None:
    samples = import_table(make_table(tmp_path, kind), kind)
    assert (samples.rate_hz, samples.index.tolist()) == (RATE, list(range(N)))
    force = np.nan_to_num(FORCE) if kind.startswith("uff") else FORCE  # UFF knows no lost sample
    if kind == "uff text":  # twelve digits are all that it has
        np.testing.assert_allclose(samples.channels["rel_disp_m"], 1e-3 * DISP, rtol=1e-11)
        np.testing.assert_allclose(samples.channels["damper_force_n"], force, rtol=1e-11)
    else:
        assert samples.channels["rel_disp_m"].tobytes() == (1e-3 * DISP).tobytes()
        assert np.isnan(samples.channels["damper_force_n"]).tolist() == np.isnan(force).tolist()
        good = np.isfinite(force)
        assert samples.channels["damper_force_n"][good].tobytes() == force[good].tobytes()


@pytest.mark.parametrize("kind", ["hdf5", "tdms", "uff binary"])
def test_a_unit_of_the_file_that_is_not_the_maps_is_refused(tmp_path: Path, kind: str) -> None:
    table = make_table(tmp_path, kind)
    time = {"time_s": TIMED["time_s"]} if kind == "hdf5" else {}

    def import_with_column(**column: Any) -> ImportedSamples:
        return import_table(table, kind, columns={**time, "rel_disp_m": {"column": "u", **column}})

    with raises_input_error(where=table.path, problem="'um'", remedy="file_unit = 'mm'"):
        import_with_column(unit="um")
    with raises_input_error(where=table.path, problem="'m' by its name", remedy="file_unit = 'mm'"):
        import_with_column()
    with raises_input_error(where=table.path, problem="'V'", remedy="file_unit = 'mm'"):
        import_with_column(file_unit="V", gain=2.0)
    by_hand = import_with_column(file_unit="mm", gain=-2.0, offset=1.0).channels["rel_disp_m"]
    np.testing.assert_array_equal(by_hand, -2.0 * DISP + 1.0)


@pytest.mark.parametrize("unit", ["m/s^2", "m/s²", "m/s**2", "m s^-2", "m/s/s", "[m/s2]"])
def test_a_unit_is_known_in_other_spellings(tmp_path: Path, unit: str) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["mass_acc_m_s2"] = DISP
        file["mass_acc_m_s2"].attrs["units"] = unit
    samples = read_samples(read_table(tmp_path / "a.h5"), ColumnMap(rate_hz=RATE))
    assert samples.channels["mass_acc_m_s2"].tobytes() == DISP.tobytes()


def test_a_rate_that_is_not_the_files_is_refused(tmp_path: Path) -> None:
    table = make_table(tmp_path, "tdms")
    assert import_table(table, "tdms", rate_hz=200.0).rate_hz == 200.0
    with raises_input_error(key="rate_hz", value=250.0, problem="200 Hz"):
        import_table(table, "tdms", rate_hz=250.0)


def test_uff_with_times_of_its_own(tmp_path: Path) -> None:
    uff(tmp_path / "a.uff", 1, even=0)
    table = read_table(tmp_path / "a.uff")
    assert table.columns["u"].clock == "u/time"
    assert import_table(table, "uff binary").rate_hz == RATE
    grouped = pyuff.UFF(str(tmp_path / "b.uff"))
    for set in pyuff.UFF(str(tmp_path / "a.uff")).read_sets():
        grouped.write_sets({**set, "id1": f"rig/{set['id1']}"}, "add")
    assert import_table(read_table(tmp_path / "b.uff", "rig"), "uff binary").rate_hz == RATE


@pytest.mark.parametrize("kind", ["csv", "parquet", "npz", "uff", "h5", "tdms"])
def test_a_slash_in_a_unit_is_no_group(tmp_path: Path, kind: str) -> None:
    names = ["Acc [m/s2] mass", "Acc [m/s2] table"]
    columns: dict[str, Any] = dict.fromkeys(names, DISP)
    path = tmp_path / f"a.{kind}"
    if kind == "csv":
        path.write_text(",".join(names) + "\n1,2\n3,4\n")
    elif kind == "parquet":
        pq.write_table(pa.table(columns), path)
    elif kind == "npz":
        np.savez(path, **columns)
    elif kind == "uff":
        uff(tmp_path / "b.uff", 1)
        for data_set, name in zip(
            pyuff.UFF(str(tmp_path / "b.uff")).read_sets(), names, strict=True
        ):
            pyuff.UFF(str(path)).write_sets({**data_set, "id1": name}, "add")
    elif kind == "h5":  # no name of a dataset has a slash, that of a field may
        with h5py.File(path, "w") as file:
            file["run/table"] = np.zeros(N, [(name, float) for name in names])
    else:
        with nptdms.TdmsWriter(str(path)) as file:
            file.write_segment([nptdms.ChannelObject("run", name, DISP) for name in names])
    assert [*read_table(path).columns] == names


@pytest.mark.parametrize("shape", [(N, 2), (2, N), (1, N, 2), (2, 1, N)])
def test_the_columns_of_a_matrix(tmp_path: Path, shape: tuple[int, ...]) -> None:
    rows = np.array([DISP, FORCE])
    values = rows.T if shape.index(N) < shape.index(2) else rows
    np.savez(tmp_path / "a.npz", m=values.reshape(shape))
    table = read_table(tmp_path / "a.npz")
    assert list(table.columns) == ["m:1", "m:2"]
    assert table.read_column("m:1").tobytes() == DISP.tobytes()
    assert table.read_column("m:2").tobytes() == FORCE.tobytes()


def test_what_is_no_column_is_listed_with_its_reason(tmp_path: Path) -> None:
    name, write, _ = FORMATS["mat v5"]
    write(tmp_path / name)
    table = read_table(tmp_path / name)
    assert {"test/t", "test/u", "test/F"} <= set(table.columns)
    assert table.dropped["test/who"] == "text"
    with raises_input_error(where=tmp_path / name, problem="'tset'", allowed="test"):
        read_table(tmp_path / name, "tset")
    lines = "\n".join(make_table(tmp_path, "tdms").contents)
    assert "u: 400 rows, in 'mm', 200 Hz" in lines
    make_table(tmp_path, "mat v7.3")
    assert read_table(tmp_path / FORMATS["mat v7.3"][0]).dropped == {"who": "text"}
    assert list(make_table(tmp_path, "hdf5").columns) == ["F", "t", "u"]  # no link is followed
    assert "o: not a column: objects" in make_table(tmp_path, "npz").contents


def test_columns_of_two_recordings_are_not_mixed(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["one/u"], file["two/F"] = DISP, FORCE[:-1]
    mapped = {"rel_disp_m": {"column": "one/u"}, "damper_force_n": {"column": "two/F"}}
    with raises_input_error(where=tmp_path / "a.h5", problem="one/u: 400, two/F: 399"):
        read_samples(read_table(tmp_path / "a.h5"), ColumnMap.model_validate({"columns": mapped}))


@pytest.mark.parametrize("kind", FORMATS)
def test_a_file_that_was_cut_off(tmp_path: Path, kind: str) -> None:
    make_table(tmp_path, kind)
    path = tmp_path / FORMATS[kind][0]
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 3])
    if kind == "tdms":  # what was written until then is read, and the end is warned of
        notes = import_table(read_table(path, "test"), kind).notes
        assert sum(note.startswith("warning: ") for note in notes) == 2
        return
    with pytest.raises(InputError, match=re.escape(path.name)):
        import_table(read_table(path, FORMATS[kind][2].get("group", "")), kind)


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    for kind in FORMATS:
        with raises_input_error(
            where=tmp_path / FORMATS[kind][0], problem=os.strerror(errno.ENOENT)
        ):
            read_table(tmp_path / FORMATS[kind][0])
