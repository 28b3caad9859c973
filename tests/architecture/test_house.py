"""The house rules, each with a planted violation that must turn it red."""

import ast
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SOURCES = ("table_io", "twin", "pyproject.toml", "README.md")
OWNERS = {
    "zenoh": {"twin/stream/zenoh_link.py"},
    "cryptography": {"twin/service/authority.py"},
    "mcap": {"twin/stream/mcap_log.py"},
    "zstandard": {"twin/stream/framing.py"},
    "lz4": {"twin/stream/framing.py"},
    # a package of its own: what is sent, how it is laid out, the viewer's window
    "rerun": {f"twin/stream/rerun/{name}.py" for name in ("sink", "blueprint", "window")},
    "google": {"twin/stream/wire.py", "twin/stream/shaketwin_pb2.py"},
    "time": {"table_io/clock.py"},
    "h5py": {"twin/stream/tables/hdf5.py"},
    "nptdms": {"twin/stream/tables/tdms.py"},
    "pyarrow": {"twin/stream/tables/parquet.py"},
    "pyuff": {"twin/stream/tables/uff.py"},
    "xarray": {"twin/log/dataset.py"},
    "opendaq": {"table_io/backends/opendaq/source.py"},
    "pysindy": {"twin/service/study/rivals_sindy.py"},
    # a package of its own: the client, and the far side of its protocol
    "nidaqmx": {
        f"table_io/backends/ni/{name}.py"
        for name in (
            "__init__",
            "backend",
            "codes",
            "found",
            "lines",
            "opening",
            "server",
            "service",
            "calls",
            "entry",
            "tasks",
        )
    },
    "grpc": {
        f"table_io/backends/ni/{name}.py"
        for name in ("calls", "channel", "found", "server", "service")
    },
    "sklearn": {"twin/service/study/rivals_blackbox.py"},
}
VIOLATIONS = {
    "arrows point down": ("twin/model/parameters.py", "import twin.stream.wire"),
    "arrows point down: service > log": ("twin/stream/salvage.py", "import twin.log"),
    "the rig never imports the twin": ("table_io/limits.py", "import twin.model.parameters"),
    "model and compare know only": ("twin/compare/curves.py", "import table_io.drive"),
    "what thinks touches no world": ("table_io/drive.py", "import time"),
    "the truth is not the twin": ("table_io/backends/plant.py", "import table_io.drive"),
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
        timeout=120,
        check=False,
    )


def imports(path: Path) -> set[str]:
    """Roots of everything that a file imports, at any depth of it."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {name.name.split(".")[0] for name in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            found.add((node.module or "").split(".")[0])
    return found


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
    broken = [row for row in result.stdout.splitlines() if row.strip().endswith("BROKEN")]
    assert any(row.startswith(contract) for row in broken), result.stdout


@pytest.mark.parametrize("library", OWNERS)
def test_one_foreign_library_one_file(library: str) -> None:
    users = {
        str(path.relative_to(ROOT))
        for room in ("table_io", "twin")
        for path in (ROOT / room).rglob("*.py")
        if library in imports(path)
    }
    assert users <= OWNERS[library]


def test_top_level_holds_only_what_was_given() -> None:
    tracked = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.split()
    top = {name.split("/")[0] for name in tracked}
    allowed = {"pyproject.toml", "twin", "table_io", "tests", "profiles", "README.md", "LICENSE"}
    assert {name for name in top if not name.startswith(".")} <= allowed


@pytest.mark.parametrize(
    "program", [["ruff", "check", "."], ["ruff", "format", "--check", "."], ["mypy"]]
)
def test_lint_and_types(program: list[str]) -> None:
    tool = Path(sys.executable).parent / program[0]
    result = subprocess.run(
        [str(tool), *program[1:]], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stdout + result.stderr
