"""Somebody's text table: what is read, and what is refused with row, column and remedy."""

import errno
import os
from pathlib import Path

import numpy as np
import pytest

from table_io.errors import InputError
from table_io.formats import read_table
from table_io.formats.table import ForeignTable
from table_io.formats.text import MAX_LINE_CHARS
from tests.input_errors import raises_input_error

GOOD = "time_s,table_acc_m_s2\n0,1.5\n0.1,-2e-3\n0.2,3\n"


def read(folder: Path, content: str | bytes) -> ForeignTable:
    path = folder / "table.csv"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return read_table(path)


@pytest.mark.parametrize(
    "content",
    [
        GOOD,
        "\ufeff" + GOOD,
        GOOD.replace("\n", "\r\n"),
        GOOD.rstrip(),
        GOOD + "\n\n",
        GOOD.replace(",", ";"),
        GOOD.replace(",", "\t"),
        GOOD.replace(",", " , "),
        GOOD.replace("\n", ",\n"),
        GOOD.replace("time_s,table_acc_m_s2", '"time_s","table_acc_m_s2",'),
    ],
    ids=["plain", "BOM", "CRLF", "no end", "blank end", ";", "tab", "spaces", "trailing", "quoted"],
)
def test_the_same_table_in_other_clothes(tmp_path: Path, content: str) -> None:
    table = read(tmp_path, content)
    assert list(table.columns) == ["time_s", "table_acc_m_s2"]
    assert table.read_column("time_s").tolist() == [0.0, 0.1, 0.2]
    assert table.read_column("table_acc_m_s2").tolist() == [1.5, -2e-3, 3.0]


def test_another_delimiter_is_said(tmp_path: Path) -> None:
    assert read(tmp_path, GOOD).notes == ()
    assert "semicolons" in read(tmp_path, GOOD.replace(",", ";")).notes[0]
    assert "tabs" in read(tmp_path, GOOD.replace(",", "\t")).notes[0]


def test_an_empty_cell_is_a_lost_sample(tmp_path: Path) -> None:
    read_column = read(tmp_path, "a,b,c\n1,,3\n4,NaN,\n").read_column
    assert np.isnan(read_column("b")).all()
    assert read_column("a").tolist() == [1.0, 4.0]
    assert np.isnan(read_column("c")).tolist() == [False, True]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", ["empty"]),
        ("  \n\n", ["empty"]),
        (b"\x89PNG\r\n\x1a\n\0\0", ["a PNG image"]),
        ("a,b\n", ["no samples"]),
        ("a,b\n1,2\n3\n", ["row 3", "1 cells", "2 columns"]),
        ("a,b\n1,2\n3,4,5\n", ["row 3", "3 cells"]),
        ("a,b\n1,2,3,4\n", ["row 2", "decimal commas"]),
        ("a;b\n1;2.5\n3;4,5\n", ["row 3", "column 'b'", "'4,5'", "decimal comma", "a point"]),
        ("a;b\n1;2,5\n3;4,5\n" + "5;6\n" * 300 + "7;8.5\n", ["row 304", "'8.5'"]),
        ("a,b\ns,mm\n1,2\nx,3\n", ["row 4", "column 'a'", "'x'"]),
        ("t u\n0 1\n1 2\n2 3 4\n", ["row 4", "3 cells", "2 columns"]),
        ("a,b\n1,2\n3,N/A\n", ["row 3", "column 'b'", "leave a lost sample empty"]),
        ('a,b\n1,"2\n' + "3,4\n" * 50_000, ["row 2", "quote"]),
        ("a,b\n" + "1" * (MAX_LINE_CHARS + 5), ["line of more than"]),
    ],
)
def test_hostile_tables(tmp_path: Path, content: str | bytes, words: list[str]) -> None:
    with pytest.raises(InputError) as caught:
        read(tmp_path, content)
    for word in ["table.csv", *words]:
        assert word in str(caught.value)


@pytest.mark.parametrize(
    ("content", "names", "units", "first_row"),
    [
        ("0 1.5\n0.1 -2e-3\n0.2 3\n", ["column 1", "column 2"], ["", ""], 1),
        ("  t   u\n  0  1.5\n 0.1 -2e-3\n 0.2   3\n", ["t", "u"], ["", ""], 2),
        ("# t u\n0 1.5\n0.1 -2e-3\n0.2 3\n", ["t", "u"], ["", ""], 2),
        ("t (s) disp (mm)\n0 1.5\n0.1 -2e-3\n0.2 3\n", ["t (s)", "disp (mm)"], ["s", "mm"], 2),
        (
            "Time  Disp table [mm]\n0 1.5\n0.1 -2e-3\n0.2 3\n",
            ["Time", "Disp table [mm]"],
            ["", "mm"],
            2,
        ),
        ("t,u\ns,in\n0,1.5\n0.1,-2e-3\n0.2,3\n", ["t", "u"], ["s", "in"], 3),
        ("t;u\n[s];[kN]\n0;1,5\n0,1;-0,002\n0,2;3\n", ["t", "u"], ["s", "kN"], 3),
        ("Test 7, 3 May\nrun,2\n\nt\tu\n0\t1.5\n0.1\t-2e-3\n0.2\t3\n", ["t", "u"], ["", ""], 5),
    ],
    ids=["bare", "blanks", "remark", "brackets", "words", "units", "decimal commas", "preamble"],
)
def test_tables_of_laboratory_programs(
    tmp_path: Path, content: str, names: list[str], units: list[str], first_row: int
) -> None:
    table = read(tmp_path, content)
    assert [*table.columns] == names
    assert [column.unit for column in table.columns.values()] == units
    assert table.first_row == first_row
    assert table.read_column(names[0]).tolist() == [0.0, 0.1, 0.2]
    assert table.read_column(names[1]).tolist() == [1.5, -2e-3, 3.0]


@pytest.mark.parametrize(
    ("preamble", "facts"),
    [
        ("Sampling rate: 200 Hz", {"rate_hz": 200.0}),
        ("# dt = 5 ms, mass = 1.2 t", {"rate_hz": 200.0, "mass_kg": 1200.0}),
        ("fs;0,5 kHz", {"rate_hz": 500.0}),
        ("Specimen mass (kg): 550", {"mass_kg": 550.0}),
        ("massive block, offset 3", {}),
    ],
)
def test_facts_of_the_test_above_the_samples(
    tmp_path: Path, preamble: str, facts: dict[str, float]
) -> None:
    table = read(tmp_path, f"{preamble}\nt\tu\n0\t1.5\n0.1\t2\n")
    assert table.facts == pytest.approx(facts)


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with raises_input_error(where=tmp_path / "none.csv", problem=os.strerror(errno.ENOENT)):
        read_table(tmp_path / "none.csv")
    with raises_input_error(where=tmp_path, problem=os.strerror(errno.EISDIR)):
        read_table(tmp_path)
