"""The house rules, each with a planted violation that must turn it red."""

import ast
import os
import shutil
import subprocess
import sys
import tomllib
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
TYPED_PYTHON = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["mypy"][
    "python_version"
]
SOURCES = ("table_io", "twin", "pyproject.toml", "README.md")
OWNERS = {  # packages that may import a foreign library
    "cryptography": ("twin/security",),
    "duckdb": ("twin/archive",),
    "google": ("twin/transport",),
    "grpc": ("table_io/backends/ni", "table_io/sim/ni"),
    "h5py": ("table_io/formats",),
    "lz4": ("twin/recording",),
    "mcap": ("twin/recording",),
    "nidaqmx": ("table_io/backends/ni", "table_io/sim/ni"),
    "nptdms": ("table_io/formats",),
    "opendaq": ("table_io/backends/opendaq", "table_io/sim"),
    "openpyxl": ("table_io/formats",),
    "pyarrow": ("table_io/formats",),
    "pyuff": ("table_io/formats",),
    "rerun": ("twin/viewer",),
    "segno": ("twin/system",),
    "time": ("table_io/clock.py",),
    "xarray": ("twin/log", "twin/studies/maps"),
    "zarr": ("twin/studies/maps",),
    "distributed": ("twin/system",),
    "zenoh": ("twin/transport", "twin/security"),
    "zstandard": ("twin/recording",),
}
VIOLATIONS = {
    "layers of the twin": ("twin/model/parameters.py", "import twin.transport.codec"),
    "layers of the rig": ("table_io/sequencer/state.py", "import table_io.acquisition.session"),
    "the rig never imports the twin": (
        "table_io/safety/preflight.py",
        "import twin.model.parameters",
    ),
    "the model knows blocks": ("twin/compare/curves.py", "import table_io.excitation.drive"),
    "the computational core does no I/O": ("table_io/excitation/drive.py", "import time"),
    "the simulated plant has its own": (
        "table_io/sim/plant.py",
        "import table_io.excitation.drive",
    ),
}


def lint(folder: Path) -> subprocess.CompletedProcess[str]:
    """The import linter's verdict on a tree."""
    program = Path(sys.executable).parent / "lint-imports"
    return subprocess.run(
        [str(program), "--no-cache"],
        cwd=folder,
        env={"PYTHONPATH": str(folder), "PATH": "/usr/bin:/bin", "COLUMNS": "200"},
        capture_output=True,
        text=True,
        check=False,
    )


@cache
def imports(path: Path) -> set[str]:
    """Roots of everything that a file imports, at any depth of it."""
    modules = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            modules |= {name.name.split(".")[0] for name in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            modules.add((node.module or "").split(".")[0])
    return modules


def test_import_contracts_hold() -> None:
    result = lint(ROOT)
    assert result.returncode == 0, result.stdout


@pytest.mark.parametrize("contract", VIOLATIONS)
def test_each_contract_bites(contract: str, tmp_path: Path) -> None:
    for name in SOURCES:
        source = ROOT / name
        copy = shutil.copytree if source.is_dir() else shutil.copy
        copy(source, tmp_path / name)
    file, line = VIOLATIONS[contract]
    path = tmp_path / file
    path.write_text(path.read_text() + f"\n{line}\n")
    result = lint(tmp_path)
    assert result.returncode == 1, result.stdout
    broken = [row for row in result.stdout.splitlines() if " BROKEN" in row]
    assert any(row.startswith(contract) for row in broken), result.stdout


@pytest.mark.parametrize("library", OWNERS)
def test_one_foreign_library_one_package(library: str) -> None:
    users = [
        str(path.relative_to(ROOT))
        for room in ("table_io", "twin")
        for path in (ROOT / room).rglob("*.py")
        if library in imports(path)
    ]
    assert users
    assert [user for user in users if not user.startswith(OWNERS[library])] == []


def backend_questions(source: str) -> list[str]:
    """Comparisons and matches of a rig's `backend` in a source: they should ask a capability."""

    def names_backend(node: ast.AST) -> bool:
        return isinstance(node, ast.Attribute) and node.attr == "backend" and is_rig(node.value)

    def is_rig(node: ast.AST) -> bool:
        name = node.attr if isinstance(node, ast.Attribute) else getattr(node, "id", "")
        return name.strip("_") == "rig"

    return [
        ast.unparse(node)
        for node in ast.walk(ast.parse(source))
        if (isinstance(node, ast.Compare) and any(map(names_backend, ast.walk(node))))
        or (isinstance(node, ast.Match) and names_backend(node.subject))
    ]


def test_nobody_asks_which_backend_a_rig_has() -> None:
    questions = {
        str(path.relative_to(ROOT)): backend_questions(path.read_text())
        for room in ("table_io", "twin")
        for path in (ROOT / room).rglob("*.py")
    }
    assert {path: asked for path, asked in questions.items() if asked} == {}


@pytest.mark.parametrize(
    "source",
    [
        'rig.backend == "ni"',
        'x = config.rig.backend in ("opendaq", "follow")',
        'match self._rig.backend:\n    case "ni": pass',
    ],
)
def test_a_question_for_the_backend_is_found(source: str) -> None:
    assert len(backend_questions(source)) == 1


def test_top_level_holds_only_what_was_given() -> None:
    tracked = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.split()
    top = {name.split("/")[0] for name in tracked}
    allowed = {"pyproject.toml", "twin", "table_io", "tests", "profiles", "README.md", "LICENSE"}
    assert {name for name in top if not name.startswith(".")} <= allowed


@pytest.mark.parametrize(
    "program",
    [
        ["ruff", "check", "."],
        ["ruff", "format", "--check", "."],
        ["mypy", "--cache-dir", os.devnull, "table_io", "twin"],
        pytest.param(["mypy"], marks=pytest.mark.slow),  # the tests too
    ],
)
def test_lint_and_types(program: list[str]) -> None:
    if program[0] == "mypy" and not sys.version.startswith(f"{TYPED_PYTHON}."):
        pytest.skip("types are checked with the packages of the lowest supported Python")
    tool = Path(sys.executable).parent / program[0]
    result = subprocess.run(
        [str(tool), *program[1:]], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stdout + result.stderr
