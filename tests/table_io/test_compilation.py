"""Compiled kernels on disk: none outlives a change of code that is compiled into it."""

import importlib
import os
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import ModuleType
from typing import Any

import numba
import numpy as np
import pytest
from numba import float64

from table_io import compilation
from table_io.compilation import fingerprint_kernel, jit_helper, jit_kernel, remove_unused_kernels
from twin.laws.expression import build_function

# A kernel of a package that is not ours, as a plug-in brings it; `{}` are changed by the tests.
LAW_MODULE = """
from numba import njit
from table_io.compilation import jit_helper, jit_helper_unless_none
from {package} import constants
TABLE = ((1.0, 2.0), (3.0, {table}))

@njit
def dispatched(x):
    return {dispatched} * x

@jit_helper(inlined=True)
def inlined(x):
    return {inlined} * x + dispatched(x)

@jit_helper_unless_none("x", lambda x: {absent})
def present(x):
    return {present} * x
"""
CONSTANTS_MODULE = "FACTOR = {factor}\n"
KERNEL_MODULE = """
from table_io.compilation import jit_kernel
from {package} import constants
from {package}.laws import TABLE, inlined, present

@jit_kernel()
def kernel(x):
    return later(x) + TABLE[1][1] + present(x) + present(None) + constants.FACTOR

@jit_kernel()
def later(x):  # defined below the kernel that calls it
    return inlined(x)
"""
VALUES = {
    "table": 4.0,
    "dispatched": 5.0,
    "inlined": 6.0,
    "absent": 7.0,
    "present": 8.0,
    "factor": 9,
}
RUN_KERNEL = """
from plant_laws.kernels import kernel
print(kernel(1.0), sum(kernel.stats.cache_hits.values()))
"""


def write_package(folder: Path, name: str, **changed: float) -> None:
    package = folder / name
    package.mkdir(exist_ok=True)
    (package / "__init__.py").touch()
    for module, text in (
        ("laws", LAW_MODULE), ("constants", CONSTANTS_MODULE), ("kernels", KERNEL_MODULE)
    ):  # fmt: skip
        path, own = package / f"{module}.py", text.format(package=name, **VALUES | changed)
        if not path.exists() or path.read_text() != own:  # older versions of numba see a rewriting
            path.write_text(own)


def run_kernel(folder: Path, cache: Path) -> list[str]:
    root = Path(__file__).parents[2]
    completed = subprocess.run(
        [sys.executable, "-B", "-c", RUN_KERNEL],
        capture_output=True,
        check=True,
        text=True,
        env={
            **os.environ,
            "NUMBA_CACHE_DIR": str(cache),
            "PYTHONPATH": f"{root}{os.pathsep}{folder}",
        },
    )
    return completed.stdout.split()


def test_kernel_follows_a_function_in_another_file(tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    write_package(tmp_path, "plant_laws")
    total = sum(VALUES.values())
    assert run_kernel(tmp_path, cache) == [str(total), "0"]
    assert run_kernel(tmp_path, cache) == [str(total), "1"]
    write_package(tmp_path, "plant_laws", dispatched=105.0)
    assert run_kernel(tmp_path, cache) == [str(total + 100.0), "0"]
    copy = tmp_path / "clone"
    copy.mkdir()
    write_package(copy, "plant_laws")
    assert run_kernel(copy, cache) == [str(total), "1"], "not found from another copy"


def test_compiled_kernels_go_to_the_cache_of_the_user_after_an_import_of_numba(
    tmp_path: Path,
) -> None:
    write_package(tmp_path, "plant_laws")
    folder, cache = tmp_path / "folder", tmp_path / "cache"
    folder.mkdir()
    env = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    path = f"{Path(__file__).parents[2]}{os.pathsep}{tmp_path}"
    command = [sys.executable, "-B", "-c", f"import numba\n{RUN_KERNEL}"]
    env |= {"PYTHONPATH": path, "XDG_CACHE_HOME": str(cache)}
    subprocess.run(command, check=True, cwd=folder, env=env)
    assert not [*folder.iterdir()]
    assert [*cache.rglob("*.kernel")]


def test_signatures_do_not_share_what_was_compiled(import_package: Any) -> None:
    total = sum(VALUES.values())
    for hits in (0, 1):
        kernel = import_package().kernel
        assert [kernel(1.0), kernel(1), kernel(1.0 + 0j)] == [total, total, total + 0j]
        assert set(kernel.stats.cache_hits.values()) == ({1} if hits else set())


def test_class_of_an_argument_that_has_moved_is_not_looked_for_where_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "cache"))

    @jit_kernel()
    def add_pair(nested: Any) -> float:
        return nested[0].first + nested[0].second

    for place in ("place_before", "place_after"):
        source = "from typing import NamedTuple\nclass Pair(NamedTuple):\n    first: float\n"
        (tmp_path / f"{place}.py").write_text(f"{source}    second: float\n")
        pair = importlib.import_module(place).Pair(1.0, 2.0)
        assert jit_kernel()(add_pair.py_func)((pair,)) == 3.0  # type: ignore[attr-defined]
        (tmp_path / f"{place}.py").unlink()
        monkeypatch.delitem(sys.modules, place)
        importlib.invalidate_caches()


@pytest.fixture
def import_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return a function that imports the package with these values, each time under a new name."""
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "cache"))

    def import_changed(**changed: float) -> ModuleType:
        for name in [name for name in sys.modules if name.partition(".")[0] == "laws_package"]:
            monkeypatch.delitem(sys.modules, name)
        write_package(tmp_path, "laws_package", **changed)
        monkeypatch.setattr(sys, "dont_write_bytecode", True)
        importlib.invalidate_caches()
        return importlib.import_module("laws_package.kernels")

    return import_changed


def test_every_constant_and_function_of_a_kernel_is_in_its_fingerprint(import_package: Any) -> None:
    before = fingerprint_kernel(import_package().kernel)
    assert fingerprint_kernel(import_package().kernel) == before
    changed = {name: fingerprint_kernel(import_package(**{name: 99.0}).kernel) for name in VALUES}
    assert len({before, *changed.values()}) == len(VALUES) + 1


def make_multiplication(factor: Any):
    def multiply(x: float) -> Any:
        return x * factor

    return multiply


def call_itself(x: float) -> float:
    return call_itself(x - 1.0) if x in {3.0, 4.0} else x


@pytest.mark.parametrize(
    ("value", "other"),
    [(1, 2), (1.0, 1), ((1, (2,)), (1, (3,))), (np.arange(3), np.arange(3.0)), ("a", "b"),
     (np.float64(1.0), np.float64(2.0)), (call_itself, abs)],
)  # fmt: skip
def test_values_of_a_closure_are_part_of_the_fingerprint(value: Any, other: Any) -> None:
    fingerprint = fingerprint_kernel(make_multiplication(value))
    assert fingerprint == fingerprint_kernel(make_multiplication(value))
    assert fingerprint != fingerprint_kernel(make_multiplication(other))


def test_fingerprints_are_the_same_in_every_process() -> None:
    """Else no process would find what another one compiled."""
    code = (
        "from tests.table_io.test_compilation import call_itself, list_kernels;"
        "from table_io.compilation import fingerprint_kernel;"
        "print(fingerprint_kernel(call_itself), *map(fingerprint_kernel, list_kernels()))"
    )
    completed = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, check=True, text=True,
        cwd=Path(__file__).parents[2], env={**os.environ, "PYTHONHASHSEED": "7"},
    )  # fmt: skip
    assert completed.stdout.split() == [
        fingerprint_kernel(function) for function in (call_itself, *list_kernels())
    ]


def list_kernels() -> list[Any]:
    """Return the kernels of this package that are kept on disk, in the order of their modules."""
    from table_io import sensor_errors
    from table_io.safety import sample_checks
    from table_io.sim import plant
    from twin.dynamics import closed_form_map
    from twin.earthquakes import table_model
    from twin.model import closed_form, event_integrator_kernel, inverse_dynamics, stepped_sine
    from twin.results import spectra

    return [event_integrator_kernel.build_kernel(False)] + [
        kernel
        for module in (
            sensor_errors, sample_checks, plant, spectra, table_model,
            closed_form_map, closed_form, inverse_dynamics, stepped_sine,
        )
        for kernel in vars(module).values()
        if getattr(kernel, "__module__", "") == module.__name__
        and isinstance(getattr(kernel, "_cache", None), compilation._KernelCache)
    ]  # fmt: skip


def test_no_kernel_is_kept_by_numba_alone() -> None:
    """Its cache would not follow functions of other files."""
    root = Path(__file__).parents[2]
    keepers = [
        path.relative_to(root)
        for package in ("table_io", "twin")
        for path in (root / package).rglob("*.py")
        if re.search(r"\bn?jit\([^)]*\bcache\b", path.read_text())
    ]
    assert keepers == []


def test_kernels_name_all_modules_that_they_are_made_of() -> None:
    kernels = {kernel.py_func.__qualname__: kernel for kernel in list_kernels()}
    assert {
        "check_samples", "advance_samples", "run_stepped_sine", "advance_variations",
        "integrate_samples", "record_points", "capture_points",
        "follow_oscillators", "_force_kernel", "_simulate", "_advance_samples",
    } <= set(kernels)  # fmt: skip
    parts = set(compilation._describe_item(kernels["integrate_samples"], set()))
    assert {"hysteretic_variable", "locate_event", "static_friction"} & parts
    assert {"contact_mode", "advance_to_event"} <= set(
        compilation._describe_item(kernels["advance_variations"], set())
    )


@pytest.mark.parametrize("folder", ["/proc/no_folder", __file__])
def test_cache_that_cannot_be_written_costs_only_time(
    folder: str, import_package: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(numba.config, "CACHE_DIR", folder)
    assert import_package().kernel(1.0) == sum(VALUES.values())


@pytest.mark.parametrize("kept", [0.0, 0.5, 1.0])
def test_damaged_file_is_compiled_and_written_again(
    kept: float, tmp_path: Path, import_package: Any
) -> None:
    total = sum(VALUES.values())
    assert import_package().kernel(1.0) == total
    [path] = (tmp_path / "cache").glob("kernel-*")
    content = path.read_bytes()
    if kept < 1.0:
        path.write_bytes(content[: int(kept * len(content))])
    else:
        path.write_bytes(content[:-100] + bytes(100))
    for hits in (0, 1):
        kernel = import_package().kernel
        assert kernel(1.0) == total
        assert sum(kernel.stats.cache_hits.values()) == hits


def test_full_disk_costs_only_time(
    tmp_path: Path, import_package: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", refuse)
    assert import_package().kernel(1.0) == sum(VALUES.values())
    assert not list((tmp_path / "cache").glob("*.kernel"))


def test_processes_that_compile_at_once_leave_whole_files(tmp_path: Path) -> None:
    write_package(tmp_path, "plant_laws")
    with ThreadPoolExecutor(4) as pool:
        started = [pool.submit(run_kernel, tmp_path, tmp_path / "cache") for _ in range(4)]
    assert {each.result()[0] for each in started} == {str(sum(VALUES.values()))}
    assert run_kernel(tmp_path, tmp_path / "cache")[1] == "1"
    assert len(list((tmp_path / "cache").iterdir())) == 2  # and `later`


def test_kernels_that_nobody_uses_are_removed(tmp_path: Path) -> None:
    folder = tmp_path / "model_of_a_removed_clone"
    folder.mkdir()
    for path in (tmp_path / "old.kernel", tmp_path / "new.kernel", folder / "plant.step.nbi"):
        path.touch()
    for path in (tmp_path / "old.kernel", folder / "plant.step.nbi"):
        os.utime(path, (1.0, 1.0))
    remove_unused_kernels(tmp_path)
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == ["new.kernel"]


def test_kernel_in_use_is_not_removed(tmp_path: Path, import_package: Any) -> None:
    import_package().kernel(1.0)
    [path] = (tmp_path / "cache").glob("kernel-*")
    os.utime(path, (1.0, 1.0))
    import_package().kernel(1.0)
    remove_unused_kernels(tmp_path / "cache")
    assert path.exists()


@pytest.mark.parametrize("factor", [3.0, 4.0])
def test_written_functions_of_one_name_are_told_apart(factor: float) -> None:
    kernels = [jit_kernel(float64(float64))(build_function(f"def law(x):\n return {n} * x"))
               for n in (factor, factor + 10.0)]  # fmt: skip
    assert [kernel(2.0) for kernel in kernels] == [2.0 * factor, 2.0 * factor + 20.0]


def test_part_of_kernels_is_plain_python_outside_of_them() -> None:
    @jit_helper()
    def part(x: float) -> float:
        return 2.0 * x

    @jit_kernel()
    def kernel(x: float) -> float:
        return part(x) + 1.0

    assert kernel(3.0) == 7.0
    assert part(3.0) == 6.0
    assert not hasattr(part, "py_func")
