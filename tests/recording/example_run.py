"""A small run as it is written: every kind of item, some samples lost."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from table_io.block import Block
from table_io.records import Comparison, Event, RunStart, RunStop, SampleGap, Step, Timing
from twin.recording.mcap_log import LogWriter
from twin.transport.codec import Item, encode_item, topic_for

RATE_HZ = 2000.0
BLOCK_SAMPLES = 20
BLOCK_COUNT = 30
START = RunStart(
    index=0, run="2026-run", name="log", source="table", profile_toml='title = "größe"\n',
    rig_toml="r = 1\n", model_toml="m = 1\n", rate_hz=RATE_HZ, block_samples=BLOCK_SAMPLES,
    channels=("drive_disp_m", "table_disp_m"), steps=(Step(0, "forward", 2.0, 0.49),),
    planned_samples=BLOCK_COUNT * BLOCK_SAMPLES, tare={"table_disp_m": 1e-4},
    versions={"shaketwin": "0.1.0"},
    host="here", started_at="2026-11-21T04:00:00+00:00", epoch_s=12.5,
)  # fmt: skip


def block(index: int, stream: str = "meas", samples: int = BLOCK_SAMPLES) -> Block:
    """A block whose samples depend on nothing but their index; some are lost."""
    at = np.arange(index, index + samples)
    values = np.array([np.sin(at / 7.0), np.cos(at / 9.0)])
    values[1, at % 41 == 0] = np.nan
    return Block(stream, index, RATE_HZ, START.channels, values, at // 100, at % 5, at % 3)


def run(missing: frozenset[int] = frozenset()) -> list[Item]:
    """A whole run as it is published; blocks with these numbers are missing."""
    items: list[Item] = [START]
    for number in set(range(BLOCK_COUNT)) - missing:
        index = number * BLOCK_SAMPLES
        items += [block(index), block(index, "pred")]
        sums = (float(number), -0.0)
        items.append(Comparison(index, BLOCK_SAMPLES, START.channels, sums, sums, (np.nan, 0.1)))
        if number % 10 == 3:  # several items of one kind at one sample: nothing else orders them
            items += [Event(index, "jump", "up"), Event(index, "trip", "b"), Event(index, "a", "c")]
            items += [SampleGap(index, 1, name, "lost") for name in reversed(START.channels)]
            items.append(Timing(index, "rig", 0.1, 0.2, 0.3, 0, number, 0.5, "fifo"))
    end = BLOCK_COUNT * BLOCK_SAMPLES
    return [*items, Event(end, "end", "done"), RunStop(end, "complete", "all played", ("idle",))]


def payloads(items: Iterable[Item]) -> list[bytes]:
    return [encode_item(item, START.run) for item in items]


def write(path: Path, items: list[Item], flush_every: int = 0, close: bool = True) -> list[int]:
    """A log of the items; returns the size of the file after each flush."""
    writer, sizes = LogWriter(path, RATE_HZ), []
    writer.write_run_description(START)
    for number, item in enumerate(items, 1):
        writer.write(topic_for(item), encode_item(item, START.run), item.index)
        if flush_every and number % flush_every == 0:
            writer.flush()
            sizes.append(path.stat().st_size)
    if close:
        writer.close()
    else:
        writer.flush()  # the file stays as a killed recorder leaves it
    return sizes
