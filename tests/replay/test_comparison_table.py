"""Several recordings and models in one go: one table, as JSON, as CSV and on the terminal."""

import csv
import errno
import json
import math
import os
from dataclasses import replace
from pathlib import Path

import pytest

from table_io.records import Comparison
from tests.input_errors import raises_input_error
from twin.recording.mcap_log import write_items
from twin.recording.reader import read_recording
from twin.replay.command import ReplayRequest, replay_logs
from twin.setup.run_config import RunConfig, read_run_config
from twin.setup.unpaced import play_unpaced
from twin.system.exit_codes import EXIT_NOT_IDENTICAL


@pytest.fixture(scope="module")
def logs(bundle: RunConfig, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Runs of a 4 mm gap and of free flight; beside them one that tells nothing of the table."""
    folder = tmp_path_factory.mktemp("table")
    made = []
    for name, gap in (("g4", "4.0"), ("ginf", "inf")):
        profile = bundle.profile_toml.replace("gap_mm = 4.0", f"gap_mm = {gap}")
        (folder / f"{name}.toml").write_text(profile)
        path = folder / name / "run.mcap"
        path.parent.mkdir()
        own = read_run_config(folder / f"{name}.toml")
        play_unpaced(own, name, path, lambda: None, lambda _: None)
        made.append(path.parent)
    still = replace(read_recording(path).start, channels=("mass_disp_m",))
    (folder / "still").mkdir()
    write_items(folder / "still" / "run.mcap", [still], still)
    (folder / "stiff.toml").write_text(bundle.model_toml.replace("36000.0", "37800.0"))
    return made


@pytest.fixture(scope="module")
def table(logs: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("compared") / "out"
    models = ["recorded", str(logs[0].parent / "stiff.toml")]
    assert replay_logs(ReplayRequest(logs, models, out)) == 0
    return out


def test_every_log_with_every_model_has_a_row_and_a_folder(table: Path) -> None:
    rows = json.loads((table / "comparison.json").read_text())["replays"]
    assert [(row["log"], Path(row["model"]).stem) for row in rows] == [
        ("g4", "recorded"), ("g4", "stiff"), ("ginf", "recorded"), ("ginf", "stiff"),
    ]  # fmt: skip
    assert [row["identical"] for row in rows] == [True, False, True, False]
    for row in rows:
        own = table / f"{row['log']}-{Path(row['model']).stem}"
        summary = json.loads((own / "summary.json").read_text())
        assert row["nrmse rel_disp_m"] == summary["comparison"]["rel_disp_m"]["nrmse"]
        assert (own / "run.mcap").is_file()
    # the stiffer model is worse in everything that there is
    for right, wrong in (rows[:2], rows[2:]):
        for name in ("nrmse rel_disp_m", "free_nrmse rel_disp_m", "prc eta_d", "prc eta_a"):
            assert wrong[name] > 2 * right[name] > 0
    assert rows[2]["nrmse force_r1_n"] is None  # no bumper, nothing to compare
    assert rows[0]["twin_jumps"] == rows[0]["jumps"]
    assert (rows[0]["steps"], rows[0]["steps_with_the_same_impacts"]) == (6, 6)


def test_the_error_of_a_curve_is_its_rms_over_the_curve(table: Path) -> None:
    row = json.loads((table / "comparison.json").read_text())["replays"][1]
    steps = json.loads((table / "g4-stiff" / "summary.json").read_text())["steps"]
    rig = [step["measured"]["eta_d"] for step in steps]
    twin = [step["twin"]["eta_d"] for step in steps]
    error = math.sqrt(sum((a - b) ** 2 for a, b in zip(rig, twin, strict=True)))
    assert row["prc eta_d"] == pytest.approx(error / math.hypot(*rig), rel=1e-12)


def test_the_csv_is_the_json(table: Path) -> None:
    rows = json.loads((table / "comparison.json").read_text())["replays"]
    with (table / "comparison.csv").open(newline="") as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == len(rows)
    for line, row in zip(lines, rows, strict=True):
        assert line["jumps"] == row["jumps"]
        for name in ("nrmse rel_disp_m", "prc eta_d"):
            assert float(line[name]) == row[name]


def test_differing_replay_of_several_has_its_exit_code(logs: list[Path], tmp_path: Path) -> None:
    recording = read_recording(logs[0] / "run.mcap")
    items = list(recording.items)
    last = recording.records(Comparison)[-1]
    sums = tuple(math.nextafter(value, 1e9) for value in last.free_error_ss)  # by one last place
    items[items.index(last)] = replace(last, free_error_ss=sums)
    write_items(tmp_path / "bent.mcap", items, recording.start)
    out = tmp_path / "out"
    asked = ReplayRequest([logs[1], tmp_path / "bent.mcap"], [], out)
    assert replay_logs(asked) == EXIT_NOT_IDENTICAL
    rows = json.loads((out / "comparison.json").read_text())["replays"]
    assert [row["identical"] for row in rows] == [True, False]


@pytest.mark.parametrize(
    "logs_of, models, steps, fields",
    [
        (["g4"], ["recorded", "nosuch"], None, {"where": "--model nosuch"}),
        (["g4", "nosuch"], ["recorded"], None, {"problem": os.strerror(errno.ENOENT)}),
        (["g4"], ["recorded", "stiff.toml", "stiff.toml"], None, {"problem": "g4-stiff"}),
        (["g4"], ["stiff.toml", "g4/stiff.toml"], None, {"problem": "g4-stiff"}),
        (["g4", "ginf"], ["recorded"], "6:9", {"where": "--steps 6:9", "allowed": "0 to 5"}),
        (["g4", "still"], ["recorded"], None, {"key": "table_acc_m_s2"}),
    ],
)
def test_impossible_replays_are_refused_before_the_first(
    logs: list[Path], tmp_path: Path, logs_of: list[str], models: list[str], steps: str | None,
    fields: dict[str, str],
) -> None:  # fmt: skip
    """Nothing is made, so that the corrected command is not refused."""
    home, out = logs[0].parent, tmp_path / "out"
    given = [str(home / model) if model.endswith(".toml") else model for model in models]
    with raises_input_error(**fields):
        replay_logs(ReplayRequest([home / item for item in logs_of], given, out, steps=steps))
    assert not out.exists()


@pytest.mark.parametrize(
    "more, where",
    [
        ({"view": True}, "--view"),
        ({"publish": "tcp/127.0.0.1:7563"}, "--publish"),
        ({"speed": "2"}, "--speed 2"),
    ],
)
def test_options_of_one_replay_are_refused_for_several(
    logs: list[Path], tmp_path: Path, more: dict[str, str], where: str
) -> None:
    with raises_input_error(where=where):
        replay_logs(ReplayRequest(logs, [], tmp_path / "out", **more))  # type: ignore[arg-type]
