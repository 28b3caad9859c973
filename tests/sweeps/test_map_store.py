"""A study that is killed, stopped, resumed, crowded out or spread over other workers."""

import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path

import distributed
import numpy as np
import pytest

from tests.command_line import call_main
from tests.input_errors import raises_input_error
from tests.plugin_package import install_package
from tests.sweeps.small_study import STUDY, make_stored_study, read_stored_bytes, write_study
from tests.system.clusters import start_cluster, start_quietly
from twin.api import open_study
from twin.studies import DEFINITION_FILE, command
from twin.studies.maps import store, task
from twin.studies.maps.store import MANIFEST_FILE, remove_partial_files
from twin.studies.maps.study import Study
from twin.studies.maps.task import MapOptions, compute_chunk, compute_outcomes
from twin.system import grid
from twin.system.process_pool import TaskResult

pytestmark = pytest.mark.usefixtures("forget_entry_points")

PROGRAM = [sys.executable, "-c", "from twin.cli.entry import main; main()"]


@pytest.fixture(autouse=True)
def without_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawing takes longer than these studies."""
    monkeypatch.setattr(command, "write_map_page", lambda folder: folder / "report.html")


@pytest.fixture(scope="module")
def whole_study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the study and, in out, its results."""
    folder = tmp_path_factory.mktemp("study")
    make_stored_study(write_study(folder), folder / "out", range(5))
    return folder


def test_two_processes_store_the_same_bytes(whole_study: Path, tmp_path: Path) -> None:
    result = call_main("map", whole_study / "study.toml", "--out", tmp_path, "--workers", 2)
    assert result.returncode == 0, result.stderr
    assert read_stored_bytes(tmp_path) == read_stored_bytes(whole_study / "out")


@pytest.fixture(scope="module")
def cluster() -> Iterator[distributed.LocalCluster]:
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=2, dashboard_address="127.0.0.1:0"
    ) as cluster:
        yield cluster


def test_a_cluster_stores_the_same_bytes(
    whole_study: Path, tmp_path: Path, cluster: distributed.LocalCluster
) -> None:
    """Two chunks at once in each process: what they share must not mix them."""
    result = call_main(
        "map", whole_study / "study.toml", "--out", tmp_path,
        "--scheduler", cluster.scheduler_address,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    assert read_stored_bytes(tmp_path) == read_stored_bytes(whole_study / "out")


def test_a_cluster_simulates_the_same_batch(
    whole_study: Path, tmp_path: Path, cluster: distributed.LocalCluster
) -> None:
    tables = []
    for name, places in (
        ("here", ["--workers", 2]),
        ("there", ["--scheduler", cluster.scheduler_address]),
    ):
        out = tmp_path / name
        words = ["simulate", whole_study / "across.toml", "--gap", "2:8:1", "--out", out]
        result = call_main(*words, *places)
        assert result.returncode == 0, result.stderr
        tables.append((out / "batch.csv").read_bytes())
    assert tables[0] == tables[1]
    assert json.loads((out / "summary.json").read_text())["run"]["workers"].startswith(
        "the cluster"
    )


def test_a_stopped_study_goes_on_where_it_was(whole_study: Path, tmp_path: Path) -> None:
    """Some chunks stored, a line cut, a file half written: the rest is computed, none twice."""
    out = tmp_path / "out"
    study = make_stored_study(whole_study / "study.toml", out, range(1, 3))
    with (out / MANIFEST_FILE).open("a") as file:
        file.write('{"chunk": 4, "fir')
    half = out / "results.zarr" / "peak_disp_m" / "c" / "0.0123.partial"
    half.write_bytes(b"half")
    data = open_study(out)
    assert int(data["peak_disp_m"].notnull().sum()) == 10
    assert data.attrs["cases"] == 10
    result = call_main("map", whole_study / "study.toml", "--out", out, "--resume", "--workers", 1)
    assert result.returncode == 0, result.stderr
    assert read_stored_bytes(out) == read_stored_bytes(whole_study / "out")
    assert study.config.chunk_count == 5


def test_a_finished_study_computes_nothing_again(
    whole_study: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = read_stored_bytes(whole_study / "out")
    monkeypatch.setattr(grid, "run_tasks", run_no_task)
    out = whole_study / "out"
    assert call_main("map", whole_study / "study.toml", "--out", out, "--resume").returncode == 0
    assert read_stored_bytes(out) == before


def run_no_task(task: object, numbers: list[int], *_: object, **__: object) -> list[TaskResult]:
    assert numbers == []
    return []


def test_a_chunk_that_was_lost_after_all_is_computed_again(
    whole_study: Path, tmp_path: Path
) -> None:
    """Its line is on the disk, but a file of it is gone, another cut and a third other numbers."""
    out = tmp_path / "out"
    shutil.copytree(whole_study / "out", out)
    arrays = out / "results.zarr"
    (arrays / "peak_disp_m" / "c" / "0").unlink()
    cut = arrays / "eta_d" / "c" / "1" / "0" / "0"
    cut.write_bytes(cut.read_bytes()[:40])
    (arrays / "peak_acc_hz" / "c" / "2").write_bytes(
        (arrays / "peak_acc_m_s2" / "c" / "2").read_bytes()
    )
    assert call_main("map", out, "--resume", "--workers", 1).returncode == 0
    assert read_stored_bytes(out) == read_stored_bytes(whole_study / "out")


def test_a_store_without_a_study_is_begun_again(whole_study: Path, tmp_path: Path) -> None:
    """The process died before anything was computed."""
    out = tmp_path / "out"
    make_stored_study(whole_study / "study.toml", out, range(0))
    (out / DEFINITION_FILE).unlink()
    result = call_main("map", whole_study / "study.toml", "--out", out, "--workers", 1)
    assert result.returncode == 0, result.stderr
    assert read_stored_bytes(out) == read_stored_bytes(whole_study / "out")


@pytest.mark.parametrize(
    ("name", "text"),
    [
        (DEFINITION_FILE, "{"),
        (DEFINITION_FILE, '{"study_toml": ""}'),
        (MANIFEST_FILE, "\0\n"),
        (MANIFEST_FILE, '{"chunk": 1}\n'),
        (MANIFEST_FILE, "3\n"),
    ],
)
def test_a_damaged_file_is_named(whole_study: Path, tmp_path: Path, name: str, text: str) -> None:
    out = tmp_path / "out"
    make_stored_study(whole_study / "study.toml", out, range(1))
    (out / name).write_text(text)
    with raises_input_error(where=out / name):
        command.run_study(MapOptions(whole_study / "study.toml", out, 1, resume=True), False)


@pytest.mark.slow
@pytest.mark.parametrize("on_cluster", [False, True])
def test_kills_at_random_lose_and_double_nothing(
    whole_study: Path, tmp_path: Path, on_cluster: bool
) -> None:
    """50 deaths: of the client and its processes, or also of a scheduler and its workers."""
    rng = random.Random(3)
    kills, round_number = 50, 0
    while kills > 0:
        out = tmp_path / f"out{round_number}"
        kills -= run_with_kills(whole_study / "study.toml", out, min(kills, 6), rng, on_cluster)
        assert read_stored_bytes(out) == read_stored_bytes(whole_study / "out")
        round_number += 1
    assert round_number >= 8


def run_with_kills(
    study: Path, out: Path, max_kills: int, rng: random.Random, on_cluster: bool
) -> int:
    """Start or resume a study until it is complete, with deaths on the way; return their number."""
    kills = 0
    for _ in range(8 * max_kills):
        resume = ["--resume"] if (out / DEFINITION_FILE).exists() else []
        if not resume and out.exists():
            out.rename(out.with_name(f"{out.name}-{kills}"))  # died before it began
        with ExitStack() as stack:
            helpers: list[subprocess.Popen[bytes]] = []
            options = ["--workers", "2"]
            if on_cluster:
                helpers, address = start_cluster(stack)
                options = ["--scheduler", address]
            words = ["map", str(study), "--out", str(out), *options, *resume]
            client = stack.enter_context(start_quietly([*PROGRAM, *words]))
            while kills < max_kills and client.poll() is None:
                time.sleep(rng.uniform(0.3, 3.5))
                victims = [client.pid, *list_children(client.pid)]
                victims += [pid for each in helpers for pid in (each.pid, *list_children(each.pid))]
                with suppress(ProcessLookupError):
                    os.kill(rng.choice(victims), signal.SIGKILL)
                    kills += 1
            try:
                code = client.wait(timeout=240)
            finally:
                for process in (client, *helpers):
                    process.kill()
        if code == 0:
            return max(kills, 1)
    raise AssertionError(f"not complete after {kills} kills: the last client ended with {code}")


def list_children(pid: int) -> list[int]:
    try:
        text = Path(f"/proc/{pid}/task/{pid}/children").read_text()
    except FileNotFoundError:
        return []
    return [int(word) for word in text.split()]


def test_another_study_is_not_mixed_into_the_first(whole_study: Path, tmp_path: Path) -> None:
    changed = write_study(tmp_path, STUDY.replace("count = 6", "count = 7"))
    with raises_input_error(key="--resume", problem="study"):
        command.run_study(MapOptions(changed, whole_study / "out", 1, resume=True), False)
    with raises_input_error(key="--out"):
        command.run_study(MapOptions(changed, whole_study / "out", 1), False)
    with raises_input_error(where=tmp_path / "none"):
        command.run_study(MapOptions(changed, tmp_path / "none", 1, resume=True), False)


def test_other_versions_are_refused(
    whole_study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    versions = store.read_study_versions() | {"numpy": "0.1"}
    with monkeypatch.context() as context:
        context.setattr(store, "read_study_versions", lambda: versions)
        make_stored_study(whole_study / "study.toml", out, range(0))
    with raises_input_error(key="--resume", problem="numpy 0.1"):
        command.run_study(MapOptions(whole_study / "study.toml", out, 1, resume=True), False)
    assert "numpy 0.1" in str(compute_chunk(out, 1))


def test_what_does_not_fit_on_the_disk_is_not_started(
    whole_study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(task, "free_bytes", lambda _: 1000)
    with raises_input_error(where=tmp_path):
        command.run_study(MapOptions(whole_study / "study.toml", tmp_path, 1), False)
    assert list(tmp_path.iterdir()) == []


def test_what_does_not_fit_into_memory_is_not_started(tmp_path: Path) -> None:
    names = ("specimen.gap_mm", "specimen.mass_kg", "base.stiffness_n_m")
    text = 'title = "T"\nprofile = "g4_ss3"\noutcomes = ["peaks"]\n' + "".join(
        f'[[parameters]]\nname = "{name}"\nstart = 1.0\nstop = 2.0\ncount = 464\n' for name in names
    )
    path = write_study(tmp_path, text)
    limit = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "sysconf", lambda name: 1 if "PAGES" in name else min(limit, 10**9))
        with raises_input_error(key="parameters"):
            command.run_study(MapOptions(path, tmp_path / "out", 1), False)
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_disk_that_fills_up_ends_the_study_with_what_is_stored(
    whole_study: Path, tmp_path: Path
) -> None:
    """Every write beyond a size fails in the processes; then there is room again."""
    out = tmp_path / "out"
    make_stored_study(whole_study / "study.toml", out, range(1))
    words = ["map", str(whole_study / "study.toml"), "--out", str(out), "--resume"]

    def limit_files() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (600, resource.RLIM_INFINITY))

    result = subprocess.run(
        [*PROGRAM, *words], preexec_fn=limit_files, capture_output=True, text=True, check=False
    )
    assert result.returncode == 2
    assert "Traceback" not in result.stderr
    assert call_main(*words).returncode == 0
    assert read_stored_bytes(out) == read_stored_bytes(whole_study / "out")


def test_a_chunk_that_always_dies_ends_the_study_with_its_number(
    whole_study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    failure = TaskResult(3, failure="its process died (exit code -9)")
    monkeypatch.setattr(grid, "run_tasks", lambda *_, **__: [failure])
    with raises_input_error(problem="chunk 3"):
        command.run_study(MapOptions(whole_study / "study.toml", tmp_path / "out", 1), False)


def test_what_zarr_leaves_behind_is_removed_and_nothing_else(
    whole_study: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    shutil.copytree(whole_study / "out", out)
    before = read_stored_bytes(out)
    (out / "results.zarr" / "eta_d" / "c" / "0.abc.partial").write_bytes(b"1")
    remove_partial_files(out)
    assert read_stored_bytes(out) == before


OUTCOME = """
import numpy as np
from twin.studies.maps.outcomes import Outcome, OutcomeVariable

def compute(chunk):
    draws = np.array([np.random.default_rng(seed).normal() for seed in chunk.seeds])
    return {"mass_kg": np.array([case.model.base.mass for case in chunk.cases]), "draw": draws}

WEIGHT = Outcome("weight", "mass and a random number", (
    OutcomeVariable("mass_kg", "kg", "mass"), OutcomeVariable("draw", "1", "random number"),
), compute)
def fail(chunk):
    raise KeyError("mass")

NAMED = (OutcomeVariable("silent", "1", "steps"),)
WRONG = 3
FAILING = Outcome("failing", "fails", NAMED, fail)
LACKING = Outcome("lacking", "lacks", NAMED, lambda chunk: {})
LONG = Outcome("long", "too long", NAMED, lambda chunk: {"silent": np.zeros(99)})
WHOLE = Outcome("whole", "counts", (OutcomeVariable("n", "1", "n", dtype="int64"),), fail)
"""


def test_a_package_adds_an_outcome(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its numbers come from the seed of the case, whoever computes it."""
    names = ("weight", "wrong", "failing", "lacking", "long", "whole")
    entries = {"shaketwin.outcomes": {name: f"our_outcome:{name.upper()}" for name in names}}
    site = install_package(tmp_path, "our_outcome", OUTCOME, entries)
    monkeypatch.syspath_prepend(str(site))
    text = STUDY.replace('["curves", "peaks", "forces", "hysteresis"]', '["weight"]')
    path = write_study(tmp_path, text.replace("specimen.gap_mm", "specimen.mass_kg"))
    make_stored_study(path, tmp_path / "out", range(5))
    data = open_study(tmp_path / "out")
    assert np.array_equal(data["mass_kg"].isel({"base.bumper_stiffness_n_m": 0}), [2, 4, 6, 9])
    draws = [np.random.default_rng(seed).normal() for seed in data["seed"].values.ravel().tolist()]
    assert data["draw"].values.ravel().tolist() == draws
    definition = json.loads((tmp_path / "out" / DEFINITION_FILE).read_text())
    assert definition["versions"]["our_outcome"] == "1.0"
    for name, problem in (("wrong", "Outcome"), ("whole", "float")):
        with raises_input_error(problem=problem):
            Study.read(write_study(tmp_path, text.replace('["weight"]', f'["{name}"]')))
    for name, problem in (("failing", "mass"), ("lacking", "silent"), ("long", "(99,)")):
        study = Study.read(write_study(tmp_path, text.replace('["weight"]', f'["{name}"]')))
        with raises_input_error(where=f"outcome {name}", problem=problem):
            compute_outcomes(study, np.array([[550.0, 5e5]]), np.zeros(1, dtype=np.uint64))


def test_options_that_exclude_each_other_are_refused(whole_study: Path, tmp_path: Path) -> None:
    path = whole_study / "study.toml"
    with raises_input_error(key="--workers"):
        command.run_study(MapOptions(path, tmp_path / "out", 0), False)
    with raises_input_error(key="--workers"):
        command.run_study(MapOptions(path, tmp_path / "out", 2, "tcp://host:1"), False)
    with raises_input_error(key="--out"):
        command.run_study(MapOptions(path, None, 2, resume=True), False)
    with raises_input_error(where=whole_study / "out"):
        command.run_study(MapOptions(whole_study / "out", None, 2), False)
    with raises_input_error(where=tmp_path):
        command.run_study(MapOptions(tmp_path, None, None), True)


@pytest.mark.slow  # 8 s
def test_a_scheduler_that_does_not_answer_leaves_no_folder(
    whole_study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("twin.system.process_pool.CONNECT_TIMEOUT_S", 0.5)
    with raises_input_error(key="--scheduler"):
        command.run_study(
            MapOptions(whole_study / "study.toml", tmp_path / "out", None, "tcp://127.0.0.1:9"),
            False,
        )
    assert not (tmp_path / "out").exists()
