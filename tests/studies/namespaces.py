"""A test on one host, a recorder on another, and what happens to the cable and a router between.

    python -m tests.studies.namespaces [--only NAME]

Each case is a run of its own over mTLS. The table says of each: samples missing in the recording
here and in the one there, whether both hold the same payloads (but for the last word of the
recorder here), and how late the rig was. Needs no privilege: the hosts are network namespaces.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.live.namespaces import HERE, THERE, Cable, cable, start_isolated
from twin.recording.reader import read_recording
from twin.recording.recovery import recover_log

SHAKETWIN = str(Path(sys.executable).parent / "shaketwin")
PORT, ROUTER_PORT = 7447, 7448
BEFORE_S = 3.0  # of the run, before something happens
PROFILE = """
title = "Two hosts"
[specimen]
mass_kg = 550.0
gap_mm = 4.0
[sweep]
start_hz = 3.6
stop_hz = 4.0
step_hz = 0.2
cycles = 25
measured_cycles = 2
directions = ["forward"]
[loop_check]
enabled = false
"""
# A zenoh router with keys of the role router; there is no other program for it on this machine.
ROUTER = """
import sys, time, zenoh, json
from pathlib import Path
from twin.security.credentials import read_credentials
from twin.transport.endpoint import merge_settings, session_settings
tls = read_credentials(Path(sys.argv[2])).tls_settings()
config = merge_settings(session_settings("router", "listen", sys.argv[1], 0), tls)
session = zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
print("ready", flush=True)
time.sleep(1000)
"""


def nothing(_: Cable) -> None:
    """The cable stays."""


def pull_cable(line: Cable) -> None:
    """The cable is pulled for 2 s."""
    line.pull()
    time.sleep(2.0)
    line.plug()


def long_pulled(line: Cable) -> None:
    """The cable is pulled for 12 s, longer than zenoh waits: the session is another afterwards."""
    line.pull()
    time.sleep(12.0)
    line.plug()


def slow_cable(line: Cable) -> None:
    """Half of what is published fits through, for 6 s."""
    line.slow("2mbit")
    time.sleep(6.0)
    line.quick()


CASES: dict[str, Callable[[Cable], None]] = {
    "nothing": nothing,
    "pulled": pull_cable,
    "long_pulled": long_pulled,
    "slowed": slow_cable,
    "restarted": nothing,  # to the cable: the router between is killed, the next comes 2 s later
}


def keys(folder: Path) -> Path:
    """A laboratory's keys with a recorder and a router."""
    lab = folder / "lab"
    for words in (
        ["new", str(lab), "--host", HERE],
        ["add", str(lab), "rec", "--role", "record"],
        ["add", str(lab), "relay", "--role", "router", "--host", THERE],
    ):
        subprocess.run([SHAKETWIN, "keys", *words], check=True, capture_output=True)
    return lab


def router(line: Cable, lab: Path) -> "subprocess.Popen[str]":
    """A router on the other host, once it listens."""
    listen = f"tls/{THERE}:{ROUTER_PORT}"
    command = [sys.executable, "-c", ROUTER, listen, str(lab / "people" / "relay")]
    process = line.start_far(*command, stdout=subprocess.PIPE)
    assert process.stdout is not None
    process.stdout.readline()
    return process


def play(case: str, line: Cable, folder: Path) -> dict[str, object]:
    """One run with its case; what came of it."""
    lab = keys(folder)
    (folder / "test.toml").write_text(PROFILE)
    command = [SHAKETWIN, "run", str(folder / "test.toml"), "--out", str(folder / "here")]
    command += ["--listen", f"tls/{HERE}:{PORT}", "--keys", str(lab)]
    reached = f"tls/{HERE}:{PORT}"
    between = None
    if case == "restarted":
        between = router(line, lab)
        reached = f"tls/{THERE}:{ROUTER_PORT}"
        command += ["--router", reached]
    with (folder / "run.txt").open("w") as output:
        run = subprocess.Popen(command, stdout=output, stderr=output)
    wait_for(folder / "run.txt", "state: running", run)
    attend = [SHAKETWIN, "attend", "recorder", "--connect", reached, "--out", str(folder / "there")]
    attend += ["--keys", str(lab / "people" / "rec")]
    with (folder / "attend.txt").open("w") as output:
        far = line.start_far(*attend, stdout=output, stderr=output)
    wait_for(folder / "attend.txt", "recording", far)
    time.sleep(BEFORE_S)
    if between is not None:
        between.kill()
        between.wait()
        time.sleep(2.0)
        between = router(line, lab)
    else:
        CASES[case](line)
    codes = run.wait(180), far.wait(180)
    if between is not None:
        between.kill()
        between.wait()
    return figures(folder) | {"case": case, "exit": codes}


def wait_for(path: Path, words: str, process: "subprocess.Popen[Any]") -> None:
    """Return once these words are said."""
    end = time.monotonic() + 90
    while words not in path.read_text():
        if process.poll() is not None or time.monotonic() > end:
            raise SystemExit(f"{path.name}: {path.read_text()}")
        time.sleep(0.05)


def figures(folder: Path) -> dict[str, object]:
    """What the recordings here and there hold."""
    logs = [folder / place / "run.mcap" for place in ("here", "there")]
    here, remote = (
        Counter((m.topic, m.payload) for m in recover_log(log).messages) for log in logs
    )
    timing = json.loads((folder / "here" / "summary.json").read_text())["timing"]
    rig = timing["components"]["rig"]
    return {
        "missing": [read_recording(log).missing_samples for log in logs],
        "only here": sum((here - remote).values()),
        "only there": sum((remote - here).values()),
        "rig_ms": (rig["p50_ms"], rig["p99_ms"], rig["max_ms"]),
        "twin_ms": timing["latency_ms"]["p99"],
        "missed": timing["missed_deadlines"],
    }


def main() -> None:
    """All cases, or one; a line each."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--only", choices=CASES)
    parser.add_argument("--enclosed", action="store_true", help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if not asked.enclosed:
        only = ["--only", asked.only] if asked.only else []
        process = start_isolated("tests.studies.namespaces", "--enclosed", *only)
        assert process.stdout is not None
        for stdout in process.stdout:
            print(stdout, end="", flush=True)
        raise SystemExit(process.wait())
    with cable() as line:
        for case in [asked.only] if asked.only else CASES:
            with tempfile.TemporaryDirectory() as folder:
                print(json.dumps(play(case, line, Path(folder))), flush=True)


if __name__ == "__main__":
    main()
