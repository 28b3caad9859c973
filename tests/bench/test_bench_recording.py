"""What the recorder pays a block of 10 ms, and what an hour takes, beside HDF5 in the same run.

Both write the measured and the predicted samples of a real test, all channels, and hand them to the
disk each 0.15 s. HDF5 (gzip 4, shuffled: its usual small form; the extra `formats`) writes the
samples alone; the log also labels, comparisons, hash, checksums and an index, and survives a kill.

    pytest tests/bench/test_bench_recording.py -n 0 --benchmark-enable -s
"""

import time
from collections.abc import Callable
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from table_io.acquisition.session import run_session
from table_io.backends import open_backend
from table_io.block import Block
from table_io.clock import ManualClock
from table_io.config.base import PROFILES_DIR
from table_io.records import Comparison, RunStart
from twin.recording.mcap_log import LogWriter
from twin.setup.run_config import read_run_config
from twin.setup.unpaced import add_twin_items
from twin.transport.codec import Item, encode_item, topic_for

FLUSH_BLOCKS = 15
BLOCKS, MORE = 300, 5000  # from the start of a test; more with -n 0 --benchmark-enable
P99_RATIO, SIZE_RATIO = 0.5, 1.25  # of HDF5: the cost of a block at the most, the size at the most


def run_items(blocks: int) -> list[list[Item]]:
    """What a recorder hears with each block of a test on the simulated table; the start first."""
    of = read_run_config(PROFILES_DIR / "tests" / "quickstart.toml")
    backend = open_backend(of.rig, of.profile, ManualClock())
    source = run_session(
        of.session_setup,
        backend,
        ManualClock(),
        of.make_start_factory("bench", "table"),
        lambda: None,
    )
    turns: list[list[Item]] = [[]]
    for item in islice(add_twin_items(source, of.prepare_twin()), 3 * blocks):
        if isinstance(item, Block) and item.stream == "meas":
            turns.append([])
        if isinstance(item, (Block, Comparison, RunStart)):
            turns[-1].append(item)
    source.close()
    return turns[:-1]  # the last one may be cut short


def costs(turns: list[list[Item]], write: Callable[[int], None]) -> np.ndarray:
    """Seconds of each block's write, every 15th with a flush."""
    durations = []
    for number in range(len(turns)):
        begin = time.perf_counter()
        write(number)
        durations.append(time.perf_counter() - begin)
    return np.array(durations)


def ours(turns: list[list[Item]], path: Path) -> np.ndarray:
    payloads = [
        [(topic_for(item), encode_item(item, "bench"), item.index) for item in turn]
        for turn in turns
    ]
    writer = LogWriter(path, 2000.0)

    def write(number: int) -> None:
        for name, payload, index in payloads[number]:
            writer.write(name, payload, index)
        if number % FLUSH_BLOCKS == 0:
            writer.flush()

    durations = costs(turns, write)
    writer.close()
    return durations


def hdf5(turns: list[list[Item]], path: Path) -> np.ndarray:
    h5py = pytest.importorskip("h5py")
    blocks = [[item for item in turn if isinstance(item, Block)] for turn in turns[1:]]
    with h5py.File(path, "x", libver="latest") as file:
        sets = [
            file.create_dataset(
                block.stream, (len(block.channels), 0), maxshape=(len(block.channels), None),
                chunks=(1, 20 * FLUSH_BLOCKS), dtype="f8", compression=4, shuffle=True,
            )
            for block in blocks[0]
        ]  # fmt: skip

        def write(number: int) -> None:
            for data, block in zip(sets, blocks[number], strict=True):
                size = data.shape[1]
                data.resize(size + len(block), axis=1)
                data[:, size:] = block.values
            if number % FLUSH_BLOCKS == 0:
                file.flush()

        return costs(turns[1:], write)


def test_a_block_is_written_in_less_than_hdf5_takes(
    benchmark: BenchmarkFixture, tmp_path: Path
) -> None:
    turns = run_items(MORE if benchmark.enabled else BLOCKS)
    durations = benchmark.pedantic(ours, (turns, tmp_path / "a.mcap"), rounds=1)
    peer = hdf5(turns, tmp_path / "a.h5")
    hours = (len(turns) - 1) * 0.01 / 3600
    sizes = [(tmp_path / name).stat().st_size / hours / 1e9 for name in ("a.mcap", "a.h5")]
    raw = sum(item.values.nbytes for turn in turns for item in turn if isinstance(item, Block))
    benchmark.extra_info["over_hdf5_size"] = round(sizes[0] / sizes[1], 3)
    print()
    for name, some, size in (("log", durations, sizes[0]), ("HDF5", peer, sizes[1])):
        p50, p99 = np.quantile(some, (0.5, 0.99)) * 1e3
        print(f"{name:>5}: p50 {p50:.3f} ms, p99 {p99:.3f} ms, worst {some.max() * 1e3:.3f} ms a "
              f"block, {size:.2f} GB an hour")  # fmt: skip
    print(f"  the float64 samples alone, not packed: {raw / hours / 1e9:.2f} GB an hour")
    assert sizes[0] <= SIZE_RATIO * sizes[1]
    if benchmark.enabled:
        assert np.quantile(durations, 0.99) <= P99_RATIO * np.quantile(peer, 0.99)
