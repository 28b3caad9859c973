"""A study on Dask workers of two hosts: its rate, a foreign version, and a scheduler gone silent.

    python -m tests.studies.map_cluster [--cases 8000] [--only PART]

The hosts are network namespaces with a cable between, which need no privilege; the scheduler is on
the one, and half of the workers are on either. The rate of w workers is compared with w times that
of one, or with as many times as there are cores. About three minutes.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tests.live.namespaces import HERE, Cable, cable, start_isolated
from tests.sweeps.small_study import read_stored_bytes
from twin.system.files import count_cores

ROOT = Path(__file__).resolve().parents[2]
ADDRESS = f"tcp://{HERE}:8786"
CHUNK_CASES = 500
DASK = [sys.executable, "-m", "dask"]
PROGRAM = [sys.executable, "-c", "from twin.cli.entry import main; main()"]
STUDY = """
title = "Gap and stiffness of G4"
profile = "g4_ss3"
outcomes = ["curves", "peaks", "forces", "hysteresis"]
chunk = {chunk}
[[parameters]]
name = "specimen.gap_mm"
start = 2.0
stop = 10.0
count = {count}
[[parameters]]
name = "base.bumper_stiffness_n_m"
start = 2e5
stop = 8e5
count = 20
"""
QUIET: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}


def start_worker(line: Cable, is_far: bool, environment: dict[str, str]) -> "subprocess.Popen[Any]":
    words = [*DASK, "worker", ADDRESS, "--nthreads", "1", "--no-dashboard"]
    if is_far:
        return line.start_far(*words, env=environment, cwd="/tmp", **QUIET)
    return subprocess.Popen(words, env=environment, cwd="/tmp", **QUIET)


@contextmanager
def run_cluster(line: Cable, count: int) -> Iterator["subprocess.Popen[Any]"]:
    """Start a scheduler here and workers here and there; yield the scheduler."""
    import distributed

    words = [*DASK, "scheduler", "--no-dashboard", "--host", ADDRESS]
    scheduler = subprocess.Popen(words, **QUIET)
    workers = [start_worker(line, bool(k % 2), {**os.environ}) for k in range(count)]
    try:
        with distributed.Client(ADDRESS, timeout="90s", set_as_default=False) as client:
            client.wait_for_workers(count, timeout=90)
        yield scheduler
    finally:
        for process in (*workers, scheduler):
            process.terminate()
        for process in (*workers, scheduler):
            process.wait()


def start_map(study: Path, out: Path, *words: str) -> "subprocess.Popen[str]":
    """Start the study; its messages are kept."""
    return subprocess.Popen(
        [*PROGRAM, "map", str(study), "--out", str(out), *words],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip


def wait_for_chunks(out: Path, count: int) -> int:
    """Wait until so many chunks are listed; return their number."""
    end = time.monotonic() + 120
    while time.monotonic() < end:
        path = out / "chunks.jsonl"
        stored = len(path.read_text().splitlines()) if path.exists() else 0
        if stored >= count:
            return stored
        time.sleep(0.05)
    raise SystemExit("no chunk was stored within 120 s")


def find_rate(out: Path, workers: int) -> float:
    """Return the sweeps a second from when every worker has stored its first chunk to the last."""
    chunks = (out / "results.zarr" / "peak_disp_m" / "c").iterdir()
    times = sorted(path.stat().st_mtime for path in chunks)
    return (len(times) - workers) * CHUNK_CASES / (times[-1] - times[workers - 1])


def measure_rates(line: Cable, study: Path, folder: Path) -> None:
    """Print the rate of processes here, and of 1, 2 and 4 workers on both hosts."""
    rates, stored = {}, read_stored_bytes(folder / "local1")
    start_map(study, folder / "local2", "--workers", "2").communicate()
    for count in (1, 2):
        print(f"{count} local processes: {find_rate(folder / f'local{count}', count):.0f} sweeps/s")
    for count in (1, 2, 4):
        out = folder / f"cluster{count}"
        with run_cluster(line, count):
            text = start_map(study, out, "--scheduler", ADDRESS).communicate()[0]
        assert "complete" in text, text
        rates[count] = find_rate(out, count)
        efficiency = rates[count] / rates[1] / min(count, count_cores())
        print(f"{count} workers on two hosts: {rates[count]:.0f} sweeps/s, {efficiency:.3f} of "
              f"{min(count, count_cores())} cores")  # fmt: skip
        assert read_stored_bytes(out) == stored, "other bytes than local processes"
    print("bytes identical to those of local processes")


def copy_package(folder: Path) -> dict[str, str]:
    """Return the environment of a copy of the package with another version."""
    for name in ("twin", "table_io", "profiles"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    metadata = folder / "shaketwin-99.0.dist-info" / "METADATA"
    metadata.parent.mkdir()
    metadata.write_text("Metadata-Version: 2.1\nName: shaketwin\nVersion: 99.0\n")
    return {**os.environ, "PYTHONPATH": str(folder)}


def try_foreign_worker(line: Cable, study: Path, folder: Path) -> None:
    """Print what a worker of another version meets before a study, and in the midst of one."""
    environment = copy_package(folder / "foreign")
    out = folder / "foreign_out"
    with run_cluster(line, 1):
        process = start_map(study, out, "--scheduler", ADDRESS)
        wait_for_chunks(out, 2)
        foreign = start_worker(line, True, environment)
        print("joins in the midst:", process.communicate()[0].strip().splitlines()[-1])
        kept = wait_for_chunks(out, 1)
        again = start_map(study, out, "--scheduler", ADDRESS, "--resume")
        print("there from the start:", again.communicate()[0].strip().splitlines()[-1])
        assert wait_for_chunks(out, 1) == kept, "a refused study lost or won chunks"
        foreign.terminate()
        foreign.wait()
    with run_cluster(line, 2):
        start_map(study, out, "--scheduler", ADDRESS, "--resume").communicate()
    assert read_stored_bytes(out) == read_stored_bytes(folder / "local1")
    print(f"nothing lost: {kept} chunks kept, the whole identical after --resume")


def try_silent_schedulers(line: Cable, study: Path, folder: Path) -> None:
    """Print what a study meets without a scheduler, and when the cable is pulled at its death."""
    text = start_map(study, folder / "none", "--scheduler", "tcp://10.77.0.2:9").communicate()[0]
    print("no scheduler:", text.strip().splitlines()[-1])
    assert not (folder / "none").exists()
    out = folder / "silent"
    with run_cluster(line, 1) as scheduler:
        process = start_map(study, out, "--scheduler", ADDRESS)
        wait_for_chunks(out, 2)
        scheduler.kill()
        print("scheduler killed:", process.communicate()[0].strip().splitlines()[-1])
    kept = wait_for_chunks(out, 2)
    start_map(study, out, "--resume").communicate()
    assert read_stored_bytes(out) == read_stored_bytes(folder / "local1")
    print(f"nothing lost: {kept} chunks kept, the whole identical after --resume")


PARTS = {"rates": measure_rates, "foreign": try_foreign_worker, "silent": try_silent_schedulers}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--cases", type=int, default=8000)
    parser.add_argument("--only", choices=PARTS)
    parser.add_argument("--enclosed", action="store_true", help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if not asked.enclosed:
        words = ["--enclosed", "--cases", str(asked.cases)]
        words += ["--only", asked.only] if asked.only else []
        os.environ["PYTHONUNBUFFERED"] = "1"
        process = start_isolated("tests.studies.map_cluster", *words)
        assert process.stdout is not None
        for text in process.stdout:
            print(text, end="", flush=True)
        raise SystemExit(process.wait())
    with tempfile.TemporaryDirectory() as temporary, cable() as line:
        folder = Path(temporary)
        study = folder / "study.toml"
        study.write_text(STUDY.format(chunk=CHUNK_CASES, count=asked.cases // 20))
        start_map(study, folder / "local1", "--workers", "1").communicate()
        for name in [asked.only] if asked.only else PARTS:
            PARTS[name](line, study, folder)


if __name__ == "__main__":
    main()
