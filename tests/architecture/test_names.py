"""The rules for names that a program can judge, each with a planted violation."""

import ast
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
IRREGULAR_PARTICIPLES = frozenset(
    [
        "begun",
        "bound",
        "built",
        "done",
        "drawn",
        "driven",
        "felt",
        "found",
        "given",
        "heard",
        "held",
        "hidden",
        "kept",
        "known",
        "laid",
        "left",
        "lost",
        "made",
        "met",
        "said",
        "seen",
        "sent",
        "shown",
        "spent",
        "spoken",
        "stood",
        "struck",
        "taken",
        "thrown",
        "told",
        "understood",
        "won",
        "worn",
        "written",
    ]
)
NOUNS_IN_ED = frozenset({"feed", "need", "seed", "speed"})
VAGUE = frozenset({"one", "found", "said", "now", "there", "told", "heard", "seen"})
# Data attributes of public results, written in users' notebooks: only in these files.
PUBLIC_ATTRIBUTES = {
    "twin/log/__init__.py": frozenset({"held", "measured", "predicted"}),
    "twin/discovery/task.py": frozenset({"converged", "undetermined"}),
}
# Interfaces that several modules implement under one name.
SHARED_FUNCTIONS = frozenset({
    "check_reachable", "discover_devices",  # of each kind of hardware
    "load_column", "scan_columns",  # of each file format
    "describe_policy", "run_policy",  # of each adaptive test
    "force",  # of each effect
    "main",  # of each program
})  # fmt: skip
Finding = tuple[str, str]  # rule, name


def is_participle(name: str) -> bool:
    bare = name.strip("_")
    regular = bare.endswith("ed") and len(bare) > 4 and bare not in NOUNS_IN_ED
    return "_" not in bare and (bare in IRREGULAR_PARTICIPLES or regular)


def find_violations(tree: ast.Module, file: str = "") -> Iterator[Finding]:
    """Bare participles as functions, vague variables, one-word limits in a module."""
    exempt = PUBLIC_ATTRIBUTES.get(file, frozenset())
    for node in ast.walk(tree):
        function = node.name if isinstance(node, ast.FunctionDef) else ""
        if is_participle(function) and function not in exempt:
            yield "participle", function
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) and node.id in VAGUE:
            yield "vague variable", node.id
        if isinstance(node, ast.arg) and node.arg in VAGUE:
            yield "vague parameter", node.arg
    for statement in tree.body:
        if not isinstance(statement, ast.Assign) or not isinstance(statement.value, ast.Constant):
            continue
        for target in statement.targets:
            name = target.id if isinstance(target, ast.Name) else ""
            number = isinstance(statement.value.value, int | float)
            if name.isupper() and "_" not in name.strip("_") and number:
                yield "constant of one word", name


def public_names(tree: ast.Module) -> Iterator[tuple[str, str]]:
    """(kind, name) of public functions and of classes, private classes included."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
            yield "function", node.name
        if isinstance(node, ast.ClassDef):
            yield "class", node.name.lstrip("_")


def find_duplicates(trees: dict[str, ast.Module]) -> dict[tuple[str, str], list[str]]:
    places: dict[tuple[str, str], list[str]] = defaultdict(list)
    for place, tree in trees.items():
        for kind_and_name in public_names(tree):
            places[kind_and_name].append(place)
    return {
        (kind, name): where
        for (kind, name), where in places.items()
        if len(where) > 1 and (kind == "class" or name not in SHARED_FUNCTIONS)
    }


@pytest.fixture(scope="module")
def trees() -> dict[str, ast.Module]:
    """Syntax tree of each file of the project, generated ones excepted."""
    return {
        str(path.relative_to(ROOT)): ast.parse(path.read_text())
        for folder in ("table_io", "twin", "tests")
        for path in sorted((ROOT / folder).rglob("*.py"))
        if not path.name.endswith("_pb2.py")
    }


def test_names_are_terms(trees: dict[str, ast.Module]) -> None:
    violations = {file: list(find_violations(tree, file)) for file, tree in trees.items()}
    assert {file: rules for file, rules in violations.items() if rules} == {}


def test_a_class_or_public_function_name_means_one_thing(trees: dict[str, ast.Module]) -> None:
    product = {file: tree for file, tree in trees.items() if not file.startswith("tests/")}
    assert find_duplicates(product) == {}


@pytest.mark.parametrize(
    ("source", "rule"),
    [
        ("def told(): ...", "participle"),
        ("def _measured(): ...", "participle"),
        ("def held(): ...", "participle"),
        ("def f():\n    return [one for one in range(3)]", "vague variable"),
        ("def f(now): ...", "vague parameter"),
        ("MOST = 3", "constant of one word"),
    ],
)
def test_each_rule_bites(source: str, rule: str) -> None:
    assert [kind for kind, _ in find_violations(ast.parse(source))] == [rule]


def test_the_rule_of_duplicates_bites() -> None:
    tree = ast.parse("class Reading: ...\ndef detect_jumps(): ...")
    assert set(find_duplicates({"a.py": tree, "b.py": tree})) == {
        ("class", "Reading"),
        ("function", "detect_jumps"),
    }
