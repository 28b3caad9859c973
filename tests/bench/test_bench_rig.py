"""What a block of 10 ms costs on its way: the simulated table, the twin beside it, the encoder.

Run with: pytest tests/bench/test_bench_rig.py -n 0 --benchmark-enable
"""

from itertools import cycle

import numpy as np
from pytest_benchmark.fixture import BenchmarkFixture

from table_io.acquisition.session import run_session
from table_io.backends import open_backend
from table_io.block import Block
from table_io.clock import ManualClock
from table_io.config.base import PROFILES_DIR
from twin.compare import TWIN_CHANNELS, pipeline
from twin.setup.run_config import RunConfig, read_run_config
from twin.transport.codec import decode_item, encode_item, topic_for


def bundle() -> RunConfig:
    return read_run_config(PROFILES_DIR / "tests" / "quickstart.toml")


def blocks(of: RunConfig, count: int) -> list[Block]:
    """The first measured blocks of a test on the simulated table."""
    backend = open_backend(of.rig, of.profile, ManualClock())
    source = run_session(
        of.session_setup,
        backend,
        ManualClock(),
        of.make_start_factory("bench", "table"),
        lambda: None,
    )
    drained: list[Block] = []
    for item in source:
        if isinstance(item, Block):
            drained.append(item)
        if len(drained) == count:
            break
    source.close()
    return drained


def test_the_simulated_table_reads_a_block(benchmark: BenchmarkFixture) -> None:
    of = bundle()
    backend = open_backend(of.rig, of.profile, ManualClock())
    backend.open()
    backend.queue(0, np.zeros(4))
    backend.start()
    assert benchmark(backend.read, 20).shape == (len(of.rig.channels), 20)


def test_the_twin_steps_a_block(benchmark: BenchmarkFixture) -> None:
    of = bundle()
    setup = of.prepare_twin()
    state, _ = pipeline.start_pipeline(setup)
    for block in blocks(of, 200):
        state, _ = pipeline.step(setup, state, block)
    (following,) = (block for block in blocks(of, 201) if block.index == state.twins.index)
    _, items = benchmark(pipeline.step, setup, state, following)
    assert isinstance(items[0], Block)
    assert items[0].channels == TWIN_CHANNELS


def test_a_block_goes_through_the_encoder_and_back(benchmark: BenchmarkFixture) -> None:
    some = cycle(blocks(bundle(), 50))

    def there_and_back() -> tuple[Block, object]:
        block = next(some)
        return block, decode_item(topic_for(block), encode_item(block, "bench"))[1]

    sent, got = benchmark(there_and_back)
    assert isinstance(got, Block)
    assert sent.is_identical(got)
