"""Files of a study: results as a zarr group, its definition, and a line per stored chunk.

`results.zarr` has a dimension `case`; every variable has one zarr chunk per chunk of cases, and
zarr replaces a file only when the new one is whole. `chunks.jsonl` lists the stored chunks with a
hash of their values; only the process that runs the study writes it, so that a chunk without a
line is computed again and its bytes are the same.
"""

import hashlib
import json
import math
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from table_io.block import Float2D
from table_io.errors import InputError
from twin.run.versions import compare_versions, format_version_changes, read_installed_versions
from twin.studies import DEFINITION_FILE
from twin.studies.maps.outcomes import SweepPlan
from twin.studies.maps.study import Study

RESULTS_FOLDER, MANIFEST_FILE = "results.zarr", "chunks.jsonl"
COORDINATE_CHUNK = 100_000  # cases
DIRECTION_VALUES = {"forward": 1, "backward": -1}
Json = dict[str, Any]


def estimate_bytes_per_case(study: Study, sweep: SweepPlan) -> int:
    """Return the bytes that a case takes before compression, with its parameters and seed."""
    sizes = {"direction": len(sweep.directions), "frequency_hz": sweep.grid_hz.size}
    return 8 * (len(study.config.parameters) + 1) + sum(
        np.dtype(variable.dtype).itemsize * math.prod(sizes[dim] for dim in variable.dims)
        for variable in study.variables
    )


def create_store(folder: Path, study: Study, sweep: SweepPlan, values: Float2D) -> None:
    """Create the files of a study without results; values of the parameters: (case, parameter)."""
    import zarr

    group = zarr.create_group(folder / RESULTS_FOLDER, attributes=_describe_study(study))
    count, size = study.config.case_count, study.config.chunk_size
    for parameter, column in zip(study.config.parameters, values.T, strict=True):
        attributes = {"units": study.factory.find_unit(parameter.name)}
        _add_coordinate(group, parameter.name, column, "case", attributes)
    seeds = make_seeds(study.config.seed, range(count))
    _add_coordinate(group, "seed", seeds, "case", {"long_name": "seed of the case"})
    _add_coordinate(group, "frequency_hz", sweep.grid_hz, "frequency_hz", {"units": "Hz"})
    directions = np.array([DIRECTION_VALUES[name] for name in sweep.directions], dtype=np.int8)
    meanings = {"flag_values": [1, -1], "flag_meanings": "forward backward"}
    _add_coordinate(group, "direction", directions, "direction", meanings)
    sizes = {"direction": directions.size, "frequency_hz": sweep.grid_hz.size}
    for variable in study.variables:
        shape = tuple(sizes[dim] for dim in variable.dims)
        group.create_array(
            variable.name,
            shape=(count, *shape),
            chunks=(size, *shape),
            dtype=variable.dtype,
            fill_value=math.nan,
            dimension_names=("case", *variable.dims),
            attributes={"units": variable.unit, "long_name": variable.title},
        )
    # Last: a folder with a definition has the whole group.
    text = json.dumps(make_definition(study), indent=1, sort_keys=True)
    replace_text(folder / DEFINITION_FILE, text)


def _describe_study(study: Study) -> Json:
    config = study.config
    names = [parameter.name for parameter in config.parameters]
    return {
        "title": config.title,
        "citation": config.citation,
        "parameters": names,
        "sampling": config.sampling,
        "shape": list(config.shape),
        "coordinates": " ".join([*names, "seed"]),  # of the cases, as xarray reads them
        "versions": read_installed_versions(),
    }


def _add_coordinate(
    group: Any, name: str, values: npt.NDArray[Any], dim: str, attributes: Json
) -> None:
    array = group.create_array(
        name,
        shape=values.shape,
        chunks=(min(values.size, COORDINATE_CHUNK),),
        dtype=values.dtype,
        dimension_names=(dim,),
        attributes=attributes,
    )
    array[:] = values


def make_seeds(seed: int, cases: Iterable[int]) -> npt.NDArray[np.uint64]:
    """Return an independent seed of each case, from the seed of the study and its number."""
    numbers = np.fromiter(cases, dtype=np.uint64)
    # A bijection that mixes all bits (splitmix64); SeedSequence takes seconds for a million cases.
    with np.errstate(over="ignore"):
        mixed = (numbers + np.uint64(seed + 1) * np.uint64(0x632BE59BD9B4E019)) * np.uint64(
            0x9E3779B97F4A7C15
        )
        mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        return mixed ^ (mixed >> np.uint64(31))


def make_definition(study: Study) -> Json:
    """Return what determines every byte of the results, by which a study can be resumed."""
    return {
        "study_toml": study.study_toml,
        "profile_toml": study.profile_toml,
        "model_toml": study.model_toml,
        "versions": read_installed_versions(),
    }


def read_definition(folder: Path) -> Json:
    """Read the definition of a study; InputError if the folder has none."""
    try:
        definition: Json = json.loads((folder / DEFINITION_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        raise InputError(
            "no study",
            where=folder,
            allowed="a folder written by `shaketwin map`",
            remedy="omit --resume to start a study",
        ) from None
    return definition


def find_version_problem(versions: Mapping[str, str]) -> str:
    """Return how the installed versions differ from those of a study; "" if they do not.

    The processor may differ, although its last bits may too.
    """
    pairs = {
        name: pair
        for name, pair in compare_versions(dict(versions)).items()
        if name != "machine" and pair["recorded"] != pair["installed"]
    }
    return format_version_changes(pairs)


def require_same_study(folder: Path, study: Study) -> None:
    """Raise InputError unless the study in a folder is this one, of the same versions."""
    stored, new = read_definition(folder), make_definition(study)
    for key, name in (
        ("study_toml", "study file"),
        ("profile_toml", "test"),
        ("model_toml", "model"),
    ):
        if stored.get(key) != new[key]:
            raise InputError(
                f"the {name} has changed since the study was started",
                where=folder,
                key="--resume",
                remedy="restore it, or start a new study in another folder",
            )
    problem = find_version_problem(stored.get("versions", {}))
    if problem:
        raise InputError(
            f"the study was started with other versions: {problem}",
            where=folder,
            key="--resume",
            remedy="install those, or start a new study in another folder",
        )


def hash_arrays(arrays: Mapping[str, npt.NDArray[Any]]) -> str:
    """Return a hash of arrays in their order."""
    digest = hashlib.sha256()
    for name, values in arrays.items():
        digest.update(name.encode())
        digest.update(np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()[:16]


def remove_partial_files(folder: Path) -> None:
    """Remove what zarr leaves behind when a process dies while it writes."""
    for path in (folder / RESULTS_FOLDER).rglob("*.partial"):
        path.unlink(missing_ok=True)


def replace_text(path: Path, text: str) -> None:
    """Write a file whole or not at all."""
    partial = path.with_suffix(path.suffix + ".new")
    with partial.open("w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    partial.replace(path)


class Manifest:
    """The stored chunks: a line of `chunks.jsonl` each, in the order in which they came."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / MANIFEST_FILE
        self.entries = {entry["chunk"]: entry for entry in self._read_lines()}

    def _read_lines(self) -> list[Json]:
        if not self._path.exists():
            return []
        entries = []
        for line in self._path.read_text(encoding="utf-8").splitlines(keepends=True):
            if line.endswith("\n"):  # else the process died while it wrote it
                entries.append(json.loads(line))
        return entries

    def start(self) -> None:
        """Drop a line that was cut."""
        self._rewrite(self.entries.values())

    def add(self, entry: Json) -> None:
        """Add a stored chunk; it is on the disk when this returns."""
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(entry) + "\n")
            file.flush()
            os.fsync(file.fileno())
        self.entries[entry["chunk"]] = entry

    def finish(self) -> None:
        """Sort the lines by chunk: the file of a finished study does not depend on the workers."""
        self._rewrite(self.entries[chunk] for chunk in sorted(self.entries))

    def _rewrite(self, entries: Iterable[Json]) -> None:
        replace_text(self._path, "".join(json.dumps(entry) + "\n" for entry in entries))

    @property
    def case_count(self) -> int:
        """Number of stored cases."""
        return sum(entry["cases"] for entry in self.entries.values())

    @property
    def failures(self) -> dict[int, str]:
        """Reasons of the cases without a result, by their numbers."""
        failures = [entry["failures"] for entry in self.entries.values()]
        return {int(case): reason for own in failures for case, reason in own.items()}
