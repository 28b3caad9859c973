"""Task: compute a map, outcomes of the model over any of its parameters; resumable."""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from table_io.block import Float2D
from table_io.clock import RealClock
from table_io.errors import InputError, require_package
from twin.setup.disk import format_size, free_bytes
from twin.setup.folders import claim_folder, find_sharing_problem, make_output_folder
from twin.setup.run_config import make_run_id
from twin.studies import DEFINITION_FILE
from twin.studies.maps.cases import SampledCase, sample_parameters
from twin.studies.maps.outcomes import CaseChunk, Outcome, SweepPlan
from twin.studies.maps.page import write_map_page
from twin.studies.maps.store import (
    Manifest,
    StoredChunk,
    create_store,
    estimate_bytes_per_case,
    hash_arrays,
    hash_stored,
    make_seeds,
    open_group,
    read_definition,
    read_study_versions,
    remove_partial_files,
    remove_unfinished_store,
    require_same_study,
    require_unchanged_store,
)
from twin.studies.maps.study import Study
from twin.system.grid import Watch, format_time_span, run_grid
from twin.system.process_pool import Workers
from twin.system.versions import find_version_problem

TRIAL_CASES = 4  # spread over the study, computed beforehand to estimate its duration
MAX_CHUNK_S = 24 * 3600.0


def make_sweep_plan(study: Study) -> SweepPlan:
    """Return the sweep of every case."""
    sweep = study.profile.sweep
    return SweepPlan(sweep.steps, sweep.cycles, sweep.measured_cycles)


def compute_outcomes(
    study: Study, values: Float2D, seeds: npt.NDArray[np.uint64]
) -> tuple[dict[str, npt.NDArray[Any]], dict[int, str]]:
    """Return the arrays of cases by variable, and why cases have none by their place.

    values (case, parameter) in the units of their keys; seeds (case,).
    """
    failures: dict[int, str] = {}
    cases: list[SampledCase | None] = []
    for index, row in enumerate(values.tolist()):
        try:
            cases.append(study.factory.build(row))
        except InputError as error:
            failures[index] = str(error)
            cases.append(None)
    chunk = CaseChunk(
        tuple(cases),
        tuple(seeds.tolist()),
        make_sweep_plan(study),
        failures,
        study.profile_toml,
        study.model_toml,
    )
    arrays: dict[str, npt.NDArray[Any]] = {}
    for outcome in study.outcomes:
        arrays |= _compute_outcome(outcome, chunk)
    without_result = [case is None for case in cases]
    for computed in arrays.values():
        computed[without_result] = np.nan  # whatever an outcome makes of what is missing
    return arrays, failures


def _compute_outcome(outcome: Outcome, chunk: CaseChunk) -> dict[str, npt.NDArray[Any]]:
    """Return the arrays of an outcome, each its own; InputError if it fails or lacks one."""
    try:
        computed = outcome.compute(chunk)
        arrays = {
            variable.name: np.array(computed[variable.name], dtype=variable.dtype)
            for variable in outcome.variables
        }
        for variable in outcome.variables:
            shape = (len(chunk.cases), *chunk.sweep.find_shape(variable.dims))
            if arrays[variable.name].shape != shape:
                raise ValueError(f"{variable.name} is {arrays[variable.name].shape}, not {shape}")
    except InputError:
        raise
    except Exception as error:  # of a plug-in, which may raise anything
        raise InputError(
            f"fails: {type(error).__name__}: {error}", where=f"outcome {outcome.name}"
        ) from error
    return arrays


@lru_cache(maxsize=1)
def _open_study(folder: Path, _: float) -> tuple[Study, Mapping[str, Any]]:
    """Return the study in a folder and its arrays; the time of its definition is part of the key.

    InputError if this process has other versions than the study.
    """
    definition = read_definition(folder)
    problem = find_version_problem(definition.versions, read_study_versions())
    if problem:
        raise InputError(f"a worker has other versions than the study: {problem}", where=folder)
    study = Study.from_definition(definition, str(folder))
    return study, dict(open_group(folder, "r+").arrays())


def compute_chunk(folder: Path, number: int) -> StoredChunk | str:
    """Compute and store a chunk; return its line of the manifest, or why it failed.

    The reason is one that every other chunk would have too, such as a full disk.
    """
    try:
        study, arrays = _open_study(folder, (folder / DEFINITION_FILE).stat().st_mtime)
        first = number * study.config.chunk_size
        span = slice(first, min(first + study.config.chunk_size, study.config.case_count))
        names = [parameter.name for parameter in study.config.parameters]
        values = np.stack([arrays[name][span] for name in names], axis=1)
        results, failures = compute_outcomes(study, values, arrays["seed"][span])
        for name, computed in results.items():
            arrays[name][span] = computed
        sha256 = hash_arrays(results)
        if hash_stored(arrays, results, span) != sha256:
            return "what was stored reads back otherwise"
    except (InputError, OSError, MemoryError) as error:
        return str(error) or type(error).__name__
    return StoredChunk(
        chunk=number,
        first=first,
        cases=span.stop - first,
        sha256=sha256,
        failures={first + index: reason for index, reason in sorted(failures.items())},
    )


@dataclass(frozen=True, slots=True)
class MapOptions:
    """A study file, or the folder of a study that was started, to `resume` it.

    On `workers` processes, or on the Dask cluster at the address `scheduler`.
    """

    study: Path
    out: Path | None = None
    workers: int | None = None
    scheduler: str = ""
    resume: bool = False


@dataclass(frozen=True, slots=True)
class StoredMap:
    """The folder of a map, its page, and how many of its cases are stored."""

    folder: Path
    page: Path
    stored: int
    total: int
    stop_reason: str | None

    @property
    def is_complete(self) -> bool:
        return self.stored == self.total


def require_packages() -> None:
    """Raise InputError if a package that maps need is not installed."""
    for package in ("xarray", "zarr"):
        require_package(package, "studies", "map")


def compute_map(options: MapOptions, watch: Watch | None = None) -> StoredMap:
    """Compute the cases of a study that are not stored yet; write its page.

    Read the results by `open_study`. InputError for a faulty study, for one that does not fit into
    memory or on the disk, and if a chunk cannot be computed or stored.
    """
    require_packages()
    watch = watch or Watch()
    path, out = options.study, options.out
    workers = Workers.from_options(options.workers, options.scheduler)
    if options.resume and (path / DEFINITION_FILE).is_file():
        if out not in (None, path):
            raise InputError(
                "the study goes on where it is", where=path, key="--out", value=str(out),
                remedy="omit it",
            )  # fmt: skip
        study, out = Study.from_definition(read_definition(path), str(path)), path
    else:
        study = Study.read(path)
    workers.require()
    folder = _open_folder(study, path, out, options.resume)
    config = study.config
    if not options.resume:
        _require_disk_space(study, folder, config.case_count)
        create_store(folder, study, make_sweep_plan(study), sample_parameters(config))
    require_unchanged_store(folder, study, read_definition(folder))
    manifest = Manifest(folder, [variable.name for variable in study.variables])
    _require_disk_space(study, folder, config.case_count - manifest.case_count)
    watch.tell(config.title)
    watch.tell(_describe_size(study))
    group = open_group(folder, "r")
    manifest.start(group)
    if missing_count := config.case_count - manifest.case_count:
        watch.tell(_describe_plan(study, group, workers, missing_count))
    _run_chunks(folder, study, manifest, workers, watch)
    if manifest.case_count == config.case_count:
        manifest.finish()
    page = write_map_page(folder)
    return StoredMap(folder, page, manifest.case_count, config.case_count, watch.find_stop())


def _estimate_seconds_per_case(study: Study, group: Any) -> float:
    """Return the time of a case in s, from a few that are spread over the study."""
    shares = (np.arange(TRIAL_CASES) + 0.5) / TRIAL_CASES
    indices = (shares * study.config.case_count).astype(int)
    names = [parameter.name for parameter in study.config.parameters]
    values = np.stack([group[name].oindex[indices] for name in names], axis=1)
    seeds = make_seeds(study.config.seed, range(TRIAL_CASES))
    clock = RealClock()
    compute_outcomes(study, values[:1], seeds[:1])  # compiles
    started_s = clock.now()
    compute_outcomes(study, values, seeds)
    return (clock.now() - started_s) / TRIAL_CASES


def _describe_size(study: Study) -> str:
    """Return how many cases there are: of many millions, listing them takes a while."""
    config, steps = study.config, study.profile.sweep.steps
    shape = " x ".join(map(str, config.shape)) + " = " if len(config.shape) > 1 else ""
    return f"{shape}{config.case_count} cases of {len(steps)} steps in {config.chunk_count} chunks"


def _describe_plan(study: Study, group: Any, workers: Workers, missing_count: int) -> str:
    """Return what the missing cases take, from a few of them."""
    seconds = _estimate_seconds_per_case(study, group) * missing_count
    size = estimate_bytes_per_case(study, make_sweep_plan(study)) * missing_count
    duration = (
        f"about {format_time_span(seconds)} of one core on {workers}"
        if workers.scheduler
        else f"about {format_time_span(seconds / workers.count)} on {workers}"
    )
    return f"{missing_count} to compute: {duration}, at most {format_size(size)} unpacked"


def _open_folder(study: Study, path: Path, out: Path | None, resume: bool) -> Path:
    """Return the folder of the study: a new one, or with `resume` the one of an earlier start."""
    if not resume:
        _require_memory(study)
        if out is not None:
            remove_unfinished_store(out)
        return make_output_folder(out, make_run_id(f"{path.stem}-map"))
    if out is None:
        raise InputError("missing", key="--out", remedy="give the folder of the study to resume")
    require_same_study(out, study)
    claim_folder(out)
    remove_partial_files(out)
    return out


def _require_memory(study: Study) -> None:
    """Raise InputError if the list of cases does not fit into memory."""
    needed = 3 * 8 * study.config.case_count * len(study.config.parameters)
    available = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    if needed > available:
        raise InputError(
            f"{study.config.case_count} cases take {format_size(needed)} of memory, and "
            f"{format_size(available)} are free; nothing was started",
            key="parameters",
            remedy="give fewer values",
        )


def _require_disk_space(study: Study, folder: Path, missing_count: int) -> None:
    """Raise InputError if the missing results do not fit on the folder's disk, uncompressed."""
    needed = estimate_bytes_per_case(study, make_sweep_plan(study)) * missing_count
    free = free_bytes(folder)
    if needed > free:
        raise InputError(
            f"{format_size(free)} free on its disk, but the results take up to "
            f"{format_size(needed)}; nothing was started",
            where=folder,
            remedy="make room, give another disk with --out, or compute fewer outcomes",
        )


def _run_chunks(
    folder: Path, study: Study, manifest: Manifest, workers: Workers, watch: Watch
) -> None:
    """Compute the chunks that are not stored and list each; InputError if one cannot be."""
    shared = folder.resolve()
    definition = (shared / DEFINITION_FILE).read_text(encoding="utf-8")

    def describe_failure(number: int, reason: str) -> InputError:
        return InputError(
            f"chunk {number} failed: {reason}; the chunks before it are kept",
            where=folder,
            remedy="remove the cause and continue with --resume",
        )

    group = open_group(folder, "r")

    def find_fault(chunk: StoredChunk | str) -> str:
        """Return why a chunk is not stored, whatever its worker says; "" if it is."""
        if isinstance(chunk, str):
            return chunk
        return "" if manifest.holds(group, chunk) else "its chunk is not in the folder of the study"

    def keep(_: int, chunk: StoredChunk) -> int:
        manifest.add(chunk)
        return chunk.cases

    run_grid(
        partial(compute_chunk, shared),
        [n for n in range(study.config.chunk_count) if n not in manifest.chunks],
        workers, keep, watch, unit="cases", total=study.config.case_count,
        done=manifest.case_count, describe_failure=describe_failure, max_task_s=MAX_CHUNK_S,
        find_problem=partial(find_sharing_problem, shared / DEFINITION_FILE, definition),
        find_fault=find_fault,
    )  # fmt: skip
