"""Mass and shape of the house: lines of each package, circles of files, late imports."""

import ast
import tomllib
from collections.abc import Iterator, Mapping
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
BUDGET = tomllib.loads(Path(__file__).with_name("budget.toml").read_text())
COMMANDS = "twin/*/cli.py"  # each command imports what it calls


def list_sources(root: Path = ROOT) -> list[Path]:
    """Return the modules of the product without generated ones, relative to the root."""
    paths = (path for room in ("table_io", "twin") for path in (root / room).rglob("*.py"))
    return sorted(path.relative_to(root) for path in paths if "_pb2" not in path.name)


def name_module(path: Path) -> str:
    return ".".join(path.with_suffix("").parts).removesuffix(".__init__")


def list_imports(tree: ast.AST, modules: Mapping[str, Path]) -> Iterator[str]:
    """Yield the modules of the product that a tree imports, at any depth of it."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in modules)
        elif isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                name = full if full in modules else node.module
                if name in modules:
                    yield name


def find_circle(root: Path) -> list[str]:
    """Return the modules of a circle of imports, [] without one."""
    modules = {name_module(path): root / path for path in list_sources(root)}
    graph = {
        name: {*list_imports(ast.parse(path.read_text()), modules)} - {name}
        for name, path in modules.items()
    }
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def count_late_imports(source: str) -> int:
    """Count the imports of modules of the product inside of functions."""
    functions = (
        node
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    )
    late = {
        node.lineno
        for function in functions
        for node in ast.walk(function)
        if isinstance(node, ast.ImportFrom)
        and (node.module or "").split(".")[0] in ("twin", "table_io")
    }
    return len(late)


def count_package_lines() -> dict[str, int]:
    """Return the lines of each package below `table_io` and `twin`, single modules together."""
    lines: dict[str, int] = {}
    for path in list_sources():
        package = "/".join(path.parts[: min(len(path.parts) - 1, 2)])
        lines[package] = lines.get(package, 0) + (ROOT / path).read_text().count("\n")
    return lines


def test_no_file_is_in_a_circle_of_imports() -> None:
    assert find_circle(ROOT) == []


def test_a_circle_through_a_late_import_is_found(tmp_path: Path) -> None:
    (tmp_path / "twin").mkdir()
    (tmp_path / "twin" / "a.py").write_text("from twin.b import f\n")
    (tmp_path / "twin" / "b.py").write_text("def f():\n    from twin import a\n")
    assert {*find_circle(tmp_path)} == {"twin.a", "twin.b"}
    (tmp_path / "twin" / "b.py").write_text("import os\n")
    assert find_circle(tmp_path) == []


def test_modules_of_the_product_are_imported_late_only_where_it_is_listed() -> None:
    """Which keeps `--help` quick, a vendor's library optional, or a process small."""
    late: dict[str, int] = {}
    for path in list_sources():
        key = COMMANDS if path.match(COMMANDS) else path.as_posix()
        if count := count_late_imports((ROOT / path).read_text()):
            late[key] = late.get(key, 0) + count
    assert late == BUDGET["late_imports"]


def test_a_late_import_is_counted_once() -> None:
    source = "def f():\n    def g():\n        from twin import api\n    import os\n"
    assert count_late_imports(source) == 1
    assert count_late_imports("from twin import api\n") == 0


@pytest.mark.parametrize("package", sorted(BUDGET["lines"]))
def test_a_package_is_within_its_budget(package: str) -> None:
    assert count_package_lines()[package] <= BUDGET["lines"][package]


def test_every_package_has_a_budget() -> None:
    assert BUDGET["lines"].keys() == count_package_lines().keys()
