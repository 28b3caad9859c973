"""What the UDP path does in real time: the figures of the documentation.

    python -m tests.studies.udp                 all of it, about five minutes
    python -m tests.studies.udp latency kills   some of it

latency: from a decision to the first changed sample, and how long the command took to arrive.
kills: a rig is killed in motion; how soon command and table rest, from the target's black box.
releases: the same in whole runs of a continuation, each within a release of an orbit; the command
    against its bound, and whether the recording is whole.
quickstart: a whole run through `shaketwin table`; lost samples, gaps, blocks on time.
target: the target is killed in a run; what the rig says, and whether the recording is whole.
"""

import json
import math
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from table_io.acquisition.output_queue import DECISION_S
from table_io.acquisition.session import SessionSetup, run_session
from table_io.backends.udp.backend import UdpBackend
from table_io.clock import RealClock
from table_io.config.base import PROFILES_DIR, load_config, parse_toml
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig
from table_io.records import Event
from tests.builders.flight_records import read_flight_record
from tests.builders.profiles import UNCHECKED, format_test
from tests.studies.held_orbits import PROFILE as HELD_PROFILE
from tests.table_io.backends.udp_bench import (
    SPECIMEN,
    card,
    compile_target,
    free_port,
    python_target,
    relay_packets,
)
from twin.live.process_config import request_realtime
from twin.setup.run_config import read_run_config

RATE_HZ = 2000.0
SHAKETWIN = str(Path(sys.executable).parent / "shaketwin")
DECISIONS, KILLS, RELEASE_KILLS = 400, 10, 6
PLATEAU_S = 3.0  # over which the command is that of a held orbit
STILL_M = 2e-4
TEST = format_test(1.0, 3.0, 0.5, tables=UNCHECKED)


def latency(folder: Path) -> None:
    """Decays of 4 s (8000 samples, 63 packets) decided at random times, each to be obeyed."""
    for side in ("python", "c"):
        for share in (0.0, 0.01):
            with ExitStack() as stack:
                if side == "python":
                    address = stack.enter_context(python_target(folder, ""))
                else:
                    address = ("127.0.0.1", free_port())
                    program = compile_target(folder)
                    command = [str(program), address[0], str(address[1])]
                    process = stack.enter_context(subprocess.Popen(command, stdout=-3))
                    stack.callback(process.terminate)
                if share:
                    address = stack.enter_context(relay_packets(address, 1, share)).address
                _decide(address, f"{side:6s} {100 * share:g} % of each evil")


def _decide(address: tuple[str, int], title: str) -> None:
    clock, chance = RealClock(), random.Random(1)
    request_realtime(50)  # as the rig is in a run
    backend = UdpBackend(parse_toml(card(address, ""), RigConfig, "card"), SPECIMEN, RATE_HZ, clock)
    for _ in range(100):  # a target that was just started
        try:
            backend.open()
            break
        except ValueError:
            time.sleep(0.05)
    backend.queue(0, np.zeros(2))
    backend.start()
    changed, handed, refused = [], [], 0
    for _ in range(DECISIONS):
        backend.read(20 * chance.randint(1, 4))
        decided = clock.now()
        while True:
            at = (
                backend._newest_sample()
                + 1
                + backend.replace_after
                + math.ceil(DECISION_S * RATE_HZ)
            )
            asked = clock.now()
            try:
                backend.queue(at, np.zeros(8000))
                break
            except ValueError:
                refused += 1
        handed.append(clock.now() - asked)
        changed.append(backend.scheduled_time_s(at) - decided)
    missed = backend._state.missed
    backend.close()
    ms = [1e3 * np.percentile(delays, (50, 99, 100)) for delays in (changed, handed)]
    print(
        f"latency {title}: decision to first changed sample p50 {ms[0][0]:.1f} p99 {ms[0][1]:.1f} "
        f"max {ms[0][2]:.1f} ms; 8000 samples handed over in p50 {ms[1][0]:.1f} p99 "
        f"{ms[1][1]:.1f} max {ms[1][2]:.1f} ms; refused {refused} of {DECISIONS}; {missed} packets "
        "missed by the target",
        flush=True,
    )


def drive(path: str, test: str) -> None:
    """A rig to be killed: says so once it has started."""
    rig = load_config(Path(path), RigConfig, "machine card")[0]
    profile = load_config(Path(test), Profile, "test profile")[0]
    backend = UdpBackend(rig, profile.specimen, RATE_HZ, RealClock())

    def describe(_: dict[str, float], epoch_s: float) -> Event:
        print("started", flush=True)
        return Event(0, "started", repr(epoch_s))

    request_realtime(50)
    for _ in run_session(SessionSetup(profile, rig), backend, RealClock(), describe, lambda: None):  # type: ignore[arg-type]
        pass


def kills(folder: Path) -> None:
    """Each rig is killed at a random time of its test, the next one waits for the rest."""
    test, chance, killed = folder / "test.toml", random.Random(2), []
    test.write_text(TEST)
    with python_target(folder, "", "--log", str(folder / "box")):
        for _ in range(KILLS):
            command = [
                sys.executable,
                "-m",
                "tests.studies.udp",
                "drive",
                str(folder / "card.toml"),
                str(test),
            ]
            with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as rig:
                assert rig.stdout is not None
                assert "started" in rig.stdout.readline()
                time.sleep(chance.uniform(2.0, 12.0))
                killed.append(time.monotonic())
                rig.kill()
        time.sleep(8.0)
    rests, peaks = [], []
    for at, life in zip(killed, read_flight_record(folder / "box"), strict=True):
        count = round((at - life.epoch_s) * RATE_HZ)
        drive, table = life.command_m, life.row("table_disp")
        rests.append((np.flatnonzero(np.abs(drive) > 1e-6)[-1] - count) / RATE_HZ)
        table_s = (np.flatnonzero(np.abs(table) > STILL_M)[-1] - count) / RATE_HZ
        peaks.append(np.abs(np.diff(drive, 2)).max() * RATE_HZ**2 / 9.80665)
        assert drive[-1] == 0.0, "the command rests at its mean"
        print(
            f"kills: command at rest {rests[-1]:.2f} s after, table within 0.2 mm {table_s:.2f} s"
        )
    print(f"kills: {KILLS}, the longest {max(rests):.2f} s; peak of the command {max(peaks):.4f} g")


# Read by every Python process of the run: its rig notes when a release begins.
RELEASE_HOOK = """
import sys
if "twin.live.processes" in sys.orig_argv and "rig" in sys.orig_argv:
    import table_io.sequencer.orbits as orbits
    advance_releases = orbits.advance_releases
    def note(state, block):
        after = advance_releases(state, block)
        if after.search.releases.is_released and not state.search.releases.is_released:
            with open({path!r}, "a") as file:
                print(block.end, file=file)
        return after
    orbits.advance_releases = note
"""


def releases(folder: Path) -> None:
    """Each rig is killed while the feedback of an orbit is released, pushed or caught again."""
    chance = random.Random(2)
    for number in range(RELEASE_KILLS):
        part = folder / str(number)
        part.mkdir()
        profile, released = part / "held.toml", part / "released"
        values = {"gap": 4.0, "kind": "continuation", "start": 2.75, "stop": 2.9, "level": 0.05}
        profile.write_text(HELD_PROFILE.format(rig="card.toml", points=2, extra="", **values))
        (part / "sitecustomize.py").write_text(RELEASE_HOOK.format(path=str(released)))
        search_path = f"{part}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"
        command = [SHAKETWIN, "run", str(profile), "--out", str(part / "out")]
        with (
            python_target(part, "", "--log", str(part / "box")),
            subprocess.Popen(command, stdout=-3, env={**os.environ, "PYTHONPATH": search_path})
            as run,
        ):  # fmt: skip
            ratio = find_bound_ratio(profile)
            due = chance.randint(1, 3)
            while not released.exists() or len(released.read_text().split()) < due:
                time.sleep(0.02)
                assert run.poll() is None, "the run has ended before the release"
            delay_s = chance.uniform(0.0, 1.2)
            time.sleep(delay_s)
            at = time.monotonic()
            os.kill(find_component(run.pid, "rig"), signal.SIGKILL)
            code = run.wait()
            time.sleep(3.0)
        (life,) = read_flight_record(part / "box")
        killed, drive = round((at - life.epoch_s) * RATE_HZ), life.command_m
        acceleration = np.diff(drive, 2) * RATE_HZ**2
        window = round(PLATEAU_S * RATE_HZ)
        power = np.convolve(acceleration**2, np.full(window, 1.0 / window), "valid")
        peak = np.abs(acceleration).max() / math.sqrt(2.0 * power.max())
        rest_s = (np.flatnonzero(np.abs(drive) > 1e-6)[-1] - killed) / RATE_HZ
        verify = [SHAKETWIN, "verify", str(part / "out" / "run.mcap")]
        verified = subprocess.run(verify, stdout=subprocess.PIPE, text=True, check=False)
        summary = json.loads((part / "out" / "summary.json").read_text())
        print(
            f"releases: {delay_s:.2f} s into release {due}, exit {code}: command at rest "
            f"{rest_s:.2f} s after, peak {peak:.3f} of the plateau, bound {ratio:.3f}; "
            f"{summary['verdict']}, gaps {summary['gaps']}; verify exit {verified.returncode}, "
            f"{'hash matches' if 'matches its hash' in verified.stdout else verified.stdout}",
            flush=True,
        )
        assert drive[-1] == 0.0, "the command rests at its mean"


def find_bound_ratio(profile: Path) -> float:
    """Return what `check` states: the largest acceleration of the command over the level."""
    config = read_run_config(profile)
    peak_m_s2 = max(row.acceleration_m_s2 for row in config.margins if row.step >= 0)
    return peak_m_s2 / config.profile.plan.level_m_s2


def find_component(run: int, component: str) -> int:
    """Return the process id of a component of a run."""
    pattern = ["pgrep", "-P", str(run), "-f", f"processes {component}"]
    return int(subprocess.run(pattern, capture_output=True, text=True, check=True).stdout)


def quickstart(folder: Path) -> None:
    """A whole run, in real time."""
    with python_target(folder, ""):
        _run(folder, "quickstart", lambda: None)


def target(folder: Path) -> None:
    """The target is killed 20 s into a run."""
    path = folder / "card.toml"
    path.write_text(card(("127.0.0.1", free_port()), ""))
    command = [SHAKETWIN, "table", "--rig", str(path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert "waiting at" in process.stdout.readline()

        def kill() -> None:
            time.sleep(20.0)
            process.kill()

        _run(folder, "target", kill)


def _run(folder: Path, title: str, meanwhile: Callable[[], None]) -> None:
    """`shaketwin run` of the quickstart on this card; what came of it."""
    out = folder / title
    profile = PROFILES_DIR / "tests" / "quickstart.toml"
    command = [
        SHAKETWIN,
        "run",
        str(profile),
        "--table",
        str(folder / "card.toml"),
        "--out",
        str(out),
    ]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        meanwhile()
        output = process.communicate()[0]
    summary = json.loads((out / "summary.json").read_text())
    verify = [SHAKETWIN, "verify", str(out / "run.mcap")]
    verified = subprocess.run(verify, stdout=subprocess.PIPE, text=True, check=False)
    print(f"{title}: exit {process.returncode}; {output.strip().splitlines()[-1]}")
    print(f"{title}: {summary['verdict']}, {summary.get('reason')}; gaps {summary['gaps']}")
    print(f"{title}: {json.dumps(summary['timing'])}")
    print(
        f"{title}: verify exit {verified.returncode}: {verified.stdout.strip()[:600]}", flush=True
    )


def main() -> None:
    if sys.argv[1:2] == ["drive"]:
        drive(*sys.argv[2:])
        return
    studies = {study.__name__: study for study in (latency, kills, releases, quickstart, target)}
    for name in sys.argv[1:] or studies:
        with tempfile.TemporaryDirectory() as folder:
            studies[name](Path(folder))


if __name__ == "__main__":
    main()
