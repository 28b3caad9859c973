"""The map that is proposed for a foreign table: channels, units, rate, mass, and open questions."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from table_io.block import Float1D, Label
from table_io.errors import InputError
from table_io.formats.table import ForeignTable, make_column
from tests.input_errors import raises_input_error
from twin.cli.table import app
from twin.exchange.import_table import ImportOptions, import_table
from twin.exchange.proposal import MapProposal, propose_map
from twin.recording.reader import read_recording
from twin.results.recordings import read_recorded_config

TIME = np.arange(2000) / 200.0
U = np.sin(2 * np.pi * 2.0 * TIME)
ACC = -((4 * np.pi) ** 2) * U


def propose(
    columns: dict[str, Float1D], units: dict[str, str] | None = None, **facts: float
) -> MapProposal:
    held = {
        name: make_column(values, (units or {}).get(name, "")) for name, values in columns.items()
    }
    return propose_map(ForeignTable(Path("table.csv"), "a table", held, facts=facts))


def sources(proposal: MapProposal) -> dict[str, tuple[str, str]]:
    return {item.channel: (item.column, item.unit) for item in proposal.columns}


@pytest.mark.parametrize(
    ("columns", "expected"),
    [
        (
            {"t [ms]": 1e3 * TIME, "Table disp (mm)": U, "Mass disp (mm)": U},
            {"time_s": "ms", "table_disp_m": "mm", "mass_disp_m": "mm"},
        ),
        (
            {"Time (s)": TIME, "acc_base_g": ACC, "acc_top_g": ACC, "LVDT rel (cm)": U},
            {"time_s": "s", "table_acc_m_s2": "g", "mass_acc_m_s2": "g", "rel_disp_m": "cm"},
        ),
        (
            {"time": TIME, "stroke (in)": U, "load (kip)": U},
            {"time_s": "s", "rel_disp_m": "in", "damper_force_n": "kip"},
        ),
        (
            {"t": TIME, "Accel_X base (m/s^2)": ACC, "cell right 1 [kN]": U, "cell R2 [kN]": U,
             "cell left (lb)": U},
            {"time_s": "s", "table_acc_m_s2": "m/s2", "force_r1_n": "kN", "force_r2_n": "kN",
             "force_l1_n": "lbf"},
        ),
        (
            {"t": TIME, "Spostamento tavola (mm)": U, "Command (mm)": U},
            {"time_s": "s", "table_disp_m": "mm", "drive_disp_m": "mm"},
        ),
    ],
)  # fmt: skip
def test_propose_map_by_names_and_units(
    columns: dict[str, Float1D], expected: dict[str, str]
) -> None:
    proposal = propose(columns)
    assert proposal.questions == ()
    assert {channel: unit for channel, (_, unit) in sources(proposal).items()} == expected
    for channel, (column, _) in sources(proposal).items():
        assert [*columns].index(column) == [*expected].index(channel)


def test_propose_map_by_units_of_the_file() -> None:
    proposal = propose({"t": TIME, "x": U, "F": U}, {"t": "sec", "x": "millimetre", "F": "kips"})
    assert sources(proposal)["rel_disp_m"] == ("x", "mm")
    assert sources(proposal)["damper_force_n"] == ("F", "kip")


@pytest.mark.parametrize(
    ("columns", "column"),
    [
        ({"t": TIME, "disp": 30 * U, "load (N)": U}, "disp"),  # mm, or cm, or in
        ({"t": TIME, "stroke (mm)": U, "load": U}, "load"),
        ({"t": TIME, "laser 1 (mm)": U, "laser 2 (mm)": U}, "laser 1 (mm)"),
        ({"t": TIME, "acc 1 (g)": U, "acc 2 (g)": U}, "acc 2 (g)"),
        ({"t": TIME, "laser rel (V)": U}, "laser rel (V)"),
        ({"t": TIME, "acc base (g)": ACC, "acc table (g)": ACC}, "acc table (g)"),
    ],
)
def test_propose_map_asks_what_is_open(columns: dict[str, Float1D], column: str) -> None:
    proposal = propose(columns)
    assert any(repr(column) in question for question in proposal.questions)


def test_propose_map_by_a_range_that_fits_one_unit() -> None:
    proposal = propose({"t": TIME, "stroke": 300.0 * U, "load (N)": U})
    item = {item.channel: item for item in proposal.columns}["rel_disp_m"]
    assert item.unit == "mm"
    assert "600" in item.reason


def test_propose_map_by_the_other_sensor_of_the_motion() -> None:
    columns = {"t": TIME, "table disp": 4.0 * U, "acc table (g)": 4e-3 * ACC / 9.80665}
    assert sources(propose(columns))["table_disp_m"] == ("table disp", "mm")


def test_propose_map_takes_rate_and_mass_of_the_file_or_asks() -> None:
    stated = propose({"stroke (mm)": U, "load (N)": U}, rate_hz=200.0, mass_kg=3.0)
    assert (stated.rate_hz, stated.mass_kg, stated.questions) == (200.0, 3.0, ())
    unstated = propose({"stroke (mm)": U, "load (N)": U})
    assert any("--rate" in question for question in unstated.questions)
    held = {name: make_column(U, "m/s2") for name in ("Acc 1", "Acc 2")}
    columns = {name: replace(column, rate_hz=200.0) for name, column in held.items()}
    open_bodies = propose_map(ForeignTable(Path("two.uff"), "a UFF file", columns))
    assert open_bodies.file_rate_hz == 200.0
    assert not any("--rate" in question for question in open_bodies.questions)
    milli = propose({"time": 1e3 * TIME, "stroke (mm)": U, "load (N)": U}, rate_hz=200.0)
    assert sources(milli)["time_s"] == ("time", "ms")


def test_propose_map_lists_what_is_missing() -> None:
    component = propose({"t": TIME, "stroke (mm)": U, "load (N)": U})
    assert component.missing == ()
    accelerations = propose({"t": TIME, "acc base (g)": ACC, "acc top (g)": ACC})
    assert any("--integrate" in text for text in accelerations.missing)
    assert any("--mass" in text for text in accelerations.missing)


def test_propose_map_names_what_is_left_out_and_why() -> None:
    held = {name: make_column(values) for name, values in (("t", TIME), ("stroke (mm)", U))}
    held["load (N)"] = make_column(U[:-10])
    table = ForeignTable(Path("a.csv"), "a table", held, {"state": "text, such as 'OK'"})
    expected = ("load (N) (1990 rows, the others 2000)", "state (text, such as 'OK')")
    assert propose_map(table).dropped == expected
    assert any("'load (N)' has 1990 rows" in text for text in propose_map(table).questions)
    rated = {name: replace(column, rate_hz=200.0) for name, column in held.items() if name != "t"}
    assert [item.channel for item in propose_map(replace(table, columns=rated)).columns] == [
        "damper_force_n", "rel_disp_m",
    ]  # fmt: skip


def test_import_table_refuses_open_units_of_a_saved_map(tmp_path: Path) -> None:
    table = tmp_path / "damper.csv"
    np.savetxt(
        table, np.array([TIME, 30 * U, U]).T, delimiter=",", header="time,stroke,load", comments=""
    )
    card = tmp_path / "map.toml"
    with pytest.raises(SystemExit):
        app(["import", str(table), "--save-map", str(card)])
    column_map = ImportOptions(columns=card).read_map()
    assert column_map is not None
    assert {*column_map.columns} == {"time_s", "rel_disp_m", "damper_force_n"}
    with raises_input_error(key="columns", allowed="kip"):
        import_table(table, tmp_path / "a.mcap", ImportOptions(columns=card))
    with raises_input_error(where=table, problem="stroke", remedy="--save-map"):
        import_table(table, tmp_path / "a.mcap", ImportOptions(accept=True))
    assert not (tmp_path / "a.mcap").exists()


def write_component(path: Path, rate_hz: float = 200.0, offset: float = 0.0) -> Path:
    time = np.arange(round(20 * rate_hz)) / rate_hz
    u = 10.0 * np.sin(2 * np.pi * 0.4 * time) * (time > 3) * (time < 17) + offset
    table = np.array([time, u, 36.0 * u])
    np.savetxt(path, table.T, delimiter="\t", header="t (s)\tstroke (mm)\tload (N)", comments="")
    return path


@pytest.mark.parametrize("rate_hz", [10.0, 13.1, 26.2, 5000.0])
def test_import_table_at_any_rate_without_a_profile(tmp_path: Path, rate_hz: float) -> None:
    file, log = write_component(tmp_path / "slow.txt", rate_hz), tmp_path / "slow.mcap"
    assert import_table(file, log, ImportOptions(accept=True)).gaps == 0
    assert read_recording(log).start.rate_hz == pytest.approx(rate_hz, rel=1e-4)


def test_import_table_applies_settings(tmp_path: Path) -> None:
    file, log = write_component(tmp_path / "a.txt", offset=5.0), tmp_path / "a.mcap"
    settings = {"mass_kg": 250.0, "from_s": 1.0, "to_s": 19.0, "rest": False, "detrend": "mean"}
    import_table(file, log, ImportOptions(accept=True, settings=settings))
    recording = read_recording(log)
    (block,) = recording.contiguous_blocks("meas")
    assert len(block) == 3601
    assert 0 not in set(block.label)  # nowhere at rest
    assert block.channel("rel_disp_m").mean() == pytest.approx(0.0, abs=1e-12)
    assert read_recorded_config(recording).profile.specimen.mass_kg == 250.0


def test_import_table_warns_of_rest_off_zero(tmp_path: Path) -> None:
    """A component that is held off its zero is not at rest, unless the user says so."""
    for offset, settings, is_rest, warned in (
        (0.0, {}, True, False), (5.0, {}, False, True), (5.0, {"rest": True}, True, False),
    ):  # fmt: skip
        name = f"{offset}{len(settings)}"
        file = write_component(tmp_path / f"{name}.txt", offset=offset)
        log = tmp_path / f"{name}.mcap"
        notes = import_table(file, log, ImportOptions(accept=True, settings=settings)).notes
        (block,) = read_recording(log).contiguous_blocks("meas")
        assert bool(block.label[0] == Label.REST) is is_rest
        assert any(note.startswith("warning: rel_disp_m") for note in notes) is warned


def test_import_command_of_several_files(tmp_path: Path) -> None:
    files = [str(write_component(tmp_path / f"run{k}.txt")) for k in (1, 2)]
    with pytest.raises(SystemExit) as ended:
        app(["import", *files, "-o", str(tmp_path / "logs"), "--accept"])
    assert not ended.value.code
    assert [path.name for path in sorted((tmp_path / "logs").iterdir())] == [
        "run1.mcap", "run2.mcap",
    ]  # fmt: skip
    with raises_input_error(allowed="folder"):
        app(["import", *files, "-o", str(tmp_path / "one.mcap"), "--accept"], standalone_mode=False)


def test_import_table_of_a_workbook(tmp_path: Path) -> None:
    openpyxl = pytest.importorskip("openpyxl")
    workbook = openpyxl.Workbook()
    sheet = workbook.active
    sheet.title = "run 1"
    sheet.append(["Damper test, mass 1.2 t"])
    sheet.append(["time", "stroke", "load"])
    sheet.append(["s", "mm", "kN"])
    for row in zip(TIME[:400].tolist(), U.tolist(), (36 * U).tolist(), strict=False):
        sheet.append(row)
    sheet.cell(10, 3).value = None
    workbook.create_sheet("remarks").append(["nothing", "to", "see"])
    file, log = tmp_path / "book.xlsx", tmp_path / "book.mcap"
    workbook.save(file)
    import_table(file, log, ImportOptions(accept=True))
    recording = read_recording(log)
    (block,) = recording.contiguous_blocks("meas")
    np.testing.assert_allclose(block.channel("rel_disp_m"), 1e-3 * U[:400])
    assert np.flatnonzero(np.isnan(block.channel("damper_force_n"))).tolist() == [6]
    assert read_recorded_config(recording).profile.specimen.mass_kg == 1200.0
    sheet.cell(20, 2).value = "broken"
    workbook.save(file)
    with pytest.raises(InputError) as caught:
        import_table(file, tmp_path / "b.mcap", ImportOptions(accept=True))
    assert "row 20" in str(caught.value)
    file.write_bytes(file.read_bytes()[:2000])
    with raises_input_error(where=file):
        import_table(file, tmp_path / "c.mcap", ImportOptions(accept=True))


def test_import_table_without_steps_plans_none(tmp_path: Path) -> None:
    noise = np.cumsum(np.random.default_rng(0).normal(size=TIME.size)) * 1e-2
    file, log = tmp_path / "noise.csv", tmp_path / "noise.mcap"
    table = np.array([TIME, noise, 36 * noise])
    np.savetxt(file, table.T, delimiter=",", header="t (s),stroke (mm),load (N)", comments="")
    import_table(file, log, ImportOptions(accept=True))
    assert read_recording(log).start.steps == ()
