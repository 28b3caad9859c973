"""Readers of recorded histories: each format with known numbers, and each fault with its line."""

import hashlib
import io
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np
import pytest
from scipy import io as scipy_io

from table_io.config.base import parse_toml
from table_io.config.excitation.record import (
    RecordedHistory,
    RecordedSeries,
    SeriesRequest,
    convert_binary,
    read_series,
)
from table_io.config.profile import Profile, load_profile
from tests.input_errors import raises_input_error
from tests.table_io.formats.test_formats import DISP, FORMATS, RATE

VALUES = [round(0.01 * (-1) ** k * (k + 1), 3) for k in range(20)]
TEST = """title = "a record"
[specimen]
mass_kg = 550.0
gap_mm = 4.0
[excitation]
kind = "record"
"""


def read(text: str, name: str, **request: Any) -> RecordedSeries:
    return read_series(text, name, SeriesRequest(**request))


def peer(header: str, values: list[float] = VALUES, units: str = "G") -> str:
    rows = [" ".join(f"{v:15.7E}" for v in values[k : k + 5]) for k in range(0, len(values), 5)]
    lines = ["PEER NGA STRONG MOTION DATABASE RECORD", "Somewhere, 1/1/1990, Station, 90"]
    units_line = f"ACCELERATION TIME SERIES IN UNITS OF {units}"
    return "\n".join([*lines, units_line, header, *rows, ""])


def csmip(*channels: list[float]) -> str:
    """Blocks of acceleration, velocity and displacement; the numbers touch, as in such files."""
    lines = ["CORRECTED ACCELEROGRAM", "  7250 points of instrument- and baseline-corrected accel"]
    for number, values in enumerate(channels, 1):
        for word, factor in (("accel", 1.0), ("veloc", 100.0), ("displ", 1000.0)):
            unit = {"accel": "cm/sec2", "veloc": "cm/sec", "displ": "cm"}[word]
            lines.append(
                f"{len(values):8d} points of {word} data equally spaced at  .020 sec, in {unit}. "
                "(8f10.3)"
            )
            cells = [f"{factor * v - 1000:10.3f}" for v in values]
            lines += ["".join(cells[k : k + 8]) for k in range(0, len(cells), 8)]
        lines.append(f"/&  ----------  End of data for channel {number:2d}  ----------")
    return "\n".join(lines)


def cosmos(step: str = "0.005000") -> str:
    header = [f"{-999.0:15.6f}"] * 100
    header[33] = f"{step:>15}"
    rows = ["".join(header[k : k + 5]) for k in range(0, 100, 5)]
    cells = [f"{v:10.5f}" for v in VALUES]
    return "\n".join([
        "Corrected acceleration    (Format v01.20 with 13 text lines)",
        "100 Real-header values follow on  20 lines, Format= (5F15.6)",
        *rows,
        '   1 Comment line(s) follow, each starting with a "|":',
        "| Sensor: a sensor",
        "      20 acceleration pts, approx   0 secs, units=cm/sec2(04),Format=(8F10.5)",
        *["".join(cells[k : k + 8]) for k in range(0, 20, 8)],
        "End-of-data for Chan  1 acceleration",
    ])  # fmt: skip


@pytest.mark.parametrize(
    "header",
    ["NPTS=  20, DT= .00500 SEC", "   20    0.0050    NPTS, DT", "NPTS= 20, DT=  5.0E-03 SEC,"],
)
def test_a_peer_file_is_read_in_g(header: str) -> None:
    series = read(peer(header), "RSN6_IMPVALL.I_I-ELC180.AT2")
    assert (series.quantity, series.rate_hz) == ("acceleration", pytest.approx(200.0))
    assert series.values == pytest.approx(9.80665 * np.array(VALUES))


def test_a_displacement_of_peer_is_read_in_cm() -> None:
    series = read(peer("NPTS= 20, DT= .01 SEC", units="CM"), "x.dt2")
    assert series.quantity == "displacement"
    assert series.values == pytest.approx(0.01 * np.array(VALUES))


def test_one_channel_of_a_csmip_file_is_read() -> None:
    text = csmip(VALUES, [2 * v for v in VALUES])
    series = read(text, "CHAN.V2", column=2)
    assert (series.quantity, series.rate_hz) == ("acceleration", pytest.approx(50.0))
    assert series.values == pytest.approx(0.01 * (2 * np.array(VALUES) - 1000))


def test_a_v2_file_is_kept_without_velocity_and_displacement(tmp_path: Path) -> None:
    """Files of three channels are larger than a profile may be; the checksum is of the whole."""
    whole = csmip(VALUES, [2 * v for v in VALUES])
    data = (whole + "\n").replace("\n", "\r\n").encode()
    files = RecordedHistory.convert_file(data, "CHAN.V2", {})
    text = files["CHAN.V2"]
    assert "veloc data" not in text
    assert len(text) < 0.5 * len(data)
    assert files["CHAN.V2.sha256"] == hashlib.sha256(data).hexdigest()
    for channel in (1, 2):
        kept, original = (read(t, "CHAN.V2", column=channel) for t in (text, whole))
        assert kept.values.tobytes() == original.values.tobytes()


def test_a_cosmos_file_is_read_with_the_step_of_its_real_header() -> None:
    series = read(cosmos(), "x.V2c")
    assert (series.quantity, series.rate_hz) == ("acceleration", pytest.approx(200.0))
    assert series.values == pytest.approx(0.01 * np.array(VALUES))


def test_columns_of_numbers_are_read_after_comments_of_either_sign() -> None:
    rows = "".join(f"{v}\t\t{2 * v}\r\n" for v in VALUES)
    text = f"%1979, El Centro. Acc. in cm/sec^2\n# and dt=0.005 sec.\n\n{rows}"
    series = read(text, "elcentro.txt", unit="cm/s2", step_s=0.005, column=2)
    assert series.values == pytest.approx(0.02 * np.array(VALUES))
    assert series.rate_hz == pytest.approx(200.0)


def test_the_first_column_holds_the_times_unless_the_step_is_set() -> None:
    text = "".join(f"{0.02 * k:.2f} {v}\n" for k, v in enumerate(VALUES))
    series = read(text, "x.txt", unit="mm")
    assert series.values == pytest.approx(1e-3 * np.array(VALUES))
    assert series.rate_hz == pytest.approx(50.0)


@pytest.mark.parametrize("column", ["ew_acc_m_s2", 3])
def test_a_column_of_a_csv_is_chosen_by_header_or_number(column: object) -> None:
    rows = "".join(f"{0.01 * k:.2f},{v},{2 * v}\n" for k, v in enumerate(VALUES))
    series = read(f"time_s,ns_acc_g,ew_acc_m_s2\n{rows}", "x.csv", column=column)
    assert series.quantity == "acceleration"
    assert series.values == pytest.approx(2 * np.array(VALUES))


def test_a_csv_without_times_needs_the_step() -> None:
    text = "acc_g\n" + "".join(f"{v}\n" for v in VALUES)
    assert read(text, "x.csv", step_s=0.01).rate_hz == pytest.approx(100.0)
    with raises_input_error(problem="acc_g", remedy="step_s"):
        read(text, "x.csv")


COLUMNS = "".join(f"{v} {v}\n" for v in VALUES)
TIMES = "".join(f"{0.01 * k:.2f} {v}\n" for k, v in enumerate(VALUES))
WAVE = np.sin(0.2 * np.arange(96)).reshape(-1, 6)
WRAPPED = "".join(" ".join(f"{v:.4f}" for v in row) + "\n" for row in WAVE)
NPTS = "NPTS= 20, DT= .01 SEC"


@pytest.mark.parametrize(
    ("text", "name", "request_keys", "fields"),
    [
        (COLUMNS, "x.txt", {"unit": "g", "step_s": 0.01},
         {"problem": "2 columns", "allowed": "column = 1 to 2"}),
        (COLUMNS, "x.txt", {"unit": "g", "step_s": 0.01, "column": 3}, {"allowed": "1 to 2"}),
        (WRAPPED, "x.txt", {"unit": "g", "step_s": 0.01}, {"problem": "96 values in lines of 6"}),
        (COLUMNS, "x.txt", {"unit": "g"},
         {"where": "x.txt: row 2, time_s", "problem": "must rise", "remedy": "step_s"}),
        (COLUMNS, "x.txt", {"step_s": 0.01, "column": 1}, {"remedy": "cm/s2"}),
        (TIMES, "x.txt", {"unit": "g", "quantity": "displacement"}, {"problem": "acceleration"}),
        (TIMES + "0.20\n", "x.txt", {"unit": "g"}, {"problem": "row 21 has 1 cells"}),
        (TIMES + "0.20 nan\n", "x.txt", {"unit": "g"}, {"where": "x.txt: row 21"}),
        ("0.1\n" * 20, "x.txt", {"unit": "g"}, {"remedy": "step_s"}),
        ("", "x.txt", {"unit": "g"}, {"problem": "empty"}),
        (peer(NPTS, VALUES[:19]), "x.AT2", {}, {"where": "x.AT2: row 4", "problem": "19"}),
        (peer(NPTS).replace("1.0000000E-02", "1.0000000Q-02"), "x.AT2", {},
         {"where": "x.AT2: row 5"}),
        (peer(NPTS, units="CM/S"), "x.VT2", {}, {"problem": "CM/S", "remedy": "acceleration"}),
        (peer("4000 points"), "x.AT2", {}, {"problem": "NPTS"}),
        (peer("NPTS= 20, DT= 0.0 SEC"), "x.AT2", {}, {"where": "x.AT2: row 4"}),
        (peer(NPTS), "x.AT2", {"unit": "cm/s2"}, {"problem": "'g'"}),
        (peer(NPTS), "x.AT2", {"step_s": 0.02}, {"problem": "0.01 s"}),
        (csmip(VALUES, VALUES), "x.v2", {}, {"problem": "channel 2", "allowed": "1 to 2"}),
        (csmip(VALUES, VALUES), "x.v2", {"column": 3}, {"allowed": "1 to 2"}),
        (csmip(VALUES).replace("20 points of accel", "24 points of accel"), "x.v2", {},
         {"where": "x.v2: row 7", "problem": "points of veloc"}),
        ("nothing\n", "x.v2", {}, {"problem": "0 channels"}),
        (cosmos(step="-999.0"), "x.v2", {}, {"problem": "-999.0", "allowed": "above 0 s"}),
        ("time_s,a_g\n" + TIMES.replace(" ", ","), "x.csv", {"step_s": 0.02},
         {"key": "step_s", "value": 0.02, "problem": "0.01 s"}),
        ("time_s,a_g\n" + TIMES.replace(" ", ","), "x.csv", {"column": "b_g"},
         {"remedy": "a_g"}),
        ("time_s,a_g\n0.0,1.0\n", "x.csv", {}, {"problem": "1 samples", "allowed": "16 to"}),
    ],
)  # fmt: skip
def test_a_fault_of_a_file_is_named_with_what_to_do(
    text: str, name: str, request_keys: dict[str, Any], fields: dict[str, str]
) -> None:
    with raises_input_error(**fields):
        read(text, name, **request_keys)


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("x.at2", "NPTS= 1 " * 200_000),
        ("x.v2", "20 points of accel data equally spaced at " + "1" * 1_500_000),
        ("x.txt", " " * 1_500_000 + "x"),
    ],
)
def test_a_hostile_line_is_refused_at_once(name: str, line: str) -> None:
    begin = monotonic()
    with raises_input_error():
        read(line, name, unit="g")
    assert monotonic() - begin < 2.0


def make_mat(**arrays: Any) -> bytes:
    stream = io.BytesIO()
    scipy_io.savemat(stream, arrays, do_compression=True)
    return stream.getvalue()


def make_npz(**arrays: Any) -> bytes:
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    return stream.getvalue()


EXACT = np.array([[0.02 * k for k in range(30)], np.random.default_rng(1).standard_normal(30)])


@pytest.mark.parametrize(("suffix", "make"), [("mat", make_mat), ("npz", make_npz)])
def test_a_binary_file_becomes_text_with_every_bit(suffix: str, make: Any, tmp_path: Path) -> None:
    data = make(record=EXACT, note=np.zeros(3))
    (tmp_path / f"motion.{suffix}").write_bytes(data)
    path = tmp_path / "test.toml"
    path.write_text(TEST + f'file = "motion.{suffix}"\nunit = "m/s2"\nband_hz = [2.0, 15.0]\n')
    profile, text = load_profile(path)
    (tmp_path / f"motion.{suffix}").unlink()
    excitation = parse_toml(text, Profile, "recording").excitation
    assert isinstance(excitation, RecordedHistory)
    assert excitation.series.values.tobytes() == EXACT[1].tobytes()
    assert excitation.series.rate_hz == pytest.approx(50.0)
    assert excitation.checksum == hashlib.sha256(data).hexdigest()
    assert profile.plan.history_m.tobytes() == excitation.plan(2000.0).history_m.tobytes()


@pytest.mark.parametrize(("suffix", "make"), [("mat", make_mat), ("npz", make_npz)])
def test_an_unclear_array_is_refused_with_those_that_there_are(suffix: str, make: Any) -> None:
    data = make(ns=EXACT, ew=EXACT[1], scalar=3.0)
    with raises_input_error(where=f"x.{suffix}", problem="'ud'", allowed="ns 30 x 2"):
        convert_binary(data, f"x.{suffix}", "ud")
    assert "ns:1,ns:2,ew" in convert_binary(data, f"x.{suffix}", None)
    with raises_input_error(where=f"x.{suffix}", remedy="export it again"):
        convert_binary(data[: len(data) // 2], f"x.{suffix}", None)
    assert convert_binary(data, f"x.{suffix}", "ew").count("\n") == 31


@pytest.mark.parametrize("kind", FORMATS)
def test_convert_file_of_every_format_of_an_import(kind: str, tmp_path: Path) -> None:
    """A record and an import read the same formats, and the same numbers."""
    name, write, _ = FORMATS[kind]
    write(tmp_path / name)
    text = RecordedHistory.convert_file((tmp_path / name).read_bytes(), name, {})[name]
    column = "both:1" if kind == "npz" else "u"
    has_unit = kind in ("hdf5", "tdms", "uff binary", "uff text")
    keys: dict[str, Any] = {"column": "test/u" if kind == "mat v5" else column}
    series = read(text, name, **keys, unit=None if has_unit else "mm")
    assert (series.quantity, series.rate_hz) == ("displacement", pytest.approx(RATE))
    np.testing.assert_allclose(series.values, 1e-3 * DISP, rtol=1e-10)


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("\ufeffTime [s],Acceleration [g]\n" + "{rows,}", "x.csv"),
        ("A quake\nSource: nobody\nTime[s] Accel[g]\n" + "{rows\t}", "x.dat"),
        ("Zeit (ms);Beschl (g)\n" + "{milli;}", "x.csv"),
        ("t,a_g,state\n" + "{states,}", "x.csv"),
        (",t,a_g\n" + "{index,}", "x.csv"),
        ("Station Code / Name   : 1 / Nowhere\nTime Increment (s)    : 0.01\nData (g)    :\n{one}",
         "x.acc"),
        ("EVENT: x\nSAMPLING_INTERVAL_S: 0.010000\nUNITS: g\nUSER5:\n{one}", "x.asc"),
    ],
)  # fmt: skip
def test_read_series_of_tables_that_an_import_reads(text: str, name: str) -> None:
    times = [f"{0.01 * k:.2f}" for k in range(20)]
    rows = [*zip(times, map(str, VALUES), strict=True)]
    lines = {
        "{rows,}": [",".join(row) for row in rows],
        "{rows\t}": ["\t".join(row) for row in rows],
        "{milli;}": [f"{10 * k},0;{value}".replace(".", ",") for k, value in enumerate(VALUES)],
        "{states,}": [",".join((*row, "OK")) for row in rows],
        "{index,}": [",".join((str(k), *row)) for k, row in enumerate(rows)],
        "{one}": [*map(str, VALUES)],
    }
    for mark, samples in lines.items():
        text = text.replace(mark, "\n".join(samples))
    series = read(text, name)
    assert (series.quantity, series.rate_hz) == ("acceleration", pytest.approx(100.0))
    np.testing.assert_allclose(series.values, 9.80665 * np.array(VALUES))


def test_a_fault_of_a_binary_file_names_profile_file_and_key(tmp_path: Path) -> None:
    (tmp_path / "motion.npz").write_bytes(make_npz(ns=EXACT, ew=EXACT))
    path = tmp_path / "test.toml"
    path.write_text(TEST + 'file = "motion.npz"\nunit = "g"\n')
    with raises_input_error(key="excitation.file", problem="ns:1, ns:2, ew:1, ew:2"):
        load_profile(path)


def test_a_huge_compressed_array_is_refused_unread() -> None:
    data = make_npz(big=np.zeros(9 * 2**20))
    assert len(data) < 100_000
    with raises_input_error(where="x.npz", problem="too short or long: big"):
        convert_binary(data, "x.npz", None)


def test_the_checksum_is_that_of_the_file_with_its_own_line_ends(tmp_path: Path) -> None:
    data = ("% sign of a degree: \xb0\r\n" + TIMES.replace("\n", "\r\n") + "\x1a").encode("latin-1")
    (tmp_path / "motion.txt").write_bytes(data)
    path = tmp_path / "test.toml"
    keys = 'file = "motion.txt"\nunit = "g"\nband_hz = [6.0, 30.0]\n'
    path.write_text(TEST + keys)
    profile, text = load_profile(path)
    excitation = profile.excitation
    assert isinstance(excitation, RecordedHistory)
    assert excitation.checksum == hashlib.sha256(data).hexdigest()
    assert parse_toml(text, Profile, "recording") == profile
    path.write_text(TEST + f'{keys}sha256 = "{excitation.checksum.upper()}"\n')
    load_profile(path)
    path.write_text(TEST + f'{keys}sha256 = "{64 * "0"}"\n')
    with raises_input_error(key="excitation.file", problem=excitation.checksum, allowed="00000"):
        load_profile(path)


def test_read_series_of_a_knet_record() -> None:
    """Counts about their mean, in gal by the scale factor of the header."""
    head = (
        "Origin Time       2026/03/29 01:59:00", "Lat.              38.1",
        "Station Code      XYZ001", "Sampling Freq(Hz) 100Hz", "Duration Time(s)  1",
        "Dir.              N-S", "Scale Factor      3920(gal)/6182761", "Max. Acc. (gal)   1.2",
        "Memo.",
    )  # fmt: skip
    counts = 12345 + np.round(1e5 * np.sin(0.3 * np.arange(96))).astype(int)
    lines = [" ".join(f"{count:8d}" for count in counts[k : k + 8]) for k in range(0, 96, 8)]
    series = read("\n".join([*head, *lines]), "XYZ0012603290159.NS")
    expected = 1e-2 * 3920 / 6182761 * (counts - counts.mean())
    np.testing.assert_allclose(series.values, expected, rtol=1e-12)
    assert (series.rate_hz, series.quantity) == (100.0, "acceleration")
    with raises_input_error(problem="K-NET record without scale"):
        read("\n".join([*head[:6], *head[7:], *lines]), "a.EW")
