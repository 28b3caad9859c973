"""Soak: a long test whose processes must not grow, lose samples or drift.

    python -m tests.studies.soak --hours 3            # unpaced, one process
    python -m tests.studies.soak --minutes 60 --live  # in real time, with page, view and monitor

The test holds neighbouring frequencies, up and down. Memory is that of each process (proportional
set size), every SAMPLE_S; printed are its value once the process has settled and at the end, and
the growth.
Drift is the change of the measured peak, and of the twin's error, from the first tenth of the
cycles of a step to the last; live also that of the timing of each process.
"""

import argparse
import math
import os
import pty
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from collections import defaultdict
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np

from table_io.block import Float1D, Float2D
from table_io.records import CycleExtremes, SampleGap, Timing
from twin.recording.reader import Recording, read_recording

SHAKETWIN = str(Path(sys.executable).parent / "shaketwin")
SAMPLE_S = 2.0
SETTLING_ROWS = 20  # cycles, or reports, at the beginning
SETTLED_SHARE = 0.2  # of the run, after which memory is no longer expected to grow
START_HZ, STEP_HZ, MAX_CYCLES = 3.0, 0.01, 1000
TOPICS = ("/run/start", "/run/stop", "/run/timing", "/rig/gap", "/twin/cycle")  # no blocks
PROFILE = """
title = "Soak"
[specimen]
mass_kg = 550.0
gap_mm = 4.0
[sweep]
start_hz = {start_hz}
stop_hz = {stop_hz}
step_hz = {step_hz}
cycles = {cycles}
measured_cycles = 20
[loop_check]
enabled = false
"""


def list_tree(root: int) -> Iterator[int]:
    """Yield a process and its descendants."""
    yield root
    with suppress(OSError):
        for task in Path(f"/proc/{root}/task").iterdir():
            for child in (task / "children").read_text().split():
                yield from list_tree(int(child))


def name_process(pid: int) -> str:
    """Return what a process of the product does, from its command line."""
    words = Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace").split("\0")
    for position, word in enumerate(words):
        if word.endswith("twin.live.processes"):
            return words[position + 1]
        if word.endswith("shaketwin"):
            return f"shaketwin {words[position + 1]}"
    return Path(words[0]).name


def memory_mib(pid: int) -> float:
    """Return the proportional set size of a process in MiB."""
    text = Path(f"/proc/{pid}/smaps_rollup").read_text()
    return int(re.findall(r"^Pss: +(\d+) kB", text, re.MULTILINE)[0]) / 1024


def watch_memory(
    runs: list["subprocess.Popen[bytes]"],
) -> dict[str, list[tuple[float, float]]]:
    """Return (time in s, MiB) by process until the first of `runs` has ended."""
    memory: dict[str, list[tuple[float, float]]] = defaultdict(list)
    begin_s = time.monotonic()
    while runs[0].poll() is None:
        for pid in (pid for run in runs for pid in list_tree(run.pid)):
            with suppress(OSError, IndexError):  # it has just ended
                row = time.monotonic() - begin_s, memory_mib(pid)
                memory[f"{name_process(pid)} ({pid})"].append(row)
        time.sleep(SAMPLE_S)
    return memory


def read_page(address: str) -> None:
    """Read the events of the page for ever, as a browser does."""
    with suppress(OSError):
        request = urllib.request.Request(f"{address}events")
        with urllib.request.urlopen(request) as events:
            while events.read(65536):
                pass


def open_viewers(run: "subprocess.Popen[bytes]", out: Path) -> "subprocess.Popen[bytes]":
    """Open the page and a monitor in a terminal of their own; return the monitor."""
    log = out.with_name("output.txt")
    deadline_s = time.monotonic() + 120.0
    while not (address := re.search(r"page: (http\S+/)", log.read_text())):
        if run.poll() is not None or time.monotonic() > deadline_s:
            raise SystemExit(log.read_text())
        time.sleep(0.2)
    threading.Thread(target=read_page, args=[address[1]], daemon=True).start()
    terminal, inside = pty.openpty()
    monitor = subprocess.Popen(
        [SHAKETWIN, "monitor"], stdin=inside, stdout=inside, stderr=inside, start_new_session=True
    )
    threading.Thread(target=drain, args=[terminal], daemon=True).start()
    return monitor


def drain(terminal: int) -> None:
    """Read what a terminal is to show."""
    with suppress(OSError):
        while os.read(terminal, 65536):
            pass


def print_memory(memory: dict[str, list[tuple[float, float]]]) -> None:
    """Print the memory of each process that lived for most of the run."""
    end_s = max(rows[-1][0] for rows in memory.values())
    print(f"{'process':28} {'settled':>8} {'end':>8} {'most':>8} MiB   growth")
    for name, rows in memory.items():
        times, sizes = np.array(rows).T
        settled = sizes[times > SETTLED_SHARE * end_s]
        if times[-1] < 0.8 * end_s or settled.size < 10:
            continue
        tenth = max(settled.size // 10, 1)
        first, last = np.median(settled[:tenth]), np.median(settled[-tenth:])
        print(f"{name:28} {first:8.1f} {last:8.1f} {sizes.max():8.1f}   {last / first - 1:+.1%}")


def print_drift(recording: Recording) -> None:
    """Print lost samples, and what changed during each step and each process."""
    stop = recording.stop
    assert stop is not None
    lost = sum(gap.count for gap in recording.records(SampleGap))
    hours = stop.index / recording.start.rate_hz / 3600
    print(f"{hours:.3f} h of the test, {stop.index} samples, {lost} of them lost")
    peaks: dict[int, list[tuple[float, float]]] = defaultdict(list)
    for cycle in recording.records(CycleExtremes):
        if cycle.measured and cycle.twin:
            u_max = cycle.measured.u_max
            peaks[cycle.step].append((u_max, cycle.twin.u_max - u_max))
    ends = {step: means_of_ends(np.array(rows)) for step, rows in sorted(peaks.items())}
    for step, (first, last) in ends.items():
        print(f"step {step}, {len(peaks[step])} cycles:", describe_change(first, last))
    first, last = ends[min(ends)][1], ends[max(ends)][1]
    print(f"from step {min(ends)} to step {max(ends)}:", describe_change(first, last))
    timings = recording.records(Timing)
    for component in sorted({timing.component for timing in timings}):
        delays = np.array(
            [(t.p50_ms, t.p99_ms, t.missed) for t in timings if t.component == component]
        )
        first, last = means_of_ends(delays)
        print(
            f"{component:10} p50 {first[0]:.2f} -> {last[0]:.2f} ms, "
            f"p99 {first[1]:.2f} -> {last[1]:.2f} ms"
        )


def describe_change(first: Float1D, last: Float1D) -> str:
    """Return what (measured peak in m, twin minus measured) has become, in words."""
    peak, error = 100 * (last - first) / first[0]
    return f"peak {1e3 * first[0]:.4f} mm {peak:+.3f} %, twin's error {error:+.3f} % of the peak"


def means_of_ends(rows: Float2D) -> tuple[Float1D, Float1D]:
    """Return the means of the first and of the last tenth of the rows, without the first rows."""
    tenth = max(len(rows) // 10, 1)
    begin = min(SETTLING_ROWS, len(rows) - tenth)
    return rows[begin : begin + tenth].mean(axis=0), rows[-tenth:].mean(axis=0)


def soak(hours: float, live: bool, folder: Path) -> int:
    """Run the test and print the figures; return the exit code of the run."""
    all_cycles = max(hours * 3600 * START_HZ, 80)
    frequencies = max(math.ceil(all_cycles / 2 / MAX_CYCLES), 2)
    profile = PROFILE.format(
        start_hz=START_HZ,
        stop_hz=round(START_HZ + STEP_HZ * (frequencies - 1), 3),
        step_hz=STEP_HZ,
        cycles=math.ceil(all_cycles / 2 / frequencies),
    )
    (folder / "soak.toml").write_text(profile)
    out = folder / "out"
    command = [SHAKETWIN, "run", str(folder / "soak.toml"), "--out", str(out)]
    command += ["--view", "--web"] if live else ["--speed", "max"]
    begin_s = time.monotonic()
    with (folder / "output.txt").open("wb") as output:
        run = subprocess.Popen(command, stdout=output, stderr=output)
    monitors = [open_viewers(run, out)] if live else []
    try:
        memory = watch_memory([run, *monitors])
    except KeyboardInterrupt:
        run.send_signal(signal.SIGINT)
        memory = watch_memory([run, *monitors])
    for monitor in monitors:
        monitor.terminate()
        monitor.wait()
    print(f"{time.monotonic() - begin_s:.0f} s, exit code {run.returncode}")
    if not out.is_dir():
        raise SystemExit((folder / "output.txt").read_text())
    print_memory(memory)
    print_drift(read_recording(out / "run.mcap", TOPICS))
    return run.returncode


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--hours", type=float, default=3.0)
    parser.add_argument("--minutes", type=float, help="instead of hours")
    parser.add_argument("--live", action="store_true", help="in real time")
    asked = parser.parse_args()
    hours = asked.hours if asked.minutes is None else asked.minutes / 60
    with tempfile.TemporaryDirectory() as folder:
        raise SystemExit(soak(hours, asked.live, Path(folder)))


if __name__ == "__main__":
    main()
