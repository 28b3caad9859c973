"""Figures of the NI path, through NI's client and a server process with the simulated table.

    python -m tests.studies.ni soak 10 1       ten minutes in real time
    python -m tests.studies.ni soak 60 10      an hour, ten times as fast as the clock
    python -m tests.studies.ni hours 1         on a clock that jumps
    python -m tests.studies.ni decisions 250   from a decision to the first changed sample
    python -m tests.studies.ni server          the server killed in a run
    python -m tests.studies.ni rig             the rig killed in a run

`ni_error_codes.py` reports every error that the driver has a code for.
"""

import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from table_io.acquisition.session import LatenessLog, SessionSetup, run_session
from table_io.backends.command_buffer import CommandBuffer
from table_io.backends.ni.backend import NiBackend
from table_io.backends.ni.config import NiWiring
from table_io.block import Block, Float1D, Float2D
from table_io.clock import Clock, RealClock
from table_io.config.base import PROFILES_DIR, parse_toml
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig
from table_io.excitation.trajectory import plan_sweep
from table_io.records import RunStart, RunStop, SampleGap
from tests.builders.flight_records import read_flight_record
from tests.table_io.backends.ni_wire import CARD, SPECIMEN, Bed

SHAKETWIN = str(Path(sys.executable).parent / "shaketwin")
NOTHING = RunStart(0, "", "", "table", "", "", "", 2e3, 20, (), (), 0, {}, {}, "", "", 0.0)


@contextmanager
def serve_table(
    folder: Path, pace: float = 1.0
) -> Iterator[tuple[Path, RigConfig, subprocess.Popen[str]]]:
    """(card, rig, process) of a server on a free port; its black box is folder/box."""
    text = CARD.replace("127.0.0.1:7470", free_address())
    card = folder / "ni_study.toml"
    card.write_text(text)
    command: list[str | Path] = [SHAKETWIN, "table", "--rig", card, "--time-scale", f"{pace:g}"]
    command += ["--log", folder / "box"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert "waiting at" in process.stdout.readline()
        try:
            yield card, parse_toml(text, RigConfig, "card"), process
        finally:
            process.terminate()


def free_address() -> str:
    """HOST:PORT on this computer where nobody listens."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return f"127.0.0.1:{free.getsockname()[1]}"


class Watched(NiBackend):
    """Compares the command that is acquired back with what was queued, sample by sample."""

    def __init__(self, rig: RigConfig, clock: Clock, channel: Any = None) -> None:
        super().__init__(rig, SPECIMEN, 2000.0, clock, channel)
        self.commands = CommandBuffer()
        self.samples = self.wrong = 0
        self._step_v = 2 * rig.output.span_v / 2**rig.output.bits

    def queue(self, index: int, volts: Float1D) -> None:
        super().queue(index, volts)
        self.commands.replace_from(index, volts)

    def read(self, samples: int) -> Float2D:
        volts = super().read(samples)
        expected = self.commands.values(self.samples, self.samples + samples)
        self.wrong += int((np.abs(volts[0] - expected) > self._step_v).sum())
        self.samples += samples
        self.commands.discard_before(self.samples - 3)
        return volts


def soak(minutes: float, pace: float) -> None:
    """A long session: lost samples, wrong samples of the command, lag of the table's answer."""
    text = (PROFILES_DIR / "tests" / "quickstart.toml").read_text()
    text += f"\n[acquisition]\nblock_samples = {20 if pace == 1.0 else 100}\n"
    for cycles in range(5, 10000):
        profile = parse_toml(text.replace("cycles = 5", f"cycles = {cycles}", 1), Profile, "soak")
        if plan_sweep(profile).planned_end >= minutes * 60.0 * 2000.0:
            break
    with (
        tempfile.TemporaryDirectory() as folder,
        serve_table(Path(folder), pace) as (_, rig, _process),
    ):
        clock, late = RealClock(pace), LatenessLog()
        backend = Watched(rig, clock)
        steps = profile.sweep.steps
        ends: dict[int, list[Float2D]] = {0: [], steps[-1].index: []}
        gaps, stop = 0, None
        for session in run_session(
            SessionSetup(profile, rig), backend, clock, lambda tare, at: NOTHING, lambda: None, late
        ):
            gaps += isinstance(session, SampleGap)
            stop = session if isinstance(session, RunStop) else stop
            if isinstance(session, Block):
                for index, blocks in ends.items():
                    if (session.step == index).all():
                        blocks.append(session.values[:2])
        lags = [
            lag(np.concatenate(blocks, axis=1), steps[index].frequency_hz, 2000.0)
            if blocks
            else np.nan
            for index, blocks in ends.items()
        ]
    assert stop is not None
    ms = np.array(late.late_s) * 1e3 / pace
    print(
        f"soak: {stop.index / 2000 / 60:.1f} min at {pace:g} x: {stop.verdict} ({stop.reason}), "
        f"{gaps} gaps, {backend.wrong} of {backend.samples} samples of the command are not what "
        "was queued; "
        f"table behind command by {lags[0]:.3f} samples in the first step, {lags[1]:.3f} in the "
        f"last, both at {steps[0].frequency_hz} Hz; blocks late by p50 {np.median(ms):.2f} ms, "
        f"p99 {np.quantile(ms, 0.99):.2f}, max {ms.max():.1f} (of real time)",
        flush=True,
    )


def lag(values: Float2D, frequency_hz: float, rate_hz: float) -> float:
    """Samples by which the second line runs behind the first, by the phase of the fundamental."""
    per_cycle = rate_hz / frequency_hz
    settled = values[:, values.shape[1] // 2 :]
    count = round(int(settled.shape[1] / per_cycle) * per_cycle)
    turn = np.exp(-2j * np.pi * np.arange(count) / per_cycle)
    command, table = (settled[:, :count] - settled[:, :count].mean(axis=1)[:, None]) @ turn
    return float(-np.angle(table / command) / (2 * np.pi) * per_cycle)


def hours(count: float) -> None:
    """A long life on a clock that jumps, client and device in one process."""
    bed = Bed()
    backend = Watched(bed.rig, bed.clock, bed.wire)
    backend.open()
    backend.queue(0, swing(0, 12000))
    backend.start()
    lost = 0
    while backend.samples < count * 7.2e6:
        lost += int(np.isnan(backend.read(2000)).any(axis=0).sum())
        first = backend.samples + 4000
        backend.queue(first, swing(first, 8000))
    print(f"{count:g} h: {lost} samples lost, {backend.wrong} of {backend.samples} wrong")


def decisions(count: int) -> None:
    """From a decision to the first changed sample of the output, as it is acquired back."""
    with tempfile.TemporaryDirectory() as folder, serve_table(Path(folder)) as (_, rig, _process):
        clock, chance = RealClock(), np.random.default_rng(1)
        backend = Watched(rig, clock)
        backend.open()
        rate, reached, room = 2000.0, 0, backend.replace_after + 10
        backend.queue(0, swing(0, 12000))
        backend.start()
        seconds, refused = [], 0
        for stop in range(2 * count):
            for _ in range(int(chance.integers(10, 20))):
                backend.read(20)
            clock.wait_until(clock.now() + chance.uniform(0.0, 0.01))
            decided = clock.now()
            while True:
                reached = int((clock.now() - backend.scheduled_time_s(0)) * rate) + 1
                first = max(reached, backend.samples) + room
                ramp = 1.0 if stop % 2 else -1.0  # away, and back: every other one is a stop
                try:
                    backend.queue(first, swing(first, 11000) + 0.05 * ramp)
                    break
                except ValueError:
                    refused += 1
            seconds.append(backend.scheduled_time_s(first) - decided)
        ms = np.array(seconds) * 1e3
        backend.read(200)
        wrong = backend.wrong
        backend.queue(backend.samples + 400, np.zeros(2))
        backend.close()
        wiring = rig.get_section(NiWiring)
        assert wiring is not None
        print(
            f"decisions: {ms.size}: p50 {np.median(ms):.1f} ms, p99 {np.quantile(ms, 0.99):.1f}, "
            f"max {ms.max():.1f}, of which {wiring.held_by_device_ms:g} ms lie in the device; "
            f"{refused} came too late and were tried again; {wrong} of {backend.samples} samples "
            "acquired back are not what was queued"
        )


def swing(first: int, count: int) -> Float1D:
    """A slow motion in V, (count,), from sample `first` on, at rest in its mean at the end."""
    at = np.arange(first, first + count)
    return 0.5 * np.sin(2 * np.pi * 0.5 * at / 2000.0)


def kill_mid_run(whom: str) -> None:
    """A run whose server or rig is killed in motion."""
    with tempfile.TemporaryDirectory() as name, serve_table(Path(name)) as (card, _, server):
        folder = Path(name)
        command: list[str | Path] = [
            SHAKETWIN,
            "run",
            PROFILES_DIR / "tests" / "quickstart.toml",
            "--table",
            card,
        ]
        command += ["--out", folder / "out", "--listen", f"tcp/{free_address()}"]
        with subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=subprocess.STDOUT, start_new_session=True
        ) as run:
            clock = RealClock()
            assert server.stdout is not None
            drives = (line for line in server.stdout if "drives" in line)
            next(drives)  # the rehearsal
            next(drives)
            clock.wait_until(clock.now() + 21.3)
            at = clock.now()
            if whom == "server":
                server.kill()
                print(f"server killed: run ends with code {run.wait(60)}")
                completed = subprocess.run(
                    [SHAKETWIN, "verify", folder / "out" / "run.mcap"],
                    capture_output=True, text=True, check=False,
                )  # fmt: skip
                summary = json.loads((folder / "out" / "summary.json").read_text())
                print({key: summary[key] for key in ("verdict", "reason", "gaps")})
                print(f"verify: code {completed.returncode}: {completed.stdout.split()[-1]}")
            else:
                theirs = Path(f"/proc/{run.pid}/task/{run.pid}/children").read_text().split()
                for number in (run.pid, *map(int, theirs)):
                    os.kill(number, signal.SIGKILL)
                clock.wait_until(clock.now() + 12.0)
                report(read_flight_record(folder / "box")[-1], at)


def report(life: Any, at_s: float) -> None:
    """How a life went on after `at_s`, by the black box."""
    table, command = life.row("table_disp"), life.row("command_m")
    kill = round((at_s - life.epoch_s) * life.rate_hz)
    moving = np.flatnonzero(np.abs(table) > 5e-5)
    driven = np.flatnonzero(np.abs(command) > 1e-6)
    print(
        f"killed at sample {kill} of {table.size}: command at rest "
        f"{(driven[-1] - kill) / 2e3:.2f} s later, table {(moving[-1] - kill) / 2e3:.2f} s later, "
        f"at {table[-1] * 1e3:.4f} mm; "
        f"largest acceleration of the table afterwards "
        f"{np.abs(life.row('table_acc')[kill:]).max() / 9.80665:.4f} g; {life.notes}"
    )


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["soak", minutes, pace]:
            soak(float(minutes), float(pace))
        case ["hours", count]:
            hours(float(count))
        case ["decisions", count]:
            decisions(int(count))
        case ["server" | "rig" as whom]:
            kill_mid_run(whom)
        case _:
            print(__doc__)
