"""What goes out to other tools comes back to the bit, with its gaps, its NaN and its labels."""

import sys
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rerun.chunk import RrdReader
from typer.testing import CliRunner

from table_io.config.base import PROFILES_DIR
from table_io.errors import InputError
from table_io.formats import read_table
from table_io.records import RunStop, StepAdded
from tests.exchange.exported import LABEL_FIELDS, LOST, export_formats, join_measured_blocks
from tests.input_errors import raises_input_error
from tests.reports.recordings import MEASURED, RATE, STEPS, blocks, start_record
from twin.cli.table import app
from twin.exchange.columns import read_samples
from twin.exchange.export import ExportOptions, export_log
from twin.exchange.import_table import read_labels
from twin.recording.mcap_log import write_items
from twin.recording.reader import read_recording
from twin.recording.tabular import LABEL_UNITS, TWIN_PREFIX, read_log_table

FORMATS = ("csv", "parquet", "mat")


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    return export_formats(tmp_path_factory.mktemp("export"), (*FORMATS, "rrd"))


@pytest.fixture(scope="module")
def log(both: tuple[Path, Path]) -> Path:
    return both[0]


@pytest.fixture(scope="module")
def out(both: tuple[Path, Path]) -> Path:
    """The log in every format, as out.csv and so on."""
    return both[1]


@pytest.mark.parametrize("kind", FORMATS)
def test_samples_and_labels_come_back_to_the_bit(log: Path, out: Path, kind: str) -> None:
    index, values, *labels = join_measured_blocks(read_recording(log))
    table = read_table(out.with_suffix(f".{kind}"))
    samples = read_samples(table, None)
    assert samples.rate_hz == RATE
    assert samples.index.tolist() == index.tolist()
    assert not set(range(*LOST)) & set(samples.index.tolist())
    assert set(samples.channels) == set(MEASURED)
    for name, row in zip(MEASURED, values, strict=True):
        assert samples.channels[name].tobytes() == row.tobytes(), name
    back = read_labels(table, samples)
    assert back.steps == STEPS
    for name, true in zip(LABEL_FIELDS, labels, strict=True):
        assert getattr(back, name)[index].tolist() == true.tolist()


@pytest.mark.parametrize("kind", FORMATS)
def test_the_twin_goes_out_beside_the_measurement(log: Path, out: Path, kind: str) -> None:
    table = read_table(out.with_suffix(f".{kind}"))
    index = join_measured_blocks(read_recording(log))[0]
    (predicted,) = read_recording(log).contiguous_blocks("pred")
    for name in ("free/rel_disp_m", "window/force_l2_n"):
        column = table.read_column(TWIN_PREFIX + name.replace("/", "_"))
        assert np.isnan(column[index < predicted.index]).all()
        spoken = predicted.channel(name)[index[index >= predicted.index] - predicted.index]
        assert column[index >= predicted.index].tobytes() == spoken.tobytes()


@pytest.mark.parametrize("kind", ["parquet", "mat"])
def test_profile_card_and_model_go_with_it(log: Path, out: Path, kind: str) -> None:
    start = read_recording(log).start
    assert read_table(out.with_suffix(f".{kind}")).texts == {
        "profile_toml": start.profile_toml,
        "rig_toml": start.rig_toml,
        "model_toml": start.model_toml,
    }


def test_parquet_says_the_unit_of_every_column(out: Path) -> None:
    columns = read_table(out.with_suffix(".parquet")).columns
    units = {name: held.unit for name, held in columns.items()}
    assert units["time_s"] == "s"
    assert units["mass_acc_m_s2"] == units["twin_window_mass_acc_m_s2"] == "m/s2"
    assert units["twin_free_rel_vel_m_s"] == "m/s"
    assert {name: units[name] for name in LABEL_UNITS} == LABEL_UNITS


def test_other_libraries_read_the_files(out: Path) -> None:
    pandas = np.genfromtxt(out.with_suffix(".csv"), delimiter=",", names=True)
    scipy_io = pytest.importorskip("scipy.io")
    mat = scipy_io.loadmat(out.with_suffix(".mat"))
    assert mat["mass_disp_m"].shape == (pandas.size, 1)
    assert mat["mass_disp_m"].tobytes() == pandas["mass_disp_m"].tobytes()
    assert mat["units"]["mass_disp_m"][0, 0].item() == "m"
    parquet = pytest.importorskip("pyarrow.parquet").read_table(out.with_suffix(".parquet"))
    assert parquet["step"].to_pylist() == mat["step"].reshape(-1).tolist()


def rows_by_entity(rrd: Path) -> dict[str, int]:
    """How often each entity changes, by Rerun's own reader."""
    rows: dict[str, int] = {}
    for chunk in RrdReader(rrd).stream():
        if not chunk.is_static:
            name = str(chunk.entity_path)
            rows[name] = rows.get(name, 0) + chunk.num_rows
    return rows


def test_rerun_reads_its_file(log: Path, out: Path, tmp_path: Path) -> None:
    """In whatever order its parts were written."""
    rows = rows_by_entity(out.with_suffix(".rrd"))
    assert (
        sum(count >= join_measured_blocks(read_recording(log))[0].size for count in rows.values())
        >= 3
    )
    start = read_recording(log).start
    changing = [c for c in RrdReader(out.with_suffix(".rrd")).stream() if not c.is_static]
    for batch in (chunk.to_record_batch() for chunk in changing):
        time, date = (np.array(batch.column(name).cast("int64")) for name in ("time", "date"))
        assert set(date - time) == {
            round(1e9 * datetime.fromisoformat(start.started_at).timestamp())
        }
    write_items(tmp_path / "run.mcap", [*read_recording(log).items], start)
    export_log(ExportOptions(tmp_path, ("rrd",)))
    assert rows_by_entity(tmp_path / "run.rrd") == rows


def test_a_choice_of_channels_and_steps(log: Path, tmp_path: Path) -> None:
    export_log(
        ExportOptions(log, ("csv",), tmp_path / "a.csv", channels=("mass_disp_m",), steps=(2, 3))
    )
    table = read_table(tmp_path / "a.csv")
    assert set(table.columns) == {"time_s", "mass_disp_m", *LABEL_UNITS, "unix_time_s"}
    started_s = datetime.fromisoformat(read_recording(log).start.started_at).timestamp()
    absolute = table.read_column("unix_time_s") - table.read_column("time_s")
    assert np.abs(absolute - started_s).max() < 1e-6
    assert set(table.read_column("step")) == {2, 3}
    samples = read_samples(table, None)
    back = read_labels(table, samples)
    assert [step.frequency_hz for step in back.steps] == [2.0, 2.5]
    assert any("numbered from 0" in text for text in back.messages)


def test_steps_that_were_decided_on_in_the_test_are_known(tmp_path: Path) -> None:
    start = replace(start_record(), steps=STEPS[:-1])
    extra = StepAdded(0, 7, "backward", 1.0, 0.49, "tracked")
    write_items(tmp_path / "run.mcap", [start, extra, *blocks()], start)
    table_steps = read_log_table(tmp_path / "run.mcap").steps
    assert table_steps[7] == STEPS[-1]


@pytest.mark.parametrize(
    ("kinds", "channels", "steps", "words"),
    [
        ([], (), None, ["--csv", "--rrd"]),
        (["csv"], ("mass_dsp_m",), None, ["mass_dsp_m", "mass_disp_m"]),
        (["csv"], (), (90, 91), ["no sample in steps 90 to 91"]),
        (["rrd"], ("mass_disp_m",), None, ["--rrd"]),
        (["csv", "rrd"], (), (1, 2), ["--rrd"]),
    ],
)
def test_invalid_export_options_are_refused_without_a_file(
    log: Path, tmp_path: Path, kinds: list[str], channels: Any, steps: Any, words: list[str]
) -> None:
    with pytest.raises(InputError) as caught:
        export_log(
            ExportOptions(log, tuple(kinds), tmp_path / "new" / "x", channels=channels, steps=steps)
        )
    for word in words:
        assert word in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_nothing_is_overwritten_and_no_half_file_left(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "x.csv").write_text("mine")
    with raises_input_error(where=tmp_path / "x.csv"):
        export_log(ExportOptions(log, ("csv",), tmp_path / "x"))
    assert (tmp_path / "x.csv").read_text() == "mine"
    with raises_input_error(where=tmp_path / "none.mcap"):
        export_log(ExportOptions(tmp_path / "none.mcap", ("csv",)))
    with raises_input_error(where=tmp_path / "x.csv", remedy="run.mcap"):
        export_log(ExportOptions(tmp_path / "x.csv", ("mat",)))

    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("table_io.formats.mat.savemat", full)
    with pytest.raises(OSError, match="No space"):
        export_log(ExportOptions(log, ("mat",), tmp_path / "y"))
    assert not (tmp_path / "y.mat").exists()


def test_a_library_that_is_missing_is_said_before_anything_is_written(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    monkeypatch.delitem(sys.modules, "table_io.formats.parquet", raising=False)
    with raises_input_error(where="--parquet", problem="pyarrow", remedy="pip install"):
        export_log(ExportOptions(log, ("csv", "parquet"), tmp_path / "new" / "x"))
    assert not list(tmp_path.iterdir())


def test_what_a_call_wrote_goes_with_what_it_could_not_write(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And nothing else does: not a file that came to stand there meanwhile."""
    existing = tmp_path / "x.foxglove.layout.json"

    def slow(*_: Any) -> None:
        existing.write_text("mine")

    monkeypatch.setattr("twin.exchange.export.write_foxglove", slow)
    with raises_input_error(where=existing):
        export_log(
            ExportOptions(log, ("csv", "foxglove"), tmp_path / "x", channels=("mass_disp_m",))
        )
    assert [*tmp_path.iterdir()] == [existing]
    assert existing.read_text() == "mine"

    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("table_io.formats.mat.savemat", full)
    with pytest.raises(OSError, match="No space"):
        export_log(
            ExportOptions(
                log, ("csv", "mat"), tmp_path / "a" / "b" / "y", channels=("mass_disp_m",)
            )
        )
    assert [*tmp_path.iterdir()] == [existing]


def test_export_log_tells_of_a_log_without_its_end(tmp_path: Path) -> None:
    start = start_record()
    cut = [item for item in blocks()[:4] if not isinstance(item, RunStop)]
    write_items(tmp_path / "run.mcap", [start, *cut], start)
    assert not export_log(ExportOptions(tmp_path, ("csv",))).is_intact
    values = read_table(tmp_path / "run.csv").columns["time_s"].values
    assert values is not None
    assert len(values) == 2500


def test_labels_that_contradict_themselves_name_the_row(out: Path, tmp_path: Path) -> None:
    lines = out.with_suffix(".csv").read_text().splitlines()
    names = lines[0].split(",")

    def require_refused(row: int, column: str, cell: str, *words: str) -> None:
        cells = lines[row - 1].split(",")
        cells[names.index(column)] = cell
        path = tmp_path / "wrong.csv"
        path.write_text("\n".join([*lines[: row - 1], ",".join(cells), *lines[row:]]))
        table = read_table(path)
        with pytest.raises(InputError) as caught:
            read_labels(table, read_samples(table, None))
        for word in (f"row {row}", *words):
            assert word in str(caught.value)

    require_refused(9, "label", "7", "label is 7", "0 to 5")
    require_refused(9, "cycle", "0.5", "cycle is 0.5", "whole numbers")
    require_refused(9, "step", "nan", "step is nan")
    require_refused(9, "frequency_hz", "3.0", "frequency_hz is 3", "step 0")
    require_refused(2, "direction", "0", "step 0 lacks direction")


def test_a_name_with_an_ending_is_the_name_of_all(log: Path, tmp_path: Path) -> None:
    export_log(
        ExportOptions(log, ("csv", "mat"), tmp_path / "new" / "a.csv", channels=("mass_disp_m",))
    )
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == ["a.csv", "a.mat"]


def test_the_commands(log: Path, tmp_path: Path) -> None:
    run = CliRunner()
    new = tmp_path / "a.csv"
    asked = ["export", str(log), "--csv", "--steps", "1:2", "--channel", "mass_disp_m"]
    result = run.invoke(app, [*asked, "-o", str(new)])
    assert result.exit_code == 0, result.output
    assert "rows of 8 columns" in result.output
    assert isinstance(run.invoke(app, [*asked[:-3], "x"]).exception, InputError)
    result = run.invoke(app, ["import", str(new), "--list"])
    assert "mass_disp_m: " in result.output
    proposed = run.invoke(app, ["import", str(new)])
    assert proposed.exit_code == 0
    assert "--accept" in proposed.output
    unnamed = run.invoke(app, ["import", str(new), "--columns", str(tmp_path / "map.toml")])
    assert isinstance(unnamed.exception, InputError)
    both = run.invoke(app, ["import", str(new), "--list", "-o", str(tmp_path / "b.mcap")])
    assert "omit -o or --list" in str(both.exception)
    assert run.invoke(app, ["import", str(new), "-o", str(tmp_path / "a.mcap")]).exit_code == 4
    assert (
        len(read_recording(tmp_path / "a.mcap").start.steps) == 2
    )  # and lost samples, hence the 4


def test_incomplete_rerun_file_is_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    start = replace(start_record(), profile_toml=(PROFILES_DIR / "tests/g4_ss3.toml").read_text())
    write_items(tmp_path / "run.mcap", [start, *blocks()], start)

    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("twin.viewer.view.RerunView.feed", full)
    with pytest.raises(OSError, match="No space"):
        export_log(ExportOptions(tmp_path, ("rrd",)))
    assert not (tmp_path / "run.rrd").exists()
