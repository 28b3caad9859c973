"""Versions in recordings: the numerics revision follows the code that computes the bits."""

import ast
import hashlib
from pathlib import Path

import pytest

import twin
from twin.system import versions
from twin.system.versions import NUMERICS_REVISION, compare_versions, find_version_changes

# Of model and comparison without names, comments and docstrings. When it differs, replay recordings
# that were made before the change: where all are bit-identical, renew the hash; where one is not,
# raise NUMERICS_REVISION too.
STRUCTURE = {"revision 3": "b187c5368139"}


class Anonymizer(ast.NodeTransformer):
    """Replaces identifiers by numbers in order of appearance; removes texts and errors."""

    def __init__(self) -> None:
        self.numbers: dict[str, str] = {}

    def generic_visit(self, node: ast.AST) -> ast.AST:
        super().generic_visit(node)
        for field in ("name", "id", "arg", "attr", "asname", "module"):
            value = getattr(node, field, None)
            if isinstance(value, str):
                setattr(node, field, self.numbers.setdefault(value, str(len(self.numbers))))
        body = getattr(node, "body", None)
        if isinstance(body, list):
            node.body = [each for each in body if not is_text(each)]  # type: ignore[attr-defined]
        return node

    def visit_Constant(self, node: ast.Constant) -> ast.Constant:
        return ast.Constant("") if isinstance(node.value, str) else node

    def visit_JoinedStr(self, node: ast.JoinedStr) -> ast.Constant:
        return ast.Constant("")

    def visit_Raise(self, node: ast.Raise) -> ast.Raise:
        return ast.Raise()


def is_text(node: ast.AST) -> bool:
    constant = node.value if isinstance(node, ast.Expr) else None
    return isinstance(constant, ast.Constant) and isinstance(constant.value, str)


def dump(node: object) -> str:
    """The tree without what is empty, which differs between versions of Python."""
    if isinstance(node, ast.AST):
        fields = (f"{name}={dump(value)}" for name, value in ast.iter_fields(node) if value != [])
        return f"{type(node).__name__}({', '.join(fields)})"
    return f"[{', '.join(map(dump, node))}]" if isinstance(node, list) else repr(node)


def hash_structure(packages: tuple[Path, ...]) -> str:
    """Hash of the code's structure, whatever its files, functions and variables are called."""
    functions = sorted(
        dump(Anonymizer().visit(node))
        for package in packages
        for path in package.rglob("*.py")
        for node in ast.parse(path.read_text()).body
        if isinstance(node, ast.FunctionDef | ast.ClassDef | ast.Assign)
    )
    return hashlib.sha256("\n".join(functions).encode()).hexdigest()[:12]


def test_numerics_revision_matches_the_code() -> None:
    root = Path(twin.__file__).parent
    assert (
        hash_structure((root / "laws", root / "model", root / "compare"))
        == STRUCTURE[NUMERICS_REVISION]
    )


def test_only_the_structure_counts(tmp_path: Path) -> None:
    def structure(text: str) -> str:
        (tmp_path / "a.py").write_text(text)
        return hash_structure((tmp_path,))

    before = structure("def f(u, k):\n    return k * u")
    assert structure('def g(x, a):\n    """Force."""\n    return a * x  # N') == before
    assert structure("def f(u, k):\n    return u * k") != before
    assert structure("def f(u, k):\n    return 2 * k * u") != before


@pytest.mark.parametrize("installed", ["revision 1", "revision 3"])
def test_recordings_of_version_0_1_are_of_revision_1(
    installed: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorded = {"kernels": "1947a383fe41"}
    monkeypatch.setattr(versions, "NUMERICS_REVISION", installed)
    versions.read_installed_versions.cache_clear()
    try:
        changes = find_version_changes(recorded)
        assert compare_versions(recorded)["kernels"]["recorded"] == "revision 1"
    finally:
        versions.read_installed_versions.cache_clear()
    pair = {"recorded": "revision 1", "installed": installed}
    assert changes.get("kernels") == (pair if installed != "revision 1" else None)


def test_an_unknown_hash_is_a_change() -> None:
    assert "kernels" in find_version_changes({"kernels": "0123456789ab"})
