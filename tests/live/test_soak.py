"""Whatever happens to the rig, the machine comes to rest: proven from the machine's black box.

Renew the figures: pytest -m slow -s tests/live/test_soak.py
"""

import contextlib
import math
import os
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from table_io.backends import HEARTBEAT_TIMEOUT_S
from table_io.config.base import load_config, parse_toml
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig
from table_io.units import GRAVITY_M_S2
from tests.builders.flight_records import RecordedSession, read_flight_record
from tests.builders.profiles import UNCHECKED, format_test
from tests.builders.rigs import read_rig_text

SHAKETWIN = str(Path(sys.executable).parent / "shaketwin")
CONTROLLER = str(Path(__file__).with_name("controller.py"))
CARD = read_rig_text("machine")
A = 0.05 * GRAVITY_M_S2
PEAK_RATIO = 1.06  # of the level: a decay multiplies a blend that may itself be at 1.05
UPDATE = 10 ** (2.0 / 20)  # most that an amplitude update changes, maybe one not yet reported
STILL_M = 2e-4  # that a table at rest still moves, with a mass that swings on it
CLOSED, SILENT = "the connection closed", "no message from the controller"
# Each is done to the rig at a random time of its test, and the machine sees one of these. A process
# that dies on a busy computer may be silent for longer than its connection stays open.
LOSSES = {
    "kill -9": (CLOSED, SILENT),
    "terminate": (CLOSED, SILENT),
    "freeze": (SILENT,),
    "drop": (CLOSED, SILENT),
    "garbage": ("no controller says",),
    "long pause": (SILENT,),
    "short pause, kill -9": (CLOSED, SILENT),
}
ORDERS = ("interrupt", "stop", "abort")
FAULTS = (
    'kind = "dropped"\nfor_s = 0.05',
    'kind = "repeated"\nfor_s = 0.05',
    'kind = "replayed"\nfor_s = 0.05',
    'kind = "late"\nsize = 0.2',
    'kind = "stall"',
    'kind = "stuck"\nchannel = "table_acc_m_s2"',
    'kind = "cable_off"\nchannel = "table_disp_m"',
    'kind = "polarity"\nchannel = "table_acc_m_s2"',
    'kind = "rail"\nchannel = "force_r1_n"',
    'kind = "nan"\nchannel = "table_disp_m"',
    'kind = "power_loss"',
    'kind = "oil_loss"\nsize = 0.2',
)


@dataclass(frozen=True)
class Case:
    """What is done to a rig, and how long after its start, in s of the machine."""

    deed: str
    after_s: float
    pause_s: float


@dataclass
class Outcome:
    """What became of a case: when it was done, and what the rig said."""

    case: Case
    done_s: float  # on the machine's clock
    output: str


@dataclass
class Group:
    """A machine and the rigs that drive it one after another."""

    folder: Path
    cases: list[Case]
    pace: float = 1.0
    check: bool = False
    fault: str = ""
    outcomes: list[Outcome] = field(default_factory=list)

    def run(self) -> "Group":
        """Every case on one machine, which is switched off at the end."""
        self.folder.mkdir()
        text = CARD.replace("tcp/127.0.0.1:7450", f"unix/{self.folder / 'table'}")
        if self.fault:
            text += f"\n[[simulated.faults]]\nat_s = 2.5\n{self.fault}\n"
        (self.folder / "card.toml").write_text(text)
        (self.folder / "test.toml").write_text(
            format_test(2.0, 4.0, 0.5, tables={} if self.check else UNCHECKED)
        )
        command: list[str | Path] = [SHAKETWIN, "table", "--rig", self.folder / "card.toml"]
        command += ["--log", self.folder / "box", "--time-scale", str(self.pace)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as machine:
            assert machine.stdout is not None
            assert "waiting at" in machine.stdout.readline()
            try:
                self.outcomes = [self._one(case) for case in self.cases]
            finally:
                machine.terminate()
        assert machine.returncode == 0
        return self

    def _one(self, case: Case) -> Outcome:
        command: list[str | Path] = [sys.executable, CONTROLLER, self.folder / "card.toml"]
        command += [self.folder / "test.toml", str(self.pace)]
        pipe = subprocess.PIPE
        with subprocess.Popen(
            command, stdin=pipe, stdout=pipe, stderr=subprocess.STDOUT, text=True
        ) as rig:
            assert rig.stdout is not None
            first = rig.stdout.readline()
            assert first.startswith("started"), f"{first}{rig.stdout.read()} ({rig.wait()})"
            time.sleep(case.after_s / self.pace)
            done_s = self._do(case, rig)
            output, _ = rig.communicate()
        return Outcome(case, done_s, output)

    def _do(self, case: Case, rig: subprocess.Popen[str]) -> float:
        """Do it; the time on the machine's clock at which it was certainly done."""
        if case.deed.startswith("short pause"):
            self._pause(rig, case.pause_s * 0.5 * HEARTBEAT_TIMEOUT_S)
            time.sleep(0.3 / self.pace)
        if case.deed in ("freeze", "long pause"):
            rig.send_signal(signal.SIGSTOP)
        elif case.deed.endswith("kill -9"):
            rig.kill()
        elif case.deed == "terminate":
            rig.terminate()
        elif case.deed == "interrupt":
            rig.send_signal(signal.SIGINT)
        else:
            assert rig.stdin is not None
            with contextlib.suppress(BrokenPipeError):  # a fault of the machine has ended it
                os.write(rig.stdin.fileno(), case.deed.encode())
        done_s = time.monotonic() * self.pace
        if case.deed in ("freeze", "long pause"):
            time.sleep((2.0 + case.pause_s) * HEARTBEAT_TIMEOUT_S / self.pace)
            rig.send_signal(signal.SIGCONT if case.deed == "long pause" else signal.SIGKILL)
        return done_s

    def _pause(self, rig: subprocess.Popen[str], seconds: float) -> None:
        rig.send_signal(signal.SIGSTOP)
        time.sleep(seconds / self.pace)
        rig.send_signal(signal.SIGCONT)

    def lives(self) -> list[RecordedSession]:
        """The lives of the machine that began to play."""
        lives = read_flight_record(self.folder / "box")
        return [life for life in lives if not math.isnan(life.epoch_s)]


def longest_s(card: RigConfig, test: Profile) -> float:
    """Heartbeat time-out, queued time and decay, in s: by then a table without its rig rests."""
    block = test.acquisition.block_samples / test.acquisition.rate_hz
    queued = 2 * (card.output.lead_s + block)
    return HEARTBEAT_TIMEOUT_S + queued + max(2.0 / test.sweep.start_hz, 0.5)


def proven(group: Group, life: RecordedSession, outcome: Outcome) -> float:
    """Seconds of the machine from the deed to rest; AssertionError where the law is broken."""
    where = f"{group.folder.name} {outcome.case} {life.notes}\n{outcome.output}"
    card = parse_toml(CARD, RigConfig, "card")
    test = load_config(group.folder / "test.toml", Profile, "test profile")[0]
    command = life.command_m
    assert life.missing == 0, where
    corrections = [
        float(number) for number in re.findall(r"correction=([0-9.e+-]+)", outcome.output)
    ]
    most = PEAK_RATIO * A * (max([1.0, *corrections]) * UPDATE if group.check else 1.0)
    jumps = np.diff(np.concatenate([np.zeros(2), command, np.zeros(2)]), 2)
    assert np.abs(jumps).max() * life.rate_hz**2 <= most, where
    if "replayed" not in group.fault:
        assert np.abs(life.row("command_m") - command).max() <= 0.501 * card.output.lsb_m, where
    end = command.size
    assert np.ptp(life.row("table_disp")[-round(0.1 * life.rate_hz) :]) < STILL_M, where
    rest = int(np.flatnonzero(command)[-1]) + 1 if command.any() else 0
    assert rest < end, where
    assert life.notes[-1] == (end, "at rest"), where
    after_s = rest / life.rate_hz - (outcome.done_s - life.epoch_s)
    assert after_s <= longest_s(card, test), where
    return max(after_s, 0.0)


def check_told(life: RecordedSession, outcome: Outcome) -> None:
    """The machine knows how it lost its controller, or that it was given back."""
    why, where = life.notes[-2][1], f"{outcome.case} {life.notes}\n{outcome.output}"
    if outcome.case.deed in ORDERS or re.search(r"^over", outcome.output, re.MULTILINE):
        assert "released" in why or "lost" in why, where
    else:
        assert any(loss in why for loss in LOSSES[outcome.case.deed]), where


@pytest.mark.slow  # 10 s
def test_a_rig_that_dies_leaves_a_table_that_comes_to_rest(tmp_path: Path) -> None:
    """Three ways to die, one after another on one machine."""
    deeds = [("kill -9", 1.7), ("freeze", 1.3), ("long pause", 2.2)]
    cases = [Case(deed, after, 1.0) for deed, after in deeds]
    group = Group(tmp_path / "machine", cases, pace=2.0).run()
    lives = group.lives()
    assert len(lives) == len(cases)
    for life, outcome in zip(lives, group.outcomes, strict=True):
        proven(group, life, outcome)
        check_told(life, outcome)
        assert np.abs(life.command_m).max() > 1e-4  # it did move
    assert re.search(r"over \d+ halted", group.outcomes[2].output)  # it was told when it came back


def cases_of(seed: int, count: int, most_s: float) -> list[Case]:
    random = np.random.default_rng([4, seed])
    deeds = [*LOSSES, *ORDERS]
    return [
        Case(deeds[random.integers(len(deeds))], *random.uniform([0.0, 0.1], [most_s, 1.0]))
        for _ in range(count)
    ]


@pytest.mark.slow
def test_two_hundred_random_deaths(tmp_path: Path) -> None:
    """Twenty machines, twelve of them faulty, ten lives each; prints worst and median."""
    groups = [
        Group(
            tmp_path / f"machine{k}",
            cases_of(k, 10, 20.0 if k >= 16 else 8.0),
            pace=2.0,
            check=k >= 16,
            fault=FAULTS[k] if k < len(FAULTS) else "",
        )
        for k in range(20)
    ]
    with ThreadPoolExecutor(3) as pool:
        groups = list(pool.map(Group.run, groups))
    seconds: dict[str, list[float]] = {}
    samples, broken = 0, []
    for group in groups:
        lives = group.lives()
        assert len(lives) == len(group.cases)
        for life, outcome in zip(lives, group.outcomes, strict=True):
            samples += life.samples.shape[1]
            try:
                seconds.setdefault(outcome.case.deed, []).append(proven(group, life, outcome))
                if not group.fault:
                    check_told(life, outcome)
            except AssertionError as error:
                broken.append(str(error))
    ends = Counter(end(outcome) for group in groups for outcome in group.outcomes)
    every = np.concatenate([np.array(values) for values in seconds.values()])
    print(f"\n{every.size} deaths, {samples} samples, {len(broken)} that broke the law")
    moved = every[every > 0.0]
    print(f"{moved.size} tables in motion: median {np.median(moved):.2f} s to rest, worst", end=" ")
    print(f"{moved.max():.2f} s")
    for deed, of in seconds.items():
        print(f"  {deed:22} {len(of):4}  worst {max(of):.2f} s")
    print(f"what the rigs said last: {dict(ends)}")
    assert not broken, "\n\n".join(broken)
    assert every.size == 200


def end(outcome: Outcome) -> str:
    """How a rig ended: its verdict, an error, or without a word."""
    over = re.search(r"^over \d+ (\w+)", outcome.output, re.MULTILINE)
    last = outcome.output.strip().rpartition("\n")[2]
    error = re.match(r"(?:[\w.]+\.)?(\w+(?:Error|Lost|Interrupt))\b", last)
    return over[1] if over else error[1] if error else "nothing"
