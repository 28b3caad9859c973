"""The zoo of strangers' files that are no text, as recorders and other programs write them."""

from collections.abc import Callable
from datetime import timedelta
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from table_io.errors import InputError
from table_io.formats import read_table
from tests.exchange.test_zoo import (
    DISP_MM,
    FORCE_N,
    ROW_COUNT,
    ROWS,
    START,
    TIME,
    check,
    read_stranger,
)
from twin.exchange.proposal import propose_map

h5py = pytest.importorskip("h5py")
nptdms = pytest.importorskip("nptdms")
openpyxl = pytest.importorskip("openpyxl")
pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")
STAMPS = np.datetime64("2026-03-28T23:59:59.500000") + (5000 * np.arange(ROW_COUNT)).astype(
    "m8[us]"
)
Write = Callable[[Path], None]


def write_sheets(*sheets: tuple[str, list[list[Any]]]) -> Write:
    def write(path: Path) -> None:
        book = openpyxl.Workbook()
        book.remove(book.active)
        for title, rows in sheets:
            sheet = book.create_sheet(title)
            for row in rows:
                sheet.append(row)
        book.save(path)

    return write


HEAD = ["Time (s)", "Disp (mm)", "Force (N)"]
NUMBERS: list[list[Any]] = [HEAD, *map(list, ROWS)]
DATES = [["Time", *HEAD[1:]]] + [[START + timedelta(seconds=t), u, f] for t, u, f in ROWS]


def write_mat(**variables: Any) -> Write:
    return lambda path: savemat(path, variables)


def make_controldesk() -> dict[str, Any]:
    y = np.zeros((1, 2), [("Name", "O"), ("Data", "O"), ("Unit", "O")])
    y[0] = [("Model Root/Weg", DISP_MM[None], "mm"), ("Model Root/Kraft", FORCE_N[None], "N")]
    return {"rec_001": {"X": {"Name": "", "Data": TIME[None], "Unit": "s"}, "Y": y}}


def make_scope(time: np.ndarray) -> dict[str, Any]:
    signals = np.zeros((1, 2), [("values", "O"), ("label", "O")])
    signals[0] = [(DISP_MM[:, None], "Disp [mm]"), (FORCE_N[:, None], "Force [N]")]
    return {"ScopeData": {"time": time, "signals": signals, "blockName": "m/Scope"}}


def write_hdf5(fill: Callable[[Any], None]) -> Write:
    def write(path: Path) -> None:
        with h5py.File(path, "w") as file:
            fill(file)

    return write


def fill_attributes(file: Any) -> None:
    for name, values, unit in (("t", TIME, "s"), ("disp", DISP_MM, "mm"), ("force", FORCE_N, "N")):
        file[f"run/{name}"] = values
        file[f"run/{name}"].attrs["units"] = unit


def fill_scaled(file: Any) -> None:
    fill_rate(file, fs=200.0)
    file["run/force"][:] = (FORCE_N - 2.0) / 0.5
    file["run/force"].attrs.update({"scale_factor": 0.5, "add_offset": 2.0})


def fill_rate(file: Any, force_start_s: float = 0.0, **attributes: float) -> None:
    for name, values, unit in (("disp", DISP_MM, "mm"), ("force", FORCE_N, "N")):
        file[f"run/{name}"] = values
        file[f"run/{name}"].attrs["unit"] = unit
    file["run/force"].attrs["start_time"] = force_start_s
    for key, value in attributes.items():
        file["run"].attrs[key] = value


def fill_version_73(file: Any) -> None:
    for name, values in (("time_s", TIME), ("disp_mm", DISP_MM), ("force_N", FORCE_N)):
        file[name] = values[None]


def fill_compound(file: Any) -> None:
    fields = [("time (s)", float), ("disp (mm)", float), ("force (N)", float)]
    file["data"] = np.array(ROWS, dtype=fields)


def write_parquet(**columns: Any) -> Write:
    table = {name.replace("_mm", " (mm)").replace("_N", " (N)"): v for name, v in columns.items()}
    return lambda path: pq.write_table(pa.table(table), path)


def write_tdms(*channels: tuple[str, Any, dict[str, Any]]) -> Write:
    def write(path: Path) -> None:
        with nptdms.TdmsWriter(str(path)) as file:
            file.write_segment(
                [nptdms.ChannelObject("run", n, v, properties=p) for n, v, p in channels]
            )

    return write


def fill_wave(file: Any) -> None:
    for name, values, unit in (("Disp", DISP_MM, "mm"), ("Force", FORCE_N, "N")):
        file[name] = values
        file[name].attrs.update({"wf_increment": 0.005, "unit_string": unit})


def fill_since(file: Any) -> None:
    fill_attributes(file)
    file["run/t"].attrs["units"] = "seconds since 2026-03-28 23:59:59"


def write_file_rate(path: Path) -> None:
    with nptdms.TdmsWriter(str(path)) as file:
        channels = (("Disp", DISP_MM, IN_MM), ("Force", FORCE_N, IN_N))
        objects = [nptdms.ChannelObject("run", n, v, properties=p) for n, v, p in channels]
        file.write_segment([nptdms.RootObject({"SampleRate": 200.0}), *objects])


IN_MM, IN_N = {"unit_string": "mm"}, {"unit_string": "N"}
AT_200_HZ = {"wf_increment": 0.005}
DISP_TDMS, FORCE_TDMS = ("Disp", DISP_MM, IN_MM), ("Force", FORCE_N, IN_N)
DISP_200_HZ = ("Disp", DISP_MM, IN_MM | AT_200_HZ)
FORCE_200_HZ = ("Force", FORCE_N, IN_N | AT_200_HZ)
GOOD: dict[str, Write] = {
    "plain.xlsx": write_sheets(("Sheet1", NUMBERS)),
    "second.xlsx": write_sheets(("Info", [["Test 17"], ["by", "me"]]), ("Data", NUMBERS)),
    "title.xlsx": write_sheets(("Data", [["Damper test 17"], [], *NUMBERS])),
    "units.xlsx": write_sheets(("D", [["Time", "Disp", "Force"], ["s", "mm", "N"], *NUMBERS[1:]])),
    "texts.xlsx": write_sheets(("D", [HEAD, *([f"{x:.9f}" for x in row] for row in ROWS)])),
    "text_commas.xlsx": write_sheets(
        ("D", [HEAD, *([f"{x:.9f}".replace(".", ",") for x in row] for row in ROWS)])
    ),
    "dates.xlsx": write_sheets(("Data", DATES)),
    "remarks.xlsx": write_sheets(("D", [[*HEAD, "remark"], *([*row, "ok"] for row in ROWS)])),
    "vectors.mat": write_mat(time_s=TIME, disp_mm=DISP_MM, force_N=FORCE_N),
    "columns.mat": write_mat(
        time_s=TIME[:, None], disp_mm=DISP_MM[:, None], force_N=FORCE_N[:, None]
    ),
    "fs.mat": write_mat(fs=200.0, disp_mm=DISP_MM, force_N=FORCE_N),
    "dt.mat": write_mat(dt=0.005, disp_mm=DISP_MM, force_N=FORCE_N),
    "structure.mat": write_mat(run={"time_s": TIME, "disp_mm": DISP_MM, "force_N": FORCE_N}),
    "controldesk.mat": write_mat(**make_controldesk()),
    "scope.mat": write_mat(**make_scope(TIME[:, None])),
    "attributes.h5": write_hdf5(fill_attributes),
    "compound.h5": write_hdf5(fill_compound),
    "rate.h5": write_hdf5(lambda file: fill_rate(file, sample_rate=200.0)),
    "dt.hdf5": write_hdf5(lambda file: fill_rate(file, dt=0.005)),
    "v73.mat": write_hdf5(fill_version_73),
    "plain.parquet": write_parquet(time=TIME, disp_mm=DISP_MM, force_N=FORCE_N),
    "index.parquet": write_parquet(disp_mm=DISP_MM, force_N=FORCE_N, timestamp=STAMPS),
    "zone.parquet": write_parquet(
        timestamp=pa.array(STAMPS, pa.timestamp("us", "Europe/Berlin")),
        disp_mm=DISP_MM, force_N=FORCE_N,
    ),
    "duration.parquet": write_parquet(
        time=pa.array((STAMPS - STAMPS[0]), pa.duration("us")), disp_mm=DISP_MM, force_N=FORCE_N
    ),
    "decimal.parquet": write_parquet(
        time=TIME, disp_mm=pa.array([Decimal(f"{u:.9f}") for u in DISP_MM]), force_N=FORCE_N
    ),
    "epoch_ns.parquet": write_parquet(
        time=STAMPS.astype("M8[ns]").astype(np.int64), disp_mm=DISP_MM, force_N=FORCE_N
    ),
    "rate.tdms": write_tdms(DISP_200_HZ, FORCE_200_HZ),
    "stamps.tdms": write_tdms(("Time", STAMPS, {}), DISP_TDMS, FORCE_TDMS),
    "time.tdms": write_tdms(
        ("Time", TIME, {"unit_string": "s"}), DISP_TDMS, FORCE_TDMS
    ),
    "unit_property.tdms": write_tdms(
        ("Disp", DISP_MM, {"Unit": "mm"} | AT_200_HZ), ("Force", FORCE_N, {"Unit": "N"} | AT_200_HZ)
    ),
    "file_rate.tdms": write_file_rate,
    "ni_unit.tdms": write_tdms(
        ("Disp", DISP_MM, {"NI_UnitDescription": "mm"} | AT_200_HZ),
        ("Force", FORCE_N, {"NI_UnitDescription": "N"} | AT_200_HZ),
    ),
    "rows.xlsx": write_sheets(
        ("D", [[name, *values] for name, values in zip(HEAD, zip(*ROWS, strict=True), strict=True)])
    ),
    "unit_cells.xlsx": write_sheets(
        ("D", [["t", "Disp", "Force"], *([f"{t} s", f"{u} mm", f"{f} N"] for t, u, f in ROWS)])
    ),
    "settings_beside.xlsx": write_sheets(
        ("D", [[*HEAD, None, "Setting", "Value"], *([*row, None, "Span", 500] for row in ROWS[:2]),
               *map(list, ROWS[2:])])
    ),
    "division.xlsx": write_sheets(
        ("D", [HEAD, *([t, u, f if k != 9 else "#DIV/0!"] for k, (t, u, f) in enumerate(ROWS))])
    ),
    "wave.h5": write_hdf5(fill_wave), "since.h5": write_hdf5(fill_since),
    "records.npz": lambda path: np.savez(
        path, data=np.array(ROWS, [("time (s)", float), ("disp (mm)", float), ("force (N)", float)])
    ),
    "empty_row.xlsx": write_sheets(("D", [*NUMBERS[:99], [], *NUMBERS[99:]])),
    "scaled.h5": write_hdf5(fill_scaled),
    "fs.npz": lambda path: np.savez(path, fs=200.0, disp_mm=DISP_MM, force_N=FORCE_N),
    "arrays.npz": lambda path: np.savez(path, time_s=TIME, disp_mm=DISP_MM, force_N=FORCE_N),
}  # fmt: skip
BAD: dict[str, tuple[Write, str]] = {
    "pictures.xlsx": (write_sheets(("Info", [["Test 17"]])), "an Excel workbook with no column"),
    "no_rate.tdms": (write_tdms(DISP_TDMS, FORCE_TDMS), "--rate"),
    "other_rate.tdms": (
        write_tdms(DISP_200_HZ, ("Force", FORCE_N, {"wf_increment": 0.01} | IN_N)),
        "200 Hz",
    ),
    "slow_force.tdms": (
        write_tdms(DISP_200_HZ, ("Force", FORCE_N[::4], {"wf_increment": 0.02} | IN_N)),
        "'Force' has 60 rows at 50 Hz, others 240 at 200 Hz",
    ),
    "tenfold.tdms": (
        write_tdms(("Disp", DISP_MM, {"unit_string": "10 mm"} | AT_200_HZ), FORCE_200_HZ), "'10 mm'"
    ),
    "starts.h5": (write_hdf5(lambda file: fill_rate(file, 1.5, rate_hz=200.0)), "0 s and 1.5 s"),
    "two_rates.h5": (
        write_hdf5(lambda file: fill_rate(file, fs=200.0, dt=0.001)), "1000 Hz and 200 Hz"
    ),
    "two_rates.mat": (
        write_mat(fs=200.0, dt=0.001, disp_mm=DISP_MM, force_N=FORCE_N), "200 Hz and 1000 Hz"
    ),
    "texts.parquet": (write_parquet(note=["a"] * ROW_COUNT), "with no column of numbers"),
    "unnamed.npz": (lambda path: np.savez(path, TIME, DISP_MM), "no column is known"),
    "matrix.mat": (write_mat(data=np.array(ROWS)), "no column is known"),
    "objects.npz": (lambda path: np.savez(path, x=np.array([1, "a"], object)), "objects"),
}  # fmt: skip


@pytest.mark.parametrize("name", GOOD)
def test_a_binary_stranger_is_read_right(tmp_path: Path, name: str) -> None:
    GOOD[name](tmp_path / name)
    check(read_stranger(tmp_path / name), lost=name.startswith("division"))


@pytest.mark.parametrize("name", BAD)
def test_a_binary_stranger_is_refused_with_its_true_cause(tmp_path: Path, name: str) -> None:
    write, cause = BAD[name]
    write(tmp_path / name)
    with pytest.raises(InputError) as caught:
        read_stranger(tmp_path / name)
    assert cause in str(caught.value)


def test_a_factor_next_to_values_is_named_and_not_applied(tmp_path: Path) -> None:
    write_hdf5(fill_wave)(tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5", "a") as file:
        file["Force"].attrs.update({"gain": 2.0, "scale": 1.0})
    (note,) = read_table(tmp_path / "a.h5").notes
    assert note == "warning: Force has an attribute gain = 2, which is not applied"


def test_a_column_of_formulas_without_values_is_left_out_with_its_reason(tmp_path: Path) -> None:
    rows: list[list[Any]] = [[t, u, f"=B{k + 2}*36"] for k, (t, u, _) in enumerate(ROWS)]
    write_sheets(("Data", [HEAD, *rows]))(tmp_path / "a.xlsx")
    proposal = propose_map(read_table(tmp_path / "a.xlsx"))
    (dropped,) = proposal.dropped
    assert dropped.startswith("Force (N) (formulas without values")
    assert any("a force" in text for text in proposal.missing)
