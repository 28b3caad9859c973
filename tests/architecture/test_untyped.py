"""Results cross a border as classes: no public function takes or returns a dict[str, Any].

Except at the true edges, which `budget.toml` counts by package: TOML and JSON before they are
checked, what a foreign library takes as keywords, messages of another program.
"""

import ast
import tomllib
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
BUDGET = tomllib.loads(Path(__file__).with_name("budget.toml").read_text())["untyped"]
UNTYPED = ("dict[str, Any]", "Mapping[str, Any]")


@cache
def parse_sources() -> dict[str, ast.Module]:
    """Trees of the product by path."""
    return {
        str(path.relative_to(ROOT)): ast.parse(path.read_text())
        for room in ("table_io", "twin")
        for path in (ROOT / room).rglob("*.py")
        if "_pb2" not in path.name
    }


@cache
def list_own_aliases(path: str) -> frozenset[str]:
    """Names that a file of the product gives to an untyped dictionary."""
    tree = parse_sources().get(path)
    return frozenset(name_untyped(tree)) if tree else frozenset()


def name_untyped(tree: ast.Module) -> Iterator[str]:
    """Names that a module gives to an untyped dictionary."""
    for node in tree.body:
        if isinstance(node, ast.Assign) and ast.unparse(node.value) in UNTYPED:
            yield from (target.id for target in node.targets if isinstance(target, ast.Name))


def list_aliases(tree: ast.Module) -> Iterator[str]:
    """Names of untyped dictionaries in a module, its own and imported ones."""
    yield from name_untyped(tree)
    for node in tree.body:
        if isinstance(node, ast.ImportFrom) and f"{node.module}".startswith(("twin", "table_io")):
            known = list_own_aliases(f"{node.module}".replace(".", "/") + ".py")
            yield from (name.name for name in node.names if name.name in known)


def count_untyped(tree: ast.Module) -> int:
    """Untyped dictionaries in the signatures of the public functions and methods of a module."""
    untyped = {*UNTYPED, *list_aliases(tree)}
    scopes: list[ast.Module | ast.ClassDef] = [
        tree,
        *(node for node in tree.body if isinstance(node, ast.ClassDef)),
    ]
    return sum(
        (node.id if isinstance(node, ast.Name) else ast.unparse(node)) in untyped
        for scope in scopes
        if not getattr(scope, "name", "").startswith("_")
        for function in scope.body
        if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef)
        and not function.name.startswith("_")
        for annotation in list_annotations(function)
        for node in ast.walk(annotation)
        if isinstance(node, ast.Name | ast.Subscript)
    )


def list_annotations(function: ast.FunctionDef | ast.AsyncFunctionDef) -> Iterator[ast.expr]:
    """Annotations of the arguments and of the result of a function."""
    of = function.args
    arguments = [*of.posonlyargs, *of.args, *of.kwonlyargs, of.vararg, of.kwarg]
    yield from (each.annotation for each in arguments if each and each.annotation)
    if function.returns:
        yield function.returns


def find_package(path: str) -> str:
    """Name of the package of a file as the budget has it: `twin.results`, `table_io.config`."""
    return ".".join(Path(path).with_suffix("").parts[:2])


def test_untyped_dictionaries_cross_a_border_only_as_budgeted() -> None:
    counts: Counter[str] = Counter()
    for path, tree in parse_sources().items():
        counts[find_package(path)] += count_untyped(tree)
    beyond = {package: count for package, count in counts.items() if count > BUDGET.get(package, 0)}
    assert beyond == {}


def test_an_untyped_dictionary_is_counted_in_any_place_of_a_public_signature() -> None:
    source = """
Json = dict[str, Any]
def show(entry: Json, rows: list[dict[str, Any]]) -> Iterator[Mapping[str, Any]]: ...
def _hide(entry: Json) -> Json: ...
class Page:
    def read(self, *, given: Json | None = None) -> dict[str, float]: ...
"""
    assert count_untyped(ast.parse(source)) == 4
