"""A study of which anything on the disk was altered is not shown as if it were whole."""

import json
import random
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from table_io.errors import InputError
from tests.sweeps.small_study import make_stored_study, write_study
from twin.studies import DEFINITION_FILE
from twin.studies.maps import task
from twin.studies.maps.results import open_study
from twin.studies.maps.store import (
    MANIFEST_FILE,
    Manifest,
    StoredChunk,
    open_group,
)
from twin.studies.maps.task import MapOptions, compute_map
from twin.system import grid
from twin.system.process_pool import TaskResult


def run_here(
    run: Callable[[int], StoredChunk],
    numbers: list[int],
    *_: object,
    find_fault: Callable[[StoredChunk], str],
    **__: object,
) -> Iterator[TaskResult]:
    for number in numbers:
        chunk = run(number)
        yield TaskResult(number, chunk, find_fault(chunk))


@pytest.fixture(scope="module")
def stored_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("stored")
    make_stored_study(write_study(folder), folder / "out", range(5))
    return folder / "out"


@pytest.fixture
def study(stored_folder: Path, tmp_path: Path) -> Path:
    return shutil.copytree(stored_folder, tmp_path / "study")


def test_scaled_results_are_refused_with_their_chunk(study: Path) -> None:
    array = open_group(study, "r+")["eta_d"]
    array[7] = 0.1 * array[7]
    with pytest.raises(InputError, match=r"chunk 1, cases 5 to 9, .*altered or missing.*--resume"):
        open_study(study)


@pytest.mark.parametrize("name", ["specimen.gap_mm", "seed", "frequency_hz", "direction"])
def test_altered_coordinates_are_refused(study: Path, name: str) -> None:
    array = open_group(study, "r+")[name]
    array[1] = array[1] + 1
    with pytest.raises(InputError, match="parameters, seeds or metadata"):
        open_study(study)
    with pytest.raises(InputError, match="parameters, seeds or metadata"):
        compute_map(MapOptions(study, workers=1, resume=True))


def test_deleted_chunk_is_not_still_to_come(study: Path) -> None:
    (study / "results.zarr" / "peak_disp_m" / "c" / "2").unlink()
    with pytest.raises(InputError, match="chunk 2, cases 10 to 14"):
        open_study(study)


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        (DEFINITION_FILE, "gap_mm = 4.0", "gap_mm = 4.1"),
        (DEFINITION_FILE, "36000", "36001"),
        (MANIFEST_FILE, '"cases": 5', '"cases": 4'),
        (MANIFEST_FILE, '"failures": {}', '"failures": {"3": "gone"}'),
        (MANIFEST_FILE, "line_sha256", "line_sha255"),
    ],
)
def test_altered_texts_are_refused(study: Path, name: str, old: str, new: str) -> None:
    path = study / name
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match="not what was written"):
        open_study(study)


def test_studies_of_earlier_versions_are_read(study: Path) -> None:
    definition = json.loads((study / DEFINITION_FILE).read_text())
    without = {key: value for key, value in definition.items() if not key.endswith("sha256")}
    (study / DEFINITION_FILE).write_text(json.dumps(without))
    lines = (study / MANIFEST_FILE).read_text()
    (study / MANIFEST_FILE).write_text(re.sub(r', "line_sha256": "\w+"', "", lines))
    assert open_study(study).attrs["cases"] == 24


def test_every_altered_byte_is_noticed_or_harmless(study: Path) -> None:
    """A byte changed at random: refused, or less is stored, or every value is the same."""
    rng = random.Random(5)
    whole = open_study(study).load()
    paths = sorted(path for path in study.rglob("*") if path.is_file())
    for _ in range(60):
        path = rng.choice(paths)
        before = path.read_bytes()
        place, value = rng.randrange(len(before)), rng.randrange(1, 256)
        after = bytearray(before)
        after[place] ^= value
        path.write_bytes(after)
        try:
            data = open_study(study).load()
        except InputError:
            continue
        else:
            is_less = data.attrs["cases"] < whole.attrs["cases"]
            assert is_less or data.identical(whole), (path, place)
        finally:
            path.write_bytes(before)


def test_chunk_that_its_worker_did_not_store_ends_the_study(
    study: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its worker reports the right hash."""
    reported = Manifest(study, []).chunks[3]
    lines = (study / MANIFEST_FILE).read_text().splitlines(keepends=True)
    (study / MANIFEST_FILE).write_text("".join(line for line in lines if '"chunk": 3' not in line))
    (study / "results.zarr" / "eta_d" / "c" / "3").rename(study / "gone")

    def report(_: Path, number: int) -> StoredChunk:
        assert number == 3
        return reported

    monkeypatch.setattr(grid, "run_tasks", run_here)
    monkeypatch.setattr(task, "compute_chunk", report)
    with pytest.raises(InputError, match="chunk 3 failed: its chunk is not in the folder"):
        compute_map(MapOptions(study, workers=1, resume=True))
