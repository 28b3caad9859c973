"""Files of a study: results as a zarr group, its definition, and a line per stored chunk.

`results.zarr` has a dimension `case`; every variable has one zarr chunk per chunk of cases, and
zarr replaces a file only when the new one is whole. `chunks.jsonl` lists the stored chunks with a
hash of their values; only the process that runs the study writes it, so that a chunk without a
line is computed again and its bytes are the same.
"""

import hashlib
import json
import math
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from table_io.block import Float2D
from table_io.config.plugins import list_entry_points
from table_io.errors import InputError
from twin.laws.library import ENTRY_POINT_GROUP as EFFECT_GROUP
from twin.results.sealed_lines import (
    SealedLine,
    SealedLines,
    hash_contract,
    is_sealed,
    make_damage_error,
)
from twin.studies import DEFINITION_FILE
from twin.studies.maps.outcomes import ENTRY_POINT_GROUP as OUTCOME_GROUP
from twin.studies.maps.outcomes import SweepPlan
from twin.studies.maps.study import Study, StudyDefinition
from twin.system.files import replace_text
from twin.system.versions import find_version_problem, read_installed_versions

COORDINATES = ("seed", "frequency_hz", "direction")  # besides the parameters
READ_ERRORS = (OSError, ValueError, RuntimeError, KeyError, TypeError, AttributeError)  # of zarr
RESULTS_FOLDER, MANIFEST_FILE = "results.zarr", "chunks.jsonl"
COORDINATE_CHUNK = 100_000  # cases
DIRECTION_VALUES = {"forward": 1, "backward": -1}


class StoredChunk(SealedLine):
    """Line of `chunks.jsonl`: cases from `first` on, and why cases have no result by number."""

    chunk: int
    first: int
    cases: int
    sha256: str
    failures: dict[int, str]

    @property
    def span(self) -> slice:
        """Place of its cases in the arrays."""
        return slice(self.first, self.first + self.cases)


def estimate_bytes_per_case(study: Study, sweep: SweepPlan) -> int:
    """Return the bytes that a case takes before compression, with its parameters and seed."""
    return 8 * (len(study.config.parameters) + 1) + sum(
        np.dtype(variable.dtype).itemsize * math.prod(sweep.find_shape(variable.dims))
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
    for variable in study.variables:
        shape = sweep.find_shape(variable.dims)
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
    definition = make_definition(study)
    definition.store_sha256 = _hash_store(folder, open_group(folder, "r"), study)
    definition.sha256 = hash_contract(definition, "sha256")
    text = json.dumps(definition.to_plain(), indent=1, sort_keys=True)
    replace_text(folder / DEFINITION_FILE, text)


def _hash_store(folder: Path, group: Any, study: Study) -> str:
    """Return a hash of the metadata of all arrays as written, and the values of the coordinates."""
    store = folder / RESULTS_FOLDER
    names = [*(parameter.name for parameter in study.config.parameters), *COORDINATES]
    arrays = {
        str(path.relative_to(store)): np.frombuffer(path.read_bytes(), dtype=np.uint8)
        for path in sorted(store.rglob("zarr.json"))
    }
    return hash_arrays(arrays | {name: group[name][:] for name in names})


def require_unchanged_store(folder: Path, study: Study, definition: StudyDefinition) -> None:
    """Raise InputError where metadata or coordinates are not those with which a study began."""
    if not definition.store_sha256:
        return
    try:
        is_same = definition.store_sha256 == _hash_store(folder, open_group(folder, "r"), study)
    except READ_ERRORS:
        is_same = False
    if not is_same:
        raise InputError(
            "its parameters, seeds or metadata are not those with which the study began",
            where=folder / RESULTS_FOLDER,
            remedy="restore it, or start a new study elsewhere",
        )


def _describe_study(study: Study) -> Mapping[str, object]:
    config = study.config
    names = [parameter.name for parameter in config.parameters]
    return {
        "title": config.title,
        "citation": config.citation,
        "parameters": names,
        "sampling": config.sampling,
        "shape": list(config.shape),
        "coordinates": " ".join([*names, "seed"]),  # of the cases, as xarray reads them
        "versions": read_study_versions(),
    }


def _add_coordinate(
    group: Any, name: str, values: npt.NDArray[Any], dim: str, attributes: Mapping[str, object]
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


def make_definition(study: Study) -> StudyDefinition:
    """Return what determines every byte of the results, by which a study can be resumed."""
    return StudyDefinition(
        study_toml=study.study_toml,
        profile_toml=study.profile_toml,
        model_toml=study.model_toml,
        versions=read_study_versions(),
    )


def read_definition(folder: Path) -> StudyDefinition:
    """Read the definition of a study; InputError if the folder has none."""
    path = folder / DEFINITION_FILE
    try:
        definition = StudyDefinition.model_validate_json(path.read_bytes(), extra="ignore")
    except OSError:
        raise InputError(
            "no study", where=folder, allowed="a folder in which `shaketwin map` has started one"
        ) from None
    except ValidationError as error:
        raise make_damage_error(path, error) from None
    if not is_sealed(definition, "sha256", bool(definition.store_sha256)):
        raise make_damage_error(path, "it is not what was written")
    return definition


def read_study_versions() -> dict[str, str]:
    """Return the versions that decide on the bytes: ours, those of zarr, and of all plug-ins."""
    from importlib.metadata import version

    plugins = {
        entry.dist.name: entry.dist.version
        for group in (EFFECT_GROUP, OUTCOME_GROUP)
        for entries in list_entry_points(group).values()
        for entry in entries
        if entry.dist is not None
    }
    own = {name: version(name) for name in ("zarr", "numcodecs")}
    return plugins | own | read_installed_versions()


def require_same_study(folder: Path, study: Study) -> None:
    """Raise InputError unless the study in a folder is this one, of the same versions."""
    stored, new = read_definition(folder), make_definition(study)
    for name, stored_text, new_text in (
        ("study file", stored.study_toml, new.study_toml),
        ("test", stored.profile_toml, new.profile_toml),
        ("model", stored.model_toml, new.model_toml),
    ):
        if stored_text != new_text:
            raise InputError(
                f"the {name} has changed since the study was started",
                where=folder,
                key="--resume",
                remedy="restore it, or start a new study in another folder",
            )
    problem = find_version_problem(stored.versions, new.versions)
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


def hash_stored(group: Any, names: Iterable[str], span: slice) -> str:
    """Return the hash of the variables of cases as they are on the disk; "" if unreadable.

    `group` holds the arrays by name.
    """
    try:
        return hash_arrays({name: group[name][span] for name in names})
    except READ_ERRORS:
        return ""


def remove_partial_files(folder: Path) -> None:
    """Remove what zarr leaves behind when a process dies while it writes."""
    for path in (folder / RESULTS_FOLDER).rglob("*.partial"):
        path.unlink(missing_ok=True)


def open_group(folder: Path, mode: str) -> Any:
    """Open the arrays of a study; `mode` as of `zarr.open_group`."""
    import zarr

    return zarr.open_group(folder / RESULTS_FOLDER, mode=mode)


def remove_unfinished_store(folder: Path) -> None:
    """Remove a store of a process that died before its study began; nothing is in it."""
    if {path.name for path in folder.glob("*")} == {RESULTS_FOLDER}:
        shutil.rmtree(folder / RESULTS_FOLDER)


class Manifest:
    """The stored chunks: a line of `chunks.jsonl` each, in the order in which they came."""

    def __init__(self, folder: Path, names: Iterable[str]) -> None:
        """`names`: the variables of the study, in the order of the hash."""
        self._path, self._names = folder / MANIFEST_FILE, tuple(names)
        must_be_sealed = bool(read_definition(folder).store_sha256)
        self._lines = SealedLines(self._path, StoredChunk, must_be_sealed)
        self.chunks = {chunk.chunk: chunk for chunk in self._lines.read()}

    def start(self, group: Any) -> None:
        """Drop a line that was cut, and those whose chunks are not what was stored.

        After a loss of power the lines may be on the disk without their chunks.
        """
        self.chunks = {
            number: chunk for number, chunk in self.chunks.items() if self.holds(group, chunk)
        }
        self._lines.rewrite(self.chunks.values())

    def holds(self, group: Any, chunk: StoredChunk) -> bool:
        """Return whether a chunk on the disk can be read and is what was computed."""
        return chunk.sha256 == hash_stored(group, self._names, chunk.span)

    def require_unchanged(self, group: Any) -> None:
        """Raise InputError for the first chunk that is not on the disk as it was stored."""
        try:
            arrays = {name: group[name] for name in self._names}
        except READ_ERRORS:  # no chunk of an array that is gone
            arrays = {}
        for chunk in self.chunks.values():
            if not self.holds(arrays, chunk):
                last = chunk.first + chunk.cases - 1
                raise InputError(
                    f"chunk {chunk.chunk}, cases {chunk.first} to {last}, is not what was stored: "
                    "altered or missing",
                    where=self._path.parent / RESULTS_FOLDER,
                    remedy=f"compute it again by `shaketwin map {self._path.parent} --resume`",
                )

    def add(self, chunk: StoredChunk) -> None:
        """Add the line of a stored chunk; the line is on the disk when this returns."""
        self.chunks[chunk.chunk] = self._lines.add(chunk)

    def finish(self) -> None:
        """Sort the lines by chunk: the file of a finished study does not depend on the workers."""
        self._lines.rewrite(self.chunks[number] for number in sorted(self.chunks))

    @property
    def case_count(self) -> int:
        """Number of stored cases."""
        return sum(chunk.cases for chunk in self.chunks.values())

    @property
    def failures(self) -> dict[int, str]:
        """Reasons of the cases without a result, by their numbers."""
        chunks = self.chunks.values()
        return {case: reason for chunk in chunks for case, reason in chunk.failures.items()}
