"""Speed of a replay, in CPU time beside real time and beside reading by mcap and protobuf alone.

pytest tests/bench/test_bench_replay.py -n 0 --benchmark-enable -s
"""

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from table_io.config.folders import find_config
from twin.log import open_log
from twin.replay.pipeline_replay import RecordedRun, replay_recording
from twin.setup.run_config import RunConfig, read_run_config
from twin.setup.unpaced import play_unpaced
from twin.transport import shaketwin_pb2 as pb

LEAST_TIMES_REAL_TIME = 20  # far below what was measured; the ratios are judged by ratios.py


@pytest.fixture(scope="module")
def bundle(request: pytest.FixtureRequest, bundle: RunConfig) -> RunConfig:
    """A whole test to measure with; where nothing is measured, the short one of other tests."""
    if not request.config.getoption("benchmark_enable"):
        return bundle
    return read_run_config(find_config("quickstart", "tests"))


@pytest.fixture(scope="module")
def log(bundle: RunConfig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bench") / "run.mcap"
    play_unpaced(bundle, "bench", path, lambda: None, lambda _: None)
    return path


def read_by_protobuf(log: Path) -> int:
    """Every message read by the library of the container, parsed, and its values counted.

    None of our own code takes part, so that the ratios to it show what our code costs.
    """
    count = 0
    kinds: dict[str, Any] = {
        "/rig/meas": pb.Block,
        "/twin/pred": pb.Block,
        "/twin/cmp": pb.Comparison,
    }
    with log.open("rb") as file:
        for _, channel, logged in make_reader(file).iter_messages(list(kinds)):
            message = kinds[channel.topic].FromString(logged.data)
            if isinstance(message, pb.Block):
                count += np.frombuffer(message.values).size
    return count


def cpu_s(work, *given: object) -> float:
    begin = time.process_time()
    work(*given)
    return time.process_time() - begin


@pytest.mark.benchmark(group="replay")
def test_replay_beside_reading(benchmark, bundle: RunConfig, log: Path, tmp_path: Path) -> None:
    """Opening, twin, comparison and writing, against parsing the recording and nothing more."""
    number = 0

    def replay_and_compare() -> None:
        nonlocal number
        number += 1
        recorded = RecordedRun.open(log)
        made = tmp_path / f"{number}.mcap"
        assert replay_recording(recorded, bundle, made, "again", lambda _: None).is_identical

    benchmark.pedantic(cpu_s, (replay_and_compare,), rounds=3)
    if benchmark.stats is None:
        return
    ours = min(cpu_s(replay_and_compare) for _ in range(3))
    reading = min(cpu_s(read_by_protobuf, log) for _ in range(3))
    stop = open_log(log).stop
    assert stop is not None
    seconds = stop.index / bundle.drive.rate_hz
    benchmark.extra_info["times_real_time"] = round(seconds / ours)
    benchmark.extra_info["over_reading"] = round(ours / reading, 3)
    print(f"\nreplay {seconds / ours:.0f} times real time, {ours / reading:.2f} times reading")
    assert seconds >= LEAST_TIMES_REAL_TIME * ours


@pytest.mark.benchmark(group="replay")
def test_one_channel_of_a_log(benchmark, log: Path) -> None:
    """The first look at a channel through the Python door, file and all."""

    def open_and_read() -> None:
        assert open_log(log)["mass_disp_m"].size

    benchmark.pedantic(open_and_read, rounds=3)
    if benchmark.stats is None:
        return
    ours = min(cpu_s(open_and_read) for _ in range(3))
    reading = min(cpu_s(read_by_protobuf, log) for _ in range(3))
    benchmark.extra_info["over_reading"] = round(ours / reading, 2)
    print(f"\none channel {ours / reading:.2f} times reading")
