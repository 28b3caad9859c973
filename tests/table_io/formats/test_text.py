"""Text tables: what is read, what is no column, and what is refused with row, column and remedy."""

import errno
import os
from pathlib import Path

import numpy as np
import pytest

from table_io.errors import InputError
from table_io.formats import parse_text, read_table
from table_io.formats.table import ForeignTable
from table_io.formats.text import MAX_LINE_CHARS
from table_io.formats.timing import describe_wrapped
from tests.input_errors import raises_input_error

GOOD = "time_s,table_acc_m_s2\n0,1.5\n0.1,-2e-3\n0.2,3\n"
NAMES = ["time_s", "table_acc_m_s2"]
BLANKS = "cells are separated by blanks"
TABS = "cells are separated by tabs"
SEMICOLONS = "cells are separated by semicolons"


def read(folder: Path, content: str | bytes) -> ForeignTable:
    path = folder / "table.csv"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return read_table(path)


@pytest.mark.parametrize(
    ("content", "names", "units", "first_row", "notes"),
    [
        (GOOD, NAMES, "", 2, ()),
        ("\ufeff" + GOOD, NAMES, "", 2, ()),
        (GOOD.encode("utf-16"), NAMES, "", 2, ("its text is in utf-16",)),
        ("#\xb0\n".encode("cp1252") + GOOD.encode(), NAMES, "", 3, ("its text is in cp1252",)),
        (GOOD.replace("\n", "\r\n"), NAMES, "", 2, ()),
        (GOOD.replace("\n", "\r"), NAMES, "", 2, ()),
        (GOOD.rstrip(), NAMES, "", 2, ()),
        (GOOD + "\n\n", NAMES, "", 2, ()),
        (GOOD.replace(",", ";"), NAMES, "", 2, (SEMICOLONS,)),
        (GOOD.replace(",", "\t"), NAMES, "", 2, (TABS,)),
        (GOOD.replace(",", " , "), NAMES, "", 2, ()),
        (GOOD.replace("\n", ",\n"), NAMES, "", 2, ()),
        (GOOD.replace(",".join(NAMES), '"time_s","table_acc_m_s2",'), NAMES, "", 2, ()),
        ("0 1.5\n0.1 -2e-3\n0.2 3\n", ["column 1", "column 2"], "", 1, (BLANKS,)),
        ("0\t\t1.5\n0.1\t\t-2e-3\n0.2\t\t3\n", ["column 1", "column 2"], "", 1, (BLANKS,)),
        ("  t   u\n  0  1.5\n 0.1 -2e-3\n 0.2   3\n", ["t", "u"], "", 2, (BLANKS,)),
        ("# t u\n0 1.5\n0.1 -2e-3\n0.2 3\n", ["t", "u"], "", 2, (BLANKS,)),
        ("t (s) disp (mm)\n0 1.5\n0.1 -2e-3\n0.2 3\n", ["t (s)", "disp (mm)"], "s mm", 2,
         (BLANKS,)),
        ("Time  Disp table [mm]\n0 1.5\n0.1 -2e-3\n0.2 3\n", ["Time", "Disp table [mm]"], " mm", 2,
         (BLANKS,)),
        ("A quake.\nSource: nobody\nTime[s] Accel[g]\n0\t1.5\n0.1\t-2e-3\n0.2\t3\n",
         ["Time[s]", "Accel[g]"], "s g", 4, (BLANKS,)),
        ("t,u\ns,in\n0,1.5\n0.1,-2e-3\n0.2,3\n", ["t", "u"], "s in", 3, ()),
        ("t;u\n[s];[kN]\n0;1,5\n0,1;-0,002\n0,2;3\n", ["t", "u"], "s kN", 3,
         (SEMICOLONS, "numbers have decimal commas")),
        ("Mass = 1.2 t\nt;u\n0;1,5\n0,1;-0,002\n0,2;3\n", ["t", "u"], "", 3,
         (SEMICOLONS, "numbers have decimal commas")),
        ("Test 7, 3 May\nrun,2\n\nt\tu\n0\t1.5\n0.1\t-2e-3\n0.2\t3\n", ["t", "u"], "", 5, (TABS,)),
    ],
)  # fmt: skip
def test_read_table_of_a_laboratory_program(
    tmp_path: Path,
    content: str | bytes,
    names: list[str],
    units: str,
    first_row: int,
    notes: tuple[str, ...],
) -> None:
    table = read(tmp_path, content)
    assert [*table.columns] == names
    stated = units.split(" ") if units else ["", ""]
    assert [column.unit for column in table.columns.values()] == stated
    assert table.read_column(names[0]).tolist() == [0.0, 0.1, 0.2]
    assert table.read_column(names[1]).tolist() == [1.5, -2e-3, 3.0]
    assert (table.first_row, table.notes) == (first_row, notes)


@pytest.mark.parametrize(
    ("content", "columns", "dropped"),
    [
        (",t,u\n0,0,5\n1,0.1,6\n", {"t": [0, 0.1], "u": [5, 6]}, {"column 1": "counts the rows"}),
        ("a,,c\n1,2,3\n4,7,6\n", {"a": [1, 4], "column 2": [2, 7], "c": [3, 6]}, {}),
        ("t,u,state\n0,5,OK\n1,6,OK\n", {"t": [0, 1], "u": [5, 6]}, {"state": "text"}),
        ("t,u,event\n0,5,\n1,6,\n2,7,hit\n", {"t": [0, 1, 2], "u": [5, 6, 7]}, {"event": "'hit'"}),
        ("t,u,remark\n0,5\n1,6\n", {"t": [0, 1], "u": [5, 6]}, {"remark": "no cells"}),
        ("t,u,u\n0,5,5\n1,6,6\n", {"t": [0, 1], "u": [5, 6]}, {}),
        ("t,u,u\n0,5,5\n1,6,7\n", {"t": [0, 1]}, {"u": "2 columns have this name"}),
        ("t,u\n0,5\n1,6\nend of test\n", {"t": [0, 1], "u": [5, 6]}, {}),
        ("t,u\n0,5\n\n# stop\n1,6\n", {"t": [0, 1], "u": [5, 6]}, {}),
        ("t,u\n0,5\n1,6\n,\n,\n", {"t": [0, 1], "u": [5, 6]}, {}),
        ("t,u\n0,5\n1,\nNaN,6\n", {"t": [0, 1, np.nan], "u": [5, np.nan, 6]}, {}),
        ("t,u\n2026-03-29 23:59:59.995,5\n2026-03-30 00:00:00,6\n", {"t": [0, 0.005], "u": [5, 6]},
         {}),
        ("t;u\n29.3.2026 9:59;5\n29.3.2026 10:00;6\n", {"t": [0, 60], "u": [5, 6]}, {}),
        ("t,u\n3/29/2026 11:59:59 AM,5\n3/29/2026 12:00:00 PM,6\n", {"t": [0, 1], "u": [5, 6]}, {}),
        ("t,u\n23:59:59.5,5\n00:00:00.0,6\n", {"t": [0, 0.5], "u": [5, 6]}, {}),
    ],
)  # fmt: skip
def test_read_table_leaves_out_what_is_no_channel(
    tmp_path: Path, content: str, columns: dict[str, list[float]], dropped: dict[str, str]
) -> None:
    table = read(tmp_path, content)
    values = {name: table.read_column(name).tolist() for name in table.columns}
    assert values.keys() == columns.keys()
    for name, expected in columns.items():
        np.testing.assert_allclose(values[name], expected, atol=1e-9)
    assert table.dropped.keys() == dropped.keys()
    assert all(reason in table.dropped[name] for name, reason in dropped.items())


def test_rows_between_which_lines_are_left_out_keep_their_numbers(tmp_path: Path) -> None:
    table = read(tmp_path, "t,u\n0,5\n\n# stop\n1,6\n2,7\n")
    assert [table.describe_row(k)[-5:] for k in range(3)] == ["row 2", "row 5", "row 6"]
    assert table.notes == ("left out: 2 lines between the samples that hold none",)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", ["empty"]),
        ("  \n\n", ["empty"]),
        (b"\x89PNG\r\n\x1a\n\0\0", ["a PNG image"]),
        (b"\1\2\0\0", ["a binary file"]),
        ("a,b\n", ["no samples"]),
        ("a,b\n1,2\n3\n", ["row 3", "1 cells", "2 columns"]),
        ("a,b\n1,2\n3,4,5\n", ["row 3", "3 cells"]),
        ("a,b\n1,2,3,4\n", ["row 2", "decimal commas"]),
        ("Time, s,Force\n0,1\n2,3\n", ["row 2 has 2 cells", "3 columns"]),
        ("a;b\n1;2.5\n3;4,5\n", ["row 3", "column 'b'", "'4,5'", "decimal comma", "a point"]),
        ("a;b\n1;2,5\n3;4,5\n" + "5;6\n" * 300 + "7;8.5\n", ["row 304", "'8.5'"]),
        ("a,b\ns,mm\n1,2\nx,3\n", ["row 4", "column 'a'", "'x'"]),
        ("t u\n0 1\n1 2\n2 3 4\n", ["row 4", "3 cells", "2 columns"]),
        ("a,b\n1,2\n3,lost\n", ["row 3", "column 'b'", "leave a lost sample empty"]),
        ("a,b\n1,2\nend\n3,4\n", ["row 3 has 1 cells"]),
        ('a,b\n1,"2\n' + "3,4\n" * 50_000, ["row 2", "quote"]),
        ("a,b\n" + "1" * (MAX_LINE_CHARS + 5), ["line of more than"]),
        ("2 CORRECTED ACCELEROGRAM  X\n1 2\n", ["an SMC record of USGS", "header is cut off"]),
        ("LabVIEW Measurement\t\nSeparator\tTab\n", ["a LabVIEW measurement file", "no segment"]),
    ],
)
def test_read_table_refuses_a_text(tmp_path: Path, content: str | bytes, words: list[str]) -> None:
    with pytest.raises(InputError) as caught:
        read(tmp_path, content)
    for word in ["table.csv", *words]:
        assert word in str(caught.value)


def test_read_column_names_an_infinite_sample(tmp_path: Path) -> None:
    table = read(tmp_path, "a,b\n1,2\n3,inf\n")
    with raises_input_error(where=f"{table.path}: row 3, column 'b'", problem="infinite"):
        table.read_column("b")


@pytest.mark.parametrize(
    ("preamble", "facts"),
    [
        ("Sampling rate: 200 Hz", {"rate_hz": 200.0}),
        ("# dt = 5 ms, mass = 1.2 t", {"rate_hz": 200.0, "mass_kg": 1200.0}),
        ("fs;0,5 kHz", {"rate_hz": 500.0}),
        ("SAMPLING_INTERVAL_S: 0.005000", {"rate_hz": 200.0}),
        ("Specimen mass (kg): 550", {"mass_kg": 550.0}),
        ("massive block, offset 3", {}),
    ],
)
def test_read_facts_above_the_samples(
    tmp_path: Path, preamble: str, facts: dict[str, float]
) -> None:
    table = read(tmp_path, f"{preamble}\nt\tu\n0\t1.5\n0.1\t2\n")
    assert table.facts == pytest.approx(facts)


def make_lvm(
    x_columns: str, separator: str = "\t", comma: bool = False, starts: tuple[float, ...] = (0.0,)
) -> str:
    """Return an .lvm file of segments with three samples of two channels at 200 Hz."""
    word = {"\t": "Tab", ",": "Comma"}[separator]
    lines = [
        "LabVIEW Measurement",
        f"Separator{separator}{word}",
        f"X_Columns{separator}{x_columns}",
    ]
    lines += [f"Decimal_Separator{separator}{',' if comma else '.'}", "***End_of_Header***", ""]
    for start in starts:
        for key, cells in (
            ("Channels", ["2"]), ("Samples", ["3", "3"]), ("Y_Unit_Label", ["mm", "N"]),
            ("X0", [str(start)] * 2), ("Delta_X", ["0.005"] * 2), ("***End_of_Header***", ["", ""]),
        ):  # fmt: skip
            lines.append(separator.join([key, *cells]))
        names = [
            "X_Value",
            "Weg",
            *(["X_Value"] if x_columns == "Multi" else []),
            "Kraft",
            "Comment",
        ]
        lines.append(separator.join(names))
        for k in range(3):
            x = f"{start + 0.005 * k:.6f}"
            cells = [x if x_columns != "No" else "", f"{k}.25"]
            cells += [x] if x_columns == "Multi" else []
            cells += [f"{10 * k}.5", *(["hit"] if k == 1 else [])]
            row = separator.join(cells)
            lines.append(row.replace(".", ",") if comma else row)
        lines.append("")
    return "\r\n".join(lines)


@pytest.mark.parametrize("x_columns", ["No", "One", "Multi"])
@pytest.mark.parametrize(("separator", "comma"), [("\t", False), ("\t", True), (",", False)])
def test_parse_lvm_reads_values_units_and_times(
    x_columns: str, separator: str, comma: bool
) -> None:
    table = parse_text(make_lvm(x_columns, separator, comma), "a.lvm")
    weg, kraft = table.columns["Weg"], table.columns["Kraft"]
    assert (weg.unit, weg.rate_hz, kraft.unit) == ("mm", pytest.approx(200.0), "N")
    assert table.read_column("Weg").tolist() == [0.25, 1.25, 2.25]
    assert table.read_column("Kraft").tolist() == [0.5, 10.5, 20.5]
    assert table.read_column(weg.clock).tolist() == pytest.approx([0.0, 0.005, 0.01])


@pytest.mark.parametrize("x_columns", ["No", "One", "Multi"])
def test_parse_lvm_joins_segments_whose_time_goes_on(x_columns: str) -> None:
    table = parse_text(make_lvm(x_columns, starts=(0.0, 0.015)), "a.lvm")
    assert table.read_column("Kraft").tolist() == [0.5, 10.5, 20.5] * 2
    assert table.columns["Kraft"].size == 6
    apart = parse_text(make_lvm(x_columns, starts=(0.0, 0.0)), "a.lvm")
    assert {"segment 1/Kraft", "segment 2/Kraft"} <= apart.columns.keys()
    assert apart.select_group("segment 2").read_column("Weg").tolist() == [0.25, 1.25, 2.25]


def test_read_table_of_a_file_that_is_not_there(tmp_path: Path) -> None:
    with raises_input_error(where=tmp_path / "none.csv", problem=os.strerror(errno.ENOENT)):
        read_table(tmp_path / "none.csv")
    with raises_input_error(where=tmp_path, problem=os.strerror(errno.EISDIR)):
        read_table(tmp_path)


def test_record_of_usgs_in_fixed_columns(tmp_path: Path) -> None:
    """Samples of ten columns touch, and the headers have numbers without names."""
    values = [-1.2345e2, 2.5e-1, -9.9999e1] * 5
    integers = ["-32768"] * 15 + ["2", "15"] + ["0"] * 31
    numbers = ["1.7e38", "2.0e2"] + ["0.0"] * 48
    lines = ["2 CORRECTED ACCELEROGRAM", *["*"] * 10]
    for words, count, width in ((integers, 8, 10), (numbers, 5, 15)):
        rows = (words[k : k + count] for k in range(0, len(words), count))
        lines += ["".join(word.rjust(width) for word in row) for row in rows]
    cells = [f"{value:10.3E}".rjust(10) for value in values]
    lines += ["| a remark", "| and one more"]
    lines += ["".join(cells[k : k + 8]) for k in range(0, len(cells), 8)]
    (tmp_path / "a.smc").write_text("\n".join(lines) + "\n")
    history = read_table(tmp_path / "a.smc").columns["history"]
    assert history.values is not None
    assert history.values.tolist() == [float(cell) for cell in cells]
    assert (history.unit, history.rate_hz) == ("cm/s2", 200.0)
    (tmp_path / "cut.smc").write_text("\n".join(lines[:-1]) + "\n")
    with raises_input_error(problem="15 samples, but 8 follow"):
        read_table(tmp_path / "cut.smc")


@pytest.mark.parametrize("lost", [1, 100, 299])
@pytest.mark.parametrize("mark", ["", "-", "NaN", "0"])
def test_a_cell_without_its_unit_loses_no_sample(tmp_path: Path, lost: int, mark: str) -> None:
    rows = [
        f"{0.01 * k:.2f},{k}.5 mm" if k != lost else f"{0.01 * k:.2f},{mark}" for k in range(300)
    ]
    content = "time,acc\n" + "\n".join(rows) + "\n"
    if mark in ("NaN", "0"):
        with raises_input_error(where=f"{tmp_path / 'table.csv'}: row {lost + 2}, column 'acc'"):
            read(tmp_path, content)
        return
    table = read(tmp_path, content)
    assert {*table.columns} == {"time", "acc"}
    assert table.read_column("time").tolist() == [round(0.01 * k, 2) for k in range(300)]
    assert np.flatnonzero(np.isnan(table.read_column("acc"))).tolist() == [lost]


def test_a_channel_of_an_oscilloscope_that_is_left_out_is_named(tmp_path: Path) -> None:
    rows = "".join(f"{k},0.{k},OFF,,\n" for k in range(6))
    table = read(tmp_path, f"X,CH1,CH2,Start,Increment\nSequence,Volt,Volt,-0.5,1e-3\n{rows}")
    assert {*table.columns} == {"CH1"}
    assert "OFF" in table.dropped["CH2"]


def test_sensors_that_move_together_are_no_series_in_lines(tmp_path: Path) -> None:
    phase = 0.5 * np.arange(200)[:, None] + [0.0, 0.1, 0.2]
    together = "\n".join(",".join(f"{x:.4f}" for x in row) for row in np.sin(phase))
    assert describe_wrapped(read(tmp_path, together)) == ""
    series = np.sin(0.1 * np.arange(600)).reshape(-1, 3)
    wrapped = "\n".join(",".join(f"{x:.4f}" for x in row) for row in series)
    assert "600 values in lines of 3" in describe_wrapped(read(tmp_path, wrapped))
