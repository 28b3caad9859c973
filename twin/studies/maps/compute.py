"""Compute one chunk of a study and store it: the task of every worker."""

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from table_io.block import Float2D
from table_io.errors import InputError
from twin.studies import DEFINITION_FILE
from twin.studies.maps.cases import SampledCase
from twin.studies.maps.outcomes import CaseChunk, Outcome, SweepPlan
from twin.studies.maps.store import (
    StoredChunk,
    hash_arrays,
    hash_stored,
    open_group,
    read_definition,
    read_study_versions,
)
from twin.studies.maps.study import Study
from twin.system.versions import find_version_problem


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
