"""Times of strangers' tables: read as what they are, asked for, or refused with both values."""

from collections.abc import Callable
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from table_io.block import Float1D
from table_io.errors import InputError
from table_io.formats import read_table
from table_io.formats.table import ForeignColumn, ForeignTable, make_column
from tests.input_errors import raises_input_error
from twin.exchange.columns import ColumnMap, ImportedSamples, read_samples
from twin.exchange.import_table import ImportOptions, import_table, propose_import
from twin.exchange.proposal import propose_map

RATE_HZ = 200.0
TIME: Float1D = np.arange(800) / RATE_HZ
U: Float1D = 10.0 * np.sin(2 * np.pi * 1.5 * TIME)
FORCE: Float1D = 36.0 * U + 1.1 * np.gradient(U, TIME)


def make_table(times: Float1D | None, header: str = "Time", **facts: float) -> ForeignTable:
    columns = {"Disp (mm)": make_column(U, "mm"), "Force (N)": make_column(FORCE, "N")}
    if times is not None:
        columns = {header: make_column(np.asarray(times, dtype=np.float64)), **columns}
    return ForeignTable(Path(__file__), "a table", columns, facts=facts)


def read_proposed(table: ForeignTable, **settings: float) -> ImportedSamples:
    """Return the samples by the proposed map; InputError with its questions."""
    proposal = propose_map(table, settings=settings)
    if proposal.questions:
        raise InputError("; ".join(proposal.questions))
    stated = proposal.to_map().model_dump(exclude_unset=True) | settings
    return read_samples(table, ColumnMap.model_validate(stated))


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (lambda t: t, "no unit is stated"),
        (lambda t: 1774749599.0 + t, "since 1970, from 2026-03-29 01:59:59"),
        (lambda t: 1e3 * (1774749599.0 + t), "counts ms since 1970"),
        (lambda t: 1e9 * (1774749599.0 + t), "counts ns since 1970"),
        (lambda t: 46110.0 + t / 86400.0, "since 1899-12-30, from 2026-03-29"),
    ],
)
def test_times_without_a_unit_are_taken_where_one_is_plausible(
    make: Callable[[Float1D], Float1D], reason: str
) -> None:
    table = make_table(make(TIME))
    assert reason in propose_map(table).columns[0].reason
    samples = read_proposed(table)
    assert samples.rate_hz == pytest.approx(RATE_HZ, rel=1e-6)
    assert samples.index.tolist() == list(range(TIME.size))


@pytest.mark.parametrize(
    ("times", "unit"),
    [
        (TIME / 60.0, "min"),
        (TIME / 3600.0, "hour"),
        (TIME / 86400.0, "day"),
        (1e3 * TIME, "ms"),
        (1e9 * TIME, "ns"),
    ],
)
def test_times_without_a_unit_are_asked_for_where_several_are_plausible(
    times: Float1D, unit: str
) -> None:
    table = make_table(times)
    with raises_input_error(problem=f"200 Hz in {unit}"):
        read_proposed(table)
    assert read_proposed(table, rate_hz=RATE_HZ).rate_hz == RATE_HZ
    stated = make_table(times, f"Time [{unit}]")
    assert read_proposed(stated).rate_hz == pytest.approx(RATE_HZ, rel=1e-6)


def test_a_count_of_samples_needs_a_rate_and_keeps_its_holes() -> None:
    keep = np.r_[0:300, 310:800]
    held = {
        "Time": make_column(np.arange(1.0, 801.0)[keep]),
        "Disp (mm)": make_column(U[keep], "mm"), "Force (N)": make_column(FORCE[keep], "N"),
    }  # fmt: skip
    table = ForeignTable(Path(__file__), "a table", held)
    with raises_input_error(problem="counts samples"):
        read_proposed(table)
    samples = read_proposed(table, rate_hz=RATE_HZ)
    assert (samples.rate_hz, samples.index.tolist()) == (RATE_HZ, keep.tolist())


@pytest.mark.parametrize("unit", ["s", "day"])
def test_a_rate_that_no_test_has_is_a_question(unit: str) -> None:
    times = 46110.0 + TIME / 86400.0 if unit == "s" else 1e5 * TIME
    columns = {
        "time_s": {"column": "Time", "unit": unit},
        "rel_disp_m": {"column": "Disp (mm)", "unit": "mm"},
    }
    with raises_input_error(problem="samples per second", allowed="0.1 Hz", remedy="unit"):
        read_samples(make_table(times), ColumnMap.model_validate({"columns": columns}))


def test_contradictions_about_the_rate_are_refused_with_both_values() -> None:
    timed = make_table(TIME, "Time (s)")
    with raises_input_error(key="rate_hz", value=250.0, problem="200 Hz"):
        read_proposed(timed, rate_hz=250.0)
    with raises_input_error(problem="states 250 Hz, but its column of times tells 200 Hz"):
        read_proposed(make_table(TIME, "Time (s)", rate_hz=250.0))
    with raises_input_error(key="rate_hz", value=500.0, problem="250 Hz"):
        read_proposed(make_table(None, rate_hz=250.0), rate_hz=500.0)
    assert read_proposed(make_table(None, rate_hz=250.0)).rate_hz == 250.0
    unused = {"rate_hz": 250.0, "columns": {"rel_disp_m": {"column": "Disp (mm)", "unit": "mm"}}}
    with raises_input_error(key="rate_hz", value=250.0, problem="'Time (s)' has 200 Hz"):
        read_samples(timed, ColumnMap.model_validate(unused))
    unused["rate_hz"] = 200.0
    assert read_samples(timed, ColumnMap.model_validate(unused)).rate_hz == 200.0


@pytest.mark.parametrize("pause_s", [3.0, 3.0017])
def test_a_pause_keeps_its_length_and_is_named(pause_s: float) -> None:
    paused = TIME + pause_s * (TIME >= 2.0)
    samples = read_proposed(make_table(paused, "Time (s)"))
    assert samples.rate_hz == RATE_HZ
    assert samples.index[[399, 400, -1]].tolist() == [399, 1000, 1399]
    assert any(f"a pause of {pause_s + 0.005:.9g} s" in note for note in samples.notes)


def with_starts(starts: tuple[float, float], rate_hz: float = RATE_HZ) -> ForeignTable:
    held = {
        "Disp": ForeignColumn(U.size, (1,), "mm", RATE_HZ, starts[0], values=U),
        "Force": ForeignColumn(U.size, (2,), "N", rate_hz, starts[1], values=FORCE),
    }
    return ForeignTable(Path(__file__), "a table", held)


def test_channels_that_start_at_different_times_are_aligned() -> None:
    samples = read_proposed(with_starts((0.0, 0.25)))
    assert samples.index.size == U.size - 50
    np.testing.assert_array_equal(samples.channels["rel_disp_m"], 1e-3 * U[50:])
    np.testing.assert_array_equal(samples.channels["damper_force_n"], FORCE[:-50])
    assert any("start at 0 to 0.25 s" in note for note in samples.notes)


@pytest.mark.parametrize(
    ("table", "words"),
    [
        (with_starts((0.0, 0.2525)), "0 s and 0.2525 s"),
        (with_starts((0.0, 30.0)), "no time in common"),
        (with_starts((0.0, 0.0), 400.0), "200 Hz, 400 Hz"),
    ],
)
def test_channels_that_share_no_clock_are_refused(table: ForeignTable, words: str) -> None:
    with raises_input_error(problem=words):
        read_proposed(table)


def write_stamps(path: Path, stamp: Callable[[int], str]) -> Path:
    rows = [f"{stamp(k)},{U[k]:.6g},{FORCE[k]:.6g}" for k in range(TIME.size)]
    path.write_text("\n".join(["Timestamp,Disp (mm),Force (N)", *rows]))
    return path


def _local(k: int, zone: bool) -> str:
    """Return a local time in Berlin about the hour that is skipped in spring."""
    time = datetime(2026, 3, 29, 0, 59, 58, tzinfo=UTC) + timedelta(seconds=k / RATE_HZ)
    hours = 1 if time < datetime(2026, 3, 29, 1, tzinfo=UTC) else 2
    local = time.astimezone(timezone(timedelta(hours=hours)))
    return local.isoformat() if zone else local.replace(tzinfo=None).isoformat(" ")


def _near_midnight(k: int) -> datetime:
    return datetime(2026, 3, 29, 23, 59, 58) + timedelta(seconds=k / RATE_HZ)


@pytest.mark.parametrize(
    "stamp",
    [
        lambda k: _near_midnight(k).isoformat(),
        lambda k: f"{_near_midnight(k):%H:%M:%S.%f}",
        lambda k: f"{_near_midnight(k):%d.%m.%Y %H:%M:%S.%f}",
        lambda k: f"{_near_midnight(k):%m/%d/%Y %I:%M:%S.%f %p}",
        lambda k: _local(k, zone=True),
    ],
)
def test_dates_and_times_of_day_are_read(tmp_path: Path, stamp: Callable[[int], str]) -> None:
    samples = read_proposed(read_table(write_stamps(tmp_path / "a.csv", stamp)))
    assert samples.rate_hz == RATE_HZ
    assert samples.index.tolist() == list(range(TIME.size))


def test_local_times_over_the_change_of_clocks_are_refused(tmp_path: Path) -> None:
    table = write_stamps(tmp_path / "a.csv", lambda k: _local(k, zone=False))
    (question,) = propose_import(table, ImportOptions()).questions
    assert "jumps by one hour" in question
    with raises_input_error(problem="jumps by one hour", remedy="UTC"):
        import_table(table, tmp_path / "a.mcap", ImportOptions(accept=True))


def test_tdms_start_times_of_channels_are_kept(tmp_path: Path) -> None:
    nptdms = pytest.importorskip("nptdms")

    def channel(name: str, values: Float1D, unit: str, start_s: float) -> Any:
        start = np.datetime64("2026-03-29T01:59:59") + np.timedelta64(round(1e6 * start_s), "us")
        properties = {"wf_increment": 1 / RATE_HZ, "unit_string": unit, "wf_start_time": start}
        return nptdms.ChannelObject("test", name, values, properties=properties)

    with nptdms.TdmsWriter(str(tmp_path / "a.tdms")) as file:
        file.write_segment([channel("Disp", U, "mm", 0.0), channel("Force", FORCE[40:], "N", 0.2)])
    samples = read_proposed(read_table(tmp_path / "a.tdms"))
    np.testing.assert_array_equal(samples.channels["rel_disp_m"], 1e-3 * U[40:])
    np.testing.assert_array_equal(samples.channels["damper_force_n"], FORCE[40:])
