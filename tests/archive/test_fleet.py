"""A fleet: one command over many logs, resumable, into one table."""

import csv
import json
import os
import random
import signal
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.archive.test_catalog import write_run
from tests.command_line import call_main
from tests.input_errors import raises_input_error
from twin.archive import fleet as fleets
from twin.archive.fleet import FleetLine, FleetOptions, compute_case, run_fleet
from twin.archive.notes import note_run
from twin.model.config import load_model_config
from twin.results.sealed_lines import SealedLines
from twin.system.grid import Watch
from twin.system.process_pool import TaskResult, Workers

LOGS_TO_KILL = 150
TRUE_STIFFNESS = 36e3  # of the simulated specimen, N/m
Stop = Callable[[], object]


def run_here(
    task: Callable[[int], Any], numbers: Iterable[int], workers: Workers, stop: Stop, **_: object
) -> Iterator[TaskResult]:
    """Run the tasks in this process, as `run_tasks` does in others."""
    for number in numbers:
        if stop():
            return
        yield TaskResult(number, task(number))


class StopAfter(Watch):
    """Watch that stops a fleet after some logs."""

    def __init__(self, count: int) -> None:
        self._left = count + 1

    def find_stop(self) -> str | None:
        self._left -= 1
        return None if self._left > 0 else "enough"


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fleets, "run_tasks", run_here)


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    """Four runs without samples, of which one is damaged."""
    for number in range(4):
        folder = tmp_path / "archive" / f"run{number}"
        folder.mkdir(parents=True)
        write_run(folder, number)
    (tmp_path / "archive/run2/run.mcap").write_bytes(b"no recording")
    return tmp_path / "archive"


def repair_run(folder: Path) -> None:
    (folder / "run.mcap").unlink()
    write_run(folder, 2)


def read_table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


@pytest.mark.usefixtures("here")
def test_fleet_writes_one_table_with_the_failures(archive: Path, tmp_path: Path) -> None:
    fleet = run_fleet(FleetOptions("verify", [archive], out=tmp_path / "out"))
    assert fleet.is_complete
    rows = read_table(tmp_path / "out/table.csv")
    assert [Path(row["log"]).parent.name for row in rows] == ["run0", "run1", "run2", "run3"]
    (failed,) = fleet.failures
    assert Path(failed.log).parent.name == "run2"
    assert [bool(row["failure"]) for row in rows] == [False, False, True, False]
    assert {row["content"] for row in rows if not row["failure"]} == {"same"}
    page = (tmp_path / "out/report.html").read_text()
    assert "verify over 4 recordings" in page
    assert page.count(f"<code>{failed.log}</code>") == 1


@pytest.mark.usefixtures("here")
def test_fleet_goes_over_the_runs_that_meet_an_expression(archive: Path, tmp_path: Path) -> None:
    note_run(archive / "run3", tags=("good",))
    options = FleetOptions("verify", [archive], where="'good' in tags", out=tmp_path / "out")
    assert [Path(line.log).parent.name for line in run_fleet(options).results] == ["run3"]
    with raises_input_error(where=str(archive)):
        run_fleet(FleetOptions("verify", [archive], where="gap_mm > 1e6"))


@pytest.mark.usefixtures("here")
def test_resumed_fleet_computes_what_is_missing_failed_or_new(
    archive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = FleetOptions("verify", [archive], out=tmp_path / "out")
    stopped = run_fleet(options, StopAfter(3))
    assert (len(stopped.results), stopped.is_complete, stopped.stop_reason) == (3, False, "enough")
    repair_run(archive / "run2")
    (archive / "run9").mkdir()
    write_run(archive / "run9", 3)
    computed: list[int] = []

    def compute(folder: Path, number: int) -> FleetLine:
        computed.append(number)
        return compute_case(folder, number)

    monkeypatch.setattr(fleets, "compute_case", compute)
    resumed = FleetOptions("verify", [archive], out=tmp_path / "out", resume=True)
    fleet = run_fleet(resumed)
    assert computed == [2, 3, 4]
    assert (fleet.is_complete, fleet.failures, len(fleet.results)) == (True, (), 5)
    with raises_input_error(key="--resume"):
        run_fleet(FleetOptions("prc", [archive], out=tmp_path / "out", resume=True))


@pytest.mark.usefixtures("here")
def test_results_cut_at_any_byte_lose_one_log_at_most(archive: Path, tmp_path: Path) -> None:
    repair_run(archive / "run2")
    out = tmp_path / "out"
    options = FleetOptions("verify", [archive], out=out, resume=True)
    whole = run_fleet(FleetOptions("verify", [archive], out=out)).results
    text = (out / "results.jsonl").read_bytes()
    dice = random.Random(7)
    for _ in range(20):
        end = dice.randrange(len(text))
        (out / "results.jsonl").write_bytes(text[:end])
        assert run_fleet(options).results == whole
    (out / "results.jsonl").write_bytes(text.replace(b'"damage": 0', b'"damage": 1', 1))
    with raises_input_error(where=out / "results.jsonl"):
        run_fleet(options)


@pytest.mark.usefixtures("here")
def test_changes_since_an_earlier_fleet_are_listed(log_file: Path, tmp_path: Path) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    run = log_file.parent
    run_fleet(FleetOptions("replay", [run], out=first))
    same = run_fleet(FleetOptions("replay", [run], out=tmp_path / "same", since=first))
    assert same.changes == ()
    softer = tmp_path / "softer.toml"
    stiffness = "stiffness_n_m = 36000"
    model = (Path(__file__).parents[2] / "profiles/models/snm.toml").read_text()
    assert stiffness in model
    softer.write_text(model.replace(stiffness, "stiffness_n_m = 30000"))
    fleet = run_fleet(FleetOptions("replay", [run], model=str(softer), out=second, since=first))
    changes = {change.column: change for change in fleet.changes}
    assert (changes["identical"].before, changes["identical"].after) == (True, False)
    worse = changes["nrmse rel_disp_m"]
    assert isinstance(worse.before, float)
    assert isinstance(worse.after, float)
    assert worse.after > worse.before
    assert read_table(second / "changes.csv")[0]["column"] in changes
    page = (second / "report.html").read_text()
    assert f"Changed since {first}" in page
    assert "nrmse rel_disp_m" in page
    with raises_input_error(key="--since"):
        run_fleet(FleetOptions("verify", [run], out=tmp_path / "third", since=first))


@pytest.mark.usefixtures("here")
@pytest.mark.parametrize("task", ["replay", "prc"])
def test_a_recording_that_was_cut_off_is_no_result_like_others(
    log_file: Path, tmp_path: Path, task: Any
) -> None:
    whole = log_file.read_bytes()
    for name, share in (("start", 0.02), ("half", 0.6), ("whole", 1.0)):
        (tmp_path / "archive" / name).mkdir(parents=True)
        size = round(share * len(whole))
        (tmp_path / "archive" / name / "run.mcap").write_bytes(whole[:size])
    fleet = run_fleet(FleetOptions(task, [tmp_path / "archive"], out=tmp_path / "out"))
    rows = {Path(line.log).parent.name: line for line in fleet.results}
    assert "no " in rows["start"].failure
    assert not rows["half"].failure
    key, cut, intact = {"replay": ("intact", False, True), "prc": ("ended", "halted", "complete")}[
        task
    ]
    assert (rows["half"].values[key], rows["whole"].values[key]) == (cut, intact)


@pytest.mark.usefixtures("here")
def test_fleet_identifies_each_log_by_itself(log_file: Path, tmp_path: Path) -> None:
    """The model of a log is in a folder next to the table."""
    fitted = run_fleet(FleetOptions("identify", [log_file.parent], out=tmp_path / "identify"))
    (row,) = read_table(tmp_path / "identify/table.csv")
    assert fitted.failures == ()
    assert float(row["stiffness_low"]) < TRUE_STIFFNESS < float(row["stiffness_high"])
    (model,) = (tmp_path / "identify").glob("0000-*/model.toml")
    assert load_model_config(model)[0].base.stiffness_n_m == float(row["stiffness"])


@pytest.mark.slow
@pytest.mark.usefixtures("here")
def test_fleet_discovers_in_each_log_by_itself(log_file: Path, tmp_path: Path) -> None:
    fleet = run_fleet(FleetOptions("discover", [log_file.parent], out=tmp_path / "discover"))
    (row,) = read_table(tmp_path / "discover/table.csv")
    assert fleet.failures == ()
    (folder,) = (tmp_path / "discover").glob("0000-*")
    verdict = json.loads((folder / "verdict.json").read_text())
    assert row["verdict"] == verdict["verdict"]
    assert (folder / "model.toml").is_file()


def test_command_states_failures_by_its_exit_code(archive: Path, tmp_path: Path) -> None:
    result = call_main("fleet", "verify", archive, "--out", tmp_path / "out", "--workers", "1")
    assert result.returncode == 4
    assert "4 of 4 logs, 1 failed, complete" in result.stdout
    assert call_main("fleet", "prc", archive, "--model", "snm").returncode == 2


@pytest.mark.usefixtures("here")
def test_nothing_is_lost_or_doubled_by_twenty_kills(tmp_path: Path) -> None:
    for number in range(LOGS_TO_KILL):
        folder = tmp_path / "archive" / f"run{number:03d}"
        folder.mkdir(parents=True)
        write_run(folder, number % 4)
    out, places = tmp_path / "out", [tmp_path / "archive"]
    run_fleet(FleetOptions("verify", places, out=out), StopAfter(1))
    options = FleetOptions("verify", places, out=out, resume=True)
    dice = random.Random(11)
    kept = 0
    for kill in range(20):
        child = os.fork()
        if child == 0:
            run_fleet(options)
            os._exit(0)
        deadline_s = time.monotonic() + 20.0
        path = out / "results.jsonl"
        while kill % 2 and path.read_bytes().count(b"\n") <= kept:
            assert time.monotonic() < deadline_s, "the fleet does not go on"
            time.sleep(0.001)
        time.sleep(dice.uniform(0.0, 0.01))
        os.kill(child, signal.SIGKILL)
        assert os.WIFSIGNALED(os.waitpid(child, 0)[1]), "it was complete before it was killed"
        lines = [*SealedLines(out / "results.jsonl", FleetLine).read()]
        assert len(lines) == len({line.number for line in lines})
        assert len(lines) >= kept, "a result is lost"
        kept = len(lines)
    results = run_fleet(options).results
    assert [line.number for line in results] == list(range(LOGS_TO_KILL))
    assert [row["log"] for row in read_table(out / "table.csv")] == [line.log for line in results]
    assert 10 < kept < LOGS_TO_KILL


def test_fleet_on_a_cluster_has_the_same_table(archive: Path, tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    words = ["fleet", "verify", archive, "--out"]
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, dashboard_address="127.0.0.1:0"
    ) as cluster:
        remote = call_main(*words, tmp_path / "there", "--scheduler", cluster.scheduler_address)
    assert remote.returncode == 4, remote.stdout
    assert call_main(*words, tmp_path / "here").returncode == 4
    assert read_table(tmp_path / "there/table.csv") == read_table(tmp_path / "here/table.csv")
