"""How much a killed recorder loses: many of them on one live bus, killed at random times.

    python -m tests.studies.killed_recorders --kills 1000 --out study.jsonl

A rig publishes whole runs in real time; to each of several chains of recorders it is a run of its
own to record. A recorder is killed (SIGKILL) at a random time, some are stalled for 3 s before
(SIGSTOP), and a successor takes over, as the supervisor has it. At the end of a run the parts of
each chain are merged. The bus holds less than in a real run (25 s of blocks instead of 50), so that
what only an early part holds is tried too; and only measured blocks travel, so that a machine can
feed many recorders. A line a run is appended to --out; the study goes on where it was, until it has
as many kills as asked for.
"""

import argparse
import json
import math
import os
import random
import signal
import socket
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from table_io.block import Block
from table_io.config.base import PROFILES_DIR
from table_io.errors import InputError
from table_io.records import RunStop, Timing
from twin.live.process_config import ProcessConfig, is_orphaned
from twin.live.recorder import run_recorder
from twin.recording.mcap_log import iter_messages
from twin.recording.merge import merge, verify_log
from twin.recording.recovery import recover_log
from twin.setup.run_config import RunConfig, read_run_config
from twin.transport import history_cache
from twin.transport.codec import Item, encode_item, topic_for
from twin.transport.endpoint import MEAS_TOPIC

RUN_S = 60.0
HELD_BLOCKS = 2500  # blocks
BLOCK_S, SIZE = 0.01, 20
MEAN_LIFE_S = 2.5
STALL_S = 3.0
TIMED_S = 0.005  # within which a death has to be known to be timed
STALLED_SHARE = 0.15  # of the recorders, once
NEVER = float("inf")
Pipe = tuple[int, int]  # its end tells the children that the study is gone


@dataclass(slots=True)
class Chain:
    """A recorder and its successors; `killed` is (part, birth, awake since, death), times in s."""

    folder: Path
    spec: ProcessConfig
    pid: int = 0
    born: float = 0.0
    awake: float = 0.0
    die: float = 0.0
    stop: float = NEVER
    resume: float = NEVER
    stalls: int = 0
    parts: list[Path] = field(default_factory=list)
    killed: list[tuple[Path, float, float, float]] = field(default_factory=list)

    def begin(self, chance: random.Random, pipe: Pipe) -> None:
        """Fork a recorder and decide when it dies."""
        part = self.folder / f"part-{len(self.parts) + 1:03d}.mcap"
        self.parts.append(part)
        self.pid = fork_child(lambda: run_recorder(self.spec, str(part)), pipe, self.folder / "log")
        self.born = self.awake = time.time()
        self.die = self.born + chance.expovariate(1 / MEAN_LIFE_S)
        if chance.random() < STALLED_SHARE:
            self.stop = chance.uniform(self.born, self.die)
            self.die += STALL_S

    def turn(self, now_s: float, chance: random.Random, pipe: Pipe) -> None:
        """Let it stall, go on or die, where it is time."""
        if now_s > self.stop:
            os.kill(self.pid, signal.SIGSTOP)
            self.stalls += 1
            self.stop, self.resume = NEVER, now_s + STALL_S
        if now_s > self.resume:
            os.kill(self.pid, signal.SIGCONT)
            self.resume, self.awake = NEVER, now_s
        if now_s > self.die:
            before = time.time()
            os.kill(self.pid, signal.SIGKILL)
            died = time.time()  # or some time before, where this process had to wait meanwhile
            known = died if died - before < TIMED_S else float("nan")
            self.killed.append((self.parts[-1], self.born, self.awake, known))
            os.waitpid(self.pid, 0)
            self.stop = self.resume = NEVER
            self.begin(chance, pipe)


def fork_child(work, pipe: Pipe, log: Path) -> int:
    """Id of a child that does `work`; nothing is imported anew, so that a thousand are cheap."""
    pid = os.fork()
    if pid:
        return pid
    code = 1
    try:
        os.dup2(pipe[0], 0)
        os.close(pipe[1])
        out = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(out, 1)
        os.dup2(out, 2)
        sys.stdin = open(0, closefd=False)  # noqa: SIM115
        work()
        code = 0
    finally:
        os._exit(code)


def run_items(bundle: RunConfig, run: str) -> list[list[tuple[str, bytes]]]:
    """What the rig publishes, one list a block."""
    start = bundle.make_start_factory(run, "table")({}, 0.0)
    chance = np.random.default_rng(1)
    turns: list[list[Item]] = [[start]]
    for number in range(round(RUN_S / BLOCK_S)):
        index = number * SIZE
        labels = [np.zeros(SIZE, np.int64)] * 3
        rate = start.rate_hz
        measured = chance.standard_normal((len(start.channels), SIZE))
        turns.append([Block("meas", index, rate, start.channels, measured, *labels)])
    end = len(turns) * SIZE - SIZE
    last = Timing(end, "twin", 0.0, 0.0, 0.0, 0, 0, 0.0, "")
    turns.append([RunStop(end, "complete", "all played", ()), last])
    return [[(topic_for(item), encode_item(item, run)) for item in turn] for turn in turns]


def publish(turns: list[list[tuple[str, bytes]]], endpoint: str, rig: str, times: Path) -> None:
    """The rig: a block each 10 ms, then whatever is still asked for."""
    from twin.transport.zenoh_link import open_hub

    history_cache.MAX_CACHED_FRAGMENTS = HELD_BLOCKS
    link = open_hub(rig, endpoint)
    link.declare(tuple({name for turn in turns for name, _ in turn}))
    begin = time.monotonic() + 2.0
    when = []
    for number, turn in enumerate(turns):
        while time.monotonic() < begin + number * BLOCK_S:
            link.serve()
            time.sleep(0.0005)
        for name, payload in turn:
            link.publish(name, payload)
        when.append(time.time())
    np.save(times, np.array(when))
    while not is_orphaned():
        link.serve()
        time.sleep(0.0005)


def judge_parts(chain: Chain, times: np.ndarray) -> dict[str, list[float]]:
    """Of each killed part: s from its last message to the death, and whether it has holes.

    The bus brings a message each few ms, so this is what a recorder had taken in and not flushed.
    At its beginning a part may have holes: what the bus forgets while it is asked stands in the
    part before it.
    """
    lost, empty, holes, unreadable = [], 0, 0, 0
    for part, born, awake, died in chain.killed:
        messages = list(iter_messages(part)) if part.exists() else []
        if not messages:  # it died before anything had come
            empty += 1
            continue
        if not math.isnan(died):
            lost.append(died - max(awake, messages[-1].publish_time / 1e9))
        blocks = [message.log_time for message in messages if message.topic == MEAS_TOPIC]
        numbers = [round(at / 1e9 / BLOCK_S) for at in blocks]
        own = [number for number in numbers if times[number + 1] > born]
        holes += own != list(range(own[0], own[-1] + 1)) if own else 0
        unreadable += not readable(part)
    return {"lost_s": lost, "empty": [empty], "holes": [holes], "unreadable": [unreadable]}


def readable(part: Path) -> bool:
    """True where a log of a killed recorder is read as one that was cut off."""
    try:
        return not recover_log(part).is_intact
    except InputError:
        return False


def one_run(number: int, chains: int, bundle: RunConfig, folder: Path) -> dict[str, object]:
    """A run with its kills; what was lost."""
    chance = random.Random(number)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    texts = (bundle.profile_toml, bundle.rig_toml, bundle.model_toml)
    spec = ProcessConfig(f"kill-{number}", bundle.name, str(folder), "", *texts, endpoint=endpoint)
    ProcessConfig.make_run_config = lambda _: bundle  # type: ignore[method-assign, assignment]
    turns = run_items(bundle, spec.run)
    pipe = os.pipe()
    times = folder / "times.npy"
    rig = fork_child(
        lambda: publish(turns, endpoint, bundle.rig.name, times), pipe, folder / "rig.log"
    )
    time.sleep(0.5)
    lines = [Chain(folder / f"chain-{k}", spec) for k in range(chains)]
    for chain in lines:
        chain.folder.mkdir()
        chain.begin(chance, pipe)
    end = time.time() + RUN_S + 1.5
    while (now_s := time.time()) < end:
        for chain in lines:
            chain.turn(now_s, chance, pipe)
        time.sleep(0.002)
    for chain in lines:
        os.kill(chain.pid, signal.SIGCONT)
        os.waitpid(chain.pid, 0)
    os.kill(rig, signal.SIGKILL)
    os.waitpid(rig, 0)
    os.close(pipe[0])
    os.close(pipe[1])
    return summarise_run(lines, np.load(times), len(turns) - 2)


def summarise_run(lines: list[Chain], times: np.ndarray, blocks: int) -> dict[str, object]:
    """The line of a run for the file."""
    judgements = [judge_parts(chain, times) for chain in lines]
    after = []
    for chain in lines:
        whole = chain.folder / "whole.mcap"
        merge([part for part in chain.parts if part.exists()], whole)
        stamps = {
            message.log_time for message in iter_messages(whole) if message.topic == MEAS_TOPIC
        }
        after.append(blocks - len(stamps) if verify_log(whole) else blocks)
    line: dict[str, object] = {
        key: [value for judgement in judgements for value in judgement[key]]
        for key in judgements[0]
    }
    kills = sum(len(chain.killed) for chain in lines)
    return line | {
        "kills": kills,
        "stalls": sum(chain.stalls for chain in lines),
        "missing_after": after,
    }


def summary(lines: list[dict]) -> str:
    """The figures of all runs so far."""
    lost = np.array([value for line in lines for value in line["lost_s"]])
    return (
        f"{sum(line['kills'] for line in lines)} kills, {sum(line['stalls'] for line in lines)} "
        f"stalls of {STALL_S:g} s in {len(lines)} runs, "
        f"{sum(sum(line['empty']) for line in lines)} before anything had come\n"
        f"taken in and not flushed, {lost.size} timed: p50 {np.median(lost):.3f} s, "
        f"p99 {np.quantile(lost, 0.99):.3f} s, most {lost.max():.3f} s, "
        f"over 0.25 s: {(lost > 0.25).sum()}\n"
        f"parts with holes: {sum(sum(line['holes']) for line in lines)}, "
        f"not readable: {sum(sum(line['unreadable']) for line in lines)}\n"
        f"blocks missing after recovery and merging: "
        f"{sum(sum(line['missing_after']) for line in lines)}"
    )


def main() -> None:
    """Run until there are enough kills; print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--kills", type=int, default=1000)
    parser.add_argument("--chains", type=int, default=5)
    parser.add_argument("--out", type=Path, default=Path("kill_study.jsonl"))
    asked = parser.parse_args()
    bundle = read_run_config(PROFILES_DIR / "tests" / "quickstart.toml")
    before = asked.out.read_text().splitlines() if asked.out.exists() else []
    lines = [json.loads(line) for line in before]
    while sum(line["kills"] for line in lines) < asked.kills:
        with tempfile.TemporaryDirectory() as folder:
            lines.append(one_run(len(lines), asked.chains, bundle, Path(folder)))
        with asked.out.open("a") as out:
            print(json.dumps(lines[-1]), file=out)
        print(summary(lines), flush=True)


if __name__ == "__main__":
    main()
