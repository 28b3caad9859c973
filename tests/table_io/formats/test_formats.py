"""Binary formats: one recording out of each of them, what is no column, and hostile files."""

import copyreg
import ctypes
import os
import random
import re
import signal
import socket
import zipfile
import zlib
from collections.abc import Callable
from contextlib import suppress
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from table_io import formats
from table_io.block import Float1D
from table_io.errors import InputError
from table_io.formats import read_table, sandbox
from table_io.formats.table import ForeignTable
from table_io.formats.words import normalize_unit
from tests.input_errors import raises_input_error
from tests.recording.mutants import damage
from twin.exchange.columns import ColumnMap, ImportedSamples, read_samples

h5py = pytest.importorskip("h5py")
nptdms = pytest.importorskip("nptdms")
pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")
pyuff = pytest.importorskip("pyuff")

RATE, N = 200.0, 400
TIME = np.arange(N) / RATE
DISP: Float1D = 10.0 * np.sin(2 * np.pi * TIME) / 3  # mm
FULL_FORCE: Float1D = 36.0 * DISP + 0.1
FORCE = FULL_FORCE.copy()
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
    for name, values, unit in (("u", DISP, "mm"), ("F", FULL_FORCE, "N")):
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
def test_read_samples_of_every_format_are_equal(tmp_path: Path, kind: str) -> None:
    samples = import_table(make_table(tmp_path, kind), kind)
    assert (samples.rate_hz, samples.index.tolist()) == (RATE, list(range(N)))
    force = FULL_FORCE if kind.startswith("uff") else FORCE  # UFF knows no lost sample
    if kind == "uff text":  # twelve digits are all that it has
        np.testing.assert_allclose(samples.channels["rel_disp_m"], 1e-3 * DISP, rtol=1e-11)
        np.testing.assert_allclose(samples.channels["damper_force_n"], force, rtol=1e-11)
    else:
        assert samples.channels["rel_disp_m"].tobytes() == (1e-3 * DISP).tobytes()
        assert np.isnan(samples.channels["damper_force_n"]).tolist() == np.isnan(force).tolist()
        good = np.isfinite(force)
        assert samples.channels["damper_force_n"][good].tobytes() == force[good].tobytes()


@pytest.mark.parametrize("kind", ["hdf5", "tdms", "uff binary"])
def test_read_samples_refuses_a_unit_that_is_not_that_of_the_file(
    tmp_path: Path, kind: str
) -> None:
    table = make_table(tmp_path, kind)
    time = {"time_s": TIMED["time_s"]} if kind == "hdf5" else {}

    def import_with_column(**column: Any) -> ImportedSamples:
        return import_table(table, kind, columns={**time, "rel_disp_m": {"column": "u", **column}})

    for column, problem in (
        ({"unit": "um"}, "'um'"), ({}, "'m' by its name"), ({"file_unit": "V", "gain": 2.0}, "'V'"),
    ):  # fmt: skip
        with raises_input_error(where=table.path, problem=problem, remedy="file_unit = 'mm'"):
            import_with_column(**column)
    by_hand = import_with_column(file_unit="mm", gain=-2.0, offset=1.0).channels["rel_disp_m"]
    np.testing.assert_array_equal(by_hand, -2.0 * DISP + 1.0)


@pytest.mark.parametrize(
    ("unit", "canonical"),
    [
        *((text, "m/s2") for text in ("m/s^2", "m/s\u00b2", "m/s**2", "m s^-2", "m/s/s", "[m/s2]")),
        ("cm/sec^2", "cm/s2"), ("Gal", "cm/s2"), ("G", "g"), ("kips", "kip"), ("SEC", "s"),
    ],
)  # fmt: skip
def test_normalize_unit_knows_other_spellings(unit: str, canonical: str) -> None:
    assert normalize_unit(unit) == canonical


def test_two_sources_of_the_rate_that_differ_are_an_error_with_both(tmp_path: Path) -> None:
    stated = make_table(tmp_path, "tdms")
    assert import_table(stated, "tdms", rate_hz=200.0).rate_hz == 200.0
    with raises_input_error(key="rate_hz", value=250.0, problem="200 Hz"):
        import_table(stated, "tdms", rate_hz=250.0)
    timed = make_table(tmp_path, "npz")
    assert import_table(timed, "npz", rate_hz=200.0).rate_hz == 200.0
    with raises_input_error(key="rate_hz", value=250.0, problem="200 Hz"):
        import_table(timed, "npz", rate_hz=250.0)
    rounded = tmp_path / "rounded.csv"  # to 3 decimals, at 1024 Hz: some times stand there twice
    rows = zip(np.round(np.arange(N) / 1024.0, 2), DISP, strict=True)
    rounded.write_text("t,u\n" + "".join(f"{t:.2f},{u:.6g}\n" for t, u in rows))
    columns = {"time_s": TIMED["time_s"], "rel_disp_m": MAP["rel_disp_m"]}
    samples = read_samples(
        read_table(rounded), ColumnMap.model_validate({"columns": columns, "rate_hz": 1024.0})
    )
    assert (samples.rate_hz, samples.index.size) == (1024.0, N)
    with raises_input_error(problem="time must rise", remedy="--rate"):
        read_samples(read_table(rounded), ColumnMap.model_validate({"columns": columns}))


def test_scan_columns_of_uff_with_stored_times(tmp_path: Path) -> None:
    uff(tmp_path / "a.uff", 1, even=0)
    table = read_table(tmp_path / "a.uff")
    assert table.columns["u"].clock == "u/time"
    assert import_table(table, "uff binary").rate_hz == RATE
    grouped = pyuff.UFF(str(tmp_path / "b.uff"))
    for data_set in pyuff.UFF(str(tmp_path / "a.uff")).read_sets():
        grouped.write_sets({**data_set, "id1": f"rig/{data_set['id1']}"}, "add")
    assert import_table(read_table(tmp_path / "b.uff", "rig"), "uff binary").rate_hz == RATE


def structure_arrays(path: Path) -> None:
    """As dSPACE ControlDesk and a Simulink scope write them."""
    y = np.zeros((1, 2), [("Name", "O"), ("Data", "O"), ("Unit", "O")])
    y[0] = [("Model Root/Weg", DISP[None], "mm"), ("Model Root/Kraft", FORCE[None], "N")]
    x = {"Data": TIME[None], "Unit": "s"}
    signals = np.zeros((1, 2), [("values", "O"), ("label", "O")])
    signals[0] = [(DISP[:, None], "u [m/s]"), (FORCE[:, None], "")]
    savemat(path, {"rec": {"X": x, "Y": y}, "scope": {"time": TIME[:, None], "signals": signals}})


def cell_array(path: Path) -> None:
    """A cell array, and a structure array, as MATLAB writes them in v7.3: by references."""
    with h5py.File(path, "w") as file:
        for name, values in (("a", TIME), ("b", DISP), ("c", FORCE)):
            file[f"#refs#/{name}"] = values[None]
        for name, text in (("d", "Model/Weg"), ("e", "Kraft"), ("f", "mm"), ("g", "N")):
            cell = file.create_dataset(f"#refs#/{name}", data=np.array([[*map(ord, text)]], "u2").T)
            cell.attrs["MATLAB_class"] = np.bytes_("char")
        for name, cells in (
            ("run/data", "abc"), ("run/Y/Data", "bc"), ("run/Y/Name", "de"), ("run/Y/Unit", "fg"),
        ):  # fmt: skip
            references = [[file[f"#refs#/{cell}"].ref] for cell in cells]
            file.create_dataset(name, data=references, dtype=h5py.ref_dtype)


def test_elements_of_structure_and_cell_arrays_are_columns_by_their_labels(tmp_path: Path) -> None:
    structure_arrays(tmp_path / "a.mat")
    table = read_table(tmp_path / "a.mat")
    units = {name: (c.unit, c.clock) for name, c in table.columns.items()}
    assert units == {
        "rec/X/Data": ("s", ""), "rec/Y/Weg": ("mm", "rec/X/Data"),
        "rec/Y/Kraft": ("N", "rec/X/Data"), "scope/time": ("", ""),
        "scope/signals/u [m/s]": ("", "scope/time"), "scope/signals/2": ("", "scope/time"),
    }  # fmt: skip
    assert table.read_column("rec/Y/Kraft").tobytes() == FORCE.tobytes()
    assert table.read_column("scope/signals/u [m/s]").tobytes() == DISP.tobytes()
    cell_array(tmp_path / "b.mat")
    cells = read_table(tmp_path / "b.mat")
    assert {name: column.unit for name, column in cells.columns.items()} == {
        "run/data/1": "", "run/data/2": "", "run/data/3": "", "run/Y/Weg": "mm", "run/Y/Kraft": "N",
    }  # fmt: skip
    assert cells.read_column("run/data/2").tobytes() == DISP.tobytes()
    assert cells.read_column("run/Y/Kraft").tobytes() == FORCE.tobytes()


def test_dates_are_times_from_the_first_one(tmp_path: Path) -> None:
    stamps = np.datetime64("2026-03-29T01:59:59") + (5000 * np.arange(N)).astype("timedelta64[us]")
    pq.write_table(pa.table({"time": stamps, "u": DISP}), tmp_path / "a.parquet")
    with nptdms.TdmsWriter(str(tmp_path / "a.tdms")) as file:
        file.write_segment([nptdms.ChannelObject("run", "time", stamps)])
    workbook = pytest.importorskip("openpyxl").Workbook()
    workbook.active.append(["time", "u"])
    for k in range(N):
        workbook.active.append([datetime(2026, 3, 29) + timedelta(seconds=k / RATE), DISP[k]])
    workbook.save(tmp_path / "a.xlsx")
    for kind in ("parquet", "tdms", "xlsx"):
        table = read_table(tmp_path / f"a.{kind}")
        np.testing.assert_allclose(table.read_column("time"), TIME, atol=1e-6)
        assert table.columns["time"].unit in ("s", "")


def test_scan_columns_of_a_workbook_names_formulas_without_values(tmp_path: Path) -> None:
    workbook = pytest.importorskip("openpyxl").Workbook()
    workbook.active.append(["Time (s)", "Force (kN)", "Disp (mm)"])
    for k in range(20):
        workbook.active.append([k / RATE, f"=A{k + 2}*2", DISP[k]])
    workbook.save(tmp_path / "a.xlsx")
    table = read_table(tmp_path / "a.xlsx")
    assert [(name, c.unit) for name, c in table.columns.items()] == [
        ("Time (s)", "s"), ("Disp (mm)", "mm"),
    ]  # fmt: skip
    assert "formulas without values" in table.dropped["Force (kN)"]


@pytest.mark.parametrize("kind", ["csv", "parquet", "npz", "uff", "h5", "tdms"])
def test_select_group_takes_no_unit_for_a_group(tmp_path: Path, kind: str) -> None:
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
def test_add_array_adds_the_columns_of_a_matrix(tmp_path: Path, shape: tuple[int, ...]) -> None:
    rows = np.array([DISP, FORCE])
    values = rows.T if shape.index(N) < shape.index(2) else rows
    np.savez(tmp_path / "a.npz", m=values.reshape(shape))
    table = read_table(tmp_path / "a.npz")
    assert list(table.columns) == ["m:1", "m:2"]
    assert table.read_column("m:1").tobytes() == DISP.tobytes()
    assert table.read_column("m:2").tobytes() == FORCE.tobytes()


def test_contents_list_what_is_no_column_with_its_reason(tmp_path: Path) -> None:
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


def test_read_samples_takes_the_common_part_of_columns_with_one_rate(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["one/u"], file["two/F"] = DISP, FORCE[:-1]
    mapped = {"rel_disp_m": {"column": "one/u"}, "damper_force_n": {"column": "two/F"}}
    with raises_input_error(where=tmp_path / "a.h5", problem="one/u: 400, two/F: 399"):
        read_samples(read_table(tmp_path / "a.h5"), ColumnMap.model_validate({"columns": mapped}))
    for force_rate, is_common in ((RATE, True), (2 * RATE, False)):
        path = tmp_path / f"{force_rate}.tdms"
        with nptdms.TdmsWriter(str(path)) as writer:
            writer.write_segment([
                nptdms.ChannelObject("run", name, values, properties={"wf_increment": 1 / rate})
                for name, values, rate in (("u", DISP, RATE), ("F", FORCE[:-10], force_rate))
            ])  # fmt: skip
        column_map = ColumnMap.model_validate({"columns": MAP})
        if is_common:
            samples = read_samples(read_table(path), column_map)
            assert samples.index.size == N - 10
            assert any("u: 400, F: 390" in note for note in samples.notes)
        else:
            with raises_input_error(where=path, problem="u: 400, F: 390"):
                read_samples(read_table(path), column_map)


@pytest.mark.parametrize("kind", FORMATS)
def test_read_table_of_a_file_that_was_cut_off(tmp_path: Path, kind: str) -> None:
    make_table(tmp_path, kind)
    path = tmp_path / FORMATS[kind][0]
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 3])
    if kind == "tdms":  # what was written until then is read, and the end is warned of
        notes = import_table(read_table(path, "test"), kind).notes
        assert sum(note.startswith("warning: ") for note in notes) == 2
        return
    with pytest.raises(InputError, match=re.escape(path.name)):
        import_table(read_table(path, FORMATS[kind][2].get("group", "")), kind)


@pytest.mark.slow
@pytest.mark.parametrize("kind", FORMATS)
def test_read_samples_reads_or_refuses_a_damaged_file(tmp_path: Path, kind: str) -> None:
    make_table(tmp_path, kind)
    path = tmp_path / FORMATS[kind][0]
    sound = path.read_bytes()
    for number in range(200):
        path.write_bytes(damage(sound, random.Random(number)))
        with suppress(InputError):
            import_table(read_table(path, FORMATS[kind][2].get("group", "")), kind)


def with_dataset(path: Path, **options: Any) -> None:
    with h5py.File(path, "w") as file:
        file.create_dataset("u", **options)


def bomb_of_zeros(path: Path) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (500000000,), }"
        archive.writestr("u.npy", b"\x93NUMPY\1\0\x76\0" + header.ljust(117) + b"\n" + bytes(2**20))


def packed_bomb(path: Path) -> None:
    savemat(path, {"u": np.zeros(8)})
    body = zlib.compress(bytes(100 * 2**20))
    with path.open("ab") as file:
        file.write((15).to_bytes(4, "little") + len(body).to_bytes(4, "little") + body)


def elsewhere(path: Path) -> None:
    with_dataset(path, shape=(N,), dtype="f8", external=[("/etc/passwd", 0, 8 * N)])


def fewer(path: Path) -> None:
    """A set that has fewer values than it says."""
    uff(path, 0)
    path.write_bytes(path.read_bytes().replace(b"       400", b"       500", 1))


HOSTILE: dict[str, tuple[str, Callable[[Path], object], str]] = {
    "complex": ("a.h5", lambda p: with_dataset(p, data=1j * TIME), "complex"),
    "text": ("a.h5", lambda p: with_dataset(p, data=[b"a"] * N), "objects"),
    "cube": ("a.h5", lambda p: with_dataset(p, data=np.zeros((9, 9, 9))), "9 x 9 x 9"),
    "wide": ("a.h5", lambda p: with_dataset(p, data=np.zeros((99, 99))), "99 x 99"),
    "one": ("a.h5", lambda p: with_dataset(p, data=np.zeros(1)), "a single value"),
    "empty": ("a.h5", lambda p: with_dataset(p, data=np.zeros(0)), "empty"),
    "other file": ("a.h5", elsewhere, "in another file"),
    "infinite": ("a.h5", lambda p: with_dataset(p, data=np.full(N, np.inf)), "row 1, column 'u'"),
    "large integers": (
        "a.h5",
        lambda p: with_dataset(p, data=np.full(N, 2**60)),
        "integers beyond 2^53",
    ),
    "huge": (
        "a.h5",
        lambda p: with_dataset(p, shape=(2**40,), dtype="f8", chunks=(2**10,)),
        "1099511627776 numbers",
    ),
    "huge chunk": (
        "a.h5",
        lambda p: with_dataset(p, shape=(2**28,), dtype="f8", chunks=(2**28,)),
        "chunks of more than",
    ),
    "zip bomb": ("a.npz", bomb_of_zeros, "500000000 numbers"),
    "mat bomb": ("a.mat", packed_bomb, "200 times its size"),
    "pickle": ("a.npz", lambda p: np.savez(p, u=np.array([{}] * N, object)), "objects"),
    "strings": ("a.parquet", lambda p: pq.write_table(pa.table({"u": ["1"] * N}), p), "string"),
    "another format": ("a.tdms", lambda p: p.write_bytes(b"a,b\n1,2\n"), "not a LabVIEW TDMS file"),
    "nothing": ("a.mat", lambda p: p.write_bytes(b""), "damaged"),
    "fewer values": ("a.uff", fewer, "500 values and has 400"),
    "no 58": ("a.uff", lambda p: p.write_text("    -1\n   151\nx\n    -1\n"), "no set of type 58"),
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_read_samples_refuses_a_hostile_file(tmp_path: Path, kind: str) -> None:
    name, write, words = HOSTILE[kind]
    write(tmp_path / name)
    mapped = ColumnMap.model_validate(
        {"rate_hz": RATE, "columns": {"rel_disp_m": {"column": "u", "unit": "mm"}}}
    )
    with pytest.raises(InputError) as caught:
        read_samples(read_table(tmp_path / name), mapped)
    assert words in str(caught.value)
    assert name in str(caught.value)


def test_read_table_names_a_library_that_is_not_installed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def absent(name: str) -> Any:
        raise ModuleNotFoundError("No module named 'h5py'", name="h5py")

    monkeypatch.setattr(formats, "import_module", absent)
    (tmp_path / "a.h5").touch()
    with raises_input_error(where=tmp_path / "a.h5", problem="h5py", remedy='"shaketwin[formats]"'):
        read_table(tmp_path / "a.h5")


def crash() -> None:
    os.kill(os.getpid(), signal.SIGSEGV)


def swell() -> int:
    return len(bytearray(2**36))


def spin() -> None:
    while True:
        pass


def test_an_error_is_answered_whatever_a_library_registers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Libraries for clusters change how errors of every kind are written, in the whole process."""
    monkeypatch.setitem(copyreg.dispatch_table, InputError, lambda error: (repr, (str(error),)))

    def refuse() -> None:
        raise InputError("no samples", where=tmp_path)

    (tmp_path / "x").touch()
    with pytest.raises(InputError, match="no samples"):
        sandbox.run_isolated(tmp_path / "x", refuse)


@pytest.mark.parametrize(
    ("work", "words"), [(crash, "crashed"), (swell, "too large"), (spin, "hung"), (os.abort, "cra")]
)
def test_run_isolated_survives_a_reader_that_dies(
    tmp_path: Path, work: Callable[[], Any], words: str
) -> None:
    (tmp_path / "x").touch()
    with raises_input_error(where=tmp_path / "x", problem=words):
        sandbox.run_isolated(tmp_path / "x", work, max_cpu_s=1)


class Intrusion:
    """Object whose pickle calls a function of the process that reads it."""

    def __reduce__(self) -> Any:
        return os.getpid, ()


def test_run_isolated_refuses_an_answer_that_is_no_table(tmp_path: Path) -> None:
    (tmp_path / "x").touch()
    with raises_input_error(where=tmp_path / "x", problem="its reader crashed"):
        sandbox.run_isolated(tmp_path / "x", Intrusion)


def connect(path: Path) -> None:
    socket.create_connection(("127.0.0.1", int(path.read_text())), timeout=5.0)


@pytest.mark.parametrize(
    "act",
    [
        lambda path: path.write_text("written"),
        lambda path: path.unlink(),
        lambda path: (path.parent / "new").mkdir(),
        lambda path: os.execv("/bin/true", ["true"]),
        lambda path: os.kill(os.getppid(), 0),
        connect,
    ],
    ids=["write", "remove", "make", "execute", "signal", "connect"],
)
def test_run_isolated_leaves_a_reader_no_right_but_to_read(
    tmp_path: Path, act: Callable[[Path], Any]
) -> None:
    if ctypes.CDLL(None).syscall(sandbox.LANDLOCK_CREATE_RULESET, None, 0, 1) < 6:
        pytest.skip("this kernel has not all of Landlock")

    def work() -> None:
        with pytest.raises(PermissionError):
            act(path)
        raise InputError(path.read_text())

    with socket.create_server(("127.0.0.1", 0)) as server:
        path = tmp_path / "x"
        path.write_text(str(server.getsockname()[1]))
        with raises_input_error(problem=path.read_text()):
            sandbox.run_isolated(path, work)
    assert [*tmp_path.iterdir()] == [path]


@pytest.mark.parametrize("suffix", ["csv", "npz"])
def test_table_of_more_columns_than_any_laboratory_has_is_refused(
    tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("table_io.formats.table.MAX_COLUMNS", 3)
    for count in (3, 4):
        names = [f"c{number}" for number in range(count)]
        path = tmp_path / f"{count}.{suffix}"
        if suffix == "csv":
            path.write_text("\n".join([",".join(names), *[",".join("1" * count)] * 9]))
        else:
            arrays: dict[str, Any] = dict.fromkeys(names, np.ones(9))
            np.savez(path, **arrays)
    assert len(read_table(tmp_path / f"3.{suffix}").columns) == 3
    with raises_input_error(where=path, problem="4 columns", allowed="up to 3"):
        read_table(path)
