"""Ten observers of one live run, honest ones, and what a stalled or malicious one costs the rig.

    python -m tests.studies.observers --minutes 10

In one run, phases of equal length follow each other: nobody hostile, one observer stopped
(SIGSTOP), one that floods the gate with questions, one that publishes and answers garbage as fast
as it can, one that sends 10,000 random messages, nobody hostile again. Times are those at which
zenoh's put() was called: rig and gate stamp what they publish. The table says of each phase how
late the rig published its measured blocks, and for all of it the latency per hop and the gaps.
"""

import argparse
import json
import os
import random
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from table_io.records import Timing
from twin.live.process_config import ProcessConfig
from twin.recording.reader import read_recording
from twin.transport.codec import TOPIC_TYPES, decode_item
from twin.transport.endpoint import MEAS_TOPIC, key_expression
from twin.transport.zenoh_link import BusLink, open_spoke

SHAKETWIN = str(Path(sys.executable).parent / "shaketwin")
RIG = "simulated"
OBSERVER_COUNT = 10
FUZZ_MESSAGES = 10_000
PHASES = ("quiet", "stalled", "flood", "garbage", "fuzz", "quiet again")
PROFILE = """
title = "Observed"
[specimen]
mass_kg = 550.0
gap_mm = 4.0
[sweep]
start_hz = 3.6
stop_hz = 4.0
step_hz = 0.2
cycles = {cycles}
measured_cycles = 2
directions = ["forward"]
[loop_check]
enabled = false
"""


def listen(link: BusLink, seconds: float, out: Path, lossless: bool) -> None:
    """Note (index, when it was put, when it came), in s of the monotonic clock, of each block."""
    rows: list[tuple[int, float, float]] = []
    offset = time.time() - time.monotonic()

    def came(sample: Any) -> None:
        stamp = sample.timestamp.get_time().timestamp() - offset if sample.timestamp else np.nan
        _, block = decode_item(MEAS_TOPIC, sample.payload.to_bytes())
        rows.append((block.index, stamp, time.monotonic()))

    subscriber = link._session.declare_subscriber(key_expression(RIG, MEAS_TOPIC), came)
    inbox = link.subscribe(tuple(TOPIC_TYPES), history=False, capacity=5000)
    link.declare_alive(f"observer.study{os.getpid()}.listener")
    blocks: list[int] = []
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if lossless and (got := inbox.get(0.2)) is not None:
            if got[0] == MEAS_TOPIC:
                blocks.append(decode_item(*got)[1].index)
        elif not lossless:
            time.sleep(0.2)
    subscriber.undeclare()
    gaps = int((np.diff(blocks) != 20).sum()) + inbox.missed + inbox.dropped
    np.savez(out, rows=np.array(rows), gaps=gaps, blocks=len(blocks))
    link.close()


def flood(link: BusLink, seconds: float) -> None:
    """Questions as fast as they go, well formed ones among them."""
    chance = random.Random(1)
    held = json.dumps({"who": "x", "history": True, "next": {name: {} for name in TOPIC_TYPES}})
    paths = ["state/held", "state/status", "config/schema", "cmd/stop/flood", "config/run"]
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        where = f"shaketwin/{RIG}/{chance.choice(paths)}"
        link._session.get(where, lambda _: None, payload=held, timeout=0.05)


def garbage(link: BusLink, seconds: float) -> None:
    """Payloads of all sizes on the run's own keys, and answers in the gate's place."""
    chance = random.Random(2)
    keys = [key_expression(RIG, name) for name in TOPIC_TYPES]
    link.declare_requests("state/held", "state/status", "cmd/*")
    bodies = [chance.randbytes(size) for size in (0, 17, 1700, 60_000, 300_000)]
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        link._session.put(chance.choice(keys), chance.choice(bodies), attachment=bodies[1])


def fuzz(link: BusLink, seconds: float) -> None:
    """So many random messages, evenly over the time."""
    chance = random.Random(3)
    parts = ["state", "cmd", "config", "stream", "event", "alive", "held", "stop", "*", "**", "é"]
    begin = time.monotonic()
    for number in range(FUZZ_MESSAGES):
        time.sleep(max(0.0, begin + number * seconds / FUZZ_MESSAGES - time.monotonic()))
        where = "/".join(["shaketwin", RIG, *chance.choices(parts, k=chance.randint(1, 4))])
        body = chance.randbytes(chance.choice((0, 1, 20, 500, 5000, 70_000)))
        try:
            if chance.random() < 0.5:
                link._session.get(where, lambda _: None, payload=body, timeout=0.05)
            else:
                link._session.put(where, body, attachment=body[:100])
        except Exception as error:  # of zenoh, in this process: no such key
            if "key" not in str(error).lower():
                raise


HOSTILE = {"flood": flood, "garbage": garbage, "fuzz": fuzz}


def child(what: str, endpoint: str, seconds: float, out: Path) -> "subprocess.Popen[bytes]":
    """A process of the study; a hostile one begins when its input says so."""
    words = ["--child", what, "--endpoint", endpoint, "--seconds", str(seconds), "--out", str(out)]
    command = [sys.executable, "-m", "tests.studies.observers", *words]
    return subprocess.Popen(command, stdin=subprocess.PIPE)


def be(asked: argparse.Namespace) -> None:
    """One of the processes of the study."""
    link = open_spoke(RIG, asked.endpoint, 30.0)
    if asked.child in HOSTILE:
        link.declare_alive(f"observer.{asked.child}.x")
        sys.stdin.readline()
        HOSTILE[asked.child](link, asked.seconds)
    else:
        listen(link, asked.seconds, asked.out, asked.child != "probe")


def begin_run(folder: Path, endpoint: str, seconds: float) -> "subprocess.Popen[bytes]":
    """The run, once the table moves."""
    cycles = round((seconds + 60) * 3.8 / 3)
    (folder / "test.toml").write_text(PROFILE.format(cycles=cycles))
    command = [SHAKETWIN, "run", str(folder / "test.toml"), "--out", str(folder / "out")]
    with (folder / "said.txt").open("w") as output:
        run = subprocess.Popen([*command, "--listen", endpoint], stdout=output, stderr=output)
    while "state: running" not in (folder / "said.txt").read_text():
        if run.poll() is not None:
            raise SystemExit((folder / "said.txt").read_text())
        time.sleep(0.1)
    return run


def study(minutes: float, folder: Path) -> None:
    """One run and its table."""
    length = minutes * 60 / len(PHASES)
    whole = minutes * 60 + 30
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{free.getsockname()[1]}"
    run = begin_run(folder, endpoint, whole)
    inside = ProcessConfig.read(folder / "out" / ".parts" / "spec.json").endpoint
    probe = child("probe", inside, whole, folder / "probe.npz")
    names = ("observer", "stalled")
    honest = [
        child(names[number == 0], endpoint, whole, folder / f"{names[number == 0]}{number}.npz")
        for number in range(OBSERVER_COUNT + 1)
    ]
    hostile = {name: child(name, endpoint, length - 1, folder / "x") for name in HOSTILE}
    link = open_spoke(RIG, endpoint, 30.0)
    everybody = OBSERVER_COUNT + 2 + len(HOSTILE)
    while sum(name.startswith("observer.") for name in link.list_components()) < everybody:
        time.sleep(0.1)
    link.close()
    spans = []
    for phase in PHASES:
        begin = time.monotonic()
        if phase == "stalled":
            honest[0].send_signal(signal.SIGSTOP)
        elif phase in hostile:
            stdin = hostile[phase].stdin
            assert stdin is not None
            stdin.write(b"\n")
            stdin.flush()
        time.sleep(max(0.0, begin + length - time.monotonic()))
        if phase == "stalled":
            honest[0].send_signal(signal.SIGCONT)
        elif phase in hostile:
            hostile[phase].kill()
            hostile[phase].wait()
        spans.append((phase, begin, time.monotonic()))
    for peer in (probe, *honest):
        peer.wait()
    run.send_signal(signal.SIGINT)
    run.wait()
    report(folder, spans)


def report(folder: Path, spans: list[tuple[str, float, float]]) -> None:
    """Print the table."""
    recording = read_recording(folder / "out" / "run.mcap")
    start = recording.start
    at_rig = np.load(folder / "probe.npz")["rows"]
    due = start.epoch_s + (at_rig[:, 0] + start.block_samples - 1) / start.rate_hz
    late = (at_rig[:, 1] - due) * 1e3
    print(f"samples missing in the recording: {recording.missing_samples}")
    print(f"{'phase':12} {'blocks':>7} {'rig put, late by: p50':>22} {'p99':>7} {'max':>8} ms")
    for phase, begin, end in spans:
        those = late[(at_rig[:, 1] > begin) & (at_rig[:, 1] < end)]
        print(f"{phase:12} {those.size:7d} {words(those):>38}")
    timings = {timing.component: timing for timing in recording.records(Timing)}
    for name, timing in timings.items():
        figures = f"p50 {timing.p50_ms:.2f} p99 {timing.p99_ms:.2f} max {timing.max_ms:.2f}"
        print(f"{name:9} by itself {figures} ms, {timing.cpu_share:.0%} of a core")
    put = dict(at_rig[:, :2].tolist())
    hops: dict[str, list[np.ndarray[Any, Any]]] = {"rig -> gate": [], "gate -> observer": []}
    gaps = blocks = 0
    for path in sorted(folder.glob("observer*.npz")):
        arrays = np.load(path)
        rows = arrays["rows"]
        gaps, blocks = gaps + int(arrays["gaps"]), blocks + int(arrays["blocks"])
        known = np.array([put.get(index, np.nan) for index in rows[:, 0]])
        hops["rig -> gate"].append((rows[:, 1] - known) * 1e3)
        hops["gate -> observer"].append((rows[:, 2] - rows[:, 1]) * 1e3)
    for hop, parts in hops.items():
        values = np.concatenate(parts)
        print(f"{hop:17} {words(values[np.isfinite(values)])} ms")
    print(f"{OBSERVER_COUNT} observers: {blocks} blocks, {gaps} gaps")


def words(values: np.ndarray[Any, Any]) -> str:
    p50, p99 = np.quantile(values, (0.5, 0.99))
    return f"p50 {p50:.2f} p99 {p99:.2f} max {values.max():.2f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--child", help=argparse.SUPPRESS)
    parser.add_argument("--endpoint", help=argparse.SUPPRESS)
    parser.add_argument("--seconds", type=float, help=argparse.SUPPRESS)
    parser.add_argument("--out", type=Path, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.child:
        be(asked)
        return
    with tempfile.TemporaryDirectory() as folder:
        study(asked.minutes, Path(folder))


if __name__ == "__main__":
    main()
