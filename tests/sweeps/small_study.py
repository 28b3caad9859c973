"""A study of seconds, and the bytes that it leaves."""

from pathlib import Path

from tests.builders.profiles import format_test
from twin.studies.maps.cases import sample_parameters
from twin.studies.maps.store import Manifest, create_store
from twin.studies.maps.study import Study
from twin.studies.maps.task import compute_chunk, make_sweep_plan

TEST = format_test(2.4, 4.4, 0.2, cycles=8, measured_cycles=None)
STUDY = """
title = "Gap and stiffness"
profile = "{profile}"
outcomes = ["curves", "peaks", "forces", "hysteresis"]
chunk = 5
[[parameters]]
name = "specimen.gap_mm"
values = [2.0, 4.0, 6.0, 9.0]
[[parameters]]
name = "base.bumper_stiffness_n_m"
start = 2e5
stop = 8e5
count = 6
scale = "log"
"""


def write_study(folder: Path, text: str = STUDY, test: str = TEST) -> Path:
    """Write a test and a study of it; return the study's path."""
    profile = folder / "across.toml"
    profile.write_text(test)
    path = folder / "study.toml"
    path.write_text(text.replace("{profile}", str(profile)))
    return path


def read_stored_bytes(folder: Path) -> dict[str, bytes]:
    """Return everything that a study has computed, by path; not its page."""
    paths = [folder / "chunks.jsonl", folder / "study.json"]
    paths += [path for path in (folder / "results.zarr").rglob("*") if path.is_file()]
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


def make_stored_study(path: Path, out: Path, chunks: range) -> Study:
    """Compute these chunks of a study in this process."""
    study = Study.read(path)
    out.mkdir()
    create_store(out, study, make_sweep_plan(study), sample_parameters(study.config))
    manifest = Manifest(out, [variable.name for variable in study.variables])
    for chunk in chunks:
        stored = compute_chunk(out, chunk)
        assert not isinstance(stored, str), stored
        manifest.add(stored)
    return study
