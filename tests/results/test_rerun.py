"""Predictions that are not recorded: recomputed to the bit, compared by hash, and said."""

from dataclasses import replace
from hashlib import blake2b
from pathlib import Path

import numpy as np
import pytest

from table_io.block import Block
from table_io.records import PredictionHash
from tests.builders.blocks import select_blocks
from twin.compare import pipeline
from twin.compare.monitoring.low_cut import LowCutFilter, LowCutRemoval
from twin.exchange.export import ExportOptions, export_log
from twin.log import open_log
from twin.recording.columns import StoredItems
from twin.recording.log_metadata import select_recorded
from twin.recording.mcap_log import write_items
from twin.recording.reader import Recording, read_recording
from twin.replay.pipeline_replay import RecordedRun, replay_recording
from twin.replay.verify import examine_logs
from twin.results import rerun
from twin.results.recordings import read_recorded_config
from twin.results.rerun import Predictions, restore_predictions
from twin.setup.run_config import RunConfig
from twin.setup.unpaced import play_unpaced


@pytest.fixture(scope="module")
def sparse_log(bundle: RunConfig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run of `recording` again, with every 10th block of predictions only."""
    profile = bundle.profile_toml.replace('"all"', '"hash"')
    config = replace(
        bundle,
        profile=bundle.profile.model_copy(
            update={
                "recording": bundle.profile.recording.model_copy(update={"predictions": "hash"})
            }
        ),
        profile_toml=profile,
    )
    path = tmp_path_factory.mktemp("sparse") / "run.mcap"
    play_unpaced(config, "first", path, lambda: None, lambda _: None)
    return path


@pytest.fixture(scope="module")
def sparse(sparse_log: Path) -> Recording:
    return read_recording(sparse_log)


def replay(log: Path, folder: Path) -> tuple[bool | None, int, int, int | None]:
    """Replay: (identical, hashes that differ, blocks that differ, first difference)."""
    recorded = RecordedRun.open(log)
    config = read_recorded_config(recorded.recording)
    result = replay_recording(recorded, config, folder / "again.mcap", "again", lambda _: None)
    assert result.hashes_compared == result.hashes > 100
    assert result.predictions_compared > 100
    return (
        result.is_identical,
        result.hashes_differing,
        result.predictions_differing,
        result.first_difference,
    )


def test_every_tenth_block_is_recorded_and_the_file_shrinks(
    sparse: Recording, recording: Recording
) -> None:
    assert (sparse.start.predictions_every, recording.start.predictions_every) == (10, 0)
    assert {block.index // 20 % 10 for block in select_blocks(sparse.items, "pred")} == {0}
    assert (
        9.5
        < sum(map(len, select_blocks(recording.items, "pred")))
        / sum(map(len, select_blocks(sparse.items, "pred")))
        < 10
    )
    assert sparse.path.stat().st_size < 0.6 * recording.path.stat().st_size
    (measured,), (full,) = (each.contiguous_blocks("meas") for each in (sparse, recording))
    assert measured.is_identical(full)


def test_a_hash_is_that_of_the_encoded_values(recording: Recording) -> None:
    """As LOG.md says it, computed from a recording with all predictions."""
    (predicted,) = recording.contiguous_blocks("pred")
    hashes = recording.records(PredictionHash)
    assert [entry.index for entry in hashes] == [*range(0, predicted.end - 199, 200)]
    for entry in hashes:
        values = predicted.cut(entry.index, entry.index + entry.count).values.copy()
        values[np.isnan(values)] = np.frombuffer(bytes.fromhex("000000000000f87f"))
        data = b"".join(row.astype("<f8").tobytes() for row in values)
        assert blake2b(data, digest_size=16).digest() == entry.digest, entry.index


def test_predictions_come_back_to_the_bit(
    sparse: Recording, recording: Recording, capsys: pytest.CaptureFixture[str]
) -> None:
    restored = restore_predictions(sparse)
    (ours,), (theirs,) = (each.contiguous_blocks("pred") for each in (restored, recording))
    assert ours.is_identical(theirs)
    assert restore_predictions(restored) is restored
    assert restore_predictions(recording) is recording
    assert capsys.readouterr().err == ""


def test_the_log_and_exports_have_all_predictions(
    sparse_log: Path, log_file: Path, tmp_path: Path
) -> None:
    logs = [open_log(path) for path in (sparse_log, log_file)]
    assert logs[0].predicted.tobytes() == logs[1].predicted.tobytes()
    for path, name in ((sparse_log, "sparse"), (log_file, "all")):
        export_log(
            ExportOptions(
                path, ("csv",), tmp_path / name, channels=("twin_free_rel_disp_m",), steps=(2, 2)
            )
        )
    # The last column is the absolute time, another for each run.
    texts = [
        [line.rpartition(",")[0] for line in (tmp_path / f"{name}.csv").read_text().splitlines()]
        for name in ("sparse", "all")
    ]
    assert texts[0][-500:] == texts[1][-500:]


def test_a_replay_compares_hashes_and_recorded_blocks(sparse_log: Path, tmp_path: Path) -> None:
    assert replay(sparse_log, tmp_path) == (True, 0, 0, None)


def test_a_changed_hash_or_block_is_found(
    sparse: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    entry = sparse.records(PredictionHash)[7]
    changed = [replace(item, digest=bytes(16)) if item is entry else item for item in sparse.items]
    write_items(tmp_path / "hash.mcap", changed, sparse.start)
    assert replay(tmp_path / "hash.mcap", tmp_path) == (False, 1, 0, entry.index)
    restore_predictions(read_recording(tmp_path / "hash.mcap"))
    assert "1 of " in capsys.readouterr().err

    block = select_blocks(sparse.items, "pred")[9]
    values = block.values.copy()
    values[3, 4] = np.nextafter(values[3, 4], np.inf)
    changed = [
        replace(block, values=values)
        if isinstance(item, Block) and (item.stream, item.index) == ("pred", block.index)
        else item
        for item in sparse.items
    ]
    write_items(tmp_path / "block.mcap", changed, sparse.start)
    (tmp_path / "b").mkdir()
    assert replay(tmp_path / "block.mcap", tmp_path / "b") == (False, 0, 1, block.index)


def test_verify_counts_recorded_predictions(sparse_log: Path, log_file: Path) -> None:
    sparse, full = (examine_logs([path]).report for path in (sparse_log, log_file))
    assert (sparse.predictions.every, full.predictions.every) == (10, 1)
    assert sparse.predictions.hashed == full.predictions.hashed
    assert sparse.predictions.recorded < 0.11 * full.predictions.recorded
    assert sparse.sound
    assert sparse.replay.identical


@pytest.mark.parametrize("size", [1, 7, 20, 200, 999])
def test_the_selection_does_not_depend_on_block_boundaries(sparse: Recording, size: int) -> None:
    (whole,) = restore_predictions(sparse).contiguous_blocks("pred")
    some = whole.cut(0, 1998)
    parts: list[Block] = []
    for first in range(0, len(some), size):
        parts += select_recorded(some.cut(first, min(first + size, len(some))), sparse.start)
    samples = [sample for part in parts for sample in range(part.index, part.end)]
    assert samples == [sample for sample in range(1998) if sample // 20 % 10 == 0]


def test_a_part_is_computed_from_the_saved_states_before_it(
    sparse: Recording, recording: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    (whole,) = recording.contiguous_blocks("pred")
    monkeypatch.setattr(
        rerun, "restore_predictions", lambda *_: pytest.fail("rerun from the start")
    )
    saved = [entry.end for entry in sparse.records(PredictionHash) if entry.free]
    assert saved == [*range(4000, whole.end + 1, 4000)]
    predictions = Predictions(sparse)
    last_hash = sparse.records(PredictionHash)[-1].end
    for first, end in ((4200, 4201), (4999, 9000), (8000, 12345), (saved[-1], last_hash)):
        (block,) = predictions.read(first, end)
        assert block.is_identical(whole.cut(first, end)), (first, end)


@pytest.mark.parametrize("change", ["another value", "too short", "not a number"])
def test_a_saved_state_that_does_not_lead_to_the_hashes_is_not_used(
    sparse: Recording, recording: Recording, change: str
) -> None:
    (whole,) = recording.contiguous_blocks("pred")

    def alter(state: tuple[float, ...]) -> tuple[float, ...]:
        first = {"another value": (state[0] + 1e-3,), "too short": (), "not a number": (np.nan,)}
        return (*first[change], *state[1:])

    entries = [
        replace(item, free=alter(item.free))
        if isinstance(item, PredictionHash) and item.free
        else item
        for item in sparse.items.records
    ]
    changed = Predictions(replace(sparse, items=StoredItems(entries, sparse.items.series)))
    (block,) = changed.read(5000, 9000)
    assert block.is_identical(whole)


def test_no_state_is_saved_while_a_low_cut_is_removed(
    bundle: RunConfig, recording: Recording
) -> None:
    """Then the twin's input depends on filters, whose states are not in the record."""
    setup, (measured,) = bundle.prepare_twin(), recording.contiguous_blocks("meas")
    plain, _ = pipeline.start_pipeline(setup, 3390)
    removal = LowCutRemoval({"mass_acc_m_s2": LowCutFilter(low_cut=1.0)})
    for state, is_saved in ((plain, True), (replace(plain, low_cuts=removal), False)):
        items = pipeline.step(setup, state, measured.cut(3390, 4010))[1]
        hashes = [item for item in items if isinstance(item, PredictionHash)]
        assert any(entry.free for entry in hashes) == is_saved
