"""`shaketwin map`: compute the chunks of a study, here or on a cluster; resumable."""

import os
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import TextColumn

from table_io.clock import RealClock
from table_io.errors import InputError, require_package
from twin.report.finalize import EXIT_INTERRUPTED
from twin.setup.disk import format_size, free_bytes
from twin.setup.folders import claim_folder, find_sharing_problem, make_output_folder
from twin.setup.run_config import make_run_id
from twin.studies import DEFINITION_FILE
from twin.studies.maps.compute import (
    compute_chunk,
    compute_outcomes,
    make_sweep_plan,
)
from twin.studies.maps.page import write_map_page
from twin.studies.maps.sampling import sample_parameters
from twin.studies.maps.store import (
    Manifest,
    create_store,
    estimate_bytes_per_case,
    make_seeds,
    open_group,
    read_definition,
    remove_partial_files,
    remove_unfinished_store,
    require_same_study,
)
from twin.studies.maps.study import Study
from twin.system.process_pool import TaskResult, Workers, run_tasks
from twin.system.progress import make_task_bar
from twin.system.terminal import catch_interrupts, console, print_line

STOPPING_MESSAGE = "stopping after the chunks in progress"
TRIAL_CASES = 4  # spread over the study, computed beforehand to estimate its duration
MAX_CHUNK_S = 24 * 3600.0
MAX_ATTEMPTS = 3  # of a chunk whose process dies
PROGRESS_LINE_S = 30.0  # between lines where there is no terminal


def run_study(
    path: Path,
    out: Path | None,
    workers: int | None,
    scheduler: str,
    resume: bool,
    show_only: bool,
) -> int:
    """Run a study, or show one that has been stored; return the exit code."""
    for package in ("xarray", "zarr"):
        require_package(package, "studies", "map")
    is_stored = (path / DEFINITION_FILE).is_file()
    if show_only or (is_stored and not resume):
        _require_plain_show(path, out, workers, scheduler)
        read_definition(path)
        print_line(f"{write_map_page(path)}")
        return 0
    places = Workers.from_options(workers, scheduler)
    if is_stored:
        if out not in (None, path):
            raise InputError(
                "the study goes on where it is", where=path, key="--out", value=str(out),
                remedy="omit it",
            )  # fmt: skip
        study, out = Study.from_definition(read_definition(path), str(path)), path
    else:
        study = Study.read(path)
    places.require()
    folder = _open_folder(study, path, out, resume)
    manifest = Manifest(folder, [variable.name for variable in study.variables])
    _require_disk_space(study, folder, study.config.case_count - manifest.case_count)
    _print_size(study)
    if not resume:
        create_store(folder, study, make_sweep_plan(study), sample_parameters(study.config))
    group = open_group(folder, "r")
    manifest.start(group)
    missing_count = study.config.case_count - manifest.case_count
    _print_plan(study, group, places, missing_count)
    pending = [n for n in range(study.config.chunk_count) if n not in manifest.entries]
    with catch_interrupts(STOPPING_MESSAGE) as stop:
        _run_chunks(folder, study, manifest, pending, places, stop)
        stop_reason = stop()
    is_complete = len(manifest.entries) == study.config.chunk_count
    if is_complete:
        manifest.finish()
    page = write_map_page(folder)
    state = "complete" if is_complete else f"stopped ({stop_reason}); continue with --resume"
    print_line(f"{manifest.case_count} of {study.config.case_count} cases, {state} -> {page}")
    return 0 if is_complete else EXIT_INTERRUPTED


def _require_plain_show(path: Path, out: Path | None, workers: int | None, scheduler: str) -> None:
    """Raise InputError for options that a stored study cannot be shown with."""
    if out is not None or workers is not None or scheduler:
        raise InputError(
            "a stored study is shown as it is",
            where=path,
            remedy="give its folder alone, or --resume to go on with it",
        )


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


def _print_size(study: Study) -> None:
    """Print how many cases there are: of many millions, listing them takes a while."""
    config, steps = study.config, study.profile.sweep.steps
    shape = " x ".join(map(str, config.shape)) + " = " if len(config.shape) > 1 else ""
    print_line(f"{config.title}")
    print_line(
        f"{shape}{config.case_count} cases of {len(steps)} steps in {config.chunk_count} chunks"
    )


def _print_plan(study: Study, group: Any, workers: Workers, missing_count: int) -> None:
    """Print what the missing cases take, from a few of them."""
    if missing_count:
        seconds = _estimate_seconds_per_case(study, group) * missing_count
        size = estimate_bytes_per_case(study, make_sweep_plan(study)) * missing_count
        duration = (
            f"about {format_time_span(seconds)} of one core on {workers}"
            if workers.scheduler
            else f"about {format_time_span(seconds / workers.count)} on {workers}"
        )
        print_line(f"{missing_count} to compute: {duration}, at most {format_size(size)} unpacked")


def format_time_span(seconds: float) -> str:
    """Format a duration for display, with two digits."""
    for unit, length in (("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * length:
            return f"{seconds / length:.3g} {unit}"
    return f"{seconds:.2g} s"


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
    folder: Path,
    study: Study,
    manifest: Manifest,
    pending: Sequence[int],
    workers: Workers,
    stop: Callable[[], object],
) -> None:
    """Compute the pending chunks and list each in the manifest; InputError if one cannot be."""
    shared = folder.resolve()
    definition = (shared / DEFINITION_FILE).read_text(encoding="utf-8")
    results = run_tasks(
        partial(compute_chunk, shared), pending, workers, stop,
        max_task_s=MAX_CHUNK_S, attempts=MAX_ATTEMPTS,
        find_problem=partial(find_sharing_problem, shared / DEFINITION_FILE, definition),
    )  # fmt: skip
    clock = RealClock()
    started_s = last_line_s = clock.now()
    stored_before, total = manifest.case_count, study.config.case_count
    with make_task_bar(TextColumn("{task.fields[rate]}")) as bar:
        task = bar.add_task("cases", total=total, completed=stored_before, rate="")
        for result in results:
            manifest.add(_require_entry(folder, result))
            elapsed_s = clock.now() - started_s
            rate = (manifest.case_count - stored_before) / elapsed_s
            bar.update(task, completed=manifest.case_count, rate=f"{rate:.3g}/s")
            if not console.is_terminal and clock.now() - last_line_s > PROGRESS_LINE_S:
                last_line_s = clock.now()
                left = format_time_span((total - manifest.case_count) / rate)
                print_line(f"{manifest.case_count} of {total} cases, {rate:.3g}/s, {left} left")


def _require_entry(folder: Path, result: TaskResult) -> dict[str, object]:
    """Return the line of a stored chunk; InputError if it could not be computed or stored."""
    reason = result.failure or result.value.get("error", "")
    if reason:
        raise InputError(
            f"chunk {result.number} failed: {reason}; the chunks before it are kept",
            where=folder,
            remedy="remove the cause and continue with --resume",
        )
    return dict(result.value)
