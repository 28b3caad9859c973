"""Fixtures: a short run with a jump, recorded once a session of tests.

Imports what computes only where a fixture is used.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from table_io.block import Block
from table_io.records import Record
from tests.builders.blocks import recut_blocks
from tests.builders.profiles import AT_1_KHZ, NO_LOOP_CHECK, format_test

if TYPE_CHECKING:
    from twin.recording.columns import StoredItems
    from twin.recording.reader import Recording
    from twin.setup.run_config import RunConfig
    from twin.transport.codec import Item

PROFILE = format_test(
    2.4,
    4.4,
    1.0,
    title="Across the down-jump and back",
    tables=NO_LOOP_CHECK | AT_1_KHZ | {"recording": {"predictions": "all"}},
)


@pytest.fixture(scope="session")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> "RunConfig":
    """Six steps across the down-jump and back."""
    from twin.setup.run_config import read_run_config

    path = tmp_path_factory.mktemp("across") / "across.toml"
    path.write_text(PROFILE)
    return read_run_config(path)


@pytest.fixture(scope="session")
def log_file(bundle: "RunConfig", tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recording of a run of it, alone in its folder, in the short blocks of a live run."""
    from twin.recording.mcap_log import write_items
    from twin.recording.reader import read_recording
    from twin.setup.unpaced import play_unpaced

    folder = tmp_path_factory.mktemp("across")
    play_unpaced(bundle, "first", folder / "long.mcap", lambda: None, lambda _: None)
    recording = read_recording(folder / "long.mcap")
    samples = bundle.profile.acquisition.block_samples
    blocks = [
        block
        for stream in ("meas", "pred")
        for block in recut_blocks(recording.contiguous_blocks(stream), samples)
    ]
    path = folder / "first" / "run.mcap"
    path.parent.mkdir()
    records = [item for item in recording.items if not isinstance(item, Block)]
    items = sorted([*records, *blocks], key=lambda item: item.index)
    write_items(path, items, recording.start)
    return path


@pytest.fixture(scope="session")
def recording(log_file: Path) -> "Recording":
    from twin.recording.reader import read_recording

    return read_recording(log_file)


def store_items(items: "Iterable[Item]") -> "StoredItems":
    """Return items as a recording holds them, blocks and comparisons in columns of their own."""
    from twin.recording.columns import SeriesStore, StoredItems
    from twin.transport.codec import topic_for
    from twin.transport.series import SeriesItem, split_item

    records: list[Record] = []
    stores: dict[str, SeriesStore] = {}
    for item in items:
        if isinstance(item, SeriesItem):
            store = stores.setdefault(topic_for(item), SeriesStore(lambda _: 10_000_000))
            store.add(item, np.array([item.index]), *split_item(item))
        else:
            records.append(item)
    return StoredItems(records, {topic: store.close() for topic, store in stores.items()})
