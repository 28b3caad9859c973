"""A laboratory's own channels, from one rig file through run, replay, exports and displays."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from table_io.config.base import parse_toml
from table_io.config.rig import RigConfig
from table_io.formats import read_table
from table_io.records import Comparison
from tests.builders.blocks import select_blocks
from tests.builders.profiles import AT_1_KHZ, format_test
from tests.builders.rigs import EXTRA, LAB_TEXT, SECOND_ACC, TEMPERATURE, UPWARD_ACC
from tests.input_errors import raises_input_error
from tests.viewer.example_run import scalars
from twin.cli.table import app
from twin.compare import COMPARED_CHANNELS
from twin.exchange.import_table import ImportOptions, import_table
from twin.log import open_log
from twin.monitor.panels import draw_limits, draw_twin, format_gaps
from twin.monitor.run_state import LiveRunState, update_run_state
from twin.monitor.run_view import RunView, SessionStatus
from twin.recording.reader import read_recording
from twin.results.sensor_table import build_sensor_rows
from twin.rig.predicted_ranges import predict_response
from twin.setup.run_config import read_run_config
from twin.transport.codec import Item

PROFILE = format_test(
    2.0,
    3.0,
    0.5,
    rig="lab",
    directions=["forward"],
    tables=AT_1_KHZ | {"protection": {"sensor": "warn"}},
)


def shaketwin(*arguments: str | Path, code: int = 0) -> str:
    """The output of the command, which ends with this code."""
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == code, result.output
    return result.output


def laboratory(folder: Path, rig_text: str = LAB_TEXT) -> Path:
    """A folder with the rig file and a test; the path of the test."""
    for name, text in (("rigs/lab.toml", rig_text), ("tests/short.toml", PROFILE)):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text)
    return folder / "tests" / "short.toml"


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("lab")


@pytest.fixture(scope="module")
def run(lab: Path) -> Path:
    """The folder of a run."""
    shaketwin("run", laboratory(lab), "--out", lab / "run", "--speed", "max")
    return lab / "run"


@pytest.fixture(scope="module")
def summary(run: Path) -> dict[str, Any]:
    return dict(json.loads((run / "summary.json").read_text()))


def test_declared_channels_are_recorded(run: Path) -> None:
    assert json.loads(shaketwin("verify", run, "--json"))["sound"] is True
    log = open_log(run)
    assert log.channels[-4:] == (*EXTRA, "rel_disp_m")
    assert log.units[SECOND_ACC] == "m/s2"
    assert log.units[TEMPERATURE] == "degC"
    noise = log[SECOND_ACC] + log["mass_acc_m_s2"]
    assert noise.std() == pytest.approx(np.sqrt(2) * 0.0005 * 9.80665, rel=0.05)
    assert log[TEMPERATURE].mean() == pytest.approx(21.5, abs=0.01)
    assert log.start.tare[TEMPERATURE] == 50.0
    attributes = log.to_xarray()[TEMPERATURE].attrs
    assert attributes == {"units": "degC", "positive": "", "meaning": "Air at the specimen."}


def test_the_summary_compares_what_the_model_predicts(summary: dict[str, Any]) -> None:
    comparison = summary["comparison"]
    assert [*comparison] == [*COMPARED_CHANNELS, SECOND_ACC]
    assert comparison[SECOND_ACC]["nrmse"] < 0.05
    for key in ("nrmse", "free_nrmse"):
        expected = comparison["mass_acc_m_s2"][key]
        assert comparison[SECOND_ACC][key] == pytest.approx(expected, rel=0.1)


def test_a_replay_is_identical_to_the_bit(run: Path, lab: Path) -> None:
    shaketwin("replay", run, "--speed", "max", "--out", lab / "replay")
    replayed = json.loads((lab / "replay" / "summary.json").read_text())
    recorded = json.loads((run / "summary.json").read_text())
    assert replayed["replay"]["identical"] is True
    assert replayed["replay"]["compared"] > 100
    assert replayed["replay"]["recorded_comparison"] == recorded["comparison"]
    assert replayed["comparison"] == recorded["comparison"]


def test_replay_reports_differences_of_a_declared_channel(run: Path, lab: Path) -> None:
    model = (Path(__file__).parents[2] / "profiles/models/snm.toml").read_text()
    (lab / "stiff.toml").write_text(model.replace("36000.0", "40000.0"))
    replay = ("replay", run, "--model", lab / "stiff.toml", "--speed", "max")
    shaketwin(*replay, "--out", lab / "stiff")
    changed = json.loads((lab / "stiff" / "summary.json").read_text())["replay"]
    assert changed["largest_difference_of_error_sums"][SECOND_ACC] > 0.0


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_export_of_declared_channels_is_imported_again(run: Path, lab: Path, kind: str) -> None:
    shaketwin("export", run, f"--{kind}", "-o", lab / "out")
    table = read_table(lab / f"out.{kind}")
    log = open_log(run)
    for name in EXTRA:
        np.testing.assert_array_equal(table.read_column(name), log[name])
    back = lab / f"{kind}.mcap"
    test = ("--profile", lab / "tests/short.toml")
    if kind == "csv":
        with raises_input_error(problem=SECOND_ACC):
            import_table(lab / "out.csv", back, ImportOptions(profile=test[1], rig="simulated"))
        shaketwin("import", lab / "out.csv", "-o", back, *test)
    else:  # carries units and the rig file
        units = [table.columns[name].unit for name in EXTRA]
        assert units == ["m/s2", "degC", "m/s2"]
        shaketwin("import", lab / "out.parquet", "-o", back)
    assert set(open_log(back).channels) == set(log.channels)
    for name in log.channels:
        np.testing.assert_array_equal(open_log(back)[name], log[name])


def test_import_maps_columns_to_declared_channels_in_their_units(lab: Path) -> None:
    laboratory(lab)
    t = np.arange(2000) / 1000.0
    rows = np.stack([t, np.sin(t), 20.0 + t, 9.0 * np.cos(t)], axis=1)
    np.savetxt(lab / "x.csv", rows, delimiter=",", header="t,laser,pt100,acc", comments="")
    (lab / "map.toml").write_text(
        f"""
[columns]
time_s = {{ column = "t", unit = "s" }}
table_disp_m = {{ column = "laser", unit = "mm" }}
{TEMPERATURE} = {{ column = "pt100", unit = "degC" }}
{SECOND_ACC} = {{ column = "acc", unit = "g" }}
"""
    )
    files = (lab / "x.csv", "-o", lab / "x.mcap", "--columns", lab / "map.toml")
    shaketwin("import", *files, "--rig", lab / "rigs/lab.toml")
    log = open_log(lab / "x.mcap")
    np.testing.assert_allclose(log[TEMPERATURE], 20.0 + t)
    np.testing.assert_allclose(log[SECOND_ACC], 9.80665 * 9.0 * np.cos(t))


def test_foxglove_and_rerun_show_declared_channels(run: Path, lab: Path) -> None:
    shaketwin("export", run, "--foxglove", "--rrd", "-o", lab / "shown")
    assert f"{TEMPERATURE}".encode() in (lab / "shown.foxglove.mcap").read_bytes()
    log = open_log(run)
    for name in EXTRA:
        values = scalars(lab / "shown.rrd", f"/other/{name}")[1]
        np.testing.assert_array_equal(values[:, 0], log[name][::2])  # lines of 500 Hz


def test_report_lists_sensors_of_declared_channels(run: Path) -> None:
    rows = {row.channel: row for row in build_sensor_rows(read_recording(run / "run.mcap").start)}
    assert rows[SECOND_ACC].serial == "A-17"
    assert rows[SECOND_ACC].tare == pytest.approx(0.002, abs=1e-4)
    assert (rows[TEMPERATURE].sensitivity, rows[TEMPERATURE].tare) == ("0.05 V/degC", 50.0)
    page = (run / "report.html").read_text()
    assert all(f"<code>{name}</code>" in page for name in EXTRA)


def test_check_predicts_peaks_of_declared_channels(lab: Path) -> None:
    predicted = predict_response(read_run_config(laboratory(lab))).peaks
    peaks = {peak.sensor.channel: peak.peak for peak in predicted}
    assert peaks[SECOND_ACC] == peaks["mass_acc_m_s2"]
    assert {TEMPERATURE, UPWARD_ACC}.isdisjoint(peaks)


def test_monitor_lists_declared_channels(run: Path) -> None:
    recording = read_recording(run / "run.mcap")
    state = LiveRunState()
    comparisons = [item for item in recording.items if isinstance(item, Comparison)]
    items: list[Item] = [recording.start, *select_blocks(recording.items, "meas"), *comparisons]
    for item in items:
        assert item.index >= 0
        state = update_run_state(state, recording.run, item)
    view = RunView(state, SessionStatus())
    limits = [line.plain for line in draw_limits(view, 80, 40)]
    assert any(line.startswith("mass acc 2") and " g " in line for line in limits)
    assert any(line.startswith("air temp") and "degC" in line for line in limits)
    twin = [line.plain for line in draw_twin(view, 80, 40)]
    assert any(line.startswith("mass acc 2") and "m/s²" in line for line in twin)
    assert format_gaps(view).plain == "0 dropouts"


@pytest.mark.parametrize(
    ("kind", "channel", "gap"), [("rail", SECOND_ACC, "clipped"), ("nan", TEMPERATURE, "lost")]
)
def test_fault_of_a_declared_channel_is_recorded(
    tmp_path: Path, kind: str, channel: str, gap: str
) -> None:
    fault = f'\n[[simulated.faults]]\nkind = "{kind}"\nat_s = 12.0\nchannel = "{channel}"\n'
    text = LAB_TEXT.replace("\n[[channels]]", f"{fault}\n[[channels]]", 1)
    assert parse_toml(text, RigConfig, "lab").is_simulated
    path = laboratory(tmp_path, text)
    path.write_text(PROFILE.replace('"warn"', '"stop"'))
    shaketwin("run", path, "--out", tmp_path / "run", "--speed", "max", code=3)
    (trip,) = json.loads((tmp_path / "run" / "summary.json").read_text())["trips"]
    assert trip["channel"] == channel
    assert trip["kind"] == ("rail" if kind == "rail" else "lost")
    assert trip["index"] == pytest.approx(12_000, abs=30)
    gaps = open_log(tmp_path / "run").gaps
    assert {(entry.channel, entry.reason) for entry in gaps} == {(channel, gap)}
